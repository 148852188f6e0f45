"""Poses from tf trees, odometry and ground truth, in logs that the tests write."""

import math
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from prim.errors import LogReadError
from prim.log import open_log
from prim.log.messages import (
    ODOMETRY_TYPE,
    POSE_TYPE,
    SCAN_TYPE,
    TF_TYPE,
    _new,
    _serialize,
    encode_odometry,
    encode_pose,
    encode_scan,
    encode_transforms,
)
from prim.log.source import LogSource
from prim.log.writer import LogWriter
from prim.scan import Scan
from prim.se2 import Pose2D
from replay.poses.laser_poses import ScanTimes
from replay.poses.pose_provider import PoseProvider
from replay.poses.transforms import TransformTree

SECOND = 10**9
STAMPS = np.array([SECOND, SECOND + SECOND // 2, 2 * SECOND])
TIMES = ScanTimes(STAMPS, ("laser",))

Write = Callable[[LogWriter], None]


def log_of(path: Path, *writers: Write) -> LogSource:
    with LogWriter(path) as log:
        log.add_topic("/scan", SCAN_TYPE)
        for stamp in STAMPS.tolist():
            scan = Scan(stamp, "laser", 0.0, 0.1, 0.1, 5.0, np.ones(3, dtype=np.float32))
            log.write("/scan", stamp, encode_scan(scan))
        for write in writers:
            write(log)
    return open_log(path)


def odometry(topic: str, *poses: tuple[float, Pose2D]) -> Write:
    def write(log: LogWriter) -> None:
        log.add_topic(topic, ODOMETRY_TYPE)
        for seconds, pose in poses:
            stamp = round(seconds * SECOND)
            log.write(topic, stamp, encode_odometry(stamp, pose))

    return write


def truth(*poses: tuple[float, Pose2D]) -> Write:
    def write(log: LogWriter) -> None:
        log.add_topic("/ground_truth/pose", POSE_TYPE)
        for seconds, pose in poses:
            stamp = round(seconds * SECOND)
            log.write("/ground_truth/pose", stamp, encode_pose(stamp, pose))

    return write


def transforms(topic: str, *edges: tuple[float, str, str, Pose2D]) -> Write:
    def write(log: LogWriter) -> None:
        log.add_topic(topic, TF_TYPE)
        for seconds, parent, child, pose in edges:
            stamp = round(seconds * SECOND)
            log.write(topic, stamp, encode_transforms([(stamp, parent, child, pose)]))

    return write


MOUNT = transforms("/tf_static", (0, "base_link", "laser", Pose2D(0.1, 0.2, math.pi / 2)))
MOVING = ((1, "odom", "base_link", Pose2D(0, 0, 0)), (2, "odom", "base_link", Pose2D(2, 0, math.pi / 2)))
DRIVE = odometry("/odom", (1, Pose2D(0, 0, 0)), (2, Pose2D(2, 0, math.pi / 2)))
HALFWAY = Pose2D(1, 0, math.pi / 4) @ Pose2D(0.1, 0.2, math.pi / 2)


def pose_tuple(pose: Pose2D) -> tuple[float, float, float]:
    return pose.x, pose.y, pose.theta


@pytest.mark.parametrize("source", ["auto", "tf"])
def test_tf_chain_is_composed_and_interpolated(tmp_path: Path, source: str) -> None:
    with log_of(tmp_path / "a.mcap", MOUNT, transforms("/tf", *MOVING)) as log:
        located = PoseProvider(log).laser_poses(TIMES, source)
    assert (located.source, located.origin) == ("tf", "odom > base_link > laser")
    assert located.valid.all()
    assert located.poses[1] == pytest.approx(pose_tuple(HALFWAY))


def test_tf_chain_is_followed_to_map(tmp_path: Path) -> None:
    to_map = (0, "map", "odom", Pose2D(5, 0, 0))
    with log_of(tmp_path / "a.mcap", transforms("/tf_static", to_map), MOUNT_2, transforms("/tf", *MOVING)) as log:
        located = PoseProvider(log).laser_poses(TIMES)
    assert located.origin == "map > odom > base_link > laser"
    assert located.poses[1, 0] == pytest.approx(HALFWAY.x + 5)


MOUNT_2 = transforms("/other/tf_static", (0, "base_link", "laser", Pose2D(0.1, 0.2, math.pi / 2)))


def test_odometry_is_composed_with_the_mount_of_the_laser(tmp_path: Path) -> None:
    with log_of(tmp_path / "a.mcap", MOUNT, DRIVE) as log:
        located = PoseProvider(log).laser_poses(TIMES, "odom")
        assert located.poses[1] == pytest.approx(pose_tuple(HALFWAY))
        assert located.notes == ()


def test_unknown_mount_is_reported_and_can_be_given(tmp_path: Path) -> None:
    with log_of(tmp_path / "a.mcap", DRIVE) as log:
        assert "no transform from base_link to laser" in PoseProvider(log).laser_poses(TIMES).notes[0]
        given = PoseProvider(log, laser_offset=Pose2D(0.1, 0.2, math.pi / 2)).laser_poses(TIMES)
    assert given.notes == ()
    assert given.poses[1] == pytest.approx(pose_tuple(HALFWAY))


def test_auto_prefers_the_ground_truth(tmp_path: Path) -> None:
    true = truth((1, Pose2D(7, 0, 0)), (2, Pose2D(7, 0, 0)))
    with log_of(tmp_path / "a.mcap", MOUNT, DRIVE, transforms("/tf", *MOVING), true) as log:
        provider = PoseProvider(log)
        sources = {source: provider.laser_poses(TIMES, source).source for source in ("auto", "truth", "tf", "odom")}
        assert provider.laser_poses(TIMES).poses[0, 0] == pytest.approx(7.1)
    assert sources == {"auto": "truth", "truth": "truth", "tf": "tf", "odom": "odom"}


def test_pose_stamped_is_used_where_there_is_no_odometry(tmp_path: Path) -> None:
    def write(log: LogWriter) -> None:
        log.add_topic("/pose", POSE_TYPE)
        for second in (1, 2):
            log.write("/pose", second * SECOND, encode_pose(second * SECOND, Pose2D(second, 0, 0)))

    with log_of(tmp_path / "a.mcap", MOUNT, write) as log:
        located = PoseProvider(log).laser_poses(TIMES)
    assert (located.source, located.origin) == ("odom", "/pose")
    assert located.poses[1, 0] == pytest.approx(1.6)


def test_several_topics_of_odometry_are_listed(tmp_path: Path) -> None:
    other = odometry("/wheels", (1, Pose2D(9, 0, 0)), (2, Pose2D(9, 0, 0)))
    with log_of(tmp_path / "a.mcap", DRIVE, other) as log:
        with pytest.raises(LogReadError, match=r"/odom, /wheels; choose one with --odom-topic"):
            PoseProvider(log).laser_poses(TIMES)
        assert PoseProvider(log, odom_topic="/wheels").laser_poses(TIMES).poses[0, 0] == 9
        with pytest.raises(LogReadError, match=r"no poses on /none; topics with poses: /odom"):
            PoseProvider(log, odom_topic="/none").laser_poses(TIMES)


def test_scans_outside_the_time_of_the_poses_are_invalid(tmp_path: Path) -> None:
    with log_of(tmp_path / "a.mcap", MOUNT, odometry("/odom", (1.4, Pose2D()), (3, Pose2D()))) as log:
        assert PoseProvider(log).laser_poses(TIMES).valid.tolist() == [False, True, True]


def test_poses_on_another_clock_are_an_error(tmp_path: Path) -> None:
    with (
        log_of(tmp_path / "a.mcap", odometry("/odom", (1000, Pose2D()), (1001, Pose2D()))) as log,
        pytest.raises(LogReadError, match="two clocks"),
    ):
        PoseProvider(log).laser_poses(TIMES)


@pytest.mark.parametrize(
    ("source", "message"),
    [
        ("auto", "--pose scans"),
        ("truth", "no ground truth"),
        ("tf", "no chain from 'laser'"),
        ("odom", "no poses"),
    ],
)
def test_missing_poses_are_an_error(tmp_path: Path, source: str, message: str) -> None:
    with log_of(tmp_path / "a.mcap", MOUNT) as log, pytest.raises(LogReadError, match=message):
        PoseProvider(log).laser_poses(TIMES, source)


def raw_transform(parent: str, child: str, rotation: tuple[float, float, float, float]) -> Write:
    """A static transform with any 3D rotation."""
    vector = _new("geometry_msgs/msg/Vector3", x=0.0, y=0.0, z=0.3)
    quaternion = _new("geometry_msgs/msg/Quaternion", **dict(zip("xyzw", rotation, strict=True)))
    stamped = _new(
        "geometry_msgs/msg/TransformStamped",
        header=_new(
            "std_msgs/msg/Header", stamp=_new("builtin_interfaces/msg/Time", sec=0, nanosec=0), frame_id=parent
        ),
        child_frame_id=child,
        transform=_new("geometry_msgs/msg/Transform", translation=vector, rotation=quaternion),
    )

    def write(log: LogWriter) -> None:
        log.add_topic("/tf_static", TF_TYPE)
        log.write("/tf_static", 1, _serialize(_new(TF_TYPE, transforms=[stamped])))

    return write


def test_laser_mounted_upside_down_is_detected(tmp_path: Path) -> None:
    rolled = raw_transform("base_link", "laser", (1.0, 0.0, 0.0, 0.0))
    with log_of(tmp_path / "a.mcap", rolled, transforms("/tf", *MOVING), DRIVE) as log:
        for source in ("tf", "odom"):
            located = PoseProvider(log).laser_poses(TIMES, source)
            assert located.is_upside_down(1)
            assert located.poses[1] == pytest.approx((1, 0, math.pi / 4))


def test_tilted_laser_is_reported(tmp_path: Path) -> None:
    half = math.radians(30) / 2
    pitched = raw_transform("base_link", "laser", (0.0, math.sin(half), 0.0, math.cos(half)))
    with log_of(tmp_path / "a.mcap", pitched, DRIVE) as log:
        assert "tilted by 30 degrees" in PoseProvider(log).laser_poses(TIMES).notes[0]


def test_transform_with_a_rotation_of_zeros_is_left_out(tmp_path: Path) -> None:
    with log_of(tmp_path / "a.mcap", raw_transform("base_link", "laser", (0.0, 0.0, 0.0, 0.0))) as log:
        assert TransformTree.read(log).edges == {}


def test_loop_in_tf_ends(tmp_path: Path) -> None:
    loop = transforms("/tf", (1, "a", "laser", Pose2D()), (2, "laser", "a", Pose2D()))
    with log_of(tmp_path / "a.mcap", loop) as log:
        assert TransformTree.read(log).chain("laser") == ["laser", "a"]
