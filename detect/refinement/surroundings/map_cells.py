"""A map's cells as refinement needs them: which may belong to primitives, and which to walls."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import shapely
from numpy.typing import NDArray

from detect.refinement.options import DEFAULTS, LineOptions, MapOptions
from detect.refinement.surroundings.lines import Line, distance_to_line, find_lines, trimmed_line
from mapping.grid import GridFrame, OccupancyGrid
from mapping.morphology import beside_free, connected_components, dilate
from prim.arrays import BoolGrid, FloatArray
from prim.shapes import Primitive

OUTLINE_POINTS = 32
"""Vertices of a curved outline that is held against walls."""


@dataclass(frozen=True)
class OneSidedWall:
    """A wall with free space on one side only.

    Attributes:
        line: Its line; the normal points to the free side.
        first: Where it begins along the line (m).
        last: Where it ends.
        depth: How far (m) it reaches to the other side.
    """

    line: Line
    first: float
    last: float
    depth: float

    def contains(self, points: FloatArray, width: float, extension: float) -> NDArray[np.bool_]:
        """Tell which points are the wall's: at its line, or behind it as far as it reaches.

        Args:
            points: (..., 2) in metres, map frame.
            width: How near (m) to its line, on the free side.
            extension: How far (m) it goes on beyond its ends.

        Returns:
            (...) bool.
        """
        nx, ny, d = self.line
        along = points @ np.array([-ny, nx])
        off = points @ np.array([nx, ny]) - d
        beside = (along > self.first - extension) & (along < self.last + extension)
        return np.asarray((off < width) & (off > -max(width, self.depth)) & beside)

    def is_beside(self, points: FloatArray, depth: float) -> bool:
        """Tell whether all points lie on one side of the wall's line.

        Args:
            points: (N, 2) in metres, map frame.
            depth: How far (m) some may lie on the other side.

        Returns:
            Whether they do.
        """
        off = points @ np.array(self.line[:2]) - self.line[2]
        return bool(off.min() > -depth or off.max() < depth)

    def hides(self, points: FloatArray, penetration: float, extension: float) -> bool:
        """Tell whether some points lie behind the wall.

        Args:
            points: (N, 2) in metres, map frame.
            penetration: How far (m) behind its line they must lie.
            extension: How far (m) it would go on beyond its ends.

        Returns:
            Whether any does.
        """
        nx, ny, d = self.line
        along, behind = points @ np.array([-ny, nx]), d - points @ np.array([nx, ny])
        beside = (along > self.first - extension) & (along < self.last + extension)
        return bool((beside & (behind > penetration) & (behind < self.depth)).any())


@dataclass(frozen=True)
class MapCells:
    """A map's cells, all (rows, cols).

    Attributes:
        frame: Where they lie.
        occupied: Occupied cells.
        free: Free cells.
        labels: The occupied cells' connected components, from 1 on; 0 elsewhere.
        large: Occupied cells of walls and of components larger than any primitive.
        walls: The walls with free space on one side only.
        thin_walls: Those with free space on both sides; either is the normal's.
        options: Numeric parameters.
    """

    frame: GridFrame
    occupied: NDArray[np.bool_]
    free: NDArray[np.bool_]
    labels: NDArray[np.int32]
    large: NDArray[np.bool_]
    walls: tuple[OneSidedWall, ...] = ()
    thin_walls: tuple[OneSidedWall, ...] = ()
    options: MapOptions = DEFAULTS.map

    @classmethod
    def of(
        cls, grid: OccupancyGrid, options: MapOptions = DEFAULTS.map, lines: LineOptions = DEFAULTS.lines
    ) -> MapCells:
        """Classify a map's cells.

        Straight walls are taken out before components are labelled: what touches one may be a primitive that stands
        close to it.

        Args:
            grid: The map.
            options: Which cells are walls.
            lines: How walls' lines are found.

        Returns:
            The cells.
        """
        walls, one_sided, thin = _straight_walls(grid, options, lines)
        labels, large = connected_components(grid.occupied & ~walls, grid.frame, options.max_extent)
        return cls(
            grid.frame, grid.occupied, grid.free, labels, walls | large, tuple(one_sided), tuple(thin), options
        )

    @cached_property
    def wall_surface(self) -> FloatArray:
        """The centres (N, 2) in metres of large things' cells that are next to free ones."""
        return self.frame.centres(self.large & beside_free(self.free))

    def large_within(self, primitive: Primitive, margin: float) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
        """Find large things' cells in a primitive or near it.

        Args:
            primitive: The primitive.
            margin: How near (m).

        Returns:
            Their rows and columns.
        """
        rows, cols, points = _cells_around(self.frame, primitive, primitive.bounding_radius + margin)
        at_rows, at_cols = np.nonzero(self.large[rows, cols] & is_within(primitive, points, margin))
        return at_rows + rows.start, at_cols + cols.start

    def around(self, primitive: Primitive, reach: float) -> tuple[slice, slice, FloatArray]:
        """Find the cells around a primitive.

        Args:
            primitive: The primitive.
            reach: How far from its centroid (m) along both axes.

        Returns:
            Rows, columns, and the cells' centres (rows, cols, 2) in m.
        """
        return _cells_around(self.frame, primitive, reach)

    def is_hollow(self, outline: FloatArray) -> bool:
        """Tell whether most of what lies within an outline (N, 2) in m is free: a room is, or a part of one."""
        low, high = outline.min(axis=0), outline.max(axis=0)
        rows, cols, points = _cells_within(self.frame, low, high)
        inside = shapely.contains_xy(shapely.Polygon(outline), points[..., 0], points[..., 1])
        return bool(inside.any() and self.free[rows, cols][inside].mean() > self.options.max_hollow)

    def is_behind_wall(self, primitive: Primitive) -> bool:
        """Tell whether a primitive reaches behind a wall that is free on one side only."""
        outline, penetration = primitive.outline(OUTLINE_POINTS), self.options.penetration
        return any(wall.hides(outline, penetration, 0.0) for wall in self.walls)

    def hides_centroid(self, primitive: Primitive) -> bool:
        """Tell whether a primitive's centroid lies behind such a wall, or behind where it would go on."""
        centroid = np.array([[primitive.x, primitive.y]])
        return any(wall.hides(centroid, 0.0, self.options.wall_depth) for wall in self.walls)

    def is_behind_extended_wall(self, primitive: Primitive) -> bool:
        """Tell whether a primitive reaches behind such a wall, or behind where it would go on."""
        outline, options = primitive.outline(OUTLINE_POINTS), self.options
        return any(wall.hides(outline, options.penetration, options.wall_depth) for wall in self.walls)

    def without(
        self, primitives: Sequence[Primitive], margin: float, touching: float | None = None, blur: float | None = None
    ) -> NDArray[np.bool_]:
        """Return the occupied cells (rows, cols) but for those of primitives.

        Noise blurs a primitive into cells around it: those that are connected with its own, and belong to nothing
        larger, are its own too.

        Args:
            primitives: The primitives.
            margin: Cells this near (m) are a primitive's; of walls' cells, those that all but touch it.
            touching: How near (m) these are; None: as in the options.
            blur: How far (m) connected cells are a primitive's; None: as in the options.

        Returns:
            (rows, cols) bool.
        """
        occupied = self.occupied.copy()
        touch = min(margin, self.options.touching if touching is None else touching)
        blur = self.options.blur if blur is None else blur
        for primitive in primitives:
            rows, cols, points = _cells_around(self.frame, primitive, primitive.bounding_radius + margin)
            near, touches = (is_within(primitive, points, reach) for reach in (margin, touch))
            occupied[rows, cols] &= ~np.where(self.large[rows, cols], touches, near)
            self._remove_connected(occupied, primitive, margin, blur)
        return occupied

    def _remove_connected(self, occupied: BoolGrid, primitive: Primitive, margin: float, blur: float) -> None:
        """Remove the cells from ``occupied`` that are connected with a primitive's, and no further than its blur."""
        reach = primitive.bounding_radius + blur
        rows, cols, points = _cells_around(self.frame, primitive, reach)
        labels, small = self.labels[rows, cols], ~self.large[rows, cols]
        own = np.unique(labels[is_within(primitive, points, margin) & small & (labels > 0)])
        occupied[rows, cols] &= ~(np.isin(labels, own) & small & is_within(primitive, points, blur))


def _cells_around(frame: GridFrame, primitive: Primitive, reach: float) -> tuple[slice, slice, FloatArray]:
    """Return the rows and columns of a grid around a primitive, and their cells' centres (rows, cols, 2)."""
    centroid = np.array([primitive.x, primitive.y])
    return _cells_within(frame, centroid - reach, centroid + reach)


def _cells_within(frame: GridFrame, lower: FloatArray, upper: FloatArray) -> tuple[slice, slice, FloatArray]:
    """Return a grid's rows and columns between two corners (2,) in m, and their cells' centres (rows, cols, 2)."""

    def span(axis: int, first: int, count: int) -> tuple[int, int]:
        low = math.floor(lower[axis] / frame.resolution) - first
        high = math.ceil(upper[axis] / frame.resolution) - first
        return min(max(low, 0), count), min(max(high, 0), count)

    row, last_row = span(1, frame.row, frame.rows)
    col, last_col = span(0, frame.col, frame.cols)
    x = (np.arange(col, last_col) + frame.col + 0.5) * frame.resolution
    y = (np.arange(row, last_row) + frame.row + 0.5) * frame.resolution
    return slice(row, last_row), slice(col, last_col), np.stack(np.meshgrid(x, y), axis=-1)


def _straight_walls(
    grid: OccupancyGrid, options: MapOptions, lines: LineOptions
) -> tuple[BoolGrid, list[OneSidedWall], list[OneSidedWall]]:
    """Return which occupied cells belong to straight walls, those that are free on one side only, and the rest."""
    resolution = grid.frame.resolution
    surface = grid.frame.centres(grid.occupied & beside_free(grid.free))
    rows, cols = np.nonzero(grid.occupied)
    points = grid.frame.centres(grid.occupied)
    free = grid.frame.centres(grid.free & dilate(grid.occupied, round(2 * options.wall_cells)))
    near = np.zeros(len(points), np.bool_)
    one_sided, thin_walls = [], []
    thin = options.wall_cells * resolution
    for line, on_it in _wall_lines(surface, resolution, options, lines):
        nx, ny, d = line
        off, along = points @ np.array([nx, ny]) - d, points @ np.array([-ny, nx])
        side = _free_side(line, on_it, free, resolution, options)
        ends = _ends(on_it, line)
        deep = _depth_behind(line, side, ends, free, resolution, options)
        for first, last in _spans(line, ends, free, points, resolution, options):
            beside = (along > first - thin) & (along < last + thin)
            near |= beside & (off > (-deep if side > 0 else -thin)) & (off < (deep if side < 0 else thin))
            if side:
                span = sorted((side * first, side * last))
                one_sided.append(OneSidedWall((side * nx, side * ny, side * d), span[0], span[1], deep))
            else:
                thin_walls.append(OneSidedWall(line, first, last, thin))
    walls = np.zeros_like(grid.occupied)
    walls[rows[near], cols[near]] = True
    return walls, one_sided, thin_walls


def _spans(
    line: Line,
    ends: tuple[float, float],
    free: FloatArray,
    occupied: FloatArray,
    resolution: float,
    options: MapOptions,
) -> list[tuple[float, float]]:
    """Return from where to where (m) a wall stands along its line: where only free cells are, there is a doorway.

    What stands in a doorway is no wall: spans that are shorter than a wall are left out.
    """
    count = max(math.ceil((ends[1] - ends[0]) / resolution), 1)

    def has(points: FloatArray) -> NDArray[np.bool_]:
        """Return which bins along the line have one of some cells' centres near it."""
        near = distance_to_line(points, line) < options.wall_width * resolution
        bins = np.floor((points[near] @ np.array([-line[1], line[0]]) - ends[0]) / resolution).astype(int)
        marked = np.zeros(count, np.bool_)
        marked[bins[(bins >= 0) & (bins < count)]] = True
        return marked

    spans, begin = [], 0
    for first, last in _runs(has(free) & ~has(occupied)):
        if (last - first) * resolution >= options.min_opening:
            spans.append((begin, first))
            begin = last
    spans.append((begin, count))
    whole = len(spans) == 1
    return [
        (ends[0] + first * resolution, ends[0] + last * resolution)
        for first, last in spans
        if whole or (last - first) * resolution >= options.min_span
    ]


def _runs(marked: NDArray[np.bool_]) -> Iterator[tuple[int, int]]:
    """Yield the runs of marked bins (N,): the first, and one past the last."""
    steps = np.diff(marked.astype(np.int8), prepend=0, append=0)
    yield from zip(np.flatnonzero(steps > 0).tolist(), np.flatnonzero(steps < 0).tolist(), strict=True)


def _wall_lines(
    surface: FloatArray, resolution: float, options: MapOptions, lines: LineOptions
) -> Iterator[tuple[Line, FloatArray]]:
    """Yield the lines of straight walls, each with the surface cells' centres (N, 2) on it."""
    width = options.wall_width
    for wide in find_lines(surface, resolution, options.min_wall, options.max_walls, width, lines):
        line = trimmed_line(surface[distance_to_line(surface, wide) < width * resolution], resolution, lines)
        off = distance_to_line(surface, line) / resolution
        on_it = surface[off < width]
        first, last = _ends(on_it, line)
        dense, sharp = (_covered(surface[off < near], line, resolution) for near in (width, options.sharp_width))
        filled = max(dense / options.wall_density, sharp / options.sharp_density)
        if dense >= options.min_wall and filled >= last - first:
            yield line, on_it


def _covered(on_it: FloatArray, line: Line, resolution: float) -> float:
    """Return the length (m) of a line that has cells on it."""
    return len(np.unique(np.floor(on_it @ np.array([-line[1], line[0]]) / resolution))) * resolution


def _ends(on_it: FloatArray, line: Line) -> tuple[float, float]:
    """Return where along a line (m) the first and the last of some points lie."""
    along = on_it @ np.array([-line[1], line[0]])
    return float(along.min()), float(along.max())


def _free_side(line: Line, on_it: FloatArray, free: FloatArray, resolution: float, options: MapOptions) -> float:
    """Return 1 where only the side of a wall's normal is free, -1 where only the other is, 0 where both are."""
    normal = np.array(line[:2])
    along = np.array([-normal[1], normal[0]])
    off, at, ends = free @ normal - line[2], free @ along, on_it @ along
    width = 2 * options.wall_cells * resolution
    beside = (at > ends.min()) & (at < ends.max()) & (np.abs(off) < width)
    above, below = np.count_nonzero(beside & (off > 0)), np.count_nonzero(beside & (off < 0))
    if below < options.one_sided * above:
        return 1.0
    return -1.0 if above < options.one_sided * below else 0.0


def _depth_behind(
    line: Line, side: float, ends: tuple[float, float], free: FloatArray, resolution: float, options: MapOptions
) -> float:
    """Return how far (m) a wall reaches to the side that is not free: a thick wall ends where the map is free again.

    Where its line goes on through a doorway, what is free there says nothing.
    """
    normal = np.array(line[:2])
    behind, at = -side * (free @ normal - line[2]), free @ np.array([-normal[1], normal[0]])
    beside = (behind > 0) & (behind < options.wall_depth) & (at > ends[0]) & (at < ends[1])
    bins, number = np.unique(np.floor(at[beside] / resolution), return_inverse=True)
    nearest = np.full(len(bins), math.inf)
    np.minimum.at(nearest, number, behind[beside])
    nearest = nearest[nearest > options.wall_cells * resolution]
    if len(nearest) < options.one_sided * (ends[1] - ends[0]) / resolution:
        return options.wall_depth
    return max(float(np.median(nearest)) - resolution, options.wall_cells * resolution)


def is_within(primitive: Primitive, points: NDArray[np.floating], margin: float) -> NDArray[np.bool_]:
    """Tell which points lie in a primitive or near it.

    Args:
        primitive: The primitive.
        points: (..., 2) in metres, map frame.
        margin: How far outside (m); edges are moved outwards, so that corners reach further.

    Returns:
        (...) bool.
    """
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
