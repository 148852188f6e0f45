"""Placement by rejection sampling: apart from walls and from each other, at a wall, or touching."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import islice
from typing import TypeVar

import numpy as np
import shapely

from prim.arrays import FloatArray
from prim.shapes import Primitive
from prim.world import Wall

Drawn = TypeVar("Drawn")


@dataclass(frozen=True)
class PlacementOptions:
    """How primitives and clutter are placed: by rejection sampling; all set by hand.

    Attributes:
        gap: Least distance of primitives and clutter from each other and from walls (m).
        tries_per_primitive: Places that are tried for one primitive before the world is drawn anew, and for one thing
            of the clutter before another one is drawn.
        things: Things that are drawn for a place in the clutter before the world is drawn anew.
        tries: Places that are tried in all.
        worlds: Worlds with clutter or a room that are drawn until all finds its place.
        flush: How often a primitive that touches something, or stands at a wall, has a side parallel to it.
        contact_points: Vertices of a round primitive's outline where contacts are computed: 1.4 µm off at 0.3 m.
    """

    gap: float = 0.03
    tries_per_primitive: int = 200
    things: int = 20
    tries: int = 20_000
    worlds: int = 20
    flush: float = 0.5
    contact_points: int = 1024


DEFAULTS = PlacementOptions()


class Ground:
    """A floor, its walls, and what stands on it already.

    Args:
        size: The floor, along x and y (m).
        structure: Outlines of thick walls and other solid pieces of the room.
        walls: Thin walls within the floor.
        placement: How all is placed.
        tries: Runs out when enough places were tried in all.
    """

    def __init__(
        self,
        size: tuple[float, float],
        structure: Sequence[shapely.Polygon],
        walls: Sequence[Wall],
        placement: PlacementOptions,
        tries: Iterator[int],
    ) -> None:
        self.size = size
        self.placement = placement
        self._tries = tries
        width, height = size
        floor = shapely.box(-width / 2, -height / 2, width / 2, height / 2)
        thin = [shapely.LineString([wall[:2], wall[2:]]) for wall in walls]
        self._room = [*structure, *thin]
        self._walls = shapely.union_all([floor.exterior, *self._room])
        self._free = floor.buffer(-placement.gap, join_style="mitre")
        self._outlines: list[shapely.Polygon] = []

    def put(
        self,
        draw: Callable[[], Drawn],
        outline_of: Callable[[Drawn], FloatArray],
        settle: Callable[[Drawn], Drawn | None] | None = None,
        touches: shapely.Polygon | None = None,
    ) -> Drawn | None:
        """Draw something until it stands apart from all else.

        Args:
            draw: Draws it somewhere on the floor.
            outline_of: Returns the vertices (N, 2) of its outline (m).
            settle: Moves it from a place that is apart from the walls to its final one, or returns None.
            touches: An outline that it need not be apart from.

        Returns:
            What was drawn; None where it found no place or no tries are left.
        """
        gap = self.placement.gap
        for _ in islice(self._tries, self.placement.tries_per_primitive):
            drawn = draw()
            outline = shapely.Polygon(outline_of(drawn))
            if not self._is_apart(outline):
                continue
            if settle is not None:
                settled = settle(drawn)
                if settled is None:
                    continue
                drawn, outline = settled, shapely.Polygon(outline_of(settled))
            if all(outline.distance(other) >= gap for other in self._outlines if other is not touches):
                self._outlines.append(outline)
                return drawn
        return None

    @property
    def latest(self) -> shapely.Polygon:
        """The outline of what was put last."""
        return self._outlines[-1]

    def _is_apart(self, outline: shapely.Polygon) -> bool:
        gap = self.placement.gap
        return self._free.contains(outline) and all(outline.distance(piece) >= gap for piece in self._room)

    def to_wall(self, rng: np.random.Generator, primitive: Primitive, distance: float) -> Primitive | None:
        """Move a primitive towards the nearest wall, every other time with a side parallel to it.

        It goes straight to the wall's nearest point, by which it comes near to no other point of a wall by more.

        Args:
            rng: Draws whether it is turned, and which side.
            primitive: It stands apart from all walls.
            distance: Its final distance from the walls (m).

        Returns:
            It there; None where it has no room to turn.
        """
        if rng.random() < self.placement.flush:
            primitive = turned_to(rng, primitive, self._way(primitive))
            if not self._is_apart(shapely.Polygon(primitive.outline())):
                return None
        way = self._way(primitive)
        length = float(np.hypot(*way))
        return _shifted(primitive, way * (1 - distance / length)) if length > distance else None

    def _way(self, primitive: Primitive) -> FloatArray:
        """Return the shortest way (2,) from a primitive to a wall (m)."""
        return _way(shapely.Polygon(primitive.outline(self.placement.contact_points)), self._walls)


def beside(
    rng: np.random.Generator, primitive: Primitive, other: Primitive, placement: PlacementOptions
) -> Primitive:
    """Move a primitive to where it touches another one: at a point, or every other time along sides where both have.

    It is set down in a random direction and goes straight to the other's nearest point, by which it overlaps nothing
    of it.

    Args:
        rng: Draws direction, heading and sides.
        primitive: What is moved.
        other: What it then touches.
        placement: How it is placed.

    Returns:
        It there.
    """
    direction = rng.uniform(-math.pi, math.pi)
    start, apart = np.array([other.x, other.y]), primitive.bounding_radius + other.bounding_radius + placement.gap
    is_flush = rng.random() < placement.flush
    if is_flush and not other.is_round:
        x0, y0, x1, y1 = other.as_segments()[rng.integers(other.kind.corners)]
        direction = math.atan2(x0 - x1, y1 - y0)  # outwards from a counter-clockwise outline
        start = np.array([x0, y0]) + rng.random() * np.array([x1 - x0, y1 - y0])
    outwards = np.array([math.cos(direction), math.sin(direction)])
    if is_flush:
        primitive = turned_to(rng, primitive, -outwards)
    x, y = start + apart * outwards
    primitive = replace(primitive, x=float(x), y=float(y))
    outlines = (shapely.Polygon(one.outline(placement.contact_points)) for one in (primitive, other))
    return _shifted(primitive, _way(*outlines))


def turned_to(rng: np.random.Generator, primitive: Primitive, direction: FloatArray) -> Primitive:
    """Turn a primitive with sides so that one of them looks in a direction.

    Args:
        rng: Draws which side.
        primitive: The primitive; a round one stays as it is.
        direction: The direction (2,).

    Returns:
        It, turned about its centroid.
    """
    if primitive.is_round or primitive.theta is None:
        return primitive
    x0, y0, x1, y1 = primitive.as_segments()[rng.integers(primitive.kind.corners)]
    turn = math.atan2(direction[1], direction[0]) - math.atan2(x0 - x1, y1 - y0)
    return replace(primitive, theta=primitive.theta + turn).canonical()


def _way(start: shapely.Geometry, end: shapely.Geometry) -> FloatArray:
    """Return the shortest way (2,) from one shape to another (m)."""
    return np.asarray(np.diff(shapely.get_coordinates(shapely.shortest_line(start, end)), axis=0)[0])


def _shifted(primitive: Primitive, way: FloatArray) -> Primitive:
    return replace(primitive, x=float(primitive.x + way[0]), y=float(primitive.y + way[1]))
