"""Straight walls in a map, told from its cells: what stands behind primitives that stand close to one.

Where a primitive stands close to a wall, few rays come between them, and the map cannot tell them apart. The wall
goes on straight, though, as it comes out on both sides.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from detect.refinement.lines import Line, find_lines, middle_line, off_line
from detect.refinement.map_cells import MapCells, is_within
from prim.arrays import FloatArray
from prim.shapes import Kind, Primitive

CLOSE = 0.12
"""A wall is looked for behind candidates that come this near (m) to it."""

AROUND = 0.5
"""Its cells are looked for this far (m) around a candidate."""

LEAST_LENGTH = 0.12
"""So much (m) of a wall must be seen at both sides."""

OWN = 0.04
"""Cells this near (m) to a candidate say nothing of a wall's line."""

BENT = 2.0
"""Its cells lie this near (cells) to its line, along which noise has bent it."""

WALL_CELLS = 3.5
"""Cells this near (cells) to the stretch stand for it."""

DEPTH = 0.02
"""How far (m) a primitive may reach into a wall: the wall's line is no surer."""

THICKNESS = 0.002


@dataclass(frozen=True)
class Wall:
    """A stretch of a wall ``behind`` a candidate (where that was first taken to stand), the line it lies on (its
    normal points to the candidate's side), and the map's cells that stand for it there (their rows and columns).
    """

    behind: Primitive
    stretch: Primitive
    line: Line
    cells: tuple[NDArray[np.intp], NDArray[np.intp]]

    def is_cut_by(self, primitive: Primitive) -> bool:
        """Whether a primitive reaches behind the stretch by more than DEPTH: nothing does."""
        nx, ny, d = self.line
        outline = primitive.outline(32)
        along = (outline - (self.stretch.x, self.stretch.y)) @ np.array([-ny, nx])
        behind = d - outline @ np.array([nx, ny])
        return bool((behind[np.abs(along) < self.stretch.size[0] / 2] > DEPTH).any())


def walls_behind(cells: MapCells, candidates: Sequence[Primitive], starts: Sequence[Primitive]) -> list[Wall]:
    """The walls that candidates stand close to, and that come out straight on both sides of each.

    A wall is seen from the side on which a candidate was first taken to stand: ``starts``.
    """
    points, resolution = cells.wall_surface, cells.frame.resolution
    if not len(points):
        return []
    places = np.array([(one.x, one.y) for one in candidates])
    made = []
    for one, start in zip(candidates, starts, strict=True):
        reach = one.circumradius + AROUND
        near = points[_around(one, points, reach)]
        if not is_within(one, near[_around(one, near, one.circumradius + CLOSE)], CLOSE).any():
            continue
        for other in np.flatnonzero(_around(one, places, 2 * reach)).tolist():
            near = near[~is_within(candidates[other], near, OWN)]
        for rough in find_lines(near, resolution, 2 * LEAST_LENGTH, 2, BENT):
            nx, ny, d = middle_line(near[off_line(near, rough) < BENT * resolution], resolution)
            side = 1.0 if nx * start.x + ny * start.y > d else -1.0
            wall = _stretch(cells, one, start, (side * nx, side * ny, side * d), near)
            if wall is not None:
                made.append(wall)
    return made


def _around(one: Primitive, points: FloatArray, reach: float) -> NDArray[np.bool_]:
    """Which points (N, 2) are no further than ``reach`` (m) from a primitive's middle, along either axis."""
    return np.asarray((np.abs(points - (one.x, one.y)) <= reach).all(axis=1))


def _stretch(cells: MapCells, candidate: Primitive, start: Primitive, line: Line, points: FloatArray) -> Wall | None:
    """The stretch of a line behind a candidate; None where the candidate is not close to it."""
    nx, ny, d = line
    gap = float((candidate.outline(32) @ np.array([nx, ny]) - d).min())
    if gap > CLOSE:
        return None
    resolution = cells.frame.resolution
    on_line = points[off_line(points, line) < (BENT + 0.5) * resolution]
    along = on_line @ np.array([-ny, nx])
    middle = -ny * candidate.x + nx * candidate.y
    reach = candidate.circumradius
    left, right = along[along < middle - 0.5 * reach], along[along > middle + 0.5 * reach]
    if min(len(np.unique(np.rint(part / resolution))) for part in (left, right)) * resolution < LEAST_LENGTH:
        return None
    low, high = max(float(left.min()), middle - reach - 0.15), min(float(right.max()), middle + reach + 0.15)
    at = (low + high) / 2
    theta = math.atan2(nx, -ny)
    stretch = Primitive(
        Kind.RECTANGLE, nx * d - ny * at, ny * d + nx * at, theta, (high - low, THICKNESS)
    ).canonical()
    return Wall(start, stretch, line, cells.large_within(stretch, WALL_CELLS * resolution))
