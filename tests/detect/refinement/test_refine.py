"""Refinement: exact rays give the exact shapes; kinds, standard deviations, rejections, proposals."""

from __future__ import annotations

import math
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st

from detect.detection import Detection, Detections, Rejection
from detect.refinement.candidates import Candidate, find_backgrounds, fit_candidates
from detect.refinement.fitting.evidence import compare_kinds, exact_costs
from detect.refinement.fitting.fit import KindFit, other_apexes, refit, starts
from detect.refinement.likelihood.geometry import JACOBIANS, parameters_of, primitive_of
from detect.refinement.likelihood.kernels import FAR, OCCLUSION
from detect.refinement.likelihood.rays import RayBundle, RayCollector, collect_rays
from detect.refinement.likelihood.sensor_model import (
    BeamModel,
    DistanceMap,
    background_log_likelihood,
    occlusion_by,
    with_background,
)
from detect.refinement.options import DEFAULTS
from detect.refinement.refine import (
    Effort,
    RefinedPrimitive,
    Refinement,
    WarmStart,
    refine_detections,
    rejection_reason,
)
from detect.refinement.surroundings.levels import MapLevels
from detect.refinement.surroundings.lines import find_lines
from detect.refinement.surroundings.map_cells import MapCells, OneSidedWall, is_within
from detect.refinement.surroundings.proposals import propose
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
    """With about the errors of networks."""
    turn = None if primitive.theta is None else primitive.theta + rng.normal(0, 0.1)
    sizes = tuple(size * (1 + rng.normal(0, 0.06)) for size in primitive.size)
    moved = replace(primitive, x=primitive.x + rng.normal(0, 0.006), y=primitive.y + rng.normal(0, 0.006))
    return replace(moved, theta=turn, size=sizes).canonical()


def detection(primitive: Primitive, score: float = 0.8) -> Detection:
    return Detection(primitive, score, (0.0, 0.0, 0.0, 0.0), NO_CROP)


Scans = list[tuple[Scan, Pose2D]]


def refine(
    primitives: list[Primitive], taken: Scans, levels: MapLevels, threads: int = 2, **given: object
) -> tuple[list[RefinedPrimitive | None], float | None]:
    """Refined primitives, and the noise (m)."""
    refinement = Refinement(levels, threads=threads, **given)
    return refinement.run(primitives, taken), refinement.noise_std


@pytest.fixture(scope="module")
def exact() -> tuple[World, Scans, OccupancyGrid]:
    world = room(*FIVE)
    taken = scans(world, 0.0)
    return world, taken, mapped(taken)


@pytest.fixture(scope="module")
def noisy() -> tuple[World, Scans, OccupancyGrid]:
    world = room(*FIVE)
    taken = scans(world, 0.1)
    return world, taken, mapped(taken)


def test_exact_rays_give_the_exact_shapes(exact: tuple[World, Scans, OccupancyGrid]) -> None:
    world, taken, grid = exact
    rng = np.random.default_rng(3)
    refined, _ = refine([disturbed(one, rng) for one in world.primitives], taken, MapLevels.of(grid))
    for made, true in zip(refined, world.primitives, strict=True):
        assert made is not None and made.primitive.kind is true.kind
        assert math.hypot(made.primitive.x - true.x, made.primitive.y - true.y) < 5e-4
        assert made.primitive.size == pytest.approx(true.size, abs=1e-3)
        error = angle_error(made.primitive, true)
        assert error is None or error < math.radians(0.5)


def test_noisy_rays_give_kind_size_noise_and_standard_deviations(
    noisy: tuple[World, Scans, OccupancyGrid],
) -> None:
    world, taken, grid = noisy
    rng = np.random.default_rng(4)
    refined, noise = refine([disturbed(one, rng) for one in world.primitives], taken, MapLevels.of(grid))
    assert noise == pytest.approx(0.1, rel=0.05)
    normal = []
    for made, true in zip(refined, world.primitives, strict=True):
        assert made is not None and made.primitive.kind is true.kind and made.score > 0.5
        assert sum(made.kind_probabilities.values()) == pytest.approx(1.0)
        assert set(made.std) == {"x", "y", *(() if true.theta is None else ("theta",)), *true.kind.sizes}
        normal += [(made.primitive.x - true.x) / made.std["x"], (made.primitive.y - true.y) / made.std["y"]]
        normal += [(made.primitive.size[0] - true.size[0]) / made.std[true.kind.sizes[0]]]
        assert np.sqrt(np.diag(made.covariance)).tolist() == pytest.approx(list(made.std.values()))
    assert 0.4 < np.sqrt(np.mean(np.square(normal))) < 2.0


@pytest.mark.parametrize("guessed", Kind)
@pytest.mark.parametrize("true", FIVE, ids=lambda one: str(one.kind))
def test_the_kind_does_not_depend_on_the_guess(
    true: Primitive, guessed: Kind, exact: tuple[World, Scans, OccupancyGrid]
) -> None:
    """The guess has the right centroid and second moments, any kind, and no angle."""
    world, taken, grid = exact
    at = starts(true, guessed)[0]
    guess = primitive_of(guessed, np.array([true.x, true.y, 0.0, at[3], at[4]]))
    all_of_them = [guess if one is true else one for one in world.primitives]
    refined, _ = refine(all_of_them, taken, MapLevels.of(grid))
    made = refined[world.primitives.index(true)]
    assert made is not None and made.primitive.kind is true.kind
    assert polygon_iou(made.primitive, true) > 0.98


@pytest.mark.parametrize(("kind", "simple"), [(Kind.RECTANGLE, Kind.SQUARE), (Kind.ELLIPSE, Kind.CIRCLE)])
@pytest.mark.parametrize("theta", [0.1, 0.9])
def test_a_fit_of_a_special_case_starts_the_general_kind(kind: Kind, simple: Kind, theta: float) -> None:
    true = replace(shape(kind, theta=theta), size=(0.2, 0.17))
    beams, sensor = beams_of(true)
    guess = KindFit(simple, np.array([0.003, 0.0, theta, 0.19, 0.19]), 0.0, np.eye(JACOBIANS[simple].shape[1]))
    fits = {fit.kind: fit for fit in refit([guess], beams, sensor)}
    assert set(fits) == {kind, simple} and fits[kind].cost < fits[simple].cost - 10
    assert polygon_iou(primitive_of(kind, fits[kind].p), true) > 0.97


def beams_of(true: Primitive) -> tuple[RayBundle, BeamModel]:
    """Its rays in an empty room, with their background."""
    taken = scans(room(true), 0.01)
    (beams,), span, _ = collect_rays(taken, [true], 0.07)
    sensor = BeamModel.create(0.01, span)
    candidate = Candidate(true, beams, MapLevels.of(mapped(taken)).levels[0].cells)
    with ThreadPoolExecutor(1) as pool:
        find_backgrounds(pool, [candidate], is_first=True)
    return candidate.rays_with_background([candidate], sensor), sensor


def test_rough_fits_are_repeated_with_all_rays() -> None:
    true = shape(Kind.SQUARE)
    taken = scans(room(true), 0.05, rays=1500)
    (beams,), span, _ = collect_rays(taken, [true], 0.07)
    sensor = BeamModel.create(0.05, span)
    candidate = Candidate(true, beams, MapLevels.of(mapped(taken)).levels[0].cells)
    with ThreadPoolExecutor(1) as pool:
        find_backgrounds(pool, [candidate], is_first=True)
        for anew in (True, False):
            fit_candidates(pool, [candidate], [anew], sensor)
            assert candidate.is_rough is anew
    (whole,) = refit(candidate.fits[:1], candidate.rays_with_background([candidate], sensor), sensor)[:1]
    assert candidate.fits[0].cost == pytest.approx(whole.cost, abs=3.0)


def test_results_do_not_depend_on_the_number_of_threads(
    noisy: tuple[World, Scans, OccupancyGrid],
) -> None:
    world, taken, grid = noisy
    rng = np.random.default_rng(4)
    guesses = [disturbed(one, rng) for one in world.primitives]
    one, four = (refine(guesses, taken, MapLevels.of(grid), threads=threads)[0] for threads in (1, 4))
    assert [made and made.primitive for made in one] == [made and made.primitive for made in four]
    assert [made and dict(made.std) for made in one] == [made and dict(made.std) for made in four]


def test_false_detections_and_duplicates_are_rejected(
    exact: tuple[World, Scans, OccupancyGrid],
) -> None:
    world, taken, grid = exact
    phantom = detection(Primitive(Kind.CIRCLE, 0.0, -0.6, None, (0.1,)))
    double = detection(replace(world.primitives[0], x=world.primitives[0].x + 0.02), 0.5)
    detections = Detections((*(detection(one) for one in world.primitives), phantom, double), ())
    refined, _ = refine_detections(detections, taken, grid)
    assert sorted(one.primitive.kind for one in refined.found) == sorted(one.kind for one in world.primitives)
    reasons = {(one.kind, one.score): one.reason for one in refined.rejected}
    assert "nats" in reasons[Kind.CIRCLE, 0.8] or "stands in its place" in reasons[Kind.CIRCLE, 0.8]
    assert "a likelier one stands in its place" in reasons[Kind.SQUARE, 0.5]


def test_components_that_the_networks_missed_are_found(
    exact: tuple[World, Scans, OccupancyGrid],
) -> None:
    world, taken, grid = exact
    refined, _ = refine_detections(Detections((), ()), taken, grid)
    assert len(refined.found) == len(world.primitives)
    for true in world.primitives:
        nearest = min(refined.found, key=lambda one: math.hypot(one.primitive.x - true.x, one.primitive.y - true.y))
        assert nearest.primitive.kind is true.kind and polygon_iou(nearest.primitive, true) > 0.97
        assert nearest.std is not None and nearest.crop.size == 0


def test_doubtful_detections_are_decided_by_the_rays(
    exact: tuple[World, Scans, OccupancyGrid],
) -> None:
    world, taken, grid = exact
    rejection = Rejection(Kind.SQUARE, 0.1, -0.5, -0.5, "score 0.10 is below 0.30, the least for a square")
    other = Rejection(Kind.SQUARE, 0.1, 0.0, -0.7, "score 0.10 is below 0.30, the least for a square")
    nothing = Primitive(Kind.SQUARE, 0.0, -0.7, 0.0, (0.1,))
    doubtful = ((detection(world.primitives[0], 0.1), rejection), (detection(nothing, 0.1), other))
    refined, _ = refine_detections(Detections((), (rejection, other), doubtful), taken, grid)
    assert any(polygon_iou(one.primitive, world.primitives[0]) > 0.97 for one in refined.found)
    assert rejection not in refined.rejected and other not in refined.rejected
    judged = [one for one in refined.rejected if "not detected by the networks" in one.reason and one.y == -0.7]
    assert len(judged) == 1 and (judged[0].fitted is None) == ("the rays speak against it" in judged[0].reason)


@pytest.mark.parametrize("kind", [Kind.CIRCLE, Kind.SQUARE, Kind.ELLIPSE])
def test_close_to_a_wall(kind: Kind) -> None:
    """30 mm from it, with noise that fills the gap in the map."""
    one = shape(kind, 0.2, 0.0, 0.0)
    at_wall = replace(one, y=-1.0 + 0.03 + float(-one.outline()[:, 1].min()))
    world = room(at_wall)
    taken = scans(world, 0.2)
    guess = replace(at_wall, y=at_wall.y + 0.01)
    refined, _ = refine([guess], taken, MapLevels.of(mapped(taken)))
    assert refined[0] is not None and refined[0].primitive.kind is kind
    assert polygon_iou(refined[0].primitive, at_wall) > 0.9


@pytest.mark.parametrize("beyond", [0, 1, 3])
def test_beside_a_wall_seen_from_both_sides(beyond: int) -> None:
    """Whatever the share of scans from its other side."""
    one = Primitive(Kind.SQUARE, 0.0, 0.18, 0.0, (0.2,))
    walls = (*room().walls, (-1.0, 0.0, 1.0, 0.0))
    taken = scans(World((2.0, 2.0), (one,), walls), 0.02)
    some = [entry for entry in taken if entry[1].y > 0] + beyond * [entry for entry in taken if entry[1].y < 0]
    refined, _ = refine([one], some, MapLevels.of(mapped(some)))
    assert refined[0] is not None and polygon_iou(refined[0].primitive, one) > 0.97


def test_a_warm_start_keeps_what_was_found(
    exact: tuple[World, Scans, OccupancyGrid],
) -> None:
    world, taken, grid = exact
    before, noise_std = refine_detections(Detections((), ()), taken, grid)
    effort = Effort(WarmStart(before, noise_std))
    after, _ = refine_detections(Detections((detection(world.primitives[0]),), ()), taken, grid, effort=effort)
    assert len(before.found) == len(after.found) == len(world.primitives)


def test_candidates_that_occlude_each_other(exact: tuple[World, Scans, OccupancyGrid]) -> None:
    """Two that stand 40 mm apart."""
    pair = [Primitive(Kind.CIRCLE, 0.0, 0.0, None, (0.1,)), Primitive(Kind.SQUARE, 0.24, 0.0, 0.0, (0.2,))]
    taken = scans(room(*pair), 0.02)
    rng = np.random.default_rng(1)
    refined, _ = refine([disturbed(one, rng) for one in pair], taken, MapLevels.of(mapped(taken)))
    for made, true in zip(refined, pair, strict=True):
        assert made is not None and made.primitive.kind is true.kind and polygon_iou(made.primitive, true) > 0.97


def test_pose_errors_widen_standard_deviations() -> None:
    one = shape(Kind.CIRCLE)
    taken = scans(room(one), 0.01)
    rng = np.random.default_rng(2)
    off = [(scan, Pose2D(p.x + rng.normal(0, 0.02), p.y + rng.normal(0, 0.02), p.theta)) for scan, p in taken]
    sure, unsure = (refine([one], some, MapLevels.of(mapped(some)))[0][0] for some in (taken, off))
    assert sure is not None and unsure is not None
    assert unsure.std["x"] > 3 * sure.std["x"]
    assert abs(unsure.primitive.x - one.x) < 5 * unsure.std["x"]


@pytest.mark.parametrize(
    "ranges",
    [np.full(100, np.nan), np.full(100, np.inf), np.full(100, -np.inf), np.zeros(100), np.full(100, 1e-3)],
    ids=["nan", "no return", "too near", "zero", "below range_min"],
)
def test_scans_without_information(ranges: np.ndarray) -> None:
    one = shape(Kind.SQUARE)
    frame = GridFrame.covering((-1, -1, 1, 1), 0.01)
    grid = OccupancyGrid(frame, np.full(frame.shape, 0.5, np.float32))
    scan = Scan(1, "laser", -math.pi, 2 * math.pi / 100, 0.032, 5.0, ranges.astype(np.float32))
    refined, _ = refine_detections(Detections((detection(one),), ()), [(scan, Pose2D(0.6, 0.0))] * 3, grid)
    assert not refined.found and len(refined.rejected) == 1


def test_a_sensor_with_infinite_range(exact: tuple[World, Scans, OccupancyGrid]) -> None:
    world, taken, grid = exact
    endless = [(replace(scan, range_max=math.inf), pose) for scan, pose in taken]
    refined, noise = refine([world.primitives[0]], endless, MapLevels.of(grid))
    assert refined[0] is not None and refined[0].primitive.kind is Kind.SQUARE and noise is not None
    assert all(math.isfinite(value) and value > 0 for value in refined[0].std.values())


def test_objects_larger_than_any_primitive_are_rejected(
    exact: tuple[World, Scans, OccupancyGrid],
) -> None:
    _, taken, grid = exact
    for size in ((0.69, 0.69), (1.1, 0.9)):
        large = Primitive(Kind.RECTANGLE, 0.0, 0.0, 0.0, size)
        refined, _ = refine_detections(Detections((detection(large),), ()), taken, grid)
        assert all(max(one.primitive.size) < 0.7 for one in refined.found)


def test_nothing_to_refine(exact: tuple[World, Scans, OccupancyGrid]) -> None:
    _, _, grid = exact
    assert refine([], [], MapLevels.of(grid)) == ([], None)
    assert refine(FIVE, [], MapLevels.of(grid)) == ([None] * 5, None)
    frame = GridFrame.covering((-1, -1, 1, 1), 0.01)
    empty = OccupancyGrid(frame, np.full(frame.shape, 0.5, np.float32))
    assert refine_detections(Detections((), ()), [], empty)[0] == Detections((), ())


def test_rays_are_thinned_evenly_by_scans() -> None:
    collector = RayCollector(np.array([[0.0, 0.0]]), np.array([0.3]))
    scan, pose = scans(room(shape(Kind.CIRCLE)), 0.0, rays=2000, stops=3)[0]
    for _ in range(400):
        collector.add(scan, pose)
    kept, limit = collector.bundles()[0], DEFAULTS.rays.max_rays
    assert limit / 2 < len(kept) <= 2 * limit
    assert len(set(np.diff(np.unique(kept.scan)).tolist())) == 1  # evenly: every fourth scan, or the like


def test_background_is_that_of_the_map_and_of_occluders() -> None:
    world = room(shape(Kind.CIRCLE), shape(Kind.SQUARE, 0.5, 0.0))
    taken = scans(world, 0.0)
    (around,), span, _ = collect_rays(taken, [world.primitives[0]], 0.05)
    cells = MapCells.of(mapped(taken))
    sensor = BeamModel.create(0.01, span)
    occupied = cells.without(world.primitives, 0.02)
    background = DistanceMap.of(occupied, cells.frame).background(around)
    by_map = background_log_likelihood(around, background, sensor)
    beams = with_background(around, background, by_map, occlusion_by(around, [world.primitives[1]]), sensor)
    exact = world.cast((0.0, 0.0), np.array([[1.0, 0.0]]))
    assert len(beams) and np.isfinite(beams.rays).all() and exact[0] > 0
    right = exact_costs(Kind.CIRCLE, parameters_of(world.primitives[0])[None], beams, sensor)[0]
    for change in ((0.01, 0, 0, 0, 0), (0, 0, 0, 0.01, 0.01), (0, -0.01, 0, 0, 0)):
        assert (
            exact_costs(Kind.CIRCLE, parameters_of(world.primitives[0])[None] + change, beams, sensor)[0] > right + 50
        )


@given(base=st.floats(0.1, 0.3), share=st.floats(0.85, 1.15), theta=st.floats(0, 6))
def test_other_apexes_give_nearly_the_same_triangle(base: float, share: float, theta: float) -> None:
    leg = base * share
    assume(leg > 0.6 * base)
    one = Primitive(Kind.TRIANGLE, 0.1, 0.2, theta, (base, math.sqrt(leg**2 - base**2 / 4)))
    for p in other_apexes(parameters_of(one)):
        assert polygon_iou(primitive_of(Kind.TRIANGLE, p), one) > 1 - 1.5 * abs(share - 1) - 1e-6


@pytest.mark.parametrize("kind", Kind)
def test_starts_keep_centroid_and_area_moments(kind: Kind) -> None:
    for of in FIVE:
        for p in starts(of, kind):
            assert p[:2].tolist() == [of.x, of.y]
            spread = np.prod(p[3:]) / math.sqrt(np.prod(kind.spread_factors))
            assert spread == pytest.approx(np.prod(of.width_height) / math.sqrt(np.prod(of.kind.spread_factors)))


def test_lines_are_found_longest_first() -> None:
    along = np.arange(0, 2, 0.01)
    rng = np.random.default_rng(0)
    lines = [np.column_stack((along, np.full(200, 0.3))), np.column_stack((np.full(100, 1.0), along[:100]))]
    points = np.concatenate([*lines, rng.uniform(0, 2, (60, 2))])
    (nx, ny, d), (mx, my, e) = find_lines(points, 0.01, 0.5, 4)
    assert abs(ny) == pytest.approx(1, abs=1e-3) and d / ny == pytest.approx(0.3, abs=0.005)
    assert abs(mx) == pytest.approx(1, abs=1e-3) and e / mx == pytest.approx(1.0, abs=0.005)
    assert abs(nx) < 0.02 and abs(my) < 0.02


def test_points_behind_a_wall_are_hidden() -> None:
    wall = OneSidedWall((0.0, 1.0, -1.0), -1.0, 1.0, 0.4)
    behind_it, before_it, beside_it = np.array([[0.0, -1.1]]), np.array([[0.0, -0.9]]), np.array([[1.2, -1.1]])
    assert wall.hides(behind_it, 0.02, 0.0) and not wall.hides(before_it, 0.02, 0.0)
    assert not wall.hides(beside_it, 0.02, 0.0) and wall.hides(beside_it, 0.02, 0.4)


def test_walls_are_large_and_primitives_are_not(
    exact: tuple[World, Scans, OccupancyGrid],
) -> None:
    world, _, grid = exact
    levels = MapLevels.of(grid)
    cells = levels.levels[0].cells
    rows, cols = np.nonzero(cells.occupied)
    points = (np.column_stack((cols + grid.frame.col, rows + grid.frame.row)) + 0.5) * grid.frame.resolution
    near = np.any([is_within(one, points, 0.02) for one in world.primitives], axis=0)
    assert near.any() and not cells.large[rows[near], cols[near]].any()
    assert cells.large[rows[~near], cols[~near]].all()
    assert len(cells.walls) == 4 and not any(cells.is_behind_wall(one) for one in world.primitives)
    assert len(propose(levels, [])) == 5 and propose(levels, world.primitives) == []


def test_reasons_name_the_limit() -> None:
    made = RefinedPrimitive(FIVE[0], {"side": 0.001}, np.eye(4), dict.fromkeys(Kind, 0.2), 3.0, 0.0, 100, 1.0)
    assert "by 3 nats only" in rejection_reason(made)
    assert "in the map alone" in rejection_reason(replace(made, log_ratio=100.0, misfit=2.0))
    assert "not known to within 25%" in rejection_reason(replace(made, log_ratio=100.0, std={"side": 0.06}))
    assert rejection_reason(replace(made, log_ratio=100.0)) == "" and "not wanted" in rejection_reason(None)


def test_pieces_of_a_scan_count_as_one_scan() -> None:
    taken = scans(room(shape(Kind.SQUARE)), 0.0)
    parts = []
    for scan, pose in taken:
        for first in range(0, 240, 60):
            start = scan.angle_min + first * scan.angle_increment
            part = replace(scan, angle_min=start, ranges=scan.ranges[first : first + 60], first_beam=first)
            parts.append((part, pose))
    whole, cut = (collect_rays(of, [shape(Kind.SQUARE)], 0.05)[0][0] for of in (taken, parts))
    assert cut.scan.tolist() == whole.scan.tolist()
    assert cut.rays == pytest.approx(whole.rays)


def test_drifting_poses_widen_standard_deviations() -> None:
    true = shape(Kind.RECTANGLE)
    taken = scans(room(true), 0.02, stops=14)
    drift = 0.012 * np.sin(np.arange(len(taken)) / 12)
    moved = [
        (scan, replace(pose, x=pose.x + off, y=pose.y - off)) for (scan, pose), off in zip(taken, drift, strict=True)
    ]
    grid = mapped(moved)
    (by_stretches,), _ = refine([true], moved, MapLevels.of(grid))
    without_stretches = replace(DEFAULTS, sensor=replace(DEFAULTS.sensor, stretches=()))
    (by_scans_alone,), _ = refine([true], moved, MapLevels.of(grid, without_stretches))
    assert by_stretches is not None and by_scans_alone is not None
    assert all(by_stretches.std[name] > 1.2 * by_scans_alone.std[name] for name in ("x", "y"))


def scans_of_a_front(box: Primitive) -> Scans:
    """Scans of a box in a room from places that see its front (towards -y) alone, with a noise of 20 mm."""
    rng = np.random.default_rng(0)
    made = []
    for k in range(60):
        pose = Pose2D(float(rng.uniform(-0.05, 0.05)), float(rng.uniform(-0.9, -0.5)), float(rng.uniform(-3, 3)))
        scan = Scan(k + 1, "laser", -math.pi, 2 * math.pi / 500, 0.032, 5.0, np.zeros(500, np.float32))
        cos, sin = math.cos(pose.theta), math.sin(pose.theta)
        ranges = room(box).cast((pose.x, pose.y), scan.directions @ np.array([[cos, sin], [-sin, cos]]))
        made.append((replace(scan, ranges=(ranges + rng.normal(0, 0.02, 500)).astype(np.float32)), pose))
    return made


@pytest.mark.parametrize("depth", [0.15, 0.45])
def test_a_side_that_nobody_saw_is_not_known(depth: float) -> None:
    """The posterior of a box's hidden depth is as wide as the prior, and the box is rejected for it."""
    box = Primitive(Kind.RECTANGLE, 0.0, depth / 2, 0.0, (0.3, depth)).canonical()
    taken = scans_of_a_front(box)
    guess = Primitive(Kind.RECTANGLE, 0.01, 0.1, 0.05, (0.29, 0.2))
    (made,), _ = refine([guess], taken, MapLevels.of(mapped(taken)))
    assert made is not None and made.primitive.kind is Kind.RECTANGLE
    along = made.primitive.theta or 0.0
    names = Kind.RECTANGLE.sizes if abs(math.sin(along)) < 0.7 else Kind.RECTANGLE.sizes[::-1]
    assert abs(made.primitive.sizes[names[0]] - 0.3) < 4 * made.std[names[0]] < 0.01
    assert 0.1 < made.std[names[1]] < 0.3
    assert made.kind_probabilities[Kind.SQUARE] > 0.3
    assert "not known to within" in rejection_reason(made)


def test_a_triangle_with_few_rays_may_have_another_apex() -> None:
    """Of a nearly equilateral triangle that few rays meet, the other corners are modes too."""
    true = Primitive(Kind.TRIANGLE, 0.0, 0.0, 0.4, (0.2, 0.177))
    taken = scans(room(true), 0.3, rays=120, stops=5)
    (beams,), span, _ = collect_rays(taken, [true], 0.07)
    sensor = BeamModel.create(0.3, span)
    candidate = Candidate(true, beams, MapLevels.of(mapped(scans(room(true), 0.01))).levels[0].cells)
    with ThreadPoolExecutor(1) as pool:
        find_backgrounds(pool, [candidate], is_first=True)
    beams = candidate.rays_with_background([candidate], sensor)
    guess = KindFit(Kind.TRIANGLE, parameters_of(true), 0.0, np.eye(5))
    modes = [fit for fit in refit([guess], beams, sensor) if fit.kind is Kind.TRIANGLE]
    turns = [(fit.p[2] - modes[0].p[2]) / (2 * math.pi / 3) for fit in modes]
    assert {round(turn) % 3 for turn in turns} == {0, 1, 2}
    posterior = compare_kinds(modes, beams, sensor)
    assert posterior is not None and posterior.std["theta"] > 0.5


def test_rivals_do_not_occlude_each_other() -> None:
    """What would stand in a candidate's place hides none of its rays; what stands before it does."""
    true = shape(Kind.SQUARE)
    taken = scans(room(true), 0.01)
    (beams,), span, _ = collect_rays(taken, [true], 0.07)
    cells = MapLevels.of(mapped(taken)).levels[0].cells
    one, other = Candidate(true, beams, cells), Candidate(replace(true, size=(0.3,)), beams, cells)
    with ThreadPoolExecutor(1) as pool:
        find_backgrounds(pool, [one, other], is_first=True)
    sensor = BeamModel.create(0.01, span)
    assert (one.rays_with_background([one, other], sensor).rays[OCCLUSION] < FAR).any()
    fresh = Candidate(true, beams, cells, background=one.background, rivals=[other])
    alone = fresh.rays_with_background([fresh], sensor).rays[OCCLUSION]
    assert (fresh.rays_with_background([fresh, other], sensor).rays[OCCLUSION] == alone).all()


def test_numbers_grow_with_the_cells_but_for_those_of_the_sensor() -> None:
    large = DEFAULTS.at_scale(5.0)
    assert DEFAULTS.at_scale(1.0) is DEFAULTS
    assert large.rays.reach == 5 * DEFAULTS.rays.reach and large.map.min_wall == 5 * DEFAULTS.map.min_wall
    assert large.fit.coarse.blurs == tuple(5 * blur for blur in DEFAULTS.fit.coarse.blurs)
    assert large.sensor == DEFAULTS.sensor and large.scanner == DEFAULTS.scanner
    assert large.evidence.sizes == DEFAULTS.evidence.sizes and large.contact.touch == DEFAULTS.contact.touch


def test_what_is_smaller_than_what_is_wanted_is_not_possible() -> None:
    """Bounds are meant within a quarter: 0.25 m is possible where 0.3 m is wanted, 0.2 m is not."""
    wanted = replace(DEFAULTS, evidence=replace(DEFAULTS.evidence, sizes=(0.3, 2.0)))
    grid = mapped(scans(room(shape(Kind.SQUARE)), 0.01))
    (beams,), _, _ = collect_rays([], [shape(Kind.SQUARE)], 0.07)
    for side, possible in ((0.25, True), (0.2, False)):
        one = Primitive(Kind.SQUARE, 0.0, 0.0, 0.4, (side,))
        candidate = Candidate(one, beams, MapLevels.of(grid).levels[0].cells, options=wanted)
        assert candidate.is_possible(one) is possible
