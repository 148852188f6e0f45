"""Lower bounds on the error of any estimate of a primitive's parameters from a session's rays.

Where a ray changes from hit to miss the likelihood is discontinuous in the parameters, and the Cramér-Rao bound is
not defined. Two others are, for steps h_j of the parameters p and r(p) the exact ranges of all rays:

- Chapman and Robbins (1951): with Δ_j = r(p + h_j e_j) - r(p) and M_ij = exp(Δ_i·Δ_j / σ²) - 1, no estimator that is
  unbiased at p and at p + h_j e_j has a smaller standard deviation than h_j √((M⁻¹)_jj). The largest over all steps
  is taken. Steps so small that no ray changes from hit to miss ignore the information in the silhouettes. An
  estimator that uses it is biased over distances shorter than those between rays, so that its error may lie far below
  this bound where silhouettes hold most of the information.
- Weiss and Weinstein (1985, s = 1/2): bounds the mean squared error of any estimator, over parameters near p. With
  u(a, b) the mean over p of exp(-|r(a) - r(b)|² / 8σ²), G_ij = 2 [u(p + h_i, p + h_j) - u(p + h_i, p - h_j)] /
  [u(p + h_i, p) u(p + h_j, p)], and the bound is h_j √((G⁻¹)_jj), again the largest over the steps.

Censored ranges count as measured ones here, so that both bounds are a little low where the noise is large.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from detect.refinement.likelihood.geometry import JACOBIANS, parameters_of, ranges_to, shape_ranges
from detect.refinement.likelihood.rays import RayBundle, collect_rays
from prim.arrays import FloatArray
from prim.raycast import cast_segments
from prim.scan import Scan
from prim.se2 import Pose2D
from prim.shapes import Primitive

STEPS = (2e-5, 5e-5, 1e-4, 2e-4, 5e-4, 1e-3, 2e-3, 5e-3, 1e-2)
"""Steps of lengths (m); steps of angles are ten times as many radians."""

REACH = 0.03
"""Rays that pass a primitive at this distance (m) count."""

MAX_EXPONENT = 600.0
"""Larger exponents in the matrix of Chapman and Robbins would overflow: such steps are left out."""

MIN_OVERLAP = 1e-6
"""Steps with a smaller mean overlap u(p + h_j, p) are left out of the bound of Weiss and Weinstein."""

MAX_CONDITION = 1e12
"""Matrices with a larger condition number count as singular."""

PRIOR_WIDTH, PRIOR_SAMPLES = 0.001, 8
"""Half the width of the uniform prior (m; ten times as many radians), and the samples, of the second bound's mean."""

NORMAL_MEDIAN = 0.674
"""The median of |x| for a standard normal x."""


@dataclass(frozen=True)
class Limits:
    """Lower bounds on standard deviations (K,) of one primitive's parameters, in m and rad.

    Attributes:
        chapman_robbins: For unbiased estimators, in the order of Kind.parameters.
        weiss_weinstein: For any estimator.
    """

    chapman_robbins: FloatArray
    weiss_weinstein: FloatArray


def bounds(
    scans: Sequence[tuple[Scan, Pose2D]],
    primitives: Sequence[Primitive],
    walls: FloatArray,
    noise_std: float,
) -> list[Limits]:
    """Compute the bounds for each primitive.

    Args:
        scans: The session's scans with the laser's poses.
        primitives: All true primitives.
        walls: Walls (M, 4): x and y (m) of both ends.
        noise_std: Standard deviation of the range noise (m).

    Returns:
        The bounds, in the order of the primitives.
    """
    bundles, _, _ = collect_rays(scans, primitives, REACH)
    limits = []
    for k, (primitive, bundle) in enumerate(zip(primitives, bundles, strict=True)):
        near = bundle.select(bundle.passing(primitive, REACH))
        others = [*primitives[:k], *primitives[k + 1 :]]
        background = np.minimum(_ranges_to_nearest(near, others), _ranges_to_walls(near, walls))
        scene = Scene(primitive, near, background, noise_std)
        limits.append(Limits(chapman_robbins(scene), weiss_weinstein(scene)))
    return limits


def _ranges_to_nearest(bundle: RayBundle, others: Sequence[Primitive]) -> FloatArray:
    """Return the ranges (N,) in m to the nearest of other primitives; inf where a ray meets none."""
    nearest = np.full(len(bundle), np.inf)
    for other in others:
        np.minimum(nearest, ranges_to(other, bundle.rays), out=nearest)
    return nearest


def _ranges_to_walls(bundle: RayBundle, walls: FloatArray) -> FloatArray:
    """Return the ranges (N,) in m to the walls, at most range_max."""
    distance = bundle.max_range.copy()
    origins, scan = np.unique(bundle.rays[:2], axis=1, return_inverse=True)
    for number, origin in enumerate(origins.T.tolist()):
        own = np.flatnonzero(scan.ravel() == number)
        cast = cast_segments((origin[0], origin[1]), bundle.rays[2:4, own].T, walls)
        distance[own] = np.minimum(distance[own], cast)
    return distance


@dataclass(frozen=True)
class Scene:
    """A primitive and the rays that pass it.

    Attributes:
        primitive: The primitive.
        bundle: N rays that pass it.
        background: Ranges (N,) in m that they would have without it.
        noise_std: Standard deviation of the range noise (m).
    """

    primitive: Primitive
    bundle: RayBundle
    background: FloatArray
    noise_std: float

    @property
    def tie(self) -> FloatArray:
        """The matrix (5, K) from the kind's own parameters to all five: JACOBIANS of likelihood.geometry."""
        return JACOBIANS[self.primitive.kind]

    def ranges(self, at: FloatArray) -> FloatArray:
        """Return the exact ranges (N,) in m for the parameters ``at`` (5,) of the primitive."""
        return np.minimum(shape_ranges(self.primitive.kind, at, self.bundle.rays), self.background)

    def steps(self, step: float) -> FloatArray:
        """Return a step of each of the kind's own parameters as steps (K, 5) of all five."""
        return np.asarray(self.tie.T * np.where(self.tie[2] != 0, 10.0 * step, step)[:, None])


def chapman_robbins(scene: Scene) -> FloatArray:
    """Compute the bound (K,) of Chapman and Robbins."""
    p = parameters_of(scene.primitive)
    here = scene.ranges(p)
    best = np.zeros(scene.tie.shape[1])
    for step in (sign * size for size in STEPS for sign in (-1.0, 1.0)):
        moves = scene.steps(step)
        moved = np.stack([scene.ranges(p + move) - here for move in moves])
        exponent = moved @ moved.T / scene.noise_std**2
        if np.diag(exponent).max() < MAX_EXPONENT:
            best = np.maximum(best, _root(np.expm1(exponent), moves))
    return best


def weiss_weinstein(scene: Scene) -> FloatArray:
    """Compute the bound (K,) of Weiss and Weinstein, over parameters within PRIOR_WIDTH of the true ones."""
    rng = np.random.default_rng(0)
    size = scene.tie.shape[1]
    offsets = rng.uniform(-PRIOR_WIDTH, PRIOR_WIDTH, (PRIOR_SAMPLES, size))
    samples = parameters_of(scene.primitive) + offsets @ scene.steps(1.0)
    best = np.zeros(size)
    for step in STEPS:
        moves = scene.steps(step)
        same, opposite, center = np.zeros((size, size)), np.zeros((size, size)), np.zeros(size)
        for p in samples:
            here = scene.ranges(p)
            ahead = np.stack([scene.ranges(p + move) for move in moves])
            back = np.stack([scene.ranges(p - move) for move in moves])
            same += _overlap(ahead, ahead, scene.noise_std)
            opposite += _overlap(ahead, back, scene.noise_std)
            center += _overlap(ahead, here[None], scene.noise_std)[:, 0]
        if center.min() > MIN_OVERLAP * PRIOR_SAMPLES:
            matrix = 2 * PRIOR_SAMPLES * (same - opposite) / np.outer(center, center)
            best = np.maximum(best, _root(matrix, moves))
    return best


def _overlap(a: FloatArray, b: FloatArray, std: float) -> FloatArray:
    """Return exp(-|a_i - b_j|² / 8σ²) for all pairs of rows of ranges: (M, L) of (M, N) and (L, N)."""
    squares = (a**2).sum(axis=1)[:, None] + (b**2).sum(axis=1) - 2 * a @ b.T
    return np.asarray(np.exp(-np.maximum(squares, 0.0) / (8 * std**2)))


def _root(matrix: FloatArray, moves: FloatArray) -> FloatArray:
    """Return h_j √((matrix⁻¹)_jj); 0 where the matrix is singular."""
    if not np.isfinite(matrix).all() or np.linalg.cond(matrix) > MAX_CONDITION:
        return np.zeros(len(moves))
    h = np.abs(moves).max(axis=1)
    return np.asarray(h * np.sqrt(np.maximum(np.diag(np.linalg.inv(matrix)), 0.0)))


def ratio(errors: Sequence[float], limits: Sequence[float]) -> float:
    """Compare errors with their bounds.

    Args:
        errors: The errors.
        limits: Lower bounds on their standard deviations; those of 0 are left out.

    Returns:
        The median of |error| / limit over that of a standard normal error; NaN where there is no bound.
    """
    known = [abs(error) / limit for error, limit in zip(errors, limits, strict=True) if limit > 0]
    return float(np.median(known)) / NORMAL_MEDIAN if known else math.nan
