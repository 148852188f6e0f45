"""What a replay gives of objects that are none of the kinds, made by hand: report, table, viewer, picture, API."""

from __future__ import annotations

import json
import math
import os
import signal
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import prim
from detect.detection import OTHER, Detection, Detections, UnknownObject
from detect.detector import Detector
from detect.networks.weights import ModelCard
from detect.refinement import refine
from detect.refinement.options import RefinementOptions
from detect.refinement.other import Alternative
from mapping.grid import OccupancyGrid
from prim import console
from prim.errors import UsageError
from prim.interrupts import Interrupts
from prim.scan import PosedScan
from prim.shapes import Kind, Primitive
from recorder.session import Session
from replay import cli
from replay.api import Result
from replay.detection.refiner import DetectionRefiner
from replay.detection.stage import DetectionResult, TrackIdentity
from replay.options import ReplayOptions
from replay.outputs.found_objects import OBJECT_COLOR
from replay.outputs.picture import draw_picture
from replay.outputs.report import comparison_table, report_json, summary_rows
from replay.pipeline import Pipeline
from replay.result import ReplayResult
from replay.viewer import RerunViewer
from replay.viewing.drawing import closed
from replay.viewing.markdown import detections_markdown
from replay.viewing.protocol import NullViewer, ViewerOptions
from tests.replay.test_viewer import rows_of, timed, value

L_SHAPE = UnknownObject(
    outline=np.add([[0.0, 0.0], [0.3, 0.0], [0.3, 0.1], [0.1, 0.1], [0.1, 0.25], [0.0, 0.25]], (0.4, -0.7)),
    std=0.004,
    score=0.93,
    reason="a free outline explains its rays better by 41 nats",
    kind_probabilities={Kind.TRIANGLE: 0.05, Kind.RECTANGLE: 0.02},
)
JAMB = UnknownObject(
    outline=np.array([[-0.9, 0.8], [-0.8, 0.8], [-0.8, 0.9]]),
    std=0.002,
    score=0.6,
    reason="it is part of something larger",
    kind_probabilities={Kind.SQUARE: 0.4},
)
OBJECTS = (L_SHAPE, JAMB)


class FakeDetector:
    """Detects all primitives, and something more in the first map; ``objects`` are those of each map in turn."""

    card = ModelCard("yolo", "any")

    def __init__(self, session: Session, *objects: Sequence[UnknownObject]) -> None:
        self.session = session
        self.objects = objects
        self.seen = 0

    def detect(self, grid: OccupancyGrid, *others: object) -> Detections:
        transient = [Primitive(Kind.CIRCLE, 0.9, -0.9, None, (0.05,))] if self.seen == 0 else []
        objects = self.objects[min(self.seen, len(self.objects) - 1)]
        self.seen += 1
        primitives = [*self.session.world.primitives, *transient]
        crop = np.full((72, 72), 7, np.uint8)
        found = tuple(Detection(primitive, 0.9, (0.0, 0.0, 0.1, 0.1), crop) for primitive in primitives)
        return Detections(found, (), objects=tuple(objects))


@pytest.fixture
def given_objects(monkeypatch: pytest.MonkeyPatch) -> list[RefinementOptions]:
    """Let refinement find OBJECTS, and give «other» a chance of a tenth in all else; the options it was given."""
    given: list[RefinementOptions] = []
    real = refine.refine_detections

    def refined(*arguments: Any, **named: Any) -> tuple[Detections, float | None]:
        given.append(named.get("options") or arguments[6])
        detections, noise_std = real(*arguments, **named)
        found = tuple(
            replace(
                detection,
                kind_probabilities={kind: 0.9 * chance / sum(chances.values()) for kind, chance in chances.items()},
                other_probability=0.1,
            )
            for detection in detections.found
            if (chances := detection.kind_probabilities)
        )
        return replace(detections, found=found, objects=OBJECTS), noise_std

    monkeypatch.setattr(refine, "refine_detections", refined)
    return given


def detector(monkeypatch: pytest.MonkeyPatch, session: Session, *objects: Sequence[UnknownObject]) -> FakeDetector:
    fake = FakeDetector(session, *objects)
    monkeypatch.setattr(Detector, "load", lambda path, mapper=None, threads=None: fake)
    return fake


def replayed(session: Session, viewer: NullViewer | RerunViewer | None = None, **options: Any) -> list[ReplayResult]:
    chosen = ReplayOptions(**{"refine": False} | options)
    with Interrupts() as interrupts:
        results = Pipeline(session.path, chosen, viewer, interrupts=interrupts).run_each()
    if isinstance(viewer, RerunViewer):
        viewer.finish(results)
    return list(results)


class Collector(NullViewer):
    """Collects what was detected at each look; interrupts the process after some."""

    def __init__(self, looks: int | None = None) -> None:
        self.results: list[DetectionResult] = []
        self.looks = looks

    def show_detections(self, mapper: str, position: int, stamp: int, result: DetectionResult) -> None:
        self.results.append(result)

    def show_scan(self, posed: PosedScan) -> None:
        if self.looks is not None and len(self.results) == self.looks:
            os.kill(os.getpid(), signal.SIGINT)


def test_the_report_lists_objects_beside_the_primitives(
    noisy_session: Session, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Those are never counted as primitives."""
    detector(monkeypatch, noisy_session, ())
    (without,) = replayed(noisy_session)
    detector(monkeypatch, noisy_session, OBJECTS)
    (result,) = replayed(noisy_session)
    report, before = report_json(result), report_json(without)
    assert json.loads(json.dumps(report, allow_nan=False)) == report
    first = len(report["primitives"]) + 1
    assert report["objects"] == [
        {
            "id": first + k,
            "outline": thing.outline.tolist(),
            "std_m": thing.std,
            "score": thing.score,
            "reason": thing.reason,
        }
        for k, thing in enumerate(OBJECTS)
    ]
    assert before["objects"] == [] and set(before) == set(report)
    assert {**report, "objects": [], "timing": {}} == {**before, "timing": {}}
    assert report["errors"]["recall"] == 1


def test_what_is_not_finite_is_null(noisy_session: Session, monkeypatch: pytest.MonkeyPatch) -> None:
    detector(monkeypatch, noisy_session, (replace(L_SHAPE, std=math.inf),))
    (thing,) = report_json(replayed(noisy_session)[0])["objects"]
    assert thing["std_m"] is None


def test_chances_sum_to_one_with_other(noisy_session: Session, given_objects: list[RefinementOptions]) -> None:
    result = prim.replay(noisy_session.path)
    assert result.primitives and [thing.id for thing in result.objects] == [
        len(result.primitives) + 1,
        len(result.primitives) + 2,
    ]
    for found, listed in zip(result.primitives, result.report["primitives"], strict=True):
        assert found.chances is not None and found.chances == listed["chances"]
        assert set(found.chances) <= {*Kind, OTHER} and found.chances["other"] == 0.1
        assert sum(found.chances.values()) == pytest.approx(1)
    for thing in result.objects:
        assert thing.chances["other"] == thing.score
    assert result.objects[1].chances == {"square": 0.4, "other": 0.6}
    assert given_objects == [RefinementOptions()]


def test_without_an_open_world_other_has_no_chance(noisy_session: Session) -> None:
    """Whoever reads the chances finds it there all the same."""
    result = prim.replay(noisy_session.path, closed_world=True)
    assert result.primitives and result.objects == ()
    assert all(found.chances is not None and found.chances["other"] == 0 for found in result.primitives)


def test_ids_are_unique_among_tracks_and_objects(noisy_session: Session, monkeypatch: pytest.MonkeyPatch) -> None:
    """No object has the id that a track has, or had; a transient track had the largest one."""
    detector(monkeypatch, noisy_session, OBJECTS)
    viewer = Collector()
    (result,) = replayed(noisy_session, viewer, detect_every=5)
    assert len(viewer.results) > 3
    known: set[int] = set()
    for look in viewer.results:
        known |= {identity.id for identity in look.identities}
        assert look.object_ids == (max(known) + 1, max(known) + 2)
    report, count = report_json(result), len(noisy_session.world.primitives)
    assert [one["id"] for one in report["primitives"]] == list(range(1, count + 1))
    assert [thing["id"] for thing in report["objects"]] == [count + 2, count + 3]


def test_objects_without_primitives_are_numbered_from_one(
    noisy_session: Session, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(FakeDetector, "detect", lambda fake, *others: Detections((), (), objects=OBJECTS))
    detector(monkeypatch, noisy_session)
    for every in ("end", 10):
        report = report_json(replayed(noisy_session, detect_every=every)[0])
        assert report["primitives"] == [] and [thing["id"] for thing in report["objects"]] == [1, 2]


def test_an_interrupted_replay_has_the_objects_of_its_last_look(
    noisy_session: Session, monkeypatch: pytest.MonkeyPatch
) -> None:
    detector(monkeypatch, noisy_session, (), OBJECTS, (JAMB,))
    (result,) = replayed(noisy_session, Collector(2), detect_every=4)
    report = report_json(result)
    assert report["interrupted"] is True and len(report["objects"]) == 2


def test_there_are_none_without_refinement_or_detection(noisy_session: Session) -> None:
    for options in ({"refine": False}, {"detect": False}):
        result = prim.replay(noisy_session.path, mapper="forward", **options)  # type: ignore[arg-type]
        assert result.report["objects"] == [] and result.objects == ()


def test_each_mapper_has_its_own(noisy_session: Session, monkeypatch: pytest.MonkeyPatch) -> None:
    detector(monkeypatch, noisy_session, OBJECTS, (), (JAMB,))
    results = replayed(noisy_session, mapper="det,prob,forward", detect_every="end")
    assert [len(report_json(result)["objects"]) for result in results] == [2, 0, 1]
    names, _, *rows = comparison_table(results)
    assert [row[names.index("objects")] for row in rows] == ["2", "", "1"]
    assert "objects" not in comparison_table(results[1:2])[0]


def test_the_table_counts_them(noisy_session: Session, monkeypatch: pytest.MonkeyPatch) -> None:
    detector(monkeypatch, noisy_session, OBJECTS)
    (result,) = replayed(noisy_session)
    rows = summary_rows(result)
    assert dict(rows)["objects"] == "2 of no kind"
    assert [name for name, _ in rows].index("objects") == [name for name, _ in rows].index("primitives") + 1
    detector(monkeypatch, noisy_session, ())
    assert "objects" not in dict(summary_rows(replayed(noisy_session)[0]))


def test_reasons_are_printed_with_verbose(
    noisy_session: Session, monkeypatch: pytest.MonkeyPatch, in_tmp: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    detector(monkeypatch, noisy_session, OBJECTS)
    number = len(noisy_session.world.primitives) + 2  # the transient one is found in the first map
    for options, wanted in ((["--verbose"], True), ([], False)):
        command = [str(noisy_session.path), "--no-refine", "--no-viewer", *options]
        detector(monkeypatch, noisy_session, OBJECTS)
        assert console.run(cli.app, "prim-replay", command) == 0
        seen = capsys.readouterr()
        line = f"no kind: object {number} at (0.55, -0.57) m, score 0.93: {L_SHAPE.reason}\n"
        assert (line in seen.err) == wanted
        assert "2 of no kind" in seen.out


def test_they_are_drawn_at_each_look_and_removed_when_they_are_gone(
    noisy_session: Session, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    detector(monkeypatch, noisy_session, (L_SHAPE,), OBJECTS, ())
    viewer = RerunViewer(ViewerOptions(save=tmp_path / "a.rrd"), announce=print)
    replayed(noisy_session, viewer, mapper="prob", detect_every=8)
    rows = rows_of(tmp_path / "a.rrd")
    outlines, labels, tables = (
        timed(rows[f"/{path}"]) for path in ("map/objects", "map/objects/labels", "detections")
    )
    looks = [row["scan"] for row in timed(rows["/map/detections"])]
    assert [row["scan"] for row in outlines] == [row["scan"] for row in labels] == looks
    assert [len(value(row, "strips")) for row in outlines] == [1, 2, 0, 0]
    drawn = np.array(value(outlines[0], "strips")[0])
    assert drawn[:, :2] == pytest.approx(closed(L_SHAPE.outline), abs=1e-6)
    red, green, blue = OBJECT_COLOR
    assert value(outlines[1], "colors") == [(red << 24) + (green << 16) + (blue << 8) + 255]
    first = len(noisy_session.world.primitives) + 2
    assert [value(row, "labels") for row in labels] == [
        [f"{first}: other 0.93"], [f"{first}: other 0.93", f"{first + 1}: other 0.60"], [], []
    ]  # fmt: skip
    texts = [value(row, "text")[0] for row in tables]
    assert [text.count("| other |") for text in texts] == [1, 2, 0, 0]


def test_they_lie_under_their_mapper(noisy_session: Session, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    detector(monkeypatch, noisy_session, OBJECTS, (JAMB,))
    viewer = RerunViewer(ViewerOptions(save=tmp_path / "a.rrd"), announce=print)
    replayed(noisy_session, viewer, mapper="det,prob", detect_every="end")
    rows = rows_of(tmp_path / "a.rrd")
    counts = {mapper: len(value(timed(rows[f"/{mapper}/map/objects"])[-1], "strips")) for mapper in ("det", "prob")}
    assert counts == {"det": 2, "prob": 1}


def test_the_table_of_detections_lists_them() -> None:
    square = Primitive(Kind.SQUARE, 0.0, 0.0, 0.0, (0.2,))
    found = Detection(square, 0.9, (0, 0, 0, 0), np.zeros((0, 0), np.uint8))
    detections = Detections((found,), (), objects=OBJECTS)
    result = DetectionResult(detections, (TrackIdentity(3),), object_ids=(7, 8))
    primitives, objects = detections_markdown(result).split("\n\n")
    assert len(primitives.splitlines()) == 3
    assert objects.splitlines() == [
        "| id | kind | score | x, mm | y, mm | extent, mm | ± 1σ, mm | reason |",
        "|" + "---|" * 8,
        f"| 7 | other | 0.93 | 550.0 | -575.0 | 300 x 250 | 4.00 | {L_SHAPE.reason} |",
        f"| 8 | other | 0.60 | -850.0 | 850.0 | 100 x 100 | 2.00 | {JAMB.reason} |",
    ]
    without = replace(result, detections=replace(detections, objects=()), object_ids=())
    assert detections_markdown(without) == f"{primitives}\n"


@pytest.fixture
def result(noisy_session: Session, given_objects: list[RefinementOptions]) -> Result:
    return prim.replay(noisy_session.path)


def test_the_api_has_them(result: Result, tmp_path: Path) -> None:
    first, second = result.objects
    assert isinstance(first, prim.FoundObject) and first.id == len(result.primitives) + 1
    assert (first.x, first.y) == pytest.approx((0.55, -0.575)) and first.extent == pytest.approx((0.3, 0.25))
    assert (first.std, first.score, first.reason) == (0.004, 0.93, L_SHAPE.reason)
    assert np.array_equal(second.outline, JAMB.outline)
    assert repr(result).startswith(f"Result({len(result.primitives)} primitives and 2 objects of no kind in 220")
    rows = result.table().to_pylist()
    assert [row["id"] for row in rows] == [found.id for found in result.primitives]
    assert all(row["chance_other"] == 0.1 for row in rows)
    (report,) = (path for path in result.save(tmp_path) if path.name.endswith(".json"))
    assert [thing["id"] for thing in json.loads(report.read_text())["objects"]] == [first.id, second.id]


def test_the_picture_shows_them_in_grey(result: Result) -> None:
    with_objects, without = result.plot().pixels, draw_picture(result.grid, result.primitives, result.truth).pixels
    rows, cols, _ = with_objects.shape
    x0, y0, x1, y1 = result.grid.frame.bounds
    for start, end in zip(L_SHAPE.outline, np.roll(L_SHAPE.outline, -1, axis=0), strict=True):
        x, y = (start + end) / 2
        col, row = round((x - x0) / (x1 - x0) * cols), round((y1 - y) / (y1 - y0) * rows)
        assert tuple(with_objects[row, col]) == OBJECT_COLOR, "an edge"
    assert not np.array_equal(with_objects, without) and with_objects.shape == without.shape


def test_a_guess_that_is_likeliest_none_of_the_kinds_is_none(
    quiet_session: Session, monkeypatch: pytest.MonkeyPatch
) -> None:
    grid, scans = prim.replay(quiet_session.path, detect=False).grid, list(prim.posed_scans(quiet_session.path))
    guesses = quiet_session.world.primitives[:2]
    run, alternative = refine.Refinement.run, Alternative(L_SHAPE.outline, 9.0, 0.004, L_SHAPE.reason)

    def unsure(*arguments: Any) -> list[refine.RefinedPrimitive | None]:
        return [
            found and replace(found, other_probability=other, alternative=alternative)
            for found, other in zip(run(*arguments), (0.7, 0.2), strict=True)
        ]

    monkeypatch.setattr(refine.Refinement, "run", unsure)
    first, second = prim.refine(guesses, scans, grid)
    assert first is None and second is not None and second.id == 2
    assert second.chances is not None and second.chances["other"] == 0.2


@pytest.mark.parametrize("closed_world", [False, True])
def test_a_closed_world_reaches_refinement(
    noisy_session: Session, monkeypatch: pytest.MonkeyPatch, in_tmp: Path, closed_world: bool
) -> None:
    """Of a replay, with detections along the way and what moves, and of guesses."""
    wanted = replace(RefinementOptions(), closed_world=closed_world)
    refiners: list[RefinementOptions] = []
    moved: list[RefinementOptions] = []
    monkeypatch.setattr(
        DetectionRefiner,
        "_refine",
        lambda refiner, detections, *others: refiners.append(refiner._refinement) or (detections, 0.05),
    )
    monkeypatch.setattr(
        "replay.detection.moved_primitives.MovedPrimitives.correct",
        lambda self, look, *others: moved.append(self._refinement) or look.detections,
    )
    command = [str(noisy_session.path), "--quiet", "--no-viewer", "--detect-every", "10"]
    assert console.run(cli.app, "prim-replay", command + closed_world * ["--closed-world"]) == 0
    prim.replay(noisy_session.path, closed_world=closed_world)
    assert len(refiners) == 5 and refiners == [wanted] * 5
    assert len(moved) == 4 and moved == [wanted] * 4
    run: list[RefinementOptions] = []
    monkeypatch.setattr(
        refine.Refinement, "run", lambda self, guesses, scans: run.append(self.options) or [None] * len(guesses)
    )
    grid = prim.replay(noisy_session.path, detect=False).grid
    assert prim.refine(noisy_session.world.primitives[:1], [], grid, closed_world=closed_world) == [None]
    assert run == [wanted]


def test_a_closed_world_without_refinement_is_refused(
    noisy_session: Session, in_tmp: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for option in ("--no-detect", "--no-refine"):
        assert console.run(cli.app, "prim-replay", [str(noisy_session.path), "--closed-world", option]) == 2
        assert "--closed-world is for refinement: it excludes --no-detect and --no-refine" in capsys.readouterr().err
    with pytest.raises(
        UsageError, match=r"^closed_world=True is for refinement: it excludes detect=False and refine="
    ):
        prim.replay(noisy_session.path, closed_world=True, refine=False)
    with pytest.raises(UsageError, match="closed_world is 'no': it must be True or False"):
        prim.refine([], [], prim.replay(noisy_session.path, detect=False).grid, closed_world="no")  # type: ignore[arg-type]


def test_the_frame_of_the_map_adds_to_the_uncertainty_of_an_outline(monkeypatch: pytest.MonkeyPatch) -> None:
    """Its place as much as its turn, which counts by the distance from the frame's origin."""

    def std_of(thing: UnknownObject, *variances: float) -> float:
        refiner = DetectionRefiner(None, lambda x, y: np.diag(variances))
        refiner._refine = lambda *arguments: (Detections((), (), objects=(thing,)), None)  # type: ignore[method-assign]
        detections, _ = refiner.refine(Detections((), ()), grid, list)
        return detections.objects[0].std

    grid = prim.make_mapper("det", bounds=(0, 0, 0.1, 0.1)).grid()
    far = replace(JAMB, outline=np.array([[30.0, 40.0], [30.001, 40.0], [30.0, 40.001]]), std=0.003)
    assert std_of(far, 0.004**2, 0.004**2, 0.0) == pytest.approx(0.005)
    assert std_of(far, 0.0, 0.0, 0.001**2) == pytest.approx(math.hypot(0.003, 0.05 / math.sqrt(2)), rel=1e-3)
