"""Detection in a replay: along the way and at the end, refined by the rays of its scans, also where things moved."""

from prim.lazy import lazy_exports

__all__, __getattr__, __dir__ = lazy_exports(
    __name__,
    {
        "MovedPrimitives": "replay.detection.moved_primitives",
        "DetectionRefiner": "replay.detection.refiner",
        "DetectionResult": "replay.detection.stage",
        "DetectionStage": "replay.detection.stage",
    },
)
