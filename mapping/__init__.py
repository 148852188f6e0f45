"""Mapping: from scans at known poses to occupancy grids."""

from prim.lazy import lazy_exports

__all__, __getattr__, __dir__ = lazy_exports(
    __name__,
    {
        "GridFrame": "mapping.grid",
        "OccupancyGrid": "mapping.grid",
        "MapScores": "mapping.map_metrics",
        "Mapper": "mapping.mapper",
        "make_mapper": "mapping.mapper",
        "ReferenceMap": "mapping.reference_map",
    },
)
