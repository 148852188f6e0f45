"""Stamps by clocks that disagree come onto one."""

import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from prim.log import open_log
from prim.log.decoding.ros import decode_scan
from prim.log.decoding.values import planar_pose
from prim.log.messages import ODOM_TOPIC, SCAN_TOPIC, TF_TOPIC, encode_odometry, encode_scan, encode_transforms
from prim.log.source import Message
from prim.log.time_resets import find_shifts, moved_behind_resets
from replay.poses.laser_poses import LaserPoses
from replay.poses.pose_provider import PoseProvider
from replay.scans.clock import HEADER_CLOCK, _clock_with_resets
from replay.scans.scan_log import ScanLog, ScanLogOptions
from replay.scans.selection import Selection
from tests.encodings import ros2
from tests.encodings.content import LogContent, decode_poses, without_truth

SECOND = 10**9
YEARS = 50 * 365 * 86400 * SECOND


def stamped(content: LogContent, stamp_of: Callable[[int], int]) -> LogContent:
    """Write other stamps into the headers of scans."""

    def changed(message: Message) -> Message:
        if message.topic != SCAN_TOPIC:
            return message
        scan = decode_scan(message.data)
        return message._replace(data=encode_scan(replace(scan, stamp=stamp_of(scan.stamp))))

    plain = without_truth(content)
    return replace(plain, messages=tuple(map(changed, plain.messages)))


def located(content: LogContent, folder: Path, clock: str = "auto") -> tuple[LaserPoses, list[str]]:
    with open_log(ros2.write_mcap(content, folder)) as log:
        scans = ScanLog(log, Selection(), ScanLogOptions(clock=clock))
        return PoseProvider(scans.log).laser_poses(scans.times, "tf"), scans.notes()


@pytest.fixture(scope="module")
def expected(content: LogContent, tmp_path_factory: pytest.TempPathFactory) -> LaserPoses:
    return located(without_truth(content), tmp_path_factory.mktemp("expected"))[0]


def test_header_stamps_that_agree_stay(content: LogContent, tmp_path: Path) -> None:
    with open_log(ros2.write_mcap(content, tmp_path)) as log:
        scans = ScanLog(log, Selection())
        assert scans.log is log
        assert scans.notes() == []


@pytest.mark.parametrize(
    ("stamp_of", "note"),
    [
        (lambda stamp: stamp - YEARS, "s behind the poses"),
        (lambda stamp: stamp - 3 * SECOND, r"3\.\d* s behind the poses"),
        (lambda stamp: stamp + 2 * SECOND, r"s ahead of the poses"),
    ],
    ids=["device", "late", "early"],
)
def test_a_steady_clock_is_moved_onto_that_of_the_poses(
    content: LogContent, expected: LaserPoses, tmp_path: Path, stamp_of: Callable[[int], int], note: str
) -> None:
    poses, notes = located(stamped(content, stamp_of), tmp_path)
    assert poses.valid.sum() >= len(poses.valid) - 2
    both = poses.valid & expected.valid
    assert np.abs(poses.poses - expected.poses)[both].max() < 1e-3
    assert len(notes) == 1
    assert re.search(note, notes[0])


def test_stamps_of_zero_are_those_of_the_log(content: LogContent, expected: LaserPoses, tmp_path: Path) -> None:
    poses, notes = located(stamped(content, lambda stamp: 0), tmp_path)
    both = poses.valid & expected.valid
    assert both.sum() >= len(both) - 2
    assert np.abs(poses.poses - expected.poses)[both].max() < 5e-3
    assert "are 0" in notes[0]


@pytest.mark.parametrize("share", [2, 7])
def test_single_stamps_of_zero_are_those_of_the_log(
    content: LogContent, expected: LaserPoses, tmp_path: Path, share: int
) -> None:
    """The others remain, on whatever clock they are."""
    for back in (0, YEARS):
        some = stamped(content, lambda stamp, back=back: stamp // 10**8 % share * (stamp - back) and stamp - back)
        poses, notes = located(some, tmp_path)
        both = poses.valid & expected.valid
        assert both.sum() >= len(both) - 2
        assert np.abs(poses.poses - expected.poses)[both].max() < 1e-3
        assert re.search(r"\d+ of 30 stamps of /scan are 0", notes[-1])


@pytest.mark.parametrize("back", [0, YEARS])
@pytest.mark.parametrize("drift", [0.01, -0.02])
def test_a_clock_that_runs_fast_or_slow_is_set(
    content: LogContent, expected: LaserPoses, tmp_path: Path, back: int, drift: float
) -> None:
    """Of thirty scans in 3 s, the drift is found to the jitter of the log times."""
    start = decode_scan(content.of(SCAN_TOPIC)[0].data).stamp
    drift *= 1 if back else 20
    poses, notes = located(stamped(content, lambda stamp: stamp - back + round((stamp - start) * drift)), tmp_path)
    both = poses.valid & expected.valid
    assert both.sum() >= len(both) - 2
    assert np.abs(poses.poses - expected.poses)[both].max() < 1e-3
    assert ("fast" if drift > 0 else "slow") in notes[0]


@pytest.mark.parametrize("stamp_of", [lambda stamp: 0, lambda stamp: stamp - YEARS], ids=["zero", "device"])
@pytest.mark.parametrize("topic", [ODOM_TOPIC, TF_TOPIC])
def test_poses_on_another_clock_are_moved_onto_that_of_the_scans(
    content: LogContent, tmp_path: Path, topic: str, stamp_of: Callable[[int], int]
) -> None:
    def changed(message: Message) -> Message:
        if message.topic != topic:
            return message
        (pose,) = decode_poses(content.types[topic], message.data)
        plane = planar_pose(pose)
        stamp = stamp_of(pose.stamp)
        if topic == ODOM_TOPIC:
            return message._replace(data=encode_odometry(stamp, plane))
        return message._replace(data=encode_transforms([(stamp, pose.frame_id, pose.child_frame_id, plane)]))

    plain = without_truth(content)
    source = "odom" if topic == ODOM_TOPIC else "tf"
    found = []
    for messages in (plain.messages, tuple(map(changed, plain.messages))):
        with open_log(ros2.write_mcap(replace(plain, messages=messages), tmp_path)) as log:
            scans = ScanLog(log, Selection())
            found.append((PoseProvider(scans.log).laser_poses(scans.times, source), scans.notes()))
    (right, silent), (poses, notes) = found
    both = right.valid & poses.valid
    assert not silent and any(topic in note for note in notes)
    assert both.sum() >= len(both) - 2
    assert np.abs(poses.poses - right.poses)[both].max() < 5e-3


def test_the_choice_of_a_clock_is_kept(content: LogContent, tmp_path: Path) -> None:
    device = stamped(content, lambda stamp: stamp - YEARS)
    with open_log(ros2.write_mcap(device, tmp_path)) as log:
        by_header = ScanLog(log, Selection(), ScanLogOptions(clock="header"))
        by_log = ScanLog(log, Selection(), ScanLogOptions(clock="log"))
        assert by_header.log is log
        assert by_log.stamps.tolist() == [m.log_time for m in device.messages if m.topic == SCAN_TOPIC]


def reset(content: LogContent, back: int, also_log: bool) -> LogContent:
    """Set the clock of scans and odometry back in the middle of a session."""
    from prim.log.decoding.values import planar_pose
    from prim.log.messages import ODOMETRY_TYPE, encode_odometry

    middle = content.messages[len(content.messages) // 2].log_time

    def changed(message: Message) -> Message:
        if message.log_time < middle or message.topic not in (SCAN_TOPIC, ODOM_TOPIC):
            return message
        if message.topic == SCAN_TOPIC:
            scan = decode_scan(message.data)
            data = encode_scan(replace(scan, stamp=scan.stamp - back))
        else:
            (pose,) = decode_poses(ODOMETRY_TYPE, message.data)
            data = encode_odometry(pose.stamp - back, planar_pose(pose))
        return message._replace(data=data, log_time=message.log_time - back * also_log)

    topics = {SCAN_TOPIC: content.types[SCAN_TOPIC], ODOM_TOPIC: content.types[ODOM_TOPIC]}
    kept = tuple(changed(message) for message in content.messages if message.topic in topics)
    return LogContent(topics, kept, {}, {})


@pytest.mark.parametrize("also_log", [False, True], ids=["headers", "log"])
def test_what_follows_a_reset_is_put_behind_what_was_before(
    content: LogContent, tmp_path: Path, also_log: bool
) -> None:
    back = 1_400_000_000
    (tmp_path / "plain").mkdir()
    with open_log(ros2.write_mcap(reset(content, 0, False), tmp_path / "plain")) as log:
        plain = ScanLog(log, Selection())
        expected = PoseProvider(plain.log).laser_poses(plain.times, "odom")
    with open_log(ros2.write_mcap(reset(content, back, also_log), tmp_path)) as log:
        scans = ScanLog(log, Selection())
        assert (np.diff(scans.stamps) > 0).all()
        poses = PoseProvider(scans.log).laser_poses(scans.times, "odom")
        assert any("set back 1 time" in note for note in scans.notes())
    assert poses.valid.all()
    assert np.abs(poses.poses - expected.poses).max() < 1e-4


def test_shifts_after_resets() -> None:
    run = np.arange(0, 20, dtype=np.int64) * SECOND
    shifts = find_shifts(np.concatenate((run + 5 * SECOND, run, run)))
    assert len(shifts) == 3
    messages = [Message("/a", int(time), b"") for part in (run + 5 * SECOND, run, run) for time in part]
    moved = [message.log_time for message in moved_behind_resets(messages, shifts)]
    assert moved == sorted(moved)


@pytest.mark.parametrize(
    "seconds",
    [
        *([*range(30)], [*range(30, 0, -1)], [*range(20, 40), *range(20)], [1, 3, 5, 2, 4, 6]),
        [*range(0, 40, 2), *range(39, 0, -2)],
    ],
    ids=["sorted", "reversed", "swapped", "short", "there and back"],
)
def test_a_log_that_is_written_in_another_order_has_no_resets(seconds: list[int]) -> None:
    assert find_shifts(np.array(seconds, dtype=np.int64) * SECOND) == (0,)


def test_messages_of_nearly_the_same_time_are_no_reset() -> None:
    assert find_shifts(np.array([5, 4, 6] * 20, dtype=np.int64) * SECOND // 10) == (0,)


def test_a_reset_before_the_first_scan_is_none() -> None:
    """Scans that are not in the order in which they were logged: before the time of the reset there is none."""
    logged = np.array([5, 6, 5, 6], dtype=np.int64) * SECOND
    assert _clock_with_resets(logged, logged, np.array([5 * SECOND])) is HEADER_CLOCK
