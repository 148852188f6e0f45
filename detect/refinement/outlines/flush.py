"""Primitives that touch with parallel sides: whether they are one thing, rays cannot decide."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from detect.refinement.options import DEFAULTS, TouchingOptions
from prim.arrays import FloatArray
from prim.shapes import Primitive


def are_flush(a: Primitive, b: Primitive, options: TouchingOptions = DEFAULTS.touching) -> bool:
    """Tell whether two primitives touch with parallel sides: no ray saw what is between.

    Args:
        a: One.
        b: The other.
        options: Numeric parameters.

    Returns:
        Whether they do; never of round ones.
    """
    return _flush_sides(a, b, options) is not None


def is_one_piece(parts: Sequence[Primitive], options: TouchingOptions = DEFAULTS.touching) -> bool:
    """Tell whether parts are made as one thing: flush, with an edge in one line or with the same axis, as L and T.

    Of two things that were put beside each other neither is so exactly.

    Args:
        parts: The parts.
        options: Numeric parameters.

    Returns:
        Whether any two of them are.
    """
    return any(_are_one_piece(a, b, options) for n, a in enumerate(parts) for b in parts[n + 1 :])


def _are_one_piece(a: Primitive, b: Primitive, options: TouchingOptions) -> bool:
    sides = _flush_sides(a, b, options)
    if sides is None:
        return False
    along = sides[0, 1] - sides[0, 0]
    along /= math.hypot(*along)
    middles = sides.mean(axis=1) @ along
    if abs(middles[0] - middles[1]) < options.coincidence:
        return True
    (corners, normals), (others, facing) = _sides(a), _sides(b)
    same = normals @ facing.T > math.cos(options.aligned)
    halfway = (others + np.roll(others, -1, axis=0)) / 2
    offsets = normals @ halfway.T - (normals * corners).sum(axis=1)[:, None]
    return bool((same & (np.abs(offsets) < options.coincidence)).any())


def _sides(primitive: Primitive) -> tuple[FloatArray, FloatArray]:
    """Return where the sides of a polygon begin (V, 2) in m, counter-clockwise, and their outward normals (V, 2)."""
    corners = primitive.outline()
    edges = np.roll(corners, -1, axis=0) - corners
    return corners, np.column_stack((edges[:, 1], -edges[:, 0])) / np.hypot(*edges.T)[:, None]


def _flush_sides(a: Primitive, b: Primitive, options: TouchingOptions) -> FloatArray | None:
    """Return the sides (2, 2, 2), one of each, at which two polygons touch; None where none are parallel there.

    Of convex polygons that touch the separating line is along a side of one of them.
    """
    if (
        a.is_round
        or b.is_round
        or math.hypot(a.x - b.x, a.y - b.y) > a.bounding_radius + b.bounding_radius + options.gap
    ):
        return None
    best, found = -math.inf, None
    for one, other in ((a, b), (b, a)):
        (corners, normals), (others, facing) = _sides(one), _sides(other)
        gaps = (others @ normals.T - (normals * corners).sum(axis=1)).min(axis=0)
        side = int(np.argmax(gaps))
        if gaps[side] > best:
            best = float(gaps[side])
            opposite = int(np.argmin(facing @ normals[side]))
            parallel = facing[opposite] @ normals[side] < -math.cos(options.aligned)
            ends = (corners[side], np.roll(corners, -1, axis=0)[side])
            back = (others[opposite], np.roll(others, -1, axis=0)[opposite])
            found = np.array((ends, back)) if parallel else None
    return found if best < options.gap else None
