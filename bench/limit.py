"""How well a primitive's parameters can be known from a session's rays: lower bounds on any estimate's error.

Where a ray jumps from hit to miss the likelihood has no derivative, and the bound of Cramér and Rao is not defined.
Two others, for steps h_j of the parameters and r(p) the exact ranges of all rays:

- Chapman and Robbins: with Δ_j = r(p + h_j e_j) - r(p) and M_ij = exp(Δ_i·Δ_j / σ²) - 1, no estimate that is
  unbiased at p and at p + h e_j has a smaller standard deviation than h_j √((M⁻¹)_jj). The largest over all steps is
  taken. Steps so small that no ray changes from hit to miss leave the silhouettes out of it, which an estimate may
  well use (it is then biased over distances shorter than those between rays): it is too high where silhouettes tell
  most, and estimates come out far below it.
- Weiss and Weinstein (s = 1/2): holds for the mean square over parameters near p, of any estimate. With
  u(a, b) the mean over p of exp(-|r(a) - r(b)|² / 8σ²), G_ij = 2 [u(p + h_i, p + h_j) - u(p + h_i, p - h_j)] /
  [u(p + h_i, p) u(p + h_j, p)], and the bound is h_j √((G⁻¹)_jj), again the largest over the steps.

Ranges that are cut off count as whole ones here, so that both are a little low where noise is large.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from detect.refinement.geometry import TIES, parameters_of, ranges_to, shape_ranges
from detect.refinement.rays import RayBundle, collect_rays
from prim.arrays import FloatArray
from prim.raycast import cast_segments
from prim.scan import Scan
from prim.se2 import Pose2D
from prim.shapes import Primitive

STEPS = (2e-5, 5e-5, 1e-4, 2e-4, 5e-4, 1e-3, 2e-3, 5e-3, 1e-2)
"""Steps of lengths (m); of angles, ten times as many radians."""

REACH = 0.03
MOST_EXPONENT = 600.0
LEAST_OVERLAP = 1e-6

JITTER, PLACES = 0.001, 8
"""How far off (m; ten times as many radians), and how many, the parameters are that the second bound is a mean of."""


@dataclass(frozen=True)
class Limits:
    """Both bounds (K,) of one primitive's own parameters (m, rad, in the order of Kind.parameters)."""

    chapman_robbins: FloatArray
    weiss_weinstein: FloatArray


def bounds(
    scans: Sequence[tuple[Scan, Pose2D]],
    primitives: Sequence[Primitive],
    walls: FloatArray,
    noise_std: float,
) -> list[Limits]:
    """The bounds of each primitive."""
    around, _, _ = collect_rays(scans, primitives, REACH)
    made = []
    for k, (one, beams) in enumerate(zip(primitives, around, strict=True)):
        near = beams.select(beams.passing(one, REACH))
        behind = np.minimum(_nearest(near, [*primitives[:k], *primitives[k + 1 :]]), _walls(near, walls))
        scene = Scene(one, near, behind, noise_std)
        made.append(Limits(chapman_robbins(scene), weiss_weinstein(scene)))
    return made


def _nearest(beams: RayBundle, others: Sequence[Primitive]) -> FloatArray:
    nearest = np.full(len(beams), np.inf)
    for other in others:
        np.minimum(nearest, ranges_to(other, beams.rays), out=nearest)
    return nearest


def _walls(beams: RayBundle, walls: FloatArray) -> FloatArray:
    distance = beams.max_range.copy()
    origins, scan = np.unique(beams.rays[:2], axis=1, return_inverse=True)
    for number, origin in enumerate(origins.T.tolist()):
        own = np.flatnonzero(scan.ravel() == number)
        cast = cast_segments((origin[0], origin[1]), beams.rays[2:4, own].T, walls)
        distance[own] = np.minimum(distance[own], cast)
    return distance


@dataclass(frozen=True)
class Scene:
    """A primitive, the rays that pass it, where (m) they end without it, and their noise (m)."""

    primitive: Primitive
    beams: RayBundle
    behind: FloatArray
    noise_std: float

    @property
    def tie(self) -> FloatArray:
        """(5, K): see detect.refinement.geometry.TIES."""
        return TIES[self.primitive.kind]

    def ranges(self, at: FloatArray) -> FloatArray:
        """Exact ranges (N,) with the primitive's parameters ``at`` (5,)."""
        return np.minimum(shape_ranges(self.primitive.kind, at, self.beams.rays), self.behind)

    def steps(self, step: float) -> FloatArray:
        """A step of each of the own parameters, as five parameters: (K, 5)."""
        return np.asarray(self.tie.T * np.where(self.tie[2] != 0, 10.0 * step, step)[:, None])


def chapman_robbins(scene: Scene) -> FloatArray:
    """The bound (K,) of Chapman and Robbins."""
    p = parameters_of(scene.primitive)
    here = scene.ranges(p)
    best = np.zeros(scene.tie.shape[1])
    for step in (sign * size for size in STEPS for sign in (-1.0, 1.0)):
        moves = scene.steps(step)
        moved = np.stack([scene.ranges(p + move) - here for move in moves])
        exponent = moved @ moved.T / scene.noise_std**2
        if np.diag(exponent).max() < MOST_EXPONENT:
            best = np.maximum(best, _root(np.expm1(exponent), moves))
    return best


def weiss_weinstein(scene: Scene) -> FloatArray:
    """The bound (K,) of Weiss and Weinstein, over parameters within JITTER of the true ones."""
    rng = np.random.default_rng(0)
    size = scene.tie.shape[1]
    around = parameters_of(scene.primitive) + rng.uniform(-JITTER, JITTER, (PLACES, size)) @ scene.steps(1.0)
    best = np.zeros(size)
    for step in STEPS:
        moves = scene.steps(step)
        alike, across, still = np.zeros((size, size)), np.zeros((size, size)), np.zeros(size)
        for p in around:
            here = scene.ranges(p)
            ahead = np.stack([scene.ranges(p + move) for move in moves])
            back = np.stack([scene.ranges(p - move) for move in moves])
            alike += _overlap(ahead, ahead, scene.noise_std)
            across += _overlap(ahead, back, scene.noise_std)
            still += _overlap(ahead, here[None], scene.noise_std)[:, 0]
        if still.min() > LEAST_OVERLAP * PLACES:
            best = np.maximum(best, _root(2 * PLACES * (alike - across) / np.outer(still, still), moves))
    return best


def _overlap(a: FloatArray, b: FloatArray, std: float) -> FloatArray:
    """exp(-|a_i - b_j|² / 8σ²) of rows of ranges."""
    squares = (a**2).sum(axis=1)[:, None] + (b**2).sum(axis=1) - 2 * a @ b.T
    return np.asarray(np.exp(-np.maximum(squares, 0.0) / (8 * std**2)))


def _root(matrix: FloatArray, moves: FloatArray) -> FloatArray:
    """h_j √((matrix⁻¹)_jj); 0 where the matrix has no inverse to speak of."""
    if not np.isfinite(matrix).all() or np.linalg.cond(matrix) > 1e12:
        return np.zeros(len(moves))
    h = np.abs(moves).max(axis=1)
    return np.asarray(h * np.sqrt(np.maximum(np.diag(np.linalg.inv(matrix)), 0.0)))


def ratio(errors: Sequence[float], limits: Sequence[float]) -> float:
    """How many times the limit errors are: the median of |error| / limit, over what it is for a normal error."""
    known = [abs(error) / limit for error, limit in zip(errors, limits, strict=True) if limit > 0]
    return float(np.median(known)) / 0.674 if known else math.nan
