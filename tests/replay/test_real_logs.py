"""Logs that nobody here recorded, end to end."""

import json
import math
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from mapping.mapper import MAPPERS
from prim import console
from prim.arrays import FloatArray
from prim.se2 import Pose2D
from prim.shapes import Kind
from replay.cli import app
from replay.options import ReplayOptions
from replay.pipeline import Pipeline
from replay.result import ReplayResult

Find = Callable[[str], Path]
every = pytest.mark.parametrize("mapper", MAPPERS)


def fit_circle(points: FloatArray) -> tuple[float, float, float]:
    """Fit a circle by least squares; return x, y, radius."""
    x, y = points.T
    a, b, c = np.linalg.lstsq(np.column_stack((2 * x, 2 * y, np.ones(len(x)))), x**2 + y**2, rcond=None)[0]
    return float(a), float(b), math.sqrt(c + a**2 + b**2)


def pillars(path: Path, mapper: str) -> ReplayResult:
    return Pipeline(path, ReplayOptions(mapper=mapper, laser_offset=Pose2D(-0.032, 0, 0))).run()


@every
def test_four_round_pillars_in_a_square_room(real_log: Find, mapper: str) -> None:
    result = pillars(real_log("pillars4.mcap"), mapper)
    assert result.poses.source == "odom"
    assert (result.scans, result.scans_used) == (341, 340)
    points = result.grid.frame.centres(result.grid.occupied)
    for x in (-0.6, 0.6):
        for y in (-0.6, 0.6):
            near = points[np.hypot(points[:, 0] - x, points[:, 1] - y) < 0.3]
            centre_x, centre_y, radius = fit_circle(near)
            assert math.hypot(centre_x - x, centre_y - y) < 0.02
            assert radius == pytest.approx(0.15, abs=0.02)
    elsewhere = points[np.abs(points).max(axis=1) < 1.7]
    distances = np.hypot(np.abs(elsewhere[:, 0]) - 0.6, np.abs(elsewhere[:, 1]) - 0.6)
    assert np.mean(distances < 0.25) > 0.95


@every
def test_the_rooms_four_walls(real_log: Find, mapper: str) -> None:
    """The median of the outermost cells on each side is where the wall is."""
    result = pillars(real_log("pillars4.mcap"), mapper)
    points = result.grid.frame.centres(result.grid.occupied)
    walls = points[np.abs(points).max(axis=1) > 1.6]
    for axis in (0, 1):
        for side in (-1, 1):
            on_wall = walls[(side * walls[:, axis] > 1.6) & (np.abs(walls[:, 1 - axis]) < 1.5)]
            assert len(on_wall) > 250
            assert side * np.median(on_wall[:, axis]) == pytest.approx(1.86, abs=0.03)


def test_a_missing_mount_is_noted_with_its_option(real_log: Find) -> None:
    result = Pipeline(real_log("pillars4.mcap"), ReplayOptions(mapper="det")).run()
    assert any("--laser-offset" in note for note in result.notes)


@every
def test_the_floor_plan_of_csail(real_log: Find, mapper: str) -> None:
    """The size of the floor is known, corridors are free, walls straight, and all poses are used."""
    result = Pipeline(real_log("csail.mcap"), ReplayOptions(mapper=mapper, resolution=0.05, detect=False)).run()
    assert (result.poses.source, result.poses.origin) == ("tf", "odom > laser")
    assert result.scans_used == 686
    x0, y0, x1, y1 = result.grid.frame.bounds
    assert (x1 - x0, y1 - y0) == pytest.approx((53.3, 81.75), abs=0.2)
    grid = result.grid
    for x, y, _ in result.poses.poses[::10]:
        row, col = (np.array([y - y0, x - x0]) / 0.05).astype(int)
        assert grid.free[row - 1 : row + 2, col - 1 : col + 2].mean() > 0.5
    assert 3_000 < np.count_nonzero(grid.occupied) < 30_000


def test_the_two_boxes_of_csail_are_rectangles(real_log: Find) -> None:
    """They are alike, and stand free in a room of their own."""
    result = Pipeline(real_log("csail.mcap"), ReplayOptions(mapper="prob", resolution=0.05)).run()
    assert result.detections is not None
    found = [detection.primitive for detection in result.detections.detections.found]
    for x, y in ((30.56, -17.39), (30.16, -18.22)):
        (box,) = (one for one in found if math.hypot(one.x - x, one.y - y) < 0.1)
        assert box.kind is Kind.RECTANGLE
        assert box.size == pytest.approx((0.56, 0.42), abs=0.03)


def test_odometry_and_transforms_of_csail_agree(real_log: Find) -> None:
    tf, odom = (
        Pipeline(real_log("csail.mcap"), ReplayOptions(resolution=0.5, pose=pose, detect=False)).run().poses.poses
        for pose in ("tf", "odom")
    )
    assert odom == pytest.approx(tf, abs=1e-6)


def test_the_forward_map_distinguishes_a_railing_from_walls(real_log: Find) -> None:
    """The hall in the middle of the floor is seen through its railing: free, but for the railing itself."""
    result = Pipeline(real_log("csail.mcap"), ReplayOptions(mapper="forward", resolution=0.05, detect=False)).run()
    assert result.noise_std == pytest.approx(0.032, abs=0.01)
    x0, y0, _, _ = result.grid.frame.bounds
    row, col = round((-5.6 - y0) / 0.05), round((11.7 - x0) / 0.05)
    hall = slice(row - 20, row + 20), slice(col - 20, col + 20)
    assert result.grid.free[hall].mean() > 0.9


@pytest.fixture
def failing(in_tmp: Path, capsys: pytest.CaptureFixture[str]) -> Callable[..., str]:
    """Run prim-replay, which must fail with one line and write nothing."""

    def run(*arguments: object) -> str:
        assert console.run(app, "prim-replay", [str(argument) for argument in arguments]) == 1
        seen = capsys.readouterr()
        assert (seen.out, seen.err.count("\n")) == ("", 1)
        assert list(in_tmp.iterdir()) == []
        return seen.err

    return run


def test_two_scanners_without_poses_are_refused(real_log: Find, failing: Callable[..., str]) -> None:
    path = real_log("hokuyo_two_scanners.mcap")
    both_topics = failing(path)
    assert "/front_scan, /rear_scan" in both_topics and "--scan-topic" in both_topics
    assert "--pose scans" in failing(path, "--scan-topic", "/front_scan", "--pose", "odom")
    assert "its scan topics: /front_scan, /rear_scan" in failing(path, "--scan-topic", "/scan")


def test_a_scanner_without_poses_is_tracked(real_log: Find) -> None:
    """It stands still, which its scans say."""
    options = ReplayOptions(scan_topic=("/front_scan",), resolution=0.05, detect=False)
    result = Pipeline(real_log("hokuyo_two_scanners.mcap"), options).run()
    assert result.poses.source == "scans"
    assert np.abs(result.poses.poses[:, :2]).max() < 0.05 and np.abs(result.poses.poses[:, 2]).max() < 0.01


@every
def test_a_scanner_that_stands_still_is_mapped(real_log: Find, in_tmp: Path, mapper: str) -> None:
    path = real_log("hokuyo_two_scanners.mcap")
    arguments = [str(path), "--scan-topic", "/front_scan", "--standing-still", "--mapper", mapper, "--quiet"]
    assert console.run(app, "prim-replay", arguments) == 0
    report = json.loads(Path(f"hokuyo_two_scanners.{mapper}.report.json").read_text())
    assert report["pose"]["source"] == "still" and report["pose"]["rmse_m"] is None
    assert report["log"]["scans_used"] == report["log"]["scans"] == 331
    assert report["map"]["scores"] is None
    options = ReplayOptions(mapper=mapper, scan_topic=("/front_scan",), standing_still=True)
    grid = Pipeline(path, options).run().grid
    assert np.count_nonzero(grid.occupied) > 200
    assert np.count_nonzero(grid.free) > 10_000


@pytest.mark.parametrize(
    ("name", "listed"),
    [
        ("no_scan_nav2.mcap", ["/odom (nav_msgs/msg/Odometry)", "/tf (tf2_msgs/msg/TFMessage)", "/amcl_pose"]),
        ("no_scan_marker.mcap", ["/cube/test (visualization_msgs/msg/Marker)"]),
    ],
)
def test_logs_without_scans_are_refused_with_their_topics(
    real_log: Find, failing: Callable[..., str], name: str, listed: list[str]
) -> None:
    error = failing(real_log(name))
    assert "no LaserScan" in error
    assert all(topic in error for topic in listed)
