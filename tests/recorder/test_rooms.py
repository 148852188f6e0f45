import math

import numpy as np
import pytest
import shapely
from hypothesis import given, settings
from hypothesis import strategies as st

from prim.shapes import Kind
from prim.world import World
from recorder.keywords import recording_options
from recorder.motion import drive, warp
from recorder.placement import PlacementOptions
from recorder.rooms import DEFAULTS, ELEMENTS, SHAPES
from recorder.simulator import Simulator
from recorder.world import draw_primitive
from tests.recorder.drawn import drawn, outlines, solids, walls

SEEDS = st.integers(0, 2**32 - 1)
FEW = settings(max_examples=15, deadline=None)
GAP = PlacementOptions().gap
ROOMS = st.tuples(st.sampled_from(["box", *SHAPES]), st.sets(st.sampled_from([*ELEMENTS]))).map(
    lambda drawn: ",".join((drawn[0], *sorted(drawn[1])))
)
SIZES = st.sampled_from([(3.0, 3.0), (5.0, 3.5), (8.0, 8.0)])


def free_of(world: World) -> shapely.Geometry:
    return shapely.box(*world.bounds).difference(
        shapely.union_all([shapely.Polygon(s.outline) for s in world.structure])
    )


@FEW
@given(SEEDS, ROOMS, SIZES)
def test_structure_is_on_the_floor_and_leaves_the_robot_room(seed: int, room: str, size: tuple[float, float]) -> None:
    world = drawn(seed, room=room, arena=size, per_kind=(0, 1), clutter=(0, 2))
    floor = shapely.box(*world.bounds)
    pieces = [shapely.Polygon(solid.outline) for solid in world.structure]
    assert all(piece.is_valid and floor.buffer(1e-6).contains(piece) for piece in pieces)
    assert all(floor.buffer(1e-6).contains(shapely.LineString([wall[:2], wall[2:]])) for wall in world.walls)
    assert bool(pieces) or len(world.walls) > 4 or room == "box"
    thin = [shapely.LineString([wall[:2], wall[2:]]).buffer(DEFAULTS.robot_room) for wall in world.walls[4:]]
    places = free_of(world).buffer(-DEFAULTS.robot_room).difference(shapely.union_all(thin))
    parts = [part.area for part in shapely.get_parts(places)]
    assert max(parts) >= DEFAULTS.reachable * sum(parts)
    assert free_of(world).area >= DEFAULTS.free_share * floor.area


@FEW
@given(SEEDS, ROOMS)
def test_primitives_and_clutter_stand_in_the_free_apart_from_walls(seed: int, room: str) -> None:
    world = drawn(seed, room=room, arena=(4.0, 4.0), per_kind=(0, 1), clutter=2)
    for outline in outlines(world) + [shapely.Polygon(thing.outline) for thing in world.clutter]:
        assert outline.distance(walls(world)) >= GAP - 1e-9
        assert shapely.box(*world.bounds).contains(outline)


@FEW
@given(SEEDS)
def test_a_round_room_is_round(seed: int) -> None:
    world = drawn(seed, room="round", per_kind=0)
    free = free_of(world)
    x0, y0, x1, y1 = free.bounds
    assert free.area == pytest.approx(np.pi / 4 * (x1 - x0) * (y1 - y0), rel=1e-3)
    assert 1.6 - 1e-6 <= min(x1 - x0, y1 - y0) <= max(x1 - x0, y1 - y0) <= 2 + 1e-6


@FEW
@given(SEEDS)
def test_corridors_and_ls_have_their_areas(seed: int) -> None:
    x0, y0, x1, y1 = free_of(drawn(seed, room="corridor", per_kind=0, arena=(4, 3))).bounds
    assert x1 - x0 == 4 and 0.3 * 3 - 1e-6 <= y1 - y0 <= 0.7 * 3 + 1e-6
    free = free_of(drawn(seed, room="L", per_kind=0))
    assert free.bounds == (-1, -1, 1, 1) and 4 * (1 - 0.36) - 1e-6 <= free.area <= 4 * (1 - 0.09) + 1e-6


def test_rooms_have_what_they_are_asked_for() -> None:
    worlds = [drawn(seed, room="doorways,pilasters,furniture", arena=(4, 4), per_kind=0) for seed in range(40)]
    names = [{solid.name for solid in world.structure} for world in worlds]
    assert all({"pilaster", "cupboard"} <= some <= {"wall", "pilaster", "cupboard"} for some in names)
    thin = [len(world.walls) > 4 for world in worlds]
    assert all(some or "wall" in of for some, of in zip(thin, names, strict=True))
    assert 0.05 < np.mean(thin) < 0.6
    widths = [
        np.ptp(solid.outline, axis=0).max() for world in worlds for solid in world.structure if "cup" in solid.name
    ]
    assert min(widths) >= 0.3 - 1e-6 and max(widths) > 0.9


@pytest.mark.parametrize("room", ["round", "L,doorways", "corridor,furniture"])
def test_the_robot_stays_inside(room: str) -> None:
    world = drawn(3, room=room, arena=(4, 3), per_kind=(0, 1))
    free = free_of(world)
    rng = np.random.default_rng(0)
    driven = drive(Simulator(world), rng, 0.5, 20, 0.3)
    places = [step.pose for step in (*warp(Simulator(world), rng, (8, 8)), *driven)]
    assert len(places) > 30
    assert all(free.contains(shapely.Point(pose.x, pose.y)) for pose in places)


@FEW
@given(SEEDS, st.sampled_from(["box", "round", "doorways"]), st.sampled_from([0.0, 0.03, 0.2]))
def test_primitives_stand_at_walls(seed: int, room: str, gap: float) -> None:
    world = drawn(seed, room=room, at_walls=gap, arena=(4, 4), per_kind=1)
    for primitive in world.primitives:
        outline = shapely.Polygon(primitive.outline(4096))
        assert outline.distance(walls(world)) == pytest.approx(gap, abs=5e-6)
        rounded = 1e-6 * outline.length  # m², what a world kept to micrometres may overlap
        assert outline.intersection(shapely.union_all(solids(world))).area < rounded
        assert outline.difference(shapely.box(*world.bounds)).area < rounded


@FEW
@given(SEEDS)
def test_pairs_touch_without_overlap_and_stand_apart_from_others(seed: int) -> None:
    world = drawn(seed, touching=True, per_kind=(0, 1), arena=(3, 3))
    shapes = outlines(world, 4096)
    for index, shape in enumerate(shapes):
        for other, there in enumerate(shapes[:index]):
            if index % 2 and other == index - 1:
                assert shape.distance(there) < 5e-6 and shape.intersection(there).area < 1e-8
            else:
                assert shape.distance(there) >= GAP - 1e-5


def test_pairs_touch_along_sides_and_at_points() -> None:
    along = []
    for seed in range(40):
        world = drawn(seed, touching=True, kinds="square,rectangle", per_kind=1)
        first, second = outlines(world)
        along.append(first.buffer(1e-6).intersection(second.buffer(1e-6)).length > 0.02)
    assert 0.3 < np.mean(along) < 0.8


def test_a_room_is_drawn_from_its_seed_and_leaves_the_rest_as_it_is() -> None:
    assert drawn(5, room="L,furniture") == drawn(5, room="furniture,L") != drawn(6, room="L,furniture")
    assert recording_options(room="box").world == recording_options().world
    assert recording_options(room=["round", "furniture"]).world.room == ("round", "furniture")


@pytest.mark.parametrize("seed", range(4))
def test_primitives_and_clutter_have_the_sizes_that_are_wanted(seed: int) -> None:
    """From the smallest to the largest, on a floor that holds them; none much thinner than the smallest."""
    world = drawn(seed, sizes=(0.4, 1.5), arena=(9, 9), per_kind=(1, 2), clutter=3)
    extents = [primitive.kind.extent * max(primitive.size) for primitive in world.primitives]
    thinnest = [primitive.kind.extent * min(primitive.size) for primitive in world.primitives]
    assert min(extents) >= 0.4 - 1e-9 and max(extents) <= 1.5 + 1e-9 and min(thinnest) >= 0.8 * 0.4 - 1e-9
    across = [max(np.ptp(np.array(solid.outline), axis=0)) for solid in world.clutter]
    assert len(across) == 3 and all(0.4 / math.sqrt(2) < value < 1.5 * math.sqrt(2) for value in across)


def test_all_scales_are_alike() -> None:
    """As many from 0.05 to 0.5 m as from 0.5 to 5 m."""
    rng = np.random.default_rng(0)
    drawn_ones = [draw_primitive(rng, Kind.CIRCLE, (9.0, 9.0), (0.05, 5.0)) for _ in range(2000)]
    small = np.mean([2 * primitive.size[0] < 0.5 for primitive in drawn_ones])
    assert small == pytest.approx(0.5, abs=0.04)
