"""A map at several sizes of its cells, so that things of any size are seen in about as many cells.

What learnt to see shapes, or was set, in cells of one size serves all: networks see shapes in cells.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from mapping.grid import UNKNOWN, GridFrame, OccupancyGrid

Slices = tuple[slice, slice]


@dataclass(frozen=True)
class PyramidOptions:
    """Which things are searched for in cells of which size.

    Attributes:
        seen_cells: Things of up to so many cells across are searched for at a level; those that are larger at the
            next, in cells twice as large. The paper's largest square, 0.32 m in cells of 1 cm, is 45 across.
        fewest_cells: Things that are seen in fewer cells have no shape; set by hand.
        enough_cells: Cells are not twice as large where the smallest wanted things were seen in fewer: networks
            localise those well that are seen in so many; set by hand.
        rounding: Relative rounding errors of resolutions.
    """

    seen_cells: float = 48.0
    fewest_cells: float = 5.0
    enough_cells: float = 16.0
    rounding: float = 1e-6


DEFAULTS = PyramidOptions()


@dataclass(frozen=True)
class PyramidLevel:
    """One size of a map's cells.

    Attributes:
        factor: How many of the map's cells make one of its own, along each axis.
        resolution: The side of its cells (m).
        extents: From which to which extent (m), from corner to corner, things are searched for in it.
    """

    factor: int
    resolution: float
    extents: tuple[float, float]


def levels_for(
    resolution: float, sizes: tuple[float, float], options: PyramidOptions = DEFAULTS
) -> tuple[PyramidLevel, ...]:
    """Choose the levels at which a map shows things of all sizes that are wanted.

    Args:
        resolution: The side of the map's cells (m).
        sizes: The smallest and the largest size (m): the longest side, or the diameter.
        options: Numeric parameters.

    Returns:
        The levels, the finest first, each with cells of twice the size of the one before.
    """
    smallest, largest = sizes
    factor = 1
    while 2 * factor * resolution * options.enough_cells <= smallest * (1 + options.rounding):
        factor *= 2
    widest, lower = largest * np.sqrt(2), 0.0
    levels: list[PyramidLevel] = []
    while not levels or lower < widest * (1 - options.rounding):
        upper = options.seen_cells * factor * resolution
        levels.append(PyramidLevel(factor, factor * resolution, (lower, upper)))
        factor, lower = 2 * factor, upper
    return tuple(levels)


def coarser(grid: OccupancyGrid, factor: int) -> OccupancyGrid:
    """Return a map with larger cells.

    A cell is as likely occupied as the likeliest of those in it where one is occupied, else as likely as those that
    are known are on average. It was visited by as many rays as cross as many of these in a row.

    Args:
        grid: The map.
        factor: How many of its cells make one, along each axis.

    Returns:
        The map, on whole multiples of its resolution; ``grid`` itself where the factor is 1.
    """
    if factor == 1:
        return grid
    fine = grid.frame
    row, col = fine.row // factor, fine.col // factor
    rows = -(-(fine.row + fine.rows) // factor) - row
    cols = -(-(fine.col + fine.cols) // factor) - col
    frame = GridFrame(fine.resolution * factor, row, col, rows, cols)
    likeliest, total = np.full(frame.shape, UNKNOWN), np.zeros(frame.shape, np.float32)
    known = np.zeros(frame.shape, np.float32)
    visits = None if grid.visits is None else np.zeros(frame.shape, np.float32)
    for inner, larger in _parts(fine, frame, factor):
        part = grid.probability[inner]
        is_known = part != UNKNOWN
        likeliest[larger] = np.maximum(likeliest[larger], part)
        total[larger] += np.where(is_known, part, np.float32(0))
        known[larger] += is_known
        if visits is not None and grid.visits is not None:
            visits[larger] += grid.visits[inner] / np.float32(factor)
    mean = np.where(known > 0, total / np.maximum(known, 1), UNKNOWN)
    return OccupancyGrid(frame, np.where(likeliest > UNKNOWN, likeliest, mean).astype(np.float32), visits)


def _parts(fine: GridFrame, frame: GridFrame, factor: int) -> Iterator[tuple[Slices, Slices]]:
    """Yield the cells of a map that lie at one place in their larger cell, and these cells: views, no copies."""
    for i in range(factor):
        for j in range(factor):
            first_row, first_col = (i - fine.row) % factor, (j - fine.col) % factor
            row, col = (fine.row + first_row) // factor - frame.row, (fine.col + first_col) // factor - frame.col
            rows = len(range(first_row, fine.rows, factor))
            cols = len(range(first_col, fine.cols, factor))
            inner = slice(first_row, None, factor), slice(first_col, None, factor)
            yield inner, (slice(row, row + rows), slice(col, col + cols))
