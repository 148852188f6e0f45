"""The scans of a log: which ones, of which scanners, by which clock."""

from prim.lazy import lazy_exports

__all__, __getattr__, __dir__ = lazy_exports(
    __name__,
    {
        "ScanLog": "replay.scans.scan_log",
        "Selection": "replay.scans.selection",
    },
)
