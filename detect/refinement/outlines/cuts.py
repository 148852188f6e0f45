"""Outlines cut where things may touch: at concave vertices, each part with the primitive that it is most like.

Of two convex things that touch the outline has concave vertices where they meet. A cut goes from one of these to
another, to the nearest point of another edge, or along the line of one of its own two edges.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import shapely

from detect.refinement.fitting.fit import starts
from detect.refinement.likelihood.geometry import primitive_of
from detect.refinement.options import DEFAULTS, TouchingOptions
from prim.arrays import FloatArray
from prim.shapes import Kind, Primitive

EXACT = 1e-9
"""m; cuts this near to an end of an edge end at its vertex, and touch the outline."""


@dataclass(frozen=True)
class Partition:
    """An outline cut in two.

    Attributes:
        guesses: For each part the primitive that it is most like.
        mismatch: Area by which the parts and their primitives differ, as a share of the whole.
    """

    guesses: tuple[Primitive, ...]
    mismatch: float


def partitions(vertices: FloatArray, options: TouchingOptions = DEFAULTS.touching) -> list[Partition]:
    """Cut an outline in two.

    Args:
        vertices: (V, 2) in m, counter-clockwise.
        options: Numeric parameters.

    Returns:
        The partitions whose parts are most like primitives first; none where the outline is convex or crosses itself.
    """
    whole = shapely.Polygon(vertices)
    if not whole.is_valid:
        return []
    made = []
    for cut in _shortest_cuts(vertices, whole, options):
        parts = _split(vertices, cut)
        areas = [shapely.Polygon(part).area for part in parts]
        if min(areas) < options.min_share * whole.area:
            continue
        likest = [_most_like(part, options) for part in parts]
        mismatch = sum(different for _, different in likest) / whole.area
        if mismatch < options.max_mismatch:
            made.append(Partition(tuple(guess for guess, _ in likest), mismatch))
    return sorted(made, key=lambda partition: partition.mismatch)


@dataclass(frozen=True)
class _Cut:
    """From a vertex to a point (2,) in m on the edge that follows vertex ``edge``, or to that vertex itself."""

    vertex: int
    edge: int
    end: FloatArray
    is_vertex: bool


def _shortest_cuts(vertices: FloatArray, whole: shapely.Polygon, options: TouchingOptions) -> list[_Cut]:
    """Return the cuts that lie in the outline, the shortest for the outline on either side of them first."""
    inner = whole.buffer(EXACT)
    found = []
    for cut in _cuts(vertices, options):
        first, length = vertices[cut.vertex], math.hypot(*(cut.end - vertices[cut.vertex]))
        if length < EXACT or not inner.covers(shapely.LineString([first, cut.end])):
            continue
        around = min(_length_of(part) for part in _split(vertices, cut)) - length
        found.append((length / max(around, EXACT), cut))
    found.sort(key=lambda item: item[0])
    return [cut for _, cut in found[: options.max_cuts]]


def _cuts(vertices: FloatArray, options: TouchingOptions) -> Iterator[_Cut]:
    """Yield cuts from concave vertices, whether or not they lie in the outline."""
    count = len(vertices)
    concave = _concave(vertices, options)
    for n, i in enumerate(concave):
        for j in concave[n + 1 :]:
            if (j - i) % count not in (1, count - 1):
                yield _Cut(i, j, vertices[j], True)
        for edge in range(count):
            if edge in (i, (i - 1) % count):
                continue
            first, last = vertices[edge], vertices[(edge + 1) % count]
            for share in _shares(vertices, i, first, last):
                yield _Cut(i, edge, first + share * (last - first), False)


def _concave(vertices: FloatArray, options: TouchingOptions) -> list[int]:
    """Return the vertices at which a counter-clockwise outline turns to the right."""
    incoming, outgoing = vertices - np.roll(vertices, 1, axis=0), np.roll(vertices, -1, axis=0) - vertices
    cross = incoming[:, 0] * outgoing[:, 1] - incoming[:, 1] * outgoing[:, 0]
    turn = np.arctan2(cross, (incoming * outgoing).sum(axis=1))
    return np.flatnonzero(turn < -options.min_turn).tolist()


def _shares(vertices: FloatArray, i: int, first: FloatArray, last: FloatArray) -> Iterator[float]:
    """Yield where along an edge, as a share of it, cuts from vertex i meet it: nearest to it, and along its edges."""
    along, at = last - first, vertices[i]
    nearest = float((at - first) @ along / max(along @ along, EXACT**2))
    if 0 < nearest < 1:
        yield nearest
    for neighbour in (vertices[i - 1], vertices[(i + 1) % len(vertices)]):
        direction = at - neighbour
        across = direction[0] * along[1] - direction[1] * along[0]
        if abs(across) < EXACT**2:
            continue
        share = float((direction[1] * (first - at)[0] - direction[0] * (first - at)[1]) / across)
        ahead = float((first + share * along - at) @ direction)
        if 0 < share < 1 and ahead > 0:
            yield share


def _split(vertices: FloatArray, cut: _Cut) -> tuple[FloatArray, FloatArray]:
    """Return the two parts (V, 2) of an outline."""
    count = len(vertices)
    there = np.arange(cut.vertex, cut.vertex + 1 + (cut.edge - cut.vertex) % count) % count
    first_back = cut.edge if cut.is_vertex else cut.edge + 1
    back = np.arange(first_back, first_back + 1 + (cut.vertex - first_back) % count) % count
    if cut.is_vertex:
        return vertices[there], vertices[back]
    end = cut.end[None, :]
    return np.concatenate((vertices[there], end)), np.concatenate((end, vertices[back]))


def _length_of(vertices: FloatArray) -> float:
    """Return the perimeter (m) of a polygon."""
    return float(np.hypot(*(np.roll(vertices, -1, axis=0) - vertices).T).sum())


def _most_like(vertices: FloatArray, options: TouchingOptions) -> tuple[Primitive, float]:
    """Return the primitive most like a polygon, with its second moments, and the area (m²) by which they differ."""
    part = shapely.Polygon(vertices)
    made = [primitive_of(kind, p) for guess in _rectangles(vertices) for kind in Kind for p in starts(guess, kind)]
    outlines = shapely.polygons([shapely.linearrings(one.outline(options.round_vertices)) for one in made])
    shared = shapely.area(shapely.intersection(outlines, part))
    different = shapely.area(outlines) + part.area - 2 * shared
    best = int(np.argmin(different))
    return made[best], float(different[best])


def _rectangles(vertices: FloatArray) -> list[Primitive]:
    """Return the rectangles with a polygon's centroid and second moments: along principal axes, and its longest edge.

    A square's principal axes are any.
    """
    centroid, moments = _moments(vertices)
    edges = np.roll(vertices, -1, axis=0) - vertices
    longest = edges[int(np.argmax(np.hypot(*edges.T)))]
    principal = 0.5 * math.atan2(2 * moments[0, 1], moments[0, 0] - moments[1, 1])
    made = []
    for theta in (principal, math.atan2(longest[1], longest[0])):
        axes = np.array([[math.cos(theta), -math.sin(theta)], [math.sin(theta), math.cos(theta)]])
        variances = np.diag(axes.T @ moments @ axes)
        width, height = np.sqrt(12 * np.maximum(variances, EXACT)).tolist()
        x, y = centroid.tolist()
        made.append(Primitive(Kind.RECTANGLE, x, y, theta, (width, height)).canonical())
    return made


def _moments(vertices: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return a polygon's centroid (2,) in m, and the covariance (2, 2) in m² of the points in it."""
    origin = vertices.mean(axis=0)
    a = vertices - origin
    b = np.roll(a, -1, axis=0)
    cross = a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]
    area = cross.sum() / 2
    mean = ((a + b) * cross[:, None]).sum(axis=0) / (6 * area)
    second = np.einsum("v,vi,vj->ij", cross, a, a) + np.einsum("v,vi,vj->ij", cross, b, b)
    mixed = np.einsum("v,vi,vj->ij", cross, a, b)
    second = (2 * second + mixed + mixed.T) / (24 * area)
    return origin + mean, second - np.outer(mean, mean)
