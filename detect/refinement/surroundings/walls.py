"""Straight walls close behind candidates.

Where a primitive stands close to a wall, few rays pass between them, and the map cannot separate them. The wall is
straight, though, as it shows on both sides of the primitive: the stretch between is known.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from detect.refinement.options import DEFAULTS, LineOptions, WallOptions
from detect.refinement.surroundings.lines import Line, distance_to_line, find_lines, trimmed_line
from detect.refinement.surroundings.map_cells import OUTLINE_POINTS, MapCells, is_within
from prim.arrays import FloatArray
from prim.shapes import Kind, Primitive


@dataclass(frozen=True)
class Wall:
    """A stretch of a wall behind a candidate.

    Attributes:
        behind: The candidate's guess.
        stretch: A thin rectangle that stands for the wall there.
        line: Its line; the normal points to the candidate's side.
        cells: Rows and columns of the map's cells that belong to it.
    """

    behind: Primitive
    stretch: Primitive
    line: Line
    cells: tuple[NDArray[np.intp], NDArray[np.intp]]

    def is_cut_by(self, primitive: Primitive, depth: float = DEFAULTS.walls.depth) -> bool:
        """Tell whether a primitive reaches behind the stretch.

        Args:
            primitive: The primitive.
            depth: By how much (m) more than the line is uncertain.

        Returns:
            Whether it does.
        """
        nx, ny, d = self.line
        outline = primitive.outline(OUTLINE_POINTS)
        along = (outline - (self.stretch.x, self.stretch.y)) @ np.array([-ny, nx])
        behind = d - outline @ np.array([nx, ny])
        return bool((behind[np.abs(along) < self.stretch.size[0] / 2] > depth).any())


def walls_behind(
    cells: MapCells,
    candidates: Sequence[Primitive],
    guesses: Sequence[Primitive],
    beside: Sequence[Primitive] = (),
    options: WallOptions = DEFAULTS.walls,
    lines: LineOptions = DEFAULTS.lines,
) -> list[Wall]:
    """Find the walls that candidates stand close to, and that show straight on both sides of them.

    Args:
        cells: The map.
        candidates: The candidates as they are known now.
        guesses: What they were taken for first: a wall is seen from the side on which that stands.
        beside: Further candidates, whose cells are no walls'.
        options: What a wall is.
        lines: How their lines are found.

    Returns:
        The walls.
    """
    points, resolution = cells.wall_surface, cells.frame.resolution
    if not len(points):
        return []
    present = [*candidates, *beside]
    centroids = np.array([(candidate.x, candidate.y) for candidate in present])
    made = []
    for candidate, guess in zip(candidates, guesses, strict=True):
        reach = candidate.bounding_radius + options.around
        near = points[_in_square(candidate, points, reach)]
        close = near[_in_square(candidate, near, candidate.bounding_radius + options.near)]
        if not is_within(candidate, close, options.near).any():
            continue
        for other in np.flatnonzero(_in_square(candidate, centroids, 2 * reach)).tolist():
            near = near[~is_within(present[other], near, options.own)]
        for rough in find_lines(near, resolution, 2 * options.min_length, 2, options.width, lines):
            inliers = near[distance_to_line(near, rough) < options.width * resolution]
            nx, ny, d = trimmed_line(inliers, resolution, lines)
            side = 1.0 if nx * guess.x + ny * guess.y > d else -1.0
            wall = _stretch(cells, candidate, guess, (side * nx, side * ny, side * d), near, options)
            if wall is not None:
                made.append(wall)
    return made


def _stretch_between(line: Line, low: float, high: float, options: WallOptions) -> Primitive:
    """Return the thin rectangle that stands for a line between two places along it (m)."""
    nx, ny, d = line
    at = (low + high) / 2
    x, y, theta = nx * d - ny * at, ny * d + nx * at, math.atan2(nx, -ny)
    return Primitive(Kind.RECTANGLE, x, y, theta, (high - low, options.thickness)).canonical()


def _in_square(candidate: Primitive, points: FloatArray, reach: float) -> NDArray[np.bool_]:
    """Tell which points (N, 2) are within ``reach`` (m) of a primitive's centroid along both axes."""
    return np.asarray((np.abs(points - (candidate.x, candidate.y)) <= reach).all(axis=1))


def _stretch(
    cells: MapCells, candidate: Primitive, guess: Primitive, line: Line, points: FloatArray, options: WallOptions
) -> Wall | None:
    """Return the stretch of a line behind a candidate; None where it is not close, or not seen on both sides."""
    nx, ny, d = line
    gap = float((candidate.outline(OUTLINE_POINTS) @ np.array([nx, ny]) - d).min())
    if gap > options.near:
        return None
    resolution = cells.frame.resolution
    on_line = points[distance_to_line(points, line) < (options.width + 0.5) * resolution]
    along = on_line @ np.array([-ny, nx])
    middle = -ny * candidate.x + nx * candidate.y
    reach, beyond = candidate.bounding_radius, options.beyond
    left, right = along[along < middle - 0.5 * reach], along[along > middle + 0.5 * reach]
    lengths = (len(np.unique(np.rint(part / resolution))) for part in (left, right))
    if min(lengths) * resolution < options.min_length:
        return None
    low, high = max(float(left.min()), middle - reach - beyond), min(float(right.max()), middle + reach + beyond)
    stretch = _stretch_between(line, low, high, options)
    return Wall(guess, stretch, line, cells.large_within(stretch, options.cells * resolution))
