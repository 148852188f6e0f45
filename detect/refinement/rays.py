"""The rays that pass a primitive, and what they say where they miss it: what refinement works on."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from detect.refinement.kernels import (
    BOX,
    DISC,
    FAR,
    MEASURED,
    MISS,
    NO_RETURN,
    RANGE,
    ROWS,
    SAYS_NOTHING,
    STOP,
    TABLE_SPACING,
    TOO_NEAR,
    TRIANGLE,
    clearances,
    keep_passing,
    pass_by,
    shade,
    stop_at,
    tables,
    walk,
)
from mapping.forward.mapper import neighbour_noise
from mapping.grid import GridFrame
from prim.arrays import FloatArray
from prim.scan import Scan
from prim.se2 import Pose2D
from prim.shapes import Kind, Primitive

MOST = 8000
"""A primitive is fitted to about so many rays at most; of more, scans are left out evenly."""

NOISE_SCANS = 40
MOST_NOISE, LEAST_MOST = 2.0, 0.01
"""The noise is no more than so many times what the differences of neighbouring beams show, in as many scans; and what
is less than so much (m) is not held against it.
"""

FARTHEST = 1000.0
"""A sensor that says it sees further (m), or without end, is taken to see so far."""

OUTLIERS = 0.005
"""The share of ranges that have nothing to do with what stands there; spread evenly over all ranges."""

DOUBT = 0.05
"""The share of rays that what stands behind, as the map has it, does not explain."""

NOTHING_BEYOND = 0.5
"""The chance that a ray which leaves the map meets nothing at all."""

ALIKE_NATS, ALIKE_STOPS, ALIKE_SHARE = 0.5, 0.01, 0.01
"""Beams have changed where more than such a share of them says something else (nats), or is stopped elsewhere (m)."""

FAMILY = {
    Kind.SQUARE: BOX,
    Kind.RECTANGLE: BOX,
    Kind.CIRCLE: DISC,
    Kind.TRIANGLE: TRIANGLE,
    Kind.ELLIPSE: DISC,
}
"""Which unit shape a kind is."""


@dataclass(frozen=True)
class Beams:
    """Rays that pass one primitive: ``rays`` (7, N) as the kernels take them, ``kinds`` (N,), from where on (m)
    they are ``near`` it (N,), each sensor's largest range ``far`` (N,), and the number of the ``scan`` (N,).
    """

    rays: FloatArray
    kinds: NDArray[np.int8]
    near: FloatArray
    far: FloatArray
    scan: NDArray[np.int32]

    def __len__(self) -> int:
        return len(self.kinds)

    def passing(self, primitive: Primitive, reach: float) -> NDArray[np.bool_]:
        """Which of them come within ``reach`` (m) of a primitive."""
        aside = np.empty(len(self))
        pass_by(FAMILY[primitive.kind], parameters(primitive), self.rays, aside)
        return aside > -reach

    def much_alike(self, other: Beams) -> bool:
        """Whether all but a few of the same beams say much the same where they miss."""
        differ = np.abs(self.rays[MISS] - other.rays[MISS]) > ALIKE_NATS
        differ |= np.abs(np.minimum(self.rays[STOP], FAR) - np.minimum(other.rays[STOP], FAR)) > ALIKE_STOPS
        return bool(np.mean(differ) < ALIKE_SHARE)

    def of(self, chosen: NDArray[np.bool_] | slice) -> Beams:
        """Some of them."""
        return Beams(
            np.ascontiguousarray(self.rays[:, chosen]),
            np.ascontiguousarray(self.kinds[chosen]),
            self.near[chosen],
            self.far[chosen],
            self.scan[chosen],
        )


@dataclass(frozen=True)
class Sensor:
    """The sensor's noise ``std`` (m), its ``span`` of ranges (m), and the tables of likelihoods that follow.

    ``footprint`` (m): half the width over which a beam that passes an edge may meet it or not: the beam's own width,
    and how far poses and bearings are off. ``dispersion``: how much larger the squared errors of whole scans are than
    those of single rays would make them; 1 where poses are exact. ``most`` (m): the noise is no larger than this.
    """

    std: float
    span: float
    table: FloatArray
    footprint: float = 0.0
    dispersion: float = 1.0
    most: float = math.inf

    @classmethod
    def of(
        cls, std: float, span: float, footprint: float = 0.0, dispersion: float = 1.0, most: float = math.inf
    ) -> Sensor:
        """The sensor with such noise and span."""
        return cls(std, span, tables(OUTLIERS * _peak_share(std, span)), footprint, dispersion, most)


def _peak_share(std: float, span: float) -> float:
    """What an even density over all ranges is in units of the noise's peak."""
    return std * math.sqrt(2 * math.pi) / span


def parameters(primitive: Primitive) -> FloatArray:
    """A primitive as the kernels take it: x, y, theta, width, height."""
    return np.array([primitive.x, primitive.y, primitive.theta or 0.0, *primitive.width_height])


class Kept:
    """The rays that pass one circle, as they come in: room for more is made where it is needed."""

    def __init__(self) -> None:
        self.size, self.stride = 0, 1
        self._made(1024)

    def _made(self, room: int) -> None:
        self.numbers = np.zeros((ROWS, room))
        self.kinds, self.scan = np.zeros(room, np.int8), np.zeros(room, np.int32)

    def make_room(self, more: int) -> None:
        """Makes room for so many more."""
        if self.size + more > len(self.kinds):
            self._hold(np.arange(self.size), 2 * (self.size + more))

    def thin(self) -> None:
        """Leaves out every other scan where there are too many rays."""
        if self.size > 2 * MOST:
            self.stride *= 2
            self._hold(np.flatnonzero(self.scan[: self.size] % self.stride == 0), len(self.kinds))

    def _hold(self, chosen: NDArray[np.intp], room: int) -> None:
        numbers, kinds, scan = self.numbers, self.kinds, self.scan
        self._made(room)
        self.size = len(chosen)
        self.numbers[:, : self.size] = numbers[:, chosen]
        self.kinds[: self.size], self.scan[: self.size] = kinds[chosen], scan[chosen]

    def beams(self) -> Beams:
        """All that are kept."""
        numbers = self.numbers[:, : self.size].copy()
        return Beams(
            numbers[: len(numbers) - 2],
            self.kinds[: self.size].copy(),
            numbers[-2],
            numbers[-1],
            self.scan[: self.size].copy(),
        )


class Gatherer:
    """Collects the rays that pass each of some circles: ``centres`` (M, 2) and ``reach`` (M,) in metres."""

    def __init__(self, centres: FloatArray, reach: FloatArray) -> None:
        self._centres, self._reach = centres, reach
        self._kept = [Kept() for _ in reach]
        self._count = 0
        self.span = 0.0
        self._ranges: list[NDArray[np.float32]] = []

    def add(self, scan: Scan, pose: Pose2D) -> None:
        """Adds a scan, or the next part of one, taken by a laser at ``pose``."""
        self._count += scan.first_beam == 0
        if len(self._ranges) < NOISE_SCANS:
            self._ranges.append(scan.ranges)
        away = np.hypot(*(self._centres - (pose.x, pose.y)).T)
        near = np.flatnonzero(away - self._reach < scan.range_max)
        if not len(near):
            return
        far = min(scan.range_max, FARTHEST)
        self.span = max(self.span, far - scan.range_min)
        kinds, z = _measurements(scan)
        for k in near.tolist():
            kept = self._kept[k]
            if self._count % kept.stride:
                continue
            kept.make_room(len(z))
            x, y = self._centres[k].tolist()
            kept.size = keep_passing(
                scan.directions,
                kinds,
                z,
                (pose.x, pose.y, pose.theta),
                (x, y, self._reach[k]),
                (far, self._count),
                kept.numbers,
                kept.kinds,
                kept.scan,
                kept.size,
            )
            if not scan.first_beam:
                kept.thin()

    @property
    def most_noise(self) -> float:
        """The noise (m) is no larger than this: neighbouring beams of some scans would differ by more."""
        guess = neighbour_noise(np.concatenate(self._ranges)) if self._ranges else None
        return max(MOST_NOISE * guess, LEAST_MOST) if guess is not None else math.inf

    def beams(self) -> list[Beams]:
        """Each circle's rays."""
        return [kept.beams() for kept in self._kept]


def _measurements(scan: Scan) -> tuple[NDArray[np.int8], FloatArray]:
    """What each beam of a scan measured (SAYS_NOTHING: NaN, and what is below range_min), and the range or its limit.

    Only -inf is «too near»: REP 117 calls numbers below range_min errors.
    """
    z = scan.ranges.astype(np.float64)
    kinds = np.full(len(z), SAYS_NOTHING, np.int8)
    kinds[(z >= scan.range_min) & (z > 0)] = MEASURED
    kinds[z >= scan.range_max] = NO_RETURN
    kinds[z == -np.inf] = TOO_NEAR
    return kinds, np.where(kinds == TOO_NEAR, scan.range_min, np.where(kinds == NO_RETURN, scan.range_max, z))


def gather(
    scans: Iterable[tuple[Scan, Pose2D]], primitives: Sequence[Primitive], reach: float
) -> tuple[list[Beams], float, float]:
    """The rays that come within ``reach`` (m) of each primitive, the largest span of ranges, the most noise (m)."""
    centres = np.array([(one.x, one.y) for one in primitives]).reshape(-1, 2)
    gatherer = Gatherer(centres, np.array([one.circumradius + reach for one in primitives]))
    for scan, pose in scans:
        gatherer.add(scan, pose)
    return gatherer.beams(), gatherer.span, gatherer.most_noise


@dataclass(frozen=True)
class Backdrop:
    """Where (m) beams end in the map behind a primitive, which of them leave the map instead, and which end before
    they come near the primitive; a stop is known to within ``spread`` (m).
    """

    stops: FloatArray
    ends: NDArray[np.bool_]
    blocked: NDArray[np.bool_]
    spread: float

    def of(self, chosen: NDArray[np.bool_]) -> Backdrop:
        """What stands behind some of the beams."""
        return Backdrop(self.stops[chosen], self.ends[chosen], self.blocked[chosen], self.spread)


@dataclass(frozen=True)
class Obstacles:
    """How far (cells) it is in a map to what is occupied: ``clear`` (rows, cols), and where that lies."""

    clear: NDArray[np.uint8]
    frame: GridFrame

    @classmethod
    def of(cls, occupied: NDArray[np.bool_], frame: GridFrame) -> Obstacles:
        """Of a map's occupied cells (rows, cols)."""
        clear = np.empty(occupied.shape, np.uint8)
        clearances(occupied, clear)
        return cls(clear, frame)


def backdrop(beams: Beams, obstacles: Obstacles) -> Backdrop:
    """What stands behind a primitive whose cells are cleared; a cell tells it to within a cell."""
    stops, ends = np.zeros(len(beams)), np.zeros(len(beams), np.bool_)
    frame = obstacles.frame
    walk(obstacles.clear, frame.row, frame.col, 1 / frame.resolution, beams.rays, beams.far, stops, ends)
    return Backdrop(stops, ends, ends & (stops < beams.near), 0.5 * frame.resolution)


def map_says(beams: Beams, behind: Backdrop, sensor: Sensor) -> FloatArray:
    """The logarithm of the likelihood (N,) of what beams measured where they end in the map behind a primitive."""
    return np.asarray(np.log(explained(beams, behind.stops, behind.ends, behind.spread, sensor)))


def before(beams: Beams, behind: Backdrop, by_map: FloatArray, others: Sequence[Primitive], sensor: Sensor) -> Beams:
    """The beams with what they say where they miss a primitive: STOP and MISS, from other primitives and the map.

    ``by_map`` (N,) is what :func:`map_says`.
    """
    rays = beams.rays.copy()
    rays[STOP] = FAR
    rays[MISS] = by_map
    for other in others:
        stop_at(FAMILY[other.kind], parameters(other), other.circumradius, rays)
    shade(rays, beams.kinds, behind.stops, behind.blocked, sensor.std, sensor.table)
    return replace(beams, rays=rays)


def in_table(table: FloatArray, kinds: NDArray[np.int8], x: FloatArray) -> FloatArray:
    """Log-likelihoods (N,) at x (N,), to the nearest entry of the table."""
    reach = (table.shape[1] - 1) / 2
    place = np.clip(np.rint(x * TABLE_SPACING + reach), 0, 2 * reach).astype(np.intp)
    return np.asarray(table[kinds, place])


def explained(beams: Beams, stops: FloatArray, ends: NDArray[np.bool_], spread: float, sensor: Sensor) -> FloatArray:
    """The likelihood (N,) of what beams measured where they end in the map at ``stops``, or leave it there.

    A stop is known to within ``spread`` (m). A ray that leaves the map ends anywhere beyond, or nowhere.
    """
    z, kinds = beams.rays[RANGE], beams.kinds
    even = _peak_share(sensor.std, sensor.span)
    wide = math.hypot(sensor.std, spread)
    at_stop = np.exp(in_table(sensor.table, kinds, (stops - z) / wide))
    at_stop *= np.where(kinds == MEASURED, sensor.std / wide, 1.0)
    beyond = np.exp(in_table(sensor.table, np.full(len(z), NO_RETURN, np.int8), (z - stops) / sensor.std))
    left = np.where(
        kinds == MEASURED,
        (1 - NOTHING_BEYOND) * beyond * _peak_share(sensor.std, 1.0) / np.maximum(beams.far - stops, sensor.std),
        np.where(kinds == NO_RETURN, NOTHING_BEYOND, OUTLIERS),
    )
    unsure = np.where(kinds == MEASURED, even, 0.1)
    return np.asarray((1 - DOUBT) * np.where(ends, at_stop, left) + DOUBT * unsure)
