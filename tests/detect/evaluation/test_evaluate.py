"""Evaluation of detectors, the suites, and their reports."""

from __future__ import annotations

import csv
import json
import math
import os
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from detect import cli
from detect.detection import Detection, Detections, Rejection, UnknownObject
from detect.detector import Detector
from detect.evaluation import suites, tables
from detect.evaluation.evaluate import evaluate_detector
from detect.evaluation.modes import RecordingMode
from detect.evaluation.paper import ROWS, SHAPES, TABLE_1, TABLE_2
from detect.evaluation.sessions import (
    REJECTED_WEIGHT,
    SessionScore,
    evaluate_session,
    evaluate_sessions,
    reported_primitives,
    scored_primitives,
    summarize_sessions,
)
from detect.networks.weights import KIND_NAMES, SHIPPED, ModelCard
from detect.networks.yolo import KINDS
from detect.refinement.options import RefinementOptions
from detect.training.dataset import DatasetOptions, bounding_box, load_samples, make_dataset, read_image
from detect.training.thresholds import choose_thresholds
from prim import console
from prim.errors import UsageError
from prim.shapes import Kind, Primitive
from tests.detect.fakes import constant, weights

OUTPUTS = [1, 0, 0, 0, 0.5] + [1, 0, 0, 0, 0.5, 0.25] + [0, 0, 0.25] + 2 * [1, 0, 0, 0, 0.5, 0.25]


@pytest.fixture(scope="module")
def small(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("sets") / "set"
    make_dataset(folder, DatasetOptions(sizes=(0, 4), mappers=("det",), rays=(120,), stops=(4,), seed=11))
    return folder


def perfect_detector(folder: Path, score: float) -> Detector:
    """A detector whose YOLO outputs the true boxes of a data set's images with a given score."""
    truth = {}
    for sample in load_samples(folder, "det", "val"):
        image = read_image(sample).transpose(2, 0, 1).astype(np.float32) / np.float32(255)
        truth[image.tobytes()] = [
            (KINDS.index(primitive.kind), bounding_box(primitive, sample.frame)) for primitive in sample.primitives
        ]

    def answer(batch: np.ndarray) -> np.ndarray:
        output = np.zeros((len(batch), 4 + len(KINDS), 40), np.float32)
        for i, image in enumerate(batch):
            for k, (kind, (left, top, right, bottom)) in enumerate(truth.get(image.tobytes(), [])):
                output[i, :4, k] = (left + right) / 2, (top + bottom) / 2, right - left, bottom - top
                output[i, 4 + kind, k] = score
        return output

    card = ModelCard("yolo", "det", thresholds=dict.fromkeys(KIND_NAMES, 0.5))
    return Detector(weights(card, answer), [constant("prim", KIND_NAMES, OUTPUTS)])


def test_perfect_boxes_score_one(small: Path) -> None:
    chosen = load_samples(small, "det", "val")
    detector = perfect_detector(small, 0.8)
    found = evaluate_detector(detector, chosen)
    truths = sum(len(sample.primitives) for sample in chosen)
    assert found.images == 4 and found.true_boxes["all"].count == truths
    assert all(row.map50_95 == pytest.approx(1) for row in found.boxes.values())
    assert found.kind_accuracy == 1.0
    sides = [shape.size[0] for sample in chosen for shape in sample.primitives if shape.kind == "square"]
    assert found.true_boxes["square"].width == pytest.approx(np.mean([abs(0.2 - side) for side in sides]))
    thresholds = choose_thresholds(detector.yolo, chosen)
    assert set(thresholds) == set(found.boxes) - {"all"} and max(thresholds.values()) <= 0.8
    assert json.loads(json.dumps(found.to_json()))["boxes"]["all"]["f1"] == pytest.approx(1)


def test_no_detections_score_zero(small: Path) -> None:
    found = evaluate_detector(perfect_detector(small, 0.0), load_samples(small, "det", "val"))
    assert found.boxes["all"].map50 == 0 and found.found == (0, 0, 0)
    assert found.detected == {} and found.kind_accuracy is None


def test_cases_are_the_papers_rows_and_those_of_det_for_forward() -> None:
    cases = list(suites.cases())
    assert len(cases) == 2 * (8 + 5)
    written = [case for case in cases if case.reading == "as written" and case.row.test == 0.1]
    assert {case.test_set for case in written} == {"test-500"} and {case.train_mm for case in written} == {250}
    assert {case.network for case in cases} == {
        *("det-0", "forward-0"), *(f"{mapper}-{mm}" for mapper in ("det", "prob", "forward") for mm in (50, 250))
    }  # fmt: skip
    assert set(TABLE_1) == set(TABLE_2) == set(ROWS)


def evaluation_json(row: float) -> dict[str, Any]:
    """A made-up evaluation."""
    scores = dict.fromkeys(("f1", "map50", "map50_95", "auc", "confidence"), row)
    errors = dict.fromkeys(("angle", "median_angle", "clear_angle", "width", "height", "size", "position"), 0.01) | {
        "count": 9
    }
    return {
        "boxes": dict.fromkeys(SHAPES, scores), "true_boxes": dict.fromkeys(SHAPES, errors), "detected": {},
        "found": [0, 0, 0], "kind_accuracy": None, "yolo_time": 0.005, "parameters_time": 0.01, "whole_time": 0.02,
    }  # fmt: skip


def test_the_papers_report(tmp_path: Path) -> None:
    pytest.importorskip("matplotlib", reason="needs the extra [train]")
    results = [
        (
            case,
            evaluation_json(0.9),
            {kind: evaluation_json(0.8) for kind in SHAPES[1:]} if case.train_mm == case.test_mm else {},
        )
        for case in suites.cases()
    ]
    markdown, table, plot = tables.write_paper_report(results, tmp_path)
    text = markdown.read_text()
    assert "| det, trained n = 0, tested n = 0 | all | 0.900 (0.800) | 0.900 (0.821) | 0.900 (0.554) |" in text
    assert "| forward, trained n = 0.05, tested n = 0.1 | ellipse | 0.900 |" in text
    assert "0.6 (69.8) | 10.0 (88.1)" in text  # 0.01 rad, 0.01 m
    lines = list(csv.DictReader(table.read_text("utf-8").splitlines()))
    assert len(lines) == 26 * 6 and float(lines[0]["paper_f1"]) == 0.8 and float(lines[0]["true_box_width"]) == 10
    assert plot.stat().st_size > 10_000
    assert tables.write_paper_report(results[:3], tmp_path) == [markdown, table, plot]  # earlier ones are recognised


def test_a_suite_is_continued(tmp_path: Path) -> None:
    """Stored results are not made again: nothing is recorded, mapped or trained."""
    announced: list[str] = []
    suite = suites.PaperSuite(tmp_path, announced.append)
    for case in suites.cases():
        (tmp_path / "networks" / case.network).mkdir(parents=True, exist_ok=True)
        (tmp_path / "networks" / case.network / "yolo.onnx").touch()
    for case in suites.cases():
        for kind in ("", *(f"-{kind.value}" for kind in KINDS)):
            (tmp_path / "results").mkdir(exist_ok=True)
            (tmp_path / "results" / f"{case.network}.{case.test_set}{kind}.json").write_text(
                json.dumps(evaluation_json(0.5))
            )
    assert len(suite.run()) == 26 and announced == []
    assert suite.results() == suite.run()
    for path in (tmp_path / "results").glob("prob-*"):
        path.unlink()
    assert len(suite.results()) == 20  # the remaining ones; nothing is made
    with pytest.raises(UsageError, match="nothing has been measured"):
        suites.PaperSuite(tmp_path / "none", announced.append).results()


def test_an_incomplete_report_counts_the_missing_rows(tmp_path: Path) -> None:
    pytest.importorskip("matplotlib", reason="needs the extra [train]")
    case = next(suites.cases())
    markdown, _, _ = tables.write_paper_report([(case, evaluation_json(0.9), {})], tmp_path)
    assert "25 of 26 rows are not measured yet" in markdown.read_text()


def test_a_report_leaves_the_home_alone(tmp_path: Path) -> None:
    """matplotlib would keep a list of fonts there."""
    pytest.importorskip("torch", reason="needs the extra [train]")
    pytest.importorskip("matplotlib", reason="needs the extra [train]")
    case, home, made = next(suites.cases()), tmp_path / "home", tmp_path / "work" / "results"
    home.mkdir()
    made.mkdir(parents=True)
    (made / f"{case.network}.{case.test_set}.json").write_text(json.dumps(evaluation_json(0.5)))
    kept = {name: value for name, value in os.environ.items() if not name.startswith(("MPL", "XDG", "YOLO"))}
    code = "from detect.__main__ import main_eval; main_eval()"
    subprocess.run(
        [sys.executable, "-c", code, made.parent, "--so-far"],
        cwd=Path(__file__).parents[3],
        env=kept | {"HOME": str(home)},
        check=True,
    )
    assert (made.parent / "report" / "paper.png").exists() and not list(home.iterdir())


def test_a_data_set_with_other_options_is_refused(tmp_path: Path) -> None:
    folder = tmp_path / "test-50"
    folder.mkdir()
    (folder / "manifest.json").write_text("{}")
    with pytest.raises(UsageError, match="other options"):
        suites.PaperSuite(tmp_path, lambda text: None).test_set("test-50")


def sessions_json(value: float) -> dict[str, Any]:
    """Made-up results of detect.evaluation.sessions."""
    metrics = {
        "boxes": {"all": {"f1": value, "map50": value, "map50_95": value}},
        "reported": {"all": {"f1": value, "map50": value / 2, "map50_95": value / 3}},
        "errors": {},
        "found": (1, 1, value),
    }
    return {"networks": metrics, "refined": metrics}


def test_the_shipped_weights_report(tmp_path: Path) -> None:
    results = [(condition, "forward", 500, sessions_json(0.9)) for condition in suites.conditions(500)]
    markdown, table = tables.write_shipped_report(results, tmp_path)
    row = "| warped | 250 | forward | 500 | 0.900 | 0.900 | 0.900 | 0.900 | 0.450 | 0.300 | 0.900 | 0.900 | – |"
    assert row in markdown.read_text()
    lines = list(csv.DictReader(table.read_text("utf-8").splitlines()))
    assert len(lines) == 7 + 4 * 3 and {line["recorded"] for line in lines} == set(RecordingMode)
    assert lines[0]["position_mm"] == "" and lines[0]["networks_f1"] == "0.9"
    assert (lines[0]["map50"], lines[0]["weighted_map50"]) == ("0.45", "0.9")


def test_a_report_does_not_replace_what_is_none(tmp_path: Path) -> None:
    """Earlier reports are replaced; another file stays, and then nothing is written at all."""
    results = [(next(suites.conditions(500)), "forward", 500, sessions_json(0.9))]
    for _ in range(2):
        markdown, table = tables.write_shipped_report(results, tmp_path)
    markdown.unlink()
    table.write_text("my,own\n")
    with pytest.raises(UsageError, match=r"shipped\.csv exists and is not a table of prim-eval"):
        tables.write_shipped_report(results, tmp_path)
    assert table.read_text() == "my,own\n" and not markdown.exists()
    tables.write_shipped_report(results, tmp_path, force=True)
    assert markdown.exists() and table.read_text().startswith("recorded,")


def test_a_report_has_its_place_before_the_work_begins(
    in_tmp: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(suites.ShippedSuite, "run", lambda *arguments: pytest.fail("evaluated"))
    Path("w/report").mkdir(parents=True)
    Path("w/report/shipped.md").write_text("my own")
    assert console.run(cli.evaluation, "prim-eval", ["w", "--suite", "shipped"]) == 2
    assert "--force" in capsys.readouterr().err and Path("w/report/shipped.md").read_text() == "my own"


def test_a_damaged_result_is_named(tmp_path: Path) -> None:
    (tmp_path / "a.json").write_text('{"images": ')
    with pytest.raises(UsageError, match=r"a\.json is damaged"):
        suites.read_result(tmp_path / "a.json")


def test_results_without_the_mean_average_precision_of_what_is_reported_have_a_dash(tmp_path: Path) -> None:
    earlier = sessions_json(0.9)
    del earlier["refined"]["reported"]
    condition = next(suites.conditions(500))
    markdown, table = tables.write_shipped_report([(condition, "forward", 500, earlier)], tmp_path)
    assert "| 500 | 0.900 | 0.900 | 0.900 | 0.900 | – | – | 0.900 | 0.900 | – |" in markdown.read_text()
    assert next(csv.DictReader(table.read_text("utf-8").splitlines()))["map50"] == ""
    assert "| 0 mm | 500 | 0.900 | 0.900 | – | – |" in tables.shipped_summary(
        [(condition, "forward", 500, earlier)], RecordingMode.WARPED, "forward"
    )


def test_a_closed_world_has_rows_of_its_own(tmp_path: Path) -> None:
    results = [
        (condition, "forward", 9, sessions_json(0.4 + 0.5 * closed))
        for closed in (False, True)
        for condition in suites.conditions(9, closed)
    ]
    markdown, table = tables.write_shipped_report(results, tmp_path)
    text = markdown.read_text()
    assert "| warped | 250 | forward | 9 | 0.400 |" in text
    assert "| warped, closed world | 250 | forward | 9 | 0.900 |" in text
    named = {line["recorded"] for line in csv.DictReader(table.read_text("utf-8").splitlines())}
    assert named == {*RecordingMode, *(f"{mode}, closed world" for mode in RecordingMode)}
    summary = tables.shipped_summary(results, RecordingMode.WARPED, "forward")
    assert "0.400" in summary and "0.900" not in summary
    assert len({condition.slug for condition, *_ in results}) == len(results)


def test_the_summary_is_of_one_mode_and_one_mapper() -> None:
    results = [
        (condition, mapper, 24, sessions_json(0.5))
        for condition in suites.conditions(24)
        for mapper in ("det", "prob")
    ]
    lines = tables.shipped_summary(results, RecordingMode.DRIVEN, "det").splitlines()
    assert [line.split(" | ")[0] for line in lines[2:]] == ["| 50 mm", "| 250 mm", "| 500 mm"]


def test_the_shipped_suite_evaluates_what_is_missing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """It reports for each row the results with most sessions."""
    calls: list[tuple[int, str]] = []

    def evaluate_sessions(
        seeds: list[int], options: object, mapper: str, weights: Path, jobs: int | None, closed_world: bool
    ) -> dict[str, Any]:
        calls.append((len(seeds), mapper))
        return sessions_json(len(seeds) / (20 if closed_world else 10))

    monkeypatch.setattr(suites, "evaluate_sessions", evaluate_sessions)
    suite = suites.ShippedSuite(tmp_path, SHIPPED, lambda text: None)
    few = suite.run(2, ["forward"], ["driven", "warped"])
    assert len(few) == 7 + 3 and calls == [(2, "forward")] * 10
    assert suite.run(2, ["forward"], ["driven", "warped"]) == few and len(calls) == 10
    more = suite.run(5, ["det", "forward"], ["driven"])
    counts = {(condition.name, condition.noise_mm, mapper): count for condition, mapper, count, _ in more}
    assert counts["driven", 50, "forward"] == counts["driven", 50, "det"] == 5 and counts["warped", 0, "forward"] == 2
    closed = suite.run(5, ["forward"], ["driven"], closed_world=True)
    assert closed[: len(more)] == more  # neither replaces the other's results, of the same sessions
    assert {(condition.title, value["refined"]["found"][2]) for condition, _, _, value in closed[len(more) :]} == {
        ("driven, closed world", 0.25)
    }
    with pytest.raises(UsageError, match="nothing has been measured"):
        suites.ShippedSuite(tmp_path / "none", SHIPPED, lambda text: None).results()


@pytest.mark.parametrize("mapper", ["det", "forward"])
def test_a_session_is_evaluated_from_its_seed(mapper: str) -> None:
    """Without noise all primitives are detected, and refinement makes them more accurate."""
    options = DatasetOptions(sizes=(0, 1), seed=7, rays=(240,), stops=(6,))
    networks, refined = evaluate_session(7, options, mapper, SHIPPED / mapper)
    assert networks.truths == refined.truths == len(refined.pairs) > 0
    assert refined.detections == refined.truths
    largest = [max(math.hypot(a.x - b.x, a.y - b.y) for a, b in score.pairs) for score in (networks, refined)]
    assert largest[1] < 0.001 < largest[0]
    scores = summarize_sessions([refined])
    assert scores["boxes"]["all"]["map50"] == pytest.approx(1, abs=0.01) and scores["found"] == (1, 1, 1)


def test_the_number_of_processes_does_not_change_the_results() -> None:
    options = DatasetOptions(sizes=(0, 3), seed=7, rays=(120,), stops=(4,), noise_stds=(0.05,))
    one, two = (evaluate_sessions([7, 8, 9], options, "forward", SHIPPED / "forward", jobs) for jobs in (1, 2))
    assert one == two and one["refined"]["found"][2] > 0.5


def test_what_is_reported_counts_with_its_kind_and_its_score() -> None:
    """The mean average precision of the field: neither further kinds nor rejected primitives count."""
    square = Primitive(Kind.SQUARE, 0.0, 0.0, 0.0, (0.2,))
    detection = Detection(
        replace(square, kind=Kind.RECTANGLE, size=(0.2, 0.19)),
        *(0.7, (0, 0, 0, 0), np.zeros((0, 0), np.uint8), None),
        {Kind.RECTANGLE: 0.7, Kind.SQUARE: 0.3},
    )
    boxes = reported_primitives([detection], [square]).boxes
    assert [KINDS[kind] for kind in boxes.kind] == [Kind.RECTANGLE] and boxes.score == pytest.approx([0.7])
    assert boxes.box[0] == pytest.approx([-10, -9.5, 10, 9.5])
    score = SessionScore.compare([scored_primitives(Detections((detection,), ()), [square])], [detection], [square])
    scores = summarize_sessions([score])
    assert scores["boxes"]["all"]["map50"] == pytest.approx(1) and scores["reported"]["all"]["map50"] == 0


def test_each_kind_counts_by_its_probability() -> None:
    square = Primitive(Kind.SQUARE, 0.0, 0.0, 0.0, (0.2,))
    crop = np.zeros((0, 0), np.uint8)
    probabilities = {Kind.RECTANGLE: 0.7, Kind.SQUARE: 0.2995, Kind.CIRCLE: 0.0005}
    rectangle = replace(square, kind=Kind.RECTANGLE, size=(0.2, 0.19))
    detection = Detection(rectangle, 0.7, (0, 0, 0, 0), crop, None, probabilities)
    boxes = scored_primitives(Detections((detection,), ()), [square]).boxes
    assert [KINDS[kind] for kind in boxes.kind] == [Kind.RECTANGLE, Kind.SQUARE]
    assert boxes.score == pytest.approx([0.7, 0.2995]) and boxes.box[0] == pytest.approx([-10, -9.5, 10, 9.5])
    alone = scored_primitives(Detections((replace(detection, kind_probabilities=None),), ()), [square]).boxes
    assert alone.score == pytest.approx([0.7]) and len(alone) == 1


def test_rejected_primitives_count_with_a_share_of_their_probability() -> None:
    """As candidates below a network's thresholds do: with less than a detection's."""
    square = Primitive(Kind.SQUARE, 0.0, 0.0, 0.0, (0.2,))
    fitted = Detection(square, 0.9, (0, 0, 0, 0), np.zeros((0, 0), np.uint8), None, {Kind.SQUARE: 0.9})
    rejection = Rejection(Kind.SQUARE, 0.1, 0.0, 0.0, "its sizes are not known", fitted)
    boxes = scored_primitives(Detections((), (rejection, replace(rejection, fitted=None))), [square]).boxes
    assert boxes.score == pytest.approx([0.9 * REJECTED_WEIGHT]) and len(boxes) == 1


def test_objects_of_no_kind_count_nowhere() -> None:
    square = Primitive(Kind.SQUARE, 0.0, 0.0, 0.0, (0.2,))
    outline = np.array([[0.5, 0.5], [0.7, 0.5], [0.6, 0.8]])
    thing = UnknownObject(outline, 0.004, 0.7, "it is part of something larger", {Kind.TRIANGLE: 0.3})
    detection = Detection(square, 0.9, (0, 0, 0, 0), np.zeros((0, 0), np.uint8), None, {Kind.SQUARE: 0.9})
    alone = Detections((replace(detection, other_probability=0.1),), ())
    scores = [
        summarize_sessions([SessionScore.compare([scored_primitives(found, [square])], found.found, [square])])
        for found in (alone, replace(alone, objects=(thing,)))
    ]
    assert scores[0] == scores[1] and scores[0]["found"] == (1, 1, 1)


@pytest.mark.parametrize("closed", [False, True])
def test_a_closed_world_reaches_refinement(monkeypatch: pytest.MonkeyPatch, closed: bool) -> None:
    given = []

    def refined(detections: Detections, *arguments: Any, options: RefinementOptions) -> tuple[Detections, None]:
        given.append(options)
        return detections, None

    monkeypatch.setattr("detect.evaluation.sessions.refine_detections", refined)
    options = DatasetOptions(sizes=(0, 1), seed=7, rays=(120,), stops=(2,))
    monkeypatch.setattr("detect.evaluation.sessions.process_pool", lambda jobs: ThreadPoolExecutor(1))
    evaluate_sessions([7], options, "det", SHIPPED / "det", 1, closed_world=closed)
    assert given == [replace(RefinementOptions(), closed_world=closed)]


def test_a_closed_world_goes_with_the_suite_that_refines(
    in_tmp: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    assert console.run(cli.evaluation, "prim-eval", ["w", "--closed-world"]) == 2
    assert "--closed-world goes with --suite shipped" in capsys.readouterr().err
    given: list[object] = []

    def run(suite: suites.ShippedSuite, *arguments: object) -> list[suites.ShippedResult]:
        given.append(arguments[-1])
        return [(next(suites.conditions(1, True)), "det", 1, sessions_json(0.5))]

    monkeypatch.setattr(suites.ShippedSuite, "run", run)
    assert console.run(cli.evaluation, "prim-eval", ["w", "--suite", "shipped", "--closed-world", "--quiet"]) == 0
    assert console.run(cli.evaluation, "prim-eval", ["w", "--suite", "shipped", "--quiet"]) == 0
    assert given == [True, False]
    assert "| warped, closed world | 0 | det | 1 |" in Path("w/report/shipped.md").read_text()


def test_missing_shipped_weights_are_refused(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="holds no weights"):
        suites.ShippedSuite(tmp_path, tmp_path, lambda text: None).run(5)
