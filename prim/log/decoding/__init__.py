"""What messages decode to, and how: a codec for each type of message in each encoding."""

from prim.lazy import lazy_exports

__all__, __getattr__, __dir__ = lazy_exports(
    __name__,
    {
        "Content": "prim.log.decoding.codecs",
        "codec_of": "prim.log.decoding.codecs",
        "content_of": "prim.log.decoding.codecs",
    },
)
