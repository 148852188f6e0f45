"""Scan matching: the score of the likelihood, convergence to the true poses, deskewed scans."""

import math
from collections.abc import Iterator
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import pytest

from mapping.forward.mapper import ForwardMapper
from mapping.forward.scan_likelihood import ScanLikelihood, ScanRays, maximize_pose
from prim.arrays import FloatArray
from prim.log import open_log
from prim.metrics import pose_nees, pose_rmse
from prim.scan import PosedScan, Scan, deskew
from prim.se2 import Pose2D, wrap_angles
from prim.shapes import Kind, Primitive
from prim.world import World
from recorder.sensors import Lidar
from recorder.session import SessionOptions, record_session
from replay.options import ReplayOptions
from replay.pipeline import Pipeline
from replay.poses.fusion_options import SensorNoise
from replay.poses.laser_poses import FUSED, LaserPoses
from replay.poses.pose_provider import PoseProvider
from replay.poses.scan_matching import match_scans
from replay.scans.posed_scans import PosedScans
from replay.scans.scan_log import ScanLog
from replay.scans.selection import Selection

ROOM = World(
    (2.0, 2.0),
    (Primitive(Kind.SQUARE, 0.4, 0.3, 0.3, (0.3,)), Primitive(Kind.CIRCLE, -0.5, -0.2, None, (0.2,))),
    ((-1, -1, 1, -1), (1, -1, 1, 1), (1, 1, -1, 1), (-1, 1, -1, -1)),
)
NO_MOUNT = np.zeros(3)


def scans_of(poses: list[Pose2D], noise_std: float = 0.02, rays: int = 200) -> list[Scan]:
    rng = np.random.default_rng(0)
    return [
        Lidar(rays=rays, noise_std=noise_std).measure(ROOM, pose, k + 1, 0.1, rng) for k, pose in enumerate(poses)
    ]


def around(count: int) -> list[Pose2D]:
    angles = np.linspace(0, 2 * np.pi, count, endpoint=False)
    return [Pose2D(0.2 * math.cos(a), -0.5 + 0.2 * math.sin(a), a) for a in angles.tolist()]


@pytest.fixture(scope="module")
def likelihood() -> ScanLikelihood:
    mapper = ForwardMapper(0.01, (-1.1, -1.1, 1.1, 1.1))
    poses = around(30)
    for scan, pose in zip(scans_of(poses), poses, strict=True):
        mapper.accumulate(scan, pose)
    fit = mapper.fit()
    return ScanLikelihood.of(fit, fit.noise)


@pytest.mark.parametrize("mount", [Pose2D(), Pose2D(0.1, -0.05, 0.8)])
def test_matching_recovers_the_true_pose(likelihood: ScanLikelihood, mount: Pose2D) -> None:
    laser = Pose2D(0.1, -0.4, 0.5)
    scan = scans_of([laser])[0]
    robot = laser @ mount.inverse()
    true = np.array([robot.x, robot.y, robot.theta])
    at = np.array([mount.x, mount.y, mount.theta])
    beams = ScanRays.from_pieces([(scan, laser)], laser, 200)
    start = true + np.array([0.02, -0.015, 0.02])
    nearer, _ = maximize_pose(likelihood, beams, at, start, start, np.zeros((3, 3)), noise_scale=2.0)
    pose, derivatives = maximize_pose(likelihood, beams, at, nearer, nearer, np.zeros((3, 3)))
    std = np.sqrt(np.diag(np.linalg.inv(derivatives.information)))
    assert np.abs(pose - true) == pytest.approx(0, abs=5 * std.max())
    assert std[:2].max() < 0.006 and std[2] < 0.01
    assert likelihood.log_likelihood(beams, pose, at) > likelihood.log_likelihood(
        beams, true + np.array([0.05, 0, 0]), at
    )


def test_the_gradient_is_that_of_the_log_likelihood(likelihood: ScanLikelihood) -> None:
    laser = Pose2D(0.05, -0.45, 1.0)
    beams = ScanRays.from_pieces([(scans_of([laser])[0], laser)], laser, 200)
    pose = np.array([0.06, -0.46, 1.01])
    evaluated = likelihood.derivatives(beams, pose, NO_MOUNT)
    step = max(0.5 * 0.01, 0.2 * likelihood.noise.std)
    for axis in range(3):
        nudge = step * np.eye(3)[axis]
        up, down = (likelihood.log_likelihood(beams, pose + sign * nudge, NO_MOUNT) for sign in (1, -1))
        assert evaluated.gradient[axis] == pytest.approx((up - down) / (2 * step), rel=1e-6, abs=1e-6)
    assert evaluated.log_likelihood == pytest.approx(likelihood.log_likelihood(beams, pose, NO_MOUNT))
    assert np.linalg.eigvalsh(evaluated.information).min() > 0


def test_selected_rays_are_spread_evenly_and_include_censored_ones(make_scan) -> None:  # type: ignore[no-untyped-def]
    scan = make_scan(1.0, math.nan, math.inf, -math.inf, 0.001, 2.0)
    beams = ScanRays.from_pieces([(scan, Pose2D(1, 1, 1))], Pose2D(1, 1, 1), 100)
    assert beams.rays[:, 4].tolist() == [1.0, math.inf, -math.inf, 2.0]
    assert len(ScanRays.from_pieces([(scan, Pose2D())], Pose2D(), 2).rays) == 2
    first, second = (ScanRays.from_pieces([(scan, Pose2D())], Pose2D(), 2, offset).rays[:, 4] for offset in (0, 1))
    assert first.tolist() == [1.0, -math.inf] and second.tolist() == [math.inf, 2.0]


def test_nothing_pulls_scans_away_from_the_walls_nearby() -> None:
    """Surfaces are thick in a map of noisy ranges, and walls nearby are seen at all angles."""
    room = replace(ROOM, primitives=())
    rng = np.random.default_rng(1)
    lidar = Lidar(rays=400, noise_std=0.05)
    poses = [Pose2D(x, y, rng.uniform(-3, 3)) for x in np.linspace(-0.7, 0.7, 8) for y in np.linspace(-0.7, 0.7, 8)]
    scans = [lidar.measure(room, pose, k + 1, 0.1, rng) for k, pose in enumerate(poses)]
    mapper = ForwardMapper(0.01, (-1.1, -1.1, 1.1, 1.1))
    for scan, pose in zip(scans, poses, strict=True):
        mapper.accumulate(scan, pose)
    fit = mapper.fit()
    pulls = []
    for by_incidence in (False, True):
        likelihood = ScanLikelihood.of(fit, fit.noise, by_incidence=by_incidence)
        along = squares = 0.0
        for scan, pose in zip(scans, poses, strict=True):
            true = np.array([pose.x, pose.y, pose.theta])
            beams = ScanRays.from_pieces([(scan, pose)], pose, 400)
            found, _ = maximize_pose(likelihood, beams, NO_MOUNT, true, true, np.eye(3))
            along += float((found - true)[:2] @ true[:2])
            squares += float(true[:2] @ true[:2])
        pulls.append(along / squares)
    assert pulls[0] < -0.001 and abs(pulls[1]) < 0.5 * abs(pulls[0]), pulls


@pytest.fixture(scope="module")
def driven(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("driven") / "driven.mcap"
    record_session(
        path, SessionOptions(seed=3, motion="drive", duration=25.0, rate=5.0, lidar=Lidar(rays=200, noise_std=0.03))
    )
    return path


@pytest.mark.parametrize(("source", "share"), [("odom", 1 / 3), (FUSED, 0.8)])
def test_matched_poses_are_more_accurate(driven: Path, source: str, share: float) -> None:
    with open_log(driven) as log:
        scans = ScanLog(log, Selection())
        truth = PoseProvider(log).laser_poses(scans.times, "truth").poses
        poses = PoseProvider(log).laser_poses(scans.times, source)
        matched = match_scans(poses, scans.stamps, partial(PosedScans, scans), 0.02)
    before, after = pose_rmse(poses.poses, truth), pose_rmse(matched.poses, truth)
    assert after[0] < share * before[0] and after[1] < before[1]
    assert after[0] < 0.03
    assert matched.matched and matched.covariances is not None and matched.source == source


def test_covariances_hold_where_the_first_pose_alone_is_known(tmp_path: Path) -> None:
    """The map is where all scans put it; that the first one is off in it moves all (NEES: 3 in expectation)."""
    values = []
    for seed in range(3):
        path = tmp_path / f"{seed}.mcap"
        lidar = Lidar(rays=200, noise_std=0.03)
        record_session(path, SessionOptions(seed=seed, motion="drive", duration=20.0, rate=5.0, lidar=lidar))
        with open_log(path) as log:
            scans = ScanLog(log, Selection())
            truth = PoseProvider(log).laser_poses(scans.times, "truth").poses
            odometry = PoseProvider(log).laser_poses(scans.times, "odom")
            matched = match_scans(odometry, scans.stamps, partial(PosedScans, scans), 0.02)
        assert matched.covariances is not None and matched.frame_covariance is not None
        values.append(pose_nees(matched.poses, truth, matched.covariances))
        assert matched.poses[0] == pytest.approx(truth[0], abs=1e-6)
        assert 1e-3 < math.sqrt(matched.frame_covariance[0, 0]) < 0.03
    assert 1.5 < np.median(values) < 5


def test_matching_reduces_the_noise_of_poses_that_do_not_drift(driven: Path) -> None:
    with open_log(driven) as log:
        scans = ScanLog(log, Selection())
        truth = PoseProvider(log).laser_poses(scans.times, "truth")
        rng = np.random.default_rng(1)
        noise = np.column_stack((rng.normal(0, 0.1, (len(truth.poses), 2)), rng.normal(0, 0.03, len(truth.poses))))
        noisy = replace(truth, poses=truth.poses + noise)
        source = partial(PosedScans, scans)
        matched = match_scans(noisy, scans.stamps, source, 0.02, None, SensorNoise(0.1, 0.03))
    assert pose_rmse(matched.poses, truth.poses)[0] < 0.3 * pose_rmse(noisy.poses, truth.poses)[0]


def sweeping(start: Pose2D, end: Pose2D, rays: int = 180) -> Scan:
    """A scan whose beams are measured one after the other while the laser moves evenly."""
    lidar = Lidar(rays=rays, noise_std=0.0)
    ranges = []
    for k in range(rays):
        share = k / (rays - 1)
        pose = Pose2D(
            start.x + share * (end.x - start.x),
            start.y + share * (end.y - start.y),
            start.theta + share * (end.theta - start.theta),
        )
        ranges.append(lidar.exact(ROOM, pose)[k])
    step = lidar.angle_increment
    return Scan(1, "laser", -lidar.fov / 2, step, 0.03, 5.0, np.array(ranges, np.float32), 0.1 / rays, 0.1)


def distance_to_surfaces(points: FloatArray) -> float:
    """The 90th percentile of points' distances to the room's walls and primitives (m)."""
    walls = np.min(np.abs(1 - np.abs(points)), axis=1)
    outlines = np.concatenate([primitive.outline(400) for primitive in ROOM.primitives])
    shapes = np.min(np.hypot(*(points[:, None] - outlines[None]).transpose(2, 0, 1)), axis=1)
    return float(np.percentile(np.minimum(walls, shapes), 90))


def test_deskewing_places_points_on_surfaces() -> None:
    start, end = Pose2D(-0.1, -0.5, 0.2), Pose2D(0.0, -0.45, 0.5)
    scan = sweeping(start, end)
    pieces = deskew(scan, start, end, 0.005)
    assert 1 < len(pieces) <= 64
    assert np.concatenate([piece.ranges for piece, _ in pieces]).tolist() == scan.ranges.tolist()
    assert np.concatenate([piece.directions for piece, _ in pieces]) == pytest.approx(scan.directions)
    assert [piece.stamp for piece, _ in pieces] == sorted(piece.stamp for piece, _ in pieces)
    deskewed = PosedScan(0, scan, start, pieces).points
    assert distance_to_surfaces(deskewed) < 0.006
    assert distance_to_surfaces(scan.points(start)) > 0.03


@pytest.mark.parametrize("end", [None, Pose2D(0.1, 0.2, 0.3)])
def test_scan_of_a_laser_at_rest_is_not_cut(end: Pose2D | None, make_scan) -> None:  # type: ignore[no-untyped-def]
    scan = make_scan(1.0, 2.0, 3.0)
    pose = Pose2D(0.1, 0.2, 0.3)
    assert deskew(scan, pose, end, 0.01) == [(scan, pose)]


def write_sweeps(path: Path) -> None:
    """A log of a robot that turns while its laser sweeps; poses by odometry, 100 a second."""
    from prim.log.messages import ODOMETRY_TYPE, SCAN_TYPE, encode_odometry, encode_scan
    from prim.log.writer import LogWriter

    def at(seconds: float) -> Pose2D:
        return Pose2D(0.3 * math.sin(seconds), -0.5, 1.5 * seconds)

    with LogWriter(path) as log:
        log.add_topic("/odom", ODOMETRY_TYPE)
        log.add_topic("/scan", SCAN_TYPE)
        for k in range(150):
            log.write("/odom", k * 10**7 + 10**9, encode_odometry(k * 10**7 + 10**9, at(k / 100)))
            if k % 10 == 0 and k < 130:
                scan = sweeping(at(k / 100), at(k / 100 + 0.1 * 179 / 180))
                stamp = k * 10**7 + 10**9
                log.write("/scan", stamp, encode_scan(replace(scan, stamp=stamp)))


@pytest.mark.parametrize("mapper", ["det", "prob", "forward"])
def test_replay_deskews_scans_unless_disabled(tmp_path: Path, mapper: str) -> None:
    path = tmp_path / "sweeps.mcap"
    write_sweeps(path)
    options = ReplayOptions(mapper=mapper, laser_offset=Pose2D(), detect=False)
    counts = []
    for is_deskewed in (True, False):
        result = Pipeline(path, replace(options, deskew=is_deskewed)).run()
        assert result.scans_used == 13
        counts.append(np.count_nonzero(result.grid.probability > 0.65))
        rows, cols = np.nonzero(result.grid.probability > 0.65)
        x0, y0 = result.grid.frame.origin
        points = np.column_stack((x0 + (cols + 0.5) * 0.01, y0 + (rows + 0.5) * 0.01))
        assert (distance_to_surfaces(points) < 0.02) == is_deskewed
    assert counts[0] < counts[1]


def test_end_poses_follow_corrected_poses(driven: Path) -> None:
    with open_log(driven) as log:
        scans = ScanLog(log, Selection(n_scans=20))
        times = replace(scans.times, sweeps=(10**8,))
        poses = PoseProvider(log).laser_poses(times, "odom")
        assert poses.end_poses is not None

        def posed(of: LaserPoses) -> Iterator[PosedScan]:
            for position, scan in scans:
                yield PosedScan(position, scan, of.at(position), [(scan, of.at(position))])

        matched = match_scans(poses, scans.stamps, posed, 0.02)
        assert matched.end_poses is not None
        before, after = poses.end_poses - poses.poses, matched.end_poses - matched.poses
        assert np.hypot(*after[:, :2].T) == pytest.approx(np.hypot(*before[:, :2].T), abs=1e-9)
        assert wrap_angles(after[:, 2] - before[:, 2]) == pytest.approx(0, abs=1e-9)


def test_implausible_sweep_is_not_deskewed_and_is_reported(tmp_path: Path) -> None:
    from prim.log.messages import SCAN_TYPE, encode_scan
    from prim.log.writer import LogWriter

    path = tmp_path / "odd.mcap"
    scan = replace(sweeping(Pose2D(), Pose2D()), time_increment=0.05)
    with LogWriter(path) as log:
        log.add_topic("/scan", SCAN_TYPE)
        for k in range(4):
            log.write("/scan", k * 10**8 + 10**9, encode_scan(replace(scan, stamp=k * 10**8 + 10**9)))
    result = Pipeline(path, ReplayOptions(standing_still=True, detect=False)).run()
    assert any(
        note.startswith("scans are not deskewed: by their time_increment a sweep takes 8.95 s")
        for note in result.notes
    )
