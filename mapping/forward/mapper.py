"""The forward mapper: a sensor model fitted to all rays by expectation-maximisation (idea: Thrun 2003).

Each cell has a chance to stop a ray that enters it. The map is the one, and the noise the one, that make the measured
ranges most likely: cells are not asked one by one whether a range speaks for them, so that the map stays sharp where
the noise is far larger than a cell. ``likelihood`` holds the model, ``sieve`` its prior, ``level`` one
pass; this file says in which order, and ``calibration`` turns the fit into probabilities of occupancy.
"""

from __future__ import annotations

import math
import os
from collections.abc import Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from mapping.forward.calibration import occupancy
from mapping.forward.level import (
    ALL,
    COLUMNS,
    NEGLIGIBLE,
    Choice,
    Level,
    Noise,
    Rays,
    Totals,
    cells_within,
    evidence_of,
    smoothing_width,
)
from mapping.grid import UNKNOWN, GridFrame, Layer, OccupancyGrid
from mapping.kernels import end_extent
from prim.errors import UsageError
from prim.scan import Scan
from prim.se2 import Pose2D
from prim.world import Bounds

START = 0.02
"""The chance of every cell to stop a ray, before there is any measurement."""

TOLERANCE, COARSE_TOLERANCE = 5e-4, 2e-3
"""A level has converged when a pass raises the mean log-likelihood of a ray by less: the last one, and the others."""

COARSEST = 8
"""The largest factor between the first level's cells and the map's."""

PASSES = {1: 6, 2: 10, 4: 16, 8: 16}
"""At most so many passes on the level whose cells are larger by a factor."""

POWER = 3
"""How often a pass multiplies the odds of a cell by their ratio: over-relaxation, taken back where it overshoots."""

MOST_START = 2.0
"""The fit begins with no less noise than neighbouring beams show, and with no more than this many times as much."""

THIN_RAYS = 20_000
THIN_STRIDE, HALF_STRIDE = 4, 2
"""Of more rays, the coarsest level takes every fourth and the next ones every second, until the last passes."""

LAST_PASSES = 3
"""At most so many passes over all rays, at the end."""

HELD_OUT_PASSES = 3
HELD_OUT_RAYS = 1000
"""The noise is found from rays that the map has not seen, unless there are fewer than this."""

SIEVE_SPREAD = 3.5
"""The sieve blurs the map, which takes about this many times its variance from the noise found (docs/forward.md)."""

LEAST_GIVEN = 0.3
"""Noise that is given counts as this many cells at least: a cell's centre is no nearer to the surface in it."""

MOST_CELLS = 50_000_000
NOISE_CELLS = 4_000_000
"""The largest map, and the largest on which only the noise is looked for."""

REVISITED = 256
"""While streaming, this many older rays are looked at again with each scan."""

STREAM_CELLS = 120_000
"""While streaming, the map is kept at half the resolution, or coarser where it would have more cells."""


@dataclass(frozen=True, slots=True)
class Fit:
    """What the forward model found, all arrays (rows, cols) float32.

    ``stopping``: each cell's chance to stop a ray that enters it; ``evidence``: how many rays came to it, expected
    hits and passes; ``certainty``: the mean over those of the chance that they came.
    """

    frame: GridFrame
    stopping: NDArray[np.float32]
    evidence: NDArray[np.float32]
    certainty: NDArray[np.float32]
    noise: Noise

    def grid(self) -> OccupancyGrid:
        """The calibrated probabilities of occupancy."""
        spread = self.noise.std / self.frame.resolution
        return OccupancyGrid(
            self.frame, occupancy(self.stopping, self.certainty, self.evidence, spread), self.evidence
        )


class ForwardMapper:
    """Fits the chance of every cell to stop a ray, and the sensor's noise, to all rays together.

    ``noise_std`` (m) fixes the noise; else it is found from the rays, whatever ``start_std`` it is told to begin with
    (by default what neighbouring beams show). Bounds as in :class:`mapping.deterministic.DeterministicMapper`.
    ``threads`` work side by side (by default one for each core) and give the same bits in any number.

    While scans stream in, a coarser map (of at most ``stream_cells``) is kept up to date with a bounded amount of
    work for each; ``grid()`` is made of it, ``finish()`` fits from coarse to fine until TOLERANCE or PASSES.
    """

    name = "forward"

    def __init__(
        self,
        resolution: float = 0.01,
        bounds: Bounds | None = None,
        noise_std: float | None = None,
        start_std: float | None = None,
        threads: int | None = None,
        stream_cells: int = STREAM_CELLS,
    ) -> None:
        self.resolution = resolution
        if noise_std is not None and not 0 < noise_std < math.inf:
            raise UsageError(f"the noise is {noise_std:g}: it must be above 0")
        self._layer = Layer(resolution, bounds, 0, np.uint8)
        check_size(self._layer.frame)
        self._fixed = noise_std
        self._start = start_std
        self._rays = Rays()
        self._threads = threads or cores()
        self._stream_cells = stream_cells
        self._stream: Stream | None = None
        self._noise = Noise(noise_std or start_std or 10 * resolution)
        self._learned = False
        self.history: list[tuple[int, Totals]] = []

    @property
    def noise_std(self) -> float | None:
        """The noise (m) that was given, or found so far; None where too few rays were stopped to find it.

        What the sieve takes from it is added to what the fit sees. Noise that is smaller than a cell cannot be told
        from the cell: up to about 0.6 of its side is found where there is none.
        """
        if self._fixed is not None:
            return self._fixed
        if not self._learned:
            return None
        width = smoothing_width(self._noise.std, self.resolution)
        share = SIEVE_SPREAD * width**2 if width >= 0.3 * self.resolution else 0.0
        return math.sqrt(self._noise.std**2 + share)

    @property
    def wild_share(self) -> float:
        """The share of measurements that have nothing to do with the map."""
        return self._noise.wild

    def update(self, scan: Scan, pose: Pose2D) -> None:
        """Adds one scan, or the next part of one, taken by a laser at ``pose`` in the map frame.

        The map so far takes up further parts with the next scan.
        """
        if not self.keep(scan, pose) or scan.first_beam:
            return
        frame = self._stream_frame()
        if self._stream is None:
            self._noise = self._first_noise(frame.resolution)
        if self._stream is None or self._stream.level.frame != frame:
            self._stream = Stream(frame, self._stream)
        self._noise = self._stream.take(self._rays, self._noise, self._fixed is not None)
        self._learned = self._learned or self._stream.learned

    def keep(self, scan: Scan, pose: Pose2D) -> bool:
        """Keeps a scan for :meth:`finish` without looking at it now; whether it says anything."""
        if not self._layer.fixed:
            place = (pose.x, pose.y, math.cos(pose.theta), math.sin(pose.theta))
            limits = (scan.range_min, scan.range_max)
            self._layer.cover(*end_extent(scan.ranges, scan.directions, place, limits, 1 / self.resolution))
            check_size(self._layer.frame)
        return self._rays.add(scan, pose) > 0

    def grid(self) -> OccupancyGrid:
        """The map so far, from the coarser one that is kept while scans come in."""
        frame = self._frame()
        if self._stream is None:
            unknown = np.full(frame.shape, UNKNOWN, np.float32)
            return OccupancyGrid(frame, unknown, np.zeros_like(unknown))
        coarse = self._stream.fit(self._noise).grid()
        cells = cells_within(coarse.frame, frame)
        ratio = coarse.frame.resolution / frame.resolution
        assert coarse.evidence is not None
        return OccupancyGrid(frame, coarse.probability[cells], coarse.evidence[cells] / np.float32(ratio))

    def so_far(self) -> tuple[Level, Noise] | None:
        """The coarser map that is kept while scans come in, and the noise; None before there is any."""
        return None if self._stream is None else (self._stream.level, self._noise)

    def finish(self) -> OccupancyGrid:
        """The map of all scans, fitted until nothing changes much."""
        return self.fit().grid()

    def fit(self) -> Fit:
        """The fit itself, before it is turned into occupancy."""
        with workers(self._threads) as pool:
            level, self._noise = self._fit(pool, self._frame())
            return self._read(level, self._noise)

    def settle(self) -> None:
        """Fits the coarser map that is kept while scans come in to all of them so far, as :meth:`finish` would."""
        finest, coarse = self._layer.frame, self._stream_frame()
        with workers(self._threads) as pool:
            level, self._noise = self._fit(pool, finest, round(coarse.resolution / finest.resolution))
        self._stream = Stream(coarse, None)
        self._stream.begin_from(level, self._rays, self._noise)

    def _frame(self) -> GridFrame:
        return self._layer.used or self._layer.frame

    def _stream_frame(self) -> GridFrame:
        frame, factor = self._layer.frame, 2
        while frame.rows * frame.cols > self._stream_cells * factor**2:
            factor *= 2
        return coarser(frame, factor)

    def _first_noise(self, resolution: float) -> Noise:
        """The noise to begin with: as given (no less than the cells show), else what neighbouring beams say."""
        if self._fixed is not None:
            return Noise(max(self._fixed, LEAST_GIVEN * resolution))
        guess = max(neighbour_noise(self._rays.rays[:, 2]) or 0.0, self.resolution)
        return Noise(min(max(self._start or guess, guess), MOST_START * guess))

    def _fit(self, pool: ThreadPoolExecutor | None, frame: GridFrame, last: int = 1) -> tuple[Level, Noise]:
        """From coarse to fine, down to cells ``last`` times the frame's; then the noise from rays held out, and the
        map from all of them.
        """
        self.history.clear()
        self._learned = False
        learns, many = self._fixed is None, len(self._rays) > THIN_RAYS
        holds_out = learns and len(self._rays) >= HELD_OUT_RAYS
        noise = self._first_noise(self.resolution)
        guess = neighbour_noise(self._rays.rays[:, 2]) or 0.0
        level: Level | None = None
        spread = noise.std / self.resolution
        for factor in [factor for factor in factors(spread) if factor >= last] or [last]:
            finer = Level(coarser(frame, factor), START * factor, pool)
            noise = noise if learns else self._first_noise(finer.frame.resolution)
            finer.smooth(noise.std)
            if level is not None:
                finer.start_from(level)
                finer.keep_free(self._rays)
            stride = (THIN_STRIDE if level is None else HALF_STRIDE) if many else 1
            noise = self._climb(finer, factor, Choice(stride=stride, held_out=1 if holds_out else 0), noise, learns)
            level = finer
        assert level is not None
        if holds_out:
            noise = self._held_out_noise(level, noise)
        elif learns:
            noise = Noise(max(noise.std, guess), noise.wild)
        if learns or many:
            noise = self._climb(level, 1, ALL, noise, False, LAST_PASSES)
        level.free_all()
        return level, noise

    def _climb(
        self, level: Level, factor: int, choice: Choice, noise: Noise, learns: bool, most: int | None = None
    ) -> Noise:
        """Passes over one level until it has converged; a step that overshot is taken back, and made plain."""
        power, best = POWER, -math.inf
        kept: tuple[NDArray[np.float32], NDArray[np.float32], Totals, Noise] | None = None
        passes = most or PASSES[factor]
        for count in range(1, passes + 1):
            sums, totals = level.expect(self._rays, noise, choice)
            if kept is not None and totals.per_ray < best and power > 1:
                parameters, sums, totals, noise = kept
                level.restore(parameters)
                power = 1
            elif totals.per_ray - best < (TOLERANCE if factor == 1 else COARSE_TOLERANCE):
                break
            else:
                self.history.append((factor, totals))
            best = totals.per_ray
            kept = level.parameters.copy(), sums, totals, noise
            level.maximize(sums, power if count < passes else 1)
            if learns:
                noise = totals.noise(noise, level.frame.resolution)
                self._learned = totals.tell_noise
        return noise

    def _held_out_noise(self, level: Level, noise: Noise) -> Noise:
        """The noise that makes the rays most likely which the map has not seen."""
        for _ in range(HELD_OUT_PASSES):
            _, totals = level.expect(self._rays, noise, Choice(held_out=-1))
            noise = totals.noise(noise, level.frame.resolution)
        return noise

    def _read(self, level: Level, noise: Noise) -> Fit:
        """What all rays say about a level's map."""
        sums, _ = level.expect(self._rays, noise, certain=True)
        return read(level, sums, noise)


def read(level: Level, sums: NDArray[np.float32], noise: Noise) -> Fit:
    """A level's map with what an E step says about it."""
    evidence, certainty = evidence_of(sums)
    shape = level.frame.shape
    return Fit(level.frame, level.stopping, evidence.reshape(shape), certainty.reshape(shape), noise)


class Stream:
    """The coarser map that is kept while scans come in: each is looked at together with some older rays."""

    def __init__(self, frame: GridFrame, before: Stream | None) -> None:
        self.level = Level(frame, START * 2)
        self.level.blocks = 1
        self._sums = np.zeros((1, self.level.parameters.size, COLUMNS), np.float32)
        self._done = self._next = 0
        self.learned = False
        if before is not None and before.level.frame.resolution == frame.resolution:  # else it begins anew
            self.level.adopt(before.level)
            self._done, self._next = before._done, before._next
            self._place(before)

    def _place(self, before: Stream) -> None:
        """Takes over the sums of a smaller map."""
        window = self.level.frame.window(before.level.frame)
        rows, cols = self.level.frame.shape
        self._sums.reshape(rows, cols, COLUMNS)[window] = before._sums.reshape(*before.level.frame.shape, COLUMNS)

    def fit(self, noise: Noise) -> Fit:
        """The map so far, at this level's resolution."""
        return read(self.level, self._sums, noise)

    def begin_from(self, fitted: Level, rays: Rays, noise: Noise) -> None:
        """Takes over a fitted map with the same cells, and what all rays say of it."""
        self.level.smooth(noise.std)
        self.level.restore(np.maximum(fitted.parameters, np.float32(NEGLIGIBLE)))  # what is 0 would stay 0
        self._sums, totals = self.level.expect(rays, noise, certain=True)
        self._done, self._next = len(rays), 0
        self.learned = totals.tell_noise

    def take(self, rays: Rays, noise: Noise, fixed: bool) -> Noise:
        """Looks at the newest rays and at some old ones, makes one M step, and returns the noise so far.

        Stepwise expectation-maximisation: the sums always stand for all rays, the newest look at each counting in
        full and earlier looks fading.
        """
        new = Choice(begin=self._done, end=len(rays))
        old = Choice(begin=self._next, end=min(self._next + REVISITED, self._done))
        self.level.smooth(noise.std)
        revisited = (old.end or 0) - old.begin
        if self._done:
            self._sums *= np.float32(1 - revisited / self._done)
        found = []
        for choice in (old, new):
            if choice.end is not None and choice.end > choice.begin:
                sums, totals = self.level.expect(rays, noise, choice, certain=True)
                self._sums += sums
                found.append(totals)
        self.level.maximize(self._sums)
        self._next = old.end if old.end is not None and old.end < self._done else 0
        self._done = len(rays)
        if fixed or not found:
            return noise
        self.learned = any(totals.tell_noise for totals in found)
        both = Totals(*(sum(values) for values in zip(*(_values(totals) for totals in found), strict=True)))
        return _between(noise, both.noise(noise, self.level.frame.resolution))


def _values(totals: Totals) -> tuple[float, int, float, float, float]:
    return totals.log_likelihood, totals.rays, totals.stops, totals.squares, totals.wild


def _between(old: Noise, new: Noise) -> Noise:
    """The geometric mean of two steps' noise, so that one odd scan does not throw it."""
    return Noise(math.sqrt(old.std * new.std), math.sqrt(old.wild * new.wild))


def find_noise(scans: Iterable[tuple[Scan, Pose2D]], frame: GridFrame) -> float | None:
    """The sensor's noise (m), found from scans and the poses of their laser on a map of ``frame``; None if it cannot.

    A map of more than NOISE_CELLS is made of larger cells.
    """
    factor = 1
    while frame.rows * frame.cols > NOISE_CELLS * factor**2:
        factor *= 2
    frame = coarser(frame, factor)
    mapper = ForwardMapper(frame.resolution, frame.bounds)
    for scan, pose in scans:
        mapper.keep(scan, pose)
    mapper.fit()
    return mapper.noise_std


def check_size(frame: GridFrame) -> None:
    """Raises UsageError for a map that would not fit the memory: the fit takes some 80 bytes for each cell."""
    if frame.rows * frame.cols > MOST_CELLS:
        raise UsageError(
            f"a map of {frame.rows * frame.cols / 1e6:.0f} million cells is too large for --mapper forward "
            f"(at most {MOST_CELLS / 1e6:.0f} million): give a coarser --resolution or smaller --bounds"
        )


def cores() -> int:
    """How many cores this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


@contextmanager
def workers(threads: int) -> Iterator[ThreadPoolExecutor | None]:
    """A pool of threads for the time being; none where one is enough."""
    if threads == 1:
        yield None
        return
    with ThreadPoolExecutor(threads) as pool:
        yield pool


def coarser(frame: GridFrame, factor: int) -> GridFrame:
    """The frame of cells larger by ``factor``, on whole multiples of their size, that covers another."""
    row, col = frame.row // factor, frame.col // factor
    rows = -(-(frame.row + frame.rows) // factor) - row
    cols = -(-(frame.col + frame.cols) // factor) - col
    return GridFrame(frame.resolution * factor, row, col, rows, cols)


def factors(spread: float) -> list[int]:
    """The levels' factors for noise of ``spread`` cells, coarse to fine."""
    factor = 4
    while factor < COARSEST and 4 * factor < spread:
        factor *= 2
    return [factor >> k for k in range(factor.bit_length())]


def neighbour_noise(ranges: NDArray[np.float32]) -> float | None:
    """A guess at the noise (m) from the differences of neighbouring beams; None where there are no two."""
    apart = np.diff(ranges[np.isfinite(ranges)])
    if not len(apart):
        return None
    return float(np.median(np.abs(apart))) * 1.4826 / math.sqrt(2)
