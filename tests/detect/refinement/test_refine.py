"""Refinement: exact rays lead back to the exact shape; kinds, error bars, contradictions, what was missed."""

from __future__ import annotations

import math
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st

from detect.detection import Detection, Detections, Rejection
from detect.refinement.candidates import Candidate, fit_all, look_behind
from detect.refinement.evidence import exact_costs
from detect.refinement.fit import TIES, Fit, again, other_apexes, primitive_of, starts
from detect.refinement.lines import find_lines
from detect.refinement.map_cells import MapCells, OneSided, is_within
from detect.refinement.proposals import proposals
from detect.refinement.rays import (
    MOST,
    Beams,
    Gatherer,
    Obstacles,
    Sensor,
    backdrop,
    before,
    gather,
    map_says,
    parameters,
)
from detect.refinement.refine import Pace, Refined, contradiction, refine, refine_detections
from mapping.grid import GridFrame, OccupancyGrid
from prim.metrics import polygon_iou
from prim.scan import Scan
from prim.se2 import Pose2D
from prim.shapes import Kind, Primitive, angle_error
from prim.world import World
from tests.detect.refinement.rooms import mapped, room, scans, shape

NO_CROP = np.zeros((0, 0), np.uint8)
FIVE = [
    shape(Kind.SQUARE, -0.5, -0.5),
    shape(Kind.RECTANGLE, 0.5, -0.45, 1.0),
    shape(Kind.CIRCLE, -0.5, 0.5),
    shape(Kind.TRIANGLE, 0.5, 0.5, 2.0),
    shape(Kind.ELLIPSE, 0.0, 0.0, 0.7),
]


def disturbed(primitive: Primitive, rng: np.random.Generator) -> Primitive:
    """About as far off as networks are."""
    turn = None if primitive.theta is None else primitive.theta + rng.normal(0, 0.1)
    sizes = tuple(size * (1 + rng.normal(0, 0.06)) for size in primitive.size)
    moved = replace(primitive, x=primitive.x + rng.normal(0, 0.006), y=primitive.y + rng.normal(0, 0.006))
    return replace(moved, theta=turn, size=sizes).canonical()


def found(primitive: Primitive, score: float = 0.8) -> Detection:
    return Detection(primitive, score, (0.0, 0.0, 0.0, 0.0), NO_CROP)


@pytest.fixture(scope="module")
def exact() -> tuple[World, list[tuple[Scan, Pose2D]], OccupancyGrid]:
    world = room(*FIVE)
    taken = scans(world, 0.0)
    return world, taken, mapped(taken)


@pytest.fixture(scope="module")
def noisy() -> tuple[World, list[tuple[Scan, Pose2D]], OccupancyGrid]:
    world = room(*FIVE)
    taken = scans(world, 0.1)
    return world, taken, mapped(taken)


def test_exact_rays_lead_to_the_exact_shapes(exact: tuple[World, list[tuple[Scan, Pose2D]], OccupancyGrid]) -> None:
    world, taken, grid = exact
    rng = np.random.default_rng(3)
    refined, _ = refine([disturbed(one, rng) for one in world.primitives], taken, MapCells.of(grid))
    for made, true in zip(refined, world.primitives, strict=True):
        assert made is not None and made.primitive.kind is true.kind
        assert math.hypot(made.primitive.x - true.x, made.primitive.y - true.y) < 5e-4
        assert made.primitive.size == pytest.approx(true.size, abs=1e-3)
        error = angle_error(made.primitive, true)
        assert error is None or error < math.radians(0.5)


def test_noisy_rays_tell_kind_size_noise_and_how_sure_all_is(
    noisy: tuple[World, list[tuple[Scan, Pose2D]], OccupancyGrid],
) -> None:
    world, taken, grid = noisy
    rng = np.random.default_rng(4)
    refined, noise = refine([disturbed(one, rng) for one in world.primitives], taken, MapCells.of(grid))
    assert noise == pytest.approx(0.1, rel=0.05)
    normal = []
    for made, true in zip(refined, world.primitives, strict=True):
        assert made is not None and made.primitive.kind is true.kind and made.score > 0.5
        assert sum(made.chances.values()) == pytest.approx(1.0)
        assert set(made.std) == {"x", "y", *(() if true.theta is None else ("theta",)), *true.kind.sizes}
        normal += [(made.primitive.x - true.x) / made.std["x"], (made.primitive.y - true.y) / made.std["y"]]
        normal += [(made.primitive.size[0] - true.size[0]) / made.std[true.kind.sizes[0]]]
        assert np.sqrt(np.diag(made.covariance)).tolist() == pytest.approx(list(made.std.values()))
    assert 0.4 < np.sqrt(np.mean(np.square(normal))) < 2.0


@pytest.mark.parametrize("guessed", Kind)
@pytest.mark.parametrize("true", FIVE, ids=lambda one: str(one.kind))
def test_the_kind_does_not_depend_on_what_it_was_taken_for(
    true: Primitive, guessed: Kind, exact: tuple[World, list[tuple[Scan, Pose2D]], OccupancyGrid]
) -> None:
    """With the others in place; the guess has the right place and spread, and another kind and no angle."""
    world, taken, grid = exact
    at = starts(true, guessed)[0]
    guess = primitive_of(guessed, np.array([true.x, true.y, 0.0, at[3], at[4]]))
    all_of_them = [guess if one is true else one for one in world.primitives]
    refined, _ = refine(all_of_them, taken, MapCells.of(grid))
    made = refined[world.primitives.index(true)]
    assert made is not None and made.primitive.kind is true.kind
    assert polygon_iou(made.primitive, true) > 0.98


@pytest.mark.parametrize(("kind", "simple"), [(Kind.RECTANGLE, Kind.SQUARE), (Kind.ELLIPSE, Kind.CIRCLE)])
@pytest.mark.parametrize("theta", [0.1, 0.9])
def test_what_is_fitted_as_a_special_case_is_fitted_as_the_other_too(kind: Kind, simple: Kind, theta: float) -> None:
    true = replace(shape(kind, theta=theta), size=(0.2, 0.17))
    beams, sensor = beams_of(true)
    guess = Fit(simple, np.array([0.003, 0.0, theta, 0.19, 0.19]), 0.0, np.eye(TIES[simple].shape[1]))
    fits = {fit.kind: fit for fit in again([guess], beams, sensor)}
    assert set(fits) == {kind, simple} and fits[kind].cost < fits[simple].cost - 10
    assert polygon_iou(primitive_of(kind, fits[kind].p), true) > 0.97


def beams_of(true: Primitive) -> tuple[Beams, Sensor]:
    """Its rays in an empty room, with what the map says where they miss it."""
    taken = scans(room(true), 0.01)
    (beams,), span, _ = gather(taken, [true], 0.07)
    sensor = Sensor.of(0.01, span)
    candidate = Candidate(true, beams, MapCells.of(mapped(taken)))
    with ThreadPoolExecutor(1) as pool:
        look_behind(pool, [candidate], candidate.cells, 0.03)
    return candidate.seen_before([candidate], sensor), sensor


def test_fits_to_some_of_the_rays_are_made_again_with_all() -> None:
    true = shape(Kind.SQUARE)
    taken = scans(room(true), 0.05, rays=1500)
    (beams,), span, _ = gather(taken, [true], 0.07)
    sensor = Sensor.of(0.05, span)
    candidate = Candidate(true, beams, MapCells.of(mapped(taken)))
    with ThreadPoolExecutor(1) as pool:
        look_behind(pool, [candidate], candidate.cells, 0.03)
        for anew in (True, False):
            fit_all(pool, [candidate], [anew], sensor)
            assert candidate.rough is anew
    (whole,) = again(candidate.fits[:1], candidate.seen_before([candidate], sensor), sensor)[:1]
    assert candidate.fits[0].cost == pytest.approx(whole.cost, abs=3.0)


def test_any_number_of_threads_gives_the_same(
    noisy: tuple[World, list[tuple[Scan, Pose2D]], OccupancyGrid],
) -> None:
    world, taken, grid = noisy
    rng = np.random.default_rng(4)
    guesses = [disturbed(one, rng) for one in world.primitives]
    one, four = (refine(guesses, taken, MapCells.of(grid), threads=threads)[0] for threads in (1, 4))
    assert [made and made.primitive for made in one] == [made and made.primitive for made in four]
    assert [made and dict(made.std) for made in one] == [made and dict(made.std) for made in four]


def test_a_phantom_is_contradicted_and_a_double_goes(
    exact: tuple[World, list[tuple[Scan, Pose2D]], OccupancyGrid],
) -> None:
    world, taken, grid = exact
    phantom = found(Primitive(Kind.CIRCLE, 0.0, -0.6, None, (0.1,)))
    double = found(replace(world.primitives[0], x=world.primitives[0].x + 0.02), 0.5)
    detections = Detections((*(found(one) for one in world.primitives), phantom, double), ())
    refined, _ = refine_detections(detections, taken, grid)
    assert sorted(one.primitive.kind for one in refined.found) == sorted(one.kind for one in world.primitives)
    reasons = {(one.kind, one.score): one.reason for one in refined.rejected}
    assert "nats" in reasons[Kind.CIRCLE, 0.8] or "stands in its place" in reasons[Kind.CIRCLE, 0.8]
    assert "a likelier one stands in its place" in reasons[Kind.SQUARE, 0.5]


def test_what_the_networks_missed_is_found_in_the_map(
    exact: tuple[World, list[tuple[Scan, Pose2D]], OccupancyGrid],
) -> None:
    world, taken, grid = exact
    refined, _ = refine_detections(Detections((), ()), taken, grid)
    assert len(refined.found) == len(world.primitives)
    for true in world.primitives:
        nearest = min(refined.found, key=lambda one: math.hypot(one.primitive.x - true.x, one.primitive.y - true.y))
        assert nearest.primitive.kind is true.kind and polygon_iou(nearest.primitive, true) > 0.97
        assert nearest.std is not None and nearest.crop.size == 0


def test_what_the_networks_doubted_is_judged_by_the_rays(
    exact: tuple[World, list[tuple[Scan, Pose2D]], OccupancyGrid],
) -> None:
    world, taken, grid = exact
    rejection = Rejection(Kind.SQUARE, 0.1, -0.5, -0.5, "score 0.10 is below 0.30, the least for a square")
    other = Rejection(Kind.SQUARE, 0.1, 0.0, -0.7, "score 0.10 is below 0.30, the least for a square")
    nothing = Primitive(Kind.SQUARE, 0.0, -0.7, 0.0, (0.1,))
    doubtful = ((found(world.primitives[0], 0.1), rejection), (found(nothing, 0.1), other))
    refined, _ = refine_detections(Detections((), (rejection, other), doubtful), taken, grid)
    assert any(polygon_iou(one.primitive, world.primitives[0]) > 0.97 for one in refined.found)
    assert rejection not in refined.rejected and other not in refined.rejected
    judged = [one for one in refined.rejected if "not found, or hardly" in one.reason and one.y == -0.7]
    assert len(judged) == 1 and (judged[0].fitted is None) == ("no ray passes it" in judged[0].reason)


@pytest.mark.parametrize("kind", [Kind.CIRCLE, Kind.SQUARE, Kind.ELLIPSE])
def test_close_to_a_wall(kind: Kind) -> None:
    """30 mm from it, in noise that fills the gap between them in the map."""
    one = shape(kind, 0.2, 0.0, 0.0)
    at_wall = replace(one, y=-1.0 + 0.03 + float(-one.outline()[:, 1].min()))
    world = room(at_wall)
    taken = scans(world, 0.2)
    guess = replace(at_wall, y=at_wall.y + 0.01)
    refined, _ = refine([guess], taken, MapCells.of(mapped(taken)))
    assert refined[0] is not None and refined[0].primitive.kind is kind
    assert polygon_iou(refined[0].primitive, at_wall) > 0.9


@pytest.mark.parametrize("beyond", [0, 1, 3])
def test_beside_a_partition_that_is_seen_from_both_sides(beyond: int) -> None:
    """However often the robot was on its other side."""
    one = Primitive(Kind.SQUARE, 0.0, 0.18, 0.0, (0.2,))
    walls = (*room().walls, (-1.0, 0.0, 1.0, 0.0))
    taken = scans(World((2.0, 2.0), (one,), walls), 0.02)
    some = [entry for entry in taken if entry[1].y > 0] + beyond * [entry for entry in taken if entry[1].y < 0]
    refined, _ = refine([one], some, MapCells.of(mapped(some)))
    assert refined[0] is not None and polygon_iou(refined[0].primitive, one) > 0.97


def test_what_an_earlier_look_found_does_not_vanish(
    exact: tuple[World, list[tuple[Scan, Pose2D]], OccupancyGrid],
) -> None:
    world, taken, grid = exact
    before, noise_std = refine_detections(Detections((), ()), taken, grid)
    pace = Pace((before, noise_std))
    after, _ = refine_detections(Detections((found(world.primitives[0]),), ()), taken, grid, pace=pace)
    assert len(before.found) == len(after.found) == len(world.primitives)


def test_in_the_shadow_of_another(exact: tuple[World, list[tuple[Scan, Pose2D]], OccupancyGrid]) -> None:
    """Two that stand 40 mm apart are told apart, each explained beside the other."""
    pair = [Primitive(Kind.CIRCLE, 0.0, 0.0, None, (0.1,)), Primitive(Kind.SQUARE, 0.24, 0.0, 0.0, (0.2,))]
    taken = scans(room(*pair), 0.02)
    rng = np.random.default_rng(1)
    refined, _ = refine([disturbed(one, rng) for one in pair], taken, MapCells.of(mapped(taken)))
    for made, true in zip(refined, pair, strict=True):
        assert made is not None and made.primitive.kind is true.kind and polygon_iou(made.primitive, true) > 0.97


def test_poses_that_are_off_make_all_less_sure() -> None:
    one = shape(Kind.CIRCLE)
    taken = scans(room(one), 0.01)
    rng = np.random.default_rng(2)
    off = [(scan, Pose2D(p.x + rng.normal(0, 0.02), p.y + rng.normal(0, 0.02), p.theta)) for scan, p in taken]
    sure, unsure = (refine([one], some, MapCells.of(mapped(some)))[0][0] for some in (taken, off))
    assert sure is not None and unsure is not None
    assert unsure.std["x"] > 3 * sure.std["x"]
    assert abs(unsure.primitive.x - one.x) < 5 * unsure.std["x"]


@pytest.mark.parametrize(
    "ranges",
    [np.full(100, np.nan), np.full(100, np.inf), np.full(100, -np.inf), np.zeros(100), np.full(100, 1e-3)],
    ids=["nan", "no return", "too near", "zero", "below range_min"],
)
def test_scans_that_say_nothing(ranges: np.ndarray) -> None:
    one = shape(Kind.SQUARE)
    frame = GridFrame.covering((-1, -1, 1, 1), 0.01)
    grid = OccupancyGrid(frame, np.full(frame.shape, 0.5, np.float32))
    scan = Scan(1, "laser", -math.pi, 2 * math.pi / 100, 0.032, 5.0, ranges.astype(np.float32))
    refined, _ = refine_detections(Detections((found(one),), ()), [(scan, Pose2D(0.6, 0.0))] * 3, grid)
    assert not refined.found and len(refined.rejected) == 1


def test_a_sensor_that_sees_without_end(exact: tuple[World, list[tuple[Scan, Pose2D]], OccupancyGrid]) -> None:
    world, taken, grid = exact
    endless = [(replace(scan, range_max=math.inf), pose) for scan, pose in taken]
    refined, noise = refine([world.primitives[0]], endless, MapCells.of(grid))
    assert refined[0] is not None and refined[0].primitive.kind is Kind.SQUARE and noise is not None
    assert all(math.isfinite(value) and value > 0 for value in refined[0].std.values())


def test_what_is_larger_than_any_primitive_is_none(
    exact: tuple[World, list[tuple[Scan, Pose2D]], OccupancyGrid],
) -> None:
    _, taken, grid = exact
    for size in ((0.69, 0.69), (1.1, 0.9)):
        large = Primitive(Kind.RECTANGLE, 0.0, 0.0, 0.0, size)
        refined, _ = refine_detections(Detections((found(large),), ()), taken, grid)
        assert all(max(one.primitive.size) < 0.7 for one in refined.found)


def test_nothing_to_refine(exact: tuple[World, list[tuple[Scan, Pose2D]], OccupancyGrid]) -> None:
    _, _, grid = exact
    assert refine([], [], MapCells.of(grid)) == ([], None)
    assert refine(FIVE, [], MapCells.of(grid)) == ([None] * 5, None)
    frame = GridFrame.covering((-1, -1, 1, 1), 0.01)
    empty = OccupancyGrid(frame, np.full(frame.shape, 0.5, np.float32))
    assert refine_detections(Detections((), ()), [], empty)[0] == Detections((), ())


def test_rays_are_thinned_where_they_are_too_many() -> None:
    gatherer = Gatherer(np.array([[0.0, 0.0]]), np.array([0.3]))
    scan, pose = scans(room(shape(Kind.CIRCLE)), 0.0, rays=2000, stops=3)[0]
    for _ in range(400):
        gatherer.add(scan, pose)
    kept = gatherer.beams()[0]
    assert MOST / 2 < len(kept) <= 2 * MOST
    assert len(set(np.diff(np.unique(kept.scan)).tolist())) == 1  # evenly: every fourth scan, or the like


def test_behind_a_primitive_stands_what_the_map_and_the_others_say() -> None:
    world = room(shape(Kind.CIRCLE), shape(Kind.SQUARE, 0.5, 0.0))
    taken = scans(world, 0.0)
    (around,), span, _ = gather(taken, [world.primitives[0]], 0.05)
    cells = MapCells.of(mapped(taken))
    sensor = Sensor.of(0.01, span)
    occupied = cells.without(world.primitives, 0.02)
    behind = backdrop(around, Obstacles.of(occupied, cells.frame))
    beams = before(around, behind, map_says(around, behind, sensor), [world.primitives[1]], sensor)
    exact = world.cast((0.0, 0.0), np.array([[1.0, 0.0]]))
    assert len(beams) and np.isfinite(beams.rays).all() and exact[0] > 0
    right = exact_costs(Kind.CIRCLE, parameters(world.primitives[0])[None], beams, sensor)[0]
    for change in ((0.01, 0, 0, 0, 0), (0, 0, 0, 0.01, 0.01), (0, -0.01, 0, 0, 0)):
        assert exact_costs(Kind.CIRCLE, parameters(world.primitives[0])[None] + change, beams, sensor)[0] > right + 50


@given(base=st.floats(0.1, 0.3), share=st.floats(0.85, 1.15), theta=st.floats(0, 6))
def test_other_apexes_tell_much_the_same_triangle(base: float, share: float, theta: float) -> None:
    leg = base * share
    assume(leg > 0.6 * base)
    one = Primitive(Kind.TRIANGLE, 0.1, 0.2, theta, (base, math.sqrt(leg**2 - base**2 / 4)))
    for p in other_apexes(parameters(one)):
        assert polygon_iou(primitive_of(Kind.TRIANGLE, p), one) > 1 - 1.5 * abs(share - 1) - 1e-6


@pytest.mark.parametrize("kind", Kind)
def test_starts_keep_place_and_spread(kind: Kind) -> None:
    for of in FIVE:
        for p in starts(of, kind):
            assert p[:2].tolist() == [of.x, of.y]
            spread = np.prod(p[3:]) / math.sqrt(np.prod(kind.spread_factors))
            assert spread == pytest.approx(np.prod(of.width_height) / math.sqrt(np.prod(of.kind.spread_factors)))


def test_straight_lines_are_found_the_longest_first() -> None:
    along = np.arange(0, 2, 0.01)
    rng = np.random.default_rng(0)
    lines = [np.column_stack((along, np.full(200, 0.3))), np.column_stack((np.full(100, 1.0), along[:100]))]
    points = np.concatenate([*lines, rng.uniform(0, 2, (60, 2))])
    (nx, ny, d), (mx, my, e) = find_lines(points, 0.01, 0.5, 4)
    assert abs(ny) == pytest.approx(1, abs=1e-3) and d / ny == pytest.approx(0.3, abs=0.005)
    assert abs(mx) == pytest.approx(1, abs=1e-3) and e / mx == pytest.approx(1.0, abs=0.005)
    assert abs(nx) < 0.02 and abs(my) < 0.02


def test_what_stands_behind_a_wall_is_told() -> None:
    wall = OneSided((0.0, 1.0, -1.0), -1.0, 1.0)
    behind_it, before_it, beside_it = np.array([[0.0, -1.1]]), np.array([[0.0, -0.9]]), np.array([[1.2, -1.1]])
    assert wall.hides(behind_it, 0.02, 0.0) and not wall.hides(before_it, 0.02, 0.0)
    assert not wall.hides(beside_it, 0.02, 0.0) and wall.hides(beside_it, 0.02, 0.4)


def test_walls_are_large_and_primitives_are_not(
    exact: tuple[World, list[tuple[Scan, Pose2D]], OccupancyGrid],
) -> None:
    world, _, grid = exact
    cells = MapCells.of(grid)
    rows, cols = np.nonzero(cells.occupied)
    points = (np.column_stack((cols + grid.frame.col, rows + grid.frame.row)) + 0.5) * grid.frame.resolution
    near = np.any([is_within(one, points, 0.02) for one in world.primitives], axis=0)
    assert near.any() and not cells.large[rows[near], cols[near]].any()
    assert cells.large[rows[~near], cols[~near]].all()
    assert len(cells.walls) == 4 and not any(cells.is_pierced_by(one) for one in world.primitives)
    assert len(proposals(cells, [])) == 5 and proposals(cells, world.primitives) == []


def test_reasons_name_the_limit() -> None:
    made = Refined(FIVE[0], {"side": 0.001}, np.eye(4), dict.fromkeys(Kind, 0.2), 3.0, 0.0, 100, 1.0)
    assert "by 3 nats only" in contradiction(made)
    assert "in the map alone" in contradiction(replace(made, gain=100.0, misfit=2.0))
    assert "not known to within 25%" in contradiction(replace(made, gain=100.0, std={"side": 0.06}))
    assert contradiction(replace(made, gain=100.0)) == "" and "too large" in contradiction(None)


def test_the_parts_of_a_scan_are_one_scan() -> None:
    taken = scans(room(shape(Kind.SQUARE)), 0.0)
    parts = []
    for scan, pose in taken:
        for first in range(0, 240, 60):
            start = scan.angle_min + first * scan.angle_increment
            part = replace(scan, angle_min=start, ranges=scan.ranges[first : first + 60], first_beam=first)
            parts.append((part, pose))
    whole, cut = (gather(of, [shape(Kind.SQUARE)], 0.05)[0][0] for of in (taken, parts))
    assert cut.scan.tolist() == whole.scan.tolist()
    assert cut.rays == pytest.approx(whole.rays)


def test_poses_that_are_off_for_a_while_make_all_less_sure(monkeypatch: pytest.MonkeyPatch) -> None:
    true = shape(Kind.RECTANGLE)
    taken = scans(room(true), 0.02, stops=14)
    drift = 0.012 * np.sin(np.arange(len(taken)) / 12)
    moved = [
        (scan, replace(pose, x=pose.x + off, y=pose.y - off)) for (scan, pose), off in zip(taken, drift, strict=True)
    ]
    cells = MapCells.of(mapped(moved))
    (told,), _ = refine([true], moved, cells)
    monkeypatch.setattr("detect.refinement.sensor_model.STRETCHES", ())
    (by_scans_alone,), _ = refine([true], moved, cells)
    assert told is not None and by_scans_alone is not None
    assert all(told.std[name] > 1.2 * by_scans_alone.std[name] for name in ("x", "y"))
