"""Maps as images of one size: the tiles that YOLO is trained on and runs on.

Pixel (row, col) of a tile's image is cell (row, col) of the tile: columns run along x, rows along y, and row 0 is at
the smallest y, as in every grid here. Boxes have the same axes. A program that draws row 0 at the top shows the map
upside down.
"""

from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from mapping.grid import UNKNOWN_GREY, GridFrame, OccupancyGrid

TILE_SIZE = 224
"""Side of a tile (cells): a multiple of YOLO's stride of 32 that holds the paper's 2 x 2 m and a margin."""

TILE_OVERLAP = 80
"""Smallest overlap (cells) of neighbouring tiles: a third more than the recorder's widest primitive, so that each
primitive lies whole in some tile."""

TILE_MARGIN = 24
"""Cells around what a tile is made for, where the map goes on: they tell a thing from a part; set by hand."""

STYLES = ("grey", "rounded")
"""How cells are rendered in three channels; model cards hold the names.

``grey`` is OccupancyGrid.image: probability of occupancy, expected visits, known or not. The first channel, all the
parameter networks read, gave it its name. ``rounded`` is the paper's (III-A): occupied, free or unknown, the same in
all three channels."""

Box = tuple[float, float, float, float]
"""x0, y0, x1, y1 in cells along columns and rows, the least first."""

BoxArray = NDArray[np.float32]
"""(N, 4) boxes: x0, y0, x1, y1 in cells along columns and rows."""


def tile_frames(frame: GridFrame) -> Iterator[GridFrame]:
    """Yield frames of tiles that cover a map, evenly spaced, overlapping by at least TILE_OVERLAP."""
    for row in _tile_starts(frame.row, frame.rows):
        for col in _tile_starts(frame.col, frame.cols):
            yield GridFrame(frame.resolution, row, col, TILE_SIZE, TILE_SIZE)


def _tile_starts(first: int, cells: int) -> list[int]:
    """Return the tiles' first cells along one axis; a single tile is centred on the map."""
    if cells <= TILE_SIZE:
        return [first - (TILE_SIZE - cells) // 2]
    count = math.ceil((cells - TILE_OVERLAP) / (TILE_SIZE - TILE_OVERLAP))
    return [first + round(k * (cells - TILE_SIZE) / (count - 1)) for k in range(count)]


def tile_around(box: NDArray[np.intp], frame: GridFrame) -> GridFrame:
    """Return a tile with something near its first corner, within a map where that is large enough.

    Args:
        box: (4,) its first and last row and column, from the map's first cell on.
        frame: The map's frame.

    Returns:
        The tile's frame.
    """

    def start(first: int, begin: int, cells: int) -> int:
        """Return the tile's first cell along one axis."""
        if cells <= TILE_SIZE:
            return begin - (TILE_SIZE - cells) // 2
        return begin + min(max(first - TILE_MARGIN, 0), cells - TILE_SIZE)

    row, col = start(int(box[0]), frame.row, frame.rows), start(int(box[2]), frame.col, frame.cols)
    return GridFrame(frame.resolution, row, col, TILE_SIZE, TILE_SIZE)


def clip_to_tile(grid: OccupancyGrid, tile: GridFrame) -> OccupancyGrid | None:
    """Return the part of a map within a tile, as a view.

    Args:
        grid: The map.
        tile: The tile's frame.

    Returns:
        The part, which shares the map's memory; None where they do not intersect.
    """
    frame = grid.frame
    row, col = max(tile.row, frame.row), max(tile.col, frame.col)
    last_row = min(tile.row + tile.rows, frame.row + frame.rows)
    last_col = min(tile.col + tile.cols, frame.col + frame.cols)
    if row >= last_row or col >= last_col:
        return None
    shared = GridFrame(frame.resolution, row, col, last_row - row, last_col - col)
    part = frame.window(shared)
    return OccupancyGrid(shared, grid.probability[part], None if grid.visits is None else grid.visits[part])


def tile_image(grid: OccupancyGrid, tile: GridFrame, style: str = "grey") -> NDArray[np.uint8]:
    """Render a tile of a map.

    Args:
        grid: The map; cells of the tile beyond it are unknown.
        tile: The tile's frame.
        style: One of STYLES.

    Returns:
        The image (rows, cols, 3).
    """
    image = np.zeros((tile.rows, tile.cols, 3), np.uint8)
    image[..., slice(0, 1) if style == "grey" else slice(None)] = UNKNOWN_GREY
    part = clip_to_tile(grid, tile)
    if part is not None:
        image[tile.window(part.frame)] = part.image() if style == "grey" else rounded_image(part)
    return image


def rounded_image(grid: OccupancyGrid) -> NDArray[np.uint8]:
    """Render a map in the paper's style (rows, cols, 3): 255 occupied, 0 free, UNKNOWN_GREY unknown."""
    grey = np.select((grid.occupied, grid.free), (np.uint8(255), np.uint8(0)), np.uint8(UNKNOWN_GREY))
    return np.repeat(grey[..., None], 3, axis=2)
