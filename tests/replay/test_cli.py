"""The command line prim-replay: outputs, exit codes, one line per error."""

import json
import math
import os
import shutil
import signal
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from detect.networks.weights import SHIPPED, shipped_weights
from mapping.mapper import MAPPERS
from prim import console
from recorder.sensors import Lidar
from recorder.session import Session, SessionOptions, record_session
from replay.cli import app, join_bounds
from replay.outputs import exports

Run = Callable[..., tuple[int, str, str]]


@pytest.fixture
def replay(in_tmp: Path, capsys: pytest.CaptureFixture[str]) -> Run:
    """Run prim-replay in an empty folder; return exit code, stdout, stderr."""

    def run(*arguments: object) -> tuple[int, str, str]:
        code = console.run(app, "prim-replay", join_bounds([str(argument) for argument in arguments]))
        seen = capsys.readouterr()
        return code, seen.out, seen.err

    return run


def report_of(path: str) -> dict[str, Any]:
    parsed: dict[str, Any] = json.loads(Path(path).read_text())
    return parsed


@pytest.mark.parametrize("mapper", MAPPERS)
def test_a_replay_writes_a_recording_and_a_report_by_default(
    replay: Run, noisy_session: Session, mapper: str
) -> None:
    code, out, err = replay(noisy_session.path, "--mapper", mapper)
    assert (code, err) == (0, "")
    assert {path.name for path in Path().iterdir()} == {f"noisy.{mapper}.rrd", f"noisy.{mapper}.report.json"}
    assert out.splitlines()[-1] == f"open:  rerun noisy.{mapper}.rrd"
    report = report_of(f"noisy.{mapper}.report.json")
    assert report["schema"] == "prim-replay/1"
    assert report["log"] == {
        "path": str(noisy_session.path),
        "format": "MCAP",
        "duration_s": pytest.approx(noisy_session.duration),
        "scans": noisy_session.scans,
        "scans_used": noisy_session.scans,
        "rays": noisy_session.scans * 180,
        "messages_lost": 0,
        "recovered": False,
    }
    unknown = dict.fromkeys(("rmse_m", "rmse_rad", "std_m", "std_rad", "nees", "loops", "sensors"))
    assert report["pose"] == {"source": "truth", "matched": False, **unknown}
    assert report["map"]["mapper"] == mapper
    assert report["map"]["origin_m"] == pytest.approx([-1.1, -1.1])
    assert report["map"]["cells"] == [220, 220]
    if mapper == "forward":
        assert report["map"]["noise_std_m"] == pytest.approx(0.05, rel=0.1)
        quartiles = report["map"]["evidence"]["rays_per_cell_quartiles"]
        assert report["map"]["evidence"]["cells_known"] > 10_000 and quartiles == sorted(quartiles)
        assert "range noise" in out
    else:
        assert report["map"]["noise_std_m"] is report["map"]["evidence"] is None
    assert set(report["map"]["scores"]) == {
        *("occupied_precision", "occupied_recall", "occupied_f1", "free_accuracy", "auc")
    }
    ids = [one["id"] for one in report["primitives"]]  # those of tracks
    assert len(set(ids)) == len(ids) and min(ids, default=1) >= 1
    assert (report["errors"] is not None) == (shipped_weights(mapper) is not None)
    assert set(report["timing"]) == {
        *("read_s", "localize_s", "map_s", "detect_s", "refine_s", "viewer_s", "total_s"),
        *("rays_per_s", "x_realtime"),
    }


@pytest.mark.parametrize(
    ("options", "heavy", "files"),
    [
        (
            "--detect-every 20",
            {"torch", "ultralytics"},
            {"report.json", "rrd"},
        ),
        ("--no-viewer", {"rerun", "torch", "ultralytics", "matplotlib", "filterpy"}, {"report.json"}),
        (
            "--no-viewer --no-detect",
            {"rerun", "torch", "matplotlib", "filterpy", "shapely", "onnxruntime"},
            {"report.json"},
        ),
    ],
)
def test_unused_libraries_are_not_loaded_and_unused_outputs_not_written(
    noisy_session: Session, tmp_path: Path, options: str, heavy: set[str], files: set[str]
) -> None:
    code = (
        f"import sys; from replay.cli import main; sys.argv[2:] = '--quiet {options}'.split()\n"
        "try: main()\nexcept SystemExit as stop: assert not stop.code, stop.code\n"
        f"bad = {heavy} & set(sys.modules)\n"
        "assert not bad, bad"
    )
    done = subprocess.run(
        [sys.executable, "-c", code, noisy_session.path], cwd=tmp_path, capture_output=True, check=False
    )
    assert (done.returncode, done.stdout, done.stderr) == (0, b"", b"")
    assert {path.name for path in tmp_path.iterdir()} == {f"noisy.prob.{ending}" for ending in files}


def test_help_and_version_load_nothing_heavy() -> None:
    code = (
        "import sys; from {0}.cli import main; sys.argv[1:] = ['{1}']\n"
        "try: main()\nexcept SystemExit as stop: assert not stop.code, stop.code\n"
        "assert not {{'numpy', 'numba', 'rerun', 'mcap', 'pymunk'}} & set(sys.modules)"
    )
    for package in ("recorder", "replay"):
        for option in ("--help", "--version"):
            done = subprocess.run(
                [sys.executable, "-c", code.format(package, option)], capture_output=True, text=True, check=False
            )
            assert (done.returncode, done.stderr) == (0, ""), done.stderr


def test_all_outputs_can_be_named(replay: Run, noisy_session: Session) -> None:
    code, out, _ = replay(
        *(noisy_session.path, "--save", "a.rrd", "--report", "b.json", "--map", "c", "--trajectory", "d.tum")
    )
    assert code == 0
    assert {path.name for path in Path().iterdir()} == {"a.rrd", "b.json", "c.pgm", "c.yaml", "d.tum"}
    assert "a.rrd" in out
    lines = [line.split() for line in Path("d.tum").read_text().splitlines()]
    assert len(lines) == noisy_session.scans
    assert all(len(line) == 8 for line in lines)
    assert lines[0][0] == "1735689600.000000000"


def test_the_nav2_map_is_read_back_as_the_grid(replay: Run, noisy_session: Session) -> None:
    """As nav2's map_server reads it: trinary, first image row at the top, the origin at the lower left."""
    from replay.options import ReplayOptions
    from replay.pipeline import Pipeline

    assert replay(noisy_session.path, "--mapper", "det", "--map", "m", "--no-viewer")[0] == 0
    yaml = dict(line.split(": ", 1) for line in Path("m.yaml").read_text().splitlines())
    header, size, depth, pixels = Path(yaml["image"]).read_bytes().split(b"\n", 3)
    assert (header, depth, yaml["mode"], yaml["negate"]) == (b"P5", b"255", "trinary", "0")
    cols, rows = map(int, size.split())
    occupancy = 1 - np.flipud(np.frombuffer(pixels, np.uint8).reshape(rows, cols)) / 255
    cells = np.full(occupancy.shape, -1)
    cells[occupancy > float(yaml["occupied_thresh"])] = 100
    cells[occupancy < float(yaml["free_thresh"])] = 0
    grid = Pipeline(noisy_session.path, ReplayOptions(mapper="det")).run().grid
    assert (cells == np.select([grid.occupied, grid.free], [100, 0], -1)).all()
    assert json.loads(yaml["origin"]) == pytest.approx([*grid.frame.origin, 0])
    assert float(yaml["resolution"]) == grid.frame.resolution


@pytest.mark.parametrize("pose", ["truth", "tf", "odom"])
def test_all_pose_sources_of_a_warped_session_agree(replay: Run, noisy_session: Session, pose: str) -> None:
    assert replay(noisy_session.path, "--pose", pose, "--no-viewer")[0] == 0
    report = report_of("noisy.prob.report.json")
    assert report["pose"]["source"] == pose
    if pose != "truth":
        assert report["pose"]["rmse_m"] == pytest.approx(0, abs=1e-9)
        assert report["pose"]["rmse_rad"] == pytest.approx(0, abs=1e-9)


def test_selections(replay: Run, noisy_session: Session) -> None:
    scans = noisy_session.scans

    def used(*options: object) -> int:
        assert replay(noisy_session.path, "--no-viewer", "--quiet", *options) == (0, "", "")
        log = report_of("noisy.prob.report.json")["log"]
        assert log["scans"] == scans
        return int(log["scans_used"])

    assert used("--n-scans", 7) == 7
    assert used("--stride", 3) == math.ceil(scans / 3)
    assert used("--start", 0.95) == scans - 10
    assert used("--end", 0.95) == 10
    assert used("--start", 0.45, "--duration", 0.5) == 5
    assert used("--start", 0.45, "--stride", 2, "--n-scans", 2) == 2


def test_bounds_and_resolution(replay: Run, noisy_session: Session) -> None:
    assert (
        replay("--bounds", "-0.5", "-0.25", "1", "0.5", noisy_session.path, "--resolution", 0.05, "--no-viewer")[0]
        == 0
    )
    frame = report_of("noisy.prob.report.json")["map"]
    assert frame["cells"] == [15, 30]
    assert frame["origin_m"] == pytest.approx([-0.5, -0.25])
    assert replay(noisy_session.path, "--bounds", "auto", "--no-viewer")[0] == 0


def test_a_laser_offset_moves_the_map(replay: Run, noisy_session: Session) -> None:
    for name, options in (("a", []), ("b", ["--laser-offset", -0.1, 0.2, 90])):
        replay(noisy_session.path, "--no-viewer", "--trajectory", f"{name}.tum", *options)
    plain, moved = (np.loadtxt(f"{name}.tum") for name in "ab")
    offset = np.hypot(*(moved - plain)[:, 1:3].T)
    assert offset == pytest.approx(math.hypot(0.1, 0.2), abs=1e-6)
    turn = 2 * np.arctan2(moved[:, 6], moved[:, 7]) - 2 * np.arctan2(plain[:, 6], plain[:, 7])
    assert np.cos(turn) == pytest.approx(0, abs=1e-6)


def test_a_replay_is_not_faster_than_its_rate(replay: Run, noisy_session: Session) -> None:
    """A replay may be slower than the rate, but not faster."""
    assert replay(noisy_session.path, "--n-scans", 6, "--rate", 2, "--no-viewer")[0] == 0
    assert report_of("noisy.prob.report.json")["timing"]["total_s"] >= 0.25


def test_several_logs_have_outputs_of_their_own(replay: Run, noisy_session: Session, quiet_session: Session) -> None:
    assert replay(noisy_session.path, quiet_session.path, "--mapper", "det", "--no-viewer")[0] == 0
    assert {path.name for path in Path().iterdir()} == {"noisy.det.report.json", "quiet.det.report.json"}
    code, _, err = replay(noisy_session.path, quiet_session.path, "--map", "m")
    assert (code, "would be written twice" in err) == (2, True)
    twin = Path("twin") / "noisy.mcap"
    twin.parent.mkdir()
    twin.write_bytes(noisy_session.path.read_bytes())
    for logs in ((noisy_session.path, twin), (twin, twin)):
        assert replay(*logs, "--no-viewer")[0] == 2


def test_an_unreadable_log_does_not_stop_the_others(replay: Run, noisy_session: Session) -> None:
    Path("bad.mcap").write_bytes(b"")
    code, _, err = replay("bad.mcap", noisy_session.path, "--no-viewer")
    assert (code, err.count("\n")) == (1, 1)
    assert Path("noisy.prob.report.json").exists()
    Path("cut.mcap").write_bytes(noisy_session.path.read_bytes()[:-200])  # of which a part is lost
    assert replay("cut.mcap", "bad.mcap", "--recover", "--no-viewer", "--no-detect")[0] == 1


@pytest.mark.parametrize("option", ["--save", "--report", "--trajectory"])
def test_no_output_overwrites_a_log(replay: Run, noisy_session: Session, option: str) -> None:
    before = noisy_session.path.read_bytes()
    code, _, err = replay(noisy_session.path, option, noisy_session.path)
    assert (code, "is the input" in err) == (2, True)
    assert noisy_session.path.read_bytes() == before
    assert replay(noisy_session.path, "--report", "same", option, "same")[0] == (0 if option == "--report" else 2)


def test_no_output_overwrites_the_weights(replay: Run, noisy_session: Session) -> None:
    shutil.copytree(SHIPPED / "prob", "w")
    before = Path("w/yolo.onnx").read_bytes()
    code, _, err = replay(noisy_session.path, "--weights", "w", "--report", "w/yolo.onnx", "--force")
    assert (code, "belongs to the input w:" in err) == (2, True)
    assert Path("w/yolo.onnx").read_bytes() == before


def test_a_replay_that_fails_keeps_the_earlier_recording(replay: Run, noisy_session: Session) -> None:
    assert replay(noisy_session.path, "--save", "a.rrd", "--no-detect", "--report", "a.json")[0] == 0
    Path("a.json").unlink()
    earlier = Path("a.rrd").read_bytes()
    data = bytearray(noisy_session.path.read_bytes())
    data[len(data) // 2] ^= 0xFF
    Path("bad.mcap").write_bytes(data)
    assert replay("bad.mcap", "--save", "a.rrd")[0] == 1
    assert Path("a.rrd").read_bytes() == earlier
    assert {path.name for path in Path().iterdir()} == {"a.rrd", "bad.mcap"}


def test_an_interruption_while_outputs_are_written_waits_for_all_of_them(
    replay: Run, noisy_session: Session, monkeypatch: pytest.MonkeyPatch
) -> None:
    write = exports.write_report

    def interrupted_write(*arguments: Any) -> None:
        os.kill(os.getpid(), signal.SIGTERM)
        write(*arguments)

    monkeypatch.setattr(exports, "write_report", interrupted_write)
    options = ("--no-detect", "--no-viewer", "--map", "m", "--trajectory", "t.tum", "--n-scans", 3)
    code, _, err = replay(noisy_session.path, *options)
    assert (code, err) == (143, "prim-replay: error: interrupted\n")
    assert {path.name for path in Path().iterdir()} == {"noisy.prob.report.json", "m.pgm", "m.yaml", "t.tum"}


def test_an_interruption_ends_the_replays_of_all_logs(
    replay: Run, noisy_session: Session, quiet_session: Session, monkeypatch: pytest.MonkeyPatch
) -> None:
    stamps = []

    def wait(pacer: object, stamp: int) -> None:
        stamps.append(stamp)
        if len(stamps) == 3:
            os.kill(os.getpid(), signal.SIGINT)

    monkeypatch.setattr("replay.pipeline.RatePacer.wait", wait)
    code, _, err = replay(noisy_session.path, quiet_session.path, "--no-detect", "--no-viewer")
    assert code == 130 and "note: interrupted after 2 of" in err
    assert [path.name for path in Path().iterdir()] == ["noisy.prob.report.json"]


def test_max_range_leaves_fewer_occupied_cells(replay: Run, noisy_session: Session) -> None:
    assert replay(noisy_session.path, "--max-range", 0.3, "--no-viewer", "--map", "near")[0] == 0
    assert replay(noisy_session.path, "--no-viewer", "--map", "far")[0] == 0
    near, far = (np.frombuffer(Path(f"{name}.pgm").read_bytes()[-220 * 220 :], np.uint8) for name in ("near", "far"))
    assert np.count_nonzero(near == 0) < np.count_nonzero(far == 0)


def test_bounds_without_any_ray_are_noted(replay: Run, noisy_session: Session) -> None:
    code, _, err = replay(noisy_session.path, "--bounds", 100, 100, 101, 101, "--no-viewer")
    assert (code, "no ray crosses the map's bounds" in err) == (0, True)


def test_a_truncated_log_is_refused_and_salvaged_with_exit_code_3(replay: Run, noisy_session: Session) -> None:
    data = noisy_session.path.read_bytes()
    Path("cut.mcap").write_bytes(data[:-200])
    code, out, err = replay("cut.mcap", "--no-viewer")
    assert (code, out) == (1, "")
    assert "truncated" in err and "--recover" in err and err.count("\n") == 1
    code, _, err = replay("cut.mcap", "--no-viewer", "--recover")
    assert code == 3
    assert "note: lost: all beyond byte" in err
    log = report_of("cut.prob.report.json")["log"]
    assert (log["recovered"], log["messages_lost"], log["scans"]) == (True, 0, noisy_session.scans)


def test_several_mappers_leave_one_recording_and_a_report_each(replay: Run, noisy_session: Session) -> None:
    code, out, err = replay(noisy_session.path, "--mapper", "det,forward", "--map", "m", "--trajectory", "t.tum")
    assert (code, err) == (0, "")
    assert {path.name for path in Path().iterdir()} == {
        *("noisy.det-forward.rrd", "noisy.det.report.json", "noisy.forward.report.json", "t.tum"),
        *(f"m.{mapper}.{suffix}" for mapper in ("det", "forward") for suffix in ("pgm", "yaml")),
    }
    header, units, det, forward = (line.split() for line in out.splitlines()[3:7])
    assert header[:4] == ["mapper", "noise", "map", "F1"] and units[:2] == ["mm", "%"]
    assert det[0] == "det" and forward[0] == "forward" and float(forward[1]) == pytest.approx(50, rel=0.1)
    assert max(map(len, out.splitlines()[:7])) <= 80
    assert {report_of(f"noisy.{mapper}.report.json")["map"]["mapper"] for mapper in ("det", "forward")} == {
        *("det", "forward")
    }


def test_the_line_that_opens_the_recording_can_be_pasted(replay: Run, noisy_session: Session) -> None:
    Path("my log.v1.mcap").write_bytes(noisy_session.path.read_bytes())
    code, out, _ = replay("my log.v1.mcap", "--mapper", "det,prob", "--no-detect", "--map", "out.v1")
    assert code == 0 and out.splitlines()[-1] == "open:  rerun 'my log.v1.det-prob.rrd'"
    assert {path.name for path in Path().glob("out*")} == {
        f"out.v1.{mapper}.{suffix}" for mapper in ("det", "prob") for suffix in ("pgm", "yaml")
    }


def test_a_named_report_of_several_mappers_gets_their_names(replay: Run, noisy_session: Session) -> None:
    options = ["--mapper", "det,prob", "--no-viewer", "--report", "a.json", "--no-detect"]
    assert replay(noisy_session.path, *options)[0] == 0
    assert {path.name for path in Path().iterdir()} == {"a.det.json", "a.prob.json"}


def test_tracks_need_no_viewer(replay: Run, noisy_session: Session) -> None:
    assert replay(noisy_session.path, "--no-viewer", "--detect-every", "5")[0] == 0
    assert [path.name for path in Path().iterdir()] == ["noisy.prob.report.json"]


@pytest.mark.parametrize(("noise", "expected"), [([], 0.05), (["--noise-std", "0.2"], 0.2)])
@pytest.mark.parametrize("kind", [["--sensor-model", "gaussian"], ["--mapper", "forward"]])
def test_the_range_noise_is_given_or_estimated(
    replay: Run, noisy_session: Session, kind: list[str], noise: list[str], expected: float
) -> None:
    assert replay(noisy_session.path, "--no-viewer", "--report", "a.json", *kind, *noise)[0] == 0
    found = report_of("a.json")["map"]["noise_std_m"]
    assert found == pytest.approx(expected, rel=0.1 if not noise else 1e-9)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--resolution", "0"], "--resolution"),
        (["--resolution", "nan"], "--resolution"),
        (["--resolution", "1e-5"], "million cells"),
        (["--resolution", "1e-320"], "--resolution"),
        (["--resolution", "1e300"], "--resolution"),
        (["--bounds", "-1e308", "-1e308", "1e308", "1e308"], "--bounds"),
        (["--bounds", "-1e5", "-1e5", "1e5", "1e5"], "million cells"),
        (["--rate", "1e-320"], "--rate"),
        (["--rate", "1e300"], "--rate"),
        (["--laser-offset", "1e300", "0", "0"], "--laser-offset"),
        (["--laser-offset", "0", "0", "1e300"], "--laser-offset"),
        (["--pose", "fused", "--pose-noise", "1e300", "1"], "--pose-noise"),
        (["--pose", "fused", "--pose-noise", "1e-300", "1"], "--pose-noise"),
        (["--pose", "fused", "--odom-noise", "1", "1e300"], "--odom-noise"),
        (["--mapper", "forward", "--noise-std", "1e300"], "--noise-std"),
        (["--mapper", "forward", "--noise-std", "1e-300"], "--noise-std"),
        (["--sensor-model", "gaussian", "--noise-std", "1e300"], "--noise-std"),
        (["--bounds", "1", "2", "3"], "--bounds"),
        (["--bounds", "1", "0", "0", "1"], "X0 must be below X1"),
        (["--start", "-1"], "--start"),
        (["--start", "nan"], "--start"),
        (["--max-range", "0"], "--max-range"),
        (["--laser-offset", "nan", "0", "0"], "--laser-offset"),
        (["--odom-topic", "/odom", "--pose", "tf"], "--odom-topic"),
        (["--no-viewer", "--map-every", "3"], "--map-every"),
        (["--stride", "0"], "--stride"),
        (["--n-scans", "0"], "--n-scans"),
        (["--end", "1", "--duration", "1"], "give one of them"),
        (["--start", "2", "--end", "1"], "not after"),
        (["--rate", "0"], "--rate"),
        (["--map-every", "0"], "--map-every"),
        (["--mapper", "magic"], "no mapper 'magic'"),
        (["--mapper", "det,det"], "named twice"),
        (["--mapper", "det,prob", "--weights", "w.onnx"], "--weights goes with one mapper"),
        (["--mapper", "det,forward", "--sensor-model", "gaussian"], "--sensor-model goes with --mapper prob"),
        (["--mapper", "det,prob", "--noise-std", "0.1"], "--noise-std goes with --mapper forward"),
        (["--detect-every", "0"], "--detect-every"),
        (["--detect-every", "often"], "a number of scans, or end"),
        (["--noise-std", "0.1"], "--noise-std goes with --mapper forward"),
        (["--mapper", "det", "--noise-std", "0.1"], "--noise-std goes with --mapper forward"),
        (["--mapper", "forward", "--noise-std", "0"], "--noise-std"),
        (["--mapper", "forward", "--noise-std", "nan"], "--noise-std"),
        (["--mapper", "forward", "--sensor-model", "gaussian"], "--sensor-model goes with --mapper prob"),
        (["--sensor-model", "magic"], "--sensor-model"),
        (["--pose", "magic"], "--pose"),
        (["--standing-still", "--pose", "tf"], "exclude"),
        (["--no-viewer", "--save", "a.rrd"], "excludes"),
        (["--serve", "--save", "a.rrd"], "excludes"),
        (["--spawn", "--connect", "rerun+http://127.0.0.1:1/proxy"], "exclude"),
        (["--connect", "what"], "--connect what"),
        (["--nonsense"], "--nonsense"),
    ],
)
def test_impossible_options_are_refused_in_one_line(
    replay: Run, noisy_session: Session, options: list[str], message: str
) -> None:
    code, out, err = replay(noisy_session.path, *options)
    assert (code, out) == (2, "")
    assert message in err
    assert err.startswith("prim-replay: error: ")
    assert err.count("\n") == 1
    assert list(Path().iterdir()) == []


def test_empty_selections_are_refused(replay: Run, noisy_session: Session) -> None:
    code, _, err = replay(noisy_session.path, "--start", 1000, "--no-viewer")
    assert (code, "no scan is selected" in err) == (1, True)


@pytest.mark.parametrize("option", ["--save", "--report", "--map", "--trajectory"])
def test_unwritable_outputs_are_refused(replay: Run, noisy_session: Session, option: str) -> None:
    code, _, err = replay(noisy_session.path, option, "no/such/folder")
    assert code == 1
    assert "cannot write" in err and err.count("\n") == 1


@pytest.mark.parametrize("option", ["--save", "--report", "--map", "--trajectory"])
@pytest.mark.parametrize("name", ["", ".", "..", "/"])
def test_outputs_without_a_name_are_refused(replay: Run, noisy_session: Session, option: str, name: str) -> None:
    code, _, err = replay(noisy_session.path, option, name, "--mapper", "det,prob")
    assert (code, option in err, err.count("\n")) == (2, True, 1)
    assert list(Path().iterdir()) == []


def test_spawn_without_a_display_is_refused(
    replay: Run, noisy_session: Session, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delenv("DISPLAY", raising=False)
    monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)
    code, _, err = replay(noisy_session.path, "--spawn")
    assert (code, "--save" in err, err.count("\n")) == (2, True, 1)


@pytest.mark.parametrize("host", ["127.0.0.1", pytest.param("a" * 64, id="a name that no host can have")])
def test_a_viewer_that_does_not_answer_is_reported(replay: Run, noisy_session: Session, host: str) -> None:
    code, _, err = replay(noisy_session.path, "--connect", f"rerun+http://{host}:9/proxy", "--n-scans", 3)
    assert code == 1
    assert "no viewer answers" in err and err.count("\n") == 1


@pytest.mark.parametrize("content", [b"", b"\x89PNG\r\n\x1a\nxxxxxxxxxxxxxxxx"])
def test_files_that_are_not_logs_are_refused(replay: Run, content: bytes) -> None:
    Path("a.mcap").write_bytes(content)
    code, out, err = replay("a.mcap")
    assert (code, out) == (1, "")
    assert err.startswith("prim-replay: error: a.mcap: ")
    assert err.count("\n") == 1
    assert [path.name for path in Path().iterdir()] == ["a.mcap"]


def test_a_missing_file_and_an_empty_folder_are_refused(replay: Run, tmp_path: Path) -> None:
    for path in ("none.mcap", tmp_path):
        code, _, err = replay(path)
        assert (code, err.count("\n")) == (1, 1)


@pytest.fixture(scope="module")
def driven_session(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A driven session: 15 s, 60 scans of 120 rays."""
    path = tmp_path_factory.mktemp("driven") / "driven.mcap"
    options = SessionOptions(seed=2, motion="drive", duration=15.0, rate=4.0, lidar=Lidar(rays=120))
    return record_session(path, options).path


@pytest.mark.parametrize("mapper", MAPPERS)
def test_fused_poses_are_reported_with_their_uncertainty(replay: Run, driven_session: Path, mapper: str) -> None:
    code, out, err = replay(driven_session, "--pose", "fused", "--mapper", mapper, "--trajectory", "fused.tum")
    assert (code, err) == (0, "")
    pose = report_of(f"driven.{mapper}.report.json")["pose"]
    assert pose["source"] == "fused" and not pose["matched"]
    assert pose["rmse_m"] < 0.08 and pose["rmse_m"] < 4 * pose["std_m"] and pose["nees"] < 12
    assert pose["sensors"]["gps"]["std_m"] == pytest.approx(0.1, rel=0.3)
    assert pose["sensors"]["compass"]["std_rad"] == pytest.approx(math.radians(3), rel=0.3)
    assert pose["sensors"]["odom"]["topic"] == "/odom" and pose["sensors"]["gps"]["used"] >= 57
    assert "fused (/odom, /gps, /compass)" in out and "pose noise" in out and "expected" in out
    assert len(np.loadtxt("fused.tum")) == 60


@pytest.mark.parametrize(("sensors", "topics"), [("gps,odom", "/odom, /gps"), ("gps, compass", "/gps, /compass")])
def test_only_the_chosen_sensors_are_fused(replay: Run, driven_session: Path, sensors: str, topics: str) -> None:
    code, out, _ = replay(driven_session, "--pose", "fused", "--fuse", sensors, "--no-viewer", "--no-detect")
    assert code == 0 and f"fused ({topics})" in out


def test_given_pose_noise_is_used(replay: Run, driven_session: Path) -> None:
    given = ["--pose-noise", 0.2, 5, "--odom-noise", 0.1, 4, "--gps-topic", "/gps", "--compass-topic", "/compass"]
    assert replay(driven_session, "--pose", "fused", *given, "--no-viewer", "--no-detect")[0] == 0
    sensors = report_of("driven.prob.report.json")["pose"]["sensors"]
    assert sensors["gps"]["std_m"] == 0.2 and sensors["compass"]["std_rad"] == pytest.approx(math.radians(5))
    assert sensors["odom"] | {"std_rad": 0} == {
        "topic": "/odom", "used": 60, "rejected": 0, "std_m": 0.1, "std_rad": 0,
        "distance_scale": 1, "turn_scale": 1,
    }  # fmt: skip


@pytest.mark.parametrize("options", [[], ["--pose-noise", 0.1, 3]])
def test_matched_scans_correct_odometry(replay: Run, driven_session: Path, options: list[object]) -> None:
    plain = ["--no-viewer", "--no-detect", "--resolution", 0.02]
    assert replay(driven_session, "--pose", "odom", *plain)[0] == 0
    before = report_of("driven.prob.report.json")["pose"]
    code, out, _ = replay(driven_session, "--pose", "odom", "--match-scans", *plain, *options)
    after = report_of("driven.prob.report.json")["pose"]
    assert code == 0 and "odom (/odom), matched scans" in out
    assert after["matched"] and not before["matched"] and after["std_m"] > 0
    if not options:  # with --pose-noise, drift is taken for noise and stays
        assert after["rmse_m"] < before["rmse_m"] / 2


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--fuse", "sonar"], "sonar is no sensor; they are odom, gps, compass, imu"),
        (["--compass-topic", "/a", "--imu-topic", "/b"], "--compass-topic excludes --imu-topic"),
        (["--fuse", "odom,"], "an empty name is no sensor"),
        (["--pose", "odom", "--fuse", "gps"], "do not go with --pose odom"),
        (["--pose", "tf", "--gps-topic", "/gps"], "do not go with --pose tf"),
        (["--pose", "odom", "--pose-noise", 0.1, 1], "go with --pose fused or with --match-scans"),
        (["--pose-noise", 0, 1], "--pose-noise is 0 m and 1 degrees: both must be above 0"),
        (["--odom-noise", 0.1, "nan"], "--odom-noise is 0.1 m and nan degrees: both must be above 0"),
        (["--standing-still", "--match-scans"], "excludes --match-scans"),
    ],
)
def test_contradicting_pose_options_are_refused(
    replay: Run, driven_session: Path, options: list[object], message: str
) -> None:
    code, _, err = replay(driven_session, *options)
    assert code == 2 and message in err and len(err.splitlines()) == 1


def test_unused_fusion_options_are_noted(replay: Run, driven_session: Path) -> None:
    _, _, err = replay(driven_session, "--fuse", "gps,compass", "--no-viewer", "--no-detect")
    assert "nothing is fused, since there are poses on /ground_truth/pose: give --pose fused" in err


def test_missing_sensors_are_reported(replay: Run, driven_session: Path) -> None:
    code, _, err = replay(driven_session, "--pose", "fused", "--fuse", "gps")
    assert code == 1 and "fused poses need odometry, or a GPS and a compass: there is /gps" in err
    code, _, err = replay(driven_session, "--pose", "fused", "--gps-topic", "/odom")
    assert code == 1 and "topics with such messages: /gps" in err
