"""Primitives that move: judged by recent scans, refined by the scans since, with one id; what stands is untouched."""

from __future__ import annotations

import math
from collections.abc import Sequence
from concurrent.futures import Future
from dataclasses import replace
from itertools import pairwise
from types import ModuleType
from typing import Any

import numpy as np
import pytest

from detect.detection import Detection, Detections, UnknownObject
from detect.refinement.likelihood.rays import collect_rays
from detect.refinement.options import RefinementOptions
from detect.refinement.refine import Effort, refine_detections
from detect.refinement.standing import Verdict, judge_places
from detect.refinement.surroundings.levels import MapLevels
from mapping.grid import OccupancyGrid
from mapping.mapper import make_mapper
from prim.scan import Scan
from prim.se2 import Pose2D
from prim.shapes import Kind, Primitive
from prim.threads import preload
from prim.world import World
from recorder.sensors import Lidar
from recorder.session import SessionOptions, record_session
from recorder.world import WorldOptions
from replay.detection import mixed_places, moved_primitives
from replay.detection.mixed_places import add_disagreement
from replay.detection.moved_primitives import Look, MovedOptions, MovedPrimitives
from replay.detection.refiner import RecentScans
from replay.detection.stage import DetectionResult
from replay.options import ReplayOptions
from replay.pipeline import Pipeline
from replay.viewing.protocol import NullViewer

BOUNDS = (-1.0, -1.0, 1.0, 1.0)
SQUARE = Primitive(Kind.SQUARE, 0.3, 0.2, 0.3, (0.2,))
CIRCLE = Primitive(Kind.CIRCLE, -0.4, 0.3, None, (0.12,))
NOISE = 0.03


def scans_of(*primitives: Primitive, seed: int = 0) -> list[tuple[Scan, Pose2D]]:
    world, lidar, rng = World(BOUNDS, primitives), Lidar(rays=300, noise_std=NOISE), np.random.default_rng(seed)
    poses = [Pose2D(0.7 * math.cos(k), -0.4 + 0.3 * math.sin(k), 0.1 * k) for k in range(12)]
    return [(lidar.measure(world, pose, k, 0.1, rng), pose) for k, pose in enumerate(poses)]


def verdicts(found: list[Primitive], scans: list[tuple[Scan, Pose2D]], slack: float = 0.0) -> list[Verdict]:
    mapper = make_mapper("prob", 0.01, BOUNDS)
    for scan, pose in scans:
        mapper.update(scan, pose)
    box, crop = (0.0, 0.0, 0.0, 0.0), np.zeros((1, 1), np.uint8)
    detections = [Detection(primitive, 1.0, box, crop) for primitive in found]
    return [
        judgement.verdict
        for judgement in judge_places(detections, scans, MapLevels.of(mapper.grid()), NOISE, 2, slack)
    ]


def test_what_stands_is_told_from_what_was_moved_and_what_is_gone() -> None:
    scans = scans_of(SQUARE, CIRCLE)
    assert verdicts([SQUARE, CIRCLE], scans) == [Verdict.STANDS] * 2
    assert verdicts([replace(SQUARE, x=SQUARE.x + 0.03), CIRCLE], scans) == [Verdict.MOVED, Verdict.STANDS]
    turned = replace(SQUARE, theta=0.6)
    assert verdicts([turned], scans) == [Verdict.MOVED]
    away = replace(CIRCLE, x=0.0, y=-0.1)
    assert verdicts([SQUARE, away], scans) == [Verdict.STANDS, Verdict.GONE]


def test_each_primitive_has_the_rays_of_the_scans_since_its_own_stamp() -> None:
    scans = scans_of(SQUARE, CIRCLE)
    (early, late), _, _ = collect_rays(scans, [SQUARE, CIRCLE], 0.03, since=[None, 8])
    assert set(early.scan.tolist()) == {*range(1, 13)} and set(late.scan.tolist()) == {9, 10, 11, 12}


def test_errors_of_poses_are_no_motion() -> None:
    displaced = replace(SQUARE, x=SQUARE.x + 0.03)
    assert verdicts([displaced], scans_of(SQUARE), slack=0.05) == [Verdict.STANDS]


def map_of(scans: Sequence[tuple[Scan, Pose2D]]) -> OccupancyGrid:
    mapper = make_mapper("prob", 0.01, BOUNDS)
    for scan, pose in scans:
        mapper.update(scan, pose)
    return mapper.grid()


def fit_to(scans: list[tuple[Scan, Pose2D]], guess: Primitive) -> Detection:
    wanted = Detections((Detection(guess, 1.0, (0.0, 0.0, 0.0, 0.0), np.zeros((1, 1), np.uint8)),), ())
    closed = RefinementOptions(closed_world=True)  # else what was moved within them is an object of no kind
    refined, _ = refine_detections(
        wanted, scans, map_of(scans), NOISE, effort=Effort(max_proposals=0), options=closed
    )
    return refined.found[0]


def deviations(detection: Detection, truth: Primitive) -> float:
    """Return the error of a detection's place in standard deviations."""
    assert detection.std is not None and detection.covariance is not None
    assert np.sqrt(np.diag(detection.covariance)) == pytest.approx(list(detection.std.values()))
    x, y = detection.primitive.x - truth.x, detection.primitive.y - truth.y
    return max(abs(x) / detection.std["x"], abs(y) / detection.std["y"])


def later(scans: list[tuple[Scan, Pose2D]], first: int) -> list[tuple[Scan, Pose2D]]:
    return [(replace(scan, stamp=first + k), pose) for k, (scan, pose) in enumerate(scans)]


def test_later_scans_that_disagree_with_a_fit_widen_its_error_bars() -> None:
    pushed = replace(SQUARE, x=SQUARE.x + 0.04)
    mixed = [*scans_of(SQUARE)[:8], *later(scans_of(pushed), 8)]
    fit = fit_to(mixed, pushed)
    assert deviations(fit, pushed) > 3
    assert deviations(add_disagreement(fit, mixed, MapLevels.of(map_of(mixed)), NOISE), pushed) < 3
    alike = [*scans_of(SQUARE), *later(scans_of(SQUARE, seed=1), 12)]
    fit = fit_to(alike, SQUARE)
    assert deviations(fit, SQUARE) < 3
    assert add_disagreement(fit, alike, MapLevels.of(map_of(alike)), NOISE) is fit


def test_what_was_pushed_within_the_recent_scans_has_error_bars_that_cover_it() -> None:
    between, end = replace(SQUARE, x=SQUARE.x - 0.1), replace(SQUARE, x=SQUARE.x - 0.14)
    recent = [*later(scans_of(between)[:8], 12), *later(scans_of(end), 20)]
    scans = [*scans_of(SQUARE), *recent]
    grid, before = map_of(scans), fit_to(scans[:12], SQUARE)
    look = Look(Detections((before,), ()), grid, MapLevels.of(grid), NOISE, recent, scans)
    moved = MovedPrimitives(map_of, lambda _: Detections((), ()), (0.0, 0.0))
    (found,) = moved.correct(look, lambda: scans, Effort(max_proposals=0)).found
    assert found.since == 12 and deviations(found, end) < 3
    assert deviations(fit_to(recent, end), end) > 3


def test_objects_of_no_kind_stay_but_where_something_has_moved_to() -> None:
    end = replace(SQUARE, x=SQUARE.x - 0.14)
    scans = [*scans_of(SQUARE), *later(scans_of(end), 12)]
    grid, before = map_of(scans), fit_to(scans[:12], SQUARE)
    far, near = (
        UnknownObject(np.array([[0.0, 0.0], [0.2, 0.0], [0.0, 0.2]]) + place, 0.004, 0.9, "none", {})
        for place in ((-0.9, -0.9), (end.x - 0.1, end.y - 0.1))
    )
    standing, pushed = scans[:12], scans[12:]
    for recent, objects in ((standing, (far, near)), (pushed, (far,))):
        detections = Detections((before,), (), objects=(far, near))
        look = Look(detections, grid, MapLevels.of(grid), NOISE, recent, scans)
        moved = MovedPrimitives(map_of, lambda _: Detections((), ()), (0.0, 0.0))
        assert moved.correct(look, lambda: scans, Effort(max_proposals=0)).objects == objects


def test_what_was_found_and_is_an_object_to_all_scans_is_sought_by_the_recent_ones() -> None:
    """A primitive that was pushed is none of the kinds to scans that show it in two places."""
    end = replace(SQUARE, x=SQUARE.x - 0.14)
    scans = [*scans_of(SQUARE), *later(scans_of(end), 12)]
    grid, before = map_of(scans), fit_to(scans[:12], SQUARE)
    smeared = UnknownObject(np.vstack([SQUARE.outline()[:2], end.outline()[2:]]), 0.004, 0.9, "none", {})
    levels, detected = MapLevels.of(grid), Detections((replace(before, primitive=end),), ())
    first = Look(Detections((before,), ()), grid, levels, NOISE, scans[:12], scans[:12])
    second = Look(Detections((), (), objects=(smeared,)), grid, levels, NOISE, scans[12:], scans)
    for looks, counts in (([first, second], (1, 0)), ([second], (0, 1)), ([first, *[second] * 5], (1, 0))):
        moved = MovedPrimitives(map_of, lambda _: detected, (0.0, 0.0))
        for look in looks:
            answer = moved.correct(look, lambda: scans, Effort(max_proposals=0))
        assert (len(answer.found), len(answer.objects)) == counts
        assert all(one.since == 12 and deviations(one, end) < 4 for one in answer.found)


def test_what_was_lost_is_sought_at_some_looks_alone() -> None:
    grid, before = map_of(scans_of(SQUARE)), fit_to(scans_of(SQUARE), SQUARE)
    levels, recent = MapLevels.of(grid), scans_of()
    maps: list[int] = []

    def watched(scans: Sequence[tuple[Scan, Pose2D]]) -> OccupancyGrid:
        maps.append(len(scans))
        return map_of(scans)

    moved = MovedPrimitives(watched, lambda _: Detections((), ()), (0.0, 0.0), options=MovedOptions(looks=2))
    for found in ((before,), (), (), (), (before,), (before,)):
        look = Look(Detections(found, ()), grid, levels, NOISE, scans_of(SQUARE), [])
        moved.correct(look, lambda: recent, Effort(max_proposals=0))
    assert len(maps) == 2


def test_what_moves_is_refined_and_judged_with_the_options_of_the_replay(monkeypatch: pytest.MonkeyPatch) -> None:
    given = []

    def watched(module: ModuleType, name: str) -> None:
        call = getattr(module, name)

        def watch(*arguments: Any) -> Any:
            options = [one.options if isinstance(one, MapLevels) else one for one in arguments]
            given.append((name, [one.closed_world for one in options if isinstance(one, RefinementOptions)]))
            return call(*arguments)

        monkeypatch.setattr(module, name, watch)

    watched(moved_primitives, "refine_detections")
    watched(moved_primitives, "judge_places")
    watched(mixed_places, "judge_places")
    scans = [*scans_of(SQUARE), *later(scans_of(replace(SQUARE, x=SQUARE.x - 0.14)), 12)]
    grid, before = map_of(scans), fit_to(scans[:12], SQUARE)
    options = RefinementOptions(closed_world=True)
    look = Look(Detections((before,), ()), grid, MapLevels.of(grid, options), NOISE, scans[12:], scans)
    moved = MovedPrimitives(map_of, lambda _: Detections((), ()), (0.0, 0.0), options)
    assert moved.correct(look, lambda: scans, Effort(max_proposals=0)).found
    assert {name for name, _ in given} == {"refine_detections", "judge_places"} and len(given) > 4
    assert all(options == [True] for _, options in given)


def test_recent_scans_are_those_since_the_last_look_and_enough() -> None:
    recent, (scan, pose) = RecentScans(3), scans_of(SQUARE)[0]

    def add(*stamps: int) -> None:
        for stamp in stamps:
            recent.add(replace(scan, stamp=stamp), pose)

    def stamps() -> list[int]:
        return [piece.stamp for piece, _ in recent.pieces()]

    add(0, 1, 2, 3)
    recent.end_look()
    assert stamps() == [0, 1, 2, 3]
    add(4, 5)
    assert stamps() == [0, 1, 2, 3, 4, 5]
    add(6)
    assert stamps() == [4, 5, 6]


class Collector(NullViewer):
    """Collects what was detected at each look."""

    def __init__(self) -> None:
        self.results: list[DetectionResult] = []

    def show_detections(self, mapper: str, position: int, stamp: int, result: DetectionResult) -> None:
        self.results.append(result)


@pytest.fixture(scope="module")
def looks(tmp_path_factory: pytest.TempPathFactory) -> list[DetectionResult]:
    """A session of 30 s in which a robot pushes two of four primitives."""
    path = tmp_path_factory.mktemp("moved") / "moved.mcap"
    world = WorldOptions(per_kind=(0, 1))
    record_session(
        path, SessionOptions(seed=PUSHING_SEED, motion="drive", movable=True, duration=30.0, rate=5.0, world=world)
    )
    collector = Collector()
    Pipeline(path, ReplayOptions(mapper="prob", detect_every=15), collector).run()
    return collector.results


PUSHING_SEED = 8
PUSHED, STANDING = 2, 0
"""Of that session a circle that is pushed by 11 cm in the fourth second, and a square that nothing moves."""


def nearest(result: DetectionResult, k: int) -> tuple[float, int, Detection]:
    truth, found = result.truth[k], result.detections.found
    distances = [math.hypot(one.primitive.x - truth.x, one.primitive.y - truth.y) for one in found]
    index = int(np.argmin(distances))
    return distances[index], result.identities[index].id, found[index]


def test_the_place_of_a_pushed_primitive_follows_within_three_looks(looks: list[DetectionResult]) -> None:
    """As soon as the recent scans show it in one place alone: before, it is none of the kinds."""
    steps = [
        abs(b.truth[PUSHED].x - a.truth[PUSHED].x) + abs(b.truth[PUSHED].y - a.truth[PUSHED].y)
        for a, b in pairwise(looks)
    ]
    first = max(k for k, step in enumerate(steps) if step > 1e-3) + 1
    distances = [nearest(result, PUSHED)[0] for result in looks[first + 2 :]]
    assert max(distances) < 0.04 and np.median(distances) < 0.003
    ids = [nearest(result, PUSHED)[1] for result in looks[first + 2 :]]
    assert len(set(ids)) == 1


def test_a_pushed_primitive_is_refined_by_the_scans_since(looks: list[DetectionResult]) -> None:
    distance, _, detection = nearest(looks[-1], PUSHED)
    assert distance < 0.003 and detection.std is not None
    assert distance < 4 * math.hypot(detection.std["x"], detection.std["y"])


def test_what_stands_beside_it_is_refined_by_all_scans(looks: list[DetectionResult]) -> None:
    first, *later = (result for result in looks if result.detections.found)  # after one scan there are none
    for result in (first, *later):
        distance, identity, detection = nearest(result, STANDING)
        assert distance < 0.003 and detection.since is None and identity == nearest(first, STANDING)[1]
    assert len(later) >= 8


def test_covariances_agree_with_standard_deviations(looks: list[DetectionResult]) -> None:
    for detection in looks[-1].detections.found:
        assert detection.covariance is not None and detection.std is not None
        assert list(detection.std) == list(detection.primitive.kind.parameters)
        assert np.sqrt(np.diag(detection.covariance)) == pytest.approx(list(detection.std.values()))
        assert np.allclose(detection.covariance, detection.covariance.T)
        assert np.linalg.eigvalsh(detection.covariance).min() > 0


def test_errors_of_a_preload_surface_at_its_use() -> None:
    def fail() -> int:
        raise ImportError("no such filter")

    future: Future[int] = preload(fail)
    with pytest.raises(ImportError, match="no such filter"):
        future.result()
    assert preload(lambda: 3).result() == 3
