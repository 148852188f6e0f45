"""Straight lines through points (RANSAC, then the points' main axis)."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mapping.rays import kernel
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
    pairs = rng.integers(len(points), size=(TRIALS, 2))
    best = pairs[best_pair(np.ascontiguousarray(points.T), pairs, resolution)]
    first, second = points[best]
    along = second - first
    return np.asarray(np.abs((points - first) @ (-along[1], along[0])) < resolution * math.hypot(*along))


@kernel
def best_pair(points: Any, pairs: Any, resolution: float) -> int:
    """Which pair (T, 2) of points (2, N) has the line with most within a cell: the first where there are several.

    Pairs less than 8 cells apart have no line.
    """
    best, most = 0, 0
    for k in range(len(pairs)):
        first, second = pairs[k]
        x, y = points[0, first], points[1, first]
        nx, ny = y - points[1, second], points[0, second] - x
        length = math.sqrt(nx * nx + ny * ny)
        if length < 8 * resolution:
            continue
        nx, ny = nx / length, ny / length
        d, count = nx * x + ny * y, 0
        for i in range(points.shape[1]):
            count += abs(nx * points[0, i] + ny * points[1, i] - d) < resolution
        if count > most:
            best, most = k, count
    return best
