"""Where the scanner was: transforms, odometry, fusion, scan matching."""

from prim.lazy import lazy_exports

__all__, __getattr__, __dir__ = lazy_exports(
    __name__,
    {
        "Fusion": "replay.poses.fusion",
        "LaserPoses": "replay.poses.laser_poses",
        "PoseProvider": "replay.poses.pose_provider",
        "match_scans": "replay.poses.scan_matching",
    },
)
