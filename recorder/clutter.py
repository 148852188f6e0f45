"""Clutter: things that are none of the kinds, drawn widely.

A thing is drawn as an outline of any length, which is then stretched to a size like the kinds', mirrored or not, and
turned. Its proportions are uniform in ranges that are set by hand. What a primitive nearly covers is drawn again.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import shapely

from prim.arrays import FloatArray
from prim.metrics import OVERLAY_GRID
from prim.shapes import TURN, Kind, Primitive


@dataclass(frozen=True)
class ClutterOptions:
    """What clutter is like; all set by hand.

    Attributes:
        across: The smallest and the largest longer side (m) of the rectangle about a thing, before it is turned.
        max_cover: What a primitive covers with this IoU or more is drawn again; see :func:`cover`.
    """

    across: tuple[float, float] = (0.1, 0.4)
    max_cover: float = 0.95


DEFAULTS = ClutterOptions()

CURVE_POINTS = 96
"""Vertices of a full turn of a curve: a circle's radius is then off by 0.05 % at most."""

Draw = Callable[[np.random.Generator], FloatArray]


def draw_thing(rng: np.random.Generator, options: ClutterOptions = DEFAULTS) -> tuple[str, FloatArray]:
    """Draw one thing that is none of the kinds, all names alike.

    Args:
        rng: Draws it.
        options: What it is like.

    Returns:
        Its name, and its outline (N, 2) about its area centroid (m).
    """
    while True:
        name = str(rng.choice(list(THINGS)))
        outline = THINGS[name](rng)
        outline = outline * (rng.uniform(*options.across) / np.ptp(outline, axis=0).max())
        outline[:, 0] *= rng.choice((-1.0, 1.0))
        if shapely.Polygon(outline).is_valid and cover(outline) < options.max_cover:
            return name, outline - _centroid(outline)


def put_anywhere(rng: np.random.Generator, outline: FloatArray, size: tuple[float, float]) -> FloatArray:
    """Turn and shift an outline, heading and place uniform.

    Args:
        rng: Draws heading and place.
        outline: Vertices (N, 2) about the thing's centroid (m).
        size: The floor, along x and y (m).

    Returns:
        The vertices (N, 2) in the map frame, the centroid on the floor.
    """
    turned = outline @ _rotation(rng.uniform(0, TURN))
    return np.asarray(turned + [rng.uniform(-length / 2, length / 2) for length in size])


def cover(outline: FloatArray) -> float:
    """Compute how well a primitive covers an outline.

    Of each kind the primitive with the outline's centroid and second moments of area is tried, along the principal
    axes and along the sides of the smallest rectangle about the outline, either way. The best of all primitives has a
    somewhat larger IoU.

    Args:
        outline: Vertices (N, 2) of a simple polygon (m).

    Returns:
        The largest IoU, from 0 to 1.
    """
    x, y = _centroid(outline)
    covariance = _covariance(outline)
    polygon = shapely.Polygon(outline)
    shapes = []
    for kind in Kind:
        for heading in _headings(polygon, covariance, kind):
            turn = _rotation(heading)
            size = _size(kind, np.diag(turn @ covariance @ turn.T))
            theta = heading if kind.has_angle else None
            shapes.append(shapely.Polygon(Primitive(kind, x, y, theta, size).outline(CURVE_POINTS)))
    shared = shapely.area(shapely.intersection(shapes, polygon, grid_size=OVERLAY_GRID))
    return float((shared / (polygon.area + shapely.area(shapes) - shared)).max())


def _headings(polygon: shapely.Polygon, covariance: FloatArray, kind: Kind) -> FloatArray:
    """Return the headings (rad) at which a primitive is tried; a quarter turn changes those of no symmetry."""
    (along_x, mixed), (_, along_y) = covariance
    corners = shapely.get_coordinates(polygon.minimum_rotated_rectangle)
    side_x, side_y = corners[1] - corners[0]
    headings = np.array([math.atan2(2 * mixed, along_x - along_y) / 2, math.atan2(side_y, side_x)])
    if not kind.has_angle:
        return headings[:1]
    quarters = np.arange(4 if kind.row.period == TURN else 1) * TURN / 4
    return np.asarray(np.add.outer(headings, quarters).ravel())


def _size(kind: Kind, variances: FloatArray) -> tuple[float, ...]:
    """Return the sizes (m) of a kind whose second moments of area, over the area, are these (2,) (m^2)."""
    width, height = np.sqrt(np.array(kind.spread_factors) * variances).tolist()
    return (math.sqrt(width * height),) if kind.is_tied else (width, height)


def _triangles(outline: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return signed areas (N,) and vertices (N, 3, 2) of the triangles from the first vertex to each edge."""
    corners = np.stack((np.broadcast_to(outline[0], outline.shape), outline, np.roll(outline, -1, axis=0)), axis=1)
    (ax, ay), (bx, by) = (corners[:, 1] - corners[:, 0]).T, (corners[:, 2] - corners[:, 0]).T
    return (ax * by - bx * ay) / 2, corners


def _centroid(outline: FloatArray) -> FloatArray:
    """Return the area centroid (2,)."""
    areas, corners = _triangles(outline)
    return np.asarray(areas @ corners.mean(axis=1) / areas.sum())


def _covariance(outline: FloatArray) -> FloatArray:
    """Return the covariance (2, 2) of points that are spread evenly over the area."""
    areas, corners = _triangles(outline - _centroid(outline))
    sums = corners.sum(axis=1)
    products = np.einsum("nki,nkj->nij", corners, corners) + sums[:, :, None] * sums[:, None, :]
    return np.asarray(np.einsum("n,nij->ij", areas, products) / (12 * areas.sum()))


def _rotation(turn: float) -> FloatArray:
    """Return the matrix (2, 2) that turns points (N, 2) from its left."""
    cos, sin = math.cos(turn), math.sin(turn)
    return np.array([[cos, sin], [-sin, cos]])


def _points(*vertices: tuple[float, float]) -> FloatArray:
    return np.array(vertices, dtype=float)


def _arc(start: float, end: float, radius: float = 1.0, x: float = 0.0, y: float = 0.0) -> FloatArray:
    """Return points on an arc, both ends included (rad)."""
    points = max(3, round(CURVE_POINTS * abs(end - start) / TURN))
    turn = np.linspace(start, end, points)
    return np.column_stack((x + radius * np.cos(turn), y + radius * np.sin(turn)))


def _polar(radius: Callable[[FloatArray], FloatArray]) -> FloatArray:
    """Return the closed curve with these radii at CURVE_POINTS bearings."""
    turn = np.linspace(0, TURN, CURVE_POINTS, endpoint=False)
    return np.asarray(np.column_stack((np.cos(turn), np.sin(turn))) * radius(turn)[:, None])


def _exterior(shape: shapely.Geometry) -> FloatArray:
    """Return the exterior ring of a shape in one piece; of more pieces that of the largest."""
    piece = max(shapely.get_parts(shape), key=lambda part: part.area)
    return np.asarray(piece.exterior.coords)[:-1]


def _half(rng: np.random.Generator) -> float:
    """Return a proportion from a fifth to a half."""
    return float(rng.uniform(0.2, 0.5))


def _angle_piece(rng: np.random.Generator) -> FloatArray:
    height, t, s = rng.uniform(0.5, 1), _half(rng), _half(rng)
    return _points((0, 0), (1, 0), (1, s * height), (t, s * height), (t, height), (0, height))


def _channel(rng: np.random.Generator) -> FloatArray:
    left, right, base = rng.uniform(0.15, 0.35), rng.uniform(0.15, 0.35), rng.uniform(0.15, 0.45)
    first, second = rng.uniform(0.6, 1), rng.uniform(0.6, 1)
    return _points(
        (0, 0), (1, 0), (1, second), (1 - right, second), (1 - right, base), (left, base), (left, first), (0, first)
    )


def _tee(rng: np.random.Generator) -> FloatArray:
    height, bar, stem = rng.uniform(0.6, 1.2), _half(rng), _half(rng)
    left = rng.uniform(0.1, 0.9 - stem)
    top = height * (1 - bar)
    return _points(
        (left, 0), (left + stem, 0), (left + stem, top), (1, top), (1, height), (0, height), (0, top), (left, top)
    )


def _cross(rng: np.random.Generator) -> FloatArray:
    a, b = rng.uniform(0.1, 0.25, 2)
    east, north, west, south = (rng.uniform(low + 0.15, 0.6) for low in (a, b, a, b))
    return _points(
        *((a, b), (a, north), (-a, north), (-a, b), (-west, b), (-west, -b)),
        *((-a, -b), (-a, -south), (a, -south), (a, -b), (east, -b), (east, b)),
    )


def _zigzag(rng: np.random.Generator) -> FloatArray:
    t, s = rng.uniform(0.2, 0.4), rng.uniform(0.2, 0.4)
    middle = rng.uniform(0.3, 0.7)
    height = rng.uniform(0.6, 1)
    low, high = t * height, (1 - s) * height
    left, right = middle - t / 2, middle + t / 2
    return _points((0, 0), (right, 0), (right, high), (1, high), (1, height), (left, height), (left, low), (0, low))


def _girder(rng: np.random.Generator) -> FloatArray:
    web, height = rng.uniform(0.1, 0.3), rng.uniform(0.5, 1)
    low, high = height * rng.uniform(0.15, 0.35), height * rng.uniform(0.65, 0.85)
    left, right = 0.5 - web / 2, 0.5 + web / 2
    return _points(
        *((0, 0), (1, 0), (1, low), (right, low), (right, high), (1, high)),
        *((1, height), (0, height), (0, high), (left, high), (left, low), (0, low)),
    )


def _star(rng: np.random.Generator) -> FloatArray:
    points, depth = int(rng.integers(4, 10)), rng.uniform(0.35, 0.75)
    turn = np.arange(2 * points) * TURN / (2 * points)
    return np.asarray(np.column_stack((np.cos(turn), np.sin(turn))) * np.tile((1.0, depth), points)[:, None])


def _segment(rng: np.random.Generator) -> FloatArray:
    half = math.pi * rng.uniform(0.3, 0.65)
    return _stretched(rng, _arc(-half, half))


def _half_disc(_: np.random.Generator) -> FloatArray:
    return _arc(0, math.pi)


def _sector(rng: np.random.Generator) -> FloatArray:
    return np.vstack(([0.0, 0.0], _arc(0, rng.uniform(0.2, 1.8) * math.pi)))


def _bow(rng: np.random.Generator) -> FloatArray:
    angle, inner = rng.uniform(0.35, 1.6) * math.pi, rng.uniform(0.4, 0.75)
    return np.vstack((_arc(0, angle), _arc(angle, 0, inner)))


def _stadium(rng: np.random.Generator) -> FloatArray:
    length = rng.uniform(0.5, 5)
    return np.vstack((_arc(-TURN / 4, TURN / 4, x=length), _arc(TURN / 4, 3 * TURN / 4)))


def _rounded_box(rng: np.random.Generator) -> FloatArray:
    core = shapely.box(0, 0, rng.uniform(0.1, 2), rng.uniform(0.1, 2))
    return _exterior(core.buffer(rng.uniform(0.3, 1), quad_segs=CURVE_POINTS // 4))


def _egg(rng: np.random.Generator) -> FloatArray:
    small, apart = rng.uniform(0, 0.7), rng.uniform(0.6, 2)
    discs = shapely.MultiPoint([(0, 0), (apart, 0)]).geoms
    circles = [d.buffer(r, quad_segs=CURVE_POINTS // 4) for d, r in zip(discs, (1.0, max(small, 1e-3)), strict=True)]
    return _exterior(shapely.union_all(circles).convex_hull)


def _lens(rng: np.random.Generator) -> FloatArray:
    half = math.pi * rng.uniform(0.15, 0.4)
    return np.vstack(
        (_arc(-half, half, x=-math.cos(half)), _arc(math.pi - half, math.pi + half, x=math.cos(half))[1:-1])
    )


def _trapezoid(rng: np.random.Generator) -> FloatArray:
    top, height = rng.uniform(0.2, 0.8), rng.uniform(0.3, 1)
    left = rng.uniform(-0.2, 1.2 - top)
    return _points((0, 0), (1, 0), (left + top, height), (left, height))


def _parallelogram(rng: np.random.Generator) -> FloatArray:
    height, shift = rng.uniform(0.3, 1), rng.uniform(0.2, 0.8)
    return _points((0, 0), (1, 0), (1 + shift, height), (shift, height))


def _kite(rng: np.random.Generator) -> FloatArray:
    half, below = rng.uniform(0.2, 0.5), rng.uniform(0.1, 0.4)
    return _points((0, -below), (half, 0), (0, 1 - below), (-half, 0))


def _dart(rng: np.random.Generator) -> FloatArray:
    half, notch = rng.uniform(0.3, 0.6), rng.uniform(0.15, 0.5)
    return _points((0, notch), (half, 0), (0, 1), (-half, 0))


def _regular(corners: int) -> Draw:
    def draw(rng: np.random.Generator) -> FloatArray:
        turn = np.arange(corners) * TURN / corners
        outline = np.column_stack((np.cos(turn), np.sin(turn)))
        return _stretched(rng, outline)

    return draw


def _stretched(rng: np.random.Generator, outline: FloatArray) -> FloatArray:
    """Stretch an outline along y, every other time."""
    return np.asarray(outline * (1.0, rng.choice((1.0, rng.uniform(0.5, 1)))))


def _scalene(rng: np.random.Generator) -> FloatArray:
    """Draw a triangle whose sides differ by a seventh or more, and which is not flat."""
    while True:
        apex, height = rng.uniform(-0.3, 1.3), rng.uniform(0.25, 1)
        sides = sorted((1.0, math.hypot(apex, height), math.hypot(1 - apex, height)))
        if sides[1] > 8 / 7 * sides[0] and sides[2] > 8 / 7 * sides[1]:
            return _points((0, 0), (1, 0), (apex, height))


def _notched_box(rng: np.random.Generator) -> FloatArray:
    height, width, depth = rng.uniform(0.4, 1), rng.uniform(0.2, 0.6), rng.uniform(0.25, 0.7)
    left = rng.uniform(0.1, 0.9 - width)
    inset = rng.choice((0.0, width / 2 - 0.01))  # a box or a wedge is cut out
    low = height * (1 - depth)
    return _points(
        *((0, 0), (1, 0), (1, height), (left + width, height), (left + width - inset, low), (left + inset, low)),
        *((left, height), (0, height)),
    )


def _cut_box(rng: np.random.Generator) -> FloatArray:
    height = rng.uniform(0.4, 1)
    return _points((0, 0), (1, 0), (1, height * _half(rng)), (_half(rng), height), (0, height))


def _convex_polygon(rng: np.random.Generator) -> FloatArray:
    points = rng.standard_normal((int(rng.integers(5, 11)), 2)) * (1, rng.uniform(0.4, 1))
    return _exterior(shapely.MultiPoint(points).convex_hull)


def _jagged_polygon(rng: np.random.Generator) -> FloatArray:
    corners = int(rng.integers(5, 13))
    turn = (np.arange(corners) + rng.uniform(0, 0.7, corners)) * TURN / corners
    return np.asarray(np.column_stack((np.cos(turn), np.sin(turn))) * rng.uniform(0.4, 1, corners)[:, None])


def _blob(rng: np.random.Generator) -> FloatArray:
    """Draw a smooth curve whose radius is the exponential of random harmonics."""
    order = np.arange(1, 7)
    waves = rng.standard_normal((2, len(order))) * rng.uniform(0.2, 0.5) / order
    return _polar(lambda t: np.exp(waves[0] @ np.cos(np.outer(order, t)) + waves[1] @ np.sin(np.outer(order, t))))


def _flower(rng: np.random.Generator) -> FloatArray:
    lobes, depth = int(rng.integers(2, 9)), rng.uniform(0.15, 0.4)
    return _polar(lambda t: 1 + depth * np.cos(lobes * t))


def _bean(rng: np.random.Generator) -> FloatArray:
    spine = shapely.LineString(_arc(0, math.pi * rng.uniform(0.3, 1.2)))
    return _exterior(spine.buffer(rng.uniform(0.25, 0.6), quad_segs=CURVE_POINTS // 4))


def _joined_pair(rng: np.random.Generator) -> FloatArray:
    """Draw the union of two primitives that overlap by some of their extent."""
    kinds = [Kind(name) for name in rng.choice(list(Kind), 2)]
    first, second = (Primitive(kind, 0, 0, 0.0 if kind.has_angle else None, kind.row.draw(rng)) for kind in kinds)
    turn, share = rng.uniform(0, TURN), rng.uniform(0.5, 0.9)
    apart = share * (min(first.width_height) + min(second.width_height)) / 2
    moved = second.outline(CURVE_POINTS) @ _rotation(rng.uniform(0, TURN)) + apart * _arc(turn, turn)[0]
    return _exterior(shapely.union(shapely.Polygon(first.outline(CURVE_POINTS)), shapely.Polygon(moved)))


THINGS: dict[str, Draw] = {
    "L": _angle_piece,
    "U": _channel,
    "T": _tee,
    "cross": _cross,
    "Z": _zigzag,
    "H": _girder,
    "star": _star,
    "half disc": _half_disc,
    "segment": _segment,
    "sector": _sector,
    "bow": _bow,
    "stadium": _stadium,
    "rounded box": _rounded_box,
    "egg": _egg,
    "lens": _lens,
    "trapezoid": _trapezoid,
    "parallelogram": _parallelogram,
    "kite": _kite,
    "dart": _dart,
    "pentagon": _regular(5),
    "hexagon": _regular(6),
    "heptagon": _regular(7),
    "scalene": _scalene,
    "notched box": _notched_box,
    "cut box": _cut_box,
    "convex polygon": _convex_polygon,
    "jagged polygon": _jagged_polygon,
    "blob": _blob,
    "flower": _flower,
    "bean": _bean,
    "joined pair": _joined_pair,
}
"""What is drawn, by name. Regular polygons of more corners are nearly circles."""
