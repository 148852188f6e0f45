"""What the viewer draws, as arrays: rings, uncertainty, maps as bytes, crops on a sheet."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mapping.grid import OccupancyGrid
from prim import linear_algebra
from prim.arrays import FloatArray
from prim.se2 import Pose2D
from prim.shapes import Primitive

if TYPE_CHECKING:
    from detect.detection import Detection

CHI_SQUARED_95 = 5.991
"""95 % quantile of the chi-squared distribution with two degrees of freedom."""

RING_POINTS = 64
"""Points of an outline."""

ELLIPSE_POINTS = 33
"""Points of a confidence ellipse, the first one again at the end."""

MIN_SIZE = 1e-3
"""Outlines are not drawn smaller than this (m)."""

CROPS_PER_ROW = 6
CROP_BORDER, BORDER_VALUE = 2, 215
"""Pixels between crops, and their grey value."""

UNKNOWN_VALUE = 255
"""Value of an unknown cell in a nav_msgs/OccupancyGrid of unsigned bytes (-1)."""


def ring(primitive: Primitive) -> FloatArray:
    """Return a primitive's outline (RING_POINTS + 1, 2) in m, closed by its first point."""
    return closed(primitive.outline(RING_POINTS))


def closed(outline: ArrayLike) -> FloatArray:
    """Return an outline's vertices (N, 2) and its first one again (N + 1, 2)."""
    vertices = np.asarray(outline, dtype=float)
    return np.asarray(np.vstack((vertices, vertices[:1])))


def uncertainty_bounds(primitive: Primitive, std: Mapping[str, float]) -> Iterator[Primitive]:
    """Shrink and enlarge a primitive by one standard deviation of its outline.

    The outline's standard deviation is that of position and size in quadrature.

    Args:
        primitive: The primitive.
        std: Standard deviations of its parameters by name (m, rad).

    Yields:
        The smaller primitive, then the larger one.
    """
    position_std = math.sqrt((std["x"] ** 2 + std["y"] ** 2) / 2)
    half = primitive.kind.extent / 2
    for sign in (-1, 1):
        sizes = tuple(
            max(size + sign * math.hypot(half * std[name], position_std) / half, MIN_SIZE)
            for name, size in primitive.sizes.items()
        )
        yield replace(primitive, size=sizes)


def pose_stds(pose: Pose2D) -> tuple[float, float]:
    """Return the standard deviations of position (m, both axes together) and heading (rad); NaN if not known."""
    if pose.covariance is None:
        return math.nan, math.nan
    xx, yy, tt = np.diag(pose.covariance).tolist()
    return tuple(math.sqrt(value) if value >= 0 else math.nan for value in (xx + yy, tt))  # type: ignore[return-value]


def confidence_ellipse(pose: Pose2D) -> FloatArray:
    """Return the ring (ELLIPSE_POINTS, 2) in m that holds the true position with 95 % probability."""
    assert pose.covariance is not None
    decomposed = linear_algebra.principal_axes(pose.covariance[:2, :2])
    variances, axes = decomposed or (np.zeros(2), np.eye(2))
    angle = np.linspace(0, 2 * np.pi, ELLIPSE_POINTS)
    radii = np.sqrt(CHI_SQUARED_95 * np.maximum(variances, 0.0))
    ellipse: FloatArray = np.column_stack((radii[0] * np.cos(angle), radii[1] * np.sin(angle))) @ axes.T
    ellipse += pose.x, pose.y
    return ellipse


def occupancy_percent(grid: OccupancyGrid) -> NDArray[np.uint8]:
    """Return a grid (rows, cols) as nav_msgs/OccupancyGrid has it: 0 free to 100 occupied, 255 unknown."""
    percent = np.rint(grid.probability * 100).astype(np.uint8)
    percent[grid.probability == 0.5] = UNKNOWN_VALUE
    return percent


def crop_sheet(detections: Sequence[Detection]) -> NDArray[np.uint8]:
    """Arrange the crops that the networks read in rows: black where occupied, the largest y at the top."""
    crops = [detection.crop for detection in detections if detection.crop.size]
    side = max((len(crop) for crop in crops), default=1)
    pitch = side + CROP_BORDER
    rows = max(1, -(-len(crops) // CROPS_PER_ROW))
    sheet = np.full((rows * pitch, CROPS_PER_ROW * pitch), BORDER_VALUE, np.uint8)
    for k, crop in enumerate(crops):
        row, col = k // CROPS_PER_ROW * pitch, k % CROPS_PER_ROW * pitch
        height, width = crop.shape
        sheet[row : row + height, col : col + width] = 255 - np.flipud(crop)
    return sheet


def subsample(points: Sequence[tuple[float, float]], max_points: int) -> Sequence[tuple[float, float]]:
    """Thin out points evenly.

    Args:
        points: The points (m).
        max_points: About how many are left at most.

    Returns:
        Every n-th point, and the last one.
    """
    step = max(1, -(-len(points) // max_points))
    return [*points[: len(points) - 1 : step], points[-1]] if points else []
