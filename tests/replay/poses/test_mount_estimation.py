"""The laser's mount by the robot's motion and the scans: what is found, what the motion determines, and the note."""

import math
import re
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest
from mcap.reader import make_reader
from mcap.writer import Writer

from prim.arrays import FloatArray, Stamps
from prim.log import open_log
from prim.log.messages import TF_STATIC_TOPIC, TF_TOPIC
from prim.scan import PosedScan, Scan, deskew
from prim.se2 import Pose2D, wrap_angles
from prim.shapes import Kind, Primitive
from prim.world import World
from recorder.motion import ExplorerOptions
from recorder.odometry import OdometryNoise
from recorder.sensors import Lidar
from recorder.session import SessionOptions, record_session
from replay.localization import pose_scans
from replay.options import ReplayOptions
from replay.pipeline import Pipeline
from replay.poses.laser_poses import LaserPoses
from replay.poses.mount_estimation import DEFAULTS, MountEstimate, estimate_mount
from replay.poses.pose_provider import PoseProvider
from replay.poses.scan_registration import Surfaces, range_noise, register_pairs, surface_points
from replay.scans.scan_log import ScanLog
from replay.timing import StageTimer

ROOM = World(
    (5.0, 4.0),
    (
        Primitive(Kind.SQUARE, 1.4, 0.9, 0.3, (0.5,)),
        Primitive(Kind.CIRCLE, -1.5, -0.9, None, (0.3,)),
        Primitive(Kind.RECTANGLE, -1.2, 1.3, 0.5, (0.8, 0.3)),
    ),
    ((-2.5, -2, 2.5, -2), (2.5, -2, 2.5, 2), (2.5, 2, -2.5, 2), (-2.5, 2, -2.5, -2)),
)
OFF = Pose2D(-0.12, 0.08, math.radians(25))
POSITION, HEADING = 0.005, math.radians(0.2)


def array(pose: Pose2D) -> FloatArray:
    return np.array([pose.x, pose.y, pose.theta])


def winding(count: int = 150) -> FloatArray:
    """Curves to the left and to the right, at a speed that changes."""
    phase = np.linspace(0, 2 * np.pi, count)
    x, y = 1.0 * np.sin(phase), 0.5 * np.sin(2 * phase)
    return np.column_stack((x, y, np.unwrap(np.arctan2(np.cos(2 * phase), np.cos(phase)))))


def straight(count: int = 100) -> FloatArray:
    return np.column_stack((np.linspace(-0.8, 0.8, count), np.zeros(count), np.zeros(count)))


def spinning(count: int = 100) -> FloatArray:
    return np.column_stack((np.zeros(count), np.zeros(count), np.linspace(0, 4 * np.pi, count)))


@dataclass
class Drive:
    """A robot on given poses (N, 3) in ROOM, whose laser is mounted somewhere."""

    robot: FloatArray
    mount: Pose2D
    noise_std: float = 0.01

    def __post_init__(self) -> None:
        rng, lidar = np.random.default_rng(0), Lidar(rays=240, range_max=10, noise_std=self.noise_std)
        self.stamps: Stamps = np.arange(len(self.robot), dtype=np.int64) * 100_000_000
        true = [Pose2D(*pose) @ self.mount for pose in self.robot.tolist()]
        self.scans = [
            lidar.measure(ROOM, pose, stamp, 0.1, rng) for pose, stamp in zip(true, self.stamps.tolist(), strict=True)
        ]

    @property
    def poses(self) -> LaserPoses:
        return LaserPoses("odom", "/odom", self.robot, np.ones(len(self.robot), dtype=bool), mount_assumed=True)

    def posed(self, poses: LaserPoses) -> Iterator[PosedScan]:
        for position in np.flatnonzero(poses.valid).tolist():
            scan, pose = self.scans[position], poses.at(position)
            yield PosedScan(position, scan, pose, [(scan, pose)])

    def estimate(self) -> MountEstimate | None:
        return estimate_mount(self.poses, self.stamps, self.posed)


def errors(found: MountEstimate, mount: Pose2D) -> FloatArray:
    off = found.mount - array(mount)
    return np.array([off[0], off[1], float(wrap_angles(off[2:])[0])])


@pytest.mark.parametrize(
    "mount", [Pose2D(0.2, 0, 0), OFF, Pose2D(0.1, 0.17, -math.pi / 6), Pose2D(-0.1, 0.05, math.radians(179))]
)
def test_a_winding_path_tells_the_mount(mount: Pose2D) -> None:
    found = Drive(winding(), mount).estimate()
    assert found is not None and found.determined.all() and found.is_significant()
    assert np.abs(errors(found, mount)[:2]).max() < POSITION
    assert abs(errors(found, mount)[2]) < HEADING
    assert (np.abs(errors(found, mount)) < 3 * found.std).all()
    assert (found.std < [POSITION, POSITION, HEADING]).all()


def test_a_laser_at_the_origin_is_found_there_and_nothing_is_suggested() -> None:
    found = Drive(winding(), Pose2D()).estimate()
    assert found is not None and found.determined.all() and not found.is_significant()
    assert np.abs(found.mount).max() < POSITION


def test_a_straight_path_tells_the_heading_alone() -> None:
    found = Drive(straight(), OFF).estimate()
    assert found is not None and found.determined.tolist() == [False, False, True]
    assert abs(errors(found, OFF)[2]) < HEADING
    assert found.mount[:2].tolist() == [0, 0]
    assert "does not determine x and y: 0 is assumed); to use it: --laser-offset 0.000 0.000 25.0" in found.note()


def test_turns_on_the_spot_tell_the_distance_from_the_centre_but_no_heading() -> None:
    """With the heading taken to be 0 the position is that of the same laser on a robot that is turned itself."""
    found = Drive(spinning(), OFF).estimate()
    assert found is not None and found.determined.tolist() == [True, True, False] and found.mount[2] == 0
    turned = Pose2D(0, 0, -OFF.theta) @ Pose2D(OFF.x, OFF.y)
    assert found.mount[:2] == pytest.approx([turned.x, turned.y], abs=POSITION)


@pytest.mark.parametrize("robot", [np.zeros((50, 3)), winding(8), np.zeros((1, 3)), np.full((50, 3), 1e300)])
def test_too_little_motion_or_too_few_scans_tell_nothing(robot: FloatArray) -> None:
    drive = Drive(winding(len(robot)), OFF)
    drive.robot = robot
    assert drive.estimate() is None


def test_scans_that_show_nothing_tell_nothing() -> None:
    drive = Drive(winding(), OFF)
    drive.scans = [replace(scan, ranges=np.full_like(scan.ranges, np.inf)) for scan in drive.scans]
    assert drive.estimate() is None


@pytest.mark.parametrize("seed", [0, 6])
def test_positions_that_wander_as_a_gps_does_suggest_nothing(seed: int) -> None:
    """A heading that explains them better by chance does not make the scans agree better."""
    steps = np.random.default_rng(seed).normal(0, 0.1, (149, 2))
    drive, error = Drive(winding(), Pose2D()), np.zeros((150, 3))
    for k in range(1, 150):
        error[k, :2] = 0.97 * error[k - 1, :2] + steps[k - 1]
    drive.robot = winding() + error
    found = drive.estimate()
    assert found is not None and found.determined[2] and abs(found.mount[2]) > 5 * found.std[2]
    assert not found.is_significant()


def test_only_the_scans_that_are_paired_are_asked_for() -> None:
    """Else a long log would not fit into memory."""
    drive, asked = Drive(winding(60), OFF), []
    drive.robot = np.repeat(drive.robot, 100, axis=0)
    drive.stamps = np.arange(6000, dtype=np.int64) * 10_000_000

    def source(poses: LaserPoses) -> Iterator[PosedScan]:
        asked.append(int(np.count_nonzero(poses.valid)))
        return iter(())

    assert estimate_mount(drive.poses, drive.stamps, source) is None
    assert 0 < asked[0] <= DEFAULTS.anchors * (1 + len(DEFAULTS.separations))


def test_the_sweeps_motion_is_compensated_for_by_the_mount() -> None:
    """Beams are carried to the first one's frame by the robot's motion and the mount, which is not in the poses."""
    start, end = Pose2D(0, 0, 0.2), Pose2D(0.1, 0.05, 0.5)
    scan = Lidar(rays=240, range_max=10, noise_std=0.0).measure(ROOM, Pose2D(), 0, 0.1, np.random.default_rng(0))
    robot = PosedScan(0, scan, start, deskew(scan, start, end, 0.005))
    assert len(robot.pieces) > 10
    laser = PosedScan(0, scan, start @ OFF, [(piece, at @ OFF) for piece, at in robot.pieces])
    expected, at_origin = (Surfaces.of([posed]).in_laser_frame(np.zeros(3)) for posed in (laser, robot))
    assert Surfaces.of([robot]).in_laser_frame(array(OFF)) == pytest.approx(expected)
    assert np.abs(at_origin - expected).max() > 0.01


def test_surface_points_lie_on_walls_and_their_normals_point_at_the_laser(make_scan: Callable[..., Scan]) -> None:
    bearings = -0.5 + 0.01 * np.arange(101)
    wall = 2.0 / np.cos(bearings)
    noisy = wall + 0.02 * np.random.default_rng(0).standard_normal(101)
    noisy[50] = 1.0
    scan = make_scan(*noisy.tolist(), angle_min=-0.5, increment=0.01, range_max=10.0)
    points, beams = surface_points(scan, 0.02)
    assert range_noise([scan]) == pytest.approx(0.02, rel=0.4)
    assert len(points) > 60 and 50 not in beams
    assert points[:, 0] == pytest.approx(2.0, abs=0.04) and points[:, 0].std() < 0.015
    assert (points[:, 2] < -0.7).all() and (points[:, 2].mean() < -0.95)


def test_the_gradient_of_the_registration_points_away_from_the_true_pose() -> None:
    drive = Drive(winding(20), Pose2D(), noise_std=0.0)
    surfaces = Surfaces.of([*drive.posed(drive.poses)][:2])
    points, pairs = surfaces.in_laser_frame(np.zeros(3)), np.array([[0, 1]])
    first, second = (Pose2D(*pose) for pose in drive.robot[:2].tolist())
    true = array(first.inverse() @ second)
    for off in 0.02 * np.vstack((np.eye(3), -np.eye(3))):
        fit = register_pairs(points, surfaces.starts, pairs, (true + off)[None], 0.02, 0.2)
        step = -np.linalg.solve(fit.information[0], fit.gradients[0])
        assert step == pytest.approx(-off, abs=0.008)
        assert fit.misfit > register_pairs(points, surfaces.starts, pairs, true[None], 0.02, 0.2).misfit


def test_the_notes_wording() -> None:
    found = MountEstimate(
        np.array([-0.0321, -0.0001, 0.0]), np.array([0.001, 1e-4, 1e-4]), np.ones(3, dtype=bool), 0.1
    )
    assert found.note() == (
        "the scans agree best with the laser at x -0.032 ± 0.001 m, y 0.000 ± 0.001 m, heading 0.0 ± 0.1 degrees on "
        "the robot; to use it: --laser-offset -0.032 0.000 0.0"
    )


@dataclass(frozen=True)
class OffsetLidar(Lidar):
    """A LiDAR that is not at the robot's centre."""

    mount: Pose2D = OFF

    def exact(self, world: World, pose: Pose2D) -> FloatArray:
        return super().exact(world, pose @ self.mount)


def without_tf(path: Path) -> Path:
    """Copy a log without its transforms."""
    copy = path.with_name(f"bare_{path.name}")
    with path.open("rb") as source, copy.open("wb") as target:
        writer = Writer(target)
        writer.start(profile="ros2", library="test")
        channels: dict[str, int] = {}
        for schema, channel, message in make_reader(source).iter_messages(log_time_order=False):
            if channel.topic not in (TF_TOPIC, TF_STATIC_TOPIC) and schema is not None:
                if channel.topic not in channels:
                    kind = writer.register_schema(schema.name, schema.encoding, schema.data)
                    channels[channel.topic] = writer.register_channel(channel.topic, "cdr", kind, channel.metadata)
                writer.add_message(channels[channel.topic], message.log_time, message.data, message.publish_time)
        writer.finish()
    return copy


def recorded(folder: Path, seed: int, mount: Pose2D, **options: object) -> Path:
    path = folder / f"{seed}.mcap"
    lidar = OffsetLidar(mount=mount)
    record_session(path, SessionOptions(seed=seed, lidar=lidar, **options))  # type: ignore[arg-type]
    return path


def suggestion(path: Path, **options: object) -> str | None:
    result = Pipeline(path, ReplayOptions(mapper="det", detect=False, **options)).run()  # type: ignore[arg-type]
    suggested = [note for note in result.notes if "the scans agree best" in note]
    assert len(suggested) <= 1
    return suggested[0] if suggested else None


def offset_of(note: str) -> FloatArray:
    """The x, y (m) and heading (degrees) of the option that a note names."""
    found = re.search(r"--laser-offset (\S+) (\S+) (\S+)$", note)
    assert found is not None
    return np.array([float(value) for value in found.groups()])


def test_a_log_without_a_mount_has_a_note_whose_option_answers_it(tmp_path: Path) -> None:
    bare = without_tf(recorded(tmp_path, 1, OFF, stops=(7, 7)))
    note = suggestion(bare)
    assert note is not None
    x, y, heading = offset_of(note)
    assert math.hypot(x - OFF.x, y - OFF.y) < POSITION
    assert heading == pytest.approx(25, abs=0.3)
    laser = Pose2D(float(x), float(y), math.radians(heading))
    assert suggestion(bare, laser_offset=laser) is None
    assert suggestion(bare, laser_offset=Pose2D(0.1, 0, 0)) is None
    with open_log(bare) as log:
        scans = ScanLog(log, ReplayOptions().selection)
        provider = PoseProvider(log, laser_offset=laser)
        poses = provider.laser_poses(scans.times)
        again = estimate_mount(
            poses, scans.stamps, lambda found: pose_scans(scans, found, ReplayOptions(), StageTimer())
        )
    assert again is not None and not again.is_significant()


def test_nothing_is_suggested_where_tf_knows_the_mount_or_the_robot_stands_still(tmp_path: Path) -> None:
    path = recorded(tmp_path, 1, OFF, stops=(7, 7))
    assert suggestion(path) is None
    assert suggestion(path, pose="tf") is None
    assert suggestion(without_tf(path), standing_still=True) is None
    assert suggestion(without_tf(recorded(tmp_path, 2, Pose2D(), stops=(7, 7)))) is None


def test_fused_and_matched_poses_have_the_note_too(tmp_path: Path) -> None:
    path = recorded(tmp_path, 3, OFF, motion="drive", duration=20.0, explorer=ExplorerOptions(margin=0.18))
    bare = without_tf(path)
    for options in ({"pose": "fused"}, {"pose": "odom", "match_scans": True, "resolution": 0.05}):
        note = suggestion(bare, **options)
        assert note is not None and np.abs(offset_of(note) - [OFF.x, OFF.y, 25]).max() < 5


def test_the_mount_of_a_turtlebot(real_log: Callable[[str], Path]) -> None:
    """Its laser is at (-0.032, 0, 0), which the log does not say."""
    note = suggestion(real_log("pillars4.mcap"))
    assert note is not None
    x, y, heading = offset_of(note)
    assert math.hypot(x + 0.032, y) < 0.005
    assert abs(heading) <= 0.3


def random_mount(seed: int) -> Pose2D:
    rng = np.random.default_rng(seed)
    bearing, distance = rng.uniform(-math.pi, math.pi), 0.2 * math.sqrt(rng.uniform())
    return Pose2D(distance * math.cos(bearing), distance * math.sin(bearing), rng.uniform(-math.pi, math.pi) / 6)


@pytest.mark.slow
@pytest.mark.parametrize("motion", ["drive", "warp"])
def test_twenty_sessions_by_exact_poses(tmp_path: Path, motion: str) -> None:
    """Within 5 mm and 0.2 degrees; and no suggestion from the same sessions with the laser at the origin."""
    off, std = [], []
    for seed in range(200, 220):
        options = {"motion": motion, "rate": 5.0, "explorer": ExplorerOptions(margin=0.18)}
        mount = random_mount(seed)
        found = estimate_of(recorded(tmp_path, seed, mount, **options), "truth")
        assert found.determined.all() and found.is_significant()
        off.append(errors(found, mount))
        std.append(found.std)
        centred = estimate_of(recorded(tmp_path, 1000 + seed, Pose2D(), **options), "truth")
        assert not centred.is_significant()
    assert np.hypot(*np.array(off)[:, :2].T).max() < POSITION
    assert np.abs(off)[:, 2].max() < HEADING
    assert (np.abs(off) < 2 * np.array(std)).mean() > 0.9


@pytest.mark.slow
@pytest.mark.parametrize(("translation", "rotation"), [(0.05, 2.0), (0.01, 0.5)])
def test_standard_deviations_by_odometry_that_drifts(tmp_path: Path, translation: float, rotation: float) -> None:
    """Close to 95 % of the errors are within two standard deviations, and these are not much too large."""
    ratios = []
    for seed in range(200, 220):
        noise, explorer = OdometryNoise(translation, math.radians(rotation)), ExplorerOptions(margin=0.18)
        options = {"motion": "drive", "rate": 5.0, "odometry": noise, "explorer": explorer}
        path, mount = recorded(tmp_path, seed, random_mount(seed), **options), random_mount(seed)
        found = estimate_of(path, "odom")
        ratios.append((errors(found, mount) / found.std)[found.determined])
    every = np.concatenate(ratios)
    assert (np.abs(every) < 2).mean() > 0.88
    assert 0.5 < math.sqrt((every**2).mean()) < 1.3


def estimate_of(path: Path, source: str) -> MountEstimate:
    """Estimate from a recorded log, whose tf says that the laser is at the robot's origin."""
    with open_log(path) as log:
        scans = ScanLog(log, ReplayOptions().selection)
        poses = PoseProvider(log).laser_poses(scans.times, source)
        found = estimate_mount(
            poses, scans.stamps, lambda some: pose_scans(scans, some, ReplayOptions(), StageTimer())
        )
    assert found is not None
    return found
