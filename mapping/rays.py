"""The compiled kernels: from one scan's ranges to the cells that its rays cross.

A ray is Bresenham's line from the sensor's cell to the cell of its end point, stepped along its major axis. Of n
steps, step k lies at minor offset floor(k * m / n + 1/2) for m minor cells in all; here that is computed in
40-bit fixed point with the slope rounded up, which is exact for lines of up to 700,000 cells and lets no cell
wait for the one before it. Clipping to the grid is exact as well: it picks the range of k and moves no cell.

Compiled code is cached beside this file and made anew when this file changes, so that every constant it uses must
stand here.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numba import njit

BORDER_SLACK = 1e-3
"""A point this close below a cell's border (in cells) counts as on it.

0.3 / 0.1 is 2.9999999999999996, and a range in single precision is off by up to 1e-4 cells: without the slack a wall
that stands on a border would be torn between the cells at its two sides.
"""

SHIFT = 40
ONE = 1 << SHIFT
HALF = 1 << (SHIFT - 1)
MAX_STEPS = float(1 << 21)
"""No ray is followed over more cells than this."""

SKIPPED, HIT, NO_RETURN = 0, 1, 2
FREE, OCCUPIED, UNSEEN = 0, 1, 2

kernel = njit(cache=True, nogil=True, error_model="numpy", inline="never")
inline = njit(cache=True, nogil=True, error_model="numpy", inline="always")


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
def line(row: int, col: int, end_row: int, end_col: int, width: int) -> tuple[int, int, int, int]:
    """The line between two cells: its steps, fixed-point slope, and flat strides along both axes."""
    rows, cols = end_row - row, end_col - col
    row_stride = width if rows >= 0 else -width
    col_stride = 1 if cols >= 0 else -1
    rows, cols = abs(rows), abs(cols)
    if cols >= rows:
        return cols, slope(rows, cols), col_stride, row_stride
    return rows, slope(cols, rows), row_stride, col_stride


@inline
def slope(minor: int, steps: int) -> int:
    """Minor cells per step in fixed point, rounded up."""
    return ((minor << SHIFT) + steps - 1) // steps if steps > 0 else 0


@inline
def clip(row: int, col: int, rows: int, cols: int, major: int, slope: int, minor: int, last: int) -> tuple[int, int]:
    """Of a line's steps 0..last the first and the last within the grid; none where the first is larger."""
    if major == 1 or major == -1:
        return _clip(col, cols, major > 0, row, rows, minor > 0, slope, last)
    return _clip(row, rows, major > 0, col, cols, minor > 0, slope, last)


@inline
def _clip(
    start: int, size: int, up: bool, minor_start: int, minor_size: int, minor_up: bool, slope: int, last: int
) -> tuple[int, int]:
    """As clip, for one orientation: steps that keep both coordinates within [0, size) and [0, minor_size)."""
    first = max(0, -start if up else start - size + 1)
    last = min(last, size - 1 - start if up else start)
    enter = -minor_start if minor_up else minor_start - minor_size + 1
    leave = minor_size - minor_start if minor_up else minor_start + 1
    if leave <= 0 or (slope == 0 and enter > 0):
        return 1, 0
    if slope > 0:
        if enter > 0:
            first = max(first, first_step(enter, slope))
        last = min(last, first_step(leave, slope) - 1)
    return first, last


@inline
def first_step(minor: int, slope: int) -> int:
    """The first step whose minor offset (step * slope + HALF) >> SHIFT is at least ``minor`` > 0."""
    return ((minor << SHIFT) - HALF + slope - 1) // slope


@kernel
def end_extent(
    ranges: Any, directions: Any, pose: Any, limits: Any, inverse_resolution: float
) -> tuple[int, int, int, int]:
    """First and last row and column over the sensor's cell and the cells of all hits."""
    x, y, cos, sin = pose
    first_row = last_row = cell(y, inverse_resolution)
    first_col = last_col = cell(x, inverse_resolution)
    for i in range(ranges.shape[0]):
        z = float(ranges[i])
        if classify(z, limits[0], limits[1]) == HIT:
            u, v = directions[i, 0], directions[i, 1]
            col = cell(x + z * (cos * u - sin * v), inverse_resolution)
            row = cell(y + z * (sin * u + cos * v), inverse_resolution)
            first_row, last_row = min(first_row, row), max(last_row, row)
            first_col, last_col = min(first_col, col), max(last_col, col)
    return first_row, first_col, last_row, last_col


@kernel
def mark(
    states: Any,
    row0: int,
    col0: int,
    ranges: Any,
    directions: Any,
    pose: Any,
    limits: Any,
    inverse_resolution: float,
) -> Any:
    """One scan into a grid of states (the paper's III-A): first all rays free their cells, then hits are marked.

    ``states`` (rows, cols) uint8 begins at cell (row0, col0) of the plane; ``ranges`` (N,) metres,
    ``directions`` (N, 2) unit vectors in the laser's frame, ``pose`` of the laser as x, y, cos, sin; ``limits``
    are range_min and range_max. A ray frees no cell that it hits; one with no return frees up to range_max.
    Returns the flat indices of the cells hit.
    """
    rows, cols = states.shape
    flat = states.reshape(-1)
    x, y, cos, sin = pose
    range_min, range_max = limits
    far = min(range_max, MAX_STEPS / inverse_resolution)
    row, col = cell(y, inverse_resolution) - row0, cell(x, inverse_resolution) - col0
    start = row * cols + col
    hits = np.empty(ranges.shape[0], np.int64)
    count = 0
    for i in range(ranges.shape[0]):
        z = float(ranges[i])
        kind = classify(z, range_min, range_max)
        if kind == SKIPPED:
            continue
        z = min(z, far)
        u, v = directions[i, 0], directions[i, 1]
        end_col = cell(x + z * (cos * u - sin * v), inverse_resolution) - col0
        end_row = cell(y + z * (sin * u + cos * v), inverse_resolution) - row0
        steps, tilt, major, minor = line(row, col, end_row, end_col, cols)
        if kind == HIT and 0 <= end_row < rows and 0 <= end_col < cols:
            hits[count] = end_row * cols + end_col
            count += 1
        first, last = clip(row, col, rows, cols, major, tilt, minor, steps)
        position = start + first * major
        offset = first * tilt + HALF
        for _ in range(first, last + 1):
            flat[np.uintp(position + (offset >> SHIFT) * minor)] = FREE
            position += major
            offset += tilt
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
    free: float,
    reach: float,
    table: Any,
) -> None:
    """One scan into a grid of log-odds (Eqs. 3 and 4), one update per ray and cell.

    Arguments as in :func:`mark`, and the inverse sensor model in log-odds: ``free`` up to ``reach`` metres
    before the measured range, then ``table``, equally spaced over [-reach, reach], 0 beyond.
    """
    rows, cols = log_odds.shape
    flat = log_odds.reshape(-1)
    x, y, cos, sin = pose
    range_min, range_max = limits
    far = min(range_max, MAX_STEPS / inverse_resolution)
    resolution = 1 / inverse_resolution
    row, col = cell(y, inverse_resolution) - row0, cell(x, inverse_resolution) - col0
    start = row * cols + col
    centre_x, centre_y = (col0 + 0.5) * resolution - x, (row0 + 0.5) * resolution - y
    update = np.float32(free)
    scale = (table.shape[0] - 1) / (2 * reach)
    for i in range(ranges.shape[0]):
        z = float(ranges[i])
        kind = classify(z, range_min, range_max)
        if kind == SKIPPED:
            continue
        z = min(z, far)
        u, v = directions[i, 0], directions[i, 1]
        dx, dy = cos * u - sin * v, sin * u + cos * v
        end_col = cell(x + z * dx, inverse_resolution) - col0
        end_row = cell(y + z * dy, inverse_resolution) - row0
        steps, tilt, major, minor = line(row, col, end_row, end_col, cols)
        plain = last = steps
        if kind == HIT:
            along_x = major == 1 or major == -1
            last = (
                steps_to(x, col + col0, z + reach, dx, inverse_resolution)
                if along_x
                else steps_to(y, row + row0, z + reach, dy, inverse_resolution)
            )
            plain = int(steps * (1 - (reach + 1.25 * resolution) / z)) if z > reach else -1
        first, last = clip(row, col, rows, cols, major, tilt, minor, last)
        position = start + first * major
        offset = first * tilt + HALF
        plain = min(plain, last)
        for _ in range(first, plain + 1):
            flat[np.uintp(position + (offset >> SHIFT) * minor)] += update
            position += major
            offset += tilt
        for _ in range(max(first, plain + 1), last + 1):
            place = position + (offset >> SHIFT) * minor
            cell_row = place // cols
            distance = math.hypot((place - cell_row * cols) * resolution + centre_x, cell_row * resolution + centre_y)
            flat[np.uintp(place)] += model(distance - z, free, reach, table, scale)
            position += major
            offset += tilt


@inline
def steps_to(origin: float, cell0: int, z: float, direction: float, inverse_resolution: float) -> int:
    """Cells along one axis from the sensor's cell to the cell of the point at range z."""
    return abs(cell(origin + z * direction, inverse_resolution) - cell0)


@inline
def model(d: float, free: float, reach: float, table: Any, scale: float) -> float:
    """The inverse sensor model's log-odds at distance d behind the measured range, from its table."""
    if d <= -reach:
        return free
    if d >= reach:
        return 0.0
    place = (d + reach) * scale
    index = int(place)
    share = place - index
    return float(table[index] * (1 - share) + table[min(index + 1, table.shape[0] - 1)] * share)
