"""The cells of a perfect map: what noise-free rays from the log's true poses end in and cross."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from mapping.grid import GridFrame
from mapping.kernels import UNSEEN, mark
from mapping.map_metrics import MapScores, map_scores
from mapping.morphology import dilate
from prim.scan import Scan
from prim.se2 import Pose2D
from prim.world import World


class TruthMap:
    """Gathers the truly occupied and truly free cells that a perfect sensor would have met.

    Occupied are the cells where rays end; free are the cells that rays cross and that lie more than one cell
    away from those. The insides of things, and all that no ray meets, are neither.
    """

    def __init__(self, frame: GridFrame) -> None:
        self.frame = frame
        self._states = np.full(frame.shape, UNSEEN, np.uint8)
        self._occupied = np.zeros(frame.shape, np.bool_)

    def update(self, scan: Scan, pose: Pose2D, world: World) -> None:
        """Adds the rays that ``scan`` would have had without noise from the true ``pose`` of its laser."""
        cos, sin = math.cos(pose.theta), math.sin(pose.theta)
        directions = scan.directions @ np.array([[cos, sin], [-sin, cos]])
        exact = world.cast((pose.x, pose.y), directions).astype(np.float32)
        perfect = replace(scan, ranges=np.where(exact < scan.range_max, exact, np.float32(np.inf)))
        hits = mark(
            self._states,
            self.frame.row,
            self.frame.col,
            perfect.ranges,
            perfect.directions,
            (pose.x, pose.y, cos, sin),
            (perfect.range_min, perfect.range_max),
            1 / self.frame.resolution,
        )
        self._occupied.reshape(-1)[hits] = True

    @property
    def occupied(self) -> NDArray[np.bool_]:
        """Cells where a ray ends (rows, cols)."""
        return self._occupied

    @property
    def crossed(self) -> NDArray[np.bool_]:
        """Cells that a ray crosses or ends in (rows, cols)."""
        crossed: NDArray[np.bool_] = self._states != UNSEEN
        return crossed

    @property
    def free(self) -> NDArray[np.bool_]:
        """Cells that a ray crosses, more than one cell away from any occupied one (rows, cols)."""
        return self.crossed & ~dilate(self._occupied, 1)

    def score(self, probability: NDArray[np.float32]) -> MapScores:
        """Scores of a map on the same frame."""
        return map_scores(probability, self.occupied, self.free)
