"""The compiled kernels: from one scan's ranges to the cells that its rays cross.

A ray is Bresenham's line from the sensor's cell to the cell of its end point, stepped along its major axis. Of n
steps, step k lies at minor offset floor(k * m / n + 1/2) for m minor cells in all; here that is computed in
40-bit fixed point, which lets no cell wait for the one before it. The slope is the next whole number above
2^40 m / n, so that a step's offset is too large by less than 1 / 2n: the result is exact for lines of up to 700,000
cells. Clipping to the grid is exact as well: it picks the range of k and moves no cell.

Compiled code is cached beside this file and made anew when this file changes, so that every constant it uses must
stand here.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from prim.compiled import inline, kernel

BORDER_SLACK = 1e-3
"""A point this close below a cell's border (in cells) counts as on it.

0.3 / 0.1 is 2.9999999999999996, and a range in single precision is off by up to 1e-4 cells: without the slack a wall
that stands on a border would be torn between the cells at its two sides.
"""

SHIFT = 40
ONE = float(1 << SHIFT)
HALF = 1 << (SHIFT - 1)
MAX_STEPS = float(1 << 21)
"""No ray is followed over more cells than this, and no scan is used from farther off the grid."""

MARGIN_CELLS = 4.0
"""How far beyond its reach (in cells) the table of an inverse sensor model goes on: no centre lies further off."""

BLOCK = 32
"""Rays whose lines are laid together: few enough for the fastest cache."""

SKIPPED, HIT, NO_RETURN = 0, 1, 2
FREE, OCCUPIED, UNSEEN = 0, 1, 2


@inline
def classify(z: float, range_min: float, range_max: float) -> int:
    """What a range is: SKIPPED (NaN, -inf, below range_min), HIT, or NO_RETURN (range_max and beyond)."""
    if not (z >= range_min and z > 0):
        return SKIPPED
    return HIT if z < range_max else NO_RETURN


@inline
def cell(coordinate: float, inverse_resolution: float) -> int:
    """As mapping.grid.cell_of."""
    return math.floor(coordinate * inverse_resolution + BORDER_SLACK)


@inline
def is_near(coordinate: float, inverse_resolution: float, first_cell: int, cells: int) -> bool:
    """Whether a coordinate (m) is a number, and lies within MAX_STEPS cells of the grid along one axis."""
    return -MAX_STEPS < coordinate * inverse_resolution - first_cell < cells + MAX_STEPS


@inline
def line(rows: int, cols: int, width: int, dx: float, dy: float) -> tuple[int, int, int, int]:
    """The line over so many rows and columns of a flat grid: steps, tilt, and strides along both of its axes.

    The tilt is the fixed-point number of minor cells per step. A line within one cell has 0 steps and goes on, if
    at all, along the beam's own direction (dx, dy).
    """
    row_stride = width if dy >= 0 else -width
    col_stride = 1 if dx >= 0 else -1
    rows, cols = abs(rows), abs(cols)
    if rows == 0 and cols == 0:
        dx, dy = abs(dx), abs(dy)
        if dx >= dy:
            return 0, tilt_of(dy, dx), col_stride, row_stride
        return 0, tilt_of(dx, dy), row_stride, col_stride
    if cols >= rows:
        return cols, tilt_of(rows, cols), col_stride, row_stride
    return rows, tilt_of(cols, rows), row_stride, col_stride


@inline
def tilt_of(minor: float, major: float) -> int:
    """The smallest whole number above minor / major * 2^40 (in double precision: within 2^-13 of it)."""
    return int(minor * ONE / major) + 1


@inline
def clip(row: int, col: int, rows: int, cols: int, major: int, minor: int, tilt: int, last: int) -> tuple[int, int]:
    """Of a line's steps 0..last the first and the last within the grid; none where the first is larger."""
    if abs(major) == 1:
        return _clip(col, cols, major > 0, row, rows, minor > 0, tilt, last)
    return _clip(row, rows, major > 0, col, cols, minor > 0, tilt, last)


@inline
def _clip(
    start: int, size: int, up: bool, minor_start: int, minor_size: int, minor_up: bool, tilt: int, last: int
) -> tuple[int, int]:
    """As clip, for one orientation: steps that keep both coordinates within [0, size) and [0, minor_size)."""
    enter = -minor_start if minor_up else minor_start - minor_size + 1
    leave = minor_size - minor_start if minor_up else minor_start + 1
    if leave <= 0 or enter > last + 1:
        return 1, 0
    first = first_step(enter, tilt) if enter > 0 else 0
    if leave <= last + 1:  # else it stays within
        last = min(last, first_step(leave, tilt) - 1)
    first = max(first, -start if up else start - size + 1)
    return first, min(last, size - 1 - start if up else start)


@inline
def first_step(minor: int, tilt: int) -> int:
    """The first step whose minor offset (step * tilt + HALF) >> SHIFT is at least ``minor`` > 0."""
    return ((minor << SHIFT) - HALF + tilt - 1) // tilt


@inline
def set_line(flat: Any, value: Any, start: int, first: int, last: int, tilt: int, major: int, minor: int) -> None:
    """Sets the cells of a line's steps first..last, four at a time: none of them waits for another."""
    p0, o0 = start + first * major, HALF + first * tilt
    p1, o1, two_majors, two_tilts = p0 + major, o0 + tilt, 2 * major, 2 * tilt
    p2, o2, p3, o3 = p0 + two_majors, o0 + two_tilts, p1 + two_majors, o1 + two_tilts
    count = max(last - first + 1, 0)
    for _ in range(count >> 2):
        flat[np.uintp(p0 + (o0 >> SHIFT) * minor)] = value
        flat[np.uintp(p1 + (o1 >> SHIFT) * minor)] = value
        flat[np.uintp(p2 + (o2 >> SHIFT) * minor)] = value
        flat[np.uintp(p3 + (o3 >> SHIFT) * minor)] = value
        p0, p1, p2, p3 = p0 + 2 * two_majors, p1 + 2 * two_majors, p2 + 2 * two_majors, p3 + 2 * two_majors
        o0, o1, o2, o3 = o0 + 2 * two_tilts, o1 + 2 * two_tilts, o2 + 2 * two_tilts, o3 + 2 * two_tilts
    for _ in range(count & 3):
        flat[np.uintp(p0 + (o0 >> SHIFT) * minor)] = value
        p0, o0 = p0 + major, o0 + tilt


@inline
def add_line(flat: Any, value: Any, start: int, first: int, last: int, tilt: int, major: int, minor: int) -> None:
    """As set_line, but adds to the cells."""
    p0, o0 = start + first * major, HALF + first * tilt
    p1, o1, two_majors, two_tilts = p0 + major, o0 + tilt, 2 * major, 2 * tilt
    p2, o2, p3, o3 = p0 + two_majors, o0 + two_tilts, p1 + two_majors, o1 + two_tilts
    count = max(last - first + 1, 0)
    for _ in range(count >> 2):
        flat[np.uintp(p0 + (o0 >> SHIFT) * minor)] += value
        flat[np.uintp(p1 + (o1 >> SHIFT) * minor)] += value
        flat[np.uintp(p2 + (o2 >> SHIFT) * minor)] += value
        flat[np.uintp(p3 + (o3 >> SHIFT) * minor)] += value
        p0, p1, p2, p3 = p0 + 2 * two_majors, p1 + 2 * two_majors, p2 + 2 * two_majors, p3 + 2 * two_majors
        o0, o1, o2, o3 = o0 + 2 * two_tilts, o1 + 2 * two_tilts, o2 + 2 * two_tilts, o3 + 2 * two_tilts
    for _ in range(count & 3):
        flat[np.uintp(p0 + (o0 >> SHIFT) * minor)] += value
        p0, o0 = p0 + major, o0 + tilt


@kernel
def end_extent(
    ranges: Any, directions: Any, pose: Any, limits: Any, inverse_resolution: float
) -> tuple[int, int, int, int]:
    """First and last row and column over the sensor's cell and the cells of all hits."""
    x, y, cos, sin = pose
    far = min(limits[1], MAX_STEPS / inverse_resolution)
    first_row = last_row = cell(y, inverse_resolution)
    first_col = last_col = cell(x, inverse_resolution)
    for i in range(ranges.shape[0]):
        z = float(ranges[i])
        if classify(z, limits[0], limits[1]) == HIT and z < far:
            u, v = directions[i, 0], directions[i, 1]
            col = cell(x + z * (cos * u - sin * v), inverse_resolution)
            row = cell(y + z * (sin * u + cos * v), inverse_resolution)
            first_row, last_row = min(first_row, row), max(last_row, row)
            first_col, last_col = min(first_col, col), max(last_col, col)
    return first_row, first_col, last_row, last_col


@inline
def lay_lines(
    ranges: Any,
    directions: Any,
    pose: Any,
    limits: Any,
    inverse_resolution: float,
    origin: Any,
    width: int,
    begin: int,
    lines: Any,
    beams: Any,
) -> int:
    """The lines of BLOCK rays from ``begin`` on, before any is walked: none of them waits for another.

    ``origin`` is the sensor's cell in the plane and in the grid, row and column each; ``width`` the grid's. Fills
    ``lines`` (BLOCK, 7) int64: kind, steps, tilt, major and minor stride, row and column of the end in the grid; and
    ``beams`` (BLOCK, 3): range in use, and direction in the plane. Returns how many there are.
    """
    count = min(BLOCK, ranges.shape[0] - begin)
    x, y, cos, sin = pose
    range_min, range_max = limits
    far = min(range_max, MAX_STEPS / inverse_resolution)
    plane_row, plane_col, row, col = origin
    for i in range(count):
        z = float(ranges[begin + i])
        kind = classify(z, range_min, range_max)
        z = min(z, far) if kind != SKIPPED else 0.0
        u, v = directions[begin + i, 0], directions[begin + i, 1]
        dx, dy = cos * u - sin * v, sin * u + cos * v
        cols = cell(x + z * dx, inverse_resolution) - plane_col
        rows = cell(y + z * dy, inverse_resolution) - plane_row
        steps, tilt, major, minor = line(rows, cols, width, dx, dy)
        lines[i, 0], lines[i, 1], lines[i, 2], lines[i, 3], lines[i, 4] = kind, steps, tilt, major, minor
        lines[i, 5], lines[i, 6] = row + rows, col + cols
        beams[i, 0], beams[i, 1], beams[i, 2] = z, dx, dy
    return int(count)


@kernel
def mark(
    states: Any, row0: int, col0: int, ranges: Any, directions: Any, pose: Any, limits: Any, inverse_resolution: float
) -> Any:
    """One scan into a grid of states (the paper's III-A): first all rays free their cells, then hits are marked.

    ``states`` (rows, cols) uint8 begins at cell (row0, col0) of the plane; ``ranges`` (N,) metres,
    ``directions`` (N, 2) unit vectors in the laser's frame, ``pose`` of the laser as x, y, cos, sin; ``limits``
    are range_min and range_max. A ray frees no cell that it hits; one with no return frees up to range_max.
    Returns the flat indices of the cells hit.
    """
    rows, cols = states.shape
    flat = states.reshape(-1)
    x, y = pose[0], pose[1]
    hits = np.empty(ranges.shape[0], np.int64)
    count = 0
    if not (is_near(x, inverse_resolution, col0, cols) and is_near(y, inverse_resolution, row0, rows)):
        return hits[:0]
    plane_row, plane_col = cell(y, inverse_resolution), cell(x, inverse_resolution)
    row, col = plane_row - row0, plane_col - col0
    starts_inside = 0 <= row < rows and 0 <= col < cols
    start = row * cols + col
    origin = (plane_row, plane_col, row, col)
    lines, beams = np.empty((BLOCK, 7), np.int64), np.empty((BLOCK, 3), np.float64)
    for begin in range(0, ranges.shape[0], BLOCK):
        laid = lay_lines(ranges, directions, pose, limits, inverse_resolution, origin, cols, begin, lines, beams)
        for i in range(laid):
            kind, steps, tilt, major = lines[i, 0], lines[i, 1], lines[i, 2], lines[i, 3]
            minor, end_row, end_col = lines[i, 4], lines[i, 5], lines[i, 6]
            if kind == SKIPPED:
                continue
            first, last = 0, steps
            ends_inside = 0 <= end_row < rows and 0 <= end_col < cols
            if not (starts_inside and ends_inside):
                first, last = clip(row, col, rows, cols, major, minor, tilt, steps)
            set_line(flat, FREE, start, first, last, tilt, major, minor)
            if kind == HIT and ends_inside:
                hits[count] = end_row * cols + end_col
                count += 1
    for i in range(count):
        flat[hits[i]] = OCCUPIED
    return hits[:count]


@kernel
def add_log_odds(
    log_odds: Any,
    row0: int,
    col0: int,
    ranges: Any,
    directions: Any,
    pose: Any,
    limits: Any,
    inverse_resolution: float,
    reach: float,
    table: Any,
    spacing: float,
) -> None:
    """One scan into a grid of log-odds (Eqs. 3 and 4), one update per ray and cell.

    Arguments as in :func:`mark`, and the inverse sensor model in log-odds: ``table`` (float32) holds it every
    ``spacing`` metres around the measured range. It differs from free and from 0 within ``reach`` of that, and goes
    on for MARGIN_CELLS cells on both sides.
    """
    rows, cols = log_odds.shape
    flat = log_odds.reshape(-1)
    x, y = pose[0], pose[1]
    resolution = 1 / inverse_resolution
    if not (is_near(x, inverse_resolution, col0, cols) and is_near(y, inverse_resolution, row0, rows)):
        return
    plane_row, plane_col = cell(y, inverse_resolution), cell(x, inverse_resolution)
    row, col = plane_row - row0, plane_col - col0
    starts_inside = 0 <= row < rows and 0 <= col < cols
    start = row * cols + col
    centre_x, centre_y = (plane_col + 0.5) * resolution - x, (plane_row + 0.5) * resolution - y
    origin = (plane_row, plane_col, row, col)
    lines, beams = np.empty((BLOCK, 7), np.int64), np.empty((BLOCK, 3), np.float64)
    for begin in range(0, ranges.shape[0], BLOCK):
        laid = lay_lines(ranges, directions, pose, limits, inverse_resolution, origin, cols, begin, lines, beams)
        for i in range(laid):
            kind, steps, tilt, major = lines[i, 0], lines[i, 1], lines[i, 2], lines[i, 3]
            minor, end_row, end_col = lines[i, 4], lines[i, 5], lines[i, 6]
            if kind == SKIPPED:
                continue
            z = beams[i, 0]
            along_x = abs(major) == 1
            first, last, plain = 0, steps, steps
            if kind == HIT:  # walk on to the cell of the point at z + reach, at the same slope
                beyond = (x + (z + reach) * beams[i, 1]) if along_x else (y + (z + reach) * beams[i, 2])
                last = abs(cell(beyond, inverse_resolution) - (plane_col if along_x else plane_row))
                plain = surely_free(z - reach - 1.25 * resolution, z, steps)
            if starts_inside and 0 <= end_row < rows and 0 <= end_col < cols:
                while last > steps and not inside(row, col, rows, cols, major, minor, tilt, last):
                    last -= 1
            else:
                first, last = clip(row, col, rows, cols, major, minor, tilt, last)
            plain = min(plain, last)
            add_line(flat, table[0], start, first, plain, tilt, major, minor)
            along, across = (centre_x, centre_y) if along_x else (centre_y, centre_x)
            walked = (start, max(first, plain + 1), last, tilt, major, minor)
            add_model(flat, walked, along, across, resolution, z, table, spacing)


@inline
def surely_free(certain: float, z: float, steps: int) -> int:
    """The last step whose cell's centre lies no further than ``certain`` metres, whatever its offset; -1: none."""
    return int(steps * certain / z) if certain > 0 and steps > 0 else -1


@inline
def add_model(
    flat: Any, walked: Any, along: float, across: float, resolution: float, z: float, table: Any, spacing: float
) -> None:
    """Adds the sensor model to the cells of a line by the distances of their centres, in single precision.

    ``walked`` is the line: flat start, first and last step, tilt, strides; ``along`` and ``across`` are the centre of
    its first cell from the sensor, metres along the major and the minor axis.
    """
    start, first, last, tilt, major, minor = walked
    middle, top = np.float32((table.shape[0] - 1) / 2), np.uint32(table.shape[0] - 2)
    scale = np.float32(1 / spacing)
    shift = middle - np.float32(z) * scale
    ahead_step = np.float32(resolution if major > 0 else -resolution)
    aside_step = np.float32(resolution if minor > 0 else -resolution)
    for step in range(first, last + 1):
        aside = (step * tilt + HALF) >> SHIFT
        u = np.float32(along) + np.float32(step) * ahead_step
        v = np.float32(across) + np.float32(aside) * aside_step
        place = np.sqrt(u * u + v * v) * scale + shift
        index = min(np.uint32(np.int32(place)), top)
        lower = table[index]
        odds = lower + (place - np.float32(np.int32(index))) * (table[index + np.uint32(1)] - lower)
        flat[np.uintp(start + step * major + aside * minor)] += odds


@inline
def inside(row: int, col: int, rows: int, cols: int, major: int, minor: int, tilt: int, step: int) -> bool:
    """Whether a line's step lies within the grid."""
    aside = (step * tilt + HALF) >> SHIFT
    if abs(major) == 1:
        col, row = (col + step if major > 0 else col - step), (row + aside if minor > 0 else row - aside)
    else:
        row, col = (row + step if major > 0 else row - step), (col + aside if minor > 0 else col - aside)
    return 0 <= row < rows and 0 <= col < cols
