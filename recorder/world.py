"""Random worlds as the paper draws them (III-B): mixed primitives on a floor of 2 x 2 m, no two overlapping.

Beside them a world may hold clutter, things that are none of the kinds, and be another room than a box.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
import shapely

from prim.errors import UsageError
from prim.shapes import Kind, Primitive
from prim.world import Solid, World
from recorder.clutter import draw_thing, put_anywhere
from recorder.placement import DEFAULTS, Ground, PlacementOptions, beside
from recorder.rooms import draw_room


@dataclass(frozen=True)
class WorldOptions:
    """What a random world holds.

    Attributes:
        size: The floor, along x and y (m).
        kinds: The kinds of primitives that are drawn.
        per_kind: Fewest and most primitives of each kind.
        walls: Whether there is a wall along each edge of the floor.
        clutter: Fewest and most things that are none of the kinds.
        room: What the room has beside walls along the floor's edges: names of :mod:`recorder.rooms`.
        at_walls: How far from a wall every primitive stands (m); None: anywhere.
        touching: Whether primitives stand in pairs that touch each other.
        sizes: The smallest and the largest extent of primitives and clutter (m), by their longest side or diameter,
            all scales alike; None: the paper's.
    """

    size: tuple[float, float] = (2.0, 2.0)
    kinds: tuple[Kind, ...] = tuple(Kind)
    per_kind: tuple[int, int] = (0, 2)
    walls: bool = True
    clutter: tuple[int, int] = (0, 0)
    room: tuple[str, ...] = ()
    at_walls: float | None = None
    touching: bool = False
    sizes: tuple[float, float] | None = None


@dataclass(frozen=True)
class OtherGenerators:
    """What draws all of a world but the primitives, so that these are the same without it where it leaves them room.

    Attributes:
        room: Draws the room.
        clutter: Draws the clutter.
    """

    room: np.random.Generator
    clutter: np.random.Generator


THINNEST = 0.8
"""The smallest width of primitives, as a share of their smallest extent: what the paper's ranges come to."""

AMPLE_SPACING = 0.6
"""Primitives that have squares of this side (m) on average find places; set by hand."""

SPACING_OF_SIZES = 2.0
"""The same as a multiple of their largest extent, where one is given: most are smaller."""


def draw_world(
    rng: np.random.Generator,
    options: WorldOptions,
    placement: PlacementOptions = DEFAULTS,
    others: OtherGenerators | None = None,
) -> World:
    """Draw a world: the room, primitives in it, and clutter where it finds room among them.

    Args:
        rng: Draws the primitives.
        options: What it holds.
        placement: How all that is drawn is placed.
        others: Draw the rest; None: children of ``rng``.

    Returns:
        The world.

    Raises:
        UsageError: The primitives, the clutter or the room's elements do not fit on the floor.
    """
    others = others or OtherGenerators(*rng.spawn(2))
    tries = iter(range(placement.tries))
    attempts = placement.worlds if options.room or options.clutter[1] else placement.tries
    for _ in range(attempts):
        fewest, most = options.per_kind
        kinds = [kind for kind in options.kinds for _ in range(rng.integers(fewest, most, endpoint=True))]
        room = draw_room(others.room, options.size, options.room)
        pieces = [shapely.Polygon(solid.outline) for solid in room.structure]
        ground = Ground(options.size, pieces, room.walls, placement, tries)
        primitives = _place(rng, kinds, ground, options)
        clutter = None if primitives is None else _scatter(others.clutter, options, ground)
        if primitives is not None and clutter is not None:
            world = World(options.size, tuple(primitives), (), tuple(clutter), room.structure)
            world = world.with_walls() if options.walls else world
            return replace(world, walls=world.walls + room.walls)
        if next(tries, None) is None:
            break
    raise UsageError(_does_not_fit(options))


def _does_not_fit(options: WorldOptions) -> str:
    width, height = options.size
    clutter = options.clutter[1]
    others = f" and {clutter} of clutter" if clutter else ""
    room = " in such a room" if options.room else ""
    return (
        f"{options.per_kind[1]} of each of {len(options.kinds)} kinds{others} do not fit on {width:g} x {height:g} m"
        f"{room}: give {_larger_floor(options)} or a smaller --per-kind"
    )


def _larger_floor(options: WorldOptions) -> str:
    """Return the option that makes the floor, enlarged in its form, large enough for all that is drawn."""
    width, height = options.size
    most = options.per_kind[1] * len(options.kinds) + options.clutter[1]
    spacing = AMPLE_SPACING if options.sizes is None else SPACING_OF_SIZES * options.sizes[1]
    growth = spacing * math.sqrt(most / (width * height)) * (2 if options.room else 1)
    return "--arena " + " ".join(f"{math.ceil(max(growth * side, spacing, side))}" for side in options.size)


def _place(
    rng: np.random.Generator, kinds: Sequence[Kind], ground: Ground, options: WorldOptions
) -> list[Primitive] | None:
    """Draw primitives of these kinds; None where one found no place."""
    if options.touching:
        return _place_pairs(rng, [kinds[i] for i in rng.permutation(len(kinds))], ground, options.sizes)
    at_walls = options.at_walls
    settle = None if at_walls is None else lambda primitive: ground.to_wall(rng, primitive, at_walls)
    placed = []
    for kind in kinds:
        primitive = ground.put(
            partial(draw_primitive, rng, kind, ground.size, options.sizes), Primitive.outline, settle
        )
        if primitive is None:
            return None
        placed.append(primitive)
    return placed


def _place_pairs(
    rng: np.random.Generator, kinds: Sequence[Kind], ground: Ground, sizes: tuple[float, float] | None
) -> list[Primitive] | None:
    """Draw primitives of which each second one touches the one before it; None where one found no place."""
    placed: list[Primitive] = []
    for index, kind in enumerate(kinds):
        draw = partial(draw_primitive, rng, kind, ground.size, sizes)
        if index % 2:
            primitive = ground.put(
                partial(_draw_beside, rng, draw, placed[-1], ground.placement), Primitive.outline, None, ground.latest
            )
        else:
            primitive = ground.put(draw, Primitive.outline)
        if primitive is None:
            return None
        placed.append(primitive)
    return placed


def _draw_beside(
    rng: np.random.Generator, draw: Callable[[], Primitive], other: Primitive, placement: PlacementOptions
) -> Primitive:
    return beside(rng, draw(), other, placement)


def _scatter(rng: np.random.Generator, options: WorldOptions, ground: Ground) -> list[Solid] | None:
    """Draw clutter, apart from all that stands there; None where it found no place."""
    scattered: list[Solid] = []
    for _ in range(rng.integers(*options.clutter, endpoint=True)):
        for _ in range(ground.placement.things):
            name, outline = draw_thing(rng)
            if options.sizes is not None:
                outline = outline * (_extent(rng, options.sizes) / np.ptp(outline, axis=0).max())
            placed = ground.put(partial(put_anywhere, rng, outline, ground.size), np.asarray)
            if placed is not None:
                scattered.append(Solid.of(name, placed))
                break
        else:
            return None
    return scattered


def _extent(rng: np.random.Generator, sizes: tuple[float, float]) -> float:
    """Draw an extent (m) of which all scales are alike."""
    return math.exp(rng.uniform(math.log(sizes[0]), math.log(sizes[1])))


def _sized(rng: np.random.Generator, kind: Kind, sizes: tuple[float, float]) -> tuple[float, ...]:
    """Draw a kind's sizes (m): proportions as its row has them, of any scale; none much thinner than the smallest."""
    while True:
        lengths = kind.row.draw(rng)
        scale = _extent(rng, sizes) / (kind.extent * max(lengths))
        if scale * kind.extent * min(lengths) >= THINNEST * sizes[0]:
            return tuple(scale * length for length in lengths)


def draw_primitive(
    rng: np.random.Generator, kind: Kind, size: tuple[float, float], sizes: tuple[float, float] | None = None
) -> Primitive:
    """Draw one primitive: sizes as its kind's row in the table of kinds has it, heading and place uniform.

    Args:
        rng: Draws it.
        kind: Its kind.
        size: The floor, along x and y (m).
        sizes: The smallest and the largest extent (m), all scales alike: only the proportions are those of the row.

    Returns:
        The primitive, its centroid on the floor.
    """
    lengths = kind.row.draw(rng) if sizes is None else _sized(rng, kind, sizes)
    theta = rng.uniform(0, 2 * math.pi) if kind.has_angle else None
    x, y = (rng.uniform(-length / 2, length / 2) for length in size)
    return Primitive(kind, x, y, theta, lengths).canonical()
