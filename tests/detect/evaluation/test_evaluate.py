"""Evaluation and its tables: what perfect and what blind networks get."""

from __future__ import annotations

import csv
import json
import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from detect.detection import Detection, Detections, Rejection
from detect.detector import Detector
from detect.evaluation import suites, tables
from detect.evaluation.evaluate import choose_thresholds, evaluate
from detect.evaluation.paper import ROWS, SHAPES, TABLE_1, TABLE_2
from detect.evaluation.sessions import RIGHT_AFTER_ALL, marked, summed_up, trial
from detect.networks.weights import ALL_KINDS, SHIPPED, Card
from detect.networks.yolo import KINDS
from detect.training.dataset import SetOptions, box_of, make, samples
from prim.errors import UsageError
from prim.shapes import Kind, Primitive
from tests.detect.fakes import constant, weights

OUTPUTS = [1, 0, 0, 0, 0.5] + [1, 0, 0, 0, 0.5, 0.25] + [0, 0, 0.25] + 2 * [1, 0, 0, 0, 0.5, 0.25]


@pytest.fixture(scope="module")
def small(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("sets") / "set"
    make(folder, SetOptions(sizes=(0, 4), mappers=("det",), rays=(120,), stops=(4,), seed=11))
    return folder


def all_seeing(folder: Path, score: float) -> Detector:
    """A detector whose YOLO knows the truth of each of a set's images, by the image."""
    truth = {}
    for sample in samples(folder, "det", "val"):
        from PIL import Image

        image = np.asarray(Image.open(sample.image)).transpose(2, 0, 1).astype(np.float32) / np.float32(255)
        truth[image.tobytes()] = [(KINDS.index(one.kind), box_of(one, sample.frame)) for one in sample.primitives]

    def answer(batch: np.ndarray) -> np.ndarray:
        output = np.zeros((len(batch), 4 + len(KINDS), 40), np.float32)
        for i, image in enumerate(batch):
            for k, (kind, (left, top, right, bottom)) in enumerate(truth.get(image.tobytes(), [])):
                output[i, :4, k] = (left + right) / 2, (top + bottom) / 2, right - left, bottom - top
                output[i, 4 + kind, k] = score
        return output

    card = Card("yolo", "det", thresholds=dict.fromkeys(ALL_KINDS, 0.5))
    return Detector(weights(card, answer), [constant("prim", ALL_KINDS, OUTPUTS)])


def test_a_detector_that_knows_all(small: Path) -> None:
    chosen = samples(small, "det", "val")
    detector = all_seeing(small, 0.8)
    found = evaluate(detector, chosen)
    truths = sum(len(sample.primitives) for sample in chosen)
    assert found.images == 4 and found.true_boxes["all"].count == truths
    assert all(row.map50_95 == pytest.approx(1) for row in found.boxes.values())
    assert found.kind_accuracy == 1.0
    sides = [one.size[0] for sample in chosen for one in sample.primitives if one.kind == "square"]
    assert found.true_boxes["square"].width == pytest.approx(np.mean([abs(0.2 - side) for side in sides]))
    thresholds = choose_thresholds(detector.yolo, chosen)
    assert set(thresholds) == set(found.boxes) - {"all"} and max(thresholds.values()) <= 0.8
    assert json.loads(json.dumps(found.to_json()))["boxes"]["all"]["f1"] == pytest.approx(1)


def test_a_detector_that_sees_nothing(small: Path) -> None:
    found = evaluate(all_seeing(small, 0.0), samples(small, "det", "val"))
    assert found.boxes["all"].map50 == 0 and found.found == (0, 0, 0)
    assert found.detected == {} and found.kind_accuracy is None


def test_the_papers_rows_stand_for_themselves_and_for_forward() -> None:
    cases = list(suites.cases())
    assert len(cases) == 2 * (8 + 5)
    written = [case for case in cases if case.reading == "as written" and case.row.test == 0.1]
    assert {case.test for case in written} == {"test-500"} and {case.train_mm for case in written} == {250}
    assert {case.network for case in cases} == {
        *("det-0", "forward-0"), *(f"{mapper}-{mm}" for mapper in ("det", "prob", "forward") for mm in (50, 250))
    }  # fmt: skip
    assert set(TABLE_1) == set(TABLE_2) == set(ROWS)


def made_up(row: float) -> dict[str, Any]:
    """An evaluation."""
    scores = dict.fromkeys(("f1", "map50", "map50_95", "auc", "confidence"), row)
    errors = dict.fromkeys(("angle", "median_angle", "clear_angle", "width", "height", "size", "position"), 0.01) | {
        "count": 9
    }
    return {
        "boxes": dict.fromkeys(SHAPES, scores), "true_boxes": dict.fromkeys(SHAPES, errors), "detected": {},
        "found": [0, 0, 0], "kind_accuracy": None, "yolo_time": 0.005, "parameters_time": 0.01, "whole_time": 0.02,
    }  # fmt: skip


def test_the_report(tmp_path: Path) -> None:
    pytest.importorskip("matplotlib", reason="needs the extra [train]")
    results = [
        (case, made_up(0.9), {kind: made_up(0.8) for kind in SHAPES[1:]} if case.train_mm == case.test_mm else {})
        for case in suites.cases()
    ]
    markdown, table, plot = tables.report(results, tmp_path)
    text = markdown.read_text()
    assert "| det, trained n = 0, tested n = 0 | all | 0.900 (0.800) | 0.900 (0.821) | 0.900 (0.554) |" in text
    assert "| forward, trained n = 0.05, tested n = 0.1 | ellipse | 0.900 |" in text
    assert "0.6 (69.8) | 10.0 (88.1)" in text  # 0.01 rad, 0.01 m
    lines = list(csv.DictReader(table.open()))
    assert len(lines) == 26 * 6 and float(lines[0]["paper_f1"]) == 0.8 and float(lines[0]["true_box_width"]) == 10
    assert plot.stat().st_size > 10_000


def test_a_suite_goes_on_where_it_stopped(tmp_path: Path) -> None:
    """Results that are there are not made again: nothing is recorded, mapped or trained."""
    said: list[str] = []
    made = suites.Suite(tmp_path, said.append)
    for case in suites.cases():
        (tmp_path / "networks" / case.network).mkdir(parents=True, exist_ok=True)
        (tmp_path / "networks" / case.network / "yolo.onnx").touch()
    for case in suites.cases():
        for kind in ("", *(f"-{kind.value}" for kind in KINDS)):
            (tmp_path / "results").mkdir(exist_ok=True)
            (tmp_path / "results" / f"{case.network}.{case.test}{kind}.json").write_text(json.dumps(made_up(0.5)))
    assert len(made.run()) == 26 and said == []
    assert made.measured() == made.run()
    for path in (tmp_path / "results").glob("prob-*"):
        path.unlink()
    assert len(made.measured()) == 20  # what is there, and nothing is made
    with pytest.raises(UsageError, match="nothing has been measured"):
        suites.Suite(tmp_path / "none", said.append).measured()


def test_a_report_of_a_part_says_what_is_missing(tmp_path: Path) -> None:
    pytest.importorskip("matplotlib", reason="needs the extra [train]")
    case = next(suites.cases())
    markdown, _, _ = tables.report([(case, made_up(0.9), {})], tmp_path)
    assert "25 of 26 rows are not measured yet" in markdown.read_text()


def test_a_set_with_other_options_is_not_taken(tmp_path: Path) -> None:
    folder = tmp_path / "test-50"
    folder.mkdir()
    (folder / "manifest.json").write_text("{}")
    with pytest.raises(UsageError, match="other options"):
        suites.Suite(tmp_path, lambda text: None).tests("test-50")


def measured(value: float) -> dict[str, Any]:
    """What detect.evaluation.sessions says of a row, made up."""
    boxes = {"boxes": {"all": {"f1": value, "map50": value, "map50_95": value}}, "errors": {}, "found": (1, 1, value)}
    return {"networks": boxes, "refined": boxes}


def test_the_shipped_weights_report(tmp_path: Path) -> None:
    results = [(condition, "forward", 500, measured(0.9)) for condition in suites.conditions(500)]
    markdown, table = tables.report_shipped(results, tmp_path)
    assert "| warped | 250 | forward | 500 | 0.900 | 0.900 | 0.900 | 0.900 | 0.900 |" in markdown.read_text()
    lines = list(csv.DictReader(table.open()))
    assert len(lines) == 7 + 4 * 3 and {line["recorded"] for line in lines} == set(suites.WAYS)
    assert lines[0]["position_mm"] == "" and lines[0]["networks_f1"] == "0.9"


def test_the_shipped_suite_measures_what_is_missing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """And reports of each row what was measured with most sessions."""
    asked: list[tuple[int, str]] = []

    def trials(seeds: list[int], options: object, mapper: str, weights: Path) -> dict[str, Any]:
        asked.append((len(seeds), mapper))
        return measured(len(seeds) / 10)

    monkeypatch.setattr(suites, "trials", trials)
    made = suites.ShippedSuite(tmp_path, SHIPPED, lambda text: None)
    few = made.run(2, ["forward"], ["driven", "warped"])
    assert len(few) == 7 + 3 and asked == [(2, "forward")] * 10
    assert made.run(2, ["forward"], ["driven", "warped"]) == few and len(asked) == 10
    more = made.run(5, ["det", "forward"], ["driven"])
    told = {(condition.name, condition.noise_mm, mapper): count for condition, mapper, count, _ in more}
    assert told["driven", 50, "forward"] == told["driven", 50, "det"] == 5 and told["warped", 0, "forward"] == 2
    with pytest.raises(UsageError, match="nothing has been measured"):
        suites.ShippedSuite(tmp_path / "none", SHIPPED, lambda text: None).measured()


@pytest.mark.parametrize("mapper", ["det", "forward"])
def test_a_trial_goes_from_a_seed_to_scores(mapper: str) -> None:
    """Without noise, what is told is what is there, and refinement makes it more exact."""
    options = SetOptions(sizes=(0, 1), seed=7, rays=(240,), stops=(6,))
    alone, refined = trial(7, options, mapper, SHIPPED / mapper)
    assert alone.truths == refined.truths == len(refined.pairs) > 0
    assert refined.detections == refined.truths
    off = [max(math.hypot(a.x - b.x, a.y - b.y) for a, b in told.pairs) for told in (alone, refined)]
    assert off[1] < 0.001 < off[0]
    scores = summed_up([refined])
    assert scores["boxes"]["all"]["map50"] == pytest.approx(1, abs=0.01) and scores["found"] == (1, 1, 1)


def test_each_kind_counts_by_its_chance() -> None:
    square = Primitive(Kind.SQUARE, 0.0, 0.0, 0.0, (0.2,))
    crop = np.zeros((0, 0), np.uint8)
    chances = {Kind.RECTANGLE: 0.7, Kind.SQUARE: 0.2995, Kind.CIRCLE: 0.0005}
    told = Detection(replace(square, kind=Kind.RECTANGLE, size=(0.2, 0.19)), 0.7, (0, 0, 0, 0), crop, None, chances)
    boxes = marked(Detections((told,), ()), [square]).boxes
    assert [KINDS[kind] for kind in boxes.kind] == [Kind.RECTANGLE, Kind.SQUARE]
    assert boxes.score == pytest.approx([0.7, 0.2995]) and boxes.box[0] == pytest.approx([-10, -9.5, 10, 9.5])
    alone = marked(Detections((replace(told, chances=None),), ()), [square]).boxes
    assert alone.score == pytest.approx([0.7]) and len(alone) == 1


def test_what_is_no_detection_counts_with_a_share_of_its_chance() -> None:
    """As candidates below a network's thresholds count: less than what is told, but they count."""
    square = Primitive(Kind.SQUARE, 0.0, 0.0, 0.0, (0.2,))
    fitted = Detection(square, 0.9, (0, 0, 0, 0), np.zeros((0, 0), np.uint8), None, {Kind.SQUARE: 0.9})
    unsure = Rejection(Kind.SQUARE, 0.1, 0.0, 0.0, "its sizes are not known", fitted)
    boxes = marked(Detections((), (unsure, replace(unsure, fitted=None))), [square]).boxes
    assert boxes.score == pytest.approx([0.9 * RIGHT_AFTER_ALL]) and len(boxes) == 1


def test_shipped_weights_that_are_not_there(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="holds no weights"):
        suites.ShippedSuite(tmp_path, tmp_path, lambda text: None).run(5)
