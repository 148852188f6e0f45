"""From a guess and the log's rays to the primitive, its covariance and the posterior probabilities of its kinds."""

from prim.lazy import lazy_exports

__all__, __getattr__, __dir__ = lazy_exports(
    __name__,
    {
        "MapCells": "detect.refinement.surroundings.map_cells",
        "RefinementOptions": "detect.refinement.options",
        "RefinedPrimitive": "detect.refinement.refine",
        "Refinement": "detect.refinement.refine",
        "refine_detections": "detect.refinement.refine",
    },
)
