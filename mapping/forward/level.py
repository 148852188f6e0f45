"""One resolution of the forward mapper: its parameters, and the passes of expectation-maximisation over them."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mapping.forward.likelihood import (
    CERTAIN,
    HITS,
    LOG_LIKELIHOOD,
    PASSES,
    RAYS,
    SQUARES,
    STOPS,
    WILD,
    expect,
    find_leads,
    tables,
)
from mapping.forward.sieve import LEAST, MOST, blur, borders, gather, maximize, normalise, taps
from mapping.grid import GridFrame
from mapping.morphology import dilate
from prim.arrays import FloatArray
from prim.scan import Scan
from prim.se2 import Pose2D

LEAST_BLOCKS, MOST_BLOCKS = 2, 8
BLOCK_CELLS = 4_000_000
"""Sums are kept for so many blocks of rays, for the fewer the larger the grid: about this many cells in all.

The number of blocks depends on the grid alone, and they are added up in order: any number of threads gives the same
bits.
"""

SMOOTHING = 0.3
"""The sieve's Gaussian is SMOOTHING * sqrt(sigma * resolution) wide: found by measuring (docs/forward.md)."""

NEGLIGIBLE = 1e-4
"""Cells that a coarser level gives no larger chance to stop a ray are left free by the finer ones."""

LEAST_WILD, MOST_WILD = 1e-4, 0.3
"""The bounds of the share of wild measurements."""

LEAST_NOISE = 0.15
"""The noise is never taken as smaller than this many cells."""

COLUMNS = 3
"""Sums are kept of hits, of passes and, where it is asked for, of how certain those are."""

MOST_NOISE = 5.0
"""Nor as larger than this (m)."""

LEAST_STOPS = 5.0
"""Nothing is learned about the noise from fewer rays that were stopped."""

FARTHEST = 1000.0
"""A sensor without a range_max is taken to see this far (m)."""

_TABLE = tables()
_NO_LEADS = np.zeros(0, np.int32)


@dataclass(frozen=True, slots=True)
class Noise:
    """What the sensor adds: Gaussian noise of ``std`` metres, and a share of ``wild`` measurements."""

    std: float
    wild: float = LEAST_WILD


@dataclass(frozen=True, slots=True)
class Totals:
    """Sums over rays of one E step: log-likelihood, their number, and what the noise is found from."""

    log_likelihood: float
    rays: int
    stops: float
    squares: float
    wild: float

    @property
    def per_ray(self) -> float:
        """The mean log-likelihood of a ray."""
        return self.log_likelihood / self.rays if self.rays else 0.0

    @property
    def tell_noise(self) -> bool:
        """Whether enough rays were stopped to learn the noise from them."""
        return self.stops >= LEAST_STOPS

    def noise(self, before: Noise, resolution: float) -> Noise:
        """The M step of the noise."""
        if not self.tell_noise:
            return before
        std = before.std * math.sqrt(self.squares / self.stops)
        wild = min(max(self.wild / self.rays, LEAST_WILD), MOST_WILD)
        return Noise(min(max(std, LEAST_NOISE * resolution), MOST_NOISE), wild)


class Rays:
    """All rays so far, 12 bytes each, and the scans that they belong to.

    ``rays``, ``scans`` and ``first`` are as :func:`mapping.forward.likelihood.expect` takes them.
    """

    def __init__(self) -> None:
        self._rays = np.empty((0, 3), np.float32)
        self._scans = np.empty((0, 4), np.float64)
        self._first = np.zeros(1, np.int64)
        self._count = 0

    def __len__(self) -> int:
        return int(self._first[self._count])

    @property
    def rays(self) -> NDArray[np.float32]:
        """Directions in the plane and ranges."""
        return self._rays[: len(self)]

    @property
    def scans(self) -> FloatArray:
        """Sensor's x, y, range_min, range_max of every scan."""
        return self._scans[: self._count]

    @property
    def first(self) -> NDArray[np.int64]:
        """Where each scan's rays begin, and where the last one's end."""
        return self._first[: self._count + 1]

    def add(self, scan: Scan, pose: Pose2D) -> int:
        """Adds a scan's measurements; returns how many.

        Those are ranges within the limits, -inf (nearer than range_min, as REP 117 has it) and ranges of range_max
        and more (no return). NaN and numbers below range_min say nothing.
        """
        z = scan.ranges
        with np.errstate(invalid="ignore"):
            used = ((z >= scan.range_min) & (z > 0)) | (np.isneginf(z) & (scan.range_min > 0))
        cos, sin = math.cos(pose.theta), math.sin(pose.theta)
        directions = scan.directions[used] @ np.array([[cos, sin], [-sin, cos]])
        count = len(directions)
        begin, end = len(self), len(self) + count
        self._rays = _grown(self._rays, end)
        self._scans = _grown(self._scans, self._count + 1)
        self._first = _grown(self._first, self._count + 2)
        self._rays[begin:end, :2] = directions
        self._rays[begin:end, 2] = np.where(z[used] >= scan.range_max, np.inf, z[used])
        self._scans[self._count] = pose.x, pose.y, max(scan.range_min, 0.0), min(scan.range_max, FARTHEST)
        self._count += 1
        self._first[self._count] = end
        return count


def _grown(array: NDArray[Any], length: int) -> NDArray[Any]:
    """The array, or a copy with room for twice as many rows where it has fewer than ``length``."""
    if len(array) >= length:
        return array
    grown = np.empty((max(2 * len(array), length), *array.shape[1:]), array.dtype)
    grown[: len(array)] = array
    return grown


@dataclass(frozen=True, slots=True)
class Choice:
    """Which rays a pass takes: ``begin`` to ``end``, every ``stride``-th.

    Without those held out (``held_out`` 1), only those (-1), or all (0).
    """

    begin: int = 0
    end: int | None = None
    stride: int = 1
    held_out: int = 0


ALL = Choice()


class Level:
    """A map of stopping chances at one resolution.

    ``parameters`` (rows, cols) float32 are the sieve's, ``stopping`` the chances they make: their weighted mean over
    neighbours.
    """

    def __init__(self, frame: GridFrame, start: float, pool: ThreadPoolExecutor | None = None) -> None:
        self.frame = frame
        self._pool = pool
        self.parameters = np.full(frame.shape, start, np.float32)
        self.stopping = self.parameters.copy()
        self._active = np.ones(frame.shape, np.bool_)
        self._leads: NDArray[np.int32] | None = None
        self._hits, self._passes, self._blurred, self._between = (np.empty(frame.shape, np.float32) for _ in range(4))
        self.blocks = max(LEAST_BLOCKS, min(MOST_BLOCKS, BLOCK_CELLS // (frame.rows * frame.cols)))
        self.smooth(0.0)

    @property
    def _corner(self) -> FloatArray:
        return np.array(self.frame.origin)

    def smooth(self, std: float) -> None:
        """Sets the sieve's width for noise of ``std`` metres."""
        self._taps = taps(smoothing_width(std, self.frame.resolution) / self.frame.resolution)
        self._row_sums = borders(self.frame.rows, self._taps)
        self._col_sums = borders(self.frame.cols, self._taps)
        self._spread()

    def start_from(self, coarser: Level) -> None:
        """Takes over a coarser level's map: a ray that crosses one of its cells crosses several here."""
        ratio = round(coarser.frame.resolution / self.frame.resolution)
        finer = coarser.parameters[cells_within(coarser.frame, self.frame)]
        self.parameters = np.clip(1 - (1 - finer) ** np.float32(1 / ratio), LEAST, MOST).astype(np.float32)
        self._spread()

    def adopt(self, smaller: Level) -> None:
        """Takes over the map of a level with the same cells on a smaller frame."""
        self.parameters[self.frame.window(smaller.frame)] = smaller.parameters
        self._spread()

    def restore(self, parameters: NDArray[np.float32]) -> None:
        """Goes back to parameters that it had."""
        self.parameters = parameters
        self._spread()

    def keep_free(self, rays: Rays) -> None:
        """Leaves cells that stop next to nothing free for good, and passes over them where rays begin."""
        self._active = self.parameters > NEGLIGIBLE
        self.parameters[~self._active] = 0
        marked = dilate(self._active, len(self._taps) // 2)
        leads = np.zeros(len(rays), np.int32)
        scans, first, resolution = rays.scans, rays.first, self.frame.resolution
        self._in_blocks(
            lambda block, begin, end: find_leads(
                scans, first, rays.rays, begin, end, self._corner, resolution, marked, leads
            ),
            0,
            len(rays),
        )
        self._leads = leads
        self._spread()

    def free_all(self) -> None:
        """Takes back :meth:`keep_free`."""
        self._active[:] = True
        self._leads = None

    def expect(
        self, rays: Rays, noise: Noise, choice: Choice = ALL, certain: bool = False
    ) -> tuple[NDArray[np.float32], Totals]:
        """The E step: ``sums`` (blocks, rows * cols, 3 or 2), as the kernel ``expect`` fills them."""
        sums = np.zeros((self.blocks, self.parameters.size, COLUMNS if certain else COLUMNS - 1), np.float32)
        totals = np.zeros((self.blocks, 6))
        leads = self._leads if self._leads is not None else _NO_LEADS
        scans, first, resolution = rays.scans, rays.first, self.frame.resolution

        def run(block: int, begin: int, end: int) -> None:
            expect(
                scans,
                first,
                rays.rays,
                begin,
                end,
                choice.stride,
                choice.held_out,
                self._corner,
                resolution,
                self.stopping,
                leads,
                noise.std,
                noise.wild,
                _TABLE,
                sums[block],
                totals[block],
            )

        self._in_blocks(run, choice.begin, len(rays) if choice.end is None else choice.end)
        total = totals.sum(axis=0)
        return sums, Totals(total[LOG_LIKELIHOOD], int(total[RAYS]), total[STOPS], total[SQUARES], total[WILD])

    def maximize(self, sums: NDArray[np.float32], power: int = 1) -> None:
        """The M step of the map; over-relaxed where ``power`` is above 1."""
        gather(sums, self.stopping, self._row_sums, self._col_sums, self._hits, self._passes)
        if len(self._taps) > 1:
            for array in (self._hits, self._passes):
                blur(array, self._taps, self._between, self._blurred)
                array[:] = self._blurred
        maximize(self.parameters, self._active, self._hits, self._passes, power)
        self._spread()

    def _spread(self) -> None:
        """Makes the stopping chances of the parameters."""
        if len(self._taps) == 1:
            np.clip(self.parameters, LEAST, MOST, out=self.stopping)
            return
        blur(self.parameters, self._taps, self._between, self.stopping)
        normalise(self.stopping, self._row_sums, self._col_sums)

    def _in_blocks(self, run: Callable[[int, int, int], None], begin: int, end: int) -> None:
        """Calls ``run`` for each block of rays, in threads where there is a pool."""
        edges = np.linspace(begin, end, self.blocks + 1).astype(np.int64)
        spans: Iterable[tuple[int, int, int]] = list(zip(range(self.blocks), edges[:-1], edges[1:], strict=True))
        if self._pool is None:
            for span in spans:
                run(*span)
        else:
            list(self._pool.map(lambda span: run(*span), spans))


def cells_within(coarse: GridFrame, fine: GridFrame) -> tuple[NDArray[np.signedinteger[Any]], ...]:
    """The index into a coarse frame's arrays that gives each of a finer frame's cells the cell it lies in."""
    ratio = round(coarse.resolution / fine.resolution)
    rows = (np.arange(fine.rows) + fine.row) // ratio - coarse.row
    cols = (np.arange(fine.cols) + fine.col) // ratio - coarse.col
    return np.ix_(rows, cols)


def smoothing_width(std: float, resolution: float) -> float:
    """The sieve's standard deviation (m) at noise of ``std`` metres."""
    return SMOOTHING * math.sqrt(std * resolution)


def evidence_of(sums: NDArray[np.float32]) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Each cell's evidence (expected hits and passes), and the mean chance of those rays to have come there."""
    added = sums.sum(axis=0)
    evidence = added[:, HITS] + added[:, PASSES]
    return evidence, added[:, CERTAIN] / np.maximum(evidence, np.float32(1e-9))
