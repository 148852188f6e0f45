"""How well scans fit each other by poses that they are given, and how well they could: a test of any source of poses.

Windows of scans are tested, consecutive ones and such that lie further apart. Each scan is held against a map of
those before it in its window, at its pose as it is given, and where it matches best nearby.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from prim.scan import PosedScan
from replay.poses.scan_registration import range_noise
from replay.poses.tracking.local_map import LocalMap, joined
from replay.poses.tracking.options import DEFAULTS, TrackingOptions
from replay.poses.tracking.points import moved, scan_points


class ScanFit(NamedTuple):
    """The share of a scan's points that lie on the map of those before it, as Welsch's weights count them.

    Attributes:
        given: By the poses that are given; the median over scans.
        matched: Once each scan is matched.
        scans: Over how many scans.
    """

    given: float
    matched: float
    scans: int

    def is_worse_than(self, other: ScanFit, options: TrackingOptions = DEFAULTS) -> bool:
        """Tell whether scans fit clearly worse by these poses than by others.

        Args:
            other: The fit of the same scans by the others.
            options: What is clear.

        Returns:
            Whether they do; not where there are no scans.
        """
        return bool(self.scans and other.scans and self.given < other.given - options.worse_fit)

    def is_bad(self, options: TrackingOptions = DEFAULTS) -> bool:
        """Tell whether scans fit clearly worse than they could.

        Args:
            options: What is clear.

        Returns:
            Whether they do; not where there are no scans.
        """
        return bool(self.scans and self.given < self.matched - options.bad_fit)


def fit_windows(count: int, options: TrackingOptions = DEFAULTS) -> tuple[list[range], list[range]]:
    """Choose windows of scans, evenly spread.

    Args:
        count: How many scans there are.
        options: How many windows, and of how many scans.

    Returns:
        Windows of consecutive scans, and windows that together span all.
    """
    length = min(options.window_scans, count)
    starts = np.unique(np.linspace(0, count - length, options.windows).astype(int)).tolist()
    stride = max(count // (options.windows * length), 1)
    span = stride * length
    near = [range(start, start + length) for start in starts]
    return near, [range(start, start + span, stride) for start in range(0, count - span + 1, span)]


def scan_fit(windows: Sequence[Sequence[PosedScan]], options: TrackingOptions = DEFAULTS) -> ScanFit:
    """Measure how well scans fit each other.

    Args:
        windows: Consecutive scans of one laser, with their poses.
        options: Points, maps, and how far poses may be off.

    Returns:
        The fit.
    """
    noise_std = range_noise([posed.scan for window in windows for posed in window])
    place, turn = options.misplaced
    nearby = np.diag([place**-2, place**-2, turn**-2])
    given, matched = [], []
    for window in windows:
        points = [scan_points(posed, noise_std, options.points) for posed in window]
        poses = [np.array([posed.pose.x, posed.pose.y, posed.pose.theta]) for posed in window]
        world = [moved(*pair) for pair in zip(points, poses, strict=True)]
        for k in range(len(window) // 2, len(window)):
            before = joined(world[:k])
            if len(before) and len(points[k]):
                local = LocalMap(before, options.map)
                given.append(local.score(points[k], poses[k]))
                matched.append(local.match(points[k], poses[k], None, nearby).score)
    if not given:
        return ScanFit(0.0, 0.0, 0)
    return ScanFit(float(np.median(given)), float(np.median(np.maximum(given, matched))), len(given))
