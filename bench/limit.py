"""How well a primitive's parameters can be known from a session's rays: the bound of Chapman and Robbins.

Where a ray jumps from hit to miss the likelihood has no derivative, and the bound of Cramér and Rao is not defined.
For steps h_j of the parameters, with Δ_j = r(p + h_j e_j) - r(p) over all rays and M_ij = exp(Δ_i·Δ_j / σ²) - 1, no
unbiased estimate has a smaller standard deviation of parameter j than h_j √((M⁻¹)_jj); the largest over the steps is
taken. Ranges that are cut off count as whole ones here, so that the bound is a little low where noise is large.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from detect.beams import FAMILY, Beams, gather, parameters
from detect.fit import TIES
from detect.raycost import trace
from prim.frames import Pose2D, Scan
from prim.raycast import FloatArray, cast_segments
from prim.shapes import Primitive

STEPS = (2e-5, 5e-5, 1e-4, 2e-4, 5e-4, 1e-3, 2e-3, 5e-3, 1e-2)
"""Steps of lengths (m); of angles, ten times as many radians."""

REACH = 0.06
MOST_EXPONENT = 600.0


def bounds(
    scans: Sequence[tuple[Scan, Pose2D]],
    primitives: Sequence[Primitive],
    walls: FloatArray,
    noise_std: float,
) -> list[FloatArray]:
    """The bound (K,) of each primitive's own parameters (m, rad, as detect.fit.NAMES has them)."""
    around, _ = gather(scans, primitives, REACH)
    made = []
    for k, (one, beams) in enumerate(zip(primitives, around, strict=True)):
        behind = np.minimum(_nearest(beams, [*primitives[:k], *primitives[k + 1 :]]), _walls(beams, walls))
        made.append(_bound(one, beams, behind, noise_std))
    return made


def _nearest(beams: Beams, others: Sequence[Primitive]) -> FloatArray:
    nearest, distance = np.full(len(beams), np.inf), np.empty(len(beams))
    for other in others:
        trace(FAMILY[other.kind], parameters(other), beams.rays, distance)
        np.minimum(nearest, distance, out=nearest)
    return nearest


def _walls(beams: Beams, walls: FloatArray) -> FloatArray:
    distance = beams.far.copy()
    origins, scan = np.unique(beams.rays[:, :2], axis=0, return_inverse=True)
    for number, origin in enumerate(origins.tolist()):
        own = np.flatnonzero(scan.ravel() == number)
        cast = cast_segments((origin[0], origin[1]), beams.rays[own, 2:4], walls)
        distance[own] = np.minimum(distance[own], cast)
    return distance


def _bound(primitive: Primitive, beams: Beams, behind: FloatArray, noise_std: float) -> FloatArray:
    tie, p = TIES[primitive.kind], parameters(primitive)
    best = np.zeros(tie.shape[1])

    def ranges(at: FloatArray) -> FloatArray:
        distance = np.empty(len(beams))
        trace(FAMILY[primitive.kind], at, beams.rays, distance)
        return np.minimum(distance, behind)

    here = ranges(p)
    for step in STEPS:
        for sign in (-1.0, 1.0):
            h = np.array([sign * step * (10.0 if tie[2, k] else 1.0) for k in range(tie.shape[1])])
            moved = np.stack([ranges(p + tie[:, k] * h[k]) - here for k in range(tie.shape[1])])
            exponent = moved @ moved.T / noise_std**2
            if np.diag(exponent).max() > MOST_EXPONENT:
                continue
            matrix = np.expm1(exponent)
            if np.linalg.cond(matrix) < 1e12:
                best = np.maximum(best, np.abs(h) * np.sqrt(np.maximum(np.diag(np.linalg.inv(matrix)), 0.0)))
    return best


def ratio(errors: Sequence[float], limits: Sequence[float]) -> float:
    """How many times the limit errors are: the median of |error| / limit, over what it is for a normal error."""
    known = [abs(error) / limit for error, limit in zip(errors, limits, strict=True) if limit > 0]
    return float(np.median(known)) / 0.674 if known else math.nan
