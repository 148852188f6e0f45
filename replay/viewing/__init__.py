"""What the viewer is made of beside rerun: its protocol, geometry, tables as text, batches, checks."""

from prim.lazy import lazy_exports

__all__, __getattr__, __dir__ = lazy_exports(
    __name__,
    {
        "NullViewer": "replay.viewing.protocol",
        "Scene": "replay.viewing.protocol",
        "Viewer": "replay.viewing.protocol",
        "ViewerOptions": "replay.viewing.protocol",
    },
)
