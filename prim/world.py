"""The ground truth of a recorded session: primitives, walls and all else, and what a beam without noise measures."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from prim import strict_json
from prim.arrays import FloatArray
from prim.errors import WorldError
from prim.raycast import cast_ellipses, cast_segments
from prim.se2 import MAX_COORDINATE
from prim.shapes import Polygon, Primitive

Wall = tuple[float, float, float, float]
"""A thin wall from (x0, y0) to (x1, y1), metres, map frame."""

Bounds = tuple[float, float, float, float]
"""An axis-aligned rectangle of the map frame: x0, y0, x1, y1 (m), the least x and y first."""


MAX_ITEMS = 10_000
"""A world has no more primitives, no more walls, and no more of other things: each is met by every beam's ray.

Set by hand."""

MAX_VERTICES = 10 * MAX_ITEMS
"""The outlines of all things that are no primitives have no more vertices. Set by hand."""

MAX_NAME = 100
"""Characters of a thing's name; set by hand."""


@dataclass(frozen=True)
class Solid:
    """A solid thing that is no primitive.

    Attributes:
        name: What it is, such as «star» or «wall».
        outline: The vertices (m, map frame) of a simple polygon, counter-clockwise; curves are finely sampled.

    Raises:
        ValueError: The name is empty or long, or the outline is no simple polygon that runs counter-clockwise.
    """

    name: str
    outline: Polygon

    def __post_init__(self) -> None:
        import shapely  # here, so that a replay of a log without such things starts faster

        if not isinstance(self.name, str) or not 0 < len(self.name) <= MAX_NAME:
            raise ValueError(f"a name has 1 to {MAX_NAME} characters, not {strict_json.shown(self.name)}")
        ring = shapely.LinearRing(self.outline) if len(self.outline) > 2 else None
        if ring is None or not shapely.Polygon(ring).is_valid:
            raise ValueError(f"the outline of {strict_json.shown(self.name)} is no simple polygon")
        if not ring.is_ccw:
            raise ValueError(f"the outline of {strict_json.shown(self.name)} does not run counter-clockwise")

    @classmethod
    def of(cls, name: str, vertices: FloatArray) -> Solid:
        """Make a thing from an outline in either direction.

        Args:
            name: What it is.
            vertices: The outline's vertices (N, 2) in m.

        Returns:
            The thing.

        Raises:
            ValueError: The outline is no simple polygon.
        """
        (x, y), (next_x, next_y) = vertices.T, np.roll(vertices, -1, axis=0).T
        clockwise = float((x * next_y - next_x * y).sum()) < 0
        return cls(name, tuple((x, y) for x, y in (vertices[::-1] if clockwise else vertices).tolist()))

    def as_segments(self) -> FloatArray:
        """Return the edges (M, 4) for :func:`prim.raycast.cast_segments`."""
        corners = np.array(self.outline)
        return np.hstack((corners, np.roll(corners, -1, axis=0)))

    def to_json(self) -> dict[str, Any]:
        """Return the thing as ``world.json`` holds it."""
        return {"name": self.name, "outline": [list(vertex) for vertex in self.outline]}

    @classmethod
    def from_json(cls, value: Mapping[str, Any]) -> Solid:
        """Invert :meth:`to_json`; the outline may run in either direction.

        Raises:
            ValueError: The value does not describe such a thing; the message names what is wrong.
        """
        if not isinstance(value, Mapping) or "name" not in value:
            raise ValueError(f"{strict_json.shown(value)} is no object with 'name' and 'outline'")
        vertices = [_numbers(vertex, 2, "a vertex") for vertex in _listed(value, "outline")]
        return cls.of(value["name"], np.array(vertices).reshape(-1, 2))


@dataclass(frozen=True)
class World:
    """Primitives, thin walls and all else on a rectangular floor, in the map frame.

    Attributes:
        size: The floor, along x and y (m), centred on the origin.
        primitives: The primitives.
        walls: The walls.
        clutter: Things that stand about and are no primitives.
        structure: What belongs to the room: thick walls, pilasters, furniture at walls.
    """

    size: tuple[float, float]
    primitives: tuple[Primitive, ...] = ()
    walls: tuple[Wall, ...] = ()
    clutter: tuple[Solid, ...] = ()
    structure: tuple[Solid, ...] = ()

    @property
    def bounds(self) -> Bounds:
        """The floor's extent."""
        width, height = self.size
        return -width / 2, -height / 2, width / 2, height / 2

    def with_walls(self) -> World:
        """Return the same world with a wall along each edge of the floor, and no others."""
        x0, y0, x1, y1 = self.bounds
        return replace(self, walls=((x0, y0, x1, y0), (x1, y0, x1, y1), (x1, y1, x0, y1), (x0, y1, x0, y0)))

    def cast(self, origin: tuple[float, float], directions: FloatArray) -> FloatArray:
        """Compute exact distances along rays to the nearest surface.

        Args:
            origin: Where all rays begin: x, y (m).
            directions: Their unit vectors (N, 2).

        Returns:
            Distances (N,) in m; inf where there is no surface.
        """
        flat = cast_segments(origin, directions, self._segments)
        return np.minimum(flat, cast_ellipses(origin, directions, self._ellipses))

    @property
    def solids(self) -> tuple[Solid, ...]:
        """All that is solid and no primitive: clutter and structure."""
        return self.clutter + self.structure

    @cached_property
    def _segments(self) -> FloatArray:
        edges = [primitive.as_segments() for primitive in self.primitives if not primitive.is_round]
        edges += [solid.as_segments() for solid in self.solids]
        return np.vstack([np.asarray(self.walls, dtype=float).reshape(-1, 4), *edges])

    @cached_property
    def _ellipses(self) -> FloatArray:
        rounds = [primitive.as_ellipse() for primitive in self.primitives if primitive.is_round]
        return np.asarray(rounds, dtype=float).reshape(-1, 5)

    def to_json(self) -> dict[str, Any]:
        """Return the world as the log's attachment ``world.json`` holds it; without keys of what there is none of."""
        value: dict[str, Any] = {
            "size": list(self.size),
            "walls": [list(wall) for wall in self.walls],
            "primitives": [primitive.to_json() for primitive in self.primitives],
        }
        others = {"clutter": self.clutter, "structure": self.structure}
        return value | {key: [solid.to_json() for solid in solids] for key, solids in others.items() if solids}

    @classmethod
    def from_json(cls, value: Mapping[str, Any]) -> World:
        """Invert :meth:`to_json`.

        Raises:
            ValueError: The value does not describe a world; the message names what is wrong.
        """
        if not isinstance(value, Mapping) or "size" not in value:
            raise ValueError("a world is an object with 'size', 'primitives' and 'walls'")
        size = _numbers(value["size"], 2, "size")
        walls = tuple(_numbers(wall, 4, "a wall") for wall in _listed(value, "walls"))
        primitives = tuple(Primitive.from_json(item).canonical() for item in _listed(value, "primitives"))
        clutter, structure = (tuple(map(Solid.from_json, _listed(value, key))) for key in ("clutter", "structure"))
        if min(size) <= 0:
            raise ValueError(f"size {list(size)} is not positive")
        if (vertices := sum(len(solid.outline) for solid in clutter + structure)) > MAX_VERTICES:
            raise ValueError(f"clutter and structure have {vertices:,} vertices, more than {MAX_VERTICES:,}")
        thin = tuple((a, b, c, d) for a, b, c, d in walls)
        return cls((size[0], size[1]), primitives, thin, clutter, structure)

    @classmethod
    def load(cls, path: Path) -> World:
        """Read a world from a JSON file.

        Raises:
            WorldError: The file cannot be read or does not describe a world.
        """
        try:
            return cls.from_json(strict_json.loads(path.read_text(encoding="utf-8")))
        except (UnicodeDecodeError, json.JSONDecodeError) as error:
            raise WorldError(f"{path}: not a world: not a JSON file: {error}") from error
        except OSError as error:
            raise WorldError(f"{path}: cannot read the world: {error.strerror}") from error
        except ValueError as error:
            raise WorldError(f"{path}: not a world: {error}") from error


def _listed(value: Mapping[str, Any], key: str) -> list[Any]:
    items = value.get(key, [])
    if not isinstance(items, list):
        raise ValueError(f"{key} is a list, not {strict_json.shown(items)}")
    if len(items) > MAX_ITEMS:
        raise ValueError(f"{key} has {len(items):,} items, more than {MAX_ITEMS:,}")
    return items


def _numbers(value: Any, count: int, what: str) -> tuple[float, ...]:
    if not isinstance(value, Sequence) or isinstance(value, str) or len(value) != count:
        raise ValueError(f"{what} is {count} numbers, not {strict_json.shown(value)}")
    try:
        numbers = tuple(float(number) for number in value)
    except (TypeError, OverflowError):
        raise ValueError(f"{what} is {count} numbers, not {strict_json.shown(value)}") from None
    if not all(math.isfinite(number) for number in numbers):
        raise ValueError(f"{what} has a number that is not finite: {numbers}")
    if max(map(abs, numbers)) > MAX_COORDINATE:
        raise ValueError(f"{what} reaches farther than {MAX_COORDINATE:g} m: {numbers}")
    return numbers
