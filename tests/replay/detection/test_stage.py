"""Detection in a replay: the report, the recording, the detector's own map; with a detector that knows the truth."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from detect.detection import Detection, Detections, Rejection
from detect.detector import Detector
from detect.networks.weights import ModelCard
from mapping.grid import OccupancyGrid
from mapping.mapper import MAPPERS
from prim import console
from prim.errors import UsageError
from prim.shapes import Kind, Primitive
from recorder.session import Session
from replay import cli
from replay.detection.refiner import add_frame_uncertainty
from replay.options import ReplayOptions
from replay.outputs.report import report_json, summary_rows
from replay.pipeline import Pipeline
from replay.result import ReplayResult
from replay.viewer import RerunViewer
from replay.viewing.protocol import ViewerOptions
from tests.replay.test_viewer import rows_of, timed, value


class FakeDetector:
    """Detects all primitives, 10 mm to the right, and rejects one candidate; ``seen`` are the maps it was given."""

    card = ModelCard("yolo", "any")

    def __init__(self, session: Session) -> None:
        self.session = session
        self.seen: list[OccupancyGrid] = []

    def detect(self, grid: OccupancyGrid, sizes: object, progress: object = None) -> Detections:
        self.seen.append(grid)
        crop = np.full((72, 72), 7, np.uint8)
        shifted = [replace(primitive, x=primitive.x + 0.01) for primitive in self.session.world.primitives]
        rejection = Rejection(Kind.CIRCLE, 0.1, 0.5, 0.25, "score 0.10 is below 0.30, the least for a circle")
        return Detections(tuple(Detection(p, 0.9, (0.0, 0.0, 0.1, 0.1), crop) for p in shifted), (rejection,))


@pytest.fixture
def detector(noisy_session: Session, monkeypatch: pytest.MonkeyPatch) -> FakeDetector:
    fake = FakeDetector(noisy_session)
    monkeypatch.setattr(Detector, "load", lambda path, mapper=None, threads=None: fake)
    return fake


def replayed(session: Session, viewer: RerunViewer | None = None, **options: object) -> ReplayResult:
    chosen = ReplayOptions(weights=Path("w"), **{"refine": False} | options)  # type: ignore[arg-type]
    result = Pipeline(session.path, chosen, viewer).run()
    if viewer is not None:
        viewer.finish([result])
    return result


@pytest.mark.parametrize("mapper", MAPPERS)
def test_the_report_lists_the_detections(noisy_session: Session, detector: FakeDetector, mapper: str) -> None:
    report = report_json(replayed(noisy_session, mapper=mapper))
    assert json.loads(json.dumps(report)) == report
    truth = noisy_session.world.primitives
    assert [one["id"] for one in report["primitives"]] == list(range(1, len(truth) + 1))
    for one, true in zip(report["primitives"], truth, strict=True):
        assert (one["kind"], one["stage"], one["score"], one["std"]) == (true.kind, "detected", 0.9, None)
        assert one["x"] == pytest.approx(true.x + 0.01) and one["size"] == true.sizes
    errors = report["errors"]
    assert [errors[name] for name in ("position_m", "width_m", "angle_rad")] == pytest.approx([0.01, 0, 0], abs=1e-9)
    assert {pair["truth"]: pair["id"] for pair in errors["pairs"]} == {k: k + 1 for k in range(len(truth))}
    assert report["timing"]["detect_s"] > 0
    assert len(detector.seen) == 1


@pytest.mark.parametrize("mapper", MAPPERS)
def test_detections_are_refined_with_the_rays(noisy_session: Session, detector: FakeDetector, mapper: str) -> None:
    """The detector is 10 mm off; the rays are not, though their noise is 50 mm."""
    report = report_json(replayed(noisy_session, mapper=mapper, refine=True))
    assert json.loads(json.dumps(report)) == report
    assert report["errors"]["f1"] > 0.6  # not all of seven can be told from other kinds, or from none, by so few rays
    assert report["errors"]["position_m"] < 0.004
    for one in report["primitives"]:
        assert one["stage"] == "refined" and 0 < one["score"] <= 1
        assert set(one["std"]) == {"x", "y", *one["size"], *(["theta"] if one["theta"] is not None else [])}
        assert all(0 < value < (2.0 if name == "theta" else 0.3) for name, value in one["std"].items())
        assert one["chances"][one["kind"]] == one["score"] == max(one["chances"].values())
    assert report["refine"]["noise_std_m"] == pytest.approx(0.05, rel=0.15)
    assert report["timing"]["refine_s"] > 0


def test_intermediate_refinements_are_on_the_timeline(
    noisy_session: Session, detector: FakeDetector, tmp_path: Path
) -> None:
    viewer = RerunViewer(ViewerOptions(save=tmp_path / "a.rrd"), announce=print)
    replayed(noisy_session, viewer, mapper="forward", detect_every=10, refine=True)
    rows = rows_of(tmp_path / "a.rrd")
    lengths = [value(row, "scalars")[0] for row in timed(rows["/errors/lengths"])]
    assert lengths[-1] < 4.0  # mm
    bands = timed(rows["/map/uncertainty"])
    assert len(bands) == len(lengths)
    assert len(value(bands[-1], "strips")) == 2 * len(value(timed(rows["/map/detections"])[-1], "strips"))


def test_no_detection_when_switched_off(noisy_session: Session, detector: FakeDetector) -> None:
    report = report_json(Pipeline(noisy_session.path, ReplayOptions(detect=False)).run())
    assert report["primitives"] == [] and report["errors"] is None and detector.seen == []


def test_intermediate_detections_are_on_the_timeline(
    noisy_session: Session, detector: FakeDetector, tmp_path: Path
) -> None:
    viewer = RerunViewer(ViewerOptions(save=tmp_path / "a.rrd"), announce=print)
    result = replayed(noisy_session, viewer, mapper="prob", detect_every=10)
    rows = rows_of(tmp_path / "a.rrd")
    outlines = timed(rows["/map/detections"])
    wanted = [0, *range(9, result.scans, 10)]
    assert sorted({row["scan"] for row in outlines}) == sorted({*wanted, result.scans - 1})
    labels = timed(rows["/map/labels"])
    assert (
        value(labels[0], "labels")[0] == f"1?: {noisy_session.world.primitives[0].kind} 0.90"
    )  # tentative when seen once
    assert value(labels[-1], "labels")[0] == f"1: {noisy_session.world.primitives[0].kind} 0.90"
    lengths = value(timed(rows["/errors/lengths"])[-1], "scalars")
    assert lengths == pytest.approx([10.0, 0.0, 0.0], abs=1e-6)
    assert value(timed(rows["/errors/found"])[-1], "scalars")[0] == pytest.approx(1.0)
    assert len(timed(rows["/crops"])) == len(outlines)
    assert "| 1 |" in value(timed(rows["/detections"])[-1], "text")[0]


@pytest.mark.parametrize("every", [23, 22, 5])
def test_the_last_scan_is_searched_once(noisy_session: Session, detector: FakeDetector, every: int) -> None:
    """Or a track that is seen in the last map alone would be confirmed by itself."""
    assert noisy_session.scans == 23
    replayed(noisy_session, mapper="prob", detect_every=every)
    assert len(detector.seen) == {23: 2, 22: 3, 5: 6}[every]


def test_how_often_is_decided_by_the_cells_that_are_searched(
    noisy_session: Session, detector: FakeDetector, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """Those of the detector's own map, where it has one: here 220 x 220, where the replay's has 44 x 44."""
    monkeypatch.setattr("replay.intervals.DETECTED_CELLS", 4 * 220 * 220)
    viewer = RerunViewer(ViewerOptions(save=tmp_path / "a.rrd"), announce=print)
    result = replayed(noisy_session, viewer, mapper="prob", resolution=0.05)
    assert any("detected 4 times along the way" in note for note in result.notes)


def test_detections_are_drawn_over_the_map_that_was_searched(
    noisy_session: Session, detector: FakeDetector, tmp_path: Path
) -> None:
    viewer = RerunViewer(ViewerOptions(save=tmp_path / "a.rrd"), announce=print)
    replayed(noisy_session, viewer, mapper="prob", map_every=10, detect_every=4)
    rows = rows_of(tmp_path / "a.rrd")
    maps, found = ({row["scan"] for row in timed(rows[f"/map/{name}"])} for name in ("grid", "detections"))
    assert found == {0, 3, 7, 11, 15, 19, 22} and maps == found | {10, 20}


def test_the_detector_has_a_map_of_its_own_resolution(noisy_session: Session, detector: FakeDetector) -> None:
    result = replayed(noisy_session, mapper="prob", resolution=0.05, detect_every=12)
    assert result.grid.frame.resolution == 0.05
    assert {grid.frame.resolution for grid in detector.seen} == {0.01} and len(detector.seen) > 1
    assert [np.count_nonzero(grid.occupied) for grid in detector.seen] == sorted(
        np.count_nonzero(grid.occupied) for grid in detector.seen
    )


def test_rejected_candidates_are_printed_with_verbose(
    noisy_session: Session, detector: FakeDetector, in_tmp: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    command = [str(noisy_session.path), "--weights", "w", "--no-refine", "--no-viewer", "--verbose"]
    assert console.run(cli.app, "prim-replay", command) == 0
    seen = capsys.readouterr()
    wanted = "rejected: circle at (0.50, 0.25) m, score 0.10: score 0.10 is below 0.30, the least for a circle"
    assert wanted in seen.err
    assert "position 10.0 mm, size 0.0 mm, angle 0.0 deg (means)" in seen.out


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"detect": False, "detect_every": 3}, "--no-detect excludes"),
        ({"detect": False, "weights": Path("w")}, "--no-detect excludes"),
        ({"detect": False, "refine": False}, "--no-detect excludes"),
        ({"detect_every": 0}, "--detect-every is 0"),
    ],
)
def test_impossible_detection_options_are_refused(options: dict[str, object], message: str) -> None:
    with pytest.raises(UsageError, match=message):
        ReplayOptions(**options)  # type: ignore[arg-type]


@pytest.mark.parametrize(("content", "message"), [(b"junk", "no ONNX network"), (b"PK\x03\x04", "pickle")])
def test_unusable_weights_are_refused_in_one_line(
    noisy_session: Session, in_tmp: Path, capsys: pytest.CaptureFixture[str], content: bytes, message: str
) -> None:
    Path("w.onnx").write_bytes(content)
    assert console.run(cli.app, "prim-replay", [str(noisy_session.path), "--weights", "w.onnx"]) == 1
    error = capsys.readouterr().err
    assert message in error and error.count("\n") == 1 and not list(Path().glob("*.rrd*"))


def test_the_table_names_missing_weights(noisy_session: Session, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("detect.networks.weights.SHIPPED", Path("nowhere"))
    result = Pipeline(noisy_session.path, ReplayOptions()).run()
    assert "detection skipped: no weights for maps of prob" in dict(summary_rows(result))["primitives"]
    assert not result.notes
    with pytest.raises(UsageError, match="give --weights"):
        Pipeline(noisy_session.path, ReplayOptions(detect_every=3)).run()


def test_a_map_too_large_for_the_detector_skips_detection(
    noisy_session: Session, detector: FakeDetector, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The map itself is small enough: the replay goes on, and the table gives the reason."""
    monkeypatch.setattr("mapping.grid.MAX_CELLS", 10_000)
    monkeypatch.setattr("replay.detection.stage.shipped_weights", lambda mapper: Path("w"))
    result = Pipeline(noisy_session.path, ReplayOptions(resolution=0.05)).run()
    assert dict(summary_rows(result))["primitives"].startswith("detection skipped: a map of")


def test_nothing_is_evaluated_where_poses_are_in_no_known_frame(
    noisy_session: Session, detector: FakeDetector
) -> None:
    report = report_json(replayed(noisy_session, standing_still=True))
    assert report["primitives"] and report["errors"] is None and report["map"]["scores"] is None


def test_the_gaussian_sensor_model_gives_the_detector_its_own_map(
    noisy_session: Session, detector: FakeDetector
) -> None:
    replayed(noisy_session, mapper="prob", sensor_model="gaussian", noise_std=0.05, resolution=0.05)
    assert detector.seen[0].frame.resolution == 0.01


def test_frame_covariance_adds_to_position_and_angle_uncertainty() -> None:
    primitive = Primitive(Kind.RECTANGLE, 3.0, -4.0, 0.2, (0.3, 0.2))
    detection = Detection(
        primitive, 0.9, (0, 0, 0, 0), np.zeros((1, 1), np.uint8), covariance=np.diag([9e-6, 0, 0, 1e-6, 4e-6])
    )
    detection = replace(detection, std={"x": 0.003, "y": 0.0, "theta": 0.0, "width": 0.001, "height": 0.002})
    shifted = add_frame_uncertainty(detection, np.diag([0.004**2, 0.0, 0.0]))
    assert shifted.std == pytest.approx({**(detection.std or {}), "x": 0.005})
    turned = add_frame_uncertainty(detection, np.diag([0.0, 0.0, 0.001**2]))
    assert turned.std == pytest.approx({**(detection.std or {}), "x": 0.005, "y": 0.003, "theta": 0.001})
    assert turned.covariance is not None and detection.covariance is not None
    lever = np.array([4.0, 3.0, 1.0]) * 0.001  # the place and the angle turn together
    assert turned.covariance[:3, :3] - detection.covariance[:3, :3] == pytest.approx(np.outer(lever, lever))
    assert np.array_equal(turned.covariance[3:], detection.covariance[3:])
