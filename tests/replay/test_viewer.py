"""The recording, read back; and a picture of it, where this machine can render one."""

import math
import os
import subprocess
import sys
from collections import defaultdict
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import rerun as rr

from mapping.grid import OccupancyGrid
from prim.errors import OutputError, UsageError
from prim.log import open_log
from prim.log.messages import SCAN_TOPIC
from prim.se2 import Pose2D
from recorder.sensors import Lidar
from recorder.session import Session, SessionOptions, record_session
from recorder.world import WorldOptions
from replay.options import ReplayOptions
from replay.pipeline import Pipeline
from replay.result import ReplayResult
from replay.scans.selection import Selection
from replay.viewer import RecordingError, RerunViewer
from replay.viewing.protocol import ViewerOptions
from replay.viewing.serving import RecordingServer

RERUN = Path(sys.executable).with_name("rerun")
SCREENSHOT = Path(__file__).parents[2] / "docs" / "screenshot.py"


def replayed(log: Path, path: Path, **options: Any) -> ReplayResult:
    viewer = RerunViewer(ViewerOptions(save=path), announce=print)
    result = Pipeline(log, ReplayOptions(**options), viewer).run()
    viewer.finish([result])
    return result


def rows_of(path: Path, entity: str = "") -> dict[str, list[dict[str, Any]]]:
    """All rows of a recording by entity, static ones too; or those of one entity."""
    rows = defaultdict(list)
    for chunk in rr.chunk.RrdReader(path).stream():
        if entity in ("", chunk.entity_path):
            rows[str(chunk.entity_path)] += chunk.to_record_batch().to_pylist()
    return rows


def value(row: dict[str, Any], component: str) -> Any:
    return next(item for key, item in row.items() if key.split(":")[-1] == component and item is not None)


def timed(rows: list[dict[str, Any]]) -> list[dict[str, Any]]:
    return [row for row in rows if row.get("scan") is not None]


@pytest.fixture(scope="module")
def recording(noisy_session: Session, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, ReplayResult]:
    path = tmp_path_factory.mktemp("rrd") / "a.rrd"
    return path, replayed(noisy_session.path, path, mapper="prob", map_every=5)


def test_a_viewer_that_goes_away_is_an_error_and_costs_the_file_nothing(
    tmp_path: Path, noisy_session: Session
) -> None:
    path, server = tmp_path / "a.rrd", RecordingServer("127.0.0.1")
    viewer = RerunViewer(ViewerOptions(save=path, connect=server.addresses.recording), announce=print)
    result = Pipeline(noisy_session.path, ReplayOptions(selection=Selection(n_scans=10)), viewer).run()
    server.close()
    with pytest.raises(RecordingError, match=r"could not be sent in full: .*; \S*a.rrd is whole$"):
        viewer.finish([result])
    assert len(timed(rows_of(path)["/map/scan"])) == 10
    assert list(tmp_path.iterdir()) == [path]


def test_a_recording_that_rerun_cannot_finish_is_one_line_and_leaves_no_file(
    tmp_path: Path, noisy_session: Session, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(stream: rr.RecordingStream, *, timeout_sec: float) -> None:
        raise RuntimeError("two\nlines\x1b[2J")

    monkeypatch.setattr(rr.RecordingStream, "flush", fail)
    with pytest.raises(RecordingError, match=r"could not be written in full: two lines\\x1b\[2J$"):
        replayed(noisy_session.path, tmp_path / "a.rrd", selection=Selection(n_scans=3), detect=False)
    assert list(tmp_path.iterdir()) == []


def test_a_replay_that_fails_leaves_no_file(tmp_path: Path, noisy_session: Session) -> None:
    def fail(stage: str, done: int, total: int) -> None:
        raise ZeroDivisionError

    viewer = RerunViewer(ViewerOptions(save=tmp_path / "a.rrd"), announce=print)
    with pytest.raises(ZeroDivisionError):
        Pipeline(noisy_session.path, ReplayOptions(detect=False), viewer, fail).run()
    assert list(tmp_path.iterdir()) == []


def test_what_a_terminal_obeys_is_not_in_the_recording(tmp_path: Path, noisy_session: Session) -> None:
    """The viewer's text can be copied to a terminal."""
    log, path = tmp_path / "a\x1b[2J.mcap", tmp_path / "a.rrd"
    log.write_bytes(noisy_session.path.read_bytes())
    viewer = RerunViewer(ViewerOptions(save=path), announce=print)
    result = Pipeline(log, ReplayOptions(selection=Selection(n_scans=3), detect=False), viewer).run()
    viewer.event(0, 0, "a topic\x1b[2J")
    viewer.finish([result])
    rows = rows_of(path)
    assert value(rows["/__properties"][-1], "name") == [r"a\x1b[2J.mcap (prob)"]
    assert value(rows["/events"][-1], "text") == [r"a topic\x1b[2J"]
    assert r"| **log** | a\x1b[2J.mcap, " in value(rows["/summary"][0], "text")[0]


def test_a_recording_that_somebody_removes_is_an_expected_error(tmp_path: Path, noisy_session: Session) -> None:
    """Which does not cost the report."""
    viewer = RerunViewer(ViewerOptions(save=tmp_path / "a.rrd"), announce=print)
    result = Pipeline(noisy_session.path, ReplayOptions(selection=Selection(n_scans=2)), viewer).run()
    (part,) = tmp_path.iterdir()
    part.unlink()
    with pytest.raises(OutputError, match=r"a\.rrd: cannot write"):
        viewer.finish([result])


def test_a_viewer_is_spawned_for_the_recording_and_sends_no_usage_data(
    tmp_path: Path, noisy_session: Session, monkeypatch: pytest.MonkeyPatch
) -> None:
    """rerun spawns none for a recording that does not exist, and prints a warning."""
    spawned = []

    def spawn(connect: bool, recording: rr.RecordingStream | None = None) -> None:
        spawned.append((connect, rr.is_enabled(recording), os.environ.get("CI")))

    monkeypatch.delenv("CI", raising=False)
    monkeypatch.setenv("DISPLAY", ":0")
    monkeypatch.setattr(rr, "spawn", spawn)
    monkeypatch.setattr(rr, "GrpcSink", lambda: rr.FileSink(tmp_path / "sent.rrd"))
    viewer = RerunViewer(ViewerOptions(spawn=True), announce=print)
    viewer.finish([Pipeline(noisy_session.path, ReplayOptions(selection=Selection(n_scans=2)), viewer).run()])
    assert spawned == [(False, True, "true")]
    assert "CI" not in os.environ
    assert len(timed(rows_of(tmp_path / "sent.rrd")["/map/scan"])) == 2


def test_rerun_that_is_switched_off_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("RERUN", "off")
    with pytest.raises(UsageError, match="RERUN"):
        RerunViewer(ViewerOptions(), announce=print)


def test_the_recording_has_exactly_two_timelines(recording: tuple[Path, ReplayResult]) -> None:
    path, result = recording
    scans = timed(rows_of(path)["/map/scan"])
    assert [row["scan"] for row in scans] == list(range(result.scans))
    stamps = [np.datetime64(row["stamp"], "ns").astype(int) for row in scans]
    assert stamps == result.stamps.tolist()
    assert not any("log_time" in row or "log_tick" in row for rows in rows_of(path).values() for row in rows)


def test_scans_are_drawn_at_their_end_points(recording: tuple[Path, ReplayResult], noisy_session: Session) -> None:
    path, result = recording
    with open_log(noisy_session.path) as log:
        scans = [scan for _, scan in log.decoded(log.topics[SCAN_TOPIC])]
    for row in timed(rows_of(path)["/map/scan"])[::7]:
        points = np.array(value(row, "positions"))[:, :2]
        pose = Pose2D(*result.poses.poses[row["scan"]])
        assert points == pytest.approx(scans[row["scan"]].points(pose), abs=1e-5)


def test_the_map_is_neither_mirrored_nor_shifted(recording: tuple[Path, ReplayResult]) -> None:
    """rerun's grid has its first row at the top: the image, flipped back, is the grid."""
    path, result = recording
    rows = rows_of(path)
    maps, looks = timed(rows["/map/grid"]), {row["scan"] for row in timed(rows["/map/detections"])}
    assert {row["scan"] for row in maps} == {0, 5, 10, 15, 20, result.scans - 1} | looks
    assert grid_values(maps[-1]) == pytest.approx(expected_values(result.grid))
    assert value(maps[-1], "translation")[0][:2] == pytest.approx(result.grid.frame.origin)
    assert value(maps[-1], "cell_size") == pytest.approx([0.01])


def grid_values(row: dict[str, Any]) -> np.ndarray:
    form = value(row, "format")[0]
    data = np.frombuffer(bytes(value(row, "data")[0]), np.uint8)
    return np.flipud(data.reshape(form["height"], form["width"]))


def expected_values(grid: OccupancyGrid) -> np.ndarray:
    return np.where(grid.probability == 0.5, 255, np.rint(grid.probability * 100))


def test_the_last_scores_are_those_of_the_result(recording: tuple[Path, ReplayResult]) -> None:
    path, result = recording
    last = timed(rows_of(path)["/scores"])[-1]
    assert result.scores is not None
    scores = result.scores
    expected = [
        *(scores.occupied_f1, scores.occupied_precision, scores.occupied_recall, scores.free_accuracy, scores.auc)
    ]
    assert value(last, "scalars") == pytest.approx(expected)


def test_truth_events_and_summary_are_recorded(recording: tuple[Path, ReplayResult], noisy_session: Session) -> None:
    rows = rows_of(recording[0])
    outlines = value(rows["/map/truth/primitives"][0], "strips")
    assert len(outlines) == len(noisy_session.world.primitives)
    for outline, primitive in zip(outlines, noisy_session.world.primitives, strict=True):
        assert np.array(outline)[:-1, :2] == pytest.approx(primitive.outline(64), abs=1e-6)
    assert len(value(rows["/map/truth/walls"][0], "strips")) == 4
    texts = [value(row, "text")[0] for row in rows["/events"]]
    assert texts == ["23 of 23 scans selected on /scan", "poses: truth (/ground_truth/pose)"]
    assert "precision" in value(rows["/summary"][0], "text")[0]
    assert rows["/timing"]


def test_what_is_truly_no_primitive_is_drawn_in_another_grey(tmp_path: Path) -> None:
    options = SessionOptions(stops=(2, 2), lidar=Lidar(rays=20), world=WorldOptions(per_kind=(1, 1), clutter=(2, 2)))
    session = record_session(tmp_path / "a.mcap", options)
    replayed(session.path, tmp_path / "a.rrd", detect=False)
    rows = rows_of(tmp_path / "a.rrd")
    outlines = value(rows["/map/truth/others"][0], "strips")
    assert value(rows["/map/truth/others"][0], "labels") == [solid.name for solid in session.world.clutter]
    for outline, solid in zip(outlines, session.world.clutter, strict=True):
        assert np.array(outline)[:-1, :2] == pytest.approx(np.array(solid.outline), abs=1e-6)
    greys = [value(rows[f"/map/truth/{name}"][0], "colors") for name in ("primitives", "others")]
    assert greys[0] != greys[1] and len(value(rows["/map/truth/primitives"][0], "strips")) == 5


def test_a_blueprint_is_saved_with_the_recording(recording: tuple[Path, ReplayResult]) -> None:
    printed = subprocess.run([RERUN, "rrd", "print", recording[0]], capture_output=True, text=True, check=True)
    assert "Blueprint" in printed.stdout


def test_pose_errors_are_drawn_where_poses_are_compared(noisy_session: Session, tmp_path: Path) -> None:
    result = replayed(noisy_session.path, tmp_path / "a.rrd", pose="odom")
    errors = timed(rows_of(tmp_path / "a.rrd")["/pose_error/position"])
    assert len(errors) == result.scans
    error, std = value(errors[-1], "scalars")
    assert error == pytest.approx(0, abs=1e-6) and math.isnan(std)


def test_fused_poses_are_drawn_with_their_uncertainty(noisy_session: Session, tmp_path: Path) -> None:
    result = replayed(noisy_session.path, tmp_path / "a.rrd", pose="fused")
    rows = rows_of(tmp_path / "a.rrd")
    error, std = value(timed(rows["/pose_error/position"])[-1], "scalars")
    assert 0 <= error < 5 * std
    ellipses = timed(rows["/map/laser_95_percent"])
    assert len(ellipses) == result.scans
    ring = np.array(value(ellipses[-1], "strips")[0])[:, :2]
    pose, covariance = result.poses.poses[-1], result.poses.covariances
    assert covariance is not None
    off = ring - pose[:2]
    squared = np.einsum("ni,ij,nj->n", off, np.linalg.inv(covariance[-1][:2, :2]), off)
    assert squared == pytest.approx(5.991, rel=1e-2)  # two degrees of freedom: 95 %


def test_a_paced_selection_is_drawn_completely(noisy_session: Session, tmp_path: Path) -> None:
    viewer = RerunViewer(ViewerOptions(save=tmp_path / "a.rrd", live=True), announce=print)
    options = ReplayOptions(selection=Selection(n_scans=4), rate=100.0)
    viewer.finish([Pipeline(noisy_session.path, options, viewer).run()])
    assert len(timed(rows_of(tmp_path / "a.rrd")["/map/scan"])) == 4


@pytest.fixture(scope="module")
def comparison(
    noisy_session: Session, tmp_path_factory: pytest.TempPathFactory
) -> tuple[Path, dict[str, ReplayResult]]:
    path = tmp_path_factory.mktemp("rrd") / "several.rrd"
    viewer = RerunViewer(ViewerOptions(save=path), announce=print)
    results = Pipeline(noisy_session.path, ReplayOptions(mapper="det,prob,forward"), viewer).run_each()
    viewer.finish(results)
    return path, {result.options.mapper: result for result in results}


def test_several_mappers_share_a_recording(comparison: tuple[Path, dict[str, ReplayResult]]) -> None:
    path, results = comparison
    rows = rows_of(path)
    for mapper, result in results.items():
        last = timed(rows[f"/{mapper}/map/grid"])[-1]
        assert grid_values(last) == pytest.approx(expected_values(result.grid))
        assert result.scores is not None and result.detections is not None and result.detections.errors is not None
        scores = value(timed(rows[f"/{mapper}/scores"])[-1], "scalars")
        assert scores[0] == pytest.approx(result.scores.occupied_f1)
        f1 = [value(row, "scalars")[0] for row in timed(rows[f"/{mapper}/errors/found"])]
        assert f1[-1] == pytest.approx(result.detections.errors.f1) and len(f1) >= 6
        assert len(timed(rows[f"/{mapper}/timing"])) == result.scans
    assert len(timed(rows["/map/scan"])) == next(iter(results.values())).scans
    assert "/map/grid" not in rows
    summary = value(rows["/summary"][0], "text")[0]
    assert "| mapper | noise, mm | map F1, % |" in summary and all(f"| {mapper} |" in summary for mapper in results)


def test_errors_and_maps_are_there_from_the_first_scan_on(recording: tuple[Path, ReplayResult]) -> None:
    path, result = recording
    rows = rows_of(path)
    looks = sorted({row["scan"] for row in timed(rows["/errors/found"])})
    assert looks[0] == 0 and looks[-1] == result.scans - 1 and 6 <= len(looks) <= 8
    assert timed(rows["/scores"])[0]["scan"] == 0 and timed(rows["/detections"])[0]["scan"] == 0


def can_render() -> bool:
    """Whether a Vulkan driver is installed; rerun needs one to draw without a screen."""
    folders = ("/usr/share/vulkan/icd.d", "/etc/vulkan/icd.d")
    return bool(os.environ.get("VK_DRIVER_FILES")) or any(
        Path(folder).is_dir() and any(Path(folder).iterdir()) for folder in folders
    )


@pytest.mark.skipif(not can_render(), reason="no Vulkan driver here to render with (mesa-vulkan-drivers)")
@pytest.mark.parametrize("recorded", ["recording", "comparison"])
def test_the_viewer_draws_every_view(recorded: str, request: pytest.FixtureRequest, tmp_path: Path) -> None:
    picture, rrd = tmp_path / "a.png", request.getfixturevalue(recorded)[0]
    done = subprocess.run(
        [sys.executable, SCREENSHOT, rrd, picture], capture_output=True, text=True, check=False, timeout=120
    )
    assert done.returncode == 0, done.stderr
    assert picture.read_bytes().startswith(b"\x89PNG")
    assert picture.stat().st_size > 30_000


def test_recorded_logs_open_in_the_importer_of_rerun(noisy_session: Session, tmp_path: Path) -> None:
    """The importer draws the poses and the transforms of a ROS 2 log; one it cannot read leaves nothing."""
    converted = tmp_path / "a.rrd"
    subprocess.run(
        [RERUN, "mcap", "convert", noisy_session.path, "-o", converted], capture_output=True, check=True, timeout=60
    )
    rows = rows_of(converted)
    drawn = {"/ground_truth/pose": "InstancePoses3D:translations", "/tf": "Transform3D:translation"}
    for entity, component in drawn.items():
        assert sum(component in row for row in rows[entity]) == noisy_session.scans
    assert sum("Transform3D:translation" in row for row in rows["/tf_static"]) == 1


def test_loops_are_drawn_where_they_were_closed(real_log: Callable[[str], Path], tmp_path: Path) -> None:
    options = {"mapper": "det", "resolution": 0.05, "pose": "scans", "detect": False}
    result = replayed(real_log("csail_raw.mcap"), path := tmp_path / "a.rrd", **options)
    loops = result.poses.loops
    assert loops is not None and loops.closed > 3 and len(loops.pairs) >= loops.closed
    strips = np.array(value(rows_of(path, "/map/loops")["/map/loops"][0], "strips"))[..., :2]
    assert strips == pytest.approx(result.poses.poses[loops.pairs, :2], abs=1e-4)
    assert np.linalg.norm(strips[:, 1] - strips[:, 0], axis=1).max() < 6
