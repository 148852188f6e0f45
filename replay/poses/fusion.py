"""Poses from odometry, GPS and compass together: Kalman filter, smoother, and the noise estimated from the log."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from prim.arrays import FloatArray, Stamps
from prim.se2 import compose_poses, inverse_poses, wrap_angles
from replay.poses.fusion_filter import filter_nodes, initial_state, with_wander
from replay.poses.fusion_nodes import FusionNodes
from replay.poses.fusion_noise import find_noise
from replay.poses.fusion_options import DEFAULTS, FusionOptions, SensorNoise, Wander
from replay.poses.kalman import (
    FIX_STD,
    HEADING_BIAS,
    HEADING_STD,
    HEADING_WANDER_STD,
    HEADING_WANDER_TIME,
    POSE,
    REJECTED,
    ROTATION_STD,
    SCALES,
    TRANSLATION_STD,
    USED,
    WANDER_STD,
    WANDER_TIME,
    FilterOutput,
    FilterState,
    QuadraticTerms,
    mean_frame_covariance,
    smooth,
)

NORMAL_MEDIAN = 0.6745
"""The median absolute value of a standard normal variable."""


class SmoothedErrors(NamedTuple):
    """How the errors of smoothed states are distributed.

    Attributes:
        means: The states (N, K), which begin with the pose.
        covariances: Their covariances (N, K, K).
        gains: The smoother's gains (N, K, K), by which errors of neighbouring states are correlated.
    """

    means: FloatArray
    covariances: FloatArray
    gains: FloatArray


@dataclass(frozen=True)
class PoseEstimate:
    """Poses at the nodes of a fusion.

    Attributes:
        stamps: (N,) ns.
        poses: (N, 3) x, y (m), heading (rad) in the map frame.
        covariances: (N, 3, 3).
        noise: The noise that they rest on.
        decisions: Whether each node's fix and heading (N, 2) were kalman.USED, kalman.REJECTED or absent (0).
        errors: How the errors of all are correlated; None for filtered poses.
    """

    stamps: Stamps
    poses: FloatArray
    covariances: FloatArray
    noise: SensorNoise
    decisions: NDArray[np.int64]
    errors: SmoothedErrors | None = None

    def frame_covariance(self, stamps: Stamps) -> FloatArray:
        """Compute the covariance (3, 3) of the pose of the map frame that the poses at ``stamps`` (ns) define.

        The mean error of these poses moves a map made from them as a whole. The covariance is that of the frame's
        x, y (m) and heading (rad), at its origin. Raises ValueError for poses that are not smoothed.
        """
        covariance: FloatArray = mean_frame_covariance(*self._known_errors(), np.isin(self.stamps, stamps))
        return covariance

    def seen_from_first(self, first: FilterState) -> PoseEstimate:
        """Move all poses together, so that the first one is where it is known to be.

        Errors of the first pose are then those of all: covariances are those of the motion since it.

        Args:
            first: What is known of the first pose.

        Returns:
            The moved poses, without their correlations.

        Raises:
            ValueError: The poses are not smoothed.
        """
        errors = self._known_errors()
        count, at_first = len(self.poses), self.covariances[0]
        # by how much an error of the first pose, which turns and shifts all that follows, moves the others
        carried = np.broadcast_to(np.eye(3), (count, 3, 3)).copy()
        carried[:, 0, 2] = self.poses[0, 1] - self.poses[:, 1]
        carried[:, 1, 2] = self.poses[:, 0] - self.poses[0, 0]
        shared, regression = np.empty((count, 3, 3)), np.eye(errors.means.shape[1])
        for k, covariance in enumerate(errors.covariances):  # of the first pose's error with that of each
            shared[k] = (regression @ covariance)[:POSE, :POSE]
            regression = regression @ errors.gains[k]
        shared = carried @ shared
        since = self.covariances - shared - shared.transpose(0, 2, 1)
        since += carried @ at_first @ carried.transpose(0, 2, 1)
        origin = compose_poses(first.mean[None, :POSE], inverse_poses(self.poses[:1]))
        poses = compose_poses(np.repeat(origin, count, axis=0), self.poses)
        poses[:, 2] = wrap_angles(poses[:, 2])
        turn = np.eye(3)
        cos, sin = math.cos(origin[0, 2]), math.sin(origin[0, 2])
        turn[:2, :2] = [[cos, -sin], [sin, cos]]
        turned = turn @ carried @ turn.T
        known = turned @ first.covariance[:POSE, :POSE] @ turned.transpose(0, 2, 1)
        return replace(self, poses=poses, covariances=turn @ since @ turn.T + known, errors=None)

    def _known_errors(self) -> SmoothedErrors:
        """Return how errors are correlated. Raises ValueError for poses that are not smoothed."""
        if self.errors is None:
            raise ValueError("the errors of poses that are not smoothed have no known correlation")
        return self.errors

    def reading_counts(self, sensor: int) -> tuple[int, int]:
        """Return how many readings of fixes (0) or headings (1) were used, and how many were rejected."""
        column = self.decisions[:, sensor]
        return int(np.count_nonzero(column == USED)), int(np.count_nonzero(column == REJECTED))


class Fusion:
    """Filters and smooths the measurements of a log.

    Args:
        nodes: The measurements.
        given: What is known of the noise; the rest is estimated.
        options: Gates, initial values and the numbers of the estimation.
    """

    def __init__(
        self, nodes: FusionNodes, given: SensorNoise | None = None, options: FusionOptions = DEFAULTS
    ) -> None:
        self.nodes = nodes
        self._given = given or SensorNoise()
        self._options = options
        self._noise, self._initial = find_noise(nodes, self._given, options)
        self._scales = self._noise[list(SCALES)].tolist()
        self._apply_scales()

    @property
    def noise(self) -> SensorNoise:
        """The noise in use: given, else estimated, else initial values (see FusionOptions).

        None for the GPS or the compass where no node has a reading of it; and for the odometry's translation
        (rotation) where it is not given and there are no fixes (neither fixes nor headings) to estimate it from.
        """
        noise, given = self._noise.tolist(), self._given
        has_fixes, has_headings = bool(self.nodes.has_fix.any()), bool(self.nodes.has_heading.any())
        distance, turn = self._scales
        return SensorNoise(
            noise[FIX_STD] if has_fixes else None,
            noise[HEADING_STD] if has_headings else None,
            noise[TRANSLATION_STD] if has_fixes or given.odometry_translation_std else None,
            noise[ROTATION_STD] if has_fixes or has_headings or given.odometry_rotation_std else None,
            noise[HEADING_BIAS] if has_headings else None,
            Wander(noise[WANDER_STD], noise[WANDER_TIME]) if noise[WANDER_STD] else None,
            Wander(noise[HEADING_WANDER_STD], noise[HEADING_WANDER_TIME]) if noise[HEADING_WANDER_STD] else None,
            None if distance == 1 else distance,
            None if turn == 1 else turn,
        )

    @property
    def initial_state(self) -> FilterState:
        """The belief before the first measurement; a copy."""
        return FilterState(self._initial.mean.copy(), self._initial.covariance.copy())

    def belief(self, pose: FloatArray, covariance: FloatArray) -> FilterState:
        """Return a belief in a pose, with wandering errors of which nothing is known yet.

        Args:
            pose: (3,) the mean.
            covariance: (3, 3).

        Returns:
            The belief.
        """
        return with_wander(FilterState(pose.copy(), covariance.copy()), self._noise, self._options)

    def step_variances(self, nodes: FusionNodes) -> FloatArray:
        """Return the process noise (N, 3) of each node's step: variances along x, y (m^2) and of the heading."""
        std = self._noise[[TRANSLATION_STD, TRANSLATION_STD, ROTATION_STD]]
        return nodes.variance_scales[:, None] * std**2 + self._options.min_step_variance

    def filtered(self) -> PoseEstimate:
        """Estimate each pose from the measurements until then."""
        return self._estimate(self.nodes.stamps, filter_nodes(self.nodes, self._noise, self._initial, self._options))

    def advance(self, begin: int, end: int, state: FilterState, inflation: float) -> FilterState:
        """Run the filter over some of the nodes.

        Args:
            begin: The index of the first node.
            end: The index after the last node.
            state: The belief before the first node.
            inflation: The factor of the odometry's variances.

        Returns:
            The belief at the last node.
        """
        output = filter_nodes(self.nodes.subrange(begin, end), self._inflated(inflation), state, self._options)
        return FilterState(output.means[-1].copy(), output.covariances[-1].copy())

    def smoothed(
        self,
        scans: QuadraticTerms | None = None,
        inflation: float = 1.0,
        count: int | None = None,
        starts_free: bool = False,
    ) -> PoseEstimate:
        """Estimate each pose from all measurements.

        Args:
            scans: The scans' log-likelihoods of the poses at the nodes.
            inflation: The factor of the odometry's variances.
            count: Use only the first so many nodes and their measurements; None: all.
            starts_free: Whether the first pose is anywhere near where it begins: in the frame of a map that the scans
                were matched with, it is known no better than others.

        Returns:
            The poses at the nodes, with the gains of the smoother.
        """
        nodes = self.nodes.subrange(0, count)
        scans = None if scans is None else QuadraticTerms(*(rows[:count] for rows in scans))
        initial = self._initial
        if starts_free:
            initial = self.belief(self._initial.mean[:POSE], self._options.initial_free_std**2 * np.eye(POSE))
        noise, headings = self._inflated(inflation), None
        for _ in range(self._options.max_smoothings):
            output = filter_nodes(nodes, noise, initial, self._options, scans, headings)
            before = output.means[:, 2].copy() if headings is None else headings
            gains = np.zeros_like(output.covariances)
            smooth(output, gains)
            # the steps are linear about these headings: where the filter knew little of them, once more with better
            headings = output.means[:, 2].copy()
            if np.abs(headings - before).max() < self._options.linear_heading:
                break
        return self._estimate(nodes.stamps, output, SmoothedErrors(output.means, output.covariances, gains))

    def gain_over_odometry(self) -> float:
        """Compare the uncertainty of poses with and without fixes and headings, each seen from the first one.

        Returns:
            The ratio of the root mean square standard deviations, without them over with them; headings count at a
            lever arm of 1 m. 1 or less where they add nothing, infinite where there is no odometry.
        """
        nodes, fused = self.nodes, self.smoothed()
        if not nodes.has_odometry:
            return math.inf
        first = FilterState(fused.poses[0], self._options.initial_known_std**2 * np.eye(POSE))
        nothing = np.full(len(nodes.stamps), np.nan)
        nodes = replace(nodes, fixes=np.column_stack((nothing, nothing)), headings=nothing)
        alone = filter_nodes(nodes, self._noise, first, self._options).covariances[:, :POSE, :POSE]
        variances = (np.trace(each.mean(axis=0)) for each in (alone, fused.seen_from_first(first).covariances))
        return math.sqrt(next(variances) / next(variances))

    def _inflated(self, inflation: float) -> FloatArray:
        """Return the noise with the odometry's variances multiplied."""
        noise = self._noise.copy()
        noise[[TRANSLATION_STD, ROTATION_STD]] *= math.sqrt(inflation)
        return noise

    def _estimate(self, stamps: Stamps, output: FilterOutput, errors: SmoothedErrors | None = None) -> PoseEstimate:
        poses = output.means[:, :POSE].copy()
        poses[:, 2] = wrap_angles(poses[:, 2])
        covariances = output.covariances[:, :POSE, :POSE].copy()
        return PoseEstimate(stamps, poses, covariances, self.noise, output.decisions, errors)

    def _apply_scales(self) -> None:
        """Take the scales that were found out of the odometry's steps."""
        distance, turn = self._scales
        if distance == turn == 1:
            return
        self.nodes = replace(self.nodes, steps=self.nodes.steps * [distance, distance, turn])
        self._noise[list(SCALES)] = 1.0
        self._initial = initial_state(self.nodes, self._noise, self._options)
