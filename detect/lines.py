"""Straight lines through points (RANSAC, then the points' main axis)."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from prim.raycast import FloatArray

Line = tuple[float, float, float]
"""nx, ny, d: points with nx x + ny y = d."""

TRIALS = 60
MOST_POINTS = 4000
"""Lines are looked for among no more points than this, chosen at random."""


def find_lines(points: FloatArray, resolution: float, least_length: float, most: int) -> list[Line]:
    """Lines through cells' centres (N, 2) that cover ``least_length`` (m) of them, the longest first."""
    rng = np.random.default_rng(0)
    share = 1.0
    if len(points) > MOST_POINTS:
        share = MOST_POINTS / len(points)
        points = points[np.sort(rng.choice(len(points), MOST_POINTS, replace=False))]
    least = max(least_length / resolution * share, 8.0)
    found: list[Line] = []
    while len(found) < most and len(points) > least:
        best = _most_on_a_line(points, resolution, rng)
        if np.count_nonzero(best) < least:
            break
        middle = points[best].mean(axis=0)
        normal = np.linalg.eigh(np.cov((points[best] - middle).T))[1][:, 0]
        found.append((float(normal[0]), float(normal[1]), float(normal @ middle)))
        points = points[np.abs(points @ normal - normal @ middle) > 3 * resolution]
    return found


def _most_on_a_line(points: FloatArray, resolution: float, rng: np.random.Generator) -> NDArray[np.bool_]:
    """Which points lie within a cell of the line through two of them that has most."""
    best = np.zeros(len(points), np.bool_)
    for first, second in rng.integers(len(points), size=(TRIALS, 2)):
        along = points[second] - points[first]
        length = math.hypot(*along)
        if length < 8 * resolution:
            continue
        off = np.abs((points - points[first]) @ np.array([-along[1], along[0]])) / length
        if np.count_nonzero(off < resolution) > np.count_nonzero(best):
            best = off < resolution
    return best
