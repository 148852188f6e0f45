"""Kinds fitted to a candidate's rays by maximum likelihood, and compared by their evidence."""

from prim.lazy import lazy_exports

__all__, __getattr__, __dir__ = lazy_exports(
    __name__,
    {
        "KindFit": "detect.refinement.fitting.fit",
        "Posterior": "detect.refinement.fitting.evidence",
        "compare_kinds": "detect.refinement.fitting.evidence",
    },
)
