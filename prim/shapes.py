"""The five geometric primitives: parameters, outline, canonical form, symmetric angle differences.

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

Nothing here is a half size but the radius and the semi-axes: side, width, height and base are full lengths.
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from enum import StrEnum
from typing import Any

import numpy as np

from prim.arrays import FloatArray
from prim.raycast import cast_ellipses, cast_segments

SIDES_AGREE = 0.03
"""Sides that differ by no more than this share make a shape look more symmetric than its kind is."""

OUTLINE_POINTS = 128
"""Vertices that stand for a curved outline; the polygon's area is then 0.04 % short of the shape's."""


class Kind(StrEnum):
    """A kind of primitive, in the paper's order."""

    SQUARE = "square"
    RECTANGLE = "rectangle"
    CIRCLE = "circle"
    TRIANGLE = "triangle"
    ELLIPSE = "ellipse"


SIZE_KEYS: Mapping[Kind, tuple[str, ...]] = {
    Kind.SQUARE: ("side",),
    Kind.RECTANGLE: ("width", "height"),
    Kind.CIRCLE: ("radius",),
    Kind.TRIANGLE: ("base", "height"),
    Kind.ELLIPSE: ("semi_major", "semi_minor"),
}
"""Names of each kind's sizes, in the order of :attr:`Primitive.size`."""

_SYMMETRY: Mapping[Kind, float] = {
    Kind.SQUARE: math.pi / 2,
    Kind.RECTANGLE: math.pi,
    Kind.TRIANGLE: 2 * math.pi,
    Kind.ELLIPSE: math.pi,
}


@dataclass(frozen=True, slots=True)
class Primitive:
    """One primitive: its kind, area centroid (m), heading (rad, None for a circle) and sizes (m).

    Raises ValueError where the sizes do not fit the kind, or a value is not finite or not positive.
    """

    kind: Kind
    x: float
    y: float
    theta: float | None
    size: tuple[float, ...]

    def __post_init__(self) -> None:
        keys = SIZE_KEYS[self.kind]
        if len(self.size) != len(keys):
            raise ValueError(f"a {self.kind} has {len(keys)} sizes ({', '.join(keys)}), not {len(self.size)}")
        if (self.theta is None) != (self.kind is Kind.CIRCLE):
            raise ValueError(f"theta of a {self.kind} is {self.theta}: a circle has none, all others have one")
        if not all(math.isfinite(v) for v in (self.x, self.y, self.theta or 0.0, *self.size)):
            raise ValueError(f"a {self.kind} has a value that is not finite: {self}")
        if min(self.size) <= 0:
            raise ValueError(f"a {self.kind} has a size that is not positive: {self.sizes}")

    @property
    def sizes(self) -> dict[str, float]:
        """The sizes by name (m), as logs and reports hold them."""
        return dict(zip(SIZE_KEYS[self.kind], self.size, strict=True))

    @property
    def width_height(self) -> tuple[float, float]:
        """Width and height in the sense of the paper's Table II (m).

        Base and height of a triangle, semi-major and semi-minor axis of an ellipse, the radius on both for a
        circle, the side on both for a square.
        """
        return self.size[0], self.size[-1]

    @property
    def area(self) -> float:
        """Area (m^2)."""
        width, height = self.width_height
        factor = {Kind.CIRCLE: math.pi, Kind.ELLIPSE: math.pi, Kind.TRIANGLE: 0.5}.get(self.kind, 1.0)
        return factor * width * height

    @property
    def symmetry(self) -> float | None:
        """The smallest turn (rad) that leaves the shape as it is, or None if every turn does.

        Where the sides agree within 3 %, the shape counts as its more symmetric relative: a rectangle as a
        square, a triangle as equilateral, an ellipse as a circle.
        """
        if self.kind is Kind.CIRCLE:
            return None
        if self.kind is Kind.SQUARE or not self._sides_agree():
            return _SYMMETRY[self.kind]
        return {Kind.RECTANGLE: math.pi / 2, Kind.TRIANGLE: 2 * math.pi / 3}.get(self.kind)

    def _sides_agree(self) -> bool:
        first, second = self.size
        if self.kind is Kind.TRIANGLE:
            second = math.hypot(first / 2, second)
        return abs(first - second) <= SIDES_AGREE * max(first, second)

    def canonical(self) -> Primitive:
        """The same shape with the longer side first (rectangle, ellipse) and theta in its kind's range."""
        if self.theta is None:
            return self
        theta, size = self.theta, self.size
        if self.kind in (Kind.RECTANGLE, Kind.ELLIPSE) and size[0] < size[1]:
            theta, size = theta + math.pi / 2, (size[1], size[0])
        period = _SYMMETRY[self.kind]
        theta = theta % period
        return replace(self, theta=0.0 if theta >= period else theta, size=size)

    def local_outline(self, points: int = OUTLINE_POINTS) -> FloatArray:
        """Counter-clockwise vertices in the shape's own frame, (N, 2) in metres, the first not repeated."""
        width, height = self.width_height
        if self.is_round:
            turn = np.linspace(0, 2 * np.pi, points, endpoint=False)
            return np.column_stack((width * np.cos(turn), height * np.sin(turn)))
        if self.kind is Kind.TRIANGLE:
            return np.array([[-width / 2, -height / 3], [width / 2, -height / 3], [0.0, 2 * height / 3]])
        return np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]]) * (width / 2, height / 2)

    def outline(self, points: int = OUTLINE_POINTS) -> FloatArray:
        """Counter-clockwise vertices in the map frame, (N, 2) in metres, the first not repeated."""
        cos, sin = math.cos(self.theta or 0.0), math.sin(self.theta or 0.0)
        outline: FloatArray = self.local_outline(points) @ np.array([[cos, sin], [-sin, cos]])
        outline += self.x, self.y
        return outline

    @property
    def is_round(self) -> bool:
        """Whether the outline is an ellipse or a circle, and no polygon."""
        return self.kind in (Kind.CIRCLE, Kind.ELLIPSE)

    def cast(self, origin: tuple[float, float], directions: FloatArray) -> FloatArray:
        """Exact distances (m) from ``origin`` along unit ``directions`` (N, 2), map frame; inf for a miss.

        From inside the shape it is the distance to its outline.
        """
        if self.is_round:
            return cast_ellipses(origin, directions, np.array([self.as_ellipse()]))
        return cast_segments(origin, directions, self.as_segments())

    def as_ellipse(self) -> tuple[float, float, float, float, float]:
        """A round shape as :func:`prim.raycast.cast_ellipses` takes it."""
        return self.x, self.y, self.theta or 0.0, *self.width_height

    def as_segments(self) -> FloatArray:
        """The edges (M, 4) of a shape with corners as :func:`prim.raycast.cast_segments` takes them."""
        corners = self.outline()
        return np.hstack((corners, np.roll(corners, -1, axis=0)))

    def to_json(self) -> dict[str, Any]:
        """As reports and ``world.json`` hold it."""
        return {"kind": str(self.kind), "x": self.x, "y": self.y, "theta": self.theta, "size": self.sizes}

    @classmethod
    def from_json(cls, value: Mapping[str, Any]) -> Primitive:
        """The inverse of :meth:`to_json`. Raises ValueError that names what is wrong."""
        if not isinstance(value, Mapping):
            raise ValueError(f"{json.dumps(value)} does not describe a primitive")
        try:
            kind = Kind(value["kind"])
            size = value["size"]
            unknown = set(size) - set(SIZE_KEYS[kind])
            if unknown:
                raise ValueError(f"a {kind} has no size {sorted(unknown)[0]!r}")
            theta = None if kind is Kind.CIRCLE else float(value["theta"])
            lengths = tuple(float(size[key]) for key in SIZE_KEYS[kind])
            return cls(kind, float(value["x"]), float(value["y"]), theta, lengths)
        except KeyError as missing:
            raise ValueError(f"{missing.args[0]!r} is missing in {json.dumps(value)}") from None
        except TypeError:
            raise ValueError(f"{json.dumps(value)} does not describe a primitive") from None


def angle_difference(a: float, b: float, period: float = 2 * math.pi) -> float:
    """A - b (rad) modulo ``period``, in [-period/2, period/2)."""
    return (a - b + period / 2) % period - period / 2


def angle_error(estimate: Primitive, truth: Primitive) -> float | None:
    """How far the estimate is turned from the truth (rad, >= 0), modulo the truth's own symmetry.

    None where either has no angle.
    """
    if truth.symmetry is None or estimate.theta is None or truth.theta is None:
        return None
    return abs(angle_difference(estimate.theta, truth.theta, truth.symmetry))
