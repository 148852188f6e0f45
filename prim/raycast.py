"""Ray casting: exact distances from a point along rays to the nearest of many segments and ellipses."""

from __future__ import annotations

import math

import numpy as np

from prim.arrays import FloatArray
from prim.compiled import kernel

END_SLACK = 1e-12
"""A segment is longer by this share at each end, so that rounding lets no ray pass between two that meet."""


NEAR_SLACK = 1 + 1e-9
"""A ray that passes an ellipse's centre at more than its longer semi-axis, and this share, does not meet it."""


def cast_segments(origin: tuple[float, float], directions: FloatArray, segments: FloatArray) -> FloatArray:
    """Compute the distances along rays to the nearest segment.

    Args:
        origin: Where all rays begin: x, y (m).
        directions: Their unit vectors (N, 2).
        segments: (M, 4) as x0, y0, x1, y1 (m); the ends belong to them.

    Returns:
        Distances (N,) in m; inf where a ray meets no segment. Segments parallel to a ray are not met.
    """
    along, towards = segments[:, 2:] - segments[:, :2], segments[:, :2] - origin
    nearest = np.full(len(directions), np.inf)
    _cast_segments(directions, np.hstack((along, towards)), nearest)
    return nearest


@kernel
def _cast_segments(directions: FloatArray, segments: FloatArray, nearest: FloatArray) -> None:
    """Lower distances (N,) to those of the nearest of segments (M, 4): their vector, and that to their start."""
    for i in range(len(directions)):
        dx, dy = directions[i]
        for j in range(len(segments)):
            along_x, along_y, towards_x, towards_y = segments[j]
            scale = 1.0 / (dx * along_y - dy * along_x)
            distance = (towards_x * along_y - towards_y * along_x) * scale
            share = (towards_x * dy - towards_y * dx) * scale
            if 0.0 <= distance < nearest[i] and abs(share - 0.5) <= 0.5 + END_SLACK:
                nearest[i] = distance


def cast_ellipses(origin: tuple[float, float], directions: FloatArray, ellipses: FloatArray) -> FloatArray:
    """Compute the distances along rays to the nearest ellipse.

    Args:
        origin: Where all rays begin: x, y (m).
        directions: Their unit vectors (N, 2).
        ellipses: (M, 5) as centre x, y (m), theta (rad), semi-axis along theta, semi-axis across (m).

    Returns:
        Distances (N,) in m; inf where a ray meets no ellipse. From inside an ellipse, the distance to its outline.
    """
    x, y, theta, a, b = ellipses.T
    cos, sin = np.cos(theta), np.sin(theta)
    ox, oy = origin[0] - x, origin[1] - y
    with np.errstate(divide="ignore", over="ignore", invalid="ignore"):  # an ellipse too small to be met
        px, py = (cos * ox + sin * oy) / a, (cos * oy - sin * ox) / b
        beyond = px * px + py * py - 1.0
    nearest, reach = np.full(len(directions), np.inf), NEAR_SLACK * np.maximum(a, b)
    _cast_ellipses(directions, np.column_stack((cos, sin, a, b, px, py, beyond, ox, oy, reach)), nearest)
    return nearest


@kernel
def _cast_ellipses(directions: FloatArray, ellipses: FloatArray, nearest: FloatArray) -> None:
    """Lower distances (N,) to those of the nearest of ellipses (M, 10).

    These are given by cosine and sine of their heading, semi-axes, the rays' origin p and p² - 1 in their frame, in
    which they are a unit circle, the origin relative to the centre, and how far from that a ray that meets it passes.
    """
    for i in range(len(directions)):
        dx, dy = directions[i]
        for j in range(len(ellipses)):
            cos, sin, a, b, px, py, beyond, ox, oy, reach = ellipses[j]
            if not abs(ox * dy - oy * dx) <= reach:
                continue
            ux, uy = (cos * dx + sin * dy) / a, (cos * dy - sin * dx) / b
            square = ux * ux + uy * uy
            half = ux * px + uy * py
            discriminant = half * half - square * beyond
            if discriminant >= 0.0:
                root = math.sqrt(discriminant)
                distance = ((-root if beyond > 0.0 else root) - half) / square
                if 0.0 <= distance < nearest[i]:
                    nearest[i] = distance
