"""Which frame is the robot's, and which the scanner's, where a log does not say it plainly."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from prim.errors import LogReadError
from prim.log import open_log
from prim.log.messages import ODOMETRY_TYPE, TF_TYPE, encode_odometry, encode_transforms
from prim.log.source import Message
from prim.se2 import Pose2D
from replay.poses.laser_poses import LaserPoses, ScanTimes
from replay.poses.pose_provider import PoseProvider
from tests.encodings import ros2
from tests.encodings.content import LogContent

SECOND = 10**9
MOUNT = Pose2D(0.1, -0.05, 0.3)
STAMPS = np.arange(0, 100) * SECOND // 20

Edge = tuple[str, str, Pose2D]
Motion = Callable[[int], Pose2D]


def driven(stamp: int) -> Pose2D:
    return Pose2D(stamp / SECOND * 0.2, 0.0, stamp / SECOND * 0.1)


def moving(parent: str, child: str, motion: Motion = driven, every: int = 1, late: int = 0) -> list[Message]:
    stamps = (STAMPS[::every] + late).tolist()
    return [Message("/tf", s, encode_transforms([(s, parent, child, motion(s))])) for s in stamps]


def static(*edges: Edge) -> list[Message]:
    return [Message("/tf_static", 0, encode_transforms([(0, *edge) for edge in edges]))]


def odometry(child: str) -> list[Message]:
    """Encode odometry; the name of its child is as long as that of the usual one, or empty."""
    messages = []
    for stamp in STAMPS.tolist():
        data = encode_odometry(stamp, driven(stamp))
        if not child:
            at = data.index(b"base_link")
            data = data[: at - 4] + b"\1\0\0\0\0\0\0\0" + data[at + 12 :]
        messages.append(Message("/odom", stamp, data))
    return messages


def poses(folder: Path, messages: list[Message], frame: str, offset: Pose2D | None = None) -> LaserPoses:
    types = {"/tf": TF_TYPE, "/tf_static": TF_TYPE, "/odom": ODOMETRY_TYPE}
    used = {topic: kind for topic, kind in types.items() if any(message.topic == topic for message in messages)}
    ordered = tuple(sorted(messages, key=lambda message: message.log_time))
    with open_log(ros2.write_mcap(LogContent(used, ordered, {}, {}), folder)) as log:
        return PoseProvider(log, laser_offset=offset).laser_poses(ScanTimes(STAMPS[10:90], (frame,)))


def is_right(found: LaserPoses) -> bool:
    expected = [driven(stamp) @ MOUNT for stamp in STAMPS[10:90].tolist()]
    return bool(np.allclose(found.poses, [(pose.x, pose.y, pose.theta) for pose in expected], atol=1e-6))


@pytest.mark.parametrize(
    ("messages", "frame"),
    [
        (moving("odom", "chassis") + static(("chassis", "laser", MOUNT)), "laser"),
        (moving("world", "chassis") + static(("chassis", "laser", MOUNT)), "laser"),
        (moving("r1/odom", "r1/base_link") + static(("r1/base_link", "r1/laser", MOUNT)), "/r1/laser"),
        (moving("odom", "base_link") + static(("base_link", "head", MOUNT)), "thing"),
        (moving("odom", "base_link") + static(("base_link", "head", MOUNT)), ""),
        (odometry("") + static(("base_link", "laser", MOUNT)), "laser"),
        (odometry("") + static(("chassis", "mast", MOUNT), ("mast", "laser", Pose2D())), "laser"),
    ],
)
def test_the_frames_are_found(tmp_path: Path, messages: list[Message], frame: str) -> None:
    assert is_right(poses(tmp_path, messages, frame))


@pytest.mark.parametrize("others", [[("base_link", "imu", Pose2D())], [("base_footprint", "base_link", Pose2D())]])
def test_frames_of_other_things_are_no_scanners(tmp_path: Path, others: list[Edge]) -> None:
    base = others[0][0]
    found = poses(tmp_path, moving("odom", base) + static(*others), "thing")
    assert found.mount_assumed and any("laser is taken to be at the robot's origin" in note for note in found.notes)


def test_of_several_robots_it_is_that_of_the_scanner(tmp_path: Path) -> None:
    robots = moving("r1/odom", "r1/base_link") + moving("r2/odom", "r2/base_link", lambda stamp: Pose2D(3.0))
    assert is_right(poses(tmp_path, robots, "r1/laser", MOUNT))
    with pytest.raises(LogReadError):
        poses(tmp_path, robots, "laser", MOUNT)


def shifted(stamp: int) -> Pose2D:
    return Pose2D(0.0, 0.1) @ driven(stamp)


@pytest.mark.parametrize("every", [1, 8])
def test_a_publisher_that_contradicts_another_is_noted_however_seldom(tmp_path: Path, every: int) -> None:
    other = moving("odom", "base_link", shifted, every, SECOND // 40)
    found = poses(tmp_path, moving("odom", "base_link") + other + static(("base_link", "laser", MOUNT)), "laser")
    assert any("contradict each other" in note and "0.100 m" in note for note in found.notes)


def test_noise_is_no_other_publisher(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    noise = {stamp: Pose2D(*rng.normal(0, 0.03, 2).tolist()) for stamp in STAMPS.tolist()}
    messages = moving("odom", "base_link", lambda stamp: driven(stamp) @ noise[stamp])
    found = poses(tmp_path, messages + static(("base_link", "laser", MOUNT)), "laser")
    assert not any("contradict" in note for note in found.notes)
