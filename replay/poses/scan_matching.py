"""Poses corrected by the map: each scan is matched with a forward map of the scans, and all poses are smoothed anew.

Poses that drift are first corrected scan by scan, as the map grows: a few scoring steps each, from where the
odometry predicts. Then in rounds: a map of all scans, each scan's log-likelihood of its pose in it (the map contains
the scan itself), and a smoother over all poses, odometry, fixes and headings. The log-likelihood is that of the
scan's rays under the forward sensor model.

Where a pose's uncertainty is needed as one length, its heading counts at a lever arm of 1 m: the length is the square
root of var x + var y + (1 m)^2 var theta.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from mapping.forward.mapper import ForwardMapper
from mapping.forward.options import ForwardOptions
from mapping.forward.scan_likelihood import ScanLikelihood, ScanRays, maximize_pose
from prim import linear_algebra
from prim.arrays import FloatArray, Stamps
from prim.scan import PosedScan, Scan
from prim.se2 import (
    Pose2D,
    Trajectory,
    compose_covariances,
    compose_poses,
    frame_covariances,
    frame_motions,
    inverse_poses,
    relative_poses,
    relative_steps,
    wrap_angles,
)
from prim.world import Bounds
from replay.poses.fusion import Fusion
from replay.poses.fusion_nodes import FusionNodes
from replay.poses.fusion_options import SensorNoise
from replay.poses.kalman import POSE, FilterState, QuadraticTerms
from replay.poses.laser_poses import LaserPoses, PosedScanSource


@dataclass(frozen=True)
class ScanMatchingOptions:
    """The numbers of scan matching; set by hand."""

    max_rays: int = 180
    """At most so many rays of a scan are matched, evenly spread."""

    map_cells: int = 1_000_000
    """The growing map has cells of twice the resolution, or larger ones where it would have more cells than this."""

    max_rounds: int = 12
    """At most so many maps are made of all scans once they are complete. Those that are made while scans are added
    (see ``first_rematch``), one each time, are extra."""

    damping_position_std: float = 0.1
    """Standard deviation (m) of the Gaussian prior around the current position in one round, which damps the steps of
    the maximisation. It is no bound, and no part of the information that enters the smoother."""

    damping_heading_std: float = math.radians(2)
    """Standard deviation (rad) of that prior around the current heading."""

    max_noise_scale: float = 8.0
    """Annealing, from coarse to fine: the range noise is first multiplied by a factor of at most this, which is then
    halved again and again, down to 1."""

    annealing_deviations: float = 2.5
    """The range noise is first enlarged to so many standard deviations of the pose, so that the scan can be matched
    from there."""

    first_rematch: int = 4
    """All scans so far are matched anew when they are so many, and each time that their number has doubled."""

    min_gain: float = 3e-3
    """The rounds end when one raises the mean log-likelihood of a ray by less (nats)."""

    inflation_rate: float = 0.3
    """The odometry's variances are multiplied by this power of each scan's normalised correction."""

    max_inflation: float = 1e4
    """The odometry's variances are multiplied by at most this factor."""

    free_step_factor: float = 10.0
    """The steps between poses that do not drift enter as those of an odometry that has so many times the poses'
    standard deviations: little information."""

    min_rays: int = 10
    """Scans with fewer rays on the map are not matched."""

    @property
    def damping_information(self) -> FloatArray:
        """The information (3, 3) of the prior that damps the change of a pose in one round."""
        return np.diag([self.damping_position_std**-2, self.damping_position_std**-2, self.damping_heading_std**-2])


DEFAULTS = ScanMatchingOptions()


def match_scans(
    poses: LaserPoses,
    stamps: Stamps,
    source: PosedScanSource,
    resolution: float,
    noise_std: float | None = None,
    noise: SensorNoise | None = None,
    bounds: Bounds | None = None,
    options: ScanMatchingOptions = DEFAULTS,
) -> LaserPoses:
    """Correct poses by a map that is made of the scans themselves.

    Args:
        poses: The laser's poses at N scans. Those that were not fused are taken for odometry; or, where ``noise``
            has standard deviations of positions and headings, for poses that do not drift and have these errors.
        stamps: The scans' stamps (N,) in ns.
        source: Yields the scans with the poses that it is given.
        resolution: The size of the map's cells (m).
        noise_std: The range noise (m); None: estimated from the scans.
        noise: The noise of poses that were not fused, as far as it is known.
        bounds: The map's bounds; None: it grows with the scans.
        options: Rays, rounds and tolerances.

    Returns:
        The corrected poses with their covariances.
    """
    return ScanMatcher(poses, stamps, source, resolution, noise_std, noise, bounds, options).run()


_State = tuple[FloatArray, FloatArray, FloatArray | None]
"""Poses and covariances at the nodes, and the covariance of the map's frame."""


class ScanMatcher:
    """The implementation and state of :func:`match_scans`, and with its arguments.

    The state is a pose at each node of a fusion: the robot's where the mounts are given, as those of fused poses
    and of several lasers are; else the laser's own, and the mounts are zero.
    """

    def __init__(
        self,
        poses: LaserPoses,
        stamps: Stamps,
        source: PosedScanSource,
        resolution: float,
        noise_std: float | None,
        noise: SensorNoise | None,
        bounds: Bounds | None,
        options: ScanMatchingOptions,
    ) -> None:
        self._poses, self._source, self._options = poses, source, options
        self._resolution, self._noise_std, self._bounds = resolution, noise_std, bounds
        self._fusion = poses.fusion or _fusion_of(poses, stamps, noise or SensorNoise(), options)
        has_fixes, has_headings = self._fusion.nodes.has_fix.any(), self._fusion.nodes.has_heading.any()
        self._drifts = not has_fixes
        # where no sensor is absolute, the first pose is known, and the map, made of all scans, is somewhere near
        self._floats = not has_fixes and not has_headings
        self._mounts = np.zeros_like(poses.poses) if poses.mounts is None else poses.mounts
        nodes = self._fusion.nodes.stamps
        self._node_of_scan = np.searchsorted(nodes, np.clip(stamps, nodes[0], nodes[-1]))
        estimate = self._fusion.smoothed()
        self._node_poses, self._covariances = estimate.poses, estimate.covariances
        self._frame_covariance = poses.frame_covariance
        if self._frame_covariance is None and has_fixes:
            self._frame_covariance = estimate.frame_covariance(stamps)
        self._rays: dict[int, ScanRays] = {}
        self._scans: list[PosedScan] = []
        self._inflation = 1.0

    def run(self) -> LaserPoses:
        """Match all scans; return the corrected poses."""
        rounds = self._options.max_rounds
        if self._drifts:
            self._match_incrementally()
            self._match_in_rounds(rounds)
        else:
            for posed in self._source(self._poses):
                self._add(posed)
            # m^2: the variance of the heading at a lever arm of 1 m
            variance = float(np.trace(self._covariances, axis1=1, axis2=2).mean())
            self._match_in_rounds(rounds, self._options.annealing_deviations * math.sqrt(variance))
        return self._corrected()

    def _match_incrementally(self) -> None:
        """Match each scan with the map of those before it, and all of them anew whenever their number has doubled."""
        mapper = self._new_mapper()
        state = self._fusion.initial_state
        last, due = -1, self._options.first_rematch
        for posed in sorted(self._source(self._poses), key=lambda posed: int(self._node_of_scan[posed.position])):
            node, mount = int(self._node_of_scan[posed.position]), self._mounts[posed.position]
            if node > last:
                state = self._fusion.advance(last + 1, node + 1, state, self._inflation)
                last = node
            rays = self._add(posed)
            streaming = mapper.streaming_map()
            if streaming is not None:
                state = self._match_one(ScanLikelihood.of(*streaming), rays, mount, state)
            self._node_poses[node] = state.mean[:POSE]
            for scan, pose in reposed(posed, self._laser_pose(posed.position)):
                mapper.update(scan, pose)
            if len(self._scans) == due:
                self._match_in_rounds(1, count=last + 1)
                mapper = self._mapper_of_scans()
                mapper.refit_streaming_map()
                state = self._fusion.belief(self._node_poses[last], self._covariances[last])
                due *= 2

    def _add(self, posed: PosedScan) -> ScanRays:
        """Store a scan, and return some of its rays to be matched."""
        rays = ScanRays.from_pieces(posed.pieces, posed.pose, self._options.max_rays, posed.position)
        self._rays[posed.position] = rays
        self._scans.append(posed)
        return rays

    def _match_in_rounds(self, max_rounds: int, pose_error: float = 0.0, count: int | None = None) -> None:
        """Alternate between a map of the scans so far and poses by this map, until the scans fit no better.

        Args:
            max_rounds: The number of rounds at most.
            pose_error: How far poses may be off at first (m): the range noise is enlarged to that, and then annealed.
            count: The number of nodes that the scans so far belong to; None: all.
        """
        best, noise_scale = -math.inf, 0.0
        before: _State | None = None  # that of the round before, smoothed by a map of all
        for number in range(max_rounds):
            fit = self._mapper_of_scans().fit()
            likelihood = ScanLikelihood.of(fit, fit.noise)
            noise_scale = noise_scale or self._first_noise_scale(pose_error, likelihood)
            mean, terms = self._match_all(likelihood, noise_scale)
            if before is not None and noise_scale == 1.0:
                if mean < best:
                    self._node_poses, self._covariances, self._frame_covariance = before
                if mean - best < self._options.min_gain:
                    break
                best = mean
            noise_scale = max(noise_scale / 2, 1.0)
            before = self._state() if number else None
            self._smooth(terms, count)

    def _state(self) -> _State:
        """Return copies of the estimates."""
        return self._node_poses.copy(), self._covariances.copy(), self._frame_covariance

    def _smooth(self, terms: QuadraticTerms, count: int | None) -> None:
        """Smooth the poses of the first ``count`` nodes with the scans' log-likelihoods."""
        estimate = self._fusion.smoothed(terms, self._inflation, count, self._floats)
        if self._floats:
            self._frame_covariance = frame_motions(estimate.covariances[:1], estimate.poses[:1])[0]
            estimate = estimate.seen_from_first(self._fusion.initial_state)
        self._node_poses[:count] = estimate.poses
        self._covariances[:count] = estimate.covariances
        self._inflation = max(self._inflation, self._step_inflation(count))

    def _step_inflation(self, count: int | None) -> float:
        """Return the mean squared correction of the odometry's steps, relative to their variances."""
        nodes = self._fusion.nodes.subrange(0, count)
        if len(nodes.steps) < 2:
            return 1.0
        corrections = relative_steps(self._node_poses[:count])[1:] - nodes.steps[1:]
        corrections[:, 2] = wrap_angles(corrections[:, 2])
        variances = self._fusion.step_variances(nodes)[1:]
        return min(float((corrections**2 / variances).mean()), self._options.max_inflation)

    def _new_mapper(self) -> ForwardMapper:
        options = ForwardOptions(streaming_cells=self._options.map_cells)
        return ForwardMapper(self._resolution, self._bounds, self._noise_std, options=options)

    def _mapper_of_scans(self) -> ForwardMapper:
        """Return a mapper that was given the scans so far at the current estimates of their poses."""
        mapper = self._new_mapper()
        for posed in self._scans:
            for scan, pose in reposed(posed, self._laser_pose(posed.position)):
                mapper.accumulate(scan, pose)
        return mapper

    def _laser_pose(self, position: int) -> Pose2D:
        """Return the current estimate of the laser's pose at a scan."""
        return Pose2D(*self._node_poses[self._node_of_scan[position]].tolist()) @ Pose2D(
            *self._mounts[position].tolist()
        )

    def _match_one(
        self, likelihood: ScanLikelihood, rays: ScanRays, mount: FloatArray, prior: FilterState
    ) -> FilterState:
        """Return the maximum a posteriori pose by the prior and one scan, by annealing, and its covariance.

        The prior itself where too few rays are on the map, or a covariance is singular.
        """
        options, expected, spread = self._options, prior.mean[:POSE], prior.covariance[:POSE, :POSE]
        prior_information = linear_algebra.inverse(spread)
        if prior_information is None:
            return prior
        pose = expected.copy()
        deviation = math.sqrt(np.trace(spread))  # m: the heading's at a lever arm of 1 m
        noise_scale = self._first_noise_scale(options.annealing_deviations * deviation, likelihood)
        while True:
            pose, derivatives = maximize_pose(likelihood, rays, mount, pose, expected, prior_information, noise_scale)
            if noise_scale <= 1:
                break
            noise_scale = max(noise_scale / 2, 1.0)
        if derivatives.rays < options.min_rays:
            return prior
        covariance = linear_algebra.inverse(prior_information + derivatives.information)
        if covariance is None:
            return prior
        change = pose - expected
        # posterior mean of the squared Mahalanobis distance from the prior, per coordinate: 1 in expectation where
        # the prior's covariance is right
        normalized_correction = (
            float(change @ prior_information @ change + np.trace(prior_information @ covariance)) / 3
        )
        inflation = self._inflation * normalized_correction**options.inflation_rate
        self._inflation = min(max(inflation, 1.0), options.max_inflation)
        return prior.with_pose(pose, covariance)

    def _first_noise_scale(self, pose_error: float, likelihood: ScanLikelihood) -> float:
        """Return the factor of the range noise with which annealing begins for poses that are off by so much (m)."""
        return min(max(pose_error / likelihood.noise.std, 1.0), self._options.max_noise_scale)

    def _match_all(self, likelihood: ScanLikelihood, noise_scale: float) -> tuple[float, QuadraticTerms]:
        """Match each scan from its current pose.

        Returns the mean log-likelihood of a ray at the current poses (nats), and the quadratic approximations at the
        poses that the scans match best at; the range noise is multiplied by ``noise_scale`` for both.
        """
        count = len(self._node_poses)
        terms = QuadraticTerms.zeros(count)
        damping = self._options.damping_information
        total, ray_count = 0.0, 0
        for posed in self._scans:
            node, mount = self._node_of_scan[posed.position], self._mounts[posed.position]
            rays, pose = self._rays[posed.position], self._node_poses[node]
            total += likelihood.log_likelihood(rays, pose, mount, noise_scale)
            ray_count += len(rays.rays)
            best, derivatives = maximize_pose(likelihood, rays, mount, pose, pose, damping, noise_scale)
            if derivatives.rays >= self._options.min_rays:
                # the terms of another scan at this node have another center: their gradient is moved to this one
                change = best - terms.centers[node]
                terms.gradients[node] += derivatives.gradient - terms.information[node] @ change
                terms.information[node] += derivatives.information
                terms.centers[node] = best
        return total / max(ray_count, 1), terms

    def _corrected(self) -> LaserPoses:
        """Return the laser's poses; their covariances are the smoother's, plus that of the map frame's own pose."""
        carriers = self._node_poses[self._node_of_scan]
        carrier_covariances = self._covariances[self._node_of_scan]
        poses = compose_poses(carriers, self._mounts)
        covariances = compose_covariances(carrier_covariances, carriers, self._mounts)
        # the variance of a surface's place within its cell, which the map does not resolve
        covariances[:, [0, 1], [0, 1]] += self._resolution**2 / 12
        if self._frame_covariance is not None and not self._floats:
            covariances = covariances + frame_covariances(self._frame_covariance, poses)
        return replace(
            self._poses,
            poses=poses,
            end_poses=self._end_poses(poses),
            covariances=covariances,
            frame_covariance=self._frame_covariance,
            matched=True,
        )

    def _end_poses(self, poses: FloatArray) -> FloatArray | None:
        """Return the poses at the last beams, with the motion since the first ones unchanged."""
        if self._poses.end_poses is None:
            return None
        return compose_poses(poses, relative_poses(self._poses.poses, self._poses.end_poses))


def reposed(posed: PosedScan, pose: Pose2D) -> Iterator[tuple[Scan, Pose2D]]:
    """Move a scan's pieces to another pose.

    Args:
        posed: The scan.
        pose: The laser's pose at the first beam.

    Yields:
        Each piece with its pose, unchanged relative to the first beam.
    """
    back = Pose2D(posed.pose.x, posed.pose.y, posed.pose.theta).inverse()
    for scan, at in posed.pieces:
        yield scan, pose @ (back @ Pose2D(at.x, at.y, at.theta))


def _fusion_of(poses: LaserPoses, stamps: Stamps, noise: SensorNoise, options: ScanMatchingOptions) -> Fusion:
    """Return a fusion of poses that were not fused.

    They are the steps of an odometry. Where their noise is known, they are fixes and headings instead, and the steps
    between them are those of an odometry that has ``free_step_factor`` times their standard deviations each.
    """
    carriers = poses.poses if poses.mounts is None else compose_poses(poses.poses, inverse_poses(poses.mounts))
    trajectory = Trajectory.from_unsorted(stamps[poses.valid], carriers[poses.valid])
    position_std, heading_std = noise.position_std, noise.heading_std
    if position_std is None or heading_std is None:
        return Fusion(FusionNodes.from_readings(trajectory.stamps, trajectory, None, None), noise)
    fixes, headings = (trajectory.stamps, trajectory.poses[:, :2]), (trajectory.stamps, trajectory.poses[:, 2])
    nodes = FusionNodes.from_readings(trajectory.stamps, trajectory, fixes, headings)
    steps = options.free_step_factor * position_std, options.free_step_factor * heading_std
    return Fusion(
        replace(nodes, variance_scales=np.ones(len(trajectory))), SensorNoise(position_std, heading_std, *steps, 0.0)
    )
