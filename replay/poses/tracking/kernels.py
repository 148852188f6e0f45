"""The compiled kernels of tracking: points on lines, the map of nearest points, the fit to it, the search in it.

The fit is by point to line (Chen and Medioni, «Object modelling by registration of multiple range images», 1992) with
Welsch's weights; the search is a branch and bound over scores that are maxima over ever larger squares (Olson,
«Real-time correlative scan matching», 2009; Hess et al., «Real-time loop closure in 2D LIDAR SLAM», 2016).
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np

from prim.arrays import FloatArray
from prim.compiled import inline, kernel

X, Y, NORMAL_X, NORMAL_Y = range(4)
"""Columns of points: where they are (m), and the unit normal towards the laser; 0, 0 for those on no line."""

FULL_SCORE = 255
"""The score of a point that lies on one of the map."""

SCORE_STEPS, SCORE_REACH = 1024, 4.5
"""Scores are taken from a table of so many steps, of squared distances up to this (in those of two widths)."""


class LineRule(NamedTuple):
    """Which beams are neighbours on one line; see PointOptions."""

    spacing: float
    reach: float
    most: int
    gap: float
    gap_beams: float
    flatness: float


class Grid(NamedTuple):
    """Where the cells of a map lie: its lower left corner and the side of a cell (m)."""

    x: float
    y: float
    cell: float


class Fit(NamedTuple):
    """How a scan is fitted to a map.

    Attributes:
        kernels: Widths (m) of Welsch's function, of each step and of what is evaluated at the end.
        residual: Standard deviation (m) that residuals count by.
        min_cosine: Least cosine between normals of corresponding points.
        point_weight: Weight of points on no line.
        enough: No step follows one that is shorter than this (m, half as much in rad).
    """

    kernels: FloatArray
    residual: float
    min_cosine: float
    point_weight: float
    enough: float


class Window(NamedTuple):
    """What a search covers, and what it charges for the distance from its middle.

    Attributes:
        reach: M to each side.
        turn: Rad to each side.
        step: Rad from one heading to the next.
        per_metre: What a score loses a metre …
        per_radian: … and a radian.
    """

    reach: float
    turn: float
    step: float
    per_metre: float
    per_radian: float


class Excluded(NamedTuple):
    """What a search leaves out: poses near this one, given in the map's frame.

    Attributes:
        x: M.
        y: M.
        heading: Rad.
        reach: M to each side; negative: nothing is left out.
        turn: Rad to each side.
    """

    x: float = 0.0
    y: float = 0.0
    heading: float = 0.0
    reach: float = -1.0
    turn: float = 0.0


@inline
def _is_excluded(x: float, y: float, heading: float, excluded: Any) -> bool:
    """Tell whether a search leaves a pose out."""
    if not (x - excluded.x) ** 2 + (y - excluded.y) ** 2 < excluded.reach * abs(excluded.reach):
        return False
    turn = heading - excluded.heading
    return bool(abs(turn - 2.0 * math.pi * math.floor((turn + math.pi) / (2.0 * math.pi))) < excluded.turn)


@inline
def _fit_line(ends: Any, i: int, rule: Any, out: Any) -> bool:
    """Fit a line to a beam's end point and its neighbours: the foot of the end point, and the normal; else False."""
    x, y = ends[i, 0], ends[i, 1]
    spread = max(rule.gap, rule.gap_beams * ends[i, 2])
    count, sx, sy, sxx, sxy, syy = 1, 0.0, 0.0, 0.0, 0.0, 0.0
    for side in (-1, 1):
        last_x, last_y = x, y
        for k in range(1, rule.most + 1):
            j = i + side * k
            if j < 0 or j >= len(ends) or math.isnan(ends[j, 0]):
                break
            if (ends[j, 0] - last_x) ** 2 + (ends[j, 1] - last_y) ** 2 > spread * spread:
                break
            dx, dy = ends[j, 0] - x, ends[j, 1] - y
            if k > 2 and dx * dx + dy * dy > rule.reach * rule.reach:
                break
            last_x, last_y = ends[j, 0], ends[j, 1]
            count, sx, sy = count + 1, sx + dx, sy + dy
            sxx, sxy, syy = sxx + dx * dx, sxy + dx * dy, syy + dy * dy
    if count < 3:
        return False
    mx, my = sx / count, sy / count
    a, b, c = sxx / count - mx * mx, sxy / count - mx * my, syy / count - my * my
    root = math.sqrt(0.25 * (a - c) ** 2 + b * b)
    if 0.5 * (a + c) - root >= rule.flatness * (0.5 * (a + c) + root):
        return False
    angle = 0.5 * math.atan2(2.0 * b, a - c)
    nx, ny = -math.sin(angle), math.cos(angle)
    if nx * x + ny * y > 0.0:
        nx, ny = -nx, -ny
    away = nx * mx + ny * my
    out[X], out[Y], out[NORMAL_X], out[NORMAL_Y] = x + nx * away, y + ny * away, nx, ny
    return True


@kernel
def find_points(ends: Any, rule: Any, out: Any) -> int:
    """Find a scan's points.

    Args:
        ends: (B, 3) end points of beams in the laser's frame (m), NaN where there is none, and the distance there of
            neighbouring beams.
        rule: The :class:`LineRule`.
        out: (B, 4) gets the points.

    Returns:
        How many there are.
    """
    count = 0
    last_x, last_y = math.inf, math.inf
    for i in range(len(ends)):
        x, y = ends[i, 0], ends[i, 1]
        if math.isnan(x) or (x - last_x) ** 2 + (y - last_y) ** 2 < rule.spacing * rule.spacing:
            continue
        last_x, last_y = x, y
        if not _fit_line(ends, i, rule, out[count]):
            out[count, X], out[count, Y], out[count, NORMAL_X], out[count, NORMAL_Y] = x, y, 0.0, 0.0
        count += 1
    return count


@kernel
def move_points(points: Any, pose: Any, out: Any) -> None:
    """Move points from the frame of a pose to that which the pose is given in.

    Args:
        points: (N, 4).
        pose: (3,).
        out: (N, 4) gets them.
    """
    cos, sin = math.cos(pose[2]), math.sin(pose[2])
    for n in range(len(points)):
        x, y, nx, ny = points[n, X], points[n, Y], points[n, NORMAL_X], points[n, NORMAL_Y]
        out[n, X], out[n, Y] = pose[0] + cos * x - sin * y, pose[1] + sin * x + cos * y
        out[n, NORMAL_X], out[n, NORMAL_Y] = cos * nx - sin * ny, sin * nx + cos * ny


@kernel
def note_nearest(points: Any, grid: Any, reach: float, squares: Any, nearest: Any) -> None:
    """Note in the cells around points which one is nearest.

    Args:
        points: (N, 4).
        grid: The :class:`Grid`.
        reach: How far around a point (m).
        squares: (rows, cols) squared distances (m²), changed in place.
        nearest: (rows, cols) indices of points, changed in place.
    """
    rows, cols = squares.shape
    around, cell, limit = math.ceil(reach / grid.cell), np.float32(grid.cell), np.float32(reach * reach)
    for n in range(len(points)):
        x, y = points[n, X] - grid.x, points[n, Y] - grid.y
        col, row = math.floor(x / grid.cell), math.floor(y / grid.cell)
        if col < around or row < around or col >= cols - around or row >= rows - around:
            continue
        first = np.float32((col - around + 0.5) * grid.cell - x)
        for j in range(row - around, row + around + 1):
            dy = np.float32((j + 0.5) * grid.cell - y)
            own, held = squares[j, col - around : col + around + 1], nearest[j, col - around : col + around + 1]
            for i in range(2 * around + 1):  # without branches, so that the compiler takes several at once
                dx = first + np.float32(i) * cell
                square = dx * dx + dy * dy
                is_nearer = (square <= limit) & (square < own[i])
                own[i] = square if is_nearer else own[i]
                held[i] = np.int32(n) if is_nearer else held[i]


@inline
def _add(information: Any, vector: Any, a: float, b: float, c: float, weight: float, residual: float) -> None:
    """Add a residual with slopes a, b, c by x, y, heading to the normal equations."""
    information[0, 0] += weight * a * a
    information[0, 1] += weight * a * b
    information[0, 2] += weight * a * c
    information[1, 1] += weight * b * b
    information[1, 2] += weight * b * c
    information[2, 2] += weight * c * c
    vector[0] -= weight * a * residual
    vector[1] -= weight * b * residual
    vector[2] -= weight * c * residual


@kernel
def add_residuals(
    points: Any,
    pose: Any,
    surface: Any,
    nearest: Any,
    grid: Any,
    fit: Any,
    width: float,
    information: Any,
    vector: Any,
) -> Any:
    """Add up how a scan at a pose fits a map.

    Args:
        points: (N, 4) of the scan.
        pose: (3,).
        surface: (M, 4) of the map.
        nearest: (rows, cols) indices into these, -1 for none.
        grid: The :class:`Grid`.
        fit: The :class:`Fit`.
        width: The width of Welsch's function (m).
        information: (3, 3), set.
        vector: (3,) the negative gradient, set.

    Returns:
        The sum of the points' weights (1 for one that lies on the map), and that of weighted squared residuals (m²)
        with that of their weights, of points on lines.
    """
    rows, cols = nearest.shape
    cos, sin = math.cos(pose[2]), math.sin(pose[2])
    information[:] = 0.0
    vector[:] = 0.0
    score, squares, weights = 0.0, 0.0, 0.0
    for n in range(len(points)):
        rx = cos * points[n, X] - sin * points[n, Y]
        ry = sin * points[n, X] + cos * points[n, Y]
        col = math.floor((pose[0] + rx - grid.x) / grid.cell)
        row = math.floor((pose[1] + ry - grid.y) / grid.cell)
        if col < 0 or row < 0 or col >= cols or row >= rows or nearest[row, col] < 0:
            continue
        m = nearest[row, col]
        dx, dy = pose[0] + rx - surface[m, X], pose[1] + ry - surface[m, Y]
        nx, ny = surface[m, NORMAL_X], surface[m, NORMAL_Y]
        own_x = cos * points[n, NORMAL_X] - sin * points[n, NORMAL_Y]
        own_y = sin * points[n, NORMAL_X] + cos * points[n, NORMAL_Y]
        on_line, has_normal = nx * nx + ny * ny > 0.5, own_x * own_x + own_y * own_y > 0.5
        if on_line and has_normal and nx * own_x + ny * own_y < fit.min_cosine:
            continue
        if on_line:
            away = nx * dx + ny * dy
            weight = math.exp(-away * away / (2.0 * width * width))
            score, weights, squares = score + weight, weights + weight, squares + weight * away * away
            _add(information, vector, nx, ny, ny * rx - nx * ry, weight / fit.residual**2, away)
        else:
            weight = math.exp(-(dx * dx + dy * dy) / (2.0 * width * width))
            score += weight
            weight *= fit.point_weight / fit.residual**2
            _add(information, vector, 1.0, 0.0, -ry, weight, dx)
            _add(information, vector, 0.0, 1.0, rx, weight, dy)
    information[1, 0], information[2, 0], information[2, 1] = information[0, 1], information[0, 2], information[1, 2]
    return score, squares, weights


@inline
def _solve(a: Any, b: Any, out: Any) -> bool:
    """Solve a symmetric positive definite 3 x 3 system; False where it is singular."""
    c00 = a[1, 1] * a[2, 2] - a[1, 2] * a[1, 2]
    c01 = a[0, 2] * a[1, 2] - a[0, 1] * a[2, 2]
    c02 = a[0, 1] * a[1, 2] - a[0, 2] * a[1, 1]
    determinant = a[0, 0] * c00 + a[0, 1] * c01 + a[0, 2] * c02
    if not determinant > 0.0:
        return False
    c11 = a[0, 0] * a[2, 2] - a[0, 2] * a[0, 2]
    c12 = a[0, 1] * a[0, 2] - a[0, 0] * a[1, 2]
    c22 = a[0, 0] * a[1, 1] - a[0, 1] * a[0, 1]
    out[0] = (c00 * b[0] + c01 * b[1] + c02 * b[2]) / determinant
    out[1] = (c01 * b[0] + c11 * b[1] + c12 * b[2]) / determinant
    out[2] = (c02 * b[0] + c12 * b[1] + c22 * b[2]) / determinant
    return True


@kernel
def fit_pose(
    points: Any,
    surface: Any,
    nearest: Any,
    grid: Any,
    fit: Any,
    prior: Any,
    prior_information: Any,
    pose: Any,
    out: Any,
) -> Any:
    """Fit a scan's pose to a map by Gauss and Newton's method.

    Args:
        points: (N, 4) of the scan.
        surface: (M, 4) of the map.
        nearest: (rows, cols) indices into these, -1 for none.
        grid: The :class:`Grid`.
        fit: The :class:`Fit`.
        prior: (3,) the mean of the pose's Gaussian prior.
        prior_information: (3, 3).
        pose: (3,) the start, changed in place.
        out: (3, 3) gets the information of the scan at the end.

    Returns:
        As :func:`add_residuals`, at the end.
    """
    vector, whole, step, right = np.empty(3), np.empty((3, 3)), np.zeros(3), np.empty(3)
    for k in range(len(fit.kernels) - 1):
        add_residuals(points, pose, surface, nearest, grid, fit, fit.kernels[k], out, vector)
        for i in range(3):
            right[i] = vector[i]
            for j in range(3):
                whole[i, j] = out[i, j] + prior_information[i, j]
                right[i] -= prior_information[i, j] * (pose[j] - prior[j])
        if not _solve(whole, right, step):
            break
        length = max(abs(step[0]), abs(step[1]), 2.0 * abs(step[2]))
        shrink = 0.5 / length if length > 0.5 else 1.0
        for i in range(3):
            pose[i] += shrink * step[i]
        if length < fit.enough and fit.kernels[k] == fit.kernels[-1]:
            break
    return add_residuals(points, pose, surface, nearest, grid, fit, fit.kernels[-1], out, vector)


@kernel
def score_cells(squares: Any, blur: float, out: Any) -> None:
    """Score cells by their distance from the nearest point.

    Args:
        squares: (rows, cols) squared distances (m²).
        blur: The width (m) of a normal density.
        out: (rows, cols) uint8, gets the scores.
    """
    rows, cols = squares.shape
    table = np.empty(SCORE_STEPS + 1, np.uint8)
    for k in range(SCORE_STEPS):
        table[k] = np.uint8(FULL_SCORE * math.exp(-(k + 0.5) * SCORE_REACH / SCORE_STEPS))
    table[SCORE_STEPS] = 0
    scale = np.float32(SCORE_STEPS / SCORE_REACH / (2.0 * blur * blur))
    for j in range(rows):
        for i in range(cols):
            out[j, i] = table[np.int32(min(squares[j, i] * scale, np.float32(SCORE_STEPS)))]


@kernel
def pool_scores(scores: Any, step: int, out: Any) -> None:
    """Take maxima of scores that are maxima over squares already.

    Args:
        scores: (rows, cols) maxima over squares of ``step`` cells a side, which begin at each cell.
        step: Cells.
        out: (rows, cols) gets those over squares of twice the side.
    """
    rows, cols = scores.shape
    for j in range(rows):
        upper, lower, row = scores[j], scores[min(j + step, rows - 1)], out[j]
        for i in range(cols - step):
            row[i] = max(max(upper[i], upper[i + step]), max(lower[i], lower[i + step]))
        for i in range(max(cols - step, 0), cols):
            row[i] = max(max(upper[i], upper[cols - 1]), max(lower[i], lower[cols - 1]))


@inline
def _score(scores: Any, level: int, cols_of: Any, rows_of: Any, right: int, up: int) -> float:
    """Return an upper bound of the mean score of points moved by any number of cells within a square."""
    rows, cols = scores.shape[1], scores.shape[2]
    total, side = 0, 1 << level
    for k in range(len(cols_of)):
        col, row = cols_of[k] + right, rows_of[k] + up
        if col + side <= 0 or row + side <= 0 or col >= cols or row >= rows:
            continue
        total += scores[level, max(row, 0), max(col, 0)]
    return total / (FULL_SCORE * len(cols_of))


@kernel
def search_pose(  # noqa: C901 - the branch and the bound belong together
    points: Any, scores: Any, grid: Any, middle: Any, window: Any, excluded: Any, least: float, out: Any
) -> float:
    """Find the best pose within a window by branch and bound.

    Args:
        points: (N, 4) of the scan.
        scores: (levels, rows, cols) of a map's cells: maxima over squares of 1, 2, 4 … cells.
        grid: The :class:`Grid`.
        middle: (3,) the middle of the window.
        window: The :class:`Window`.
        excluded: What is :class:`Excluded` from it.
        least: Only what scores more is found.
        out: (3,) gets the pose.

    Returns:
        Its score, from 0 to 1, less what the window charges; -1 where none is found.
    """
    top, turns = len(scores) - 1, math.ceil(window.turn / window.step)
    reach, side = math.ceil(window.reach / grid.cell), 1 << top
    across, headings = (2 * reach + side) // side, 2 * turns + 1
    cols_of, rows_of = np.empty((headings, len(points)), np.int32), np.empty((headings, len(points)), np.int32)
    bounds = np.empty(headings * across * across, np.float32)
    for q in range(headings):
        theta = middle[2] + (q - turns) * window.step
        cos, sin = math.cos(theta), math.sin(theta)
        for k in range(len(points)):
            x = middle[0] + cos * points[k, X] - sin * points[k, Y]
            y = middle[1] + sin * points[k, X] + cos * points[k, Y]
            cols_of[q, k] = math.floor((x - grid.x) / grid.cell)
            rows_of[q, k] = math.floor((y - grid.y) / grid.cell)
        for i in range(across):
            for j in range(across):
                bounds[(q * across + i) * across + j] = _score(
                    scores, top, cols_of[q], rows_of[q], i * side - reach, j * side - reach
                )
    best, found = least, False
    stack, heights = np.empty((4 * top + 4, 3), np.int64), np.empty(4 * top + 4)
    for place in np.argsort(-bounds):
        if bounds[place] <= best:
            break
        q, rest = place // (across * across), place % (across * across)
        stack[0, 0], stack[0, 1], stack[0, 2] = rest // across * side - reach, rest % across * side - reach, top
        heights[0], size = bounds[place], 1
        while size:
            size -= 1
            right, up, level = stack[size]
            if heights[size] <= best:
                continue
            if level == 0:
                cost = window.per_metre * math.hypot(right, up) * grid.cell
                height = heights[size] - cost - window.per_radian * abs(q - turns) * window.step
                x, y = middle[0] + right * grid.cell, middle[1] + up * grid.cell
                heading = middle[2] + (q - turns) * window.step
                if height > best and not _is_excluded(x, y, heading, excluded):
                    best, found = height, True
                    out[0], out[1], out[2] = x, y, heading
                continue
            half, first = 1 << (level - 1), size
            for part in range(4):
                a, b = right + part % 2 * half, up + part // 2 * half
                if a > reach or b > reach:
                    continue
                height = _score(scores, level - 1, cols_of[q], rows_of[q], a, b)
                if height <= best:
                    continue
                at = size
                while at > first and heights[at - 1] > height:  # the best one is taken first
                    stack[at], heights[at] = stack[at - 1], heights[at - 1]
                    at -= 1
                stack[at, 0], stack[at, 1], stack[at, 2] = a, b, level - 1
                heights[at], size = height, size + 1
    return best if found else -1.0
