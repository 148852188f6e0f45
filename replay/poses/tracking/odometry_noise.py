"""The noise of an odometry, by scans: how far each lies from where those before it, placed by odometry, expect it."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from prim.arrays import FloatArray
from prim.scan import PosedScan
from prim.se2 import relative_poses, wrap_angles
from replay.poses.fusion_options import FusionOptions
from replay.poses.scan_registration import range_noise
from replay.poses.tracking.local_map import LocalMap, joined
from replay.poses.tracking.options import DEFAULTS, TrackingOptions
from replay.poses.tracking.points import moved, scan_points

CHI_SQUARED_MEDIANS = 0.4549, 1.3863
"""The medians of chi squared with one and two degrees of freedom."""


def odometry_noise(
    windows: Sequence[Sequence[PosedScan]],
    fusion: FusionOptions,
    options: TrackingOptions = DEFAULTS,
) -> tuple[float, float] | None:
    """Estimate how an odometry's errors grow.

    Args:
        windows: Consecutive scans of one laser, with their poses by odometry.
        fusion: The distances that turns and time count as.
        options: Points, maps, and how far poses may be off.

    Returns:
        Standard deviations of a position along each axis (m) and of a heading (rad) after one metre, and no less than
        matches can show; None where scans say too little.
    """
    noise_std = range_noise([posed.scan for window in windows for posed in window])
    rows: list[tuple[float, float]] = []
    for window in windows:
        points = [scan_points(posed, noise_std, options.points) for posed in window]
        poses = np.array([[posed.pose.x, posed.pose.y, posed.pose.theta] for posed in window])
        lengths = _lengths(window, poses, fusion)
        for k in range(len(window) // 2, len(window)):
            # a random walk's last value is off the mean of those before it by this share of its steps
            spread = float(((np.arange(1, k + 1) / k) ** 2 * lengths[:k]).sum())
            off = _offset(points[: k + 1], poses[: k + 1], options) if spread > options.least_spread else None
            if off is not None:
                rows.append((float(off[0] ** 2 + off[1] ** 2) / spread, float(off[2] ** 2) / spread))
    if len(rows) < options.least_windows:
        return None
    one, two = CHI_SQUARED_MEDIANS
    squares = np.median(np.array(rows), axis=0)
    place, turn = options.least_odometry_std
    return max(math.sqrt(squares[0] / two), place), max(math.sqrt(squares[1] / one), turn)


def _lengths(window: Sequence[PosedScan], poses: FloatArray, fusion: FusionOptions) -> FloatArray:
    """Return the distances (m) between scans, with turns and time counted as distance."""
    change, seconds = np.diff(poses, axis=0), np.diff([posed.scan.stamp for posed in window]) / 1e9
    turns = np.abs(wrap_angles(change[:, 2]))
    return np.hypot(change[:, 0], change[:, 1]) + fusion.rotation_distance * turns + fusion.idle_distance * seconds


def _offset(points: Sequence[FloatArray], poses: FloatArray, options: TrackingOptions) -> FloatArray | None:
    """Return where the last scan matches those before it, seen from where it is expected; None where it does not."""
    before = joined([moved(*pair) for pair in zip(points[:-1], poses[:-1], strict=True)])
    if not len(before) or not len(points[-1]):
        return None
    place, turn = options.misplaced
    match = LocalMap(before, options.map).match(
        points[-1], poses[-1], None, np.diag([place**-2, place**-2, turn**-2])
    )
    if match.score < options.sure_score:
        return None
    off: FloatArray = relative_poses(poses[-1:], match.pose[None])[0]
    off[2] = wrap_angles(off[2:])[0]
    return off
