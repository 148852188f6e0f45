"""Primitives in a replay: the report, the recording, the detector's own map; with a detector that knows the truth."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from detect.detection import Detection, Detections, Rejection
from detect.detector import Detector
from detect.networks.weights import Card
from mapping.grid import OccupancyGrid
from mapping.mapper import MAPPERS
from prim import console
from prim.errors import UsageError
from prim.shapes import Kind, Primitive
from recorder.session import Session
from replay import cli
from replay.detection import spread_by_frame
from replay.options import ReplayOptions
from replay.pipeline import Pipeline
from replay.report import report, table
from replay.result import ReplayResult
from replay.viewer import RerunViewer
from replay.viewer_protocol import ViewerOptions
from tests.replay.test_viewer import rows_of, timed, value


class Knowing:
    """A detector that finds what is there, 10 mm to the right, and rejects one candidate; ``seen`` are its maps."""

    card = Card("yolo", "any")

    def __init__(self, session: Session) -> None:
        self.session = session
        self.seen: list[OccupancyGrid] = []

    def detect(self, grid: OccupancyGrid) -> Detections:
        self.seen.append(grid)
        crop = np.full((72, 72), 7, np.uint8)
        moved = [replace(one, x=one.x + 0.01) for one in self.session.world.primitives]
        rejection = Rejection(Kind.CIRCLE, 0.1, 0.5, 0.25, "score 0.10 is below 0.30, the least for a circle")
        return Detections(tuple(Detection(one, 0.9, (0.0, 0.0, 0.1, 0.1), crop) for one in moved), (rejection,))


@pytest.fixture
def knowing(noisy_session: Session, monkeypatch: pytest.MonkeyPatch) -> Knowing:
    made = Knowing(noisy_session)
    monkeypatch.setattr(Detector, "load", lambda path, mapper=None, threads=None: made)
    return made


def replayed(session: Session, viewer: RerunViewer | None = None, **options: object) -> ReplayResult:
    chosen = ReplayOptions(weights=Path("w"), **{"refine": False} | options)  # type: ignore[arg-type]
    return Pipeline(session.path, chosen, viewer).run()


@pytest.mark.parametrize("mapper", MAPPERS)
def test_the_report_lists_what_was_found(noisy_session: Session, knowing: Knowing, mapper: str) -> None:
    told = report(replayed(noisy_session, mapper=mapper))
    assert json.loads(json.dumps(told)) == told
    truth = noisy_session.world.primitives
    assert [one["id"] for one in told["primitives"]] == list(range(1, len(truth) + 1))
    for one, true in zip(told["primitives"], truth, strict=True):
        assert (one["kind"], one["stage"], one["score"], one["std"]) == (true.kind, "detected", 0.9, None)
        assert one["x"] == pytest.approx(true.x + 0.01) and one["size"] == true.sizes
    errors = told["errors"]
    assert [errors[name] for name in ("position_m", "width_m", "angle_rad")] == pytest.approx([0.01, 0, 0], abs=1e-9)
    assert {pair["truth"]: pair["id"] for pair in errors["pairs"]} == {k: k + 1 for k in range(len(truth))}
    assert told["timing"]["detect_s"] > 0
    assert len(knowing.seen) == 1


@pytest.mark.parametrize("mapper", MAPPERS)
def test_what_was_found_is_refined_by_the_rays(noisy_session: Session, knowing: Knowing, mapper: str) -> None:
    """The detector is 10 mm off; the rays are not, though their noise is 50 mm."""
    told = report(replayed(noisy_session, mapper=mapper, refine=True))
    assert json.loads(json.dumps(told)) == told
    assert told["errors"]["f1"] > 0.7  # two of seven cannot be told from a circle and a square in so few rays
    assert told["errors"]["position_m"] < 0.004
    for one in told["primitives"]:
        assert one["stage"] == "refined" and 0 < one["score"] <= 1
        assert set(one["std"]) == {"x", "y", *one["size"], *(["theta"] if one["theta"] is not None else [])}
        assert all(0 < value < (1.0 if name == "theta" else 0.3) for name, value in one["std"].items())
        assert one["chances"][one["kind"]] == one["score"] == max(one["chances"].values())
    assert told["refine"]["noise_std_m"] == pytest.approx(0.05, rel=0.15)
    assert told["timing"]["refine_s"] > 0


def test_refinement_on_the_way_is_on_the_timeline(noisy_session: Session, knowing: Knowing, tmp_path: Path) -> None:
    viewer = RerunViewer(ViewerOptions(save=tmp_path / "a.rrd"), announce=print)
    replayed(noisy_session, viewer, mapper="forward", detect_every=10, refine=True)
    rows = rows_of(tmp_path / "a.rrd")
    lengths = [value(row, "scalars")[0] for row in timed(rows["/errors/lengths"])]
    assert lengths[-1] < 4.0  # mm
    bands = timed(rows["/map/uncertainty"])
    assert len(bands) == len(lengths)
    assert len(value(bands[-1], "strips")) == 2 * len(value(timed(rows["/map/detections"])[-1], "strips"))


def test_no_detection_where_none_is_wanted(noisy_session: Session, knowing: Knowing) -> None:
    told = report(Pipeline(noisy_session.path, ReplayOptions(detect=False)).run())
    assert told["primitives"] == [] and told["errors"] is None and knowing.seen == []


def test_detection_on_the_way_is_on_the_timeline(noisy_session: Session, knowing: Knowing, tmp_path: Path) -> None:
    viewer = RerunViewer(ViewerOptions(save=tmp_path / "a.rrd"), announce=print)
    result = replayed(noisy_session, viewer, mapper="prob", detect_every=10)
    rows = rows_of(tmp_path / "a.rrd")
    outlines = timed(rows["/map/detections"])
    wanted = [*range(9, result.scans, 10)]
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


def test_the_detector_keeps_a_map_of_its_own(noisy_session: Session, knowing: Knowing) -> None:
    result = replayed(noisy_session, mapper="prob", resolution=0.05, detect_every=12)
    assert result.grid.frame.resolution == 0.05
    assert {grid.frame.resolution for grid in knowing.seen} == {0.01} and len(knowing.seen) > 1
    assert [np.count_nonzero(grid.occupied) for grid in knowing.seen] == sorted(
        np.count_nonzero(grid.occupied) for grid in knowing.seen
    )


def test_rejected_candidates_are_told_at_verbose(
    noisy_session: Session, knowing: Knowing, in_tmp: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    command = [str(noisy_session.path), "--weights", "w", "--no-refine", "--no-viewer", "--verbose"]
    assert console.run(cli.app, "prim-replay", command) == 0
    seen = capsys.readouterr()
    wanted = "rejected: circle at (0.50, 0.25) m, score 0.10: score 0.10 is below 0.30, the least for a circle"
    assert wanted in seen.err
    assert "position 10.0 mm, size 0.0 mm, angle 0.0 deg (means)" in seen.out


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ({"detect": False, "detect_every": 3}, "--no-detect excludes"),
        ({"detect": False, "weights": Path("w")}, "--no-detect excludes"),
        ({"detect": False, "refine": False}, "--no-detect excludes"),
        ({"detect_every": 0}, "--detect-every is 0"),
    ],
)
def test_impossible_options(options: dict[str, object], said: str) -> None:
    with pytest.raises(UsageError, match=said):
        ReplayOptions(**options)  # type: ignore[arg-type]


@pytest.mark.parametrize(("content", "said"), [(b"junk", "no ONNX network"), (b"PK\x03\x04", "pickle")])
def test_weights_that_cannot_be_used(
    noisy_session: Session, in_tmp: Path, capsys: pytest.CaptureFixture[str], content: bytes, said: str
) -> None:
    Path("w.onnx").write_bytes(content)
    assert console.run(cli.app, "prim-replay", [str(noisy_session.path), "--weights", "w.onnx"]) == 1
    error = capsys.readouterr().err
    assert said in error and error.count("\n") == 1 and not list(Path().glob("*.rrd*"))


def test_without_weights_the_table_says_so(noisy_session: Session, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("detect.networks.weights.SHIPPED", Path("nowhere"))
    result = Pipeline(noisy_session.path, ReplayOptions()).run()
    assert "not looked for: no weights for maps of det" in dict(table(result))["primitives"] and not result.notes
    with pytest.raises(UsageError, match="give --weights"):
        Pipeline(noisy_session.path, ReplayOptions(detect_every=3)).run()


def test_a_map_that_is_too_large_for_the_detector(
    noisy_session: Session, knowing: Knowing, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The map itself fits: the replay goes on, and says that it does not look for primitives."""
    monkeypatch.setattr("mapping.grid.MAX_CELLS", 10_000)
    monkeypatch.setattr("replay.pipeline.shipped_weights", lambda mapper: Path("w"))
    result = Pipeline(noisy_session.path, ReplayOptions(resolution=0.05)).run()
    assert dict(table(result))["primitives"].startswith("not looked for: a map of")


def test_nothing_is_held_against_the_truth_where_poses_are_in_no_known_frame(
    noisy_session: Session, knowing: Knowing
) -> None:
    told = report(replayed(noisy_session, standing_still=True))
    assert told["primitives"] and told["errors"] is None and told["map"]["scores"] is None


def test_the_gaussian_sensor_model_leaves_the_detector_its_own_map(noisy_session: Session, knowing: Knowing) -> None:
    replayed(noisy_session, mapper="prob", sensor_model="gaussian", noise_std=0.05, resolution=0.05)
    assert knowing.seen[0].frame.resolution == 0.01


def test_a_map_whose_place_is_unsure_makes_places_and_angles_unsure() -> None:
    primitive = Primitive(Kind.RECTANGLE, 3.0, -4.0, 0.2, (0.3, 0.2))
    std = {"x": 0.003, "y": 0.0, "theta": 0.0, "width": 0.001, "height": 0.002}
    shifted = spread_by_frame(primitive, std, np.diag([0.004**2, 0.0, 0.0]))
    assert shifted == pytest.approx(std | {"x": 0.005})
    turned = spread_by_frame(primitive, std, np.diag([0.0, 0.0, 0.001**2]))
    assert turned == pytest.approx(std | {"x": 0.005, "y": 0.003, "theta": 0.001})  # 4 m and 3 m from the origin
