"""The laser's pose on the robot, estimated from the robot's motion and the scans (extrinsic or hand-eye calibration).

Between two scans i and j the robot moved by U, which its poses give, and the laser by Z = M^-1 U M, where M is the
laser's pose on the robot. The scans of many pairs are registered (:mod:`replay.poses.scan_registration`), and the M
that fits best is found by Gauss and Newton, together with each pair's Z: the likelihood of Z by the scans, to second
order, times that by U, whose errors have variances that grow in proportion to the distance travelled and are
estimated along (compare Censi et al., «Simultaneous calibration of odometry and sensor parameters for mobile robots»,
2013). Pairs are independent of any map, which would have been drawn with a wrong M.

A turn determines the laser's position, a path its heading. What the motion does not determine is fixed at 0.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from prim import linear_algebra
from prim.arrays import FloatArray, Stamps
from prim.scan import PosedScan
from prim.se2 import Trajectory, compose_poses, relative_poses, relative_steps, rotate, wrap_angle, wrap_angles
from replay.poses.laser_poses import EXACT_SOURCES, LaserPoses
from replay.poses.scan_registration import PairTerms, RegistrationOptions, Surfaces, register_pairs

Scans = Callable[[LaserPoses], Iterable[PosedScan]]
"""Yields the scans that have a valid pose, with it."""


@dataclass(frozen=True)
class MountEstimationOptions:
    """The numbers of the estimation; set by hand where no source is named."""

    anchors: int = 120
    """Number of scans, evenly spread over the robot's path, that others are paired with."""

    separations: tuple[float, ...] = (0.5, 1.0, 2.0, 4.0)
    """Each of them is paired with the scans that follow at these distances travelled (m), path and turns."""

    turn_radius: float = 0.5
    """To choose pairs, a turn by 1 rad counts as a path of this length (m)."""

    drift_turn_radius: float = 0.05
    """For the errors of the robot's poses it counts as a path of this length (m)."""

    min_travel: float = 1.0
    """Nothing is estimated where the robot travelled less than this (m), path and turns."""

    min_pairs: int = 20
    """Nothing is estimated from fewer pairs."""

    start_headings: int = 8
    """The search starts from so many headings of the laser, evenly spread from 0 on."""

    min_start_gain: float = 0.05
    """Another start is preferred to heading 0 where the misfit is lower by this share."""

    coarse_pairs: int = 120
    """At most so many pairs are registered in the search."""

    coarse_steps: int = 10
    """Number of steps of the search from each start."""

    coarse_std: float = 0.15
    """Standard deviation of residuals (m) in the search."""

    coarse_distance: float = 0.5
    """Points of two scans that are further apart (m) do not correspond in the search."""

    steps: int = 16
    """Number of steps that refine the best result."""

    first_std: float = 0.05
    """Standard deviation of residuals (m) in the first of these steps."""

    std_decay: float = 0.75
    """It is multiplied by this from one step to the next, down to ``final_std``."""

    final_std: float = 0.02
    """Standard deviation of residuals (m) in the last steps."""

    distance_stds: float = 6.0
    """Points that are further apart than this many standard deviations do not correspond, or ``min_distance``."""

    min_distance: float = 0.1
    """See ``distance_stds`` (m)."""

    drift_position_std: float = 0.03
    """Standard deviation of the poses' error of position (m) after one metre, before it is estimated."""

    drift_heading_std: float = math.radians(2)
    """Standard deviation of their error of heading (rad) after one metre, before it is estimated."""

    drift_from_step: int = 4
    """Both are estimated from this step on."""

    min_drift_variance: float = 1e-10
    """Their variances (m^2, rad^2) are no smaller."""

    pair_robustness: float = 3.0
    """Pairs lose weight whose residual is larger than this many times the usual one."""

    ridge: float = 1e-3
    """Added to the information about a pair's residual (1/m^2, 1/rad^2), which may be singular."""

    prior_position_std: float = 1.0
    """Standard deviation (m) of a prior around the robot's origin, for what the motion does not determine."""

    prior_heading_std: float = math.pi
    """Standard deviation (rad) of a prior around 0."""

    blocks: int = 20
    """Number of stretches of the path that the uncertainty is estimated from, by leaving out each in turn."""

    timing_std: float = 0.01
    """Uncertainty (s) of the time between the stamps of scans and of poses, where the poses are not exact."""

    position_floor: float = 5e-4
    """Standard deviation (m) that is added to those of x and y for what the model does not describe."""

    heading_floor: float = math.radians(0.05)
    """The same for the heading (rad)."""

    max_position_std: float = 0.03
    """The motion does not determine x or y where its standard deviation (m) is larger."""

    max_heading_std: float = math.radians(3)
    """The motion does not determine the heading where its standard deviation (rad) is larger."""

    significance: float = 3.0
    """A component is significant where it differs from 0 by more than this many standard deviations ..."""

    min_position: float = 0.005
    """... and by more than this (m) ..."""

    min_heading: float = math.radians(0.3)
    """... or this (rad)."""

    min_misfit_gain: float = 0.01
    """The laser is taken to be elsewhere only where that lowers the misfit of the scans by this share: where poses
    have errors that the model does not describe, it does not."""

    registration: RegistrationOptions = field(default_factory=RegistrationOptions)


DEFAULTS = MountEstimationOptions()


@dataclass(frozen=True)
class MountEstimate:
    """An estimate of the laser's pose on the robot.

    Attributes:
        mount: (3,) x, y (m), heading (rad); 0 where the motion does not determine it.
        std: (3,) standard deviations (m, rad).
        determined: (3,) whether the motion determines the component.
        gain: The share by which the misfit of the scans is lower than with the laser at the robot's origin.
    """

    mount: FloatArray
    std: FloatArray
    determined: NDArray[np.bool_]
    gain: float

    def is_significant(self, options: MountEstimationOptions = DEFAULTS) -> bool:
        """Return whether the laser is elsewhere than at the robot's origin, as far as the motion determines it."""
        least = np.array([options.min_position, options.min_position, options.min_heading])
        threshold = np.maximum(options.significance * self.std, least)
        return (
            bool((self.determined & (np.abs(self.mount) > threshold)).any()) and self.gain >= options.min_misfit_gain
        )

    def note(self) -> str:
        """Return what the scans suggest, with the option that takes it."""
        shown = [
            _rounded(float(self.mount[0]), float(self.std[0]), 3),
            _rounded(float(self.mount[1]), float(self.std[1]), 3),
            _rounded(math.degrees(self.mount[2]), math.degrees(self.std[2]), 1),
        ]
        names, units = ("x", "y", "heading"), ("m", "m", "degrees")
        estimated = [f"{names[k]} {' ± '.join(shown[k])} {units[k]}" for k in range(3) if self.determined[k]]
        fixed = [names[k] for k in range(3) if not self.determined[k]]
        taken = f" (the motion does not determine {' and '.join(fixed)}: 0 is assumed)" if fixed else ""
        return (
            f"the scans agree best with the laser at {', '.join(estimated)} on the robot{taken}; to use it: "
            f"--laser-offset {' '.join(value for value, _ in shown)}"
        )


def _rounded(value: float, std: float, digits: int) -> tuple[str, str]:
    """Return a value and its standard deviation as text; the latter is never shown as 0, the former never as -0."""
    return f"{round(value, digits) + 0.0:.{digits}f}", f"{max(std, 10.0**-digits):.{digits}f}"


def estimate_mount(
    poses: LaserPoses, stamps: Stamps, source: Scans, options: MountEstimationOptions = DEFAULTS
) -> MountEstimate | None:
    """Estimate the laser's pose on the robot.

    Args:
        poses: The robot's poses at N scans: those of a laser that is taken to be at its origin.
        stamps: The scans' stamps (N,) in ns.
        source: Yields the scans with the poses that it is given.
        options: The numbers.

    Returns:
        The estimate; None where the motion or the scans determine nothing.
    """
    pairs = _ScanPairs.choose(poses, stamps, source, options)
    if pairs is None:
        return None
    with np.errstate(all="ignore"):  # what overflows is not finite, and then nothing is determined
        return MountEstimator(pairs, options).run()


@dataclass(frozen=True)
class _ScanPairs:
    """Pairs of scans, and the robot's motion between them.

    Attributes:
        surfaces: The surfaces of the scans.
        scans: (P, 2) indices of the first and the second scan.
        steps: (P, 3) the robot's pose at the second scan relative to that at the first.
        later: (P, 3) the same where the poses' clock is late by ``timing_std``.
        travel: (P,) distance travelled in between (m), for the errors of the poses.
        span: (P, 2) where on the path the scans lie, from 0 to 1.
    """

    surfaces: Surfaces
    scans: NDArray[np.int64]
    steps: FloatArray
    later: FloatArray
    travel: FloatArray
    span: FloatArray

    @classmethod
    def choose(
        cls, poses: LaserPoses, stamps: Stamps, source: Scans, options: MountEstimationOptions
    ) -> _ScanPairs | None:
        """Choose pairs along the robot's path; None where there are too few."""
        valid = np.flatnonzero(poses.valid)
        order = valid[np.argsort(stamps[valid], kind="stable")]
        robot = poses.poses[order]
        motion = relative_steps(robot)
        path, turns = np.hypot(motion[:, 0], motion[:, 1]).cumsum(), np.abs(motion[:, 2]).cumsum()
        travel = path + options.turn_radius * turns
        if len(order) < 2 or not options.min_travel <= travel[-1] < math.inf:
            return None
        chosen = _spread_pairs(travel, options)
        wanted = np.zeros(len(stamps), dtype=bool)
        wanted[order[np.unique(chosen)]] = True
        posed = list(source(replace(poses, valid=wanted)))
        index_of = {scan.position: index for index, scan in enumerate(posed)}
        readable = np.isin(order[chosen], list(index_of)).all(axis=1)
        chosen = chosen[readable]
        if len(chosen) < options.min_pairs:
            return None
        late = np.zeros_like(robot)
        if poses.source not in EXACT_SOURCES:
            trajectory = Trajectory.from_unsorted(stamps[order], robot)
            late = trajectory.at(stamps[order] + round(options.timing_std * 1e9))[0] - robot
        a, b = chosen.T
        drift = path + options.drift_turn_radius * turns
        return cls(
            Surfaces.of(posed, options.registration),
            np.array([[index_of[k] for k in pair] for pair in order[chosen].tolist()], dtype=np.int64),
            relative_poses(robot[a], robot[b]),
            relative_poses(robot[a] + late[a], robot[b] + late[b]),
            np.maximum(drift[b] - drift[a], np.finfo(float).tiny),
            travel[chosen] / travel[-1],
        )

    def predicted(self, mount: FloatArray, steps: FloatArray | None = None) -> FloatArray:
        """Return the laser's poses (P, 3) at the second scans relative to the first ones, by the robot's motion."""
        steps = self.steps if steps is None else steps
        mounts = np.broadcast_to(mount, steps.shape)
        return relative_poses(mounts, compose_poses(steps, mounts))

    def jacobians(self, mount: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the derivatives (P, 3, 3) of :meth:`predicted` by the laser's mount and by the robot's steps."""
        back = rotate(np.eye(2), mount[2])  # the matrix R(-heading)
        predicted, theta = self.predicted(mount), self.steps[:, 2]
        cos, sin = np.cos(theta), np.sin(theta)
        turn = np.array([[cos, -sin], [sin, cos]]).transpose(2, 0, 1)
        by_mount, by_step = np.zeros((2, len(theta), 3, 3))
        by_mount[:, :2, :2] = back @ (turn - np.eye(2))
        by_mount[:, 0, 2], by_mount[:, 1, 2] = predicted[:, 1], -predicted[:, 0]
        lever = turn @ mount[:2]
        by_step[:, :2, :2] = back
        by_step[:, :2, 2] = np.column_stack((-lever[:, 1], lever[:, 0])) @ back.T
        by_step[:, 2, 2] = 1.0
        return by_mount, by_step

    def registered(
        self, mount: FloatArray, relative: FloatArray, std: float, distance: float, options: MountEstimationOptions
    ) -> PairTerms:
        """Return how well the scans fit at the lasers' relative poses (P, 3); see :func:`register_pairs`."""
        points = self.surfaces.in_laser_frame(mount)
        return register_pairs(points, self.surfaces.starts, self.scans, relative, std, distance, options.registration)

    def thinned(self, count: int) -> _ScanPairs:
        """Return at most ``count`` of the pairs, evenly spread, with half of the scans' points."""
        stride = max(1, -(-len(self.scans) // count))
        return replace(
            self,
            surfaces=self.surfaces.thinned(2),
            scans=self.scans[::stride],
            steps=self.steps[::stride],
            later=self.later[::stride],
            travel=self.travel[::stride],
            span=self.span[::stride],
        )

    def step_covariances(self, drift: tuple[float, float]) -> FloatArray:
        """Return the covariances (P, 3, 3) of the steps by the variances (m^2, rad^2) of their errors after 1 m.

        Errors of heading on the way, a random walk, displace the end across the path.
        """
        across = self.across
        covariances = np.zeros((len(self.travel), 3, 3))
        covariances[:, :2, :2] = drift[0] * np.eye(2) + drift[1] / 3 * across[:, :, None] * across[:, None, :]
        covariances[:, :2, 2] = covariances[:, 2, :2] = drift[1] / 2 * across
        covariances[:, 2, 2] = drift[1]
        return covariances * self.travel[:, None, None]

    @property
    def across(self) -> FloatArray:
        """The displacements (P, 2) of the steps' ends by a heading that is off from the start (m/rad)."""
        return np.column_stack((-self.steps[:, 1], self.steps[:, 0]))


def _spread_pairs(travel: FloatArray, options: MountEstimationOptions) -> NDArray[np.int64]:
    """Return pairs (P, 2) of indices along a path, by the distance travelled (N,) until each pose."""
    anchors = np.searchsorted(travel, np.linspace(0, travel[-1], options.anchors, endpoint=False))
    anchors = np.unique(anchors)
    partners = [np.searchsorted(travel, travel[anchors] + separation) for separation in options.separations]
    pairs = np.column_stack((np.tile(anchors, len(partners)), np.concatenate(partners)))
    return np.unique(pairs[pairs[:, 1] < len(travel)], axis=0)


def _inverses(matrices: linear_algebra.Matrix) -> FloatArray:
    """Return the inverses (P, K, K) of matrices; NaN where one is singular: then nothing is determined."""
    inverses = linear_algebra.solve(matrices, np.broadcast_to(np.eye(matrices.shape[1]), matrices.shape))
    return np.full(matrices.shape, np.nan) if inverses is None else inverses


def _multiply(matrices: linear_algebra.Matrix, vectors: FloatArray) -> FloatArray:
    """Return the products (P, 3) of matrices (P, 3, 3) and vectors (P, 3)."""
    product: FloatArray = np.einsum("pab,pb->pa", matrices, vectors)
    return product


def _wrapped(poses: FloatArray) -> FloatArray:
    """Return differences (N, 3) of poses with headings within half a turn."""
    return np.column_stack((poses[:, :2], wrap_angles(poses[:, 2])))


@dataclass(frozen=True)
class _Linearization:
    """The negative log-likelihood of the mount to second order, by pairs.

    Attributes:
        relative: (P, 3) the lasers' relative poses Z that the scans were registered at.
        by_mount: (P, 3, 3) derivatives of the prediction of Z by the mount.
        by_step: (P, 3, 3) its derivatives by the robot's step.
        scan_gradients: (P, 3) of the scans' negative log-likelihood with respect to Z.
        covariances: (P, 3, 3) of the prediction of Z, C.
        inverses: (P, 3, 3) of I + L C, where L is the scans' information about Z.
        weights: (P, 3, 3) the information W = (L^-1 + C)^-1 of Z's residual.
        pulls: (P, 3) derivatives of the negative log-likelihood by the prediction of Z.
        robust: (P,) weights of the pairs.
    """

    relative: FloatArray
    by_mount: FloatArray
    by_step: FloatArray
    scan_gradients: FloatArray
    covariances: FloatArray
    inverses: FloatArray
    weights: FloatArray
    pulls: FloatArray
    robust: FloatArray

    @property
    def gradients(self) -> FloatArray:
        """The gradients (P, 3) with respect to the mount."""
        return self.robust[:, None] * _multiply(self.by_mount.transpose(0, 2, 1), self.pulls)

    @property
    def by_relative(self) -> FloatArray:
        """The derivatives (P, 3, 3) of the gradients by the prediction of Z."""
        return self.robust[:, None, None] * (self.by_mount.transpose(0, 2, 1) @ self.weights)

    @property
    def information(self) -> FloatArray:
        """The information (P, 3, 3) about the mount."""
        return self.by_relative @ self.by_mount

    @property
    def totals(self) -> tuple[FloatArray, FloatArray]:
        """The gradient (3,) and the information (3, 3) of all pairs."""
        return self.gradients.sum(axis=0), self.information.sum(axis=0)

    def posterior(self, predicted: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return Z by the scans and by a prediction (P, 3), its difference from this, and its covariance."""
        off = _wrapped(predicted - self.relative)
        towards = off - _multiply(self.covariances, self.scan_gradients)
        relative = self.relative + _multiply(self.inverses.transpose(0, 2, 1), towards)
        return relative, _wrapped(relative - predicted), self.covariances @ self.inverses


class MountEstimator:
    """The implementation of :func:`estimate_mount`.

    Args:
        pairs: Pairs of scans.
        options: The numbers.
    """

    def __init__(self, pairs: _ScanPairs, options: MountEstimationOptions) -> None:
        self._pairs, self._options = pairs, options
        self._prior = np.diag([options.prior_position_std**-2] * 2 + [options.prior_heading_std**-2])

    def run(self) -> MountEstimate | None:
        """Estimate all components; while one is not determined, fix it at 0 and estimate the others anew."""
        options = self._options
        limits = np.array([options.max_position_std, options.max_position_std, options.max_heading_std])
        free, std = np.ones(3, dtype=bool), np.zeros(3)
        while free.any():
            mount, covariance = self._estimate(free)
            std = np.where(free, np.sqrt(np.diagonal(covariance)), 0.0)
            excess = std / limits
            if not np.isfinite(excess).all():
                return None
            if excess.max() <= 1:
                gain = 1 - self._misfit(mount) / max(self._misfit(np.zeros(3)), np.finfo(float).tiny)
                return MountEstimate(mount, std, free, gain)
            free[np.argmax(excess)] = False
        return None

    def _estimate(self, free: NDArray[np.bool_]) -> tuple[FloatArray, FloatArray]:
        """Return the mount (3,), with the components that are not free at 0, and its covariance (3, 3)."""
        options = self._options
        mount = self._search(free)
        relative = self._pairs.predicted(mount)
        start = options.drift_position_std**2, options.drift_heading_std**2
        drift, std = start, options.first_std
        for step in range(options.steps):
            std = max(std * options.std_decay, options.final_std)
            linear = self._linearized(mount, relative, drift, std)
            mount = mount + self._step(*linear.totals, mount, free)
            relative, errors, covariances = linear.posterior(self._pairs.predicted(mount))
            if step >= options.drift_from_step:
                drift = self._drift(errors, covariances, linear)
        return mount, self._covariance(mount, linear, free)

    def _search(self, free: NDArray[np.bool_]) -> FloatArray:
        """Return the best mount (3,) of coarse registrations from several headings."""
        options = self._options
        some = self._pairs.thinned(options.coarse_pairs)
        count = options.start_headings if free[2] else 1
        headings = np.linspace(0, 2 * np.pi, count, endpoint=False).tolist()
        found = [self._descend(some, np.array([0.0, 0.0, heading]), free) for heading in headings]
        usual, best = found[0], min(found, key=lambda result: result[1])
        mount = best[0] if best[1] < (1 - options.min_start_gain) * usual[1] else usual[0]
        return np.array([mount[0], mount[1], wrap_angle(float(mount[2]))])

    def _descend(self, pairs: _ScanPairs, mount: FloatArray, free: NDArray[np.bool_]) -> tuple[FloatArray, float]:
        """Return the mount (3,) that is reached from this one by exact poses, and the mean misfit of a point."""
        options, misfit = self._options, math.inf
        for _ in range(options.coarse_steps):
            fit = pairs.registered(
                mount, pairs.predicted(mount), options.coarse_std, options.coarse_distance, options
            )
            by_mount, _ = pairs.jacobians(mount)
            gradient = np.einsum("pai,pa->i", by_mount, fit.gradients)
            information = np.einsum("pai,pab,pbj->ij", by_mount, fit.information, by_mount)
            mount = mount + self._step(gradient, information, mount, free)
            misfit = float(fit.misfit.sum() / max(fit.points.sum(), 1.0))
        return mount, misfit

    def _misfit(self, mount: FloatArray) -> float:
        """Return the scans' misfit where the poses are exact and the laser is mounted here."""
        options, pairs = self._options, self._pairs
        distance = options.distance_stds * options.final_std
        return float(
            pairs.registered(mount, pairs.predicted(mount), options.final_std, distance, options).misfit.sum()
        )

    def _step(
        self, gradient: FloatArray, information: FloatArray, mount: FloatArray, free: NDArray[np.bool_]
    ) -> FloatArray:
        """Return the step (3,) of Gauss and Newton, 0 for components that are not free."""
        step, at = np.zeros(3), np.flatnonzero(free)
        centred = np.array([mount[0], mount[1], wrap_angle(float(mount[2]))])
        total = (gradient + self._prior @ centred)[at]
        solution = linear_algebra.solve((information + self._prior)[np.ix_(at, at)], -total)
        if solution is not None:
            step[at] = solution
        return step

    def _linearized(
        self, mount: FloatArray, relative: FloatArray, drift: tuple[float, float], std: float
    ) -> _Linearization:
        """Return the negative log-likelihood of the mount to second order at the lasers' relative poses (P, 3)."""
        options, pairs = self._options, self._pairs
        distance = max(options.distance_stds * std, options.min_distance)
        fit = pairs.registered(mount, relative, std, distance, options)
        by_mount, by_step = pairs.jacobians(mount)
        covariances = by_step @ pairs.step_covariances(drift) @ by_step.transpose(0, 2, 1)
        # with the scans' information L and the motion's covariance C, (I + L C)^-1 L is (L^-1 + C)^-1 for any L
        inverses = _inverses(np.eye(3) + fit.information @ covariances)
        weights = inverses @ fit.information
        pulls = _multiply(weights, _wrapped(pairs.predicted(mount) - relative)) + _multiply(inverses, fit.gradients)
        return _Linearization(
            relative, by_mount, by_step, fit.gradients, covariances, inverses, weights, pulls,
            _pair_weights(pulls, weights, options),
        )  # fmt: skip

    def _drift(self, errors: FloatArray, covariances: FloatArray, linear: _Linearization) -> tuple[float, float]:
        """Return the variances (m^2, rad^2) of the motion's errors after one metre: the M step of EM.

        Args:
            errors: (P, 3) of the lasers' relative poses by the motion.
            covariances: (P, 3, 3) of these, as they are only estimated.
            linear: What they come from.
        """
        # errors of the robot's steps; that of position less the mean effect of that of heading
        split = np.tile(np.eye(3), (len(errors), 1, 1))
        split[:, :2, 2] = -self._pairs.across / 2
        split = split @ _inverses(linear.by_step)
        variances = np.diagonal(split @ covariances @ split.transpose(0, 2, 1), axis1=1, axis2=2)
        squares = (_multiply(split, errors) ** 2 + variances) / self._pairs.travel[:, None]
        x, y, heading = (linear.robust @ squares / linear.robust.sum()).tolist()
        least = self._options.min_drift_variance
        return max((x + y) / 2, least), max(heading, least)

    def _covariance(self, mount: FloatArray, linear: _Linearization, free: NDArray[np.bool_]) -> FloatArray:
        """Return the covariance (3, 3) of the estimate; 0 for components that are not free.

        It is the sum of what leaving out stretches of the path shows (block jackknife: errors of neighbouring pairs
        are not independent), what the residuals' own noise and the prior give, of an error of the clocks, and of
        what the model does not describe.
        """
        options, pairs, at = self._options, self._pairs, np.flatnonzero(free)
        gradients, information = linear.gradients[:, at], linear.information[:, at][:, :, at]
        prior = self._prior[np.ix_(at, at)]
        model = _inverses((information.sum(axis=0) + prior)[None])[0]
        blocks = np.minimum(pairs.span * options.blocks, options.blocks - 1).astype(np.int64)
        kept = [(blocks[:, 1] < block) | (blocks[:, 0] > block) for block in range(options.blocks)]
        inverses = _inverses(np.array([information[k].sum(axis=0) + prior for k in kept]))
        replicates = _multiply(inverses, np.array([gradients[k].sum(axis=0) for k in kept]))
        off = replicates - replicates.mean(axis=0)
        jackknife = (options.blocks - 1) / options.blocks * off.T @ off
        late = _wrapped(pairs.predicted(mount, pairs.later) - pairs.predicted(mount))
        shift = model @ _multiply(linear.by_relative, late).sum(axis=0)[at]
        floor = np.array([options.position_floor, options.position_floor, options.heading_floor])[at]
        covariance = np.zeros((3, 3))
        covariance[np.ix_(at, at)] = jackknife + model + np.outer(shift, shift) + np.diag(floor**2)
        return covariance


def _pair_weights(pulls: FloatArray, weights: FloatArray, options: MountEstimationOptions) -> FloatArray:
    """Return the robust weights (P,) of pairs, by the squared Mahalanobis distances of their residuals.

    A pull is W d, with the weight W and the residual d, which may be anything where W is singular.
    """
    residuals = _multiply(_inverses(weights + options.ridge * np.eye(3)), pulls)
    distances = np.maximum((pulls * residuals).sum(axis=1), 0.0)
    usual = max(float(np.median(distances)), np.finfo(float).tiny)
    robust: FloatArray = (1 + distances / (usual * options.pair_robustness**2)) ** -2
    return robust
