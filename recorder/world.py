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

GAP = 0.03
"""Primitives keep this far (m) from each other and from the floor's edge."""

_TRIES_PER_PRIMITIVE = 200
_TRIES = 20_000


@dataclass(frozen=True)
class WorldOptions:
    """What a random world holds: ``per_kind`` (fewest, most) primitives of each of ``kinds``, on ``size`` metres."""

    size: tuple[float, float] = (2.0, 2.0)
    kinds: tuple[Kind, ...] = tuple(Kind)
    per_kind: tuple[int, int] = (0, 2)
    walls: bool = True


def draw_world(rng: np.random.Generator, options: WorldOptions) -> World:
    """Draws a world. Raises UsageError where the primitives asked for do not fit on the floor."""
    tries = iter(range(_TRIES))
    while True:
        fewest, most = options.per_kind
        kinds = [kind for kind in options.kinds for _ in range(rng.integers(fewest, most, endpoint=True))]
        primitives = _place(rng, kinds, options.size, tries)
        if primitives is not None:
            world = World(options.size, tuple(primitives))
            return world.walled() if options.walls else world
        if next(tries, None) is None:
            width, height = options.size
            raise UsageError(
                f"{most} of each of {len(options.kinds)} kinds do not fit on {width:g} x {height:g} m: "
                "give a larger --size or a smaller --per-kind"
            )


def _place(
    rng: np.random.Generator, kinds: Sequence[Kind], size: tuple[float, float], tries: Iterator[int]
) -> list[Primitive] | None:
    """Primitives of these kinds, apart from each other; None where one found no place or no ``tries`` are left."""
    placed: list[Primitive] = []
    outlines: list[shapely.Polygon] = []
    floor = shapely.box(-size[0] / 2, -size[1] / 2, size[0] / 2, size[1] / 2).buffer(-GAP, join_style="mitre")
    for kind in kinds:
        for _ in islice(tries, _TRIES_PER_PRIMITIVE):
            primitive = draw_primitive(rng, kind, size)
            outline = shapely.Polygon(primitive.outline())
            if floor.contains(outline) and all(outline.distance(other) >= GAP for other in outlines):
                placed.append(primitive)
                outlines.append(outline)
                break
        else:
            return None
    return placed


def draw_primitive(rng: np.random.Generator, kind: Kind, size: tuple[float, float]) -> Primitive:
    """One primitive of random size, heading and place (its size within the paper's ranges)."""
    lengths = kind.row.draw(rng)
    theta = rng.uniform(0, 2 * math.pi) if kind.has_angle else None
    x, y = (rng.uniform(-length / 2, length / 2) for length in size)
    return Primitive(kind, x, y, theta, lengths).canonical()
