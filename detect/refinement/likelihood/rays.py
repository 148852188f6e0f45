"""The rays that pass each candidate, collected from the log's scans."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from detect.refinement.likelihood.geometry import passes_within
from detect.refinement.likelihood.kernels import (
    BACKGROUND,
    COLLECTED_ROWS,
    DIRECTION_X,
    DIRECTION_Y,
    ENTRY_RANGE,
    FAR,
    OCCLUSION,
    RayStoreView,
    append_passing,
)
from detect.refinement.options import DEFAULTS, RefinementOptions
from mapping.range_noise import neighbour_noise
from prim.arrays import FloatArray, Stamps
from prim.scan import RangeOutcome, Scan
from prim.se2 import Pose2D, rotate
from prim.shapes import Primitive

FIRST_ROOM = 1024
"""Rays that a buffer has room for at first."""

ALWAYS = np.iinfo(np.int64).min
"""A stamp (ns) before all scans."""


@dataclass(frozen=True)
class RayBundle:
    """N rays that pass one candidate.

    Attributes:
        rays: (7, N) as detect.refinement.likelihood.kernels has them.
        outcomes: (N,) MEASURED, TOO_NEAR or NO_RETURN.
        entry_range: (N,) range (m) at which they enter the candidate's circle.
        max_range: (N,) the sensor's (m).
        scan: (N,) number of the scan.
    """

    rays: FloatArray
    outcomes: NDArray[np.int8]
    entry_range: FloatArray
    max_range: FloatArray
    scan: NDArray[np.int32]

    def __len__(self) -> int:
        return len(self.outcomes)

    def passing(self, primitive: Primitive, reach: float) -> NDArray[np.bool_]:
        """Tell which rays come near a primitive.

        Args:
            primitive: The primitive.
            reach: How near (m).

        Returns:
            (N,) bool.
        """
        return passes_within(primitive, self.rays, reach)

    def is_similar(self, other: RayBundle, options: RefinementOptions = DEFAULTS) -> bool:
        """Tell whether nearly all of the same rays have nearly the same background and occlusion.

        Args:
            other: The same rays, with another background.
            options: The thresholds (``options.rays``).

        Returns:
            Whether a fit to one holds for the other.
        """
        limits = options.rays
        differ = np.abs(self.rays[BACKGROUND] - other.rays[BACKGROUND]) > limits.similar_nats
        occlusions = np.minimum(self.rays[OCCLUSION], FAR) - np.minimum(other.rays[OCCLUSION], FAR)
        differ |= np.abs(occlusions) > limits.similar_range
        return int(np.count_nonzero(differ)) <= limits.similar_share * len(differ)

    def with_rays(self, rays: FloatArray) -> RayBundle:
        """Return the bundle with other numbers (7, N)."""
        return replace(self, rays=rays)

    def select(self, chosen: NDArray[np.bool_] | slice) -> RayBundle:
        """Return the chosen rays."""
        return RayBundle(
            np.ascontiguousarray(self.rays[:, chosen]),
            np.ascontiguousarray(self.outcomes[chosen]),
            self.entry_range[chosen],
            self.max_range[chosen],
            self.scan[chosen],
        )


def turned_rays(rays: FloatArray, turn: float) -> FloatArray:
    """Turn rays about their origins.

    Args:
        rays: (7, N).
        turn: The angle (rad).

    Returns:
        (7, N).
    """
    turned = rays.copy()
    turned[DIRECTION_X : DIRECTION_Y + 1] = rotate(rays[DIRECTION_X : DIRECTION_Y + 1].T, turn).T
    return turned


class RayBuffer:
    """The rays that pass one circle, as they come in; it grows, and thins itself by scans."""

    def __init__(self, max_rays: int) -> None:
        self.size, self.stride = 0, 1
        self._max_rays = max_rays
        self.view = self._allocated(FIRST_ROOM)

    @staticmethod
    def _allocated(room: int) -> RayStoreView:
        return RayStoreView(np.zeros((COLLECTED_ROWS, room)), np.zeros(room, np.int8), np.zeros(room, np.int32))

    def reserve(self, more: int) -> None:
        """Make room for so many more rays."""
        if self.size + more > len(self.view.outcomes):
            self._keep(np.arange(self.size), 2 * (self.size + more))

    def thin(self) -> None:
        """Leave out every other scan where there are more than twice as many rays as wanted."""
        if self.size > 2 * self._max_rays:
            self.stride *= 2
            chosen = np.flatnonzero(self.view.scan[: self.size] % self.stride == 0)
            self._keep(chosen, len(self.view.outcomes))

    def _keep(self, chosen: NDArray[np.intp], room: int) -> None:
        before = self.view
        self.view = self._allocated(room)
        self.size = len(chosen)
        self.view.rays[:, : self.size] = before.rays[:, chosen]
        self.view.outcomes[: self.size] = before.outcomes[chosen]
        self.view.scan[: self.size] = before.scan[chosen]

    def bundle(self) -> RayBundle:
        """Return all rays so far."""
        rays = self.view.rays[:, : self.size].copy()
        outcomes, scan = self.view.outcomes[: self.size].copy(), self.view.scan[: self.size].copy()
        return RayBundle(rays[:ENTRY_RANGE], outcomes, rays[-2], rays[-1], scan)


class RayCollector:
    """Collects the rays that pass each of M circles."""

    def __init__(
        self,
        centres: FloatArray,
        reach: FloatArray,
        options: RefinementOptions = DEFAULTS,
        since: Stamps | None = None,
    ) -> None:
        """Begin with no rays.

        Args:
            centres: (M, 2) in metres, map frame.
            reach: (M,) radii (m).
            options: How many rays at most (``options.rays``), and from how many scans the noise is bounded.
            since: (M,) stamps (ns); of earlier scans no rays are collected. None: all are.
        """
        self._centres, self._reach, self._options = centres, reach, options
        self._since = np.full(len(reach), ALWAYS) if since is None else since
        self._buffers = [RayBuffer(options.rays.max_rays) for _ in reach]
        self._scans = 0
        self.span = 0.0
        self._ranges: list[NDArray[np.float32]] = []

    def add(self, scan: Scan, pose: Pose2D) -> None:
        """Add a scan, or the next part of one.

        Args:
            scan: The scan.
            pose: Of the laser, in the map frame.
        """
        self._scans += scan.first_beam == 0
        if len(self._ranges) < self._options.sensor.noise_scans:
            self._ranges.append(scan.ranges)
        away = np.hypot(*(self._centres - (pose.x, pose.y)).T)
        near = np.flatnonzero((away - self._reach < scan.range_max) & (self._since <= scan.stamp))
        if not len(near):
            return
        max_range = min(scan.range_max, self._options.rays.max_range)
        self.span = max(self.span, max_range - scan.range_min)
        outcomes, z = _measurements(scan)
        for k in near.tolist():
            buffer = self._buffers[k]
            if self._scans % buffer.stride:
                continue
            buffer.reserve(len(z))
            x, y = self._centres[k].tolist()
            buffer.size = append_passing(
                scan.directions,
                outcomes,
                z,
                (pose.x, pose.y, pose.theta),
                (x, y, self._reach[k]),
                (max_range, self._scans),
                buffer.view,
                buffer.size,
            )
            if not scan.first_beam:
                buffer.thin()

    @property
    def max_noise(self) -> float:
        """An upper bound of the range noise (m), by the differences of neighbouring beams of some scans."""
        options = self._options.sensor
        guess = neighbour_noise(np.concatenate(self._ranges)) if self._ranges else None
        return max(options.max_noise_ratio * guess, options.min_max_noise) if guess is not None else math.inf

    def bundles(self) -> list[RayBundle]:
        """Return each circle's rays."""
        return [buffer.bundle() for buffer in self._buffers]


def _measurements(scan: Scan) -> tuple[NDArray[np.int8], FloatArray]:
    """Return each beam's outcome, and its range or the limit (m) that it is beyond."""
    outcomes, z = scan.outcomes(), scan.ranges.astype(np.float64)
    z[outcomes == RangeOutcome.NO_RETURN] = scan.range_max
    z[outcomes == RangeOutcome.TOO_NEAR] = scan.range_min
    return outcomes, z


def collect_rays(
    scans: Iterable[tuple[Scan, Pose2D]],
    primitives: Sequence[Primitive],
    reach: float | Sequence[float],
    options: RefinementOptions = DEFAULTS,
    since: Sequence[int | None] | None = None,
) -> tuple[list[RayBundle], float, float]:
    """Collect the rays that come near each primitive.

    Args:
        scans: Scans and the poses of their laser, in the map frame.
        primitives: The primitives.
        reach: How near (m) to their circumscribed circles; one number for all, or one for each.
        options: The limits.
        since: The stamp (ns) for each from which on scans are used; None for all.

    Returns:
        A bundle for each primitive, the largest span of ranges (m), and an upper bound of the noise (m).
    """
    centres = np.array([(primitive.x, primitive.y) for primitive in primitives]).reshape(-1, 2)
    radii = np.array([primitive.bounding_radius for primitive in primitives]) + reach
    first = np.array([ALWAYS if stamp is None else stamp for stamp in since or [None] * len(primitives)], np.int64)
    collector = RayCollector(centres, radii, options, first)
    for scan, pose in scans:
        collector.add(scan, pose)
    return collector.bundles(), collector.span, collector.max_noise
