"""The paper's deterministic mapper (III-A): Bresenham's lines, the last scan wins."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from mapping.grid import UNKNOWN, GridFrame, Layer, OccupancyGrid
from mapping.kernels import FREE, OCCUPIED, UNSEEN, end_extent, mark
from prim.scan import Scan
from prim.se2 import Pose2D
from prim.world import Bounds

_PROBABILITY = np.array([0.0, 1.0, UNKNOWN], dtype=np.float32)
assert (FREE, OCCUPIED, UNSEEN) == (0, 1, 2)


class DeterministicMapper:
    """Marks the cells that rays cross as free and the cells where they end as occupied.

    Cells start unknown. Per scan all rays free their cells first and then all end points become occupied. A ray
    without a return frees its cells and marks none. Without ``bounds`` the grid grows with the end points; rays
    without a return are then followed within the bounds known so far.
    """

    name = "det"
    noise_std: float | None = None

    def __init__(self, resolution: float = 0.01, bounds: Bounds | None = None) -> None:
        self.resolution = resolution
        self._layer = Layer(resolution, bounds, UNSEEN, np.uint8)
        self._hits: list[tuple[GridFrame, NDArray[np.int64]]] = []

    def update(self, scan: Scan, pose: Pose2D) -> None:
        """Adds one scan, or the next part of one, taken by a laser at ``pose`` in the map frame."""
        place = (pose.x, pose.y, math.cos(pose.theta), math.sin(pose.theta))
        limits = (scan.range_min, scan.range_max)
        rays = (scan.ranges, scan.directions, place, limits, 1 / self.resolution)
        layer = self._layer
        if not layer.fixed:
            layer.cover(*end_extent(*rays))
        hits = mark(layer.array, layer.frame.row, layer.frame.col, *rays)
        if scan.first_beam == 0:
            self._hits.clear()
        for frame, earlier in self._hits:  # of the same scan: its end points come after all its rays
            if frame == layer.frame:
                layer.array.reshape(-1)[earlier] = OCCUPIED
        self._hits.append((layer.frame, hits))

    keep = update

    def grid(self) -> OccupancyGrid:
        """The map so far: 0 free, 1 occupied, 0.5 unknown."""
        frame, states = self._layer.crop()
        return OccupancyGrid(frame, _PROBABILITY[states])

    def finish(self) -> OccupancyGrid:
        """The map of all scans."""
        return self.grid()
