"""Candidates from the map: connected components that the networks did not find.

A component that is no larger than a primitive and lies in none that is known is proposed as the rectangle around it;
refinement decides whether the rays support it, and of which kind it is.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence

import numpy as np
from numpy.typing import NDArray

from detect.refinement.options import DEFAULTS, ProposalOptions
from detect.refinement.surroundings.levels import MapLevels
from detect.refinement.surroundings.map_cells import MapCells, is_within
from mapping.morphology import dilate
from prim import linear_algebra
from prim.arrays import FloatArray
from prim.shapes import Kind, Primitive


def propose(levels: MapLevels, known: Sequence[Primitive], max_proposals: int | None = None) -> list[Primitive]:
    """Propose rectangles around the largest components that are in no known primitive.

    Args:
        levels: The map at several sizes of its cells; each component is proposed at the one that shows it.
        known: The primitives that are candidates already.
        max_proposals: How many at each size at most; None: as in the options.

    Returns:
        Rectangles, those of most cells first.
    """
    made: list[Primitive] = []
    for level in levels:
        proposed = _propose_at(level.cells, [*known, *made], max_proposals, level.options.proposals)
        shown = [around for around in proposed if levels.showing(around) is level]
        made += [around for around in shown if not levels.is_room(around.outline())]
    return made


def _propose_at(
    cells: MapCells, known: Sequence[Primitive], max_proposals: int | None, options: ProposalOptions
) -> list[Primitive]:
    """Propose rectangles around the components of one map, those of most cells first."""
    made = []
    centroids = np.array([(primitive.x, primitive.y) for primitive in known]).reshape(-1, 2)
    reaches = np.array([primitive.bounding_radius + options.near for primitive in known])
    for points in components(cells, options):
        around = bounding_rectangle(points, cells.frame.resolution, options)
        if around is None or cells.hides_centroid(around):
            continue
        inside = np.zeros(len(points), np.bool_)
        apart = np.hypot(*(centroids - (around.x, around.y)).T)
        for near in np.flatnonzero(apart < reaches + around.bounding_radius).tolist():
            inside |= is_within(known[near], points, options.near)
        if inside.mean() <= options.max_covered:
            made.append((len(points), around))
    made.sort(key=lambda item: -item[0])
    return [around for _, around in made[: options.max_proposals if max_proposals is None else max_proposals]]


def components(cells: MapCells, options: ProposalOptions = DEFAULTS.proposals) -> Iterator[FloatArray]:
    """Yield connected components of occupied cells that are not large and stand in free space.

    Args:
        cells: The map.
        options: Numeric parameters.

    Yields:
        The centres (N, 2) in metres of each component's cells.
    """
    frame = cells.frame
    occupied = np.flatnonzero(cells.labels)
    labels = cells.labels.flat[occupied]
    order = np.argsort(labels, kind="stable")
    for part in np.split(occupied[order], np.flatnonzero(np.diff(labels[order])) + 1):
        if len(part) < options.min_cells or cells.large.flat[part[0]]:
            continue
        rows, cols = np.divmod(part, frame.cols)
        if _free_around(cells, rows, cols) >= options.min_free:
            yield (np.column_stack((cols + frame.col, rows + frame.row)) + 0.5) * frame.resolution


def _free_around(cells: MapCells, rows: NDArray[np.intp], cols: NDArray[np.intp]) -> float:
    """Return the share of the cells around a component (8 neighbours) that are free."""
    top, left = rows.min() - 1, cols.min() - 1
    own = np.zeros((rows.max() - top + 2, cols.max() - left + 2), np.bool_)
    own[rows - top, cols - left] = True
    around = dilate(own, 1) & ~own
    at_rows, at_cols = np.nonzero(around)
    at_rows, at_cols = at_rows + top, at_cols + left
    inside = (at_rows >= 0) & (at_rows < cells.frame.rows) & (at_cols >= 0) & (at_cols < cells.frame.cols)
    return float(cells.free[at_rows[inside], at_cols[inside]].sum() / len(at_rows))


def bounding_rectangle(
    points: FloatArray, resolution: float, options: ProposalOptions = DEFAULTS.proposals
) -> Primitive | None:
    """Return the rectangle around cells along their principal axes.

    Args:
        points: (N, 2) cells' centres (m).
        resolution: The cells' side (m).
        options: Numeric parameters.

    Returns:
        The rectangle; None where it is smaller or larger than primitives are.
    """
    middle = points.mean(axis=0)
    axes = linear_algebra.scatter_axes(points, ridge=1e-12)
    along = (points - middle) @ axes
    low, high = along.min(axis=0), along.max(axis=0)
    height, width = (high - low + resolution).tolist()  # eigenvalues rise: the second axis is the longer one
    if not options.min_extent <= max(width, height) <= options.max_extent:
        return None
    x, y = (middle + axes @ ((low + high) / 2)).tolist()
    theta = math.atan2(axes[1, 1], axes[0, 1])
    size = width, max(height, options.min_extent)
    return Primitive(Kind.RECTANGLE, x, y, theta, size).canonical()
