"""Frames that are missing from tf, or contradict each other."""

import math
from pathlib import Path

import numpy as np
import pytest

from prim.errors import LogReadError
from prim.log import open_log
from prim.log.messages import ODOMETRY_TYPE, TF_TYPE, encode_odometry, encode_transforms
from prim.log.writer import LogWriter
from prim.se2 import Pose2D
from replay.poses.laser_poses import LaserPoses, ScanTimes
from replay.poses.pose_provider import PoseProvider

SECOND = 10**9
STAMPS = np.array([2, 4, 6], dtype=np.int64) * SECOND
Edges = list[tuple[str, str, Pose2D]]


def located(
    folder: Path, moving: Edges, static: Edges, frame: str, odom: bool = False, offset: Pose2D | None = None
) -> LaserPoses:
    """The poses of a laser by a log in which what moves does so along x, at 1 m/s."""
    path = folder / "a.mcap"
    with LogWriter(path) as log:
        for topic in ("/tf", "/tf_static"):
            log.add_topic(topic, TF_TYPE)
        log.add_topic("/odom", ODOMETRY_TYPE)
        if static:
            log.write("/tf_static", 1, encode_transforms((1, *edge) for edge in static))
        for tenth in range(81):
            stamp, x = tenth * SECOND // 10, tenth / 10
            for parent, child, pose in moving:
                moved = Pose2D(pose.x + x, pose.y, pose.theta)
                log.write("/tf", stamp, encode_transforms([(stamp, parent, child, moved)]))
            if odom:
                log.write("/odom", stamp, encode_odometry(stamp, Pose2D(x, 5.0, 0)))
    with open_log(path) as opened:
        return PoseProvider(opened, laser_offset=offset).laser_poses(ScanTimes(STAMPS, (frame,)), "auto")


DRIVEN: Edges = [("odom", "base_link", Pose2D())]
MOUNTED: Edges = [("base_link", "laser", Pose2D(0.2, 0, 0))]


@pytest.mark.parametrize("frame", ["laser", "/laser", "", "laser_frame"])
def test_the_only_frame_that_can_be_a_scanners_is_the_scanners(tmp_path: Path, frame: str) -> None:
    static: Edges = [*MOUNTED, ("base_link", "imu_link", Pose2D())]
    poses = located(tmp_path, DRIVEN, static, frame)
    assert poses.poses[:, 0] == pytest.approx([2.2, 4.2, 6.2])
    assert any("alone can be a scanner's" in note for note in poses.notes) == (frame not in ("laser", "/laser"))
    assert not poses.mount_assumed


@pytest.mark.parametrize("frame", ["", "other"])
def test_of_two_scanners_none_is_taken(tmp_path: Path, frame: str) -> None:
    poses = located(tmp_path, DRIVEN, [*MOUNTED, ("base_link", "laser_2", Pose2D(9, 9, 0))], frame)
    assert poses.poses[:, 0] == pytest.approx([2, 4, 6])
    assert poses.mount_assumed
    assert any("no transform from base_link" in note and "--laser-offset" in note for note in poses.notes)


@pytest.mark.parametrize("root", ["odom", "map", "world"])
@pytest.mark.parametrize("base", ["base_link", "base_footprint", "agv"])
def test_without_a_mount_the_laser_is_at_the_robots_frame(tmp_path: Path, root: str, base: str) -> None:
    moving: Edges = [(root, base, Pose2D()), (base, "left_wheel", Pose2D(0, 0.2, 0))]
    poses = located(tmp_path, moving, [], "laser")
    assert (poses.source, poses.origin, poses.mount_assumed) == ("tf", f"{root} > {base}", True)
    assert poses.poses[:, 0] == pytest.approx([2, 4, 6])


def test_an_offset_is_that_from_the_robots_frame(tmp_path: Path) -> None:
    poses = located(tmp_path, DRIVEN, [], "laser", offset=Pose2D(0.1, 0.02, math.pi / 2))
    assert poses.poses[0] == pytest.approx((2.1, 0.02, math.pi / 2))
    assert (poses.mount_assumed, poses.notes) == (False, ())


def test_a_topic_of_poses_comes_before_the_robot_in_tf(tmp_path: Path) -> None:
    poses = located(tmp_path, DRIVEN, [], "laser", odom=True)
    assert (poses.source, poses.origin, poses.mount_assumed) == ("odom", "/odom", True)


def test_nothing_is_taken_for_a_robot_that_may_be_several(tmp_path: Path) -> None:
    with pytest.raises(LogReadError, match="no poses"):
        located(tmp_path, [("world", "a", Pose2D()), ("world", "b", Pose2D(0, 1, 0))], [], "laser")


def test_two_publishers_that_contradict_each_other_are_noted_by_their_distance(tmp_path: Path) -> None:
    twice: Edges = [("odom", "base_link", Pose2D()), ("odom", "base_link", Pose2D(0, 0.3, 0))]
    path = tmp_path / "a.mcap"
    with LogWriter(path) as log:
        log.add_topic("/tf", TF_TYPE)
        for k in range(160):
            stamp = k * SECOND // 20
            parent, child, pose = twice[k % 2]
            log.write("/tf", stamp, encode_transforms([(stamp, parent, child, Pose2D(k / 200, pose.y, 0))]))
    with open_log(path) as opened:
        poses = PoseProvider(opened).laser_poses(ScanTimes(STAMPS, ("base_link",)), "auto")
    assert [note for note in poses.notes if "two publishers contradict" in note and "0.300 m" in note]


def test_static_transforms_that_differ_are_noted(tmp_path: Path) -> None:
    other: Edges = [("base_link", "laser", Pose2D(0.5, 0, 0)), *MOUNTED]
    poses = located(tmp_path, DRIVEN, other, "laser")
    assert poses.poses[0] == pytest.approx((2.2, 0, 0))
    assert any("static transforms from base_link to laser" in note and "0.300 m" in note for note in poses.notes)


def test_one_publisher_contradicts_nothing(tmp_path: Path) -> None:
    assert located(tmp_path, DRIVEN, [*MOUNTED, *MOUNTED], "laser").notes == ()
