"""What a mapper is, and which there are."""

from __future__ import annotations

from typing import Protocol

import numpy as np

from mapping.deterministic import DeterministicMapper
from mapping.grid import OccupancyGrid
from mapping.probabilistic import ProbabilisticMapper
from prim.errors import UsageError
from prim.frames import Pose2D, Scan
from prim.world import Bounds


class Mapper(Protocol):
    """Makes an occupancy grid of scans taken at known poses."""

    name: str

    def update(self, scan: Scan, pose: Pose2D) -> None:
        """Adds one scan, taken by a laser at ``pose`` in the map frame."""

    def grid(self) -> OccupancyGrid:
        """The map so far; later updates do not change it."""

    def finish(self) -> OccupancyGrid:
        """The map of all scans."""


MAPPERS: dict[str, type[DeterministicMapper] | type[ProbabilisticMapper]] = {
    mapper.name: mapper for mapper in (DeterministicMapper, ProbabilisticMapper)
}


def make_mapper(name: str, resolution: float, bounds: Bounds | None = None) -> Mapper:
    """A mapper by name, over given or growing ``bounds`` (m), its kernels compiled. Raises UsageError."""
    if name not in MAPPERS:
        raise UsageError(f"there is no mapper {name!r}: choose from {', '.join(MAPPERS)}")
    MAPPERS[name](1.0, (0.0, 0.0, 1.0, 1.0)).update(_NO_RAYS, Pose2D())
    return MAPPERS[name](resolution, bounds)


_NO_RAYS = Scan(0, "", 0.0, 0.0, 0.0, 1.0, np.zeros(0, dtype=np.float32))
