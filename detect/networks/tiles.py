"""Maps as images of one size: what a detector is trained on, and what it looks at."""

from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from mapping.grid import UNKNOWN_GREY, GridFrame, OccupancyGrid

TILE = 224
"""Side of an image in cells: a multiple of 32, as YOLO wants it, and enough for the paper's 2 x 2 m and a margin."""

OVERLAP = 80
"""Tiles of a larger map overlap by this many cells: a third more than any primitive is wide."""

STYLES = ("grey", "rounded")
"""How cells are shown: ``grey`` is OccupancyGrid.image; ``rounded`` is the paper's (III-A): occupied, free or
unknown, the same in all three channels."""


def tiles(frame: GridFrame) -> Iterator[GridFrame]:
    """Frames of TILE x TILE cells that cover a map, evenly spread, each overlapping the next by OVERLAP at least."""
    for row in _starts(frame.row, frame.rows):
        for col in _starts(frame.col, frame.cols):
            yield GridFrame(frame.resolution, row, col, TILE, TILE)


def _starts(first: int, cells: int) -> list[int]:
    """Where tiles begin along one axis; a single tile is centred on the map."""
    if cells <= TILE:
        return [first - (TILE - cells) // 2]
    count = math.ceil((cells - OVERLAP) / (TILE - OVERLAP))
    return [first + round(k * (cells - TILE) / (count - 1)) for k in range(count)]


def window(grid: OccupancyGrid, tile: GridFrame) -> OccupancyGrid | None:
    """The part of a map that lies in a tile; None where there is none. Shares the map's memory."""
    frame = grid.frame
    row, col = max(tile.row, frame.row), max(tile.col, frame.col)
    last_row = min(tile.row + tile.rows, frame.row + frame.rows)
    last_col = min(tile.col + tile.cols, frame.col + frame.cols)
    if row >= last_row or col >= last_col:
        return None
    shared = GridFrame(frame.resolution, row, col, last_row - row, last_col - col)
    part = frame.window(shared)
    return OccupancyGrid(shared, grid.probability[part], None if grid.evidence is None else grid.evidence[part])


def cut(grid: OccupancyGrid, tile: GridFrame, style: str = "grey") -> NDArray[np.uint8]:
    """A tile's image (TILE, TILE, 3), row 0 at the smallest y; what lies beyond the map is unknown."""
    image = np.zeros((tile.rows, tile.cols, 3), np.uint8)
    image[..., slice(0, 1) if style == "grey" else slice(None)] = UNKNOWN_GREY
    part = window(grid, tile)
    if part is not None:
        image[tile.window(part.frame)] = part.image() if style == "grey" else rounded(part)
    return image


def rounded(grid: OccupancyGrid) -> NDArray[np.uint8]:
    """A map as the paper shows it (rows, cols, 3): 255 occupied, 0 free, UNKNOWN_GREY unknown."""
    grey = np.select((grid.occupied, grid.free), (np.uint8(255), np.uint8(0)), np.uint8(UNKNOWN_GREY))
    return np.repeat(grey[..., None], 3, axis=2)
