"""Drawn worlds as shapely sees them."""

import numpy as np
import shapely

from prim.world import World
from recorder.keywords import recording_options
from recorder.world import OtherGenerators, draw_world


def drawn(seed: int, **keywords: object) -> World:
    options = recording_options(**keywords)  # type: ignore[arg-type]
    rngs = [np.random.default_rng((seed, number)) for number in range(3)]
    return draw_world(rngs[0], options.world, options.placement, OtherGenerators(*rngs[1:]))


def solids(world: World) -> list[shapely.Polygon]:
    return [shapely.Polygon(solid.outline) for solid in world.solids]


def outlines(world: World, points: int = 128) -> list[shapely.Polygon]:
    return [shapely.Polygon(primitive.outline(points)) for primitive in world.primitives]


def walls(world: World) -> shapely.Geometry:
    """Return all that a primitive may stand at."""
    thin = [shapely.LineString([wall[:2], wall[2:]]) for wall in world.walls]
    return shapely.union_all([*thin, *(shapely.Polygon(solid.outline) for solid in world.structure)])
