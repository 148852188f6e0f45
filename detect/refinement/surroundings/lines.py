"""Straight lines through points: RANSAC (Fischler and Bolles 1981), then the principal axis of the inliers."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from detect.refinement.options import DEFAULTS, LineOptions
from prim import linear_algebra
from prim.arrays import FloatArray
from prim.compiled import kernel

Line = tuple[float, float, float]
"""nx, ny, d: the points with nx x + ny y = d, the normal (nx, ny) of unit length."""


def find_lines(
    points: FloatArray,
    resolution: float,
    min_length: float,
    max_lines: int,
    width: float = 1.0,
    options: LineOptions = DEFAULTS.lines,
) -> list[Line]:
    """Find straight lines through cells' centres, those with most cells first.

    Args:
        points: (N, 2) centres (m).
        resolution: The cells' side (m).
        min_length: A line has cells for this length (m) at least.
        max_lines: How many to find at most.
        width: Cells lie within this distance (cells) of a line.
        options: Numeric parameters.

    Returns:
        The lines.
    """
    rng = np.random.default_rng(0)
    share = 1.0
    if len(points) > options.max_points:
        share = options.max_points / len(points)
        points = points[np.sort(rng.choice(len(points), options.max_points, replace=False))]
    fewest = max(min_length / resolution * share, options.min_inliers)
    found: list[Line] = []
    while len(found) < max_lines and len(points) > fewest:
        inliers = _largest_consensus(points, width * resolution, rng, options)
        if np.count_nonzero(inliers) < fewest:
            break
        found.append(line := _principal_axis(points[inliers]))
        points = points[distance_to_line(points, line) > (2 + width) * resolution]
    return found


def trimmed_line(points: FloatArray, resolution: float, options: LineOptions = DEFAULTS.lines) -> Line:
    """Fit a line to points, without those that lie further from it than most do.

    Args:
        points: (N, 2) in metres.
        resolution: Points within this distance (m) always count.
        options: Numeric parameters.

    Returns:
        The line.
    """
    line = _principal_axis(points)
    for _ in range(options.refits):
        off = distance_to_line(points, line)
        line = _principal_axis(points[off <= max(options.medians * float(np.median(off)), resolution)])
    return line


def distance_to_line(points: FloatArray, line: Line) -> FloatArray:
    """Return the distances (m) of points from a line.

    Args:
        points: (N, 2).
        line: The line.

    Returns:
        (N,) 0 or more.
    """
    return np.asarray(np.abs(points @ np.array(line[:2]) - line[2]))


def _principal_axis(points: FloatArray) -> Line:
    """Return the total-least-squares line."""
    middle = points.mean(axis=0)
    normal = linear_algebra.scatter_axes(points)[:, 0]
    return float(normal[0]), float(normal[1]), float(normal @ middle)


def _largest_consensus(
    points: FloatArray, within: float, rng: np.random.Generator, options: LineOptions
) -> NDArray[np.bool_]:
    """Return which points lie within a distance (m) of the line through two of them that most do."""
    pairs = rng.integers(len(points), size=(options.trials, 2))
    best = pairs[best_pair(np.ascontiguousarray(points.T), pairs, within, options.baseline * within)]
    first, second = points[best]
    along = second - first
    return np.asarray(np.abs((points - first) @ (-along[1], along[0])) < within * math.hypot(*along))


@kernel
def best_pair(points: Any, pairs: Any, within: float, baseline: float) -> int:
    """Find the pair of points whose line has most points near it.

    Args:
        points: (2, N).
        pairs: (T, 2) indices.
        within: Distance (m) from the line.
        baseline: Pairs that are nearer to each other (m) have no line.

    Returns:
        The index of the pair: the first of equals.
    """
    best, most = 0, 0
    for k in range(len(pairs)):
        first, second = pairs[k]
        x, y = points[0, first], points[1, first]
        nx, ny = y - points[1, second], points[0, second] - x
        length = math.sqrt(nx * nx + ny * ny)
        if length < baseline:
            continue
        nx, ny = nx / length, ny / length
        d, count = nx * x + ny * y, 0
        for i in range(points.shape[1]):
            count += abs(nx * points[0, i] + ny * points[1, i] - d) < within
        if count > most:
            best, most = k, count
    return best
