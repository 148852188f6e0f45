"""The cells of a perfect map: those that noise-free rays from the log's true poses end in and cross."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from mapping.grid import GridFrame
from mapping.kernels import UNSEEN, mark_scan, scan_arrays
from mapping.map_metrics import MapScores, map_scores
from mapping.morphology import dilate
from prim.arrays import BoolGrid
from prim.scan import Scan
from prim.se2 import Pose2D
from prim.world import World


class ReferenceMap:
    """Reference map: the truly occupied and truly free cells that a perfect sensor would have observed.

    Occupied are the cells where rays end; free are the cells that rays cross and that lie more than one cell away
    from those. The interior of objects, and all that no ray reaches, is neither.
    """

    def __init__(self, frame: GridFrame) -> None:
        """Start without any cells.

        Args:
            frame: The frame of the maps that are scored.
        """
        self.frame = frame
        self._states = np.full(frame.shape, UNSEEN, np.uint8)
        self._occupied = np.zeros(frame.shape, np.bool_)

    def update(self, scan: Scan, pose: Pose2D, world: World) -> None:
        """Add the rays that a scan would have had without noise.

        Args:
            scan: The scan.
            pose: True pose of its laser in the map frame.
            world: The world at that time.
        """
        cos, sin = math.cos(pose.theta), math.sin(pose.theta)
        directions = scan.directions @ np.array([[cos, sin], [-sin, cos]])
        exact = world.cast((pose.x, pose.y), directions).astype(np.float32)
        perfect = replace(scan, ranges=np.where(exact < scan.range_max, exact, np.float32(np.inf)))
        place = (self.frame.row, self.frame.col, 1 / self.frame.resolution)
        hits = mark_scan(self._states, place, scan_arrays(perfect, pose))
        self._occupied.reshape(-1)[hits] = True

    @property
    def occupied(self) -> BoolGrid:
        """Cells where a ray ends (rows, cols)."""
        return self._occupied

    @property
    def crossed(self) -> BoolGrid:
        """Cells that a ray crosses or ends in (rows, cols)."""
        crossed: BoolGrid = self._states != UNSEEN
        return crossed

    @property
    def free(self) -> BoolGrid:
        """Cells that a ray crosses, more than one cell away from any occupied one (rows, cols)."""
        return self.crossed & ~dilate(self._occupied, 1)

    def score(self, probability: NDArray[np.float32]) -> MapScores:
        """Return the scores of a map's probabilities of occupancy (rows, cols) on the same frame."""
        return map_scores(probability, self.occupied, self.free)
