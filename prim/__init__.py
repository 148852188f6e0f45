"""prim: 2D LiDAR logs through an occupancy mapper and a detector of geometric primitives.

>>> import prim
>>> result = prim.replay("log.mcap", mapper="forward")
>>> result.primitives[0].kind, result.primitives[0].size, result.primitives[0].std

docs/api.md shows all of it. What is exported here is the public interface; it is loaded when it is first used.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from prim.lazy import lazy_exports

if TYPE_CHECKING:
    from mapping.grid import GridFrame, OccupancyGrid
    from prim.errors import LogReadError, OutputError, PrimError, UsageError, WorldError
    from prim.scan import Scan
    from prim.se2 import Pose2D
    from prim.shapes import Kind, Primitive
    from prim.world import World
    from recorder.api import record
    from replay.api import LaserTrajectory, Result, make_mapper, open_log, posed_scans, refine, replay, replay_each
    from replay.outputs.found_objects import FoundObject
    from replay.outputs.found_primitives import FoundPrimitive
    from replay.outputs.picture import Picture

__version__ = "0.2.0"

__all__ = [
    "FoundObject",
    "FoundPrimitive",
    "GridFrame",
    "Kind",
    "LaserTrajectory",
    "LogReadError",
    "OccupancyGrid",
    "OutputError",
    "Picture",
    "Pose2D",
    "PrimError",
    "Primitive",
    "Result",
    "Scan",
    "UsageError",
    "World",
    "WorldError",
    "make_mapper",
    "open_log",
    "posed_scans",
    "record",
    "refine",
    "replay",
    "replay_each",
]

_, __getattr__, __dir__ = lazy_exports(
    __name__,
    {
        "FoundObject": "replay.outputs.found_objects",
        "FoundPrimitive": "replay.outputs.found_primitives",
        "GridFrame": "mapping.grid",
        "Kind": "prim.shapes",
        "LogReadError": "prim.errors",
        "OccupancyGrid": "mapping.grid",
        "OutputError": "prim.errors",
        "Picture": "replay.outputs.picture",
        "Pose2D": "prim.se2",
        "PrimError": "prim.errors",
        "Primitive": "prim.shapes",
        "Result": "replay.api",
        "Scan": "prim.scan",
        "LaserTrajectory": "replay.api",
        "UsageError": "prim.errors",
        "World": "prim.world",
        "WorldError": "prim.errors",
        "make_mapper": "replay.api",
        "open_log": "replay.api",
        "posed_scans": "replay.api",
        "record": "recorder.api",
        "refine": "replay.api",
        "replay": "replay.api",
        "replay_each": "replay.api",
    },
)
