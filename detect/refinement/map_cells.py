"""A map's cells as refinement sees them: which may be of primitives, and which are of walls."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from detect.refinement.lines import Line, find_lines, middle_line, off_line
from mapping.grid import GridFrame, OccupancyGrid
from mapping.morphology import beside_free, centres, connected_components, dilate
from prim.arrays import BoolGrid, FloatArray
from prim.shapes import Primitive

LARGE = 0.75
"""What hangs together over more than this (m) is no primitive."""

LEAST_WALL = 0.8
"""A straight line through this much (m) of what is occupied and next to something free is a wall."""

BENT, LEAST_DENSE = 3.0, 0.7
"""Noise bends a wall in the map: its cells lie this near (cells) to its line, over such a share of its length at
least. Lines through specks have half of that.
"""

SHARP, LEAST_SHARP = 1.0, 0.4
"""Or they lie this near, over such a share: mappers wear holes into walls that are seen at a slant."""

WALL_CELLS = 3.0
"""Cells this near (cells) to a wall's line are the wall's: noise makes it thick."""

THICK, ONE_SIDED = 0.4, 0.2
"""Where one side of a wall has so much less that is free than the other, the wall goes on into it for so much (m)."""

PIERCED = 0.025
"""What reaches further (m) behind a wall is no primitive."""

MOST_WALLS = 16

TOUCHING = 0.008
"""Cells of a wall whose centres lie within this (m) of a primitive are taken for the primitive's."""


@dataclass(frozen=True)
class OneSided:
    """A wall with nothing free behind it: its line, whose normal points to the free side, from where to where (m)."""

    line: Line
    first: float
    last: float

    def hides(self, points: FloatArray, depth: float, beyond: float) -> bool:
        """Whether some of the points lie more than ``depth`` (m) behind it, or behind where it would go on to.

        ``beyond`` (m) is how far it would go on beyond its ends.
        """
        nx, ny, d = self.line
        along, behind = points @ np.array([-ny, nx]), d - points @ np.array([nx, ny])
        beside = (along > self.first - beyond) & (along < self.last + beyond)
        return bool((beside & (behind > depth) & (behind < THICK)).any())


@dataclass(frozen=True)
class MapCells:
    """A map's occupied cells (rows, cols), numbered by what hangs together (0: not occupied), and which of them
    belong to something larger than any primitive; its free cells; and the walls that are free on one side only.
    """

    frame: GridFrame
    occupied: NDArray[np.bool_]
    free: NDArray[np.bool_]
    labels: NDArray[np.int32]
    large: NDArray[np.bool_]
    walls: tuple[OneSided, ...] = ()

    @classmethod
    def of(cls, grid: OccupancyGrid) -> MapCells:
        """The cells of a map: what hangs together over more than LARGE is a wall, or the like.

        What hangs on a straight wall is told apart from it: it may be a primitive that stands close to it.
        """
        walls, one_sided = _along_lines(grid)
        labels, loose = connected_components(grid.occupied & ~walls, grid.frame, LARGE)
        return cls(grid.frame, grid.occupied, grid.free, labels, walls | loose, tuple(one_sided))

    def is_pierced_by(self, primitive: Primitive) -> bool:
        """Whether a primitive reaches behind a wall that is free on one side only."""
        outline = primitive.outline(32)
        return any(wall.hides(outline, PIERCED, 0.0) for wall in self.walls)

    @cached_property
    def wall_surface(self) -> FloatArray:
        """The centres (N, 2) in metres of large things' cells that are next to something free."""
        return centres(self.large & beside_free(self.free), self.frame)

    def large_within(self, primitive: Primitive, margin: float) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
        """Rows and columns of large things' cells in a primitive and within ``margin`` (m) of it."""
        rows, cols, points = _cells_around(self.frame, primitive, primitive.circumradius + margin)
        at_rows, at_cols = np.nonzero(self.large[rows, cols] & is_within(primitive, points, margin))
        return at_rows + rows.start, at_cols + cols.start

    def hide(self, primitive: Primitive) -> bool:
        """Whether a primitive's middle lies behind such a wall, or behind where the wall would go on to."""
        middle = np.array([[primitive.x, primitive.y]])
        return any(wall.hides(middle, 0.0, THICK) for wall in self.walls)

    def is_touched_by(self, primitive: Primitive) -> bool:
        """Whether it reaches at all behind such a wall, or behind where the wall would go on to."""
        outline = primitive.outline(32)
        return any(wall.hides(outline, PIERCED, THICK) for wall in self.walls)

    def without(self, primitives: Sequence[Primitive], margin: float) -> NDArray[np.bool_]:
        """The occupied cells (rows, cols) but for those of the primitives and within ``margin`` (m) of them.

        Walls stay, but for what lies in a primitive or all but touches it.
        """
        occupied = self.occupied.copy()
        for primitive in primitives:
            rows, cols, points = _cells_around(self.frame, primitive, primitive.circumradius + margin)
            near, touching = (is_within(primitive, points, reach) for reach in (margin, min(margin, TOUCHING)))
            occupied[rows, cols] &= ~np.where(self.large[rows, cols], touching, near)
        return occupied


def _cells_around(frame: GridFrame, primitive: Primitive, reach: float) -> tuple[slice, slice, FloatArray]:
    """The part of a grid around a primitive: its rows and columns, and its cells' centres (rows, cols, 2)."""

    def span(middle: float, first: int, count: int) -> tuple[int, int]:
        low = math.floor((middle - reach) / frame.resolution) - first
        high = math.ceil((middle + reach) / frame.resolution) - first
        return min(max(low, 0), count), min(max(high, 0), count)

    row, last_row = span(primitive.y, frame.row, frame.rows)
    col, last_col = span(primitive.x, frame.col, frame.cols)
    x = (np.arange(col, last_col) + frame.col + 0.5) * frame.resolution
    y = (np.arange(row, last_row) + frame.row + 0.5) * frame.resolution
    return slice(row, last_row), slice(col, last_col), np.stack(np.meshgrid(x, y), axis=-1)


def _along_lines(grid: OccupancyGrid) -> tuple[BoolGrid, list[OneSided]]:
    """Which occupied cells lie along straight walls, and which of the walls are free on one side only."""
    resolution = grid.frame.resolution
    surface = centres(grid.occupied & beside_free(grid.free), grid.frame)
    rows, cols = np.nonzero(grid.occupied)
    points = centres(grid.occupied, grid.frame)
    free = centres(grid.free & dilate(grid.occupied, round(2 * WALL_CELLS)), grid.frame)
    near = np.zeros(len(points), np.bool_)
    one_sided = []
    for line, on_it in _straight(surface, resolution):
        nx, ny, d = line
        off, along = points @ np.array([nx, ny]) - d, points @ np.array([-ny, nx])
        thin = WALL_CELLS * resolution
        side = _free_side(line, on_it, free, resolution)
        first, last = _ends(on_it, line)
        beside = (along > first - thin) & (along < last + thin)
        near |= beside & (off > (-THICK if side > 0 else -thin)) & (off < (THICK if side < 0 else thin))
        if side:
            ends = sorted((side * first, side * last))
            one_sided.append(OneSided((side * nx, side * ny, side * d), ends[0], ends[1]))
    walls = np.zeros_like(grid.occupied)
    walls[rows[near], cols[near]] = True
    return walls, one_sided


def _straight(surface: FloatArray, resolution: float) -> Iterator[tuple[Line, FloatArray]]:
    """The lines of straight walls, each with the cells' centres (N, 2) of a ``surface`` that are on it."""
    for wide in find_lines(surface, resolution, LEAST_WALL, MOST_WALLS, BENT):
        line = middle_line(surface[off_line(surface, wide) < BENT * resolution], resolution)
        off = off_line(surface, line) / resolution
        on_it = surface[off < BENT]
        first, last = _ends(on_it, line)
        dense, sharp = (_covered(surface[off < width], line, resolution) for width in (BENT, SHARP))
        if dense >= LEAST_WALL and max(dense / LEAST_DENSE, sharp / LEAST_SHARP) >= last - first:
            yield line, on_it


def _covered(on_it: FloatArray, line: Line, resolution: float) -> float:
    """How much (m) of a line has cells on it."""
    return len(np.unique(np.floor(on_it @ np.array([-line[1], line[0]]) / resolution))) * resolution


def _ends(on_it: FloatArray, line: Line) -> tuple[float, float]:
    """From where to where (m, along a line) points on it go."""
    along = on_it @ np.array([-line[1], line[0]])
    return float(along.min()), float(along.max())


def _free_side(line: Line, on_it: FloatArray, free: FloatArray, resolution: float) -> float:
    """1 where only the side that a wall's normal points to is free, -1 where only the other is, 0 where both are."""
    normal = np.array(line[:2])
    along = np.array([-normal[1], normal[0]])
    off, at, ends = free @ normal - line[2], free @ along, on_it @ along
    beside = (at > ends.min()) & (at < ends.max()) & (np.abs(off) < 2 * WALL_CELLS * resolution)
    above, below = np.count_nonzero(beside & (off > 0)), np.count_nonzero(beside & (off < 0))
    if below < ONE_SIDED * above:
        return 1.0
    return -1.0 if above < ONE_SIDED * below else 0.0


def is_within(primitive: Primitive, points: NDArray[np.floating], margin: float) -> NDArray[np.bool_]:
    """Which points (..., 2) lie in a primitive or no more than ``margin`` (m) outside of it (corners cut square)."""
    cos, sin = math.cos(primitive.theta or 0.0), math.sin(primitive.theta or 0.0)
    local = (points - (primitive.x, primitive.y)) @ np.array([[cos, -sin], [sin, cos]])
    if primitive.is_round:
        semi = np.array(primitive.width_height) + margin
        return np.asarray(((local / semi) ** 2).sum(axis=-1) < 1)
    corners = primitive.local_outline()
    along = np.roll(corners, -1, axis=0) - corners
    normals = np.column_stack((along[:, 1], -along[:, 0])) / np.hypot(*along.T)[:, None]
    reaches = (normals * corners).sum(axis=1) + margin
    return np.asarray((local @ normals.T < reaches).all(axis=-1))
