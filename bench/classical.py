"""What a user would write without us: primitives from a map's contours by OpenCV. A peer to compare with.

Occupied cells, closed by a 3 x 3 kernel; each component's outer contour; three corners of its approximated polygon
make a triangle, four its rectangle of least area, more an ellipse fitted to it. What is larger than any primitive is
a wall. Needs OpenCV, which comes with the extra [train].
"""

from __future__ import annotations

import math
from itertools import pairwise

import cv2
import numpy as np
from numpy.typing import NDArray

from mapping.grid import OccupancyGrid
from prim.shapes import Kind, Primitive

LEAST, MOST = 4, 66
"""Between these (cells) lie a primitive's width and height."""

ALIKE = 0.9
"""Sides of this ratio and more are a square's, axes a circle's."""

EPSILON = 0.04
"""How far (share of the contour's length) the polygon may lie from it."""


def detect(grid: OccupancyGrid) -> list[Primitive]:
    """The primitives in a map."""
    occupied = (grid.probability > 0.5).astype(np.uint8)
    closed = cv2.morphologyEx(occupied, cv2.MORPH_CLOSE, np.ones((3, 3), np.uint8))
    contours, hierarchy = cv2.findContours(closed, cv2.RETR_CCOMP, cv2.CHAIN_APPROX_NONE)
    found = []
    for k, contour in enumerate(contours):
        _, _, width, height = cv2.boundingRect(contour)
        outer = hierarchy[0][k][3] < 0
        if outer and LEAST <= max(width, height) <= MOST and len(contour) >= 8:
            points = contour[:, 0, :].astype(np.float64) + 0.5
            found.append(_primitive(points, contour, grid))
    return [one for one in found if one is not None]


def _primitive(points: NDArray[np.float64], contour: NDArray[np.int32], grid: OccupancyGrid) -> Primitive | None:
    frame = grid.frame
    corners = cv2.approxPolyDP(contour, EPSILON * cv2.arcLength(contour, True), True)[:, 0, :].astype(np.float64)
    if len(corners) == 3:
        return _triangle((corners + np.array((frame.col, frame.row)) + 0.5) * frame.resolution)
    if len(corners) == 4:
        (x, y), (a, b), turn = cv2.minAreaRect(points.astype(np.float32))
        kind, other, half = Kind.SQUARE, Kind.RECTANGLE, 1.0
    else:
        (x, y), (a, b), turn = cv2.fitEllipse(points.astype(np.float32))
        kind, other, half = Kind.CIRCLE, Kind.ELLIPSE, 0.5
    if not (math.isfinite(a) and math.isfinite(b)) or min(a, b) < 1:
        return None
    if b > a:
        a, b, turn = b, a, turn + 90
    scale = half * frame.resolution
    size = (scale * (a + b) / 2,) if b >= ALIKE * a else (scale * a, scale * b)
    made = kind if len(size) == 1 else other
    theta = None if made is Kind.CIRCLE else math.radians(turn)
    place = (x + frame.col) * frame.resolution, (y + frame.row) * frame.resolution
    return Primitive(made, *place, theta, size).canonical()


def _triangle(corners: NDArray[np.float64]) -> Primitive | None:
    """The isosceles triangle whose apex is where the two sides are most alike."""
    ring = [*corners, *corners]
    sides = [float(np.linalg.norm(b - a)) for a, b in pairwise(ring[:4])]  # 01, 12, 20
    unlike = [abs(sides[k - 1] - sides[k]) for k in range(3)]  # the two sides that meet in corner k
    k = int(np.argmin(unlike))
    apex, left, right = ring[k], ring[k + 1], ring[k + 2]
    middle = (left + right) / 2
    base, height = float(np.linalg.norm(right - left)), float(np.linalg.norm(apex - middle))
    if base < 0.01 or height < 0.01:
        return None
    x, y = middle + (apex - middle) / 3
    dx, dy = apex - middle
    return Primitive(Kind.TRIANGLE, float(x), float(y), math.atan2(dy, dx) - math.pi / 2, (base, height)).canonical()
