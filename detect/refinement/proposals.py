"""Things in a map that the networks did not take for primitives, and that may be some all the same.

What hangs together in the map, is no larger than a primitive, and lies in none that was found, is proposed as a
rectangle around it; refinement says whether the rays support it, and of which kind it is.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence

import numpy as np
from numpy.typing import NDArray

from detect.refinement.map_cells import MapCells, is_within
from mapping.morphology import dilate
from prim.arrays import FloatArray
from prim.shapes import Kind, Primitive

LEAST, MOST = 0.03, 0.7
"""Between these (m) lies the extent of what is proposed."""

LEAST_CELLS = 6
COVERED = 0.3
"""What lies by more than this share in a primitive that was found is a part of it."""

LEAST_FREE = 0.3
"""Around what is proposed, this share of the cells is free at least: what lies behind a wall is not seen."""

NEAR = 0.03
"""A cell this near (m) to a primitive counts as in it."""

MOST_PROPOSALS = 24
"""No more than so many are proposed, those of the most cells: a map that is full of specks says nothing."""


def proposals(cells: MapCells, found: Sequence[Primitive], most: int = MOST_PROPOSALS) -> list[Primitive]:
    """Rectangles around things in a map that are in no primitive ``found``, the ``most`` largest."""
    made = []
    middles = np.array([(one.x, one.y) for one in found]).reshape(-1, 2)
    reaches = np.array([one.circumradius + NEAR for one in found])
    for points in blobs(cells):
        around = rectangle_around(points, cells.frame.resolution)
        if around is None or cells.hide(around):
            continue
        inside = np.zeros(len(points), np.bool_)
        apart = np.hypot(*(middles - (around.x, around.y)).T)
        for near in np.flatnonzero(apart < reaches + around.circumradius).tolist():
            inside |= is_within(found[near], points, NEAR)
        if inside.mean() <= COVERED:
            made.append((len(points), around))
    made.sort(key=lambda one: -one[0])
    return [around for _, around in made[:most]]


def blobs(cells: MapCells) -> Iterator[FloatArray]:
    """The centres (N, 2) in metres of the cells of each thing that is not large."""
    frame = cells.frame
    occupied = np.flatnonzero(cells.labels)
    numbers = cells.labels.flat[occupied]
    order = np.argsort(numbers, kind="stable")
    for part in np.split(occupied[order], np.flatnonzero(np.diff(numbers[order])) + 1):
        if len(part) < LEAST_CELLS or cells.large.flat[part[0]]:
            continue
        rows, cols = np.divmod(part, frame.cols)
        if _free_around(cells, rows, cols) >= LEAST_FREE:
            yield (np.column_stack((cols + frame.col, rows + frame.row)) + 0.5) * frame.resolution


def _free_around(cells: MapCells, rows: NDArray[np.intp], cols: NDArray[np.intp]) -> float:
    """Of the cells around a thing (8 neighbours), the share that is free."""
    top, left = rows.min() - 1, cols.min() - 1
    own = np.zeros((rows.max() - top + 2, cols.max() - left + 2), np.bool_)
    own[rows - top, cols - left] = True
    around = dilate(own, 1) & ~own
    at_rows, at_cols = np.nonzero(around)
    at_rows, at_cols = at_rows + top, at_cols + left
    inside = (at_rows >= 0) & (at_rows < cells.frame.rows) & (at_cols >= 0) & (at_cols < cells.frame.cols)
    return float(cells.free[at_rows[inside], at_cols[inside]].sum() / len(at_rows))


def rectangle_around(points: FloatArray, resolution: float) -> Primitive | None:
    """The rectangle around points along their main axes; None where it is smaller or larger than primitives are."""
    middle = points.mean(axis=0)
    axes: NDArray[np.float64] = np.linalg.eigh(np.cov((points - middle).T) + np.eye(2) * 1e-12)[1]
    along = (points - middle) @ axes
    low, high = along.min(axis=0), along.max(axis=0)
    height, width = (high - low + resolution).tolist()  # eigenvalues rise: the second axis is the longer one
    if not LEAST <= max(width, height) <= MOST:
        return None
    x, y = (middle + axes @ ((low + high) / 2)).tolist()
    theta = math.atan2(axes[1, 1], axes[0, 1])
    return Primitive(Kind.RECTANGLE, x, y, theta, (width, max(height, LEAST))).canonical()
