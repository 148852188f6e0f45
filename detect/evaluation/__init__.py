"""Evaluation of detectors: metrics, suites of experiments, tables."""

from prim.lazy import lazy_exports

__all__, __getattr__, __dir__ = lazy_exports(
    __name__,
    {
        "score_boxes": "detect.evaluation.box_metrics",
        "evaluate_detector": "detect.evaluation.evaluate",
        "evaluate_session": "detect.evaluation.sessions",
        "evaluate_sessions": "detect.evaluation.sessions",
    },
)
