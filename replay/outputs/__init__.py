"""What a replay leaves: the report, tables, pictures, and files for other programs."""

from prim.lazy import lazy_exports

__all__, __getattr__, __dir__ = lazy_exports(
    __name__,
    {
        "write_map": "replay.outputs.exports",
        "write_report": "replay.outputs.exports",
        "write_trajectory": "replay.outputs.exports",
        "FoundObject": "replay.outputs.found_objects",
        "FoundPrimitive": "replay.outputs.found_primitives",
        "Picture": "replay.outputs.picture",
        "report_json": "replay.outputs.report",
        "summary_rows": "replay.outputs.report",
        "primitives_table": "replay.outputs.tables",
    },
)
