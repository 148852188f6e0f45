"""The forward sensor model as a likelihood of poses: how well a scan fits a map, and the pose where it fits best.

log p(scan | pose, map) is the sum of the rays' log-densities under the model of :mod:`mapping.forward.likelihood`.
Its gradient g is taken by central differences, and the information matrix from the outer products of the n single
rays' gradients (Berndt, Hall, Hall and Hausman 1974), centred: g g^T / n is subtracted from their sum. The maximum is
found by scoring steps with this matrix.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from mapping.forward.incidence import directional_stopping
from mapping.forward.level import Level, RangeNoise, geometry_fields, sensor_fields
from mapping.forward.likelihood import RayModel, pose_likelihood
from mapping.forward.mapper import ForwardFit
from mapping.forward.options import DEFAULTS
from mapping.grid import GridFrame
from prim import linear_algebra
from prim.arrays import FloatArray
from prim.scan import Scan
from prim.se2 import Pose2D, rotate


@dataclass(frozen=True, slots=True)
class ScanLikelihoodOptions:
    """Options of the likelihood of poses and of its maximisation; all set by hand."""

    difference_cells: float = 0.5
    """Half-width (cells) of the central differences, or ``difference_noise`` times the noise where that is larger."""

    difference_noise: float = 0.2
    """Half-width of the central differences as a share of the noise's standard deviation."""

    rotation_scale: float = 1.0
    """Length scale of rotations (m): the difference of heading displaces what is this far away as far as the
    differences of position do."""

    min_noise_cells: float = 0.5
    """The noise counts as this many cells at least: where in a cell a surface lies is unknown."""

    max_steps: int = 4
    """Largest number of scoring steps."""

    max_extension: int = 8
    """A step is lengthened up to this many times, while the posterior rises."""

    min_translation: float = 2e-4
    """A step that moves by less than this (m) and turns by less than ``min_rotation`` counts as none."""

    min_rotation: float = 1e-4
    """See ``min_translation`` (rad)."""


POSE_DEFAULTS = ScanLikelihoodOptions()


@dataclass(frozen=True)
class ScanRays:
    """A scan's measurements in the frame of its laser.

    Attributes:
        rays: (N, 5): where each beam starts (x, y), its direction, its range (m; -inf: nearer than range_min, inf: no
            return).
        limits: range_min and range_max (m).
    """

    rays: FloatArray
    limits: tuple[float, float]

    @classmethod
    def from_pieces(
        cls, pieces: Sequence[tuple[Scan, Pose2D]], pose: Pose2D, max_rays: int, offset: int = 0
    ) -> ScanRays:
        """Collect a scan's measurements, see :meth:`prim.scan.Scan.censored_ranges`.

        Args:
            pieces: The scan in pieces, with the laser's pose at each.
            pose: The laser's pose that the rays are given in.
            max_rays: Largest number of rays; they are evenly spaced.
            offset: Index of the first one, modulo the spacing.

        Returns:
            The rays.
        """
        first = pieces[0][0]
        inverse = pose.inverse()
        parts = []
        for scan, piece_pose in pieces:
            relative = inverse @ Pose2D(piece_pose.x, piece_pose.y, piece_pose.theta)
            used, ranges = scan.censored_ranges()
            rays = np.empty((int(np.count_nonzero(used)), 5))
            rays[:, :2] = relative.x, relative.y
            rays[:, 2:4] = rotate(scan.directions[used], relative.theta)
            rays[:, 4] = ranges
            parts.append(rays)
        every = np.concatenate(parts)
        stride = max(1, -(-len(every) // max_rays))
        limits = float(max(first.range_min, 0.0)), float(min(first.range_max, DEFAULTS.max_range))
        return cls(np.ascontiguousarray(every[offset % stride :: stride]), limits)


@dataclass(frozen=True)
class PoseDerivatives:
    """The likelihood of a pose and its derivatives.

    Attributes:
        log_likelihood: Log-likelihood of the scan (nats).
        gradient: Gradient of the log-likelihood (3,) with respect to x, y (m), heading (rad).
        information: Estimate of the Fisher information about the pose (3, 3), by the centred outer products.
        rays: Number of rays that cross the map.
    """

    log_likelihood: float
    gradient: FloatArray
    information: FloatArray
    rays: int


@dataclass(frozen=True)
class ScanLikelihood:
    """The likelihood of scans under a map of stopping probabilities.

    Attributes:
        frame: Where the map's cells lie.
        stopping: Stopping probabilities (directions, rows, cols) float32, of rays about the angles k pi / directions.
        noise: The range noise.
        ray_model: The sensor model's parameters that are not estimated.
        options: The likelihood's options.
    """

    frame: GridFrame
    stopping: NDArray[np.float32]
    noise: RangeNoise
    ray_model: RayModel = DEFAULTS.ray_model
    options: ScanLikelihoodOptions = POSE_DEFAULTS

    @classmethod
    def of(
        cls,
        level: Level | ForwardFit,
        noise: RangeNoise,
        options: ScanLikelihoodOptions = POSE_DEFAULTS,
        by_incidence: bool = False,
    ) -> ScanLikelihood:
        """Return the likelihood under a level's or a fit's map.

        Args:
            level: The map.
            noise: The range noise; bounded by ``min_noise_cells``.
            options: The likelihood's options.
            by_incidence: Whether rays that graze surfaces stop no sooner than others (see mapping.forward.incidence).

        Returns:
            The likelihood.
        """
        stopping = directional_stopping(level.stopping) if by_incidence else level.stopping[None]
        std = max(noise.std, options.min_noise_cells * level.frame.resolution)
        return cls(level.frame, stopping, noise._replace(std=std), options=options)

    def derivatives(
        self, scan: ScanRays, pose: FloatArray, mount: FloatArray, noise_scale: float = 1.0
    ) -> PoseDerivatives:
        """Compute the log-likelihood of a pose, its gradient and its information.

        Args:
            scan: The scan.
            pose: The robot's pose (3,).
            mount: The laser's pose (3,) in the robot's frame.
            noise_scale: The noise's standard deviation is multiplied by this.

        Returns:
            The likelihood and its derivatives.
        """
        std, options = self.noise.std * noise_scale, self.options
        step = max(options.difference_cells * self.frame.resolution, options.difference_noise * std)
        return self._evaluate(scan, pose, mount, std, np.array([step, step, step / options.rotation_scale]))

    def log_likelihood(self, scan: ScanRays, pose: FloatArray, mount: FloatArray, noise_scale: float = 1.0) -> float:
        """Compute the log-likelihood of a pose alone.

        Args:
            scan: The scan.
            pose: The robot's pose (3,).
            mount: The laser's pose (3,) in the robot's frame.
            noise_scale: The noise's standard deviation is multiplied by this.

        Returns:
            The log-likelihood (nats).
        """
        return self._evaluate(scan, pose, mount, self.noise.std * noise_scale, np.zeros(3)).log_likelihood

    def _evaluate(
        self, scan: ScanRays, pose: FloatArray, mount: FloatArray, std: float, steps: FloatArray
    ) -> PoseDerivatives:
        result = np.empty(11)
        sensor = sensor_fields(self.noise._replace(std=std), self.ray_model)
        geometry, placement = geometry_fields(self.frame), (pose, mount, steps)
        pose_likelihood(scan.rays, scan.limits, placement, geometry, self.stopping, sensor, result)
        gradient, rays = result[1:4], int(result[10])
        information = result[[4, 5, 6, 5, 7, 8, 6, 8, 9]].reshape(3, 3) - np.outer(gradient, gradient) / max(rays, 1)
        return PoseDerivatives(float(result[0]), gradient, information, rays)


def maximize_pose(
    likelihood: ScanLikelihood,
    scan: ScanRays,
    mount: FloatArray,
    pose: FloatArray,
    prior: FloatArray,
    prior_information: FloatArray,
    noise_scale: float = 1.0,
) -> tuple[FloatArray, PoseDerivatives]:
    """Maximise the posterior of a pose by a few scoring steps (Berndt, Hall, Hall and Hausman 1974).

    Far from the maximum the outer products overestimate the information: a step is lengthened while the posterior
    rises, and halved until it does. None is taken where the information is singular.

    Args:
        likelihood: The likelihood under a map.
        scan: The scan.
        mount: The laser's pose (3,) in the robot's frame.
        pose: The robot's pose (3,) to start from.
        prior: Mean of the pose's Gaussian prior (3,).
        prior_information: Information of the prior (3, 3).
        noise_scale: The noise's standard deviation is multiplied by this.

    Returns:
        The pose (3,), and the likelihood there.
    """
    options = likelihood.options

    def log_posterior(at: FloatArray, log_likelihood: float) -> float:
        return float(log_likelihood - (at - prior) @ prior_information @ (at - prior) / 2)

    def after(step: FloatArray) -> float:
        return log_posterior(pose + step, likelihood.log_likelihood(scan, pose + step, mount, noise_scale))

    current = likelihood.derivatives(scan, pose, mount, noise_scale)
    for _ in range(options.max_steps):
        height = log_posterior(pose, current.log_likelihood)
        gradient = current.gradient - prior_information @ (pose - prior)
        step = linear_algebra.solve(current.information + prior_information, gradient)
        if step is None:  # nothing says where to
            break
        reached, length = after(step), 1
        while reached > height and length < options.max_extension and (further := after(2 * step)) > reached:
            step, reached, length = 2 * step, further, 2 * length
        while reached <= height and not is_negligible(step, options):
            step = step / 2
            reached = after(step)
        if reached <= height or is_negligible(step, options):
            break
        pose = pose + step
        current = likelihood.derivatives(scan, pose, mount, noise_scale)
    return pose, current


def is_negligible(step: FloatArray, options: ScanLikelihoodOptions = POSE_DEFAULTS) -> bool:
    """Return whether a step is too short to count.

    Args:
        step: The step (3,).
        options: The limits.

    Returns:
        Whether both its translation and its rotation are below them.
    """
    return bool(np.abs(step[:2]).max() < options.min_translation and abs(step[2]) < options.min_rotation)
