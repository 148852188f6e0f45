"""The geometric primitives: one table of kinds, and what follows from it.

Lengths are metres, angles radians, counter-clockwise. ``(x, y)`` is the area centroid in the map frame.

==========  =============================  ==========================================
kind        size                           theta
==========  =============================  ==========================================
square      side                           [0, pi/2), direction of a side
rectangle   width >= height                [0, pi), direction of the width
circle      radius                         none
triangle    base, height (isosceles)       [0, 2 pi), direction of the base, apex on +y
ellipse     semi_major >= semi_minor       [0, pi), direction of the major axis
==========  =============================  ==========================================

Side, width, height and base are full lengths; the radius and the semi-axes are half lengths.

All that a kind is stands in its row of :class:`Kind`; nothing elsewhere asks for a kind by its name. A shape is its
kind's unit outline stretched by width and height, turned by theta and moved to its centroid.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from enum import StrEnum
from functools import cached_property
from typing import Any

import numpy as np

from prim import strict_json
from prim.arrays import FloatArray
from prim.errors import UsageError
from prim.raycast import cast_ellipses, cast_segments
from prim.se2 import MAX_COORDINATE, angle_difference

SIDES_AGREE = 0.03
"""Sides that differ by no more than this share make a shape look more symmetric than its kind is."""

OUTLINE_POINTS = 128
"""Vertices that stand for a curved outline; the polygon's area is then 0.04 % short of the shape's."""

Color = tuple[int, int, int]
Polygon = tuple[tuple[float, float], ...]
Draw = Callable[[np.random.Generator], tuple[float, ...]]


def uniform(sizes: int, low: float, high: float) -> Draw:
    """Make a draw of independent sizes from one uniform distribution.

    Args:
        sizes: How many.
        low: Smallest size (m).
        high: Largest size (m).

    Returns:
        The draw.
    """
    return lambda rng: tuple(rng.uniform(low, high) for _ in range(sizes))


def isosceles(low: float, high: float, min_height: float) -> Draw:
    """Make a draw of base and height of an isosceles triangle, whose base and legs are uniform.

    Args:
        low: Shortest base or leg (m).
        high: Longest one (m).
        min_height: Both are drawn again until the triangle is this high (m).

    Returns:
        The draw.
    """

    def draw(rng: np.random.Generator) -> tuple[float, float]:
        while True:
            base, leg = rng.uniform(low, high), rng.uniform(low, high)
            if leg > base / 2 and (height := math.sqrt(leg**2 - base**2 / 4)) >= min_height:
                return base, height

    return draw


TURN = 2 * math.pi

SKY_BLUE, GREEN, ORANGE = (86, 180, 233), (0, 158, 115), (230, 159, 0)
VERMILION, PURPLE = (213, 94, 0), (204, 121, 167)
"""Colours (red, green, blue) of Okabe and Ito's palette, for all kinds of colour vision."""

DISC: Polygon = ()
"""The unit disc, in the place of a polygon."""

BOX: Polygon = ((-1 / 2, -1 / 2), (1 / 2, -1 / 2), (1 / 2, 1 / 2), (-1 / 2, 1 / 2))
TRIANGLE: Polygon = ((-1 / 2, -1 / 3), (1 / 2, -1 / 3), (0.0, 2 / 3))


@dataclass(frozen=True)
class Row:
    """A row of the table of kinds: all that a kind is.

    Attributes:
        sizes: The sizes' names, in the order of :attr:`Primitive.size`. A single one is tied: it is both the width
            and the height that the unit outline is stretched by.
        outline: The unit outline, counter-clockwise about its centroid: a convex polygon, or DISC.
        period: The turn (rad) after which theta is the same again; None where the kind has no angle.
        regular_period: The same where the outline's sides (a disc's axes) agree within SIDES_AGREE.
        draw: Draws sizes (m) as the recorder wants them: the paper's ranges.
        color: Red, green, blue (0 to 255).
    """

    sizes: tuple[str, ...]
    outline: Polygon
    period: float | None
    regular_period: float | None
    draw: Draw
    color: Color


class Kind(StrEnum):
    """A kind of primitive, in the paper's order: the table of kinds."""

    row: Row

    def __new__(cls, name: str, row: Row | None = None) -> Kind:
        """A member whose value is its name; ``Kind("circle")`` gives the member of that name."""
        assert row is not None
        member = str.__new__(cls, name)
        member._value_, member.row = name, row
        return member

    SQUARE = "square", Row(("side",), BOX, TURN / 4, TURN / 4, uniform(1, 0.08, 0.3), SKY_BLUE)
    RECTANGLE = "rectangle", Row(("width", "height"), BOX, TURN / 2, TURN / 4, uniform(2, 0.06, 0.32), GREEN)
    CIRCLE = "circle", Row(("radius",), DISC, None, None, uniform(1, 0.05, 0.3), ORANGE)
    TRIANGLE = "triangle", Row(("base", "height"), TRIANGLE, TURN, TURN / 3, isosceles(0.1, 0.3, 0.06), VERMILION)
    ELLIPSE = "ellipse", Row(("semi_major", "semi_minor"), DISC, TURN / 2, None, uniform(2, 0.02, 0.16), PURPLE)

    @property
    def sizes(self) -> tuple[str, ...]:
        """The sizes' names."""
        return self.row.sizes

    @property
    def has_angle(self) -> bool:
        """Whether a turn changes anything."""
        return self.row.period is not None

    @cached_property
    def parameters(self) -> tuple[str, ...]:
        """The names of a kind's own parameters: x, y, theta where it has one, sizes."""
        return ("x", "y", *(("theta",) if self.has_angle else ()), *self.sizes)

    @property
    def is_tied(self) -> bool:
        """Whether width and height are one and the same size."""
        return len(self.sizes) == 1

    @property
    def is_round(self) -> bool:
        """Whether the outline is an ellipse or a circle, and no polygon."""
        return self.row.outline == DISC

    @property
    def corners(self) -> int:
        """How many corners the outline has; none where it is round."""
        return len(self.row.outline)

    @property
    def any_apex(self) -> bool:
        """Whether it is a triangle of which any corner may be the apex where its sides agree: an isosceles one."""
        return self.corners == 3 and self.row.regular_period != self.row.period

    @cached_property
    def longer_first(self) -> bool:
        """Whether both sizes exchanged make the same shape, turned by a quarter: the longer one is then first."""
        turned = [(-y, x) for x, y in self.row.outline]
        return not self.is_tied and {_rounded(vertex) for vertex in turned} == {*map(_rounded, self.row.outline)}

    @cached_property
    def special_case(self) -> Kind | None:
        """The kind with the same outline whose sizes are tied: what this one is where its sizes agree."""
        alike = (kind for kind in Kind if kind.is_tied and not self.is_tied and kind.row.outline == self.row.outline)
        return next(alike, None)

    @cached_property
    def vertices(self) -> FloatArray:
        """The unit outline's vertices (N, 2), counter-clockwise; for the disc OUTLINE_POINTS points on its rim."""
        return _round_vertices(OUTLINE_POINTS) if self.is_round else np.array(self.row.outline)

    @cached_property
    def reciprocals(self) -> FloatArray:
        """One over the unit outline's vertices (N, 2): sizes are divided by it, so that height / 3 rounds once."""
        with np.errstate(divide="ignore"):
            return np.asarray(1 / self.vertices)

    @cached_property
    def extent(self) -> float:
        """The larger of the unit outline's extents along x and y: how long a shape of size 1 is."""
        return 2.0 if self.is_round else float(np.ptp(self.vertices, axis=0).max())

    @cached_property
    def unit_area(self) -> float:
        """The unit outline's area."""
        return math.pi if self.is_round else round(_moments(self.vertices)[0], 12)

    @cached_property
    def spread_factors(self) -> tuple[float, float]:
        """width^2 / var_x and height^2 / var_y, with the variances of points spread evenly over the area."""
        if self.is_round:
            return 4.0, 4.0
        area, along_x, along_y = _moments(self.vertices)
        return round(area / along_x, 9), round(area / along_y, 9)


def _rounded(vertex: tuple[float, float]) -> tuple[float, float]:
    return round(vertex[0], 9), round(vertex[1], 9)


def _round_vertices(points: int) -> FloatArray:
    turn = np.linspace(0, 2 * np.pi, points, endpoint=False)
    return np.column_stack((np.cos(turn), np.sin(turn)))


def _moments(vertices: FloatArray) -> tuple[float, float, float]:
    """Area and second moments of area along x and y about the origin of a polygon (Green's theorem)."""
    (x, y), (next_x, next_y) = vertices.T, np.roll(vertices, -1, axis=0).T
    cross = x * next_y - next_x * y
    along_x, along_y = (cross * (a * a + a * b + b * b) for a, b in ((x, next_x), (y, next_y)))
    return float(cross.sum() / 2), float(along_x.sum() / 12), float(along_y.sum() / 12)


@dataclass(frozen=True, slots=True)
class Primitive:
    """One primitive.

    Attributes:
        kind: Its kind.
        x: The area centroid's x in the map frame (m).
        y: The area centroid's y in the map frame (m).
        theta: Its heading (rad); None where the kind has none.
        size: Its sizes (m), in the order of the kind's row.

    Raises:
        ValueError: The sizes or the heading do not fit the kind, a value is not finite or beyond MAX_COORDINATE, or
            a size is not positive.
    """

    kind: Kind
    x: float
    y: float
    theta: float | None
    size: tuple[float, ...]

    def __post_init__(self) -> None:
        if not isinstance(self.kind, Kind):
            raise ValueError(f"{self.kind!r} is no Kind: Primitive.of takes its name")
        keys = self.kind.sizes
        if len(self.size) != len(keys):
            raise ValueError(f"a {self.kind} has {len(keys)} sizes ({', '.join(keys)}), not {len(self.size)}")
        if (self.theta is not None) != self.kind.has_angle:
            has = "has one" if self.kind.has_angle else "has none"
            raise ValueError(f"theta of a {self.kind} is {self.theta}: a {self.kind} {has}")
        values = (self.x, self.y, self.theta or 0.0, *self.size)
        if not all(abs(value) <= MAX_COORDINATE for value in values):
            finite = all(isinstance(value, int) or math.isfinite(value) for value in values)
            what = f"beyond {MAX_COORDINATE:g}" if finite else "that is not finite"
            raise ValueError(f"a {self.kind} has a value {what}: {self}")
        if min(self.size) <= 0:
            raise ValueError(f"a {self.kind} has a size that is not positive: {self.sizes}")

    @classmethod
    def of(cls, kind: str, x: float, y: float, theta: float | None = None, **sizes: float) -> Primitive:
        """Make a primitive by the names of its kind and sizes: ``Primitive.of("circle", 0, 0, radius=0.1)``.

        Args:
            kind: The kind's name.
            x: The area centroid's x in the map frame (m).
            y: The same along y (m).
            theta: Its heading (rad); None where the kind has none.
            **sizes: All sizes of the kind by name (m).

        Returns:
            The primitive.

        Raises:
            UsageError: There is no such kind, or the values do not fit it.
        """
        if kind not in [*Kind]:
            raise UsageError(f"there is no kind {kind!r}: the kinds are {', '.join(Kind)}")
        named = Kind(kind)
        if set(sizes) != set(named.sizes):
            raise UsageError(f"a {named} has the sizes {', '.join(named.sizes)}, not {', '.join(sizes) or 'none'}")
        try:
            return cls(named, x, y, theta, tuple(sizes[name] for name in named.sizes))
        except (ValueError, TypeError) as error:
            raise UsageError(str(error)) from None

    @property
    def sizes(self) -> dict[str, float]:
        """The sizes by name (m), as logs and reports hold them."""
        return dict(zip(self.kind.sizes, self.size, strict=True))

    @property
    def width_height(self) -> tuple[float, float]:
        """Width and height in the sense of the paper's Table II (m): what the unit outline is stretched by.

        Full extents of shapes with corners (the side twice, width and height, base and height), but half extents of
        round ones (the radius twice, semi-major and semi-minor axis). A mean error of the width or the height over
        several kinds therefore mixes errors of full and of half lengths.
        """
        return self.size[0], self.size[-1]

    @property
    def area(self) -> float:
        """Area (m^2)."""
        width, height = self.width_height
        return self.kind.unit_area * width * height

    @property
    def bounding_radius(self) -> float:
        """Radius about the centroid that bounds the outline (m); not that of the circumscribed circle."""
        if self.is_round:
            return max(self.width_height)
        return float(np.hypot(*self.local_outline().T).max())

    @property
    def sides(self) -> tuple[float, ...]:
        """Lengths of the outline's edges (m); of a round shape, both semi-axes."""
        if self.is_round:
            return self.width_height
        corners = self.local_outline()
        return tuple(np.hypot(*(np.roll(corners, -1, axis=0) - corners).T).tolist())

    def sides_agree(self, share: float) -> bool:
        """Return whether the longest and the shortest side differ by at most ``share`` of the longest one."""
        return max(self.sides) - min(self.sides) <= share * max(self.sides)

    @property
    def symmetry(self) -> float | None:
        """The smallest turn (rad) that leaves the shape as it is, or None if every turn does.

        Where the sides agree within 3 %, the shape counts as its more symmetric relative: a rectangle as a
        square, a triangle as equilateral, an ellipse as a circle.
        """
        return self.kind.row.regular_period if self.sides_agree(SIDES_AGREE) else self.kind.row.period

    def canonical(self) -> Primitive:
        """Return the same shape with the longer side first (rectangle, ellipse) and theta in its kind's range."""
        period = self.kind.row.period
        if self.theta is None or period is None:
            return self
        theta, size = self.theta, self.size
        if self.kind.longer_first and size[0] < size[1]:
            theta, size = theta + math.pi / 2, (size[1], size[0])
        theta = theta % period
        return replace(self, theta=0.0 if theta >= period else theta, size=size)

    def scaled(self, factor: float) -> Primitive:
        """Return it in other units: place and sizes so many times as large, kind and angle the same."""
        return replace(self, x=factor * self.x, y=factor * self.y, size=tuple(factor * value for value in self.size))

    def local_outline(self, points: int = OUTLINE_POINTS) -> FloatArray:
        """Return the outline's vertices (N, 2) in the shape's frame (m), counter-clockwise; round ones ``points``."""
        if self.is_round:
            return np.asarray(_round_vertices(points) * self.width_height)
        return np.asarray(self.width_height / self.kind.reciprocals)

    def outline(self, points: int = OUTLINE_POINTS) -> FloatArray:
        """Return the outline's vertices (N, 2) in the map frame (m), counter-clockwise; round ones ``points``."""
        cos, sin = math.cos(self.theta or 0.0), math.sin(self.theta or 0.0)
        outline: FloatArray = self.local_outline(points) @ np.array([[cos, sin], [-sin, cos]])
        outline += self.x, self.y
        return outline

    @property
    def is_round(self) -> bool:
        """Whether the outline is an ellipse or a circle, and no polygon."""
        return self.kind.is_round

    def cast(self, origin: tuple[float, float], directions: FloatArray) -> FloatArray:
        """Compute exact distances along rays to the outline.

        Args:
            origin: Where all rays begin: x, y in the map frame (m).
            directions: Their unit vectors (N, 2).

        Returns:
            Distances (N,) in m; inf where a ray misses. From inside the shape, the distance to its outline.
        """
        if self.is_round:
            return cast_ellipses(origin, directions, np.array([self.as_ellipse()]))
        return cast_segments(origin, directions, self.as_segments())

    def as_ellipse(self) -> tuple[float, float, float, float, float]:
        """Return a round shape as a row for :func:`prim.raycast.cast_ellipses`."""
        return self.x, self.y, self.theta or 0.0, *self.width_height

    def as_segments(self) -> FloatArray:
        """Return the edges (M, 4) of a shape with corners for :func:`prim.raycast.cast_segments`."""
        corners = self.outline()
        return np.hstack((corners, np.roll(corners, -1, axis=0)))

    def to_json(self) -> dict[str, Any]:
        """Return the primitive as reports and ``world.json`` hold it."""
        return {"kind": str(self.kind), "x": self.x, "y": self.y, "theta": self.theta, "size": self.sizes}

    @classmethod
    def from_json(cls, value: Mapping[str, Any]) -> Primitive:
        """Invert :meth:`to_json`.

        Raises:
            ValueError: The value does not describe a primitive; the message names what is wrong.
        """
        if not isinstance(value, Mapping):
            raise ValueError(f"{strict_json.shown(value)} does not describe a primitive")
        try:
            kind = Kind(value["kind"])
            size = value["size"]
            unknown = set(size) - set(kind.sizes)
            if unknown:
                raise ValueError(f"a {kind} has no size {sorted(unknown)[0]!r}")
            theta = float(value["theta"]) if kind.has_angle else None
            lengths = tuple(float(size[key]) for key in kind.sizes)
            return cls(kind, float(value["x"]), float(value["y"]), theta, lengths)
        except KeyError as missing:
            raise ValueError(f"{missing.args[0]!r} is missing in {strict_json.shown(value)}") from None
        except (TypeError, AttributeError, OverflowError):
            raise ValueError(f"{strict_json.shown(value)} does not describe a primitive") from None


def angle_error(estimate: Primitive, truth: Primitive) -> float | None:
    """Compute the error in angle modulo the true shape's own symmetry.

    Args:
        estimate: The estimate.
        truth: The true primitive.

    Returns:
        The error (rad), 0 or more; None where either has no angle, or where the true shape counts as a circle: an
        ellipse whose axes agree within SIDES_AGREE.
    """
    if truth.symmetry is None or estimate.theta is None or truth.theta is None:
        return None
    return abs(angle_difference(estimate.theta, truth.theta, truth.symmetry))
