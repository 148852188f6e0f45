"""Compiled kernels of the inverse mappers: from one scan's ranges to the cells that its rays cross.

A ray is Bresenham's line from the sensor's cell to the cell of its end point, stepped along its major axis. Of a line
with n steps along the major and m <= n cells along the minor axis, step k lies at minor offset floor(k m / n + 1/2).
The offset is computed in fixed point with 40 fractional bits, so that no step depends on the one before it. The slope
is the smallest whole number above 2^40 m / n; a step's offset is therefore too large by less than 1 / 2n, and the
result is exact for lines of up to 700,000 cells. Clipping to the grid is exact as well: it selects a range of k and
moves no cell.

Lengths are in metres. Cells are given by row and column, in the plane (the corner of cell (0, 0) is the map's origin)
or in the grid (relative to its first cell). Flat indices are row * cols + col.

Numba's cache watches only this file: constants that the kernels use must stand here, model parameters are arguments.
Numba recognises a plain tuple two to three times as fast as a named one, which matters for calls of some 50 us:
callers pass the fields of named tuples as plain tuples, and the kernels name them.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from prim.arrays import FloatArray
from prim.compiled import inline, kernel
from prim.errors import UsageError
from prim.scan import Scan
from prim.se2 import MAX_COORDINATE, Pose2D

BORDER_SLACK = 1e-3
"""A point less than this (cells) below a cell's border counts as on the border, and so belongs to the cell above.

0.3 / 0.1 is 2.9999999999999996, and a range in single precision is off by up to 1e-4 cells: without the slack a wall
on a border would be split between the cells at its two sides.
"""

SHIFT = 40
ONE = float(1 << SHIFT)
HALF = 1 << (SHIFT - 1)
"""The fixed-point format of minor offsets: number of fractional bits, 1 and 1/2."""

MAX_STEPS = float(1 << 21)
"""No ray is followed over more cells than this, and no scan is used from farther off the grid (cells)."""

TABLE_MARGIN_CELLS = 4.0
"""How far (cells) the table of an inverse sensor model extends beyond the model's reach.

No cell that a line visits within the reach has its centre farther out.
"""

BLOCK = 32
"""Rays whose lines are computed together: few enough for the first-level cache."""

SKIPPED, HIT, NO_RETURN = 0, 1, 2
"""What a range is, see :func:`classify`."""

FREE, OCCUPIED, UNSEEN = 0, 1, 2
"""The states of a cell in a deterministic map."""


Fields = tuple[Any, ...]
"""The fields of a named tuple, as a plain one."""


class ScanArrays(NamedTuple):
    """A scan and its pose as the kernels take them, see :func:`scan_arrays`.

    Attributes:
        ranges: Measured ranges (N,) in m.
        directions: Unit vectors (N, 2) of the beams in the laser's frame.
        x: The laser's x (m) in the map frame.
        y: The laser's y (m) in the map frame.
        cos: Cosine of the laser's heading.
        sin: Sine of the laser's heading.
        range_min: The sensor's shortest range (m).
        range_max: The sensor's longest range (m).
    """

    ranges: NDArray[np.floating]
    directions: FloatArray
    x: float
    y: float
    cos: float
    sin: float
    range_min: float
    range_max: float


class GridOrigin(NamedTuple):
    """Where a grid's array begins.

    Attributes:
        row: Row in the plane of the array's first row.
        col: Column in the plane of the array's first column.
        inverse_resolution: Cells per metre.
    """

    row: int
    col: int
    inverse_resolution: float


class SensorCell(NamedTuple):
    """The cell of the sensor: in the plane, and relative to the grid's first cell."""

    plane_row: int
    plane_col: int
    row: int
    col: int


class InverseModelTable(NamedTuple):
    """An inverse sensor model in log-odds, tabulated over the distance from the measured range.

    Attributes:
        reach: Within this distance (m) of the range the model differs from its constant values before and behind it.
        log_odds: The model (2 M + 1,) float32 at distances from -M to M times ``spacing``; it extends beyond
            ``reach`` by TABLE_MARGIN_CELLS cells at both ends.
        spacing: Distance (m) between entries.
    """

    reach: float
    log_odds: NDArray[np.float32]
    spacing: float


def scan_arrays(scan: Scan, pose: Pose2D) -> Fields:
    """Return the fields of :class:`ScanArrays`, as a plain tuple.

    Args:
        scan: The scan.
        pose: The laser's pose in the map frame.

    Returns:
        The fields.

    Raises:
        UsageError: The heading or the scan's geometry is not finite.
    """
    if not math.isfinite(pose.theta):
        raise UsageError(f"the laser's heading is {pose.theta:g}: it must be finite")
    if not (math.isfinite(scan.angle_min + scan.angle_increment + scan.range_min) and scan.range_max > 0):
        raise UsageError(f"the scan cannot be used: {scan.problem}")
    cos, sin = math.cos(pose.theta), math.sin(pose.theta)
    return scan.ranges, scan.directions, pose.x, pose.y, cos, sin, scan.range_min, scan.range_max


def scan_extent(scan: Scan, pose: Pose2D, resolution: float) -> tuple[int, int, int, int]:
    """Return the extent of a scan, see :func:`hit_extent`.

    Args:
        scan: The scan.
        pose: The laser's pose in the map frame.
        resolution: Side of a cell (m).

    Returns:
        First row, first column, last row and last column (both ends included).

    Raises:
        UsageError: The pose or the scan's geometry is not finite, or the laser beyond MAX_COORDINATE.
    """
    if not (abs(pose.x) <= MAX_COORDINATE and abs(pose.y) <= MAX_COORDINATE):  # so for NaN
        where = f"{pose.x:g} {pose.y:g}"
        raise UsageError(f"the laser's position is {where}: it must be finite and within {MAX_COORDINATE:g} m")
    extent: tuple[int, int, int, int] = hit_extent(scan_arrays(scan, pose), 1 / resolution)
    return extent


@inline
def classify(z: float, range_min: float, range_max: float) -> int:
    """Classify a range (m).

    Args:
        z: The measured range.
        range_min: The sensor's shortest range.
        range_max: The sensor's longest range.

    Returns:
        SKIPPED for NaN, -inf and ranges below range_min, NO_RETURN from range_max on, else HIT. Limits are compared
        in the ranges' single precision, as :meth:`prim.scan.Scan.outcomes` does.
    """
    if not (z >= np.float32(range_min) and z > 0):
        return SKIPPED
    return HIT if z < np.float32(range_max) else NO_RETURN


@inline
def cell(coordinate: float, inverse_resolution: float) -> int:
    """Return the index of the cell that holds a coordinate, see :func:`mapping.grid.cell_of`.

    Args:
        coordinate: The coordinate (m).
        inverse_resolution: Cells per metre.

    Returns:
        The index in the plane.
    """
    return math.floor(coordinate * inverse_resolution + BORDER_SLACK)


@inline
def is_near(coordinate: float, inverse_resolution: float, first_cell: int, cells: int) -> bool:
    """Return whether a coordinate lies within MAX_STEPS cells of the grid along one axis; False for NaN.

    Args:
        coordinate: The coordinate (m).
        inverse_resolution: Cells per metre.
        first_cell: Index in the plane of the grid's first cell along the axis.
        cells: The grid's number of cells along the axis.

    Returns:
        Whether it is near enough.
    """
    return -MAX_STEPS < coordinate * inverse_resolution - first_cell < cells + MAX_STEPS


@inline
def is_sensor_near(scan: ScanArrays, origin: GridOrigin, rows: int, cols: int) -> bool:
    """Return whether the sensor's position is finite and within MAX_STEPS cells of the grid.

    Args:
        scan: The scan.
        origin: Where the grid begins.
        rows: The grid's rows.
        cols: The grid's columns.

    Returns:
        Whether the scan can be used.
    """
    near_x = is_near(scan.x, origin.inverse_resolution, origin.col, cols)
    return near_x and is_near(scan.y, origin.inverse_resolution, origin.row, rows)


@inline
def sensor_cell(scan: ScanArrays, origin: GridOrigin) -> SensorCell:
    """Return the cell of the sensor.

    Args:
        scan: The scan.
        origin: Where the grid begins.

    Returns:
        Its row and column in the plane and in the grid.
    """
    plane_row, plane_col = cell(scan.y, origin.inverse_resolution), cell(scan.x, origin.inverse_resolution)
    return SensorCell(plane_row, plane_col, plane_row - origin.row, plane_col - origin.col)


@inline
def bresenham_line(rows: int, cols: int, width: int, dx: float, dy: float) -> tuple[int, int, int, int]:
    """Return the line over a number of rows and columns of a flat grid.

    A line within one cell has 0 steps and, where it is extended, follows the beam's own direction.

    Args:
        rows: Rows from the first to the last cell, signed.
        cols: Columns from the first to the last cell, signed.
        width: The grid's number of columns.
        dx: x of the beam's direction.
        dy: y of the beam's direction.

    Returns:
        The number of steps along the major axis, the slope (minor cells per step, fixed point), and the strides in
        the flat grid along the major and the minor axis.
    """
    row_stride = width if dy >= 0 else -width
    col_stride = 1 if dx >= 0 else -1
    rows, cols = abs(rows), abs(cols)
    if rows == 0 and cols == 0:
        dx, dy = abs(dx), abs(dy)
        if dx >= dy:
            return 0, fixed_point_slope(dy, dx), col_stride, row_stride
        return 0, fixed_point_slope(dx, dy), row_stride, col_stride
    if cols >= rows:
        return cols, fixed_point_slope(rows, cols), col_stride, row_stride
    return rows, fixed_point_slope(cols, rows), row_stride, col_stride


@inline
def fixed_point_slope(minor: float, major: float) -> int:
    """Return the smallest whole number above minor / major * 2^40 (in double precision: within 2^-13 of it).

    Args:
        minor: Extent along the minor axis, not negative.
        major: Extent along the major axis, above 0.

    Returns:
        The slope in fixed point.
    """
    return int(minor * ONE / major) + 1


@inline
def clip(row: int, col: int, rows: int, cols: int, major: int, minor: int, slope: int, last: int) -> tuple[int, int]:
    """Clip a line's steps 0..last to the grid.

    Args:
        row: Row of step 0 in the grid.
        col: Column of step 0 in the grid.
        rows: The grid's rows.
        cols: The grid's columns.
        major: Stride along the major axis.
        minor: Stride along the minor axis.
        slope: The fixed-point slope.
        last: The line's last step.

    Returns:
        The first and the last step within the grid; no step is where the first is larger.
    """
    if abs(major) == 1:
        return _clip(col, cols, major > 0, row, rows, minor > 0, slope, last)
    return _clip(row, rows, major > 0, col, cols, minor > 0, slope, last)


@inline
def _clip(
    start: int, size: int, up: bool, minor_start: int, minor_size: int, minor_up: bool, slope: int, last: int
) -> tuple[int, int]:
    """Clip for one orientation: steps that keep both coordinates within [0, size) and [0, minor_size)."""
    enter = -minor_start if minor_up else minor_start - minor_size + 1
    leave = minor_size - minor_start if minor_up else minor_start + 1
    if leave <= 0 or enter > last + 1:
        return 1, 0
    first = first_step(enter, slope) if enter > 0 else 0
    if leave <= last + 1:  # else it stays within
        last = min(last, first_step(leave, slope) - 1)
    first = max(first, -start if up else start - size + 1)
    return first, min(last, size - 1 - start if up else start)


@inline
def first_step(minor: int, slope: int) -> int:
    """Return the first step whose minor offset (step * slope + HALF) >> SHIFT is at least ``minor``.

    Args:
        minor: The minor offset (cells), above 0.
        slope: The fixed-point slope.

    Returns:
        The step.
    """
    return ((minor << SHIFT) - HALF + slope - 1) // slope


@inline
def set_line(flat: Any, value: Any, start: int, first: int, last: int, slope: int, major: int, minor: int) -> None:
    """Set the cells of a line's steps first..last, four at a time: no store depends on the one before it.

    Args:
        flat: The flat grid, changed in place.
        value: The value.
        start: Flat index of step 0.
        first: First step.
        last: Last step; none is set where it is below ``first``.
        slope: The fixed-point slope.
        major: Stride along the major axis.
        minor: Stride along the minor axis.
    """
    p0, o0 = start + first * major, HALF + first * slope
    p1, o1, two_majors, two_slopes = p0 + major, o0 + slope, 2 * major, 2 * slope
    p2, o2, p3, o3 = p0 + two_majors, o0 + two_slopes, p1 + two_majors, o1 + two_slopes
    count = max(last - first + 1, 0)
    for _ in range(count >> 2):
        flat[np.uintp(p0 + (o0 >> SHIFT) * minor)] = value
        flat[np.uintp(p1 + (o1 >> SHIFT) * minor)] = value
        flat[np.uintp(p2 + (o2 >> SHIFT) * minor)] = value
        flat[np.uintp(p3 + (o3 >> SHIFT) * minor)] = value
        p0, p1, p2, p3 = p0 + 2 * two_majors, p1 + 2 * two_majors, p2 + 2 * two_majors, p3 + 2 * two_majors
        o0, o1, o2, o3 = o0 + 2 * two_slopes, o1 + 2 * two_slopes, o2 + 2 * two_slopes, o3 + 2 * two_slopes
    for _ in range(count & 3):
        flat[np.uintp(p0 + (o0 >> SHIFT) * minor)] = value
        p0, o0 = p0 + major, o0 + slope


@inline
def add_line(flat: Any, value: Any, start: int, first: int, last: int, slope: int, major: int, minor: int) -> None:
    """Add to the cells of a line's steps first..last, see :func:`set_line`.

    Args:
        flat: The flat grid, changed in place.
        value: The value.
        start: Flat index of step 0.
        first: First step.
        last: Last step; none is changed where it is below ``first``.
        slope: The fixed-point slope.
        major: Stride along the major axis.
        minor: Stride along the minor axis.
    """
    p0, o0 = start + first * major, HALF + first * slope
    p1, o1, two_majors, two_slopes = p0 + major, o0 + slope, 2 * major, 2 * slope
    p2, o2, p3, o3 = p0 + two_majors, o0 + two_slopes, p1 + two_majors, o1 + two_slopes
    count = max(last - first + 1, 0)
    for _ in range(count >> 2):
        flat[np.uintp(p0 + (o0 >> SHIFT) * minor)] += value
        flat[np.uintp(p1 + (o1 >> SHIFT) * minor)] += value
        flat[np.uintp(p2 + (o2 >> SHIFT) * minor)] += value
        flat[np.uintp(p3 + (o3 >> SHIFT) * minor)] += value
        p0, p1, p2, p3 = p0 + 2 * two_majors, p1 + 2 * two_majors, p2 + 2 * two_majors, p3 + 2 * two_majors
        o0, o1, o2, o3 = o0 + 2 * two_slopes, o1 + 2 * two_slopes, o2 + 2 * two_slopes, o3 + 2 * two_slopes
    for _ in range(count & 3):
        flat[np.uintp(p0 + (o0 >> SHIFT) * minor)] += value
        p0, o0 = p0 + major, o0 + slope


@kernel
def hit_extent(arrays: Fields, inverse_resolution: float) -> tuple[int, int, int, int]:
    """Return the extent, in cells of the plane, of the sensor and the end points of all hits.

    Args:
        arrays: Fields of :class:`ScanArrays`.
        inverse_resolution: Cells per metre.

    Returns:
        First row, first column, last row and last column (both ends included).
    """
    scan = ScanArrays(*arrays)
    far = min(scan.range_max, MAX_STEPS / inverse_resolution)
    first_row = last_row = cell(scan.y, inverse_resolution)
    first_col = last_col = cell(scan.x, inverse_resolution)
    for i in range(scan.ranges.shape[0]):
        z = float(scan.ranges[i])
        if classify(z, scan.range_min, scan.range_max) == HIT and z < far:
            u, v = scan.directions[i, 0], scan.directions[i, 1]
            col = cell(scan.x + z * (scan.cos * u - scan.sin * v), inverse_resolution)
            row = cell(scan.y + z * (scan.sin * u + scan.cos * v), inverse_resolution)
            first_row, last_row = min(first_row, row), max(last_row, row)
            first_col, last_col = min(first_col, col), max(last_col, col)
    return first_row, first_col, last_row, last_col


@inline
def compute_lines(
    scan: ScanArrays, sensor: SensorCell, inverse_resolution: float, width: int, begin: int, lines: Any, beams: Any
) -> int:
    """Compute the lines of BLOCK rays before any is walked, so that the rays do not depend on each other.

    Args:
        scan: The scan.
        sensor: The sensor's cell.
        inverse_resolution: Cells per metre.
        width: The grid's number of columns.
        begin: Index of the first ray.
        lines: Filled (BLOCK, 7) int64: what the range is (see :func:`classify`), steps, slope, major stride, minor
            stride, and the end point's row and column in the grid.
        beams: Filled (BLOCK, 3) float64: the range (m) that is used, and the beam's direction in the map frame.

    Returns:
        The number of rays in the block.
    """
    count = min(BLOCK, scan.ranges.shape[0] - begin)
    far = min(scan.range_max, MAX_STEPS / inverse_resolution)
    for i in range(count):
        z = float(scan.ranges[begin + i])
        kind = classify(z, scan.range_min, scan.range_max)
        z = min(z, far) if kind != SKIPPED else 0.0
        u, v = scan.directions[begin + i, 0], scan.directions[begin + i, 1]
        dx, dy = scan.cos * u - scan.sin * v, scan.sin * u + scan.cos * v
        cols = cell(scan.x + z * dx, inverse_resolution) - sensor.plane_col
        rows = cell(scan.y + z * dy, inverse_resolution) - sensor.plane_row
        steps, slope, major, minor = bresenham_line(rows, cols, width, dx, dy)
        lines[i, 0], lines[i, 1], lines[i, 2], lines[i, 3], lines[i, 4] = kind, steps, slope, major, minor
        lines[i, 5], lines[i, 6] = sensor.row + rows, sensor.col + cols
        beams[i, 0], beams[i, 1], beams[i, 2] = z, dx, dy
    return int(count)


@inline
def line_of(lines: Any, i: int) -> tuple[Any, ...]:
    """Return a row of the lines that :func:`compute_lines` fills.

    Args:
        lines: The lines (BLOCK, 7).
        i: The row.

    Returns:
        Its seven numbers.
    """
    return lines[i, 0], lines[i, 1], lines[i, 2], lines[i, 3], lines[i, 4], lines[i, 5], lines[i, 6]


@kernel
def mark_scan(states: Any, place: Fields, arrays: Fields) -> Any:
    """Enter one scan into a grid of states (the paper's III-A): all rays free their cells, then hits are marked.

    A ray does not free the cell that it hits; a ray without a return frees its cells up to range_max.

    Args:
        states: States of cells (rows, cols) uint8, changed in place.
        place: Fields of :class:`GridOrigin`.
        arrays: Fields of :class:`ScanArrays`.

    Returns:
        Flat indices (M,) of the cells that were hit.
    """
    origin, scan = GridOrigin(*place), ScanArrays(*arrays)
    rows, cols = states.shape
    flat = states.reshape(-1)
    hits = np.empty(scan.ranges.shape[0], np.int64)
    count = 0
    if not is_sensor_near(scan, origin, rows, cols):
        return hits[:0]
    sensor = sensor_cell(scan, origin)
    row, col = sensor.row, sensor.col
    starts_inside = 0 <= row < rows and 0 <= col < cols
    start = row * cols + col
    lines, beams = np.empty((BLOCK, 7), np.int64), np.empty((BLOCK, 3), np.float64)
    for begin in range(0, scan.ranges.shape[0], BLOCK):
        block = compute_lines(scan, sensor, origin.inverse_resolution, cols, begin, lines, beams)
        for i in range(block):
            kind, steps, slope, major, minor, end_row, end_col = line_of(lines, i)
            if kind == SKIPPED:
                continue
            first, last = 0, steps
            ends_inside = 0 <= end_row < rows and 0 <= end_col < cols
            if not (starts_inside and ends_inside):
                first, last = clip(row, col, rows, cols, major, minor, slope, steps)
            set_line(flat, FREE, start, first, last, slope, major, minor)
            if kind == HIT and ends_inside:
                hits[count] = end_row * cols + end_col
                count += 1
    for i in range(count):
        flat[hits[i]] = OCCUPIED
    return hits[:count]


@kernel
def add_log_odds(log_odds: Any, place: Fields, arrays: Fields, inverse_model: Fields) -> None:
    """Add one scan to a grid of log-odds (the paper's Eqs. 3 and 4), one update per ray and cell.

    Args:
        log_odds: Log-odds of cells (rows, cols) float32, changed in place.
        place: Fields of :class:`GridOrigin`.
        arrays: Fields of :class:`ScanArrays`.
        inverse_model: Fields of :class:`InverseModelTable`.
    """
    origin, scan, model = GridOrigin(*place), ScanArrays(*arrays), InverseModelTable(*inverse_model)
    rows, cols = log_odds.shape
    flat = log_odds.reshape(-1)
    inverse_resolution = origin.inverse_resolution
    resolution = 1 / inverse_resolution
    if not is_sensor_near(scan, origin, rows, cols):
        return
    sensor = sensor_cell(scan, origin)
    row, col = sensor.row, sensor.col
    starts_inside = 0 <= row < rows and 0 <= col < cols
    start = row * cols + col
    centre_x, centre_y = (
        (sensor.plane_col + 0.5) * resolution - scan.x,
        (sensor.plane_row + 0.5) * resolution - scan.y,
    )
    lines, beams = np.empty((BLOCK, 7), np.int64), np.empty((BLOCK, 3), np.float64)
    for begin in range(0, scan.ranges.shape[0], BLOCK):
        block = compute_lines(scan, sensor, inverse_resolution, cols, begin, lines, beams)
        for i in range(block):
            kind, steps, slope, major, minor, end_row, end_col = line_of(lines, i)
            if kind == SKIPPED:
                continue
            z = beams[i, 0]
            along_x = abs(major) == 1
            first, last, free = 0, steps, steps
            if kind == HIT:  # walk on to the cell of the point at z + reach, at the same slope
                beyond = (
                    (scan.x + (z + model.reach) * beams[i, 1])
                    if along_x
                    else (scan.y + (z + model.reach) * beams[i, 2])
                )
                last = abs(cell(beyond, inverse_resolution) - (sensor.plane_col if along_x else sensor.plane_row))
                free = last_free_step(z - model.reach - 1.25 * resolution, z, steps)
            if starts_inside and 0 <= end_row < rows and 0 <= end_col < cols:
                while last > steps and not is_step_inside(row, col, rows, cols, major, minor, slope, last):
                    last -= 1
            else:
                first, last = clip(row, col, rows, cols, major, minor, slope, last)
            free = min(free, last)
            add_line(flat, model.log_odds[0], start, first, free, slope, major, minor)
            along, across = (centre_x, centre_y) if along_x else (centre_y, centre_x)
            rest = (start, max(first, free + 1), last, slope, major, minor)
            add_sensor_model(flat, rest, along, across, resolution, z, model)


@inline
def last_free_step(distance: float, z: float, steps: int) -> int:
    """Return the last step of a line whose cell's centre is surely no farther away than a distance.

    Args:
        distance: The distance (m).
        z: The line's length (m).
        steps: The line's number of steps.

    Returns:
        The step; -1 where there is none.
    """
    return int(steps * distance / z) if distance > 0 and steps > 0 else -1


@inline
def add_sensor_model(
    flat: Any, line: Any, along: float, across: float, resolution: float, z: float, model: InverseModelTable
) -> None:
    """Add the inverse sensor model to a line's cells, by the distances of their centres, in single precision.

    Args:
        flat: The flat grid of log-odds, changed in place.
        line: Flat index of step 0, first and last step, fixed-point slope, major and minor stride.
        along: From the sensor to the centre of step 0's cell along the major axis (m).
        across: The same along the minor axis (m).
        resolution: Side of a cell (m).
        z: The measured range (m).
        model: The model.
    """
    start, first, last, slope, major, minor = line
    table = model.log_odds
    middle, top = np.float32((table.shape[0] - 1) / 2), np.uint32(table.shape[0] - 2)
    scale = np.float32(1 / model.spacing)
    shift = middle - np.float32(z) * scale
    ahead_step = np.float32(resolution if major > 0 else -resolution)
    aside_step = np.float32(resolution if minor > 0 else -resolution)
    for step in range(first, last + 1):
        aside = (step * slope + HALF) >> SHIFT
        u = np.float32(along) + np.float32(step) * ahead_step
        v = np.float32(across) + np.float32(aside) * aside_step
        place = np.sqrt(u * u + v * v) * scale + shift
        index = min(np.uint32(np.int32(place)), top)
        lower = table[index]
        odds = lower + (place - np.float32(np.int32(index))) * (table[index + np.uint32(1)] - lower)
        flat[np.uintp(start + step * major + aside * minor)] += odds


@inline
def is_step_inside(row: int, col: int, rows: int, cols: int, major: int, minor: int, slope: int, step: int) -> bool:
    """Return whether a line's step lies within the grid.

    Args:
        row: Row of step 0 in the grid.
        col: Column of step 0 in the grid.
        rows: The grid's rows.
        cols: The grid's columns.
        major: Stride along the major axis.
        minor: Stride along the minor axis.
        slope: The fixed-point slope.
        step: The step.

    Returns:
        Whether its cell is one of the grid's.
    """
    aside = (step * slope + HALF) >> SHIFT
    if abs(major) == 1:
        col, row = (col + step if major > 0 else col - step), (row + aside if minor > 0 else row - aside)
    else:
        row, col = (row + step if major > 0 else row - step), (col + aside if minor > 0 else col - aside)
    return 0 <= row < rows and 0 <= col < cols
