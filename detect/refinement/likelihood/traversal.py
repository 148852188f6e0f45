"""The compiled kernel that follows rays through a map's cells to the occupied ones.

Compiled code is cached beside this file and made anew when this file changes, so that nothing that stands elsewhere
may be compiled in.
"""

from __future__ import annotations

import math
from typing import Any

from prim.compiled import compiled

kernel = compiled(inline="never", fastmath={"arcp", "contract", "reassoc", "nsz"})

ORIGIN_X, ORIGIN_Y, DIRECTION_X, DIRECTION_Y = range(4)
"""Rows of rays (7, N), as in detect.refinement.likelihood.kernels."""

FAR = 1e30


@kernel
def cast_through_map(distances: Any, grid: Any, rays: Any, max_ranges: Any, ranges: Any, ends: Any) -> None:
    """Find where rays end in a map: in the first occupied cell, or where they leave it.

    Over free space as many cells are taken at once as the distance to the nearest occupied one allows.

    Args:
        distances: (rows, cols) the chessboard distance (cells) of each cell to the nearest occupied one, or to beyond
            the map; no longer than that.
        grid: row and column of the plane's cell at which the map begins, and 1 / resolution (1 / m).
        rays: (7, N).
        max_ranges: (N,) of the sensors (m).
        ranges: (N,) gets the ranges (m): to the middle of a ray's way through the occupied cell, or to where it
            leaves the map, and at most the sensor's.
        ends: (N,) gets whether the ray ends in an occupied cell.
    """
    row, col, inverse_resolution = grid
    rows, cols = distances.shape
    for i in range(len(ranges)):
        x, y = rays[ORIGIN_X, i] * inverse_resolution - col, rays[ORIGIN_Y, i] * inverse_resolution - row
        dx, dy = rays[DIRECTION_X, i], rays[DIRECTION_Y, i]
        far = max_ranges[i] * inverse_resolution
        c, r = math.floor(x), math.floor(y)
        step_c, step_r = (1 if dx > 0 else -1), (1 if dy > 0 else -1)
        first_c, first_r = (1 if dx > 0 else 0), (1 if dy > 0 else 0)
        per_c = 1.0 / dx if dx != 0.0 else FAR
        per_r = 1.0 / dy if dy != 0.0 else FAR
        per_cell = min(abs(per_c), abs(per_r))
        at, ends[i] = 0.0, False
        while at < far:
            next_c = (c + first_c - x) * per_c if dx != 0.0 else FAR
            next_r = (r + first_r - y) * per_r if dy != 0.0 else FAR
            if 0 <= c < cols and 0 <= r < rows:
                free = distances[r, c]
                if free == 0:
                    at, ends[i] = 0.5 * (at + min(next_c, next_r)), True
                    break
                if free > 2:
                    at += (free - 1) * per_cell
                    c, r = math.floor(x + at * dx), math.floor(y + at * dy)
                    continue
            elif (c < 0 and dx <= 0) or (c >= cols and dx >= 0) or (r < 0 and dy <= 0) or (r >= rows and dy >= 0):
                break
            at = min(next_c, next_r)
            if next_c <= next_r:
                c += step_c
            else:
                r += step_r
        ranges[i] = min(at, far) / inverse_resolution
