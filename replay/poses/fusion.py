"""Poses from odometry, GPS and compass together: Kalman filter, smoother, and the noise estimated from the log."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from prim.arrays import FloatArray, Stamps
from prim.se2 import compose_poses, integrate_steps, inverse_poses, wrap_angles
from replay.poses.fusion_nodes import FusionNodes
from replay.poses.fusion_options import FusionOptions, SensorNoise
from replay.poses.kalman import (
    FIX_STD,
    HEADING_BIAS,
    HEADING_STD,
    REJECTED,
    ROTATION_STD,
    TRANSLATION_STD,
    USED,
    FilterModel,
    FilterOutput,
    FilterState,
    Gate,
    Measurements,
    QuadraticTerms,
    mean_frame_covariance,
    pack_symmetric,
    run_filter,
    smooth,
    unpack_symmetric,
)
from replay.poses.noise_estimation import NoiseEstimator

NORMAL_MEDIAN = 0.6745
"""The median absolute value of a standard normal variable."""

DEFAULTS = FusionOptions()


@dataclass(frozen=True)
class PoseEstimate:
    """Poses at the nodes of a fusion.

    Attributes:
        stamps: (N,) ns.
        poses: (N, 3) x, y (m), heading (rad) in the map frame.
        covariances: (N, 3, 3).
        noise: The noise that they rest on.
        decisions: Whether each node's fix and heading (N, 2) were kalman.USED, kalman.REJECTED or absent (0).
        gains: The smoother's gains (N, 3, 3), by which errors of neighbouring poses are correlated; None for
            filtered poses.
    """

    stamps: Stamps
    poses: FloatArray
    covariances: FloatArray
    noise: SensorNoise
    decisions: NDArray[np.int64]
    gains: FloatArray | None = None

    def frame_covariance(self, stamps: Stamps) -> FloatArray:
        """Compute the covariance (3, 3) of the pose of the map frame that the poses at ``stamps`` (ns) define.

        The mean error of these poses moves a map made from them as a whole. The covariance is that of the frame's
        x, y (m) and heading (rad), at its origin. Raises ValueError for poses that are not smoothed.
        """
        if self.gains is None:
            raise ValueError("the errors of poses that are not smoothed have no known correlation")
        selected = np.isin(self.stamps, stamps)
        covariance: FloatArray = mean_frame_covariance(
            self.poses, pack_symmetric(self.covariances), self.gains, selected
        )
        return covariance

    def seen_from_first(self, first: FilterState) -> PoseEstimate:
        """Move all poses together, so that the first one is where it is known to be.

        Errors of the first pose are then those of all: covariances are those of the motion since it.

        Args:
            first: What is known of the first pose.

        Returns:
            The moved poses, without gains.

        Raises:
            ValueError: The poses are not smoothed.
        """
        if self.gains is None:
            raise ValueError("the errors of poses that are not smoothed have no known correlation")
        count, at_first = len(self.poses), self.covariances[0]
        # by how much an error of the first pose, which turns and shifts all that follows, moves the others
        carried = np.broadcast_to(np.eye(3), (count, 3, 3)).copy()
        carried[:, 0, 2] = self.poses[0, 1] - self.poses[:, 1]
        carried[:, 1, 2] = self.poses[:, 0] - self.poses[0, 0]
        shared, regression = np.empty((count, 3, 3)), np.eye(3)
        for k, covariance in enumerate(self.covariances):  # of the first pose's error with that of each
            shared[k] = regression @ covariance
            regression = regression @ self.gains[k]
        shared = carried @ shared
        since = self.covariances - shared - shared.transpose(0, 2, 1)
        since += carried @ at_first @ carried.transpose(0, 2, 1)
        origin = compose_poses(first.pose[None], inverse_poses(self.poses[:1]))
        poses = compose_poses(np.repeat(origin, count, axis=0), self.poses)
        poses[:, 2] = wrap_angles(poses[:, 2])
        turn = np.eye(3)
        cos, sin = math.cos(origin[0, 2]), math.sin(origin[0, 2])
        turn[:2, :2] = [[cos, -sin], [sin, cos]]
        turned = turn @ carried @ turn.T
        known = turned @ unpack_symmetric(first.covariance) @ turned.transpose(0, 2, 1)
        return replace(self, poses=poses, covariances=turn @ since @ turn.T + known, gains=None)

    def reading_counts(self, sensor: int) -> tuple[int, int]:
        """Return how many readings of GPS (0) or compass (1) were used, and how many were rejected."""
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
        self._noise = self._initial_noise()
        self._initial = self._initial_state()
        self._estimate_noise()

    @property
    def noise(self) -> SensorNoise:
        """The noise in use: given, else estimated, else initial values (see FusionOptions).

        None for the GPS or the compass where no node has a reading of it; and for the odometry's translation
        (rotation) where it is not given and there are no fixes (neither fixes nor headings) to estimate it from.
        """
        fixes, headings, translation, rotation, bias = self._noise.tolist()
        has_fixes, has_headings = bool(self.nodes.has_fix.any()), bool(self.nodes.has_heading.any())
        given = self._given
        return SensorNoise(
            fixes if has_fixes else None,
            headings if has_headings else None,
            translation if has_fixes or given.odometry_translation_std else None,
            rotation if has_fixes or has_headings or given.odometry_rotation_std else None,
            bias if has_headings else None,
        )

    @property
    def initial_state(self) -> FilterState:
        """The belief before the first measurement; a copy."""
        return FilterState(self._initial.pose.copy(), self._initial.covariance.copy())

    def step_variances(self, nodes: FusionNodes) -> FloatArray:
        """Return the process noise (N, 3) of each node's step: variances along x, y (m^2) and of the heading."""
        std = self._noise[[TRANSLATION_STD, TRANSLATION_STD, ROTATION_STD]]
        return nodes.variance_scales[:, None] * std**2 + self._options.min_step_variance

    def filtered(self) -> PoseEstimate:
        """Estimate each pose from the measurements until then."""
        return self._estimate(self.nodes.stamps, self._run(self.nodes, self._noise))

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
        output = self._run(self.nodes.subrange(begin, end), self._inflated(inflation), initial=state)
        return FilterState(output.poses[-1].copy(), output.covariances[-1].copy())

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
        initial = None
        if starts_free:
            initial = FilterState(self._initial.pose, self._options.initial_free_std**2 * pack_symmetric(np.eye(3)))
        output = self._run(nodes, self._inflated(inflation), scans, initial)
        gains = np.zeros((len(output.poses), 3, 3))
        smooth(output, gains)
        return self._estimate(nodes.stamps, output, gains)

    def _inflated(self, inflation: float) -> FloatArray:
        """Return the noise with the odometry's variances multiplied."""
        noise = self._noise.copy()
        noise[[TRANSLATION_STD, ROTATION_STD]] *= math.sqrt(inflation)
        return noise

    def _estimate(self, stamps: Stamps, output: FilterOutput, gains: FloatArray | None = None) -> PoseEstimate:
        poses = output.poses.copy()
        poses[:, 2] = wrap_angles(poses[:, 2])
        return PoseEstimate(stamps, poses, unpack_symmetric(output.covariances), self.noise, output.decisions, gains)

    def _run(
        self,
        nodes: FusionNodes,
        noise: FloatArray,
        scans: QuadraticTerms | None = None,
        initial: FilterState | None = None,
    ) -> FilterOutput:
        """Run the filter over nodes with noise parameters (5,)."""
        options = self._options
        if scans is None:
            scans = QuadraticTerms(np.zeros((0, 3)), np.zeros((0, 6)), np.zeros((0, 3)))
        measurements = Measurements(nodes.steps, nodes.variance_scales, nodes.fixes, nodes.headings, scans)
        # without odometry a turn cannot be distinguished from a wrong heading, and nothing is rejected
        thresholds = (options.fix_gate, options.heading_gate) if nodes.has_odometry else (math.inf, math.inf)
        fix_gate, heading_gate = (Gate(threshold, options.max_rejections) for threshold in thresholds)
        model = FilterModel(noise, nodes.lever_arm, fix_gate, heading_gate, options.min_step_variance)
        output = FilterOutput.empty(len(nodes.stamps))
        run_filter(initial or self._initial, measurements, model, output)
        return output

    def _initial_noise(self) -> FloatArray:
        """Return the noise that is given, else that differences of neighbouring readings show, else the default."""
        given, nodes, options = self._given, self.nodes, self._options
        translation, rotation = options.default_odometry_std if nodes.has_odometry else options.default_walk_std
        fix_differences = np.diff(nodes.fixes[nodes.has_fix], axis=0)
        heading_differences = wrap_angles(np.diff(nodes.headings[nodes.has_heading]))
        return np.array(
            [
                given.position_std or _robust_std(fix_differences) or options.default_position_std,
                given.heading_std or _robust_std(heading_differences) or options.default_heading_std,
                given.odometry_translation_std or translation,
                given.odometry_rotation_std or rotation,
                given.heading_bias or 0.0,
            ]
        )

    def _initial_state(self) -> FilterState:
        """Return the initial pose and its covariance, from the first readings."""
        nodes, options = self.nodes, self._options
        odometry = integrate_steps(nodes.steps)
        x, y, theta = nodes.initial_pose.tolist()
        heading_std = options.initial_known_std
        if nodes.has_heading.any():
            at = np.flatnonzero(nodes.has_heading)[: options.initial_readings]
            theta = _median_angle(nodes.headings[at] - odometry[at, 2])
            heading_std = options.initial_compass_std
        elif nodes.has_fix.any():
            theta, heading_std = self._aligned_heading(odometry), options.initial_aligned_std
        position_std = options.initial_known_std
        if nodes.has_fix.any():
            at = np.flatnonzero(nodes.has_fix)[: options.initial_readings]
            cos, sin = math.cos(theta), math.sin(theta)
            moved = odometry[at, :2] @ np.array([[cos, sin], [-sin, cos]])
            x, y = np.median(nodes.fixes[at] - moved, axis=0).tolist()
            constant, multiple = options.initial_position_std
            position_std = constant + multiple * float(self._noise[FIX_STD])
        covariance = np.array([position_std**2, 0, 0, position_std**2, 0, heading_std**2])
        return FilterState(np.array([x, y, theta]), covariance)

    def _aligned_heading(self, odometry: FloatArray) -> float:
        """Return the initial heading by which the odometry's poses (N, 3) fit the fixes best (Procrustes)."""
        at = np.flatnonzero(self.nodes.has_fix)
        moved, fixes = odometry[at, :2], self.nodes.fixes[at]
        reach = np.hypot(*(moved - moved[0]).T)
        far = np.flatnonzero(reach > self._options.alignment_ratio * self._noise[FIX_STD])
        count = max(int(far[0]) + 1, self._options.initial_readings) if len(far) else len(at)
        moved, fixes = moved[:count] - moved[:count].mean(axis=0), fixes[:count] - fixes[:count].mean(axis=0)
        cross = float((moved[:, 0] * fixes[:, 1] - moved[:, 1] * fixes[:, 0]).sum())
        return math.atan2(cross, float((moved * fixes).sum()))

    def _free_parameters(self) -> list[int]:
        """Return which noise parameters are to be estimated, the bias apart.

        Without odometry the motion is anything but a random walk of normal steps, and the sensors' noise stays what
        differences of neighbouring readings show.
        """
        given, nodes = self._given, self.nodes
        has_fixes, has_headings = nodes.has_fix.any(), nodes.has_heading.any()
        free = {
            FIX_STD: given.position_std is None and has_fixes and nodes.has_odometry,
            HEADING_STD: given.heading_std is None and has_headings and nodes.has_odometry,
            TRANSLATION_STD: given.odometry_translation_std is None and has_fixes,
            ROTATION_STD: given.odometry_rotation_std is None and (has_fixes or has_headings),
        }
        return [parameter for parameter, is_free in free.items() if is_free]

    def _estimate_noise(self) -> None:
        """Estimate the noise that is not given, and whether the compass is biased."""
        free = self._free_parameters()
        if not free:
            return
        measured = np.flatnonzero(self.nodes.has_fix | self.nodes.has_heading)
        stride = max(1, -(-len(measured) // self._options.estimation.max_nodes))
        nodes = self.nodes.subset(np.union1d([0], measured[::stride]))
        estimator = NoiseEstimator(lambda noise: self._run(nodes, noise).costs, self._options.estimation)
        self._noise = estimator.maximize(self._noise, free)
        has_all = nodes.has_odometry and nodes.has_heading.any() and nodes.has_fix.any()
        if not (has_all and self._given.heading_bias is None):
            return
        if estimator.is_significant(self._noise, HEADING_BIAS):
            self._noise = estimator.maximize(self._noise, [*free, HEADING_BIAS])


def _robust_std(differences: FloatArray) -> float:
    """Return the standard deviation of single readings from their differences' median size; 0 where there is none."""
    return float(np.median(np.abs(differences))) / NORMAL_MEDIAN / math.sqrt(2) if differences.size else 0.0


def _median_angle(angles: FloatArray) -> float:
    return math.atan2(float(np.median(np.sin(angles))), float(np.median(np.cos(angles))))
