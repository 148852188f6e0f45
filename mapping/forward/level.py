"""One resolution level of the forward mapper: its rays, its parameters, and its E and M steps.

The sensor model and the E step's kernel are in :mod:`mapping.forward.likelihood`, the sieve and the M step's kernel
in :mod:`mapping.forward.sieve`.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from enum import IntEnum
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from mapping.forward.likelihood import (
    DROPOUTS,
    HITS,
    LOG_LIKELIHOOD,
    OUTLIERS,
    PASSES,
    RAYS,
    SQUARES,
    SQUARES_OF_ARRIVAL,
    STOPS,
    TOTALS,
    RayModel,
    count_skips,
    expect,
    noise_tables,
)
from mapping.forward.options import DEFAULTS, ForwardOptions
from mapping.forward.sieve import convolve, gaussian_kernel, kernel_sums, maximize, normalize, reduce_blocks
from mapping.grid import GridFrame
from mapping.kernels import Fields
from mapping.morphology import dilate
from prim.scan import Scan
from prim.se2 import Pose2D, rotate

MIN_BLOCKS, MAX_BLOCKS = 2, 8
BLOCK_CELLS = 4_000_000
"""The E step's sums are computed for this many blocks of rays: fewer on larger grids, for about BLOCK_CELLS cells in
all. The number depends on the grid alone, and blocks are added up in order, so that any number of threads gives the
same bits."""

COLUMNS = 3
"""Columns of the E step's sums with SQUARES_OF_ARRIVAL; without it there is one less."""

_TABLE = noise_tables()
_NO_SKIPS = np.zeros(0, np.int32)


class RangeNoise(NamedTuple):
    """Range noise: Gaussian, with a share of outliers, and of rays that return nothing.

    Attributes:
        std: Standard deviation sigma (m).
        outlier_share: The share epsilon of outliers.
        dropout_share: The share delta of dropouts among the rays that end in the grid; 0 where every ray returned.
    """

    std: float
    outlier_share: float
    dropout_share: float = 0.0


@dataclass(frozen=True, slots=True)
class SufficientStatistics:
    """Expected complete-data sufficient statistics of the range noise: what its M step needs of an E step.

    Stops, squares and outliers are expectations under the responsibilities; the log-likelihood is that of the
    observed ranges.

    Attributes:
        log_likelihood: Log-likelihood of the rays' measurements (nats).
        rays: Number of rays that cross the grid.
        stops: Expected number of rays that stop in the grid and are no dropouts.
        squares: Expected sum of their squared residuals (z - s)^2, in sigma^2.
        outliers: Expected number of outliers.
        dropouts: Expected number of rays that stop in the grid and return nothing.
    """

    log_likelihood: float
    rays: int
    stops: float
    squares: float
    outliers: float
    dropouts: float = 0.0

    @property
    def mean_log_likelihood(self) -> float:
        """Mean log-likelihood of a ray (nats)."""
        return self.log_likelihood / self.rays if self.rays else 0.0

    def determines_noise(self, options: ForwardOptions = DEFAULTS) -> bool:
        """Return whether enough rays stopped to estimate the range noise from them."""
        return self.stops >= options.min_stops

    def range_noise(self, previous: RangeNoise, resolution: float, options: ForwardOptions = DEFAULTS) -> RangeNoise:
        """Compute the M step of the range noise.

        Args:
            previous: The noise of the E step.
            resolution: Side of a cell (m).
            options: The estimate's bounds.

        Returns:
            The estimate; the standard deviation and the outlier share of ``previous`` where too few rays stopped.
        """
        previous = self.with_dropouts(previous, options)
        if not self.determines_noise(options):
            return previous
        std = previous.std * math.sqrt(self.squares / self.stops)
        share = min(max(self.outliers / self.rays, options.min_outlier_share), options.max_outlier_share)
        std = min(max(std, options.min_noise_cells * resolution), options.max_noise)
        return RangeNoise(std, share, previous.dropout_share)

    def with_dropouts(self, previous: RangeNoise, options: ForwardOptions = DEFAULTS) -> RangeNoise:
        """Compute the M step of the share of dropouts alone.

        Args:
            previous: The noise of the E step.
            options: The estimate's bounds.

        Returns:
            ``previous`` with that share; itself where every ray returned.
        """
        if not previous.dropout_share:
            return previous
        share = self.dropouts / max(self.stops + self.dropouts, options.min_stops)
        share = min(max(share, options.min_dropout_share), options.max_dropout_share)
        return previous._replace(dropout_share=share)


class RayStore:
    """All rays so far, up to 16 bytes each with their scans; grows in amortised constant time."""

    def __init__(self, max_range: float = DEFAULTS.max_range) -> None:
        """Start without rays.

        Args:
            max_range: The range_max (m) of sensors that have none.
        """
        self._rays = np.empty((0, 3), np.float32)
        self._scans = np.empty((0, 4), np.float64)
        self._first = np.zeros(1, np.int64)
        self._count = 0
        self._no_returns = 0
        self._max_range = max_range

    def __len__(self) -> int:
        return int(self._first[self._count])

    @property
    def ranges(self) -> NDArray[np.float32]:
        """Ranges (N,) in m; -inf: nearer than range_min, inf: no return."""
        return self._rays[: len(self), 2]

    @property
    def share_without_return(self) -> float:
        """Share of the rays that returned nothing; 0 without any."""
        return self._no_returns / max(len(self), 1)

    @property
    def arrays(self) -> Fields:
        """The fields of :class:`mapping.forward.likelihood.RayArrays`, as a plain tuple."""
        count = self._count
        return self._scans[:count], self._first[: count + 1], self._rays[: len(self)]

    def add(self, scan: Scan, pose: Pose2D) -> int:
        """Add a scan's measurements, see :meth:`prim.scan.Scan.censored_ranges`.

        Args:
            scan: The scan.
            pose: Pose of the laser in the map frame.

        Returns:
            The number of measurements.
        """
        used, ranges = scan.censored_ranges()
        directions = rotate(scan.directions[used], pose.theta)
        count = len(directions)
        begin, end = len(self), len(self) + count
        for array, rows in ((self._rays, end), (self._scans, self._count + 1), (self._first, self._count + 2)):
            _grow(array, rows)
        self._rays[begin:end, :2] = directions
        self._rays[begin:end, 2] = ranges
        self._scans[self._count] = pose.x, pose.y, max(scan.range_min, 0.0), min(scan.range_max, self._max_range)
        self._count += 1
        self._no_returns += int(np.count_nonzero(ranges == np.inf))
        self._first[self._count] = end
        return count

    def trim(self) -> None:
        """Give back the room for further rays."""
        _trim(self._rays, len(self))
        _trim(self._scans, self._count)
        _trim(self._first, self._count + 1)


def _trim(array: NDArray[Any], length: int) -> None:
    """Leave an array ``length`` rows, and give the rest back. No view of it may be in use."""
    if len(array) > length:
        array.resize((length, *array.shape[1:]), refcheck=False)


def _grow(array: NDArray[Any], length: int) -> None:
    """Make room in an array for ``length`` rows, and some more, where it has fewer.

    Arrays that are large enough for that are moved by the operating system, and never there twice. No view of the
    array may be in use.
    """
    if len(array) < length:
        rows = max(len(array) * 9 // 8, length, 4096)
        array.resize((rows, *array.shape[1:]), refcheck=False)


class Fold(IntEnum):
    """Which rays an E step takes with respect to those that are held out."""

    ALL = 0
    FITTED = 1
    HELD_OUT = -1


@dataclass(frozen=True, slots=True)
class RaySubset:
    """The rays that an E step takes.

    Attributes:
        begin: Index of the first ray.
        end: Index after the last ray; None: all from ``begin`` on.
        stride: Every ``stride``-th ray is taken.
        fold: All of these, those that are not held out, or those that are.
    """

    begin: int = 0
    end: int | None = None
    stride: int = 1
    fold: Fold = Fold.ALL


ALL_RAYS = RaySubset()


def sensor_fields(noise: RangeNoise, rays: RayModel) -> Fields:
    """Return the fields of :class:`mapping.forward.likelihood.SensorModel`.

    Args:
        noise: The range noise.
        rays: The parameters that are not estimated.

    Returns:
        The fields, as a plain tuple.
    """
    return noise.std, noise.outlier_share, noise.dropout_share, tuple(rays), _TABLE


def geometry_fields(frame: GridFrame) -> Fields:
    """Return the fields of :class:`mapping.forward.likelihood.GridGeometry`, as a plain tuple."""
    return *frame.origin, frame.resolution


class Level:
    """A map of stopping probabilities at one resolution.

    Attributes:
        frame: Where its cells lie.
        parameters: The sieve's parameters p (rows, cols) float32.
        stopping: The stopping probabilities o = K p (rows, cols) float32.
        blocks: Number of blocks of rays that the E step's sums are computed for.
    """

    def __init__(
        self,
        frame: GridFrame,
        start: float,
        pool: ThreadPoolExecutor | None = None,
        options: ForwardOptions = DEFAULTS,
    ) -> None:
        """Start with equal parameters and without smoothing.

        Args:
            frame: Where its cells lie.
            start: Value of all parameters.
            pool: Threads that the blocks of an E step are distributed to; None: the caller's alone.
            options: Options of the sieve and of the sensor model.
        """
        self.frame = frame
        self.options = options
        self._pool = pool
        self.parameters = np.full(frame.shape, start, np.float32)
        self.stopping = self.parameters.copy()
        self._active = np.ones(frame.shape, np.bool_)
        self._skip: NDArray[np.int32] | None = None
        arrays = (np.empty(frame.shape, np.float32) for _ in range(4))
        self._hits, self._passes, self._convolved, self._scratch = arrays
        self._bounds = np.float32(options.min_stopping), np.float32(options.max_stopping)
        self._geometry = geometry_fields(frame)
        self.blocks = max(MIN_BLOCKS, min(MAX_BLOCKS, BLOCK_CELLS // (frame.rows * frame.cols)))
        self.smooth(0.0)

    def smooth(self, std: float) -> None:
        """Set the sieve's width to that for range noise of standard deviation ``std`` (m)."""
        options = self.options
        width = smoothing_width(std, self.frame.resolution, options) / self.frame.resolution
        self._kernel = gaussian_kernel(width, options.min_smoothing_cells, options.kernel_truncation)
        self._row_sums = kernel_sums(self.frame.rows, self._kernel)
        self._col_sums = kernel_sums(self.frame.cols, self._kernel)
        self._update_stopping()

    def initialize_from(self, coarser: Level) -> None:
        """Start from a coarser level's map: a ray that crosses one of its cells crosses several of this level."""
        ratio = round(coarser.frame.resolution / self.frame.resolution)
        finer = coarser.parameters[coarse_cell_index(coarser.frame, self.frame)]
        low, high = self.options.min_stopping, self.options.max_stopping
        self.parameters = np.clip(1 - (1 - finer) ** np.float32(1 / ratio), low, high).astype(np.float32)
        self._update_stopping()

    def copy_from(self, smaller: Level) -> None:
        """Copy the parameters of a level of the same resolution whose frame lies within this one's."""
        self.parameters[self.frame.window(smaller.frame)] = smaller.parameters
        self._update_stopping()

    def set_parameters(self, parameters: NDArray[np.float32]) -> None:
        """Set the sieve's parameters (rows, cols)."""
        self.parameters = parameters
        self._update_stopping()

    def fix_free_cells(self, rays: RayStore) -> None:
        """Fix negligible parameters p at 0, and let these rays begin at the first cell that others contribute to.

        The stopping probability of the cells that are skipped is its lower bound, ``min_stopping``.
        """
        self._active = self.parameters > self.options.negligible_stopping
        self.parameters[~self._active] = 0
        marked = dilate(self._active, len(self._kernel) // 2)
        skip = np.zeros(len(rays), np.int32)
        arrays = rays.arrays
        self._in_blocks(
            lambda block, begin, end: count_skips(arrays, begin, end, self._geometry, marked, skip), 0, len(rays)
        )
        self._skip = skip
        self._update_stopping()

    def release_free_cells(self) -> None:
        """Undo :meth:`fix_free_cells`: all cells may change again, and no cells are skipped."""
        self._active[:] = True
        self._skip = None

    def expect(
        self, rays: RayStore, noise: RangeNoise, subset: RaySubset = ALL_RAYS, with_arrival: bool = False
    ) -> tuple[NDArray[np.float32], SufficientStatistics]:
        """Compute the E step.

        Args:
            rays: All rays.
            noise: The range noise.
            subset: The rays that are taken.
            with_arrival: Whether the sums get a third column, SQUARES_OF_ARRIVAL.

        Returns:
            The sums (blocks, rows * cols, 2 or 3) per cell, as :func:`mapping.forward.likelihood.expect` fills them;
            and the sums over rays.
        """
        sums = np.zeros((self.blocks, self.parameters.size, COLUMNS if with_arrival else COLUMNS - 1), np.float32)
        totals = np.zeros((self.blocks, TOTALS))
        skip = self._skip if self._skip is not None else _NO_SKIPS
        arrays, sensor = rays.arrays, sensor_fields(noise, self.options.ray_model)
        stride, fold, every = subset.stride, int(subset.fold), self.options.hold_out_every

        def run(block: int, begin: int, end: int) -> None:
            part = (begin, end, stride, fold, every)
            expect(arrays, part, self._geometry, self.stopping, skip, sensor, sums[block], totals[block])

        self._in_blocks(run, subset.begin, len(rays) if subset.end is None else subset.end)
        total = totals.sum(axis=0)
        statistics = SufficientStatistics(
            total[LOG_LIKELIHOOD], int(total[RAYS]), total[STOPS], total[SQUARES], total[OUTLIERS], total[DROPOUTS]
        )
        return sums, statistics

    def maximize(self, sums: NDArray[np.float32], power: int = 1) -> None:
        """Compute the M step of the map.

        Args:
            sums: The E step's sums (blocks, rows * cols, 2 or 3).
            power: Exponent of the odds ratio; above 1 the step is over-relaxed.
        """
        reduce_blocks(sums, self.stopping, self._row_sums, self._col_sums, self._hits, self._passes)
        if len(self._kernel) > 1:
            for array in (self._hits, self._passes):
                convolve(array, self._kernel, self._scratch, self._convolved)
                array[:] = self._convolved
        maximize(self.parameters, self._active, self._hits, self._passes, power, self._bounds)
        self._update_stopping()

    def _update_stopping(self) -> None:
        """Compute the stopping probabilities o = K p."""
        if len(self._kernel) == 1:
            np.clip(self.parameters, *self._bounds, out=self.stopping)
            return
        convolve(self.parameters, self._kernel, self._scratch, self.stopping)
        normalize(self.stopping, self._row_sums, self._col_sums, self._bounds)

    def _in_blocks(self, run: Callable[[int, int, int], None], begin: int, end: int) -> None:
        """Call ``run(block, begin, end)`` for each block of rays, in threads where there is a pool."""
        edges = np.linspace(begin, end, self.blocks + 1).astype(np.int64)
        spans: Iterable[tuple[int, int, int]] = list(zip(range(self.blocks), edges[:-1], edges[1:], strict=True))
        if self._pool is None:
            for span in spans:
                run(*span)
        else:
            list(self._pool.map(lambda span: run(*span), spans))


def coarse_cell_index(coarse: GridFrame, fine: GridFrame) -> tuple[NDArray[np.signedinteger[Any]], ...]:
    """Return the index into a coarse frame's array that gives each cell of a finer frame the cell that it lies in.

    Args:
        coarse: The coarse frame; covers the fine one.
        fine: The fine frame.

    Returns:
        The index; it makes an array (rows, cols) of the fine frame.
    """
    ratio = round(coarse.resolution / fine.resolution)
    rows = (np.arange(fine.rows) + fine.row) // ratio - coarse.row
    cols = (np.arange(fine.cols) + fine.col) // ratio - coarse.col
    return np.ix_(rows, cols)


def smoothing_width(std: float, resolution: float, options: ForwardOptions = DEFAULTS) -> float:
    """Return the width of the sieve's Gaussian kernel.

    Args:
        std: Standard deviation of the range noise (m).
        resolution: Side of a cell (m).
        options: The sieve's options.

    Returns:
        The kernel's standard deviation (m).
    """
    return options.smoothing * math.sqrt(std * resolution)


def visits_and_arrival_probability(sums: NDArray[np.float32]) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Return each cell's expected visits and arrival probability, see :class:`mapping.forward.mapper.ForwardFit`.

    Args:
        sums: The E step's sums (blocks, rows * cols, 3).

    Returns:
        Both (rows * cols,).
    """
    added = sums.sum(axis=0)
    visits = added[:, HITS] + added[:, PASSES]
    return visits, added[:, SQUARES_OF_ARRIVAL] / np.maximum(visits, np.float32(1e-9))
