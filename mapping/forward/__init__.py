"""The forward mapper: a forward sensor model fitted by expectation-maximisation."""

from prim.lazy import lazy_exports

__all__, __getattr__, __dir__ = lazy_exports(
    __name__,
    {
        "ForwardMapper": "mapping.forward.mapper",
        "estimate_range_noise": "mapping.forward.mapper",
    },
)
