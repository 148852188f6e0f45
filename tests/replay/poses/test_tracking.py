"""Tracking: points on lines, the fit, the search, poses from scans alone, odometry that is wrong, what is noted."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from prim.arrays import FloatArray
from prim.log.messages import ODOMETRY_TYPE, SCAN_TYPE, encode_odometry, encode_scan
from prim.log.writer import LogWriter
from prim.metrics import pose_rmse
from prim.scan import PosedScan, Scan
from prim.se2 import Pose2D, compose_poses, frame_covariances, relative_poses, wrap_angles
from prim.shapes import Kind, Primitive
from prim.world import World
from recorder.sensors import Lidar
from recorder.session import SessionOptions, record_session
from replay.options import ReplayOptions
from replay.pipeline import Pipeline
from replay.poses.tracking.kernels import FULL_SCORE, Window
from replay.poses.tracking.local_map import LocalMap, joined
from replay.poses.tracking.options import DEFAULTS
from replay.poses.tracking.points import moved, scan_points, surfels, thinned
from replay.poses.tracking.scan_fit import fit_windows, scan_fit
from replay.poses.tracking.scan_tracker import ScanTracker, track
from replay.poses.tracking.track_errors import TrackErrors
from replay.result import ReplayResult

SECOND = 10**9
ROOM = World(
    (4.0, 3.0),
    (Primitive(Kind.SQUARE, 0.9, 0.6, 0.4, (0.5,)), Primitive(Kind.CIRCLE, -1.0, -0.5, None, (0.3,))),
    ((-2, -1.5, 2, -1.5), (2, -1.5, 2, 1.5), (2, 1.5, -2, 1.5), (-2, 1.5, -2, -1.5)),
)
LIDAR = Lidar(rays=240, noise_std=0.01)


def driven(count: int = 80, step: float = 0.04) -> FloatArray:
    """Poses (N, 3) on a loop about the room's middle."""
    angles = np.arange(count) * step / 0.45
    return np.column_stack((0.45 * np.cos(angles), -0.1 + 0.45 * np.sin(angles), angles + math.pi / 2))


def scans_at(poses: FloatArray, noise_std: float = 0.01, seed: int = 0, world: World = ROOM) -> list[PosedScan]:
    rng, lidar = np.random.default_rng(seed), Lidar(rays=240, noise_std=noise_std)
    posed = []
    for k, pose in enumerate(poses):
        at = Pose2D(*pose.tolist())
        scan = lidar.measure(world, at, (k + 1) * SECOND // 10, 0.1, rng)
        posed.append(PosedScan(k, scan, at, [(scan, at)]))
    return posed


def at_origin(posed: PosedScan) -> PosedScan:
    return PosedScan(posed.position, posed.scan, Pose2D(), [(posed.scan, Pose2D())])


def errors(poses: FloatArray, truth: FloatArray) -> tuple[float, float]:
    """RMSE (m, rad) of poses in the frame of the first one."""
    first = np.repeat(truth[:1], len(truth), axis=0)
    return pose_rmse(relative_poses(first, truth), poses)


def local_map(poses: FloatArray) -> LocalMap:
    points = [
        moved(scan_points(at_origin(one), 0.01, DEFAULTS.points), pose)
        for one, pose in zip(scans_at(poses), poses, strict=True)
    ]
    return LocalMap(joined(points), DEFAULTS.map)


def test_points_lie_on_the_lines_that_beams_meet() -> None:
    (posed,) = scans_at(np.array([[0.2, -0.4, 0.3]]), noise_std=0.02)
    points = scan_points(at_origin(posed), 0.02, DEFAULTS.points)
    on_line = np.hypot(points[:, 2], points[:, 3]) > 0.5
    assert on_line.mean() > 0.7
    assert (np.einsum("ni,ni->n", points[on_line, :2], points[on_line, 2:]) < 0).all(), "normals face the laser"
    world = moved(points, np.array([0.2, -0.4, 0.3]))
    wall = on_line & (world[:, 2] < -0.98) & (np.abs(world[:, 0] - 2) < 0.1)
    assert wall.sum() > 20
    raw = posed.scan.points(posed.pose)
    raw = raw[np.abs(raw[:, 0] - 2) < 0.1]
    assert np.std(world[wall, 0] - 2) < 0.7 * np.std(raw[:, 0] - 2)  # lines take out noise
    apart = np.hypot(*np.diff(points[:, :2], axis=0).T)
    assert np.median(apart) > 0.5 * DEFAULTS.points.spacing


def test_beams_without_a_return_give_no_points(make_scan: Callable[..., Scan]) -> None:
    scan = make_scan(*[math.inf, math.nan, 0.0] * 20)
    posed = PosedScan(0, scan, Pose2D(), [(scan, Pose2D())])
    assert scan_points(posed, 0.01, DEFAULTS.points).shape == (0, 4)
    assert thinned(np.zeros((0, 4)), 0.1).shape == (0, 4)
    assert len(track([posed] * 5).poses) == 5


def test_surfels_are_means_of_what_faces_alike() -> None:
    points = np.array([[0.01, 0.01, 1, 0], [0.03, 0.02, 1, 0], [0.02, 0.02, -1, 0], [0.2, 0.2, 0, 1]], float)
    assert surfels(points, 0.05) == pytest.approx(np.array([[0.02, 0.015, 1, 0]]))


@settings(max_examples=25, deadline=None)
@given(st.floats(-0.08, 0.08), st.floats(-0.08, 0.08), st.floats(-0.06, 0.06), st.integers(0, 9))
def test_a_fit_finds_the_pose(dx: float, dy: float, turn: float, seed: int) -> None:
    local = local_map(driven(12))
    pose = np.array([0.35, 0.1, 1.9])
    (posed,) = scans_at(pose[None], seed=seed)
    points = scan_points(at_origin(posed), 0.01, DEFAULTS.points)
    match = local.match(points, pose + np.array([dx, dy, turn]))
    assert match.pose == pytest.approx(pose, abs=0.01)
    assert match.score > 0.85 and match.spread < 0.02
    assert np.linalg.eigvalsh(match.information).min() > 0
    assert local.score(points, match.pose) == pytest.approx(match.score, abs=1e-9)
    assert local.score(points, pose + 0.3) < 0.5


def test_a_prior_holds_what_a_corridor_leaves_open() -> None:
    corridor = World((40.0, 2.0), (), ((-20, -1, 20, -1), (20, 1, -20, 1)))
    poses = np.column_stack((np.linspace(0, 1, 6), np.zeros(6), np.zeros(6)))
    points = [scan_points(at_origin(one), 0.01, DEFAULTS.points) for one in scans_at(poses, world=corridor)]
    local = LocalMap(joined([moved(*pair) for pair in zip(points, poses, strict=True)]), DEFAULTS.map)
    prior = np.array([0.53, 0.0, 0.0])
    free = local.match(points[3], prior)
    held = local.match(points[3], prior, prior, np.diag([50.0**2, 1.0, 1.0]))
    along, across = free.information[0, 0], free.information[1, 1]
    assert along < 0.01 * across, "what is known along a corridor is next to nothing"
    assert held.pose[0] == pytest.approx(0.53, abs=0.01) and held.pose[1:] == pytest.approx([0, 0], abs=0.01)


def test_the_search_finds_what_trying_all_poses_finds() -> None:
    """Branch and bound loses nothing: it is the best of all cells and headings in the window, less their cost."""
    local = local_map(driven(12))
    (posed,) = scans_at(np.array([[0.35, 0.1, 1.9]]))
    points = thinned(scan_points(at_origin(posed), 0.01, DEFAULTS.points), DEFAULTS.points.coarse)
    middle, window = np.array([0.2, 0.2, 1.8]), Window(0.3, 0.15, 0.05, 0.05, 0.05)
    scores, grid = local._pyramid(3), local._grid
    best = (-1.0, middle)
    for q, i, j in itertools.product(range(-3, 4), range(-6, 7), range(-6, 7)):
        world = moved(points, np.array([middle[0], middle[1], middle[2] + q * 0.05]))
        cols = np.floor((world[:, 0] - grid.x) / grid.cell).astype(int) + i
        rows = np.floor((world[:, 1] - grid.y) / grid.cell).astype(int) + j
        inside = (cols >= 0) & (rows >= 0) & (cols < scores.shape[2]) & (rows < scores.shape[1])
        score = scores[0][rows[inside], cols[inside]].sum() / (FULL_SCORE * len(points))
        score -= 0.05 * math.hypot(i, j) * grid.cell + 0.05 * abs(q) * 0.05
        best = max(
            best, (score, middle + np.array([i * grid.cell, j * grid.cell, q * 0.05])), key=lambda item: item[0]
        )
    for levels in (0, 1, 3):
        found = local.search(points, middle, window, levels)
        assert found == pytest.approx(best[1], abs=1e-9)
    assert local.search(points, middle, window, 3, least=0.99) is None
    assert found == pytest.approx([0.35, 0.1, 1.9], abs=0.06)


@pytest.mark.parametrize("seed", range(2))
def test_scans_alone_give_the_poses(seed: int) -> None:
    truth = driven()
    found = track([at_origin(one) for one in scans_at(truth, seed=seed)])
    position, heading = errors(found.poses, truth)
    assert position < 0.02 and heading < math.radians(1)
    assert found.poses[0] == pytest.approx(np.zeros(3), abs=1e-12)
    assert not found.broken and not found.overruled and not found.stands_still
    assert 0.009 < found.noise_std < 0.03  # of neighbouring beams: what is seen at a slant adds to it
    assert found.scores.min() > 0.6 and len(found.keyframes) < len(truth)


def test_all_scans_are_matched_anew_in_the_end_where_the_noise_is_low() -> None:
    truth = driven()
    scans = [at_origin(one) for one in scans_at(truth)]
    settled, streamed = track(scans), track(scans, settled_noise=0.005)
    assert not np.allclose(settled.poses, streamed.poses, atol=1e-4)
    assert errors(settled.poses, truth)[0] < 1.5 * errors(streamed.poses, truth)[0]


def test_odometry_that_stands_still_is_not_followed() -> None:
    truth = driven()
    found = track([at_origin(one) for one in scans_at(truth)], np.zeros_like(truth))
    assert found.stands_still and found.overrules
    assert errors(found.poses, truth)[0] < 0.03


def test_odometry_that_jumps_is_not_followed_there() -> None:
    truth = driven()
    odometry = truth.copy()
    odometry[40:] = compose_poses(np.repeat([[0.6, -0.4, 1.2]], 40, axis=0), truth[40:])
    found = track([at_origin(one) for one in scans_at(truth)], odometry)
    assert found.overruled == (40,) and not found.broken and not found.overrules
    assert errors(found.poses, truth)[0] < 0.03


def test_odometry_that_jumps_all_the_time_is_replaced(tmp_path: Path) -> None:
    """Even where scans are matched with the forward map, which begins with the odometry else."""
    truth = driven(40)
    odometry = truth + np.where(np.arange(40) % 2, 20.0, 0.0)[:, None] * (1, 0, 0)
    path = write(tmp_path / "a.mcap", truth, odometry)
    options = ReplayOptions(resolution=0.02, detect=False, pose="odom", match_scans=True)
    assert pose_rmse(Pipeline(path, options).run().poses.poses, truth)[0] < 0.02


def test_a_robot_that_is_carried_away_is_said_to_be_lost() -> None:
    """From the room it gets into a corridor that looks like nothing in it."""
    corridor = World((40.0, 2.0), (), ((-20, -1, 20, -1), (20, 1, -20, 1)))
    inside = np.column_stack((np.linspace(0, 1, 20), np.zeros(20), np.zeros(20)))
    scans = [*scans_at(driven(30)), *scans_at(inside, world=corridor)]
    held = [at_origin(one) for one in scans]
    tracker = ScanTracker(
        [scan_points(one, 0.01, DEFAULTS.points) for one in held],
        np.arange(50, dtype=np.int64) * SECOND // 10,
        None,
    )
    tracker.run()
    assert tracker.broken and tracker.broken[0] in (30, 31)
    tracker.settle()
    first = tracker.broken[0]
    alone = ScanTracker(tracker.points[:first], np.arange(first, dtype=np.int64) * SECOND // 10, None)
    alone.run()
    alone.settle()
    assert tracker.poses[:first] == pytest.approx(alone.poses, abs=1e-9), "nothing is matched with what is after"


def test_constant_velocity_helps_where_odometry_jumps() -> None:
    """Without a search further away, which finds the place as well."""
    truth = driven()
    odometry = truth.copy()
    odometry[40:] = compose_poses(np.repeat([[0.9, -0.6, 1.6]], 40, axis=0), truth[40:])
    near = replace(DEFAULTS, lost=0.0, broken=0.0)
    found = track([at_origin(one) for one in scans_at(truth)], odometry, options=near)
    assert found.overruled == (40,) and errors(found.poses, truth)[0] < 0.03


def test_scans_tell_by_which_poses_they_fit() -> None:
    truth = driven(160)
    rng = np.random.default_rng(0)
    shaken = truth + rng.normal(0, (0.2, 0.2, 0.15), truth.shape)
    scans = scans_at(truth)
    moved_scans = [
        PosedScan(one.position, one.scan, Pose2D(*pose.tolist()), [(one.scan, Pose2D(*pose.tolist()))])
        for one, pose in zip(scans, shaken, strict=True)
    ]
    for windows in fit_windows(len(scans)):
        good = scan_fit([[scans[k] for k in window] for window in windows])
        bad = scan_fit([[moved_scans[k] for k in window] for window in windows])
        assert good.given > 0.9 and not good.is_bad() and not good.is_worse_than(bad)
        assert bad.given < 0.7 and bad.is_worse_than(good)
        assert bad.is_bad()
    assert scan_fit([]).scans == 0 and not scan_fit([]).is_bad()
    assert fit_windows(5) == ([range(5)], [range(5)])
    near, far = fit_windows(1000)
    assert near[0] == range(12) and near[-1] == range(988, 1000)
    assert far[0] == range(0, 156, 13) and far[-1][-1] >= 900


def write(path: Path, truth: FloatArray, odometry: FloatArray | None = None, noise_std: float = 0.01) -> Path:
    """Write a log of scans at poses, with odometry as it is given."""
    with LogWriter(path) as log:
        log.add_topic("/scan", SCAN_TYPE)
        if odometry is not None:
            log.add_topic("/odom", ODOMETRY_TYPE)
        for k, posed in enumerate(scans_at(truth, noise_std)):
            stamp = posed.scan.stamp
            if odometry is not None:
                log.write("/odom", stamp, encode_odometry(stamp, Pose2D(*odometry[k].tolist())))
            log.write("/scan", stamp, encode_scan(posed.scan))
    return path


def replayed(path: Path, **options: object) -> tuple[FloatArray, ReplayResult]:
    result = Pipeline(path, ReplayOptions(resolution=0.05, detect=False, **options)).run()  # type: ignore[arg-type]
    return result.poses.poses, result


@pytest.mark.parametrize("pose", ["auto", "scans"])
def test_a_log_of_scans_alone_is_replayed(tmp_path: Path, pose: str) -> None:
    truth = driven()
    poses, result = replayed(write(tmp_path / "a.mcap", truth), pose=pose)
    assert errors(poses, truth)[0] < 0.02
    assert result.poses.source == "scans" and result.poses.matched
    noted = any("they are found by the scans alone" in note for note in result.notes)
    assert noted == (pose == "auto")


def test_where_scans_say_too_little_nothing_is_claimed(tmp_path: Path) -> None:
    truth = driven(25)
    _, result = replayed(write(tmp_path / "a.mcap", truth, noise_std=0.3))
    assert result.poses.covariances is None and result.poses.frame_covariance_at(0.0, 0.0) is None
    assert any("how far is not known" in note for note in result.notes)


def test_odometry_alone_that_stands_still_is_left_by_auto(tmp_path: Path) -> None:
    truth = driven()
    poses, result = replayed(write(tmp_path / "a.mcap", truth, np.zeros_like(truth)))
    assert errors(poses, truth)[0] < 0.02
    assert any("stands still where the scans do not" in note for note in result.notes)
    poses, result = replayed(tmp_path / "a.mcap", pose="odom")
    assert any("try --match-scans" in note for note in result.notes)
    assert not poses.any()
    poses, result = replayed(tmp_path / "a.mcap", pose="odom", match_scans=True)
    assert errors(poses, truth)[0] < 0.02
    assert any("moves by 0.00 m where the scans move by" in note for note in result.notes)


def test_the_frame_is_that_of_the_first_true_pose(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    lidar = Lidar(rays=240, noise_std=0.01)
    record_session(path, SessionOptions(seed=5, motion="drive", duration=10.0, rate=8.0, lidar=lidar))
    _, result = replayed(path, pose="scans")
    assert result.pose_rmse is not None and result.pose_rmse[0] < 0.03


def test_headings_are_within_a_turn(tmp_path: Path) -> None:
    truth = driven(110, 0.06)
    poses, _ = replayed(write(tmp_path / "a.mcap", truth))
    assert np.abs(poses[:, 2]).max() <= math.pi
    assert np.abs(wrap_angles(np.diff(poses[:, 2]))).max() < 0.3


def test_errors_of_tracks_are_those_of_a_random_walk() -> None:
    """Steps along x whose headings are unsure: a keyframe's turns what follows, a scan's own is its own."""
    poses = np.column_stack((np.arange(5.0), np.zeros(5), np.zeros(5)))
    own = np.repeat(np.diag([1e-4, 4e-4, 1e-6])[None], 5, axis=0)
    errors = TrackErrors.of(poses, own, keyframes=(0, 2), breaks=(), break_std=6.0, first_std=1e-5)
    since = errors.since_first()
    assert np.diag(since[0]) == pytest.approx([1e-10] * 3)
    # at x = 4 m: its own, the first one's turned by 4 m, and the keyframe's at 2 m turned by 2 m
    assert since[4, 1, 1] == pytest.approx(4e-4 + (4e-4 + 16e-6) + (4e-4 + 4e-6), rel=1e-4)
    assert since[4, 2, 2] == pytest.approx(3e-6, rel=1e-3) and since[4, 1, 2] == pytest.approx(4e-6 + 2e-6, rel=1e-3)
    between = errors.between(np.array([0, 3, 1]), np.array([4, 4, 2]))
    assert between[0] == pytest.approx(since[4], abs=1e-9)
    assert between[1, 1, 1] == pytest.approx(4e-4 + 4e-4 + 1e-6), "nothing is a keyframe on the way"
    assert between[2, 0, 0] == pytest.approx(3e-4)
    turned = TrackErrors.of(
        np.column_stack((np.zeros(5), np.arange(5.0), np.full(5, math.pi / 2))),
        own[:, [1, 0, 2]][:, :, [1, 0, 2]],
        (0, 2),
        (),
        6.0,
        1e-5,
    )
    assert turned.between(np.array([0]), np.array([4]))[0] == pytest.approx(between[0], abs=1e-12)
    lost = TrackErrors.of(poses, own, (0, 2), (3,), 6.0, 1e-5).since_first()
    assert lost[2] == pytest.approx(since[2]) and lost[3, 0, 0] > 36 and lost[4, 2, 2] > 36


def test_tracked_poses_and_what_is_seen_from_them_are_as_unsure_as_they_are_off(tmp_path: Path) -> None:
    values, places = [], []
    for seed in range(3):
        path = tmp_path / f"{seed}.mcap"
        session = SessionOptions(
            seed=seed, motion="drive", duration=20.0, rate=8.0, lidar=Lidar(rays=300, noise_std=0.01)
        )
        record_session(path, session)
        _, result = replayed(path, pose="odom", match_scans=True)
        poses = result.poses
        assert poses.frame_covariance is None and poses.covariances is not None
        values.append(result.pose_nees)
        last = poses.frame_covariance_at(*poses.poses[-1, :2].tolist())
        assert last is not None
        places.append(frame_covariances(last, poses.poses[-1:])[0])
        assert places[-1] == pytest.approx(poses.covariances[-1], rel=1e-6)
    assert 0.05 < np.median(values) < 6, "wide in a room that is seen again and again, never narrow"
    assert 1e-3 < math.sqrt(np.mean([place[0, 0] for place in places])) < 0.05
