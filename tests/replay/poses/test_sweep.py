"""When beams are measured: found by how well scans fit each other, set by hand, and left as the log says."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from prim.errors import UsageError
from prim.log import open_log
from prim.log.messages import ODOMETRY_TYPE, SCAN_TYPE, encode_odometry, encode_scan
from prim.log.writer import LogWriter
from prim.scan import Scan
from prim.se2 import Pose2D
from prim.shapes import Kind, Primitive
from prim.world import World
from recorder.sensors import Lidar
from replay.keywords import replay_options
from replay.localization import Localization, localize
from replay.options import ReplayOptions
from replay.pipeline import Pipeline
from replay.poses.laser_poses import AT_ONCE, BEAM_TIMES, BeamTimes
from replay.scans.scan_log import ScanLog
from replay.scans.selection import Selection
from replay.timing import StageTimer

CASE = Path(__file__).parents[4] / "shared" / "cases" / "logs" / "sweep_endstamp.mcap"

SECOND = 10**9
SCANS, PERIOD, BEAMS = 100, 0.1, 48
SWEEP = PERIOD * (BEAMS - 1) / BEAMS
LIDAR = Lidar(rays=BEAMS, noise_std=0.0)
ROOM = World(
    (4.0, 3.0),
    (Primitive(Kind.SQUARE, 1.0, 2.2, 0.4, (0.3,)), Primitive(Kind.CIRCLE, 3.0, 0.8, None, (0.2,))),
    ((0.0, 0.0, 4.0, 0.0), (4.0, 0.0, 4.0, 3.0), (4.0, 3.0, 0.0, 3.0), (0.0, 3.0, 0.0, 0.0)),
)

Motion = Callable[[float], Pose2D]


def turning_to_and_fro(seconds: float) -> Pose2D:
    """A robot that drives a little and turns by up to a radian per second, either way."""
    return Pose2D(2.0 + 0.3 * math.sin(0.5 * seconds), 1.5, math.sin(1.1 * seconds) + 0.3 * math.sin(0.4 * seconds))


def write_log(path: Path, times: BeamTimes, motion: Motion = turning_to_and_fro, sign: int = 1) -> Path:
    """A log of scans whose beams are measured at these times; poses by odometry, 50 a second."""
    rng = np.random.default_rng(3)
    with LogWriter(path) as log:
        log.add_topic("/odom", ODOMETRY_TYPE)
        log.add_topic("/scan", SCAN_TYPE)
        for k in range(50 * (round(SCANS * PERIOD) + 1)):
            stamp = SECOND + k * SECOND // 50
            log.write("/odom", stamp, encode_odometry(stamp, motion(k / 50)))
        for k in range(SCANS):
            start = 0.5 + k * PERIOD
            offsets = (times.first + np.linspace(0, times.last - times.first, BEAMS)) * SWEEP
            ranges = [LIDAR.exact(ROOM, motion(start + offset))[beam] for beam, offset in enumerate(offsets)]
            stamp, increment = SECOND + round(start * 1e9), sign * PERIOD / BEAMS
            noisy = np.float32(ranges + 0.02 * rng.standard_normal(BEAMS))
            step = LIDAR.angle_increment
            scan = Scan(stamp, "laser", -LIDAR.fov / 2, step, 0.03, 8.0, noisy, increment, PERIOD)
            log.write("/scan", stamp, encode_scan(scan))
    return path


def localized(path: Path, **keywords: object) -> Localization:
    """The localization of a log by these options."""
    with open_log(path) as log:
        options = replay_options(laser_offset=(0, 0, 0), **keywords)  # type: ignore[arg-type]
        return localize(ScanLog(log, Selection()), options, StageTimer())


def sweep_notes(found: Localization) -> list[str]:
    return [note for note in found.notes if "fit each other" in note]


@pytest.mark.parametrize("name", ["end", "start-reversed", "end-reversed"])
def test_times_that_the_log_does_not_say_are_found_and_can_be_set(tmp_path: Path, name: str) -> None:
    times = BEAM_TIMES[name]
    path = write_log(tmp_path / "a.mcap", times)
    found = localized(path)
    assert len(sweep_notes(found)) == 1 and f"--sweep {name} sets this, --sweep start" in sweep_notes(found)[0]
    set_by_hand = localized(path, sweep=name)
    assert not sweep_notes(set_by_hand)
    for localization in (found, set_by_hand):
        stamps, sweep = localization.scans.stamps, localization.scans.sweep
        assert stamps[0] == SECOND + round(0.5e9) + round(times.first * abs(sweep))
        assert sweep == pytest.approx((times.last - times.first) * SWEEP * 1e9, rel=1e-4)
        assert localization.scans.first.stamp == stamps[0] and localization.poses.end_poses is not None
        for k, pose, end in zip(range(SCANS), localization.poses.poses, localization.poses.end_poses, strict=True):
            true = [turning_to_and_fro(0.5 + k * PERIOD + offset * SWEEP) for offset in times]
            assert (pose[2], end[2]) == pytest.approx((true[0].theta, true[1].theta), abs=2e-3)


def test_scans_that_were_deskewed_by_the_driver_are_left_whole(tmp_path: Path) -> None:
    path = write_log(tmp_path / "a.mcap", AT_ONCE)
    found, whole = localized(path), localized(path, deskew=False)
    assert "--no-deskew sets this" in sweep_notes(found)[0]
    assert found.poses.end_poses is None and found.poses.poses.tolist() == whole.poses.poses.tolist()


@pytest.mark.parametrize(
    "motion",
    [
        turning_to_and_fro,
        lambda seconds: Pose2D(2.0, 1.5, 0.3),
        lambda seconds: Pose2D(1.0 + 0.1 * seconds, 1.5, 0.3),
    ],
)
def test_right_stamps_and_robots_that_do_not_turn_change_nothing(tmp_path: Path, motion: Motion) -> None:
    path = write_log(tmp_path / "a.mcap", BEAM_TIMES["start"], motion)
    found, stated = localized(path), localized(path, sweep="start")
    assert found.notes == stated.notes == ()
    assert found.poses.poses.tobytes() == stated.poses.poses.tobytes()
    assert found.scans.stamps.tolist() == stated.scans.stamps.tolist()


def test_stamps_at_the_middle_of_the_sweep_are_no_evidence(tmp_path: Path) -> None:
    path = write_log(tmp_path / "a.mcap", BeamTimes(-0.5, 0.5))
    assert localized(path).notes == ()


def test_a_few_scans_decide_nothing(tmp_path: Path) -> None:
    path = write_log(tmp_path / "a.mcap", BEAM_TIMES["end"])
    with open_log(path) as log:
        scans = ScanLog(log, Selection(n_scans=60))
        options = ReplayOptions(laser_offset=Pose2D(0, 0, 0))
        assert localize(scans, options, StageTimer()).notes == ()


def test_a_negative_time_increment_says_that_beams_run_against_time(tmp_path: Path) -> None:
    path = write_log(tmp_path / "a.mcap", BEAM_TIMES["end-reversed"], sign=-1)
    found = localized(path)
    assert found.notes == () and found.scans.sweep < 0
    assert found.poses.end_poses is not None
    assert found.poses.end_poses[5, 2] == pytest.approx(turning_to_and_fro(1.0 - SWEEP).theta, abs=2e-3)
    path = write_log(tmp_path / "b.mcap", BEAM_TIMES["start"], sign=-1)
    found = localized(path)
    assert "--sweep start sets this, --sweep end-reversed the log's" in sweep_notes(found)[0]
    assert found.scans.sweep > 0


def test_only_some_scans_are_read(tmp_path: Path) -> None:
    path = write_log(tmp_path / "a.mcap", BEAM_TIMES["start"])
    with open_log(path) as log:
        scans = ScanLog(log, Selection(start=1.0))
        every = dict(scans)
        some = dict(scans.only(np.array([40, 7])))
    assert sorted(some) == [7, 40] and len(every) == len(scans)
    assert all(some[k].stamp == every[k].stamp for k in some)


def test_a_time_of_beams_that_does_not_apply_is_said(tmp_path: Path) -> None:
    path = write_log(tmp_path / "a.mcap", AT_ONCE, sign=0)
    assert localized(path).notes == ()
    found = localized(path, sweep="end")
    assert found.notes == ("--sweep end changes nothing: scans have no time_increment that is plausible",)


def test_impossible_options() -> None:
    with pytest.raises(UsageError, match="--no-deskew excludes --sweep"):
        ReplayOptions(deskew=False, sweep="end")
    with pytest.raises(UsageError, match="--sweep is 'middle': choose from auto, start, end, start-reversed"):
        ReplayOptions(sweep="middle")
    assert replace(ReplayOptions(), deskew=False).sweep == "auto"


def test_a_log_that_is_stamped_at_the_end_of_the_sweep() -> None:
    if not CASE.exists():
        pytest.skip(f"the log {CASE.name} is not here (looked in {CASE.parent})")
    options = ReplayOptions(detect=False)
    occupied = {}
    for sweep in ("auto", "start", "end"):
        result = Pipeline(CASE, replace(options, sweep=sweep)).run()
        occupied[sweep] = int(np.count_nonzero(result.grid.probability > 0.65))
        assert any("--sweep end sets this" in note for note in result.notes) == (sweep == "auto")
    assert occupied["auto"] == occupied["end"] < 0.7 * occupied["start"]
