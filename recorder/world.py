"""Random worlds as the paper draws them (III-B): mixed primitives on a floor of 2 x 2 m, no two overlapping.

Beside them a world may hold clutter: things that are none of the kinds.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import islice
from typing import TypeVar

import numpy as np
import shapely

from prim.arrays import FloatArray
from prim.errors import UsageError
from prim.shapes import Kind, Primitive
from prim.world import Solid, World
from recorder.clutter import draw_thing, put_anywhere

_Drawn = TypeVar("_Drawn")


@dataclass(frozen=True)
class WorldOptions:
    """What a random world holds.

    Attributes:
        size: The floor, along x and y (m).
        kinds: The kinds of primitives that are drawn.
        per_kind: Fewest and most primitives of each kind.
        walls: Whether there is a wall along each edge of the floor.
        clutter: Fewest and most things that are none of the kinds.
    """

    size: tuple[float, float] = (2.0, 2.0)
    kinds: tuple[Kind, ...] = tuple(Kind)
    per_kind: tuple[int, int] = (0, 2)
    walls: bool = True
    clutter: tuple[int, int] = (0, 0)


@dataclass(frozen=True)
class PlacementOptions:
    """How primitives are placed: by rejection sampling; all set by hand.

    Attributes:
        gap: Least distance of primitives and clutter from each other and from the floor's edge (m).
        tries_per_primitive: Places that are tried for one primitive before the world is drawn anew, and for one thing
            of the clutter before another one is drawn.
        things: Things that are drawn for a place in the clutter before the world is drawn anew.
        tries: Places that are tried in all.
    """

    gap: float = 0.03
    tries_per_primitive: int = 200
    things: int = 20
    tries: int = 20_000


DEFAULTS = PlacementOptions()

AMPLE_SPACING = 0.6
"""Primitives that have squares of this side (m) on average find places; set by hand."""


def draw_world(
    rng: np.random.Generator,
    options: WorldOptions,
    placement: PlacementOptions = DEFAULTS,
    clutter_rng: np.random.Generator | None = None,
) -> World:
    """Draw a world: primitives, and then clutter where it finds room among them.

    Args:
        rng: Draws the primitives.
        options: What it holds.
        placement: How all that is drawn is placed.
        clutter_rng: Draws the clutter, so that the primitives are the same without it; None: a child of ``rng``.

    Returns:
        The world.

    Raises:
        UsageError: The primitives, or the clutter, do not fit on the floor.
    """
    clutter_rng = clutter_rng or rng.spawn(1)[0]
    tries = iter(range(placement.tries))
    while True:
        fewest, most = options.per_kind
        kinds = [kind for kind in options.kinds for _ in range(rng.integers(fewest, most, endpoint=True))]
        ground = _Ground(options.size, placement, tries)
        primitives = _place(rng, kinds, ground)
        clutter = None if primitives is None else _scatter(clutter_rng, options.clutter, ground)
        if primitives is not None and clutter is not None:
            world = World(options.size, tuple(primitives), clutter=tuple(clutter))
            return world.with_walls() if options.walls else world
        if next(tries, None) is None:
            width, height = options.size
            others = f" and {options.clutter[1]} of clutter" if options.clutter[1] else ""
            fewer = " or --clutter" if options.clutter[1] else ""
            raise UsageError(
                f"{most} of each of {len(options.kinds)} kinds{others} do not fit on {width:g} x {height:g} m: "
                f"give {_larger_floor(options)} or a smaller --per-kind{fewer}"
            )


def _larger_floor(options: WorldOptions) -> str:
    """Return the option that makes the floor, enlarged in its form, large enough for all that is drawn."""
    width, height = options.size
    most = options.per_kind[1] * len(options.kinds) + options.clutter[1]
    growth = AMPLE_SPACING * math.sqrt(most / (width * height))
    return "--size " + " ".join(f"{math.ceil(max(growth * side, AMPLE_SPACING, side))}" for side in options.size)


class _Ground:
    """The floor, and what stands on it already.

    Args:
        size: The floor, along x and y (m).
        placement: How all is placed.
        tries: Runs out when enough places were tried in all.
    """

    def __init__(self, size: tuple[float, float], placement: PlacementOptions, tries: Iterator[int]) -> None:
        self.size = size
        self.placement = placement
        self._tries = tries
        width, height = size
        floor = shapely.box(-width / 2, -height / 2, width / 2, height / 2)
        self._free = floor.buffer(-placement.gap, join_style="mitre")
        self._outlines: list[shapely.Polygon] = []

    def put(self, draw: Callable[[], _Drawn], outline_of: Callable[[_Drawn], FloatArray]) -> _Drawn | None:
        """Draw something until it stands apart from all else; None where it found no place or no tries are left."""
        gap = self.placement.gap
        for _ in islice(self._tries, self.placement.tries_per_primitive):
            drawn = draw()
            outline = shapely.Polygon(outline_of(drawn))
            if self._free.contains(outline) and all(outline.distance(other) >= gap for other in self._outlines):
                self._outlines.append(outline)
                return drawn
        return None


def _place(rng: np.random.Generator, kinds: Sequence[Kind], ground: _Ground) -> list[Primitive] | None:
    """Draw primitives of these kinds, apart from each other; None where one found no place."""
    placed = []
    for kind in kinds:
        primitive = ground.put(partial(draw_primitive, rng, kind, ground.size), Primitive.outline)
        if primitive is None:
            return None
        placed.append(primitive)
    return placed


def _scatter(rng: np.random.Generator, counts: tuple[int, int], ground: _Ground) -> list[Solid] | None:
    """Draw clutter, apart from all that stands there; None where it found no place."""
    if not counts[1]:
        return []
    scattered: list[Solid] = []
    for _ in range(rng.integers(*counts, endpoint=True)):
        for _ in range(ground.placement.things):
            name, outline = draw_thing(rng)
            placed = ground.put(partial(put_anywhere, rng, outline, ground.size), np.asarray)
            if placed is not None:
                scattered.append(Solid.of(name, placed))
                break
        else:
            return None
    return scattered


def draw_primitive(rng: np.random.Generator, kind: Kind, size: tuple[float, float]) -> Primitive:
    """Draw one primitive: sizes as its kind's row in the table of kinds has it, heading and place uniform.

    Args:
        rng: Draws it.
        kind: Its kind.
        size: The floor, along x and y (m).

    Returns:
        The primitive, its centroid on the floor.
    """
    lengths = kind.row.draw(rng)
    theta = rng.uniform(0, 2 * math.pi) if kind.has_angle else None
    x, y = (rng.uniform(-length / 2, length / 2) for length in size)
    return Primitive(kind, x, y, theta, lengths).canonical()
