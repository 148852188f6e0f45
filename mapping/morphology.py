"""Morphology of cells: dilation, neighbours, connected components, cell centres."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from mapping.grid import GridFrame
from prim.arrays import BoolGrid, FloatArray
from prim.compiled import kernel


def dilate(cells: BoolGrid, steps: int) -> BoolGrid:
    """The cells and all within ``steps`` cells of them (8 neighbours)."""
    grown = cells.copy()
    for axis in (0, 1):
        line = grown.copy()
        for step in range(1, steps + 1):
            ahead, behind = [slice(None)] * 2, [slice(None)] * 2
            ahead[axis], behind[axis] = slice(step, None), slice(None, -step)
            grown[tuple(ahead)] |= line[tuple(behind)]
            grown[tuple(behind)] |= line[tuple(ahead)]
    return grown


def connected_components(occupied: BoolGrid, frame: GridFrame, largest: float) -> tuple[NDArray[np.int32], BoolGrid]:
    """Connected components of occupied cells (8 neighbours): labels from 1 on, and which cells are of large ones.

    A component is large where it extends over more than ``largest`` metres along an axis.
    """
    labels, large = np.zeros(occupied.shape, np.int32), np.zeros_like(occupied)
    number_connected(occupied, largest / frame.resolution, labels, large)
    return labels, large


@kernel
def number_connected(occupied: Any, most: float, labels: Any, large: Any) -> None:
    """Numbers occupied cells (rows, cols) by what hangs together, through any of 8 neighbours, from 1 on: ``labels``.

    ``large`` are those of what reaches over more than ``most`` cells along an axis.
    """
    rows, cols = occupied.shape
    stack = np.empty((occupied.sum(), 2), np.int64)
    number = 0
    for row in range(rows):
        for col in range(cols):
            if not occupied[row, col] or labels[row, col]:
                continue
            number += 1
            labels[row, col] = number
            stack[0] = row, col
            done, found = 0, 1
            bottom, left, right = row, col, col
            while done < found:
                r, c = stack[done]
                done += 1
                bottom, left, right = max(bottom, r), min(left, c), max(right, c)
                for near_r in range(max(r - 1, 0), min(r + 2, rows)):
                    for near_c in range(max(c - 1, 0), min(c + 2, cols)):
                        if occupied[near_r, near_c] and not labels[near_r, near_c]:
                            labels[near_r, near_c] = number
                            stack[found] = near_r, near_c
                            found += 1
            if max(bottom - row, right - left) + 1 > most:
                for cell in range(found):
                    large[stack[cell, 0], stack[cell, 1]] = True


def beside_free(free: BoolGrid) -> BoolGrid:
    """Cells with a neighbour (4) that is free."""
    padded = np.pad(free, 1)
    return np.asarray(padded[:-2, 1:-1] | padded[2:, 1:-1] | padded[1:-1, :-2] | padded[1:-1, 2:])


def centres(chosen: BoolGrid, frame: GridFrame) -> FloatArray:
    """The centres (N, 2) in metres of some of a grid's cells."""
    rows, cols = np.nonzero(chosen)
    return np.asarray((np.column_stack((cols + frame.col, rows + frame.row)) + 0.5) * frame.resolution)
