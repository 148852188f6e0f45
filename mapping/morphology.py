"""Binary morphology of grids, by OpenCV: dilation, neighbourhoods, connected components, distances.

OpenCV is imported when it is needed: many replays need none of it.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from mapping.grid import GridFrame
from prim.arrays import BoolGrid


def dilate(cells: BoolGrid, steps: int) -> BoolGrid:
    """Dilate cells by a square.

    Args:
        cells: Marked cells (rows, cols).
        steps: Half the square's side (cells): 1 adds the 8 neighbours.

    Returns:
        The marked cells and all within ``steps`` cells of them.
    """
    return _dilated(cells, np.ones((2 * steps + 1, 2 * steps + 1), np.uint8))


def beside_free(free: BoolGrid) -> BoolGrid:
    """Return which cells (rows, cols) have a free cell among their 4 neighbours."""
    return _dilated(free, np.array([[0, 1, 0], [1, 0, 1], [0, 1, 0]], np.uint8))


def _dilated(cells: BoolGrid, neighbours: NDArray[np.uint8]) -> BoolGrid:
    import cv2

    return cv2.dilate(cells.view(np.uint8), neighbours).view(np.bool_)


def connected_components(
    occupied: BoolGrid, frame: GridFrame, max_extent: float
) -> tuple[NDArray[np.int32], BoolGrid]:
    """Label the connected components of occupied cells (8 neighbours) and find the large ones.

    Args:
        occupied: Occupied cells (rows, cols).
        frame: The grid's frame.
        max_extent: A component is large where it extends over more than this (m) along an axis.

    Returns:
        Labels (rows, cols) from 1 on, in the order of the components' first cells, 0 where a cell is not occupied;
        and which cells (rows, cols) belong to large components.
    """
    import cv2

    cells = occupied.view(np.uint8)
    # Wu's algorithm, of all that OpenCV has, numbers components in the order of their first cells
    _, labels, boxes, _ = cv2.connectedComponentsWithStatsWithAlgorithm(cells, 8, cv2.CV_32S, cv2.CCL_WU)
    is_large = boxes[:, [cv2.CC_STAT_WIDTH, cv2.CC_STAT_HEIGHT]].max(axis=1) > max_extent / frame.resolution
    is_large[0] = False  # what is not occupied
    return np.asarray(labels, dtype=np.int32), is_large[labels]


def isolated_boxes(occupied: BoolGrid, most: int) -> NDArray[np.intp]:
    """Find what stands isolated: connected components of occupied cells, gaps of a cell closed, that are not large.

    Args:
        occupied: Occupied cells (rows, cols).
        most: The most cells along an axis.

    Returns:
        (N, 4) first and last row and column of each, in the order of these.
    """
    import cv2

    closed = cv2.morphologyEx(occupied.view(np.uint8), cv2.MORPH_CLOSE, np.ones((3, 3), np.uint8))
    _, _, stats, _ = cv2.connectedComponentsWithStats(closed, connectivity=8, ltype=cv2.CV_32S)
    col, row, width, height, _ = stats[1:].T.astype(np.intp)  # the first one is what is not occupied
    boxes = np.column_stack((row, row + height - 1, col, col + width - 1))
    boxes = boxes[np.maximum(width, height) <= most]
    return np.asarray(boxes[np.lexsort((boxes[:, 2], boxes[:, 0]))])


def label(cells: BoolGrid) -> NDArray[np.int32]:
    """Label the connected components of marked cells (8 neighbours): from 1 on, 0 where a cell is not marked."""
    import cv2

    return np.asarray(cv2.connectedComponents(cells.view(np.uint8), connectivity=8)[1], dtype=np.int32)


def component_around(solid: BoolGrid, own: BoolGrid) -> BoolGrid | None:
    """Find the connected component (4 neighbours) of cells with the most cells in a region.

    Links of one cell's width are cut outside of the region (a morphological opening by 3 x 3 cells).

    Args:
        solid: The cells (rows, cols).
        own: The region (rows, cols).

    Returns:
        The component's cells (rows, cols); None where none is in the region.
    """
    import cv2

    opened = cv2.morphologyEx(solid.view(np.uint8), cv2.MORPH_OPEN, np.ones((3, 3), np.uint8)).view(np.bool_)
    labels = cv2.connectedComponents((opened | (solid & own)).view(np.uint8), connectivity=4)[1]
    counts = np.bincount(labels[own], minlength=2)
    counts[0] = 0
    return np.asarray(labels == counts.argmax()) if counts.any() else None


def chessboard_distances(occupied: BoolGrid) -> NDArray[np.uint8]:
    """Compute the chessboard distance (cells) of each cell to the nearest occupied one, or to beyond the map.

    Args:
        occupied: Occupied cells (rows, cols).

    Returns:
        The distances (rows, cols), at most those that one byte holds.
    """
    import cv2

    others = np.pad(~occupied, 1).view(np.uint8)
    distances = cv2.distanceTransform(others, cv2.DIST_C, cv2.DIST_MASK_3)[1:-1, 1:-1]
    return np.minimum(distances, np.iinfo(np.uint8).max).astype(np.uint8)


def outer_contour(cells: BoolGrid, tolerance: float) -> NDArray[np.float64]:
    """Return the outer contour of the largest connected component of cells, holes filled, as a simplified polygon.

    Args:
        cells: Marked cells (rows, cols), at least one.
        tolerance: How far the polygon may be off (cells; Douglas and Peucker 1973).

    Returns:
        Vertices (V, 2) as column and row, in cells from the grid's first corner, counter-clockwise.
    """
    import cv2

    doubled = np.repeat(np.repeat(cells.view(np.uint8), 2, axis=0), 2, axis=1)  # a cell's own width shows
    contours, _ = cv2.findContours(np.pad(doubled, 1), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    largest = max(contours, key=cv2.contourArea)
    simple = cv2.approxPolyDP(largest, 2 * tolerance, True)[:, 0].astype(np.float64)
    (x, y), (next_x, next_y) = simple.T, np.roll(simple, -1, axis=0).T
    ordered = simple if (x * next_y - next_x * y).sum() >= 0 else simple[::-1]
    return np.asarray((ordered - 1.0 + 0.5) / 2)
