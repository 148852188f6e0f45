"""Binary morphology of grids: dilation, neighbourhoods, connected components."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from mapping.grid import GridFrame
from prim.arrays import BoolGrid
from prim.compiled import kernel


def dilate(cells: BoolGrid, steps: int) -> BoolGrid:
    """Dilate cells by a square.

    Args:
        cells: Marked cells (rows, cols).
        steps: Half the square's side (cells): 1 adds the 8 neighbours.

    Returns:
        The marked cells and all within ``steps`` cells of them.
    """
    grown = cells.copy()
    for axis in (0, 1):
        line = grown.copy()
        for step in range(1, steps + 1):
            ahead, behind = [slice(None)] * 2, [slice(None)] * 2
            ahead[axis], behind[axis] = slice(step, None), slice(None, -step)
            grown[tuple(ahead)] |= line[tuple(behind)]
            grown[tuple(behind)] |= line[tuple(ahead)]
    return grown


def connected_components(
    occupied: BoolGrid, frame: GridFrame, max_extent: float
) -> tuple[NDArray[np.int32], BoolGrid]:
    """Label the connected components of occupied cells (8 neighbours) and find the large ones.

    Args:
        occupied: Occupied cells (rows, cols).
        frame: The grid's frame.
        max_extent: A component is large where it extends over more than this (m) along an axis.

    Returns:
        Labels (rows, cols) from 1 on, 0 where a cell is not occupied; and which cells (rows, cols) belong to large
        components.
    """
    labels, large = np.zeros(occupied.shape, np.int32), np.zeros_like(occupied)
    label_components(occupied, max_extent / frame.resolution, labels, large)
    return labels, large


@kernel
def label_components(occupied: Any, max_extent: float, labels: Any, large: Any) -> None:
    """Label connected components (8 neighbours) by flood fill.

    Args:
        occupied: Occupied cells (rows, cols).
        max_extent: A component is large where it extends over more than this (cells) along an axis.
        labels: Filled (rows, cols) with labels from 1 on; zeros beforehand.
        large: Set (rows, cols) for cells of large components; False beforehand.
    """
    rows, cols = occupied.shape
    stack = np.empty((occupied.sum(), 2), np.int64)
    label = 0
    for row in range(rows):
        for col in range(cols):
            if not occupied[row, col] or labels[row, col]:
                continue
            label += 1
            labels[row, col] = label
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
                            labels[near_r, near_c] = label
                            stack[found] = near_r, near_c
                            found += 1
            if max(bottom - row, right - left) + 1 > max_extent:
                for cell in range(found):
                    large[stack[cell, 0], stack[cell, 1]] = True


def beside_free(free: BoolGrid) -> BoolGrid:
    """Return which cells (rows, cols) have a free cell among their 4 neighbours."""
    padded = np.pad(free, 1)
    return np.asarray(padded[:-2, 1:-1] | padded[2:, 1:-1] | padded[1:-1, :-2] | padded[1:-1, 2:])
