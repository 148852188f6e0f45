"""From a log to maps, scores, a report and a recording for the viewer."""

from prim.lazy import lazy_exports

__all__, __getattr__, __dir__ = lazy_exports(
    __name__,
    {
        "replay_options": "replay.keywords",
        "ReplayOptions": "replay.options",
        "Pipeline": "replay.pipeline",
        "report_json": "replay.outputs.report",
        "summary_rows": "replay.outputs.report",
        "ReplayResult": "replay.result",
    },
)
