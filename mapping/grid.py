"""The one grid type: probabilities of occupancy on cells that lie on whole multiples of the resolution."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from mapping.kernels import BORDER_SLACK
from prim.errors import UsageError
from prim.world import Bounds

UNKNOWN = np.float32(0.5)
UNKNOWN_GREY = 128
"""What a probability of 0.5 is in an image."""

EVIDENCE_TOP = 10_000.0
"""In an image, this many rays to a cell are white."""

MAX_CELLS = 200_000_000
"""A grid of more cells is refused: it would not fit the memory of a laptop."""


def cell_of(coordinate: float, resolution: float) -> int:
    """Index of the cell that holds a coordinate (m); a border belongs to the cell above it."""
    return math.floor(coordinate / resolution + BORDER_SLACK)


@dataclass(frozen=True, slots=True)
class GridFrame:
    """Where a grid lies: cells of ``resolution`` metres, ``rows`` x ``cols`` of them, from cell (``row``, ``col``).

    Cell (r, c) of the plane covers [c, c + 1) x [r, r + 1) times the resolution, so that grids of one resolution
    always fit on each other. Raises UsageError where it would have more than MAX_CELLS cells.
    """

    resolution: float
    row: int
    col: int
    rows: int
    cols: int

    def __post_init__(self) -> None:
        if self.rows * self.cols > MAX_CELLS:
            metres = f"{self.cols * self.resolution:.0f} x {self.rows * self.resolution:.0f} m"
            raise UsageError(
                f"a map of {metres} has {self.rows * self.cols / 1e6:.0f} million cells of {self.resolution:g} m, "
                f"more than {MAX_CELLS / 1e6:.0f} million: give a coarser --resolution or smaller --bounds"
            )

    @classmethod
    def covering(cls, bounds: Bounds, resolution: float) -> GridFrame:
        """The smallest frame that covers ``bounds`` (m)."""
        x0, y0, x1, y1 = bounds
        row, col = cell_of(y0, resolution), cell_of(x0, resolution)
        rows = -cell_of(-y1, resolution) - row
        cols = -cell_of(-x1, resolution) - col
        return cls(resolution, row, col, max(rows, 1), max(cols, 1))

    @property
    def origin(self) -> tuple[float, float]:
        """x, y (m) of the lower left corner."""
        return self.col * self.resolution, self.row * self.resolution

    @property
    def bounds(self) -> Bounds:
        """x0, y0, x1, y1 (m)."""
        x, y = self.origin
        return x, y, (self.col + self.cols) * self.resolution, (self.row + self.rows) * self.resolution

    @property
    def shape(self) -> tuple[int, int]:
        """Rows, columns."""
        return self.rows, self.cols

    def union(self, other: GridFrame) -> GridFrame:
        """The smallest frame that covers both."""
        row, col = min(self.row, other.row), min(self.col, other.col)
        rows = max(self.row + self.rows, other.row + other.rows) - row
        cols = max(self.col + self.cols, other.col + other.cols) - col
        return GridFrame(self.resolution, row, col, rows, cols)

    def padded(self, pad: int) -> GridFrame:
        """A frame larger by ``pad`` cells on all sides."""
        return GridFrame(self.resolution, self.row - pad, self.col - pad, self.rows + 2 * pad, self.cols + 2 * pad)

    def window(self, inner: GridFrame) -> tuple[slice, slice]:
        """Where ``inner``, which must lie within, is in this frame's arrays."""
        row, col = inner.row - self.row, inner.col - self.col
        return slice(row, row + inner.rows), slice(col, col + inner.cols)


@dataclass(frozen=True, slots=True)
class OccupancyGrid:
    """``probability`` (rows, cols) float32 of occupancy, 0.5 where unknown; row 0 at the smallest y.

    ``evidence`` (rows, cols) float32, where the mapper has it: how many rays are expected to have come to each cell.
    """

    frame: GridFrame
    probability: NDArray[np.float32]
    evidence: NDArray[np.float32] | None = None

    @property
    def occupied(self) -> NDArray[np.bool_]:
        """Cells more likely occupied than not: the paper's rounding."""
        return self.probability > UNKNOWN

    @property
    def free(self) -> NDArray[np.bool_]:
        """Cells more likely free than not."""
        return self.probability < UNKNOWN

    def image(self) -> NDArray[np.uint8]:
        """What a detector sees (rows, cols, 3): probability of occupancy, evidence, and whether the cell is known.

        The probability is 0 to 255; the evidence is logarithmic, 255 at EVIDENCE_TOP rays and more, and where the
        mapper does not tell it, the same as the third: 255 where the cell is known, else 0. Row 0 at the smallest y.
        """
        known = np.where(self.occupied | self.free, np.uint8(255), np.uint8(0))
        evidence = known
        if self.evidence is not None:
            scaled = np.log1p(self.evidence) * (255 / math.log1p(EVIDENCE_TOP))
            evidence = np.clip(scaled, 0, 255).astype(np.uint8)
        probability = np.rint(self.probability * 255).astype(np.uint8)
        return np.stack((probability, evidence, known), axis=-1)

    def centres(self, cells: NDArray[np.bool_]) -> NDArray[np.float64]:
        """Centres (N, 2) in metres of the marked cells."""
        rows, cols = np.nonzero(cells)
        corner = np.column_stack((cols + self.frame.col, rows + self.frame.row))
        return np.asarray((corner + 0.5) * self.frame.resolution, dtype=np.float64)


class Layer:
    """An array over the plane's cells that grows, or is held to given bounds.

    ``array`` covers ``frame``; ``used`` is the part of it that has been asked for. A growing array reaches at least
    ``margin`` metres beyond that.
    """

    def __init__(
        self,
        resolution: float,
        bounds: Bounds | None,
        fill: float,
        dtype: type[np.generic],
        margin: float = 0.0,
    ) -> None:
        self.resolution = resolution
        self.fixed = bounds is not None
        self.fill = fill
        self.margin = math.ceil(margin / resolution) + 1
        self.frame = GridFrame.covering(bounds or (0.0, 0.0, resolution, resolution), resolution)
        self.used: GridFrame | None = self.frame if self.fixed else None
        self.array = np.full(self.frame.shape, fill, dtype)

    def cover(self, row: int, col: int, last_row: int, last_col: int) -> None:
        """Grows the array to hold these cells (both ends included), unless its bounds were given."""
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
        """The frame in use and a copy of its part of the array."""
        used = self.used or self.frame
        return used, self.array[self.frame.window(used)].copy()
