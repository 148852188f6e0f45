"""Tracking: poses from scans as they come, each matched with a map of the last ones, by odometry or without."""

from prim.lazy import lazy_exports

__all__, __getattr__, __dir__ = lazy_exports(
    __name__,
    {
        "LocalMap": "replay.poses.tracking.local_map",
        "ScanTrack": "replay.poses.tracking.scan_tracker",
        "track": "replay.poses.tracking.scan_tracker",
    },
)
