"""Random worlds as the paper draws them (III-B): mixed primitives on a floor of 2 x 2 m, no two overlapping."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import islice

import numpy as np
import shapely

from prim.errors import UsageError
from prim.shapes import Kind, Primitive
from prim.world import World


@dataclass(frozen=True)
class WorldOptions:
    """What a random world holds.

    Attributes:
        size: The floor, along x and y (m).
        kinds: The kinds of primitives that are drawn.
        per_kind: Fewest and most primitives of each kind.
        walls: Whether there is a wall along each edge of the floor.
    """

    size: tuple[float, float] = (2.0, 2.0)
    kinds: tuple[Kind, ...] = tuple(Kind)
    per_kind: tuple[int, int] = (0, 2)
    walls: bool = True


@dataclass(frozen=True)
class PlacementOptions:
    """How primitives are placed: by rejection sampling; all set by hand.

    Attributes:
        gap: Least distance of primitives from each other and from the floor's edge (m).
        tries_per_primitive: Places that are tried for one primitive before the world is drawn anew.
        tries: Places that are tried in all.
    """

    gap: float = 0.03
    tries_per_primitive: int = 200
    tries: int = 20_000


DEFAULTS = PlacementOptions()

AMPLE_SPACING = 0.6
"""Primitives that have squares of this side (m) on average find places; set by hand."""


def draw_world(rng: np.random.Generator, options: WorldOptions, placement: PlacementOptions = DEFAULTS) -> World:
    """Draw a world.

    Args:
        rng: Draws it.
        options: What it holds.
        placement: How its primitives are placed.

    Returns:
        The world.

    Raises:
        UsageError: The primitives do not fit on the floor.
    """
    tries = iter(range(placement.tries))
    while True:
        fewest, most = options.per_kind
        kinds = [kind for kind in options.kinds for _ in range(rng.integers(fewest, most, endpoint=True))]
        primitives = _place(rng, kinds, options.size, placement, tries)
        if primitives is not None:
            world = World(options.size, tuple(primitives))
            return world.with_walls() if options.walls else world
        if next(tries, None) is None:
            width, height = options.size
            raise UsageError(
                f"{most} of each of {len(options.kinds)} kinds do not fit on {width:g} x {height:g} m: "
                f"give {_larger_floor(options)} or a smaller --per-kind"
            )


def _larger_floor(options: WorldOptions) -> str:
    """Return the option that makes the floor, enlarged in its form, large enough for all primitives."""
    width, height = options.size
    growth = AMPLE_SPACING * math.sqrt(options.per_kind[1] * len(options.kinds) / (width * height))
    return "--size " + " ".join(f"{math.ceil(max(growth * side, AMPLE_SPACING, side))}" for side in options.size)


def _place(
    rng: np.random.Generator,
    kinds: Sequence[Kind],
    size: tuple[float, float],
    placement: PlacementOptions,
    tries: Iterator[int],
) -> list[Primitive] | None:
    """Draw primitives of these kinds, apart from each other; None where one found no place or no tries are left."""
    placed: list[Primitive] = []
    outlines: list[shapely.Polygon] = []
    gap = placement.gap
    floor = shapely.box(-size[0] / 2, -size[1] / 2, size[0] / 2, size[1] / 2).buffer(-gap, join_style="mitre")
    for kind in kinds:
        for _ in islice(tries, placement.tries_per_primitive):
            primitive = draw_primitive(rng, kind, size)
            outline = shapely.Polygon(primitive.outline())
            if floor.contains(outline) and all(outline.distance(other) >= gap for other in outlines):
                placed.append(primitive)
                outlines.append(outline)
                break
        else:
            return None
    return placed


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
