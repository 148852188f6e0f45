"""Occupancy grids: probabilities of occupancy on cells that lie on whole multiples of the resolution."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from mapping.kernels import BORDER_SLACK
from prim.arrays import BoolGrid, FloatArray
from prim.errors import UsageError
from prim.world import Bounds

UNKNOWN = np.float32(0.5)


class MapSizeError(UsageError):
    """A map that would have too many cells.

    Args:
        what: How large it would be.
        resolution: The side of its cells (m).
        excess: By how much too many there would be: their number over the largest.

    Attributes:
        what: How large it would be, without the hint.
        coarser: A resolution (m) of which there would be few enough.
    """

    def __init__(self, what: str, resolution: float, excess: float) -> None:
        self.what = what
        finest = resolution * math.sqrt(excess)
        digit = 10.0 ** math.floor(math.log10(finest))
        self.coarser = math.ceil(1.01 * finest / digit) * digit
        super().__init__(f"{what}: give --resolution {self.coarser:g} or a coarser one, or smaller --bounds")


UNKNOWN_GREY = 128
"""Grey value of a probability of 0.5 in an image."""

WHITE_VISITS = 10_000.0
"""In an image, this many expected visits of a cell and more are white: part of the networks' image definition."""

MAX_CELLS = 200_000_000
"""A grid of more cells is refused: it would not fit into a laptop's memory. Set by hand."""


def cell_of(coordinate: float, resolution: float) -> int:
    """Return the index of the cell that holds a coordinate; a border belongs to the cell above it.

    Args:
        coordinate: The coordinate (m).
        resolution: Side of a cell (m).

    Returns:
        The index in the plane.
    """
    return math.floor(coordinate / resolution + BORDER_SLACK)


@dataclass(frozen=True, slots=True)
class GridFrame:
    """The place and size of a grid in the map frame.

    Cell (r, c) of the plane covers [c, c + 1) x [r, r + 1) times the resolution, so that grids of one resolution are
    always aligned.

    Attributes:
        resolution: Side of a cell (m).
        row: Row in the plane of the first cell.
        col: Column in the plane of the first cell.
        rows: Number of rows.
        cols: Number of columns.

    Raises:
        MapSizeError: Where it would have more than MAX_CELLS cells.
    """

    resolution: float
    row: int
    col: int
    rows: int
    cols: int

    def __post_init__(self) -> None:
        if self.rows * self.cols > MAX_CELLS:
            metres = f"{self.cols * self.resolution:.0f} x {self.rows * self.resolution:.0f} m"
            raise MapSizeError(
                f"a map of {metres} has {self.rows * self.cols / 1e6:.0f} million cells of {self.resolution:g} m, "
                f"more than {MAX_CELLS / 1e6:.0f} million",
                self.resolution,
                self.rows * self.cols / MAX_CELLS,
            )

    @classmethod
    def covering(cls, bounds: Bounds, resolution: float) -> GridFrame:
        """Return the smallest frame that covers bounds.

        Args:
            bounds: (x0, y0, x1, y1) (m).
            resolution: Side of a cell (m).

        Returns:
            The frame.
        """
        x0, y0, x1, y1 = bounds
        row, col = cell_of(y0, resolution), cell_of(x0, resolution)
        rows = -cell_of(-y1, resolution) - row
        cols = -cell_of(-x1, resolution) - col
        return cls(resolution, row, col, max(rows, 1), max(cols, 1))

    @property
    def origin(self) -> tuple[float, float]:
        """The lower left corner: x, y (m)."""
        return self.col * self.resolution, self.row * self.resolution

    @property
    def bounds(self) -> Bounds:
        """The bounds: x0, y0, x1, y1 (m)."""
        x, y = self.origin
        return x, y, (self.col + self.cols) * self.resolution, (self.row + self.rows) * self.resolution

    @property
    def shape(self) -> tuple[int, int]:
        """The shape of the grid's arrays: rows, columns."""
        return self.rows, self.cols

    def union(self, other: GridFrame) -> GridFrame:
        """Return the smallest frame that covers this one and another of the same resolution."""
        row, col = min(self.row, other.row), min(self.col, other.col)
        rows = max(self.row + self.rows, other.row + other.rows) - row
        cols = max(self.col + self.cols, other.col + other.cols) - col
        return GridFrame(self.resolution, row, col, rows, cols)

    def padded(self, pad: int) -> GridFrame:
        """Return the frame that is larger by ``pad`` cells on all sides."""
        return GridFrame(self.resolution, self.row - pad, self.col - pad, self.rows + 2 * pad, self.cols + 2 * pad)

    def window(self, inner: GridFrame) -> tuple[slice, slice]:
        """Return the slices of this frame's arrays that a frame within it covers."""
        row, col = inner.row - self.row, inner.col - self.col
        return slice(row, row + inner.rows), slice(col, col + inner.cols)

    def centres(self, cells: BoolGrid) -> FloatArray:
        """Return the centres (N, 2) in metres of the marked cells (rows, cols)."""
        rows, cols = np.nonzero(cells)
        return np.asarray((np.column_stack((cols + self.col, rows + self.row)) + 0.5) * self.resolution)


@dataclass(frozen=True, slots=True)
class OccupancyGrid:
    """An occupancy grid; row 0 is at the smallest y.

    Attributes:
        frame: Where it lies.
        probability: Probability of occupancy (rows, cols) float32, 0.5 where unknown.
        visits: Expected number of rays that reached each cell (rows, cols) float32: those that ended in it and those
            that passed it; None where the mapper does not compute it.
    """

    frame: GridFrame
    probability: NDArray[np.float32]
    visits: NDArray[np.float32] | None = None

    @property
    def occupied(self) -> BoolGrid:
        """Cells (rows, cols) more likely occupied than not: the paper's rounding."""
        return self.probability > UNKNOWN

    @property
    def free(self) -> BoolGrid:
        """Cells (rows, cols) more likely free than not."""
        return self.probability < UNKNOWN

    def image(self) -> NDArray[np.uint8]:
        """Return the detector's image (rows, cols, 3) uint8: probability of occupancy, expected visits, known or not.

        The probability is scaled to 0 to 255. The visits are logarithmic, 255 at WHITE_VISITS rays and more; where
        the mapper has none, the channel equals the third one: 255 where the cell is known, else 0. Row 0 is at the
        smallest y.
        """
        known = np.where(self.occupied | self.free, np.uint8(255), np.uint8(0))
        visits = known
        if self.visits is not None:
            scaled = np.log1p(self.visits) * (255 / math.log1p(WHITE_VISITS))
            visits = np.clip(scaled, 0, 255).astype(np.uint8)
        probability = np.rint(self.probability * 255).astype(np.uint8)
        return np.stack((probability, visits, known), axis=-1)


class GrowingGrid:
    """An array over the plane's cells that grows on demand, or has given bounds.

    Attributes:
        array: The array (rows, cols).
        frame: The frame that it covers.
        used: The part of the frame that has been asked for; None before any has.
        fixed: Whether the bounds were given.
    """

    def __init__(
        self,
        resolution: float,
        bounds: Bounds | None,
        fill: float,
        dtype: type[np.generic],
        margin: float = 0.0,
    ) -> None:
        """Make the array.

        Args:
            resolution: Side of a cell (m).
            bounds: (x0, y0, x1, y1) (m); None: the array grows.
            fill: Value of new cells.
            dtype: The array's type.
            margin: A growing array extends at least this far (m) beyond what has been asked for.
        """
        self.resolution = resolution
        self.fixed = bounds is not None
        self.fill = fill
        self.margin = math.ceil(margin / resolution) + 1
        self.frame = GridFrame.covering(bounds or (0.0, 0.0, resolution, resolution), resolution)
        self.used: GridFrame | None = self.frame if self.fixed else None
        self.array = np.full(self.frame.shape, fill, dtype)

    def cover(self, row: int, col: int, last_row: int, last_col: int) -> None:
        """Grow the array to hold a rectangle of cells of the plane, unless its bounds were given.

        Args:
            row: First row.
            col: First column.
            last_row: Last row, included.
            last_col: Last column, included.
        """
        if self.fixed:
            return
        needed = GridFrame(self.resolution, row, col, last_row - row + 1, last_col - col + 1)
        before, self.used = self.used, needed if self.used is None else self.used.union(needed)
        if before and self.used.padded(self.margin).union(self.frame) == self.frame:
            return
        grown = self.used.padded(self.margin + max(self.used.shape) // 4)
        if before:
            grown = grown.union(self.frame)
        array = np.full(grown.shape, self.fill, self.array.dtype)
        if before:
            array[grown.window(self.frame)] = self.array
        self.frame, self.array = grown, array

    def crop(self) -> tuple[GridFrame, NDArray[np.generic]]:
        """Return the frame in use and a copy of its part of the array."""
        used = self.used or self.frame
        return used, self.array[self.frame.window(used)].copy()
