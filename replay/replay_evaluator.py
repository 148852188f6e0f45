"""Evaluation of a replay against the log's ground truth: maps and poses."""

from __future__ import annotations

import numpy as np

from mapping.grid import GridFrame, OccupancyGrid
from mapping.map_metrics import MapScores
from mapping.reference_map import ReferenceMap
from prim.metrics import pose_nees, pose_rmse
from prim.scan import PosedScan
from prim.se2 import Pose2D, angle_difference
from prim.world import World
from replay.ground_truth import GroundTruth
from replay.poses.laser_poses import STILL, LaserPoses


class ReplayEvaluator:
    """Compares maps and poses with the ground truth, where the log has one.

    Args:
        frame: The place and size of the grid of the maps that are scored.
        truth: The true world; None where the log has none.
        poses: The laser's poses that the replay uses.
        true_poses: The laser's true poses; None where the log has none.
    """

    def __init__(
        self, frame: GridFrame, truth: GroundTruth | None, poses: LaserPoses, true_poses: LaserPoses | None
    ) -> None:
        self._truth = truth
        self._poses = poses
        self._true_poses = true_poses
        self._reference = ReferenceMap(frame) if truth is not None and true_poses is not None else None

    @property
    def scores_maps(self) -> bool:
        """Whether maps are scored: the true world and the true poses are known."""
        return self._reference is not None

    @property
    def compares_poses(self) -> bool:
        """Whether true poses are known and the replay uses others."""
        return self._true_poses is not None and (self._poses.matched or self._poses.source not in ("truth", STILL))

    @property
    def comparable_truth(self) -> GroundTruth | None:
        """The true world where the true poses are known too, so that the map can be compared with it; else None.

        That the map's frame is the true world's is assumed, not checked: maps are not aligned before they are scored.
        """
        return self._truth if self.scores_maps else None

    def world(self, stamp: int) -> World | None:
        """Return the true world at ``stamp`` (ns); None where the log has none."""
        return None if self._truth is None else self._truth.at(stamp)

    def update(self, posed: PosedScan) -> None:
        """Add the noise-free rays of a scan, cast in the true world from the true pose, to the reference map."""
        true = self._true_poses
        if self._reference is None or self._truth is None or true is None or not true.valid[posed.position]:
            return
        pose = Pose2D(*true.poses[posed.position].tolist())
        self._reference.update(posed.scan, pose, self._truth.at(posed.scan.stamp))

    def score(self, grid: OccupancyGrid) -> MapScores | None:
        """Score a map against the reference map of the scans so far; None without ground truth."""
        return None if self._reference is None else self._reference.score(grid.probability)

    def pose_error(self, position: int) -> tuple[float, float] | None:
        """Return one scan's position (m) and heading (rad) error; None where poses are not compared."""
        if self._true_poses is None or not self.compares_poses or not self._true_poses.valid[position]:
            return None
        pose, true = self._poses.poses[position], self._true_poses.poses[position]
        return float(np.hypot(*(pose - true)[:2])), abs(angle_difference(float(pose[2]), float(true[2])))

    def pose_rmse(self) -> tuple[float, float] | None:
        """Return the root mean square position (m) and heading (rad) errors; None where poses are not compared."""
        if self._true_poses is None or not self.compares_poses:
            return None
        both = self._poses.valid & self._true_poses.valid
        if not both.any():
            return None
        rmse = pose_rmse(self._poses.poses[both], self._true_poses.poses[both])
        return rmse if np.isfinite(rmse).all() else None

    def pose_nees(self) -> float | None:
        """Return the mean normalized estimation error squared of the poses; None without covariances or truth.

        None as well where a covariance is singular.

        Its expectation is 3, the degrees of freedom, where the covariances are right.
        """
        if self._true_poses is None or self._poses.covariances is None:
            return None
        both = self._poses.valid & self._true_poses.valid
        if not both.any():
            return None
        return pose_nees(self._poses.poses[both], self._true_poses.poses[both], self._poses.covariances[both])
