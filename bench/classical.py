"""A baseline detector: primitives fitted to the contours of a map by OpenCV.

The occupied cells are closed by a 3 x 3 kernel, and the outer contour of each connected component is approximated by
a polygon (Douglas and Peucker). Three vertices give a triangle, four the rectangle of minimum area around the
contour, more an ellipse fitted to it. Components larger than any primitive are walls.
"""

from __future__ import annotations

import math
from itertools import pairwise

import cv2
import numpy as np
from numpy.typing import NDArray

from mapping.grid import OccupancyGrid
from prim.shapes import Kind, Primitive

MIN_EXTENT, MAX_EXTENT = 4, 66
"""Bounds (cells) of the larger side of a primitive's axis-aligned bounding box."""

MIN_POINTS = 8
"""Contours with fewer points are left out."""

EQUAL_RATIO = 0.9
"""From this ratio of the sides (axes) on, a rectangle (ellipse) counts as a square (circle)."""

EPSILON = 0.04
"""Largest distance of the polygon from the contour, as a share of the contour's length."""


def detect(grid: OccupancyGrid) -> list[Primitive]:
    """Detect the primitives in a map."""
    occupied = (grid.probability > 0.5).astype(np.uint8)
    closed = cv2.morphologyEx(occupied, cv2.MORPH_CLOSE, np.ones((3, 3), np.uint8))
    contours, hierarchy = cv2.findContours(closed, cv2.RETR_CCOMP, cv2.CHAIN_APPROX_NONE)
    primitives = []
    for k, contour in enumerate(contours):
        _, _, width, height = cv2.boundingRect(contour)
        outer = hierarchy[0][k][3] < 0
        if outer and MIN_EXTENT <= max(width, height) <= MAX_EXTENT and len(contour) >= MIN_POINTS:
            points = contour[:, 0, :].astype(np.float64) + 0.5
            primitives.append(_primitive(points, contour, grid))
    return [primitive for primitive in primitives if primitive is not None]


def _primitive(points: NDArray[np.float64], contour: NDArray[np.int32], grid: OccupancyGrid) -> Primitive | None:
    """Fit a primitive to a contour (N, 1, 2), whose points (N, 2) are the cells' centres; None where none fits."""
    frame = grid.frame
    corners = cv2.approxPolyDP(contour, EPSILON * cv2.arcLength(contour, True), True)[:, 0, :].astype(np.float64)
    if len(corners) == 3:
        return _triangle((corners + np.array((frame.col, frame.row)) + 0.5) * frame.resolution)
    if len(corners) == 4:
        (x, y), (a, b), angle = cv2.minAreaRect(points.astype(np.float32))
        kind, general, half = Kind.SQUARE, Kind.RECTANGLE, 1.0
    else:
        (x, y), (a, b), angle = cv2.fitEllipse(points.astype(np.float32))
        kind, general, half = Kind.CIRCLE, Kind.ELLIPSE, 0.5
    if not (math.isfinite(a) and math.isfinite(b)) or min(a, b) < 1:
        return None
    if b > a:
        a, b, angle = b, a, angle + 90
    scale = half * frame.resolution
    size = (scale * (a + b) / 2,) if b >= EQUAL_RATIO * a else (scale * a, scale * b)
    fitted = kind if len(size) == 1 else general
    theta = None if fitted is Kind.CIRCLE else math.radians(angle)
    position = (x + frame.col) * frame.resolution, (y + frame.row) * frame.resolution
    return Primitive(fitted, *position, theta, size).canonical()


def _triangle(corners: NDArray[np.float64]) -> Primitive | None:
    """Return the isosceles triangle with the apex between the two most equal sides; None where it is degenerate."""
    ring = [*corners, *corners]
    sides = [float(np.linalg.norm(b - a)) for a, b in pairwise(ring[:4])]  # 01, 12, 20
    difference = [abs(sides[k - 1] - sides[k]) for k in range(3)]  # of the two sides that meet in corner k
    k = int(np.argmin(difference))
    apex, left, right = ring[k], ring[k + 1], ring[k + 2]
    middle = (left + right) / 2
    base, height = float(np.linalg.norm(right - left)), float(np.linalg.norm(apex - middle))
    if base < 0.01 or height < 0.01:
        return None
    x, y = middle + (apex - middle) / 3
    dx, dy = apex - middle
    return Primitive(Kind.TRIANGLE, float(x), float(y), math.atan2(dy, dx) - math.pi / 2, (base, height)).canonical()
