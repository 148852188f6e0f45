"""A replay held against the truth that its log has: maps and poses."""

from __future__ import annotations

import numpy as np

from mapping.grid import GridFrame, OccupancyGrid
from mapping.map_metrics import MapScores
from mapping.reference_map import TruthMap
from prim.metrics import pose_nees, pose_rmse
from prim.scan import Scan
from prim.se2 import Pose2D
from prim.shapes import angle_difference
from replay.ground_truth import Truth
from replay.poses.localize import STILL, LaserPoses


class Judge:
    """Holds the replay against the truth, where the log has one."""

    def __init__(
        self, frame: GridFrame, truth: Truth | None, poses: LaserPoses, true_poses: LaserPoses | None
    ) -> None:
        self._truth = truth
        self._poses = poses
        self._true_poses = true_poses
        self._map = TruthMap(frame) if truth is not None and true_poses is not None else None

    @property
    def scores_maps(self) -> bool:
        """Whether the map is held against the true world."""
        return self._map is not None

    @property
    def compares_poses(self) -> bool:
        """Whether the poses are other than the true ones, and held against them."""
        return self._true_poses is not None and (self._poses.matched or self._poses.source not in ("truth", STILL))

    def update(self, position: int, scan: Scan, stamp: int) -> None:
        """Adds what a perfect sensor would have seen."""
        true = self._true_poses
        if self._map is None or self._truth is None or true is None or not true.valid[position]:
            return
        self._map.update(scan, Pose2D(*true.poses[position].tolist()), self._truth.at(stamp))

    def score(self, grid: OccupancyGrid) -> MapScores | None:
        """Scores of the map so far; None without truth."""
        return None if self._map is None else self._map.score(grid.probability)

    def pose_error(self, position: int) -> tuple[float, float] | None:
        """Position (m) and heading (rad) error of one scan's pose; None where poses are not compared."""
        if self._true_poses is None or not self.compares_poses or not self._true_poses.valid[position]:
            return None
        pose, true = self._poses.poses[position], self._true_poses.poses[position]
        return float(np.hypot(*(pose - true)[:2])), abs(angle_difference(float(pose[2]), float(true[2])))

    def pose_rmse(self) -> tuple[float, float] | None:
        """Root mean square position (m) and heading (rad) errors; None where poses are not compared."""
        if self._true_poses is None or not self.compares_poses:
            return None
        both = self._poses.valid & self._true_poses.valid
        return pose_rmse(self._poses.poses[both], self._true_poses.poses[both]) if both.any() else None

    def pose_nees(self) -> float | None:
        """The mean normalised error squared: 3 where the covariances are right; None where there are none."""
        if self._true_poses is None or self._poses.covariances is None:
            return None
        both = self._poses.valid & self._true_poses.valid
        if not both.any():
            return None
        return pose_nees(self._poses.poses[both], self._true_poses.poses[both], self._poses.covariances[both])
