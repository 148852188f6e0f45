"""Straight lines through points (RANSAC, then the points' main axis)."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from prim.arrays import FloatArray
from prim.compiled import kernel

Line = tuple[float, float, float]
"""nx, ny, d: points with nx x + ny y = d."""

TRIALS = 60
MOST_POINTS = 4000
"""Lines are looked for among no more points than this, chosen at random."""

REFITS, SPREADS = 3, 2.0
"""A line is moved to its middle so often, by points that are off by no more than so many times the median."""


def find_lines(
    points: FloatArray, resolution: float, least_length: float, most: int, width: float = 1.0
) -> list[Line]:
    """Lines through cells' centres (N, 2), within ``width`` cells, over ``least_length`` (m) of them; the longest are
    first.
    """
    rng = np.random.default_rng(0)
    share = 1.0
    if len(points) > MOST_POINTS:
        share = MOST_POINTS / len(points)
        points = points[np.sort(rng.choice(len(points), MOST_POINTS, replace=False))]
    least = max(least_length / resolution * share, 8.0)
    found: list[Line] = []
    while len(found) < most and len(points) > least:
        best = _most_on_a_line(points, width * resolution, rng)
        if np.count_nonzero(best) < least:
            break
        found.append(line := _main_axis(points[best]))
        points = points[off_line(points, line) > (2 + width) * resolution]
    return found


def middle_line(points: FloatArray, resolution: float) -> Line:
    """The line along points (N, 2), those left out that lie further from it than most do: sharp walls stay sharp."""
    line = _main_axis(points)
    for _ in range(REFITS):
        off = off_line(points, line)
        line = _main_axis(points[off <= max(SPREADS * float(np.median(off)), resolution)])
    return line


def off_line(points: FloatArray, line: Line) -> FloatArray:
    """How far (m) points (N, 2) are from a line."""
    return np.asarray(np.abs(points @ np.array(line[:2]) - line[2]))


def _main_axis(points: FloatArray) -> Line:
    middle = points.mean(axis=0)
    normal = np.linalg.eigh(np.cov((points - middle).T))[1][:, 0]
    return float(normal[0]), float(normal[1]), float(normal @ middle)


def _most_on_a_line(points: FloatArray, within: float, rng: np.random.Generator) -> NDArray[np.bool_]:
    """Which points lie ``within`` (m) of the line through two of them that has most."""
    pairs = rng.integers(len(points), size=(TRIALS, 2))
    best = pairs[best_pair(np.ascontiguousarray(points.T), pairs, within)]
    first, second = points[best]
    along = second - first
    return np.asarray(np.abs((points - first) @ (-along[1], along[0])) < within * math.hypot(*along))


@kernel
def best_pair(points: Any, pairs: Any, within: float) -> int:
    """Which pair (T, 2) of points (2, N) has the line with most ``within`` (m): the first where there are several.

    Pairs that are no further apart than eight times that have no line.
    """
    best, most = 0, 0
    for k in range(len(pairs)):
        first, second = pairs[k]
        x, y = points[0, first], points[1, first]
        nx, ny = y - points[1, second], points[0, second] - x
        length = math.sqrt(nx * nx + ny * ny)
        if length < 8 * within:
            continue
        nx, ny = nx / length, ny / length
        d, count = nx * x + ny * y, 0
        for i in range(points.shape[1]):
            count += abs(nx * points[0, i] + ny * points[1, i] - d) < within
        if count > most:
            best, most = k, count
    return best
