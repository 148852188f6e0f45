"""Compiled kernels of the forward sensor model: likelihoods of ranges, and the E step of expectation-maximisation.

The model. Each cell c has a stopping probability o_c: that of a ray that enters the cell to end there, whatever the
length of its path in it (one Bernoulli trial for each ray and cell). A ray crosses cells k = 0, 1, ..., one for each
step along its major axis, whose centres lie at distances s_k along the ray. It reaches cell k with the transmittance
T_k = prod_{j < k} (1 - o_j), and ends there with probability T_k o_k. A ray that ends at distance s is measured as
z ~ N(s, sigma^2). With the share epsilon of outliers, z has the density

    p(z) = (1 - epsilon) [sum_k T_k o_k N(z; s_k, sigma) + T_exit E(z) + B(z)] + epsilon O(z).

E is the density of rays that leave the grid (:func:`likelihood_beyond`), B that of rays from a sensor off the grid
that end before they enter it (:func:`likelihood_before`), O that of outliers (:func:`outlier_likelihood`). -inf
(nearer than range_min, REP 117) and no returns are censored measurements: N is replaced by the probability of its
tail.

Dropouts. Of the rays that end in the grid the share delta returns nothing: black, slanted or shiny surfaces, and
faults of the scanner. N and its lower tail are multiplied by 1 - delta, and for a no return the upper tail is
replaced by (1 - delta) Phi((s_k - z_max) / sigma) + delta. E and B say themselves how often nothing returns, E of no
less than delta of the rays. With sum T_k o_k = T_0 - T_exit the density of a no return is

    (1 - epsilon) [(1 - delta) sum_k T_k o_k Phi(.) + T_exit (E - delta) + delta T_0 + B] + epsilon O.

The E step. The responsibilities q_k = (1 - epsilon) T_k o_k N(z; s_k, sigma) / p(z), with those of exit, entry and
outlier, sum to 1. Cell k receives q_k as an expected hit, and the responsibility of all that lies behind it (exit
included, outlier not) as an expected pass (Thrun, «Learning occupancy grid maps with forward sensor models», 2003).
The part delta T_0 does not depend on the map: a dropout frees nothing and fills nothing. The share delta itself is
that of dropouts, which have the responsibility delta (T_0 - T_exit), among all rays that end in the grid.

All lengths inside the kernels are in cells. Numba's cache watches only this file: constants that the kernels use must
stand here, model parameters are arguments. Callers pass the fields of named tuples as plain tuples, which numba
recognises faster, and the kernels name them.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from mapping.kernels import Fields
from prim.arrays import FloatArray
from prim.compiled import compiled, inline, kernel
from prim.normal import normal_table

SHIFT = 32
ONE = float(1 << SHIFT)
"""The fixed-point format of a ray's minor coordinate: number of fractional bits, and 1."""

FAR_CELLS = float(1 << 20)
"""A ray from a sensor farther off the grid than this (cells) is not traced: the fixed-point format would overflow."""

REACH = 6.0
"""Beyond this many standard deviations the Gaussian counts as 0."""

SPACING = 64
"""Entries of the tables per standard deviation."""

TOP = int(2 * REACH * SPACING)
"""Index of the tables' last entry."""

CUT = REACH**2 / 512
"""REACH in the variable x^2 / 512 of :func:`weight_measured`."""

CHUNK = 32
"""Cells that are traversed between two tests of whether a ray's transmittance is still above the cutoff."""

SMALLEST_SHARE = float(np.finfo(np.float32).tiny)
"""In the place of 0 where a share divides."""

TRANSMITTANCE_FLOOR = 1e-10
"""Added to the transmittance at each cell: denormal numbers would slow the processor down considerably."""

MEASURED, TOO_NEAR, NO_RETURN = 0, 1, 2
"""What a range is, see :func:`classify_range`; also the tables' rows of weights."""

CENSORED_MOMENTS = 2
"""A table's row of second moments is this plus TOO_NEAR or NO_RETURN."""

HITS, PASSES, SQUARES_OF_ARRIVAL = 0, 1, 2
"""Columns of an E step's sums per cell."""

LOG_LIKELIHOOD, STOPS, SQUARES, OUTLIERS, RAYS, TRACED_CELLS, DROPOUTS = range(7)
"""Entries of an E step's totals over rays."""

TOTALS = DROPOUTS + 1
"""Number of these."""

ROOT_HALF = math.sqrt(0.5)
PEAK = 1 / math.sqrt(2 * math.pi)
"""The standard normal density at 0."""


class RayModel(NamedTuple):
    """Parameters of the forward sensor model that are not estimated; all set by hand.

    Attributes:
        hit_before: Probability that a ray from a sensor off the grid ends before it reaches the grid.
        hit_beyond: Probability that a ray that leaves the grid ends before range_max.
        outlier_tail: Share of outliers that read as nearer than range_min, and the share that read as no return; the
            rest is uniform over the sensor's ranges.
        transmittance_cutoff: A ray is traced until the probability that it came so far falls below this.
    """

    hit_before: float = 0.5
    hit_beyond: float = 0.5
    outlier_tail: float = 0.1
    transmittance_cutoff: float = 1e-5


class SensorModel(NamedTuple):
    """The forward sensor model's parameters as the kernels take them.

    Attributes:
        sigma: Standard deviation of the range noise (m; in cells inside the kernels).
        epsilon: Share of outliers.
        delta: Share of dropouts among the rays that end in the grid.
        rays: The parameters that are not estimated.
        table: The tables made by :func:`noise_tables`.
    """

    sigma: float
    epsilon: float
    delta: float
    rays: RayModel
    table: NDArray[np.float32]


class RayArrays(NamedTuple):
    """Rays in the order of their scans.

    Attributes:
        scans: Per scan (S, 4) float64: the sensor's x, y, range_min and range_max (m).
        first: Index (S + 1,) of each scan's first ray, and the number of rays.
        rays: Per ray (N, 3) float32: the direction in the map frame, and the range (m; -inf: nearer than range_min,
            inf: no return).
    """

    scans: FloatArray
    first: NDArray[np.int64]
    rays: NDArray[np.float32]


class RaySlice(NamedTuple):
    """The rays that an E step takes, as the kernel takes them.

    Attributes:
        begin: Index of the first ray.
        end: Index after the last ray.
        stride: Every ``stride``-th ray is taken.
        fold: 1 leaves the held-out rays out, -1 takes only those, 0 takes all.
        hold_out_every: Every ``hold_out_every``-th ray is held out. Which ones shifts from scan to scan, so that they
            are not always at the same bearings.
    """

    begin: int
    end: int
    stride: int
    fold: int
    hold_out_every: int


class GridGeometry(NamedTuple):
    """The place of a grid in the map frame.

    Attributes:
        x: x (m) of the lower left corner.
        y: y (m) of the lower left corner.
        resolution: Side of a cell (m).
    """

    x: float
    y: float
    resolution: float


class RayScratch(NamedTuple):
    """Working memory for one ray: an entry for each cell that it crosses.

    Attributes:
        cells: Flat indices int64.
        transmittance: T_k float32, the probability that the ray reaches the cell.
        residual: (s_k - z) / sigma float32.
        weight: Float32, first T_k o_k times the likelihood of the measurement, then the responsibilities q_k.
    """

    cells: NDArray[np.int64]
    transmittance: NDArray[np.float32]
    residual: NDArray[np.float32]
    weight: NDArray[np.float32]


def noise_tables() -> NDArray[np.float32]:
    """Tabulate the noise over x = (s - z) / sigma from -REACH to REACH, for a ray that ends at s.

    Returns:
        An array (5, TOP + 1). Rows MEASURED, TOO_NEAR and NO_RETURN are the weights of a measurement: exp(-x^2 / 2)
        for a range z, Phi(-x) for one below z = range_min, Phi(x) for one above z = range_max. Rows 3 and 4 are the
        second moments of the noise, in sigma^2, given that the range is censored below or above (moments of the
        truncated normal distribution).
    """
    x, density, below = normal_table(REACH, SPACING)
    above = below[::-1]
    moment_below = 1 + x * density * PEAK / below
    return np.stack([density, below, above, moment_below, moment_below[::-1]]).astype(np.float32)


@inline
def normal_cdf(u: float) -> float:
    """Return the standard normal distribution function Phi(u)."""
    return 0.5 * math.erfc(-u * ROOT_HALF)


@inline
def normal_cdf_integral(u: float) -> float:
    """Return the integral of Phi from minus infinity to u."""
    return u * normal_cdf(u) + PEAK * math.exp(-0.5 * u * u)


@inline
def interpolate(table: Any, row: int, x: float) -> float:
    """Interpolate a row of the tables linearly.

    Args:
        table: The tables made by :func:`noise_tables`.
        row: The row.
        x: Residual in standard deviations; clamped to the tables' reach.

    Returns:
        The value at x.
    """
    place = min(max(x + REACH, 0.0), 2 * REACH) * SPACING
    entry = min(int(place), TOP - 1)
    low = float(table[row, entry])
    return low + (place - entry) * (float(table[row, entry + 1]) - low)


@inline
def likelihood_beyond(kind: int, z: float, z_min: float, z_max: float, exit_at: float, sensor: SensorModel) -> float:
    """Return the likelihood E(z) of a measurement whose ray has left the grid.

    Beyond the grid the ray ends with probability ``hit_beyond`` anywhere up to range_max, uniformly, plus noise; else
    there is no return.

    Args:
        kind: MEASURED, TOO_NEAR or NO_RETURN.
        z: The range (cells).
        z_min: range_min (cells).
        z_max: range_max (cells).
        exit_at: Distance at which the ray leaves the grid (cells).
        sensor: The sensor model, in cells.

    Returns:
        A density (per cell) for a measured range, else a probability.
    """
    sigma, hit = sensor.sigma, sensor.rays.hit_beyond
    if exit_at >= z_max:
        return 1.0 if kind == NO_RETURN else 0.0
    span = z_max - exit_at
    if kind == MEASURED:
        above = interpolate(sensor.table, NO_RETURN, (z - exit_at) / sigma)
        return hit * (above - interpolate(sensor.table, NO_RETURN, (z - z_max) / sigma)) / span
    if kind == TOO_NEAR:
        near = normal_cdf_integral((z_min - exit_at) / sigma) - normal_cdf_integral((z_min - z_max) / sigma)
        return hit * sigma * near / span
    far = normal_cdf_integral(span / sigma) - PEAK
    return 1 - hit * sigma * far / span


@inline
def likelihood_before(kind: int, z: float, z_min: float, z_max: float, entry: float, sensor: SensorModel) -> float:
    """Return the likelihood B(z) of a measurement whose ray ends before it enters the grid.

    Between a sensor off the grid and the grid the ray ends with probability ``hit_before``, uniformly, plus noise.

    Args:
        kind: MEASURED, TOO_NEAR or NO_RETURN.
        z: The range (cells).
        z_min: range_min (cells).
        z_max: range_max (cells).
        entry: Distance at which the ray enters the grid (cells); 0 where the sensor is inside.
        sensor: The sensor model, in cells.

    Returns:
        A density (per cell) for a measured range, else a probability.
    """
    sigma, hit = sensor.sigma, sensor.rays.hit_before
    if entry <= 0:
        return 0.0
    if kind == MEASURED:
        above = interpolate(sensor.table, NO_RETURN, z / sigma)
        return hit * (above - interpolate(sensor.table, NO_RETURN, (z - entry) / sigma)) / entry
    limit = z_min if kind == TOO_NEAR else z_max
    nearer = sigma * (normal_cdf_integral(limit / sigma) - normal_cdf_integral((limit - entry) / sigma)) / entry
    return hit * nearer if kind == TOO_NEAR else hit * max(1 - nearer, 0.0)


@inline
def outlier_likelihood(kind: int, z_min: float, z_max: float, outlier_tail: float) -> float:
    """Return the likelihood O(z) of an outlier: a measurement that does not depend on the map.

    Args:
        kind: MEASURED, TOO_NEAR or NO_RETURN.
        z_min: range_min (cells).
        z_max: range_max (cells).
        outlier_tail: Share of outliers at each end of the sensor's ranges.

    Returns:
        A density (per cell) for a measured range, else a probability.
    """
    return (1 - 2 * outlier_tail) / (z_max - z_min) if kind == MEASURED else outlier_tail


@inline
def steps_inside(offset: int, slope: int, cells: int) -> tuple[int, int]:
    """Return the steps for which a ray's minor coordinate is within the grid.

    Args:
        offset: The minor coordinate at step 0, fixed point.
        slope: Its change per step, fixed point.
        cells: The grid's number of cells along the minor axis.

    Returns:
        First and last step for which 0 <= (offset + step * slope) >> SHIFT < cells; no step is where the first is
        larger.
    """
    end = (cells << SHIFT) - 1
    if slope == 0:
        return (0, 1 << 40) if 0 <= offset <= end else (1, 0)
    if slope < 0:
        offset, slope = end - offset, -slope
    return -(offset // slope), (end - offset) // slope


@inline
def cells_along_ray(x: float, y: float, dx: float, dy: float, rows: int, cols: int) -> tuple[Any, ...]:
    """Return the cells that a ray crosses: one for each step along its major axis, by the exact sensor position.

    Args:
        x: The sensor's x relative to the grid (cells).
        y: The sensor's y relative to the grid (cells).
        dx: x of the ray's direction.
        dy: y of the ray's direction.
        rows: The grid's rows.
        cols: The grid's columns.

    Returns:
        First and last step within the grid (only steps ahead of the sensor); the flat index of step 0 by its major
        coordinate alone; the strides along the major and the minor axis; the minor coordinate at step 0 and its
        change per step, in fixed point; the distance of step 0 (may be below 0) and between steps (cells).
    """
    along_x = abs(dx) >= abs(dy)
    if along_x:
        a, b, da, db, a_cells, b_cells, a_stride, b_stride = x, y, dx, dy, cols, rows, 1, cols
    else:
        a, b, da, db, a_cells, b_cells, a_stride, b_stride = y, x, dy, dx, rows, cols, cols, 1
    step = 1 / abs(da)
    cell = math.floor(a)
    start = (cell + 0.5 - a) * step if da > 0 else (a - cell - 0.5) * step
    slope = int(db * step * ONE)
    offset = math.floor((b + start * db) * ONE)
    first, last = steps_inside(offset, slope, b_cells)
    if da > 0:
        first, last, major = max(first, -cell), min(last, a_cells - 1 - cell), a_stride
    else:
        first, last, major = max(first, cell - a_cells + 1), min(last, cell), -a_stride
    first = max(first, 0 if start > 0 else 1)
    return first, last, cell * a_stride, major, b_stride, offset, slope, start, step


part = compiled(cache=False, forceinline=True)
"""Decorator for a part of the kernels below."""

fused = compiled(cache=False, forceinline=True, fastmath={"contract"})
"""Decorator for a part that may fuse a multiplication and an addition."""

fast = compiled(cache=False, forceinline=True, fastmath={"nsz", "contract", "reassoc", "nnan"})
"""Decorator for a part that may also reorder sums, so that they are vectorised."""


@fused
def traverse(
    line: Any, stop: int, left: Any, cutoff: float, x_start: Any, x_step: Any, flat: Any, scratch: RayScratch
) -> Any:
    """Traverse a ray's cells until its transmittance is below the cutoff or a step is reached.

    The transmittance is compared with the cutoff after every CHUNK cells only: a test at each cell would stall the
    cells that follow.

    Args:
        line: First step, flat index of step 0, strides, fixed-point offset and slope, see :func:`cells_along_ray`.
        stop: Last step.
        left: Transmittance T at the first step.
        cutoff: The transmittance's cutoff.
        x_start: Residual (s - z) / sigma at step 0.
        x_step: Its change per step.
        flat: Stopping probabilities (rows * cols,).
        scratch: Its ``cells``, ``transmittance`` and ``residual`` are filled.

    Returns:
        The number of cells, and the transmittance after the last one.
    """
    first, start, major, minor, offset, slope = line
    cells, transmittance, residual = scratch.cells, scratch.transmittance, scratch.residual
    count = 0
    step = first
    c, along = start + first * major, offset + first * slope
    while step <= stop and left >= cutoff:
        for k in range(min(CHUNK, stop + 1 - step)):
            n = np.uintp(count + k)
            here = c + (along >> SHIFT) * minor
            cells[n] = here
            transmittance[n] = left
            residual[n] = x_start + np.float32(np.int32(step + k)) * x_step
            left = left * (np.float32(1) - flat[np.uintp(here)]) + np.float32(TRANSMITTANCE_FLOOR)
            c += major
            along += slope
        count += min(CHUNK, stop + 1 - step)
        step += CHUNK
    return count, left


@fast
def weight_measured(count: int, flat: Any, scratch: RayScratch) -> Any:
    """Weight a ray's cells by a measured range: T_k o_k exp(-x_k^2 / 2), the exponential to 5e-4 of itself.

    exp(-x^2 / 2) = exp(-t)^256 with t = x^2 / 512, and a polynomial for exp(-t).

    Args:
        count: The number of cells.
        flat: Stopping probabilities (rows * cols,).
        scratch: Its ``weight`` is filled.

    Returns:
        The sum of the weights.
    """
    cells, transmittance, residual, weight = scratch.cells, scratch.transmittance, scratch.residual, scratch.weight
    for i in range(count):
        weight[np.uintp(i)] = flat[np.uintp(cells[np.uintp(i)])]
    total = np.float32(0)
    for i in range(count):
        n = np.uintp(i)
        x = residual[n]
        t = x * x * np.float32(1 / 512)
        u = min(t, np.float32(CUT))
        w = np.float32(1) - u * (np.float32(1) - u * (np.float32(0.5) - u * np.float32(1 / 6)))
        w *= w
        w *= w
        w *= w
        w *= w
        w *= w
        w *= w
        w *= w
        w *= w
        part = transmittance[n] * weight[n] * (w if t < np.float32(CUT) else np.float32(0))
        weight[n] = part
        total += part
    return total


@part
def weight_censored(row: int, count: int, flat: Any, table: Any, scratch: RayScratch) -> Any:
    """Weight a ray's cells by a censored measurement: T_k o_k times the probability of the tail, from the tables.

    Args:
        row: TOO_NEAR or NO_RETURN.
        count: The number of cells.
        flat: Stopping probabilities (rows * cols,).
        table: The tables.
        scratch: Its ``weight`` is filled.

    Returns:
        The sum of the weights.
    """
    cells, transmittance, residual, weight = scratch.cells, scratch.transmittance, scratch.residual, scratch.weight
    total = np.float32(0)
    for i in range(count):
        n = np.uintp(i)
        part = transmittance[n] * flat[np.uintp(cells[n])] * np.float32(interpolate(table, row, residual[n]))
        weight[n] = part
        total += part
    return total


@fast
def moments_measured(count: int, factor: Any, scratch: RayScratch) -> Any:
    """Turn weights into responsibilities, in place, and sum them up.

    Args:
        count: The number of cells.
        factor: Responsibility per weight.
        scratch: Its ``weight`` is scaled.

    Returns:
        The sums of q_k and of q_k x_k^2.
    """
    residual, weight = scratch.residual, scratch.weight
    stops, squares = np.float32(0), np.float32(0)
    for i in range(count):
        n = np.uintp(i)
        q = weight[n] * factor
        weight[n] = q
        stops += q
        squares += q * residual[n] * residual[n]
    return stops, squares


@part
def moments_censored(row: int, count: int, factor: Any, table: Any, scratch: RayScratch) -> Any:
    """Turn weights into responsibilities, in place, with the second moments of censored noise from the tables.

    Args:
        row: The tables' row of second moments.
        count: The number of cells.
        factor: Responsibility per weight.
        table: The tables.
        scratch: Its ``weight`` is scaled.

    Returns:
        The sums of q_k and of q_k times the second moment.
    """
    residual, weight = scratch.residual, scratch.weight
    stops, squares = np.float32(0), np.float32(0)
    for i in range(count):
        n = np.uintp(i)
        q = weight[n] * factor
        weight[n] = q
        stops += q
        squares += q * np.float32(interpolate(table, row, residual[n]))
    return stops, squares


@part
def scatter(count: int, behind: Any, scratch: RayScratch, sums: Any, with_arrival: bool, kept: Any) -> None:
    """Add a ray's responsibilities to its cells, from the last one back.

    Args:
        count: The number of cells.
        behind: Responsibility of what lies behind the last cell.
        scratch: The ray's ``cells`` and responsibilities.
        sums: Changed in place, see :func:`expect`.
        with_arrival: Whether the third column of ``sums``, SQUARES_OF_ARRIVAL, is filled.
        kept: Probability that the ray is no dropout, which arrives nowhere: squares are those of the probabilities to
            have reached a cell given that.
    """
    cells, responsibility = scratch.cells, scratch.weight
    for i in range(count - 1, -1, -1):
        n = np.uintp(i)
        c = np.uintp(cells[n])
        q = responsibility[n]
        sums[c, HITS] += q
        sums[c, PASSES] += behind
        behind += q
        if with_arrival:
            sums[c, SQUARES_OF_ARRIVAL] += behind * behind / kept


@inline
def classify_range(z: float, z_min: float, z_max: float, sigma: float) -> tuple[int, float, float]:
    """Classify a range; -inf is nearer than range_min (REP 117).

    Args:
        z: The range (cells).
        z_min: range_min (cells).
        z_max: range_max (cells).
        sigma: Standard deviation of the noise (cells).

    Returns:
        MEASURED, TOO_NEAR or NO_RETURN; the distance that the noise is measured from; and the distance beyond which
        the ray cannot have ended, or (no return) is not followed.
    """
    if z == -math.inf:
        return TOO_NEAR, z_min, z_min + REACH * sigma
    if z >= z_max:
        return NO_RETURN, z_max, z_max
    return MEASURED, z, z + REACH * sigma


@inline
def is_selected(number: Any, subset: RaySlice) -> bool:
    """Return whether an E step takes a ray.

    Args:
        number: Index of the ray plus that of its scan.
        subset: The rays that it takes.

    Returns:
        Whether the ray is one of them.
    """
    is_held_out = number % subset.hold_out_every == 0
    return number % subset.stride == 0 and (subset.fold == 0 or is_held_out == (subset.fold < 0))


@part
def trace_ray(
    ray: Any, limits: Any, stopping: Any, skip: int, sensor: SensorModel, scratch: RayScratch
) -> tuple[Any, ...]:
    """Trace one ray through the grid and compute the density of its measurement.

    Args:
        ray: x and y of the sensor, the direction, and the range (-inf: nearer than range_min, inf: no return).
        limits: range_min and range_max.
        stopping: Stopping probabilities (rows, cols).
        skip: Number of the ray's first cells that are skipped.
        sensor: The sensor model. All lengths are in cells.
        scratch: Filled, with weights.

    Returns:
        MEASURED, TOO_NEAR or NO_RETURN; the number of cells (-1 where the ray misses the grid); the factor of the
        weights in the density; the likelihoods of what lies behind the cells, of a dropout whatever the map, of one
        that ended in the grid and of an outlier (each with its share); and the density of the measurement.
    """
    rows, cols = stopping.shape
    flat = stopping.reshape(-1)
    x, y, dx, dy, measurement = ray
    z_min, z_max = limits
    sigma, epsilon, delta, cutoff = sensor.sigma, sensor.epsilon, sensor.delta, sensor.rays.transmittance_cutoff
    inverse_sigma = 1 / sigma
    if not (-FAR_CELLS < x < cols + FAR_CELLS and -FAR_CELLS < y < rows + FAR_CELLS):
        return 0, -1, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0
    first, last, start, major, minor, offset, slope, s0, ds = cells_along_ray(x, y, dx, dy, rows, cols)
    if first > last:
        return 0, -1, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0
    kind, z, farthest = classify_range(measurement, z_min, z_max, sigma)
    entry = 0.0 if 0 <= x < cols and 0 <= y < rows else s0 + (first - 0.5) * ds
    exit_at = s0 + (last + 0.5) * ds
    leaves = exit_at <= farthest
    stop = last if leaves else min(last, int((farthest - s0) / ds))
    line = (first + skip, start, major, minor, offset, slope)
    x_start, x_step = np.float32((s0 - z) * inverse_sigma), np.float32(ds * inverse_sigma)
    enters = np.float32(1.0 if entry <= 0 else 1 - sensor.rays.hit_before)
    count, left = traverse(line, stop, enters, cutoff, x_start, x_step, flat, scratch)
    behind = lost = dropout = 0.0
    if left >= cutoff and leaves:
        behind = likelihood_beyond(kind, z, z_min, z_max, exit_at, sensor)
    elif left >= cutoff and kind == NO_RETURN:
        behind = 1.0
    if kind == NO_RETURN:
        behind = max(behind - delta, 0.0)
        lost = delta * float(enters)
        dropout = max(lost - delta * float(left), 0.0)
    behind *= float(left)
    if kind == MEASURED:
        scale = PEAK * inverse_sigma * (1 - delta)
        total = weight_measured(count, flat, scratch)
    else:
        scale = 1 - delta
        total = weight_censored(kind, count, flat, sensor.table, scratch)
    outlier = epsilon * outlier_likelihood(kind, z_min, z_max, sensor.rays.outlier_tail)
    ahead = likelihood_before(kind, z, z_min, z_max, entry, sensor)
    density = (1 - epsilon) * (total * scale + behind + ahead + lost) + outlier
    return kind, count, scale, behind, lost, dropout, outlier, density


@inline
def in_cells(sensor: Fields, resolution: float) -> SensorModel:
    """Return a sensor model with lengths in cells.

    Args:
        sensor: Fields of :class:`SensorModel`, in metres, with those of :class:`RayModel`.
        resolution: Side of a cell (m).

    Returns:
        The model, in cells.
    """
    sigma, epsilon, delta, rays, table = sensor
    return SensorModel(sigma / resolution, epsilon, delta, RayModel(*rays), table)


@inline
def make_scratch(rows: int, cols: int) -> RayScratch:
    """Return working memory for any ray through a grid.

    Args:
        rows: The grid's rows.
        cols: The grid's columns.

    Returns:
        Arrays that are not initialised.
    """
    longest = rows + cols + CHUNK
    return RayScratch(
        np.empty(longest, np.int64),
        np.empty(longest, np.float32),
        np.empty(longest, np.float32),
        np.empty(longest, np.float32),
    )


@inline
def place_laser(pose: Any, mount: Any, steps: Any, k: int, grid: GridGeometry, place: Any) -> None:
    """Compute where a laser is for a pose of the robot, or for one that is displaced along one coordinate.

    Args:
        pose: The robot's pose (3,): x, y (m), heading (rad).
        mount: The laser's pose (3,) in the robot's frame.
        steps: Displacements (3,) in m, m, rad.
        k: 0 for the pose itself; 1, 3, 5 for x, y, heading increased by their step; 2, 4, 6 for them decreased.
        grid: The grid's place.
        place: Filled (4,): the laser's x and y relative to the grid (cells), cosine and sine of its heading.
    """
    x, y, theta = pose[0], pose[1], pose[2]
    per_metre = 1 / grid.resolution
    if k:
        change = steps[(k - 1) // 2] if k % 2 else -steps[(k - 1) // 2]
        if k < 3:
            x += change
        elif k < 5:
            y += change
        else:
            theta += change
    cos, sin = math.cos(theta), math.sin(theta)
    place[0] = (x + cos * mount[0] - sin * mount[1] - grid.x) * per_metre
    place[1] = (y + sin * mount[0] + cos * mount[1] - grid.y) * per_metre
    place[2], place[3] = math.cos(theta + mount[2]), math.sin(theta + mount[2])


@inline
def add_gradient(a: float, b: float, c: float, result: Any) -> None:
    """Add one ray's gradient, and its outer product, to the result of :func:`pose_likelihood`.

    Args:
        a: The gradient's component along x.
        b: The gradient's component along y.
        c: The gradient's component along the heading.
        result: Changed in place (11,).
    """
    result[1] += a
    result[2] += b
    result[3] += c
    result[4] += a * a
    result[5] += a * b
    result[6] += a * c
    result[7] += b * b
    result[8] += b * c
    result[9] += c * c


@kernel
def pose_likelihood(
    rays: Any,
    limits: Any,
    placement: Any,
    geometry: Fields,
    stopping: Any,
    sensor: Fields,
    result: Any,
) -> None:
    """Compute the log-likelihood of a scan from a pose of the robot, its gradient, and rays' outer products.

    A ray's stopping probabilities are those of the direction next to its own. Derivatives are central differences.
    The outer products are those of single rays' gradients (Berndt, Hall, Hall and Hausman 1974); the caller centres
    their sum. A ray that misses the grid counts as an outlier.

    Args:
        rays: (N, 5) float64, in the frame of the laser: where each beam starts (x, y), its direction, its range (m).
        limits: range_min and range_max (m).
        placement: The robot's pose (3,), the laser's pose in the robot's frame (3,), and the differences' steps (3,)
            in m, m, rad; where the steps are 0 the log-likelihood alone is computed.
        geometry: Fields of :class:`GridGeometry`.
        stopping: Stopping probabilities (directions, rows, cols) float32, of rays about the angles k pi / directions.
        sensor: Fields of :class:`SensorModel`.
        result: Filled (11,): log-likelihood, gradient (3), sums of the rays' outer products xx, xy, xt, yy, yt, tt,
            number of rays that cross the grid.
    """
    pose, mount, steps = placement
    grid = GridGeometry(*geometry)
    directions = stopping.shape[0]
    scratch = make_scratch(stopping.shape[1], stopping.shape[2])
    per_metre, model = 1 / grid.resolution, in_cells(sensor, grid.resolution)
    cells = (limits[0] * per_metre, limits[1] * per_metre)
    gradient, places = np.empty(3), np.empty((7, 4))
    result[:] = 0.0
    evaluations = 7 if steps[0] > 0 else 1
    for k in range(evaluations):
        place_laser(pose, mount, steps, k, grid, places[k])
    for i in range(len(rays)):
        here = 0.0
        counts = True
        dx = places[0, 2] * rays[i, 2] - places[0, 3] * rays[i, 3]
        dy = places[0, 3] * rays[i, 2] + places[0, 2] * rays[i, 3]
        part = stopping[math.floor(math.atan2(dy, dx) / math.pi * directions + 0.5) % directions]
        for k in range(evaluations):
            cos, sin = places[k, 2], places[k, 3]
            x = places[k, 0] + (cos * rays[i, 0] - sin * rays[i, 1]) * per_metre
            y = places[k, 1] + (sin * rays[i, 0] + cos * rays[i, 1]) * per_metre
            dx, dy = cos * rays[i, 2] - sin * rays[i, 3], sin * rays[i, 2] + cos * rays[i, 3]
            ray = (x, y, dx, dy, rays[i, 4] * per_metre)
            kind, count, _, _, _, _, _, density = trace_ray(ray, cells, part, 0, model, scratch)
            if count < 0:
                kind = classify_range(ray[4], cells[0], cells[1], model.sigma)[0]
                density = model.epsilon * outlier_likelihood(kind, cells[0], cells[1], model.rays.outlier_tail)
            log_density = math.log(density * per_metre if kind == MEASURED else density)
            if k == 0:
                here, counts = log_density, count >= 0
            elif k % 2:
                gradient[(k - 1) // 2] = log_density
            else:
                gradient[(k - 1) // 2] = (gradient[(k - 1) // 2] - log_density) / (2 * steps[(k - 1) // 2])
        result[0] += here
        result[10] += counts
        if evaluations > 1:
            add_gradient(gradient[0], gradient[1], gradient[2], result)


@kernel
def expect(
    arrays: Fields,
    selection: Fields,
    geometry: Fields,
    stopping: Any,
    skip: Any,
    sensor: Fields,
    sums: Any,
    totals: Any,
) -> None:
    """Compute the E step over some rays.

    Args:
        arrays: Fields of :class:`RayArrays`.
        selection: Fields of :class:`RaySlice`.
        geometry: Fields of :class:`GridGeometry`.
        stopping: Stopping probabilities (rows, cols) float32.
        skip: Per ray (N,) int32 the number of its first cells that are skipped: they receive nothing, and what little
            they stop is neglected; empty: none.
        sensor: Fields of :class:`SensorModel`.
        sums: (rows * cols, 2 or 3) float32, added to: expected HITS and PASSES and, where there is a third column,
            the sum of squares of the rays' probabilities to have reached the cell (SQUARES_OF_ARRIVAL).
        totals: (7,) float64, added to: LOG_LIKELIHOOD, the expected number of STOPS in the grid but for dropouts,
            their SQUARES ((z - s)^2 in sigma^2), the expected number of OUTLIERS, RAYS that cross the grid, their
            TRACED_CELLS, and the expected number of DROPOUTS.
    """
    scans, first_rays, rays = arrays
    subset, grid = RaySlice(*selection), GridGeometry(*geometry)
    with_arrival = sums.shape[1] > 2
    scratch = make_scratch(stopping.shape[0], stopping.shape[1])
    per_metre, model = 1 / grid.resolution, in_cells(sensor, grid.resolution)
    scan = np.searchsorted(first_rays, subset.begin, side="right") - 1
    for i in range(subset.begin, subset.end):
        while i >= first_rays[scan + 1]:
            scan += 1
        if not is_selected(i + scan, subset):
            continue
        x, y = (scans[scan, 0] - grid.x) * per_metre, (scans[scan, 1] - grid.y) * per_metre
        limits = (scans[scan, 2] * per_metre, scans[scan, 3] * per_metre)
        ray = (x, y, float(rays[i, 0]), float(rays[i, 1]), float(rays[i, 2]) * per_metre)
        skipped = skip[i] if len(skip) else 0
        traced = trace_ray(ray, limits, stopping, skipped, model, scratch)
        kind, count, scale, behind, lost, dropout, outlier, density = traced
        if count < 0:
            continue
        weight = (1 - model.epsilon) / density
        factor = np.float32(scale * weight)
        if kind == MEASURED:
            stops, squares = moments_measured(count, factor, scratch)
        else:
            stops, squares = moments_censored(CENSORED_MOMENTS + kind, count, factor, model.table, scratch)
        kept = max(1 - lost * weight, SMALLEST_SHARE)
        scatter(count, np.float32(behind * weight), scratch, sums, with_arrival, np.float32(kept))
        totals[LOG_LIKELIHOOD] += math.log(density * per_metre if kind == MEASURED else density)
        totals[STOPS] += stops
        totals[SQUARES] += squares
        totals[OUTLIERS] += outlier / density
        totals[RAYS] += 1
        totals[TRACED_CELLS] += count
        totals[DROPOUTS] += dropout * weight


@kernel
def count_skips(arrays: Fields, begin: int, end: int, geometry: Fields, marked: Any, skip: Any) -> None:
    """Count the cells that each ray crosses before it reaches a marked one.

    Args:
        arrays: Fields of :class:`RayArrays`.
        begin: Index of the first ray.
        end: Index after the last ray.
        geometry: Fields of :class:`GridGeometry`.
        marked: Marked cells (rows, cols) bool.
        skip: Filled (N,) int32 for rays from ``begin`` to ``end``.
    """
    scans, first_rays, rays = arrays
    grid = GridGeometry(*geometry)
    rows, cols = marked.shape
    flat = marked.reshape(-1)
    scan = np.searchsorted(first_rays, begin, side="right") - 1
    for i in range(begin, end):
        while i >= first_rays[scan + 1]:
            scan += 1
        x, y = (scans[scan, 0] - grid.x) / grid.resolution, (scans[scan, 1] - grid.y) / grid.resolution
        skip[i] = 0
        if not (-FAR_CELLS < x < cols + FAR_CELLS and -FAR_CELLS < y < rows + FAR_CELLS):
            continue
        first, last, start, major, minor, offset, slope, _, _ = cells_along_ray(
            x, y, float(rays[i, 0]), float(rays[i, 1]), rows, cols
        )
        step = first
        c, along = start + first * major, offset + first * slope
        while step <= last and not flat[np.uintp(c + (along >> SHIFT) * minor)]:
            step += 1
            c += major
            along += slope
        skip[i] = max(step - first, 0)
