"""Ray casting: exact distances from a point along rays to segments and ellipses, all pairs at once."""

from __future__ import annotations

import numpy as np

from prim.arrays import FloatArray

END_SLACK = 1e-12
"""A segment is longer by this share at each end, so that rounding lets no ray pass between two that meet."""


def cast_segments(origin: tuple[float, float], directions: FloatArray, segments: FloatArray) -> FloatArray:
    """Compute the distances along rays to the nearest segment.

    Args:
        origin: Where all rays begin: x, y (m).
        directions: Their unit vectors (N, 2).
        segments: (M, 4) as x0, y0, x1, y1 (m); the ends belong to them.

    Returns:
        Distances (N,) in m; inf where a ray meets no segment. Segments parallel to a ray are not met.
    """
    if not len(segments):
        return np.full(len(directions), np.inf)
    along = (segments[:, 2:] - segments[:, :2]).T[:, :, None]
    towards = (segments[:, :2] - origin).T[:, :, None]
    dx, dy = directions.T[:, None, :]
    with np.errstate(divide="ignore", over="ignore", invalid="ignore"):
        scale = 1.0 / (dx * along[1] - dy * along[0])
        distance = (towards[0] * along[1] - towards[1] * along[0]) * scale
        share = (towards[0] * dy - towards[1] * dx) * scale
        hits = (distance >= 0) & (np.abs(share - 0.5) <= 0.5 + END_SLACK)
    nearest: FloatArray = np.where(hits, distance, np.inf).min(axis=0)
    return nearest


def cast_ellipses(origin: tuple[float, float], directions: FloatArray, ellipses: FloatArray) -> FloatArray:
    """Compute the distances along rays to the nearest ellipse.

    Args:
        origin: Where all rays begin: x, y (m).
        directions: Their unit vectors (N, 2).
        ellipses: (M, 5) as centre x, y (m), theta (rad), semi-axis along theta, semi-axis across (m).

    Returns:
        Distances (N,) in m; inf where a ray meets no ellipse. From inside an ellipse, the distance to its outline.
    """
    if not len(ellipses):
        return np.full(len(directions), np.inf)
    x, y, theta, a, b = ellipses.T[:, :, None]
    cos, sin = np.cos(theta), np.sin(theta)
    ox, oy = origin[0] - x, origin[1] - y
    dx, dy = directions.T[:, None, :]
    with np.errstate(divide="ignore", over="ignore", invalid="ignore"):  # an ellipse too small to be met
        px, py = (cos * ox + sin * oy) / a, (cos * oy - sin * ox) / b
        ux, uy = (cos * dx + sin * dy) / a, (cos * dy - sin * dx) / b
        square = ux * ux + uy * uy
        half = ux * px + uy * py
        beyond = px * px + py * py - 1.0
        discriminant = half * half - square * beyond
        root = np.sqrt(np.maximum(discriminant, 0.0))
        distance = (np.where(beyond > 0, -root, root) - half) / square
    nearest: FloatArray = np.where((discriminant >= 0) & (distance >= 0), distance, np.inf).min(axis=0)
    return nearest
