"""Loops: places that a track comes back to, recognised, verified and closed by a pose graph of its keyframes."""

from prim.lazy import lazy_exports

__all__, __getattr__, __dir__ = lazy_exports(
    __name__,
    {
        "ClosedLoops": "replay.poses.loops.loop_closing",
        "LoopCloser": "replay.poses.loops.loop_closing",
        "PoseGraph": "replay.poses.loops.pose_graph",
    },
)
