"""Driven sessions: exploration, odometry drift, physics, and what remains of a recording that is killed."""

import math
import os
import random
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
import shapely

from prim.log import open_log
from prim.log.decoding.values import planar_pose
from prim.log.messages import (
    SCAN_TOPIC,
    TRUE_POSE_TOPIC,
    TRUE_PRIMITIVES_TOPIC,
)
from prim.se2 import Pose2D, Trajectory
from prim.shapes import Kind, Primitive
from prim.world import World
from recorder.motion import drive
from recorder.odometry import Odometry, OdometryNoise
from recorder.sensors import Lidar
from recorder.session import Session, SessionOptions, record_session
from recorder.simulator import Simulator, SimulatorOptions
from replay.options import ReplayOptions
from replay.pipeline import Pipeline

ROBOT_RADIUS = SimulatorOptions().robot_radius


@pytest.fixture(scope="module")
def driven(tmp_path_factory: pytest.TempPathFactory) -> Session:
    path = tmp_path_factory.mktemp("driven") / "driven.mcap"
    return record_session(path, SessionOptions(seed=10, motion="drive", lidar=Lidar(rays=180, noise_std=0.02)))


def trajectory(path: Path, topic: str) -> Trajectory:
    with open_log(path) as log:
        found = [pose for _, (pose,) in log.decoded(log.topics[topic])]
    poses = [(p.x, p.y, p.theta) for p in map(planar_pose, found)]
    return Trajectory.from_unsorted([pose.stamp for pose in found], poses)


def test_the_robot_explores_and_keeps_clear_of_obstacles(driven: Session) -> None:
    true = trajectory(driven.path, TRUE_POSE_TOPIC)
    assert len(true) == driven.scans == 600
    outlines = shapely.union_all([shapely.Polygon(primitive.outline()) for primitive in driven.world.primitives])
    points = shapely.points(true.poses[:, :2])
    assert shapely.distance(points, outlines).min() > ROBOT_RADIUS
    assert np.abs(true.poses[:, :2]).max() < 1 - ROBOT_RADIUS
    steps = np.hypot(*np.diff(true.poses[:, :2], axis=0).T)
    assert steps.max() < 0.2 * 0.1 * 1.2
    assert steps.sum() > 5
    assert len({(round(x / 0.25), round(y / 0.25)) for x, y, _ in true.poses}) > 15


def test_odometry_errors_have_their_covariance() -> None:
    """Over many runs of 2 m: the spread of position and heading errors against the mean covariance."""
    true = [Pose2D(0.02 * i, 0.3 * math.sin(0.05 * i), 0.5 * math.sin(0.03 * i)) for i in range(100)]
    errors, mean_covariance = [], np.zeros((3, 3))
    for seed in range(400):
        odometry = Odometry(OdometryNoise(), np.random.default_rng(seed))
        for pose in true:
            estimated = odometry.update(pose, 0.02)
        errors.append((estimated.x - pose.x, estimated.y - pose.y, estimated.theta - pose.theta))
        assert estimated.covariance is not None
        mean_covariance = mean_covariance + estimated.covariance / 400
    assert np.sqrt(np.diag(np.cov(np.array(errors).T))) == pytest.approx(np.sqrt(np.diag(mean_covariance)), rel=0.1)
    assert np.std([error[2] for error in errors]) == pytest.approx(math.radians(2) * math.sqrt(1.98), rel=0.1)


def test_odometry_without_noise_is_the_truth(tmp_path: Path) -> None:
    still = OdometryNoise(0.0, 0.0)
    session = record_session(
        tmp_path / "a.mcap",
        SessionOptions(seed=2, motion="drive", duration=10, odometry=still, lidar=Lidar(rays=8)),
    )
    true, estimated = (trajectory(session.path, topic) for topic in (TRUE_POSE_TOPIC, "/odom"))
    assert estimated.poses == pytest.approx(true.poses, abs=1e-9)


@pytest.mark.parametrize("mapper", ["det", "prob"])
def test_true_poses_of_a_driven_session_map_well_and_odometry_poses_do_not(driven: Session, mapper: str) -> None:
    true = Pipeline(driven.path, ReplayOptions(mapper=mapper)).run()
    estimated = Pipeline(driven.path, ReplayOptions(mapper=mapper, pose="odom")).run()
    assert true.scores is not None and estimated.scores is not None and estimated.pose_rmse is not None
    assert true.scores.free_accuracy is not None and true.scores.free_accuracy > 0.97
    assert true.scores.occupied_f1 is not None and estimated.scores.occupied_f1 is not None
    assert true.scores.occupied_f1 > 0.8
    assert estimated.scores.occupied_f1 < true.scores.occupied_f1 - 0.2
    assert estimated.pose_rmse[0] > 0.03


def test_the_same_driven_session_writes_the_same_bytes(tmp_path: Path) -> None:
    options = SessionOptions(seed=3, motion="drive", duration=30, movable=True, lidar=Lidar(rays=100))
    first, second = (record_session(tmp_path / name, options).path.read_bytes() for name in ("a.mcap", "b.mcap"))
    assert first == second


def test_pushed_primitives_move_and_are_logged(tmp_path: Path) -> None:
    session = record_session(
        tmp_path / "a.mcap", SessionOptions(seed=10, motion="drive", movable=True, lidar=Lidar(rays=60))
    )
    with open_log(session.path) as log:
        topic = log.topics[TRUE_PRIMITIVES_TOPIC]
        logged = [primitives for _, (_, primitives) in log.decoded(topic)]
        scans = [scan for _, scan in log.decoded(log.topics[SCAN_TOPIC])]
    first, last = logged[0], logged[-1]
    moved = [math.hypot(a.x - b.x, a.y - b.y) for a, b in zip(first, last, strict=True)]
    assert len(logged) > 10
    assert max(moved) > 0.05
    assert [(p.kind, p.size) for p in first] == [(p.kind, p.size) for p in last]
    assert len(scans) == 600


@pytest.mark.parametrize("movable", [False, True])
def test_a_box_stops_the_robot_or_is_pushed(movable: bool) -> None:
    """Straight at a box whose face is 0.3 m away, for 2 s at 0.2 m/s."""
    box = Primitive(Kind.SQUARE, 0.4, 0.0, 0.0, (0.2,))
    simulator = Simulator(World((2.0, 2.0), (box,)).with_walls(), movable=movable)
    assert simulator.warp(Pose2D())
    simulator.drive(0.2, 0.2, 2.0)
    pushed = simulator.current_world().primitives[0].x - 0.4
    assert simulator.pose.x == pytest.approx(0.3 - ROBOT_RADIUS + pushed, abs=3e-3)
    assert (pushed > 0.05) if movable else (pushed == 0)


def test_walls_stop_the_robot() -> None:
    simulator = Simulator(World((1.0, 1.0)).with_walls())
    simulator.warp(Pose2D())
    simulator.drive(0.2, 0.2, 4.0)
    assert simulator.pose.x == pytest.approx(0.5 - ROBOT_RADIUS, abs=3e-3)


@pytest.mark.parametrize(("left", "right"), [(0.1, 0.1), (-0.1, -0.1), (0.1, -0.1), (0.12, 0.06)])
def test_wheel_speeds_move_the_robot_by_differential_drive_kinematics(left: float, right: float) -> None:
    simulator = Simulator(World((9.0, 9.0)))
    simulator.warp(Pose2D())
    simulator.drive(left, right, 1.0)
    before = simulator.pose
    simulator.drive(left, right, 1.0)
    step = before.inverse() @ simulator.pose
    turn = (right - left) / SimulatorOptions().track_width
    ahead = (left + right) / 2
    expected = Pose2D(
        ahead * (math.sin(turn) / turn if turn else 1), ahead * ((1 - math.cos(turn)) / turn if turn else 0), turn
    )
    assert (step.x, step.y) == pytest.approx((expected.x, expected.y), abs=2e-3)
    assert math.cos(step.theta - expected.theta) == pytest.approx(1, abs=1e-3)


def test_a_world_without_room_to_drive_is_refused() -> None:
    from prim.errors import UsageError

    full = World((1.0, 1.0), (Primitive(Kind.SQUARE, 0.0, 0.0, 0.0, (0.95,)),)).with_walls()
    with pytest.raises(UsageError, match="no room"):
        next(drive(Simulator(full), np.random.default_rng(0), 0.1, 1, 0.2))


def killed_recording(folder: Path, seconds: float, seed: int) -> tuple[Path, float]:
    """A recorder that is killed with SIGKILL after writing for so many seconds: its file, and when that was."""
    code = "from recorder.cli import main; main()"
    options = ["--motion", "drive", "--duration", "100000", "--rays", "90", "--seed", str(seed), "--quiet"]
    process = subprocess.Popen([sys.executable, "-c", code, str(folder / f"{seed}.mcap"), *options])
    while not (parts := list(folder.glob(f"{seed}.mcap.*.part"))) and process.poll() is None:
        time.sleep(0.01)
    time.sleep(seconds)
    killed = time.time()
    os.kill(process.pid, signal.SIGKILL)
    process.wait()
    return parts[0], killed


def check_killed(part: Path, killed: float, seconds: float) -> None:
    """Every chunk is read, and the last one was written in the second before the end."""
    with open_log(part, recover=True) as log:
        scans = [scan for _, scan in log.decoded(log.topics[SCAN_TOPIC])] if log.topics else []
        assert len(log.lost) == 1
    if seconds > 1:
        assert killed - part.stat().st_mtime < 1
        assert len(scans) > 50
        assert (np.diff([scan.stamp for scan in scans]) == 100_000_000).all()


def test_a_killed_recorder_leaves_what_it_wrote(tmp_path: Path) -> None:
    check_killed(*killed_recording(tmp_path, 2.0, seed=1), 2.0)


@pytest.mark.slow
def test_a_recorder_killed_at_any_moment_leaves_what_it_wrote(tmp_path: Path) -> None:
    rng = random.Random(0)
    for seed in range(30):
        seconds = rng.uniform(0.0, 4.0)
        check_killed(*killed_recording(tmp_path, seconds, seed), seconds)
