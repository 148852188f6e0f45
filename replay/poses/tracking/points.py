"""Scans as points on surfaces, in the frame of their laser."""

from __future__ import annotations

import numpy as np

from prim.arrays import FloatArray
from prim.scan import PosedScan
from prim.se2 import Pose2D
from replay.poses.tracking.kernels import LineRule, find_points, move_points
from replay.poses.tracking.options import PointOptions


def scan_points(posed: PosedScan, noise_std: float, options: PointOptions) -> FloatArray:
    """Find the points of a scan.

    Args:
        posed: The scan; its pieces have the laser's motion within it.
        noise_std: Standard deviation of its range noise (m).
        options: Which beams are neighbours on a line.

    Returns:
        Points (N, 4) in the laser's frame at the first beam: x, y (m), on the line through the neighbours where there
        is one, and the unit normal towards the laser; 0, 0 for points on no line.
    """
    scan = posed.scan
    ends = np.full((len(scan.ranges), 3), np.nan)
    back = Pose2D(posed.pose.x, posed.pose.y, posed.pose.theta).inverse()
    for piece, pose in posed.pieces:
        beams = piece.first_beam + np.flatnonzero(piece.measured)
        ends[beams, :2] = piece.points(back @ Pose2D(pose.x, pose.y, pose.theta))
        ends[beams, 2] = piece.ranges[piece.measured].astype(float) * abs(scan.angle_increment)
    noise = options.reach_noise * noise_std
    rule = LineRule(
        options.spacing,
        max(options.reach, noise),
        options.most,
        max(options.gap, noise),
        options.gap_beams,
        options.flatness,
    )
    points = np.empty((len(ends), 4))
    return points[: find_points(ends, rule, points)].copy()


def thinned(points: FloatArray, distance: float) -> FloatArray:
    """Leave one point in each square.

    Args:
        points: (N, 4).
        distance: The squares' side (m).

    Returns:
        (M, 4), in their order.
    """
    if not len(points):
        return points
    squares = np.floor(points[:, :2] / distance).astype(np.int64)
    squares -= squares.min(axis=0)
    _, first = np.unique(squares[:, 0] * (squares[:, 1].max() + 1) + squares[:, 1], return_index=True)
    return np.ascontiguousarray(points[np.sort(first)])


def moved(points: FloatArray, pose: FloatArray) -> FloatArray:
    """Move points from the frame of a pose to that which the pose is given in.

    Args:
        points: (N, 4).
        pose: (3,).

    Returns:
        (N, 4).
    """
    out = np.empty_like(points)
    move_points(points, pose, out)
    return out


def surfels(points: FloatArray, distance: float) -> FloatArray:
    """Average points (N, 4) that lie in one square of a side of ``distance`` (m) and face the same quarter.

    Args:
        points: Of many scans, in one frame.
        distance: The side (m).

    Returns:
        (M, 4) the means of two points at least.
    """
    if not len(points):
        return points
    squares = np.floor(points[:, :2] / distance).astype(np.int64)
    squares -= squares.min(axis=0)
    quarter = 2 * (points[:, 2] > 0) + (points[:, 3] > 0)
    keys = (squares[:, 0] * (squares[:, 1].max() + 1) + squares[:, 1]) * 4 + quarter
    _, number, counts = np.unique(keys, return_inverse=True, return_counts=True)
    means = np.column_stack([np.bincount(number, column) / counts for column in points.T])
    length = np.hypot(means[:, 2], means[:, 3])[:, None]
    means[:, 2:] = np.where(length > 0.5, means[:, 2:] / np.maximum(length, 0.5), 0.0)
    return np.ascontiguousarray(means[counts > 1])
