"""The likelihood of the log's own rays given a shape: geometry, the beam model, compiled kernels."""

from prim.lazy import lazy_exports

__all__, __getattr__, __dir__ = lazy_exports(
    __name__,
    {
        "BeamModel": "detect.refinement.likelihood.sensor_model",
        "RayBundle": "detect.refinement.likelihood.rays",
        "collect_rays": "detect.refinement.likelihood.rays",
    },
)
