"""The forward mapper: a forward sensor model fitted to all rays by expectation-maximisation.

The map is a reflection map with noisy ranges. Each cell c has a stopping probability o_c: that of a ray that crosses
the cell to end there. It is one Bernoulli trial for each ray and cell, where a ray crosses one cell for each step
along its major axis, whatever the length of its path in it. If ranges were exact, the maximum-likelihood map would be
the counting model, hits / (hits + passes) (Hähnel, Triebel, Burgard and Thrun 2003). With noise, which cell stopped a
ray is latent: map and range noise (sigma, epsilon) maximise the likelihood of all measured ranges together. The
latent correspondences and their expectation-maximisation are those of Thrun («Learning occupancy grid maps with
forward sensor models», 2003). His cells are binary, and a search flips them; here they hold probabilities, which
the M step gives in closed form.

An inverse sensor model updates each cell on its own and blurs the map by the noise; here the map stays sharp where
the noise is far larger than a cell.

:mod:`~mapping.forward.likelihood` is the sensor model and the E step, :mod:`~mapping.forward.sieve` the restriction
to smooth maps and the M step, :mod:`~mapping.forward.level` both on one resolution. This module is the schedule:

- :meth:`ForwardMapper.fit`: over-relaxed expectation-maximisation (Salakhutdinov and Roweis 2003) from coarse to
  fine; then the range noise from held-out rays, since a map also fits a part of the noise of its own rays; then the
  map from all rays.
- :class:`StreamingMap`: stepwise expectation-maximisation (Cappé and Moulines 2009) on a coarser map, while scans
  stream in.

:mod:`~mapping.forward.calibration` turns a fit into probabilities of occupancy.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from mapping.forward.calibration import CALIBRATION, CalibrationOptions, occupancy
from mapping.forward.level import (
    ALL_RAYS,
    COLUMNS,
    Fold,
    Level,
    RangeNoise,
    RayStore,
    RaySubset,
    SufficientStatistics,
    coarse_cell_index,
    smoothing_width,
    visits_and_arrival_probability,
)
from mapping.forward.options import DEFAULTS, ForwardOptions
from mapping.grid import UNKNOWN, GridFrame, GrowingGrid, MapSizeError, OccupancyGrid
from mapping.kernels import scan_extent
from mapping.range_noise import check_noise, neighbour_noise
from prim.scan import Scan
from prim.se2 import Pose2D
from prim.threads import cores, worker_pool
from prim.world import Bounds


@dataclass(frozen=True, slots=True)
class ForwardFit:
    """A fit of the forward model; all arrays (rows, cols) float32.

    Attributes:
        frame: Where the cells lie.
        stopping: Stopping probabilities.
        visits: Expected number of rays that reached the cell, its hits and passes: sum(a) over the rays, with a the
            posterior probability that the ray reached the cell.
        arrival_probability: The mean of a, weighted by a itself: sum(a^2) / sum(a). It is no confidence in the map.
        noise: The range noise.
    """

    frame: GridFrame
    stopping: NDArray[np.float32]
    visits: NDArray[np.float32]
    arrival_probability: NDArray[np.float32]
    noise: RangeNoise

    def grid(self, options: CalibrationOptions = CALIBRATION) -> OccupancyGrid:
        """Return the calibrated probabilities of occupancy."""
        noise_cells = self.noise.std / self.frame.resolution
        probability = occupancy(self.stopping, self.arrival_probability, self.visits, noise_cells, options)
        return OccupancyGrid(self.frame, probability, self.visits)


class ForwardMapper:
    """Mapper that fits stopping probabilities and the range noise to all rays together.

    While scans stream in, :meth:`update` keeps a coarser map up to date with a bounded amount of work per scan, and
    :meth:`grid` returns that one. :meth:`finish` fits all rays from coarse to fine, until convergence or the options'
    limits of passes; its result does not depend on the streaming map, nor on the number of threads.

    Attributes:
        resolution: Side of a cell (m).
        options: The mapper's options.
        history: Of the last fit, the level's factor and the E step's statistics of passes on rays of the fit. Passes
            that showed that the step before was to be undone, or that the level had converged, are left out.
    """

    name = "forward"
    counts_visits = True

    def __init__(
        self,
        resolution: float = 0.01,
        bounds: Bounds | None = None,
        noise_std: float | None = None,
        start_std: float | None = None,
        threads: int | None = None,
        options: ForwardOptions = DEFAULTS,
    ) -> None:
        """Start with an empty map.

        Args:
            resolution: Side of a cell (m).
            bounds: (x0, y0, x1, y1) (m) of the map; None: it grows with the scans.
            noise_std: Standard deviation of the range noise (m), held fixed; None: it is estimated.
            start_std: Its initial value (m) where it is estimated, bounded by what neighbouring beams show and by
                ``max_start_ratio`` times that; None: what they show.
            threads: Number of threads; None: one for each available core.
            options: The mapper's options.

        Raises:
            UsageError: Where the noise cannot be, or the map is too large.
        """
        self.resolution = resolution
        self.options = options
        if noise_std is not None:
            check_noise(noise_std)
        self._cells = GrowingGrid(resolution, bounds, 0, np.uint8)
        check_size(self._cells.frame, options)
        self._fixed_std = noise_std
        self._start_std = start_std
        self._rays = RayStore(options.max_range)
        self._threads = threads or cores()
        self._streaming: StreamingMap | None = None
        start = noise_std or start_std or options.default_noise_cells * resolution
        self._noise = RangeNoise(start, options.min_outlier_share)
        self._is_estimated = False
        self.history: list[tuple[int, SufficientStatistics]] = []

    @property
    def noise_std(self) -> float | None:
        """Standard deviation of the range noise (m), given or estimated; None where too few rays stopped.

        The sieve lowers the estimated variance; what it takes is added back. This is computed with the kernel's width
        for the final estimate, whereas the finest level's kernel was set by the estimate before that level converged.
        Noise below about 0.6 cells cannot be separated from the cells' size: that much is estimated where there is
        none.
        """
        if self._fixed_std is not None:
            return self._fixed_std
        if not self._is_estimated:
            return None
        options = self.options
        width = smoothing_width(self._noise.std, self.resolution, options)
        is_smoothed = width >= options.min_smoothing_cells * self.resolution
        return math.sqrt(self._noise.std**2 + (options.sieve_variance * width**2 if is_smoothed else 0.0))

    @property
    def outlier_share(self) -> float:
        """Share of outliers among the measurements."""
        return self._noise.outlier_share

    @property
    def dropout_share(self) -> float:
        """Share of dropouts among the rays that ended in the map: of those that returned nothing."""
        return self._noise.dropout_share

    def update(self, scan: Scan, pose: Pose2D) -> None:
        """Add one scan, or the next piece of one; the streaming map takes up further pieces with the next scan.

        Args:
            scan: The scan.
            pose: Pose of the laser in the map frame.
        """
        if not self.accumulate(scan, pose) or scan.first_beam:
            return
        frame = self._streaming_frame()
        if self._streaming is None:
            self._noise = self._initial_noise(frame.resolution)
        if not self._noise.dropout_share:  # the first ray without a return may be one of this scan
            self._noise = self._noise._replace(dropout_share=self._initial_dropouts())
        if self._streaming is None or self._streaming.level.frame != frame:
            self._streaming = StreamingMap(frame, self._streaming, self.options)
        self._noise = self._streaming.step(self._rays, self._noise, self._fixed_std is not None)
        self._is_estimated = self._is_estimated or self._streaming.determines_noise

    def accumulate(self, scan: Scan, pose: Pose2D) -> bool:
        """Add one scan without updating the streaming map.

        Args:
            scan: The scan.
            pose: Pose of the laser in the map frame.

        Returns:
            Whether it holds any measurement.
        """
        if not self._cells.fixed:
            self._cells.cover(*scan_extent(scan, pose, self.resolution))
            check_size(self._cells.frame, self.options)
        return self._rays.add(scan, pose) > 0

    def grid(self) -> OccupancyGrid:
        """Return the map so far: the streaming map, at this mapper's resolution."""
        frame = self._frame()
        if self._streaming is None:
            unknown = np.full(frame.shape, UNKNOWN, np.float32)
            return OccupancyGrid(frame, unknown, np.zeros_like(unknown))
        coarse = self._streaming.fit(self._noise).grid(self.options.calibration)
        cells = coarse_cell_index(coarse.frame, frame)
        ratio = coarse.frame.resolution / frame.resolution
        assert coarse.visits is not None
        return OccupancyGrid(frame, coarse.probability[cells], coarse.visits[cells] / np.float32(ratio))

    def streaming_map(self) -> tuple[Level, RangeNoise] | None:
        """Return the streaming map and the range noise so far; None before there is any."""
        return None if self._streaming is None else (self._streaming.level, self._noise)

    def finish(self) -> OccupancyGrid:
        """Return the map of all scans, see :meth:`fit`."""
        return self.fit().grid(self.options.calibration)

    def fit(self) -> ForwardFit:
        """Return the fit to all scans, before it is turned into occupancy.

        Each level is fitted until convergence, in ``max_passes`` at most, and the finest one then in ``final_passes``
        at most.
        """
        with worker_pool(self._threads) as pool:
            level, self._noise = self._fit(pool, self._frame())
            sums, _ = level.expect(self._rays, self._noise, with_arrival=True)
            return fit_of(level, sums, self._noise)

    def refit_streaming_map(self) -> None:
        """Fit the streaming map to all scans so far, from coarse to fine as :meth:`fit` does."""
        finest, coarse = self._cells.frame, self._streaming_frame()
        with worker_pool(self._threads) as pool:
            level, self._noise = self._fit(pool, finest, round(coarse.resolution / finest.resolution))
        self._streaming = StreamingMap(coarse, None, self.options)
        self._streaming.initialize_from(level, self._rays, self._noise)

    def _frame(self) -> GridFrame:
        return self._cells.used or self._cells.frame

    def _streaming_frame(self) -> GridFrame:
        frame, factor = self._cells.frame, 2
        while frame.rows * frame.cols > self.options.streaming_cells * factor**2:
            factor *= 2
        return coarsened(frame, factor)

    def _neighbour_noise(self) -> float:
        """Return the noise (m) as neighbouring beams show it, within what can be estimated; 0 without any."""
        return min(neighbour_noise(self._rays.ranges) or 0.0, self.options.max_noise)

    def _initial_noise(self, resolution: float) -> RangeNoise:
        """Return the noise to start from: as given (but bounded by the cells), else from neighbouring beams."""
        options = self.options
        if self._fixed_std is not None:
            std = max(self._fixed_std, options.min_given_noise_cells * resolution)
            return RangeNoise(std, options.min_outlier_share, self._initial_dropouts())
        guess = max(self._neighbour_noise(), self.resolution)
        std = min(max(self._start_std or guess, guess), options.max_start_ratio * guess)
        return RangeNoise(std, options.min_outlier_share, self._initial_dropouts())

    def _initial_dropouts(self) -> float:
        """Return the share of dropouts to start from: as if all rays without a return were dropouts.

        Free paths show themselves as such in the first passes, since nothing ended on them. If the fit began with
        free paths, walls would have to give way to dropouts, and where nothing behind a wall is seen, a wall that
        lets a tenth of the rays pass explains them as well as a tenth of dropouts does.
        """
        return min(self._rays.share_without_return, self.options.max_dropout_share)

    def _fit(self, pool: ThreadPoolExecutor | None, frame: GridFrame, last: int = 1) -> tuple[Level, RangeNoise]:
        """Fit from coarse to fine, down to cells ``last`` times the frame's; then noise and map, see the module."""
        options = self.options
        self.history.clear()
        self._rays.trim()
        self._is_estimated = False
        estimates_noise, is_thinned = self._fixed_std is None, len(self._rays) > options.thinning_rays
        holds_out = estimates_noise and len(self._rays) >= options.hold_out_min_rays
        fold = Fold.FITTED if holds_out else Fold.ALL
        noise = self._initial_noise(self.resolution)
        guess = self._neighbour_noise()
        level: Level | None = None
        factors = level_factors(noise.std / self.resolution, options)
        for factor in [factor for factor in factors if factor >= last] or [last]:
            finer = Level(coarsened(frame, factor), options.initial_stopping * factor, pool, options)
            if not estimates_noise:
                noise = noise._replace(std=self._initial_noise(finer.frame.resolution).std)
            finer.smooth(noise.std)
            if level is not None:
                finer.initialize_from(level)
                level.release_free_cells()  # and the memory of which rays skip them
                finer.fix_free_cells(self._rays)
            stride = (options.coarsest_stride if level is None else options.stride) if is_thinned else 1
            noise = self._converge(finer, factor, RaySubset(stride=stride, fold=fold), noise, estimates_noise)
            level = finer
        assert level is not None
        if holds_out:
            noise = self._held_out_noise(level, noise)
        elif estimates_noise:
            noise = noise._replace(std=max(noise.std, guess))
        if estimates_noise or is_thinned:
            noise = self._converge(level, 1, ALL_RAYS, noise, False, options.final_passes)
        level.release_free_cells()
        return level, noise

    def _converge(
        self,
        level: Level,
        factor: int,
        subset: RaySubset,
        noise: RangeNoise,
        estimates_noise: bool,
        max_passes: int | None = None,
    ) -> RangeNoise:
        """Iterate on one level until convergence or the largest number of passes; return the noise.

        Steps are over-relaxed. One that lowered the likelihood is undone, and plain steps follow. The step of the
        last pass allowed is plain; a level that converges before ends with the step that it took last, of either
        kind.
        """
        options = self.options
        power, best = options.over_relaxation, -math.inf
        previous: tuple[NDArray[np.float32], NDArray[np.float32], SufficientStatistics, RangeNoise] | None = None
        passes = max_passes or options.max_passes[min(factor.bit_length(), len(options.max_passes)) - 1]
        tolerance = options.tolerance if factor == 1 else options.coarse_tolerance
        for count in range(1, passes + 1):
            sums, statistics = level.expect(self._rays, noise, subset)
            if previous is not None and statistics.mean_log_likelihood < best and power > 1:
                parameters, sums, statistics, noise = previous
                level.set_parameters(parameters)
                power = 1
            elif statistics.mean_log_likelihood - best < tolerance:
                break
            else:
                self.history.append((factor, statistics))
            best = statistics.mean_log_likelihood
            previous = level.parameters.copy(), sums, statistics, noise
            level.maximize(sums, power if count < passes else 1)
            if estimates_noise:
                noise = statistics.range_noise(noise, level.frame.resolution, options)
                self._is_estimated = statistics.determines_noise(options)
            else:
                noise = statistics.with_dropouts(noise, options)
        return noise

    def _held_out_noise(self, level: Level, noise: RangeNoise) -> RangeNoise:
        """Return the noise after a few steps of expectation-maximisation on the held-out rays, given the map."""
        for _ in range(self.options.hold_out_passes):
            _, statistics = level.expect(self._rays, noise, RaySubset(fold=Fold.HELD_OUT))
            noise = statistics.range_noise(noise, level.frame.resolution, self.options)
        return noise


def fit_of(level: Level, sums: NDArray[np.float32], noise: RangeNoise) -> ForwardFit:
    """Return a level's map with the expected visits and the arrival probabilities of an E step.

    Args:
        level: The level.
        sums: The E step's sums (blocks, rows * cols, 3).
        noise: The range noise.

    Returns:
        The fit.
    """
    visits, arrival_probability = visits_and_arrival_probability(sums)
    shape = level.frame.shape
    return ForwardFit(level.frame, level.stopping, visits.reshape(shape), arrival_probability.reshape(shape), noise)


class StreamingMap:
    """The coarser map while scans stream in, updated by stepwise expectation-maximisation (Cappé and Moulines 2009).

    A step takes the m newest rays and r of the n earlier ones, these in turn. The E step's sums per cell stand for
    all rays so far: they are multiplied by 1 - r / n, and those of the m + r rays under the current map are added.
    Per ray this is a stepwise update with step size (m + r) / (m + n). The range noise is the geometric mean of its
    last value and the estimate from these m + r rays alone.

    Cells are at least twice as large as the mapper's. A frame that grows keeps the map while the resolution stays the
    same; otherwise the map starts anew, with all rays in its first step.

    Attributes:
        level: The map.
        determines_noise: Whether the new or the earlier rays of the last step sufficed to estimate the range noise;
            not updated while the noise is given.
    """

    def __init__(self, frame: GridFrame, previous: StreamingMap | None, options: ForwardOptions = DEFAULTS) -> None:
        """Start a map.

        Args:
            frame: Where its cells lie.
            previous: The map on a smaller frame that it continues where both have the same resolution; else it starts
                anew.
            options: The mapper's options.
        """
        self.level = Level(frame, options.initial_stopping * 2, None, options)
        self.level.blocks = 1
        self.determines_noise = False
        self._options = options
        self._sums = np.zeros((1, self.level.parameters.size, COLUMNS), np.float32)
        self._done = self._next = 0
        if previous is not None and previous.level.frame.resolution == frame.resolution:
            self.level.copy_from(previous.level)
            self._done, self._next = previous._done, previous._next
            self._copy_sums(previous)

    def _copy_sums(self, smaller: StreamingMap) -> None:
        window = self.level.frame.window(smaller.level.frame)
        rows, cols = self.level.frame.shape
        self._sums.reshape(rows, cols, COLUMNS)[window] = smaller._sums.reshape(*smaller.level.frame.shape, COLUMNS)

    def fit(self, noise: RangeNoise) -> ForwardFit:
        """Return the map so far as a fit, at this map's resolution."""
        return fit_of(self.level, self._sums, noise)

    def initialize_from(self, fitted: Level, rays: RayStore, noise: RangeNoise) -> None:
        """Start from a fitted map.

        Args:
            fitted: A level with the same cells.
            rays: All rays that it was fitted to.
            noise: The range noise.
        """
        self.level.smooth(noise.std)
        negligible = np.float32(self._options.negligible_stopping)
        self.level.set_parameters(np.maximum(fitted.parameters, negligible))  # a parameter of 0 would stay 0
        self._sums, statistics = self.level.expect(rays, noise, with_arrival=True)
        self._done, self._next = len(rays), 0
        self.determines_noise = statistics.determines_noise(self._options)

    def step(self, rays: RayStore, noise: RangeNoise, is_noise_fixed: bool) -> RangeNoise:
        """Compute the E step of the newest rays and some earlier ones, and one M step.

        Args:
            rays: All rays so far.
            noise: The range noise.
            is_noise_fixed: Whether the noise is given.

        Returns:
            The noise so far.
        """
        options, level = self._options, self.level
        new = RaySubset(begin=self._done, end=len(rays))
        end = min(self._next + options.revisited_rays, self._done)
        old = RaySubset(begin=self._next, end=end)
        level.smooth(noise.std)
        if self._done:
            self._sums *= np.float32(1 - (end - old.begin) / self._done)
        found = []
        for subset in (old, new):
            if subset.end is not None and subset.end > subset.begin:
                sums, statistics = level.expect(rays, noise, subset, with_arrival=True)
                self._sums += sums
                found.append(statistics)
        level.maximize(self._sums)
        self._next = end if end < self._done else 0
        self._done = len(rays)
        if not found:
            return noise
        if is_noise_fixed:
            return noise._replace(
                dropout_share=_mean(noise, _sum_of(found).with_dropouts(noise, options)).dropout_share
            )
        self.determines_noise = any(statistics.determines_noise(options) for statistics in found)
        estimate = _sum_of(found).range_noise(noise, level.frame.resolution, options)
        return _mean(noise, estimate)


def _sum_of(statistics: list[SufficientStatistics]) -> SufficientStatistics:
    rows = [(s.log_likelihood, s.rays, s.stops, s.squares, s.outliers, s.dropouts) for s in statistics]
    return SufficientStatistics(*(sum(values) for values in zip(*rows, strict=True)))


def _mean(old: RangeNoise, new: RangeNoise) -> RangeNoise:
    """Return the mean of two steps' noise, so that no single scan dominates it: geometric but for dropouts."""
    std, outlier_share = math.sqrt(old.std * new.std), math.sqrt(old.outlier_share * new.outlier_share)
    return RangeNoise(std, outlier_share, (old.dropout_share + new.dropout_share) / 2)


def estimate_range_noise(
    scans: Iterable[tuple[Scan, Pose2D]], frame: GridFrame, options: ForwardOptions = DEFAULTS
) -> float | None:
    """Estimate the range noise alone; large maps are made of larger cells.

    Args:
        scans: Scans with the pose of their laser in the map frame.
        frame: The map's frame.
        options: The mapper's options.

    Returns:
        The standard deviation (m); None where too few rays stopped in the map.
    """
    factor = 1
    while frame.rows * frame.cols > options.noise_cells * factor**2:
        factor *= 2
    frame = coarsened(frame, factor)
    mapper = ForwardMapper(frame.resolution, frame.bounds, options=options)
    for scan, pose in scans:
        mapper.accumulate(scan, pose)
    mapper.fit()
    return mapper.noise_std


def check_size(frame: GridFrame, options: ForwardOptions = DEFAULTS) -> None:
    """Check that a map fits into memory: the fit takes some 80 bytes per cell.

    Args:
        frame: The map's frame.
        options: The mapper's options.

    Raises:
        MapSizeError: Where it does not.
    """
    if frame.rows * frame.cols > options.max_cells:
        raise MapSizeError(
            f"a map of {frame.rows * frame.cols / 1e6:.0f} million cells is too large for --mapper forward "
            f"(at most {options.max_cells / 1e6:.0f} million)",
            frame.resolution,
            frame.rows * frame.cols / options.max_cells,
        )


def coarsened(frame: GridFrame, factor: int) -> GridFrame:
    """Return the frame of larger cells, on whole multiples of their size, that covers another.

    Args:
        frame: The frame.
        factor: How many times as large the cells are.

    Returns:
        The coarser frame.
    """
    row, col = frame.row // factor, frame.col // factor
    rows = -(-(frame.row + frame.rows) // factor) - row
    cols = -(-(frame.col + frame.cols) // factor) - col
    return GridFrame(frame.resolution * factor, row, col, rows, cols)


def level_factors(noise_cells: float, options: ForwardOptions = DEFAULTS) -> list[int]:
    """Return how many times as large as the map's the levels' cells are, coarse to fine.

    Args:
        noise_cells: Standard deviation of the range noise (cells).
        options: The mapper's options.

    Returns:
        Powers of 2, the last one 1.
    """
    factor = options.min_coarsest_factor
    while factor < options.max_coarsest_factor and options.coarsest_noise_cells * factor < noise_cells:
        factor *= 2
    return [factor >> k for k in range(factor.bit_length())]
