import math

import numpy as np
import pytest
import shapely
from hypothesis import given, settings
from hypothesis import strategies as st

from prim.se2 import Pose2D
from prim.shapes import Kind, Primitive
from prim.world import World
from recorder.clutter import DEFAULTS, THINGS, cover, draw_thing
from recorder.placement import PlacementOptions
from recorder.simulator import Simulator, SimulatorOptions
from recorder.world import WorldOptions, draw_world
from tests.recorder.drawn import drawn, outlines, solids

SEEDS = st.integers(0, 2**32 - 1)
FEW = settings(max_examples=20, deadline=None)
GAP = PlacementOptions().gap


@FEW
@given(SEEDS)
def test_clutter_is_simple_on_the_floor_and_apart_from_all_else(seed: int) -> None:
    world = drawn(seed, clutter=(3, 6))
    things = solids(world)
    assert 3 <= len(things) <= 6
    everything = things + outlines(world)
    assert all(thing.is_valid and thing.exterior.is_ccw for thing in things)
    floor = shapely.box(*world.bounds)
    assert all(floor.contains(thing) and floor.exterior.distance(thing) >= GAP - 1e-9 for thing in things)
    for index, thing in enumerate(everything):
        assert all(thing.distance(other) >= GAP - 1e-9 for other in everything[:index])


@pytest.mark.parametrize("name", THINGS)
def test_every_thing_is_a_simple_outline_and_mostly_no_primitive(name: str) -> None:
    rng = np.random.default_rng(0)
    drawings = [THINGS[name](rng) for _ in range(20)]
    assert all(shapely.Polygon(outline).is_valid for outline in drawings)
    assert sum(cover(outline) < DEFAULTS.max_cover for outline in drawings) >= 8


def test_things_have_the_sizes_of_kinds_and_no_primitive_covers_them() -> None:
    rng = np.random.default_rng(0)
    things = [draw_thing(rng) for _ in range(300)]
    assert {name for name, _ in things} == set(THINGS)
    across = np.array([np.ptp(outline, axis=0).max() for _, outline in things])
    assert 0.1 <= across.min() < 0.12 and 0.38 < across.max() <= 0.4
    for _, outline in things:
        assert np.hypot(*shapely.get_coordinates(shapely.Polygon(outline).centroid)[0]) < 1e-9
        assert cover(outline) < DEFAULTS.max_cover


@pytest.mark.parametrize("kind", Kind)
@pytest.mark.parametrize("turn", [0.0, 0.4, 2.0, 4.5])
def test_a_primitive_covers_itself(kind: Kind, turn: float) -> None:
    size = (0.1,) if kind.is_tied else (0.1, 0.23)
    primitive = Primitive(kind, 0.3, -0.2, turn if kind.has_angle else None, size).canonical()
    assert cover(primitive.outline()) > 0.999


def test_covers_of_known_shapes() -> None:
    """A regular hexagon, and the disc of the same area about its centre: integrated over one of twelve sectors."""
    turn = np.arange(6) * math.tau / 6
    hexagon = np.column_stack((np.cos(turn), np.sin(turn)))
    bearing = (np.arange(100_000) + 0.5) / 100_000 * math.pi / 6
    edge = math.cos(math.pi / 6) / np.cos(bearing)
    radius = math.sqrt(3 * math.sqrt(3) / 2 / math.pi)
    shared, union = (np.mean(pick(edge, radius) ** 2) for pick in (np.minimum, np.maximum))
    assert cover(hexagon) == pytest.approx(shared / union, abs=2e-3)
    parallelogram = np.array([(0, 0), (1, 0), (1.4, 0.6), (0.4, 0.6)])
    assert 0.7 < cover(parallelogram) < 0.9


@FEW
@given(SEEDS)
def test_ranges_to_clutter_and_structure_are_exact(seed: int) -> None:
    """Against shapely: the distance to the nearest point where a ray meets an outline."""
    world = drawn(seed, clutter=3, per_kind=(0, 1), room="doorways,pilasters", arena=(4, 4))
    rng = np.random.default_rng(seed)
    origin = rng.uniform(-2, 2, 2)
    turn = rng.uniform(-math.pi, math.pi, 30)
    directions = np.column_stack((np.cos(turn), np.sin(turn)))
    rings = [shape.exterior for shape in solids(world) + outlines(world, 4096)]
    lines = [shapely.LineString([wall[:2], wall[2:]]) for wall in world.walls]
    surfaces, start = shapely.union_all([*rings, *lines]), shapely.Point(origin)
    for direction, distance in zip(directions, world.cast(tuple(origin), directions), strict=True):
        ray = shapely.LineString([origin, origin + 9 * direction])
        expected = start.distance(ray.intersection(surfaces))
        assert distance == pytest.approx(expected, abs=1e-5)


@FEW
@given(SEEDS)
def test_the_robot_stands_on_no_clutter(seed: int) -> None:
    world = drawn(seed, clutter=4, per_kind=0)
    simulator, radius = Simulator(world), SimulatorOptions().robot_radius
    rng = np.random.default_rng(seed)
    for x, y in rng.uniform(-0.95, 0.95, (60, 2)):
        room = min(thing.distance(shapely.Point(x, y)) for thing in solids(world))
        if abs(room - radius) > 1e-6:
            assert simulator.warp(Pose2D(x, y)) == (room > radius)
        to_edges = min(thing.exterior.distance(shapely.Point(x, y)) for thing in solids(world))
        expected = min(room, 0.04) if room else -to_edges
        assert simulator.clearance(x, y, 0.04) == pytest.approx(expected, abs=1e-6)


def test_a_driving_robot_does_not_pass_clutter() -> None:
    world = World((2.0, 2.0), clutter=drawn(0, clutter=1).clutter).with_walls()
    (thing,) = world.clutter
    centre = np.mean(thing.outline, axis=0)
    away = 0.5 * -centre / np.hypot(*centre)
    simulator = Simulator(world, movable=True)
    simulator.warp(Pose2D(*(centre + away), math.atan2(*-away[::-1])))
    simulator.drive(0.3, 0.3, 5.0)
    distance = shapely.Polygon(thing.outline).distance(shapely.Point(simulator.pose.x, simulator.pose.y))
    assert distance > SimulatorOptions().robot_radius - 2e-3
    assert simulator.current_world().clutter == world.clutter


def test_clutter_leaves_the_primitives_as_they_are() -> None:
    same = [drawn(seed).primitives == drawn(seed, clutter=3).primitives for seed in range(10)]
    assert sum(same) >= 9  # else the clutter found no room
    assert drawn(1, clutter=3) == drawn(1, clutter=3) != drawn(1, clutter=4)


def test_clutter_has_a_generator_of_its_own_where_none_is_given() -> None:
    worlds = [draw_world(np.random.default_rng(3), WorldOptions(clutter=(n, n))) for n in (0, 2, 2)]
    assert worlds[0].primitives == worlds[1].primitives and worlds[1] == worlds[2]
