"""From occupancy grids to primitives: detection, refinement and tracking, and training and evaluation of networks."""

from prim.lazy import lazy_exports

__all__, __getattr__, __dir__ = lazy_exports(
    __name__,
    {
        "Detection": "detect.detection",
        "Detections": "detect.detection",
        "Rejection": "detect.detection",
        "Detector": "detect.detector",
        "Tracker": "detect.tracker",
    },
)
