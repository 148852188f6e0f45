"""Straight walls in a map, told from its cells: what stands behind primitives that stand close to one.

Where a primitive stands close to a wall, few rays come between them, and the map cannot tell them apart. The wall
goes on straight, though, as it comes out on both sides.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from detect.beams import MapCells, circumradius, is_within
from mapping.grid import GridFrame
from prim.metrics import BoolGrid
from prim.raycast import FloatArray
from prim.shapes import Kind, Primitive

CLOSE = 0.12
"""A wall is looked for behind candidates that come this near (m) to it."""

AROUND = 0.5
"""Its cells are looked for this far (m) around a candidate."""

LEAST_LENGTH = 0.12
"""So much (m) of a wall must be seen at both sides."""

THICKNESS = 0.002
TRIALS = 60

Line = tuple[float, float, float]
"""nx, ny, d: points with nx x + ny y = d; the normal points to the free side."""


@dataclass(frozen=True)
class Wall:
    """A stretch of a wall behind a candidate, and the map's cells that stand for it there (rows, cols)."""

    stretch: Primitive
    cells: BoolGrid


def walls_behind(cells: MapCells, candidates: Sequence[Primitive]) -> list[Wall]:
    """The walls that candidates stand close to, and that come out straight on both sides of each."""
    surface = cells.large & _touches_free(cells)
    rows, cols = np.nonzero(surface)
    points = (np.column_stack((cols + cells.frame.col, rows + cells.frame.row)) + 0.5) * cells.frame.resolution
    close = [one for one in candidates if is_within(one, points, CLOSE).any()]
    for one in candidates:
        points = points[~is_within(one, points, 0.04)]
    made = []
    for one in close:
        near = points[np.hypot(*(points - (one.x, one.y)).T) < circumradius(one) + AROUND]
        for line in _lines(near, cells.frame.resolution):
            wall = _stretch(cells, one, line, near)
            if wall is not None:
                made.append(wall)
    return made


def _touches_free(cells: MapCells) -> BoolGrid:
    """Cells with a neighbour (4) that is free."""
    free = np.pad(cells.free, 1)
    return free[:-2, 1:-1] | free[2:, 1:-1] | free[1:-1, :-2] | free[1:-1, 2:]


def _lines(points: FloatArray, resolution: float) -> list[Line]:
    """Up to two straight lines through many of the points, the best first."""
    rng = np.random.default_rng(0)
    found: list[Line] = []
    while len(found) < 2 and len(points) * resolution > 2 * LEAST_LENGTH:
        best = np.zeros(len(points), np.bool_)
        for first, second in rng.integers(len(points), size=(TRIALS, 2)):
            along = points[second] - points[first]
            length = math.hypot(*along)
            if length < LEAST_LENGTH:
                continue
            off = np.abs((points - points[first]) @ np.array([-along[1], along[0]])) / length
            if np.count_nonzero(off < resolution) > np.count_nonzero(best):
                best = off < resolution
        if np.count_nonzero(best) * resolution < 2 * LEAST_LENGTH:
            break
        middle = points[best].mean(axis=0)
        normal = np.linalg.eigh(np.cov((points[best] - middle).T))[1][:, 0]
        found.append((float(normal[0]), float(normal[1]), float(normal @ middle)))
        points = points[np.abs(points @ normal - normal @ middle) > 3 * resolution]
    return found


def _stretch(cells: MapCells, candidate: Primitive, line: Line, points: FloatArray) -> Wall | None:
    """The stretch of a line behind a candidate; None where the candidate is not close to it, or cuts it."""
    nx, ny, d = line
    outline = candidate.outline(32) @ np.array([nx, ny]) - d
    side = 1.0 if outline.mean() > 0 else -1.0
    gap = float((side * outline).min())
    if not -0.02 < gap < CLOSE:
        return None
    on_line = points[np.abs(points @ np.array([nx, ny]) - d) < 1.5 * cells.frame.resolution]
    along = on_line @ np.array([-ny, nx])
    middle = -ny * candidate.x + nx * candidate.y
    reach = circumradius(candidate)
    left, right = along[along < middle - 0.5 * reach], along[along > middle + 0.5 * reach]
    resolution = cells.frame.resolution
    if min(len(np.unique(np.rint(part / resolution))) for part in (left, right)) * resolution < LEAST_LENGTH:
        return None
    low, high = max(float(left.min()), middle - reach - 0.15), min(float(right.max()), middle + reach + 0.15)
    at = (low + high) / 2
    theta = math.atan2(nx, -ny)
    stretch = Primitive(
        Kind.RECTANGLE, nx * d - ny * at, ny * d + nx * at, theta, (high - low, THICKNESS)
    ).canonical()
    return Wall(stretch, _cells_of(cells.frame, cells.large, stretch))


def _cells_of(frame: GridFrame, large: BoolGrid, stretch: Primitive) -> BoolGrid:
    """The large cells (rows, cols) that stand for a stretch of a wall: within three and a half cells of it."""
    rows, cols = np.nonzero(large)
    points = (np.column_stack((cols + frame.col, rows + frame.row)) + 0.5) * frame.resolution
    inside = is_within(stretch, points, 3.5 * frame.resolution)
    found = np.zeros_like(large)
    found[rows[inside], cols[inside]] = True
    return found
