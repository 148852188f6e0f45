"""The laser's pose on the robot, estimated from the robot's motion and the scans (extrinsic or hand-eye calibration).

Between two scans i and j the robot moved by U, which its poses tell, and the laser by Z = M^-1 U M, where M is the
laser's pose on the robot. The scans of many pairs are registered (:mod:`replay.poses.scan_registration`), and the M
that fits best is found by Gauss and Newton, together with each pair's Z: the likelihood of Z by the scans, to second
order, times that by U, whose errors have variances that grow in proportion to the distance travelled and are
estimated along (compare Censi et al., «Simultaneous calibration of odometry and sensor parameters for mobile robots»,
2013). Pairs are independent of any map, which would have been drawn with a wrong M.

A turn tells the laser's position, a path its heading. What the motion does not tell is fixed at 0.
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
from prim.se2 import Trajectory, compose_poses, relative_poses, relative_steps, rotate, wrap_angles
from replay.poses.laser_poses import EXACT_SOURCES, LaserPoses
from replay.poses.scan_registration import RegistrationOptions, Surfaces, register_pairs

Scans = Callable[[LaserPoses], Iterable[PosedScan]]
"""Yields the scans that have a valid pose, with it."""


@dataclass(frozen=True)
class MountEstimationOptions:
    """The numbers of the estimation; set by hand where no source is named."""

    anchors: int = 120
    """Number of scans, evenly spread over the robot's path, that others are paired with."""

    separations: tuple[float, ...] = (0.25, 0.5, 1.0, 2.0)
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

    min_gain: float = 0.05
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

    final_std: float = 0.012
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

    prior_position_std: float = 1.0
    """Standard deviation (m) of a prior around the robot's origin, for what the motion does not tell."""

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

    max_position_std: float = 0.02
    """The motion does not tell x or y where its standard deviation (m) is larger."""

    max_heading_std: float = math.radians(1.5)
    """The motion does not tell the heading where its standard deviation (rad) is larger."""

    significance: float = 3.0
    """A component is significant where it differs from 0 by more than this many standard deviations ..."""

    min_position: float = 0.005
    """... and by more than this (m) ..."""

    min_heading: float = math.radians(0.3)
    """... or this (rad)."""

    registration: RegistrationOptions = field(default_factory=RegistrationOptions)


DEFAULTS = MountEstimationOptions()


@dataclass(frozen=True)
class MountEstimate:
    """An estimate of the laser's pose on the robot.

    Attributes:
        mount: (3,) x, y (m), heading (rad); 0 where the motion does not tell it.
        std: (3,) standard deviations (m, rad).
        told: (3,) whether the motion tells the component.
    """

    mount: FloatArray
    std: FloatArray
    told: NDArray[np.bool_]

    def is_significant(self, options: MountEstimationOptions = DEFAULTS) -> bool:
        """Return whether the laser is not at the robot's origin, as far as the motion tells."""
        least = np.array([options.min_position, options.min_position, options.min_heading])
        threshold = np.maximum(options.significance * self.std, least)
        return bool((self.told & (np.abs(self.mount) > threshold)).any())

    def note(self) -> str:
        """Return what the scans suggest, with the option that takes it."""
        x, y, heading = (float(value) for value in (*self.mount[:2], math.degrees(self.mount[2])))
        x, y, heading = round(x, 3) + 0.0, round(y, 3) + 0.0, round(heading, 1) + 0.0  # + 0.0: no -0
        std = (*self.std[:2].tolist(), math.degrees(self.std[2]))
        parts = [
            f"{name} {value:.{digits}f} ± {max(error, 0.1**digits):.{digits}f}{unit}"
            for name, value, error, digits, unit, told in (
                ("x", x, std[0], 3, " m", self.told[0]),
                ("y", y, std[1], 3, " m", self.told[1]),
                ("heading", heading, std[2], 1, " degrees", self.told[2]),
            )
            if told
        ]
        untold = [name for name, told in zip(("x", "y", "heading"), self.told, strict=True) if not told]
        rest = f" (the motion does not determine {' and '.join(untold)}: 0 is assumed)" if untold else ""
        return (
            f"the scans agree best with the laser at {', '.join(parts)} on the robot{rest}; "
            f"to use it: --laser-offset {x:.3f} {y:.3f} {heading:.1f}"
        )


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
        The estimate; None where the motion or the scans do not tell anything.
    """
    pairs = _ScanPairs.choose(poses, stamps, source, options)
    return None if pairs is None else MountEstimator(pairs, options).run()


@dataclass(frozen=True)
class _ScanPairs:
    """Pairs of scans, and the robot's motion between them.

    Attributes:
        surfaces: The surfaces of the scans.
        scans: (P, 2) indices of the first and the second scan.
        steps: (P, 3) the robot's pose at the second scan relative to that at the first.
        later: (P, 3) the same where the poses' clock is late by ``timing_std``.
        travel: (P,) distance travelled in between (m), for the errors of the poses.
        blocks: (P, 2) the stretches of the path that the scans lie on.
    """

    surfaces: Surfaces
    scans: NDArray[np.int64]
    steps: FloatArray
    later: FloatArray
    travel: FloatArray
    blocks: NDArray[np.int64]

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
            np.minimum(travel[chosen] / travel[-1] * options.blocks, options.blocks - 1).astype(np.int64),
        )

    def predicted(self, mount: FloatArray, steps: FloatArray | None = None) -> FloatArray:
        """Return the laser's poses (P, 3) at the second scans relative to those at the first, by the robot's motion."""
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


def _wrapped(poses: FloatArray) -> FloatArray:
    """Return differences (N, 3) of poses with headings within half a turn."""
    return np.column_stack((poses[:, :2], wrap_angles(poses[:, 2])))


@dataclass(frozen=True)
class _Linearization:
    """The negative log-likelihood of the mount to second order, by pairs.

    Attributes:
        gradients: (P, 3).
        information: (P, 3, 3).
        by_relative: (P, 3, 3) derivatives of the gradients by the laser's relative poses.
    """

    gradients: FloatArray
    information: FloatArray
    by_relative: FloatArray


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
        """Estimate all components; while the motion does not tell one, fix it at 0 and estimate the others anew."""
        options = self._options
        limits = np.array([options.max_position_std, options.max_position_std, options.max_heading_std])
        free, std = np.ones(3, dtype=bool), np.zeros(3)
        while free.any():
            mount, covariance = self._estimate(free)
            std[free] = np.sqrt(np.diagonal(covariance))
            excess = np.where(free, std / limits, 0.0)
            if excess.max() <= 1:
                return MountEstimate(np.where(free, mount, 0.0), std, free)
            free[np.argmax(excess)] = False
        return None

    def _estimate(self, free: NDArray[np.bool_]) -> tuple[FloatArray, FloatArray]:
        """Return the mount (3,), with the components that are not free at 0, and the covariance of the free ones."""
        mount = self._search(free)
        relative, options = self._pairs.predicted(mount), self._options
        drift = options.drift_position_std**2, options.drift_heading_std**2
        std = options.first_std
        for step in range(options.steps):
            std = max(std * options.std_decay, options.final_std)
            mount, relative, drift, linear = self._refine(mount, relative, drift, std, free)
            if step < options.drift_from_step:
                drift = options.drift_position_std**2, options.drift_heading_std**2
        return mount, self._covariance(mount, linear, free)

    def _search(self, free: NDArray[np.bool_]) -> FloatArray:
        """Return the best mount (3,) of coarse registrations from several headings."""
        options = self._options
        thinned = self._pairs.surfaces.thinned(2)
        stride = max(1, -(-len(self._pairs.scans) // options.coarse_pairs))
        some = replace(self._pairs, surfaces=thinned, **{
            name: getattr(self._pairs, name)[::stride] for name in ("scans", "steps", "later", "travel", "blocks")
        })
        headings = np.arange(options.start_headings if free[2] else 1) * 2 * np.pi / options.start_headings
        found = [self._descend(some, np.array([0.0, 0.0, heading]), free) for heading in headings.tolist()]
        best = min(found, key=lambda result: result[1])
        mount = best[0] if best[1] < (1 - options.min_gain) * found[0][1] else found[0][0]
        return np.array([*mount[:2], wrap_angles(mount[2])])

    def _descend(self, pairs, mount, free):
        options = self._options
        for _ in range(options.coarse_steps):
            fit = register_pairs(pairs.surfaces, pairs.surfaces.in_laser_frame(mount), pairs.scans,
                pairs.predicted(mount), options.coarse_std, options.coarse_distance, options.registration)
            by_mount, _ = pairs.jacobians(mount)
            gradient = np.einsum("pai,pa->i", by_mount, fit.gradients)
            information = np.einsum("pai,pab,pbj->ij", by_mount, fit.information, by_mount)
            mount = mount + self._step(gradient, information, mount, free)
        return mount, float(fit.misfit.sum() / max(fit.points.sum(), 1.0))

    def _step(self, gradient, information, mount, free):
        """Return the step (3,) of Gauss and Newton that the free components take."""
        at = np.flatnonzero(free)
        matrix = (information + self._prior)[np.ix_(at, at)]
        away = np.array([*mount[:2], wrap_angles(mount[2])])
        solved = linear_algebra.solve(matrix, -(gradient + self._prior @ away)[at])
        step = np.zeros(3)
        if solved is not None:
            step[at] = solved
        return step

    def _refine(self, mount, relative, drift, std, free):
        options, pairs = self._options, self._pairs
        distance = max(options.distance_stds * std, options.min_distance)
        fit = register_pairs(pairs.surfaces, pairs.surfaces.in_laser_frame(mount), pairs.scans, relative, std, distance, options.registration)
        by_mount, by_step = pairs.jacobians(mount)
        covariances = by_step @ pairs.step_covariances(drift) @ by_step.transpose(0, 2, 1)
        off = _wrapped(pairs.predicted(mount) - relative)
        # with information L of the scans and covariance C of the motion: (I + L C)^-1 L is (L^-1 + C)^-1
        mixing = np.eye(3) + fit.information @ covariances
        inverse = np.linalg.inv(mixing)
        weights = inverse @ fit.information
        pull = np.einsum("pab,pb->pa", weights, off) + np.einsum("pab,pb->pa", inverse, fit.gradients)
        robust = self._pair_weights(pull, weights)
        linear = _Linearization(
            robust[:, None] * np.einsum("pai,pa->pi", by_mount, pull),
            robust[:, None, None] * (by_mount.transpose(0, 2, 1) @ weights @ by_mount),
            robust[:, None, None] * (by_mount.transpose(0, 2, 1) @ weights),
        )
        mount = mount + self._step(linear.gradients.sum(axis=0), linear.information.sum(axis=0), mount, free)
        off = _wrapped(pairs.predicted(mount) - relative)
        moved = off - np.einsum("pab,pb->pa", covariances, fit.gradients)
        relative = relative + np.einsum("pba,pb->pa", inverse, moved)
        posterior = covariances @ inverse
        errors = _wrapped(relative - pairs.predicted(mount))
        return mount, relative, self._drift(errors, posterior, by_step, robust), linear

    def _pair_weights(self, pull, weights):
        """Return the robust weights (P,) of pairs, by the squared Mahalanobis distances of their residuals."""
        # pull is W d for a residual d: d^T W d = pull^T W^-1 pull; W is singular where a pair's scans do not tell
        # all of Z, and the directions that they do not tell have no pull
        ridge = np.eye(3)*1e-3
        distance = np.einsum("pa,pa->p", pull, np.linalg.solve(weights + ridge, pull[..., None])[..., 0])
        usual = max(float(np.median(distance)), np.finfo(float).tiny)
        return (1 + distance / (usual * self._options.pair_robustness**2)) ** -2

    def _drift(self, errors, posterior, by_step, robust):
        """Return the variances (m^2, rad^2) of the steps' errors after one metre: the M step of EM."""
        back = np.linalg.inv(by_step)
        errors = np.einsum("pab,pb->pa", back, errors)
        posterior = back @ posterior @ back.transpose(0, 2, 1)
        # the error of position less the mean effect of that of heading
        split = np.zeros((len(errors), 3, 3))
        split[:] = np.eye(3)
        split[:, :2, 2] = -self._pairs.across / 2
        errors = np.einsum("pab,pb->pa", split, errors)
        squares = errors**2 + np.diagonal(split @ posterior @ split.transpose(0, 2, 1), axis1=1, axis2=2)
        x, y, theta = (robust[:, None] * squares / self._pairs.travel[:, None]).sum(axis=0) / robust.sum()
        least = self._options.min_drift_variance
        return max((x + y) / 2, least), max(theta, least)

    def _covariance(self, mount, linear, free):
        at = np.flatnonzero(free)
        options, pairs = self._options, self._pairs
        gradient, information = linear.gradients[:, at], linear.information[:, at][:, :, at]
        prior = self._prior[np.ix_(at, at)]
        model = np.linalg.inv(information.sum(axis=0) + prior)
        replicates = []
        for block in range(options.blocks):
            kept = (pairs.blocks[:, 1] < block) | (pairs.blocks[:, 0] > block)
            if not kept.all():
                replicates.append(-np.linalg.solve(information[kept].sum(axis=0) + prior, gradient[kept].sum(axis=0)))
        count = len(replicates)
        off = np.array(replicates) - np.mean(replicates, axis=0)
        jackknife = (count - 1) / count * off.T @ off
        late = _wrapped(pairs.predicted(mount, pairs.later) - pairs.predicted(mount))
        shift = model @ np.einsum("pia,pa->i", linear.by_relative, late)[at]
        floor = np.diag(np.array([options.position_floor, options.position_floor, options.heading_floor])[at] ** 2)
        self.parts = tuple(np.sqrt(np.diagonal(m)) for m in (jackknife, model, np.outer(shift, shift)))
        return jackknife + model + np.outer(shift, shift) + floor
