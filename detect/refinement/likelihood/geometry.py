"""Primitives as the kernels take them: parameters, outlines, and the kinds' own parameters."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from detect.refinement.likelihood.kernels import (
    FORMS,
    PARAMETERS,
    POLYGON,
    Outlines,
    cast_rays,
    silhouette_clearances,
)
from prim.arrays import FloatArray
from prim.shapes import Kind, Primitive

NUMBERS = {kind: number for number, kind in enumerate(Kind)}
"""The number of each kind: its row in OUTLINES."""


def _outlines() -> Outlines:
    """Return the outlines of the table of kinds, padded to the most corners."""
    corners = np.array([kind.corners for kind in Kind], np.int64)
    vertices = np.zeros((len(Kind), int(corners.max()), 2))
    normals, offsets = np.zeros_like(vertices), np.zeros(vertices.shape[:2])
    for k, kind in enumerate(Kind):
        if kind.is_round:
            continue
        own = kind.vertices
        edges = np.roll(own, -1, axis=0) - own
        outward = np.column_stack((edges[:, 1], -edges[:, 0])) / np.hypot(*edges.T)[:, None]
        vertices[k, : len(own)], normals[k, : len(own)] = own, outward
        offsets[k, : len(own)] = (outward * own).sum(axis=1)
    return Outlines(
        np.array([FORMS.get(kind.row.outline, POLYGON) for kind in Kind], np.int64),
        corners,
        vertices,
        normals,
        offsets,
    )


OUTLINES = _outlines()
"""The unit outlines of all kinds."""


def _jacobian(kind: Kind) -> FloatArray:
    full = np.eye(PARAMETERS)
    columns = [full[0], full[1], *([full[2]] if kind.has_angle else [])]
    columns += [full[3] + full[4]] if kind.is_tied else [full[3], full[4]]
    return np.column_stack(columns)


JACOBIANS = {kind: _jacobian(kind) for kind in Kind}
"""For each kind the constant Jacobian (5, K) of x, y, theta, width, height by its own parameters."""


def parameters_of(primitive: Primitive) -> FloatArray:
    """Return a primitive's parameters (5,): x, y (m), theta (rad), width, height (m)."""
    return np.array([primitive.x, primitive.y, primitive.theta or 0.0, *primitive.width_height])


def primitive_of(kind: Kind, p: FloatArray) -> Primitive:
    """Make a primitive of a kind from parameters.

    Args:
        kind: The kind.
        p: (5,) x, y, theta, width, height; sizes beyond the kind's own are left out.

    Returns:
        The primitive, in canonical form.
    """
    x, y, theta, width, height = p.tolist()
    size = (width, height)[: len(kind.sizes)]
    return Primitive(kind, x, y, theta if kind.has_angle else None, size).canonical()


def shape_ranges(kind: Kind, p: FloatArray, rays: FloatArray) -> FloatArray:
    """Cast rays against a shape.

    Args:
        kind: Its kind.
        p: (5,) its parameters.
        rays: (7, N) as detect.refinement.likelihood.kernels has them.

    Returns:
        The ranges (N,) in metres; FAR for a miss, 0 from inside.
    """
    ranges = np.empty(rays.shape[1])
    cast_rays(OUTLINES, NUMBERS[kind], p, rays, ranges)
    return ranges


def ranges_to(primitive: Primitive, rays: FloatArray) -> FloatArray:
    """Cast rays against a primitive.

    Args:
        primitive: The primitive.
        rays: (7, N).

    Returns:
        The ranges (N,) in metres; FAR for a miss, 0 from inside.
    """
    return shape_ranges(primitive.kind, parameters_of(primitive), rays)


def passes_within(primitive: Primitive, rays: FloatArray, reach: float) -> NDArray[np.bool_]:
    """Tell which rays come near a primitive.

    Args:
        primitive: The primitive.
        rays: (7, N).
        reach: How near (m) to its silhouette; below 0, how far inside of it.

    Returns:
        (N,) bool.
    """
    clearances = np.empty(rays.shape[1])
    silhouette_clearances(OUTLINES, NUMBERS[primitive.kind], parameters_of(primitive), rays, clearances)
    return clearances > -reach
