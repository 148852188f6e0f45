"""The ground truth of a recorded session: primitives and walls, and what a beam without noise measures."""

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
from prim.shapes import Primitive

Wall = tuple[float, float, float, float]
"""A thin wall from (x0, y0) to (x1, y1), metres, map frame."""

Bounds = tuple[float, float, float, float]
"""An axis-aligned rectangle of the map frame: x0, y0, x1, y1 (m), the least x and y first."""


MAX_ITEMS = 10_000
"""A world has no more primitives, and no more walls: each is met by every beam's ray. Set by hand."""


@dataclass(frozen=True)
class World:
    """Primitives and thin walls on a rectangular floor, in the map frame.

    Attributes:
        size: The floor, along x and y (m), centred on the origin.
        primitives: The primitives.
        walls: The walls.
    """

    size: tuple[float, float]
    primitives: tuple[Primitive, ...] = ()
    walls: tuple[Wall, ...] = ()

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

    @cached_property
    def _segments(self) -> FloatArray:
        edges = [primitive.as_segments() for primitive in self.primitives if not primitive.is_round]
        return np.vstack([np.asarray(self.walls, dtype=float).reshape(-1, 4), *edges])

    @cached_property
    def _ellipses(self) -> FloatArray:
        rounds = [primitive.as_ellipse() for primitive in self.primitives if primitive.is_round]
        return np.asarray(rounds, dtype=float).reshape(-1, 5)

    def to_json(self) -> dict[str, Any]:
        """Return the world as the log's attachment ``world.json`` holds it."""
        return {
            "size": list(self.size),
            "walls": [list(wall) for wall in self.walls],
            "primitives": [primitive.to_json() for primitive in self.primitives],
        }

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
        if min(size) <= 0:
            raise ValueError(f"size {list(size)} is not positive")
        return cls((size[0], size[1]), primitives, tuple((a, b, c, d) for a, b, c, d in walls))

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
