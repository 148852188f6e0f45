"""Which topics of scans are mapped, and those of several scanners together."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from prim.errors import LogReadError, UsageError
from prim.log import open_log
from prim.log.messages import ODOMETRY_TYPE, SCAN_TYPE, TF_TYPE, encode_odometry, encode_scan, encode_transforms
from prim.log.writer import LogWriter
from prim.scan import Scan, reconciled_angles
from prim.se2 import Pose2D
from replay.poses.pose_provider import PoseProvider
from replay.scans.posed_scans import PosedScans
from replay.scans.scan_log import ScanLog, ScanLogOptions
from replay.scans.selection import Selection

SECOND = 10**9
FRONT, REAR = Pose2D(0.3, 0.0, 0.0), Pose2D(-0.2, 0.1, np.pi)


def two_scanners(path: Path, mounts: dict[str, Pose2D], frames: dict[str, str]) -> Path:
    """A robot that drives along x at 1 m/s, with scanners that take turns."""
    with LogWriter(path) as log:
        log.add_topic("/tf_static", TF_TYPE)
        log.add_topic("/odom", ODOMETRY_TYPE)
        for topic in frames:
            log.add_topic(topic, SCAN_TYPE)
        log.write("/tf_static", 1, encode_transforms((1, "base_link", frame, at) for frame, at in mounts.items()))
        for second in range(6):
            log.write("/odom", second * SECOND, encode_odometry(second * SECOND, Pose2D(second, 0, 0)))
        for second in range(1, 5):
            for k, (topic, frame) in enumerate(frames.items()):
                stamp = second * SECOND + k * SECOND // 2
                ranges = np.full(4 + k, 1.0 + k, np.float32)
                scan = Scan(stamp, frame, 0.0, 0.1, 0.1, 5.0 + k, ranges)
                log.write(topic, stamp, encode_scan(scan))
    return path


BOTH = {"/front": "front", "/rear": "rear"}


def test_scanners_of_one_robot_are_mapped_together(tmp_path: Path) -> None:
    with open_log(two_scanners(tmp_path / "a.mcap", {"front": FRONT, "rear": REAR}, BOTH)) as log:
        scans = ScanLog(log, Selection())
        assert scans.names == "/front, /rear"
        assert scans.scanner.tolist() == [0, 1] * 4
        poses = PoseProvider(scans.log).laser_poses(scans.times, "odom")
        assert poses.mounts is not None
        assert poses.mounts[:2].tolist() == [[0.3, 0.0, 0.0], [-0.2, 0.1, pytest.approx(np.pi)]]
        posed = list(PosedScans(scans, poses))
        assert any("2 scanners of one robot" in note for note in scans.notes())
    assert [p.scan.frame_id for p in posed] == ["front", "rear"] * 4
    assert [(p.pose.x, p.pose.y) for p in posed[:2]] == [pytest.approx((1.3, 0.0)), pytest.approx((1.3, 0.1))]
    assert [p.scan.range_max for p in posed[:2]] == [5.0, 6.0]


def test_each_scanner_has_its_sweep(tmp_path: Path) -> None:
    with open_log(two_scanners(tmp_path / "a.mcap", {"front": FRONT, "rear": REAR}, BOTH)) as log:
        scans = ScanLog(log, Selection())
    swept = replace(scans.scanners[1], first=replace(scans.scanners[1].first, time_increment=0.1))
    scans.scanners = (scans.scanners[0], swept)
    times = scans.times
    assert times.sweeps == (0, 400_000_000)
    assert (times.query_stamps[8:] - times.query_stamps[:8]).tolist() == [0, 400_000_000] * 4
    assert times.query_rows(1).tolist() == [1, 3, 5, 7, 9, 11, 13, 15]


@pytest.mark.parametrize(
    ("mounts", "frames"),
    [({"front": FRONT}, BOTH), ({"front": FRONT}, {"/front": "front", "/copy": "front"})],
    ids=["not joined", "one frame"],
)
def test_topics_that_do_not_belong_together_are_a_choice(
    tmp_path: Path, mounts: dict[str, Pose2D], frames: dict[str, str]
) -> None:
    with open_log(two_scanners(tmp_path / "a.mcap", mounts, frames)) as log:
        with pytest.raises(LogReadError, match=r"2 scan topics: .*--scan-topic /"):
            ScanLog(log, Selection())
        one = ScanLog(log, Selection(), ScanLogOptions(("/front",)))
        assert len(one) == 4
        assert len(ScanLog(log, Selection(), ScanLogOptions(tuple(frames)))) == 8


def test_one_offset_is_not_that_of_two_scanners(tmp_path: Path) -> None:
    with open_log(two_scanners(tmp_path / "a.mcap", {"front": FRONT, "rear": REAR}, BOTH)) as log:
        scans = ScanLog(log, Selection())
        with pytest.raises(UsageError, match="one scanner"):
            PoseProvider(scans.log, laser_offset=Pose2D(0.1, 0, 0)).laser_poses(scans.times, "odom")


@pytest.mark.parametrize(
    ("increment", "last", "expected"),
    [
        (0, 359, 1),
        (np.nan, 359, 1),
        (-1, 359, 1),
        (2, 359, 1),
        (180 / np.pi, 359, 1),
        (1, 359, 1),
        (1, 360, 1),
        (1, np.nan, 1),
        (1, 0, 1),
        (1, 359 - 360, 1),
        (-1, 1, -1),
        (0.5, 179.5, 0.5),
        (0.5, 359, 1),
        (1e-7, 359, 1),
        (1, 361 * 57, 1),
        (-1, 360, 360 / 359),
    ],
)
def test_angles_are_those_of_the_ends_where_the_increment_contradicts(
    increment: float, last: float, expected: float
) -> None:
    """Degrees, of 360 beams; ends that were wrapped contradict nothing, nor does one beam more or less."""
    scan = Scan(0, "", 0.0, np.radians(increment), 0.1, 5.0, np.ones(360, np.float32), angle_max=np.radians(last))
    assert reconciled_angles(scan)[0].angle_increment == pytest.approx(np.radians(expected))


@pytest.mark.parametrize(
    ("first", "last", "increment", "beams", "used", "what"),
    [
        (-180, 0, 1, 360, 1, "angle_max contradicts"),
        (-180, 360, 1, 360, 1, "angle_max contradicts"),
        (-90, 90, 1, 100, 1, "fewer ranges"),
        (-90, 90, 1, 171, 1, "fewer ranges"),
        (-90, 90, 0.5, 181, 1, "angle_increment contradicts"),
        (-90, 90, 1, 91, 2, "angle_increment contradicts"),
        (-90, 90, 2, 181, 1, "angle_increment contradicts"),
        (-90, 90, 0.97, 181, 1, "angle_increment contradicts"),
    ],
)
def test_the_increment_remains_where_the_ends_cannot_be(
    first: float, last: float, increment: float, beams: int, used: float, what: str
) -> None:
    """Degrees."""
    first, last, increment = np.radians((first, last, increment)).tolist()
    scan = Scan(0, "", first, increment, 0.1, 5.0, np.ones(beams, np.float32), angle_max=last)
    reconciled, contradiction = reconciled_angles(scan)
    assert reconciled.angle_increment == pytest.approx(np.radians(used))
    assert contradiction is not None and contradiction.startswith((what, f"there are {what}"))


@pytest.mark.parametrize(("first", "increment"), [(-np.pi, 0.0), (-180.0, 1.0), (-180.0, np.pi / 180)])
def test_angles_that_no_beam_can_have_make_a_scan_unusable(first: float, increment: float) -> None:
    scan = Scan(0, "", first, increment, 0.1, 5.0, np.ones(360, np.float32), angle_max=first)
    problem = reconciled_angles(scan)[0].problem
    assert problem is not None and problem.startswith(f"angle_{'min' if increment else 'increment'}")
