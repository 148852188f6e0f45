"""Clouds of points as scans: of a planar scanner, or the slice of a 3D one."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from prim.arrays import FloatArray
from prim.errors import LogReadError
from prim.log.decoding.values import PointCloud
from prim.scan import Scan


@dataclass(frozen=True)
class CloudOptions:
    """The numbers by which clouds become scans; set by hand."""

    max_flat: float = 0.05
    """A cloud whose heights spread (10th to 90th percentile, m) by more is no planar scanner's."""

    max_beams: int = 7200
    """A scan has no more beams, which are 0.05 degrees apart."""

    min_beams: int = 90
    """A scan that goes all around has no fewer beams, which are 4 degrees apart."""

    percentile: float = 10.0
    """The distance between beams is this percentile of those between the bearings of neighbouring points: larger ones
    are gaps, smaller ones two points of a beam."""

    min_step: float = 1e-5
    """Bearings closer than this (rad) are the same."""


DEFAULTS = CloudOptions()


class CloudSlicer:
    """Makes scans of clouds: beams of equal steps in bearing all around the sensor, each with its nearest point.

    Bearings are rounded to the nearest beam. The steps are found from the first cloud; a beam without a point has no
    measurement, since a cloud does not say whether it had no return.

    Args:
        heights: The lowest and the highest z (m, in the sensor's frame) of points that are used; None: all those of a
            planar scanner.
        refuse: Called with a reason and a hint where a cloud is not flat, and no heights are given; it raises.
        options: Numbers.
    """

    def __init__(
        self,
        heights: tuple[float, float] | None,
        refuse: Callable[[str, str], LogReadError],
        options: CloudOptions = DEFAULTS,
    ) -> None:
        self._heights = heights
        self._refuse = refuse
        self._options = options
        self._angle_min = 0.0
        self._beams = 0

    def scan(self, cloud: PointCloud) -> Scan:
        """Make a scan of a cloud.

        Args:
            cloud: The cloud.

        Returns:
            The scan, without limits of the range.

        Raises:
            LogReadError: The cloud is no planar scanner's, and no heights are given.
        """
        points = self._slice(cloud)
        bearings = np.arctan2(points[:, 1], points[:, 0])
        if not self._beams:
            self._choose_beams(bearings)
        if not self._beams:  # too few points to choose by: their bearings would be those of no beam
            points, bearings = points[:0], bearings[:0]
        increment = 2 * math.pi / max(self._beams, 1)
        ranges = np.full(self._beams, np.inf)
        beams = np.rint((bearings - self._angle_min) / increment).astype(np.intp) % max(self._beams, 1)
        np.minimum.at(ranges, beams, np.hypot(points[:, 0], points[:, 1]))
        ranges[np.isinf(ranges)] = np.nan
        single = ranges.astype(np.float32)
        return Scan(cloud.stamp, cloud.frame_id, self._angle_min, increment, 0.0, math.inf, single)

    def _slice(self, cloud: PointCloud) -> FloatArray:
        """Return the finite points (M, 3) at the heights that are used, those at the sensor's origin left out."""
        points = cloud.points[np.isfinite(cloud.points).all(axis=1)]
        points = points[np.hypot(points[:, 0], points[:, 1]) > 0]
        if self._heights is not None:
            lowest, highest = self._heights
            return points[(points[:, 2] >= lowest) & (points[:, 2] <= highest)]
        if len(points):
            low, middle, high = np.percentile(points[:, 2], (10, 50, 90)).tolist()
            if high - low > self._options.max_flat:
                half = self._options.max_flat / 2
                what = f"its clouds are no planar scanner's: they reach from z = {low:.2f} to {high:.2f} m"
                raise self._refuse(what, f"choose a slice: --slice {middle - half:.2f} {middle + half:.2f}")
        return points

    def _choose_beams(self, bearings: FloatArray) -> None:
        """Choose the number of beams all around, and the bearing of the first, by the points of a cloud."""
        options = self._options
        ordered = np.unique(bearings)
        steps = np.diff(ordered)
        steps = steps[steps > options.min_step]
        if not len(steps):
            return
        step = float(np.percentile(steps, options.percentile))
        near = steps[steps < 1.5 * step]
        step = float(near.mean())
        self._beams = int(np.clip(round(2 * math.pi / step), options.min_beams, options.max_beams))
        increment = 2 * math.pi / self._beams
        phases = np.exp(1j * ordered * self._beams)
        self._angle_min = -math.pi + (float(np.angle(phases.mean())) / self._beams + math.pi) % increment
