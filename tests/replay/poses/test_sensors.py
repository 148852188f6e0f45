"""GPS, compass and odometry in logs that the tests write: topics, bad values, order, frames."""

import math
from pathlib import Path

import numpy as np
import pytest

from prim.errors import LogReadError
from prim.log.messages import (
    POINT_TYPE,
    POSE_TYPE,
    VECTOR_TYPE,
    _header,
    _new,
    _serialize,
    encode_compass,
    encode_point,
    encode_pose,
)
from prim.se2 import Pose2D, wrap_angles
from replay.poses.fusion_options import FusionInputs
from replay.poses.laser_poses import FUSED
from replay.poses.pose_provider import PoseProvider
from replay.poses.sensors import (
    compass_headings,
    find_compass,
    find_gps,
    find_imu,
    geodetic_to_plane,
    imu_headings,
    read_compass,
    read_gps,
    read_imu,
)
from tests.replay.poses.test_pose_provider import (
    DRIVE,
    SECOND,
    TIMES,
    Write,
    log_of,
    odometry,
    raw_transform,
    transforms,
    truth,
)

DRIVE_X = [(1.0, 0.0), (1.5, 1.0), (2.0, 2.0)]
"""Seconds and x of a robot that drives along x."""

STRAIGHT = odometry("/odom", *((t, Pose2D(x, 0, 0)) for t, x in DRIVE_X))

FIX_TYPE = "sensor_msgs/msg/NavSatFix"
IMU_TYPE = "sensor_msgs/msg/Imu"


def points(topic: str, *fixes: tuple[float, float, float], frame: str = "map") -> Write:
    def write(log) -> None:  # type: ignore[no-untyped-def]
        log.add_topic(topic, POINT_TYPE)
        for seconds, x, y in fixes:
            log.write(topic, round(seconds * SECOND), encode_point(round(seconds * SECOND), x, y, frame))

    return write


def goal(topic: str, x: float) -> Write:
    def write(log) -> None:  # type: ignore[no-untyped-def]
        log.add_topic(topic, POSE_TYPE)
        log.write(topic, SECOND, encode_pose(SECOND, Pose2D(x, 0, 0)))

    return write


def north_vectors(topic: str, *angles: tuple[float, float]) -> Write:
    def write(log) -> None:  # type: ignore[no-untyped-def]
        log.add_topic(topic, VECTOR_TYPE)
        for seconds, heading in angles:
            log.write(topic, round(seconds * SECOND), encode_compass(round(seconds * SECOND), heading))

    return write


def satellites(
    topic: str, *fixes: tuple[float, float, float], status: int = 0, variance: float = 0.0, known: int = 0
) -> Write:
    def write(log) -> None:  # type: ignore[no-untyped-def]
        log.add_topic(topic, FIX_TYPE)
        for seconds, latitude, longitude in fixes:
            stamp = round(seconds * SECOND)
            message = _new(
                FIX_TYPE,
                header=_header(stamp, "gps"),
                status=_new("sensor_msgs/msg/NavSatStatus", status=status, service=1),
                latitude=latitude,
                longitude=longitude,
                altitude=30.0,
                position_covariance=np.diag([variance, variance, 9.0]).ravel(),
                position_covariance_type=known,
            )
            log.write(topic, stamp, _serialize(message))

    return write


GPS = points("/gps", *((t, x + 5, 7) for t, x in DRIVE_X))
COMPASS = north_vectors("/compass", *((t, 0.0) for t, _ in DRIVE_X))


def test_fused_poses_agree_with_gps_and_compass(tmp_path: Path) -> None:
    with log_of(tmp_path / "a.mcap", STRAIGHT, GPS, COMPASS) as log:
        located = PoseProvider(log).laser_poses(TIMES, FUSED)
        assert located.source == FUSED and located.origin == "/odom, /gps, /compass"
        assert located.poses[:, 0] == pytest.approx([5, 6, 7], abs=0.05)
        assert located.poses[:, 1] == pytest.approx([7, 7, 7], abs=0.05)
        assert located.valid.all() and located.covariances is not None


def test_fused_poses_do_not_depend_on_order_and_duplicates(tmp_path: Path) -> None:
    with log_of(tmp_path / "a.mcap", STRAIGHT, GPS, COMPASS) as log:
        expected = PoseProvider(log).laser_poses(TIMES, FUSED)
    shuffled = points("/gps", *((t, x + 5, 7) for t, x in (DRIVE_X[2], DRIVE_X[0], DRIVE_X[1], DRIVE_X[1])))
    twice = odometry("/odom", *((t, Pose2D(x, 0, 0)) for t, x in (*DRIVE_X[::-1], DRIVE_X[0])))
    with log_of(tmp_path / "b.mcap", twice, shuffled, COMPASS) as log:
        assert PoseProvider(log).laser_poses(TIMES, FUSED).poses == pytest.approx(expected.poses)


@pytest.mark.parametrize(
    ("writers", "origin"),
    [
        ((STRAIGHT, GPS), "/odom, /gps"),
        ((STRAIGHT, COMPASS), "/odom, /compass"),
        ((GPS, COMPASS), "/gps, /compass"),
        ((STRAIGHT, GPS, COMPASS), "/odom, /gps, /compass"),
    ],
)
def test_auto_fuses_the_available_sensors(tmp_path: Path, writers: tuple[Write, ...], origin: str) -> None:
    with log_of(tmp_path / "a.mcap", *writers) as log:
        located = PoseProvider(log).laser_poses(TIMES)
        assert (located.source, located.origin) == (FUSED, origin)


def test_auto_prefers_the_ground_truth_and_a_tf_chain_to_map(tmp_path: Path) -> None:
    localized = transforms("/tf", *((t, "map", "laser", Pose2D(x, 0, 0)) for t, x in DRIVE_X))
    with log_of(tmp_path / "a.mcap", STRAIGHT, GPS, localized) as log:
        assert PoseProvider(log).laser_poses(TIMES).source == "tf"
    with log_of(tmp_path / "b.mcap", STRAIGHT, GPS, truth(*((t, Pose2D(x, 0, 0)) for t, x in DRIVE_X))) as log:
        assert PoseProvider(log).laser_poses(TIMES).source == "truth"


def test_clicked_point_is_not_taken_for_a_gps(tmp_path: Path) -> None:
    with log_of(tmp_path / "a.mcap", STRAIGHT, points("/prefix/clicked_point", (1.0, 3, 3))) as log:
        assert PoseProvider(log).laser_poses(TIMES).source == "odom"


def test_gps_topic_of_any_name_can_be_requested(tmp_path: Path) -> None:
    with log_of(tmp_path / "a.mcap", STRAIGHT, points("/beacon", *((t, x, 7) for t, x in DRIVE_X)), COMPASS) as log:
        located = PoseProvider(log, inputs=FusionInputs(gps_topic="/beacon")).laser_poses(TIMES, FUSED)
        assert located.origin == "/odom, /beacon, /compass"


def test_several_gps_topics_are_listed(tmp_path: Path) -> None:
    with log_of(tmp_path / "a.mcap", GPS, points("/gps_rear", (1.0, 0, 0))) as log:
        with pytest.raises(LogReadError, match=r"2 topics to choose from: .*choose one with --gps-topic"):
            find_gps(log)
        with pytest.raises(LogReadError, match=r"on /nothing.*topics with such messages: /gps"):
            find_gps(log, "/nothing")


def test_error_without_enough_sensors_lists_the_available_ones(tmp_path: Path) -> None:
    with log_of(tmp_path / "a.mcap", GPS) as log, pytest.raises(LogReadError, match=r"need odometry.*there is /gps"):
        PoseProvider(log).laser_poses(TIMES, FUSED)


def test_fusion_of_odometry_alone_is_reported(tmp_path: Path) -> None:
    with log_of(tmp_path / "a.mcap", DRIVE) as log:
        located = PoseProvider(log).laser_poses(TIMES, FUSED)
        assert "no GPS, no compass and no IMU: fused poses are those of /odom" in located.notes
        assert located.poses == pytest.approx(PoseProvider(log).laser_poses(TIMES, "odom").poses, abs=1e-6)


def test_sensors_on_another_clock_are_an_error(tmp_path: Path) -> None:
    late = [odometry("/odom", (900.0, Pose2D()), (901.0, Pose2D()))]
    error = pytest.raises(LogReadError, match=r"no scan .* lies within the time of .*two clocks")
    with log_of(tmp_path / "a.mcap", *late, points("/gps", (900.5, 0, 0))) as log, error:
        PoseProvider(log).laser_poses(TIMES, FUSED)


def test_values_that_are_not_finite_are_skipped_and_reported(tmp_path: Path) -> None:
    broken = points("/gps", (1.0, 0, 0), (1.5, math.nan, 0), (2.0, math.inf, 0))
    with log_of(tmp_path / "a.mcap", broken, north_vectors("/compass", (1.0, math.nan))) as log:
        topic, other = find_gps(log), find_compass(log)
        assert topic is not None and other is not None
        gps = read_gps(log, topic)
        assert len(gps.stamps) == 1
        assert gps.notes == ("/gps: 2 messages without a usable value were skipped",)
        assert len(read_compass(log, other).stamps) == 0


def test_north_is_the_y_axis_of_the_map(tmp_path: Path) -> None:
    angles = [0.0, 1.0, -3.0]
    with log_of(tmp_path / "a.mcap", north_vectors("/compass", *zip((1.0, 1.5, 2.0), angles, strict=True))) as log:
        topic = find_compass(log)
        assert topic is not None
        readings = read_compass(log, topic)
        assert compass_headings(readings, np.eye(3)) == pytest.approx(angles)
        quarter = np.array([[0, -1, 0], [1, 0, 0], [0, 0, 1]])
        expected = wrap_angles(np.array(angles) - math.pi / 2)
        assert wrap_angles(compass_headings(readings, quarter)) == pytest.approx(expected)


def test_compass_may_be_mounted_upside_down(tmp_path: Path) -> None:
    angles = [0.3, 0.8, 1.2]
    mount = raw_transform("base_link", "compass", (1.0, 0.0, 0.0, 0.0))

    def mirrored(log) -> None:  # type: ignore[no-untyped-def]
        log.add_topic("/compass", VECTOR_TYPE)
        for (seconds, _), turn in zip(DRIVE_X, angles, strict=True):
            stamp = round(seconds * SECOND)
            north = _new("geometry_msgs/msg/Vector3", x=math.sin(turn), y=-math.cos(turn), z=0.0)
            log.write(
                "/compass", stamp, _serialize(_new(VECTOR_TYPE, header=_header(stamp, "compass"), vector=north))
            )

    spin = odometry("/odom", *((t, Pose2D(0, 0, turn)) for (t, _), turn in zip(DRIVE_X, angles, strict=True)))
    with log_of(tmp_path / "a.mcap", mount, mirrored, spin) as log:
        assert PoseProvider(log).laser_poses(TIMES, FUSED).poses[:, 2] == pytest.approx(angles, abs=0.01)


def test_satellite_fixes_are_projected_to_east_and_north(tmp_path: Path) -> None:
    north = 52.0 + 10 / 111_267.0  # a degree of latitude is 111,267 m long there
    with log_of(tmp_path / "a.mcap", satellites("/fix", (1.0, 52.0, 13.0), (2.0, north, 13.0))) as log:
        topic = find_gps(log)
        assert topic is not None and topic.type == FIX_TYPE
        gps = read_gps(log, topic)
        assert gps.values == pytest.approx(np.array([[0, 0], [0, 10]]), abs=0.01)


def test_satellite_messages_without_a_fix_are_skipped(tmp_path: Path) -> None:
    with log_of(tmp_path / "a.mcap", satellites("/fix", (1.0, 52.0, 13.0), status=-1)) as log:
        topic = find_gps(log)
        assert topic is not None and len(read_gps(log, topic).stamps) == 0


def test_auto_falls_back_to_tf_and_reports_why(tmp_path: Path) -> None:
    moving = transforms("/tf", *((t, "odom", "laser", Pose2D(x, 0, 0)) for t, x in DRIVE_X))
    indoors = satellites("/fix", (1.0, 52.0, 13.0), status=-1)
    with log_of(tmp_path / "a.mcap", moving, indoors, COMPASS) as log:
        located = PoseProvider(log).laser_poses(TIMES)
        assert located.source == "tf" and any(note.startswith("nothing is fused: ") for note in located.notes)
    with log_of(tmp_path / "b.mcap", moving, GPS, goal("/goal_pose", 3.0)) as log:
        assert PoseProvider(log).laser_poses(TIMES).source == "tf"


def test_skipped_messages_are_reported_where_no_reading_remains(tmp_path: Path) -> None:
    with log_of(tmp_path / "a.mcap", STRAIGHT, points("/gps", (1.0, math.nan, 0)), COMPASS) as log:
        located = PoseProvider(log).laser_poses(TIMES, FUSED)
        assert "/gps: 1 messages without a usable value were skipped" in located.notes
        assert [sensor.name for sensor in located.sensors] == ["odom", "compass"]
        assert "m" not in located.sensors[0].std  # the noise of the odometry's position cannot be estimated


def test_projection_to_the_plane_preserves_distances() -> None:
    """A degree of longitude at 60 degrees north is 55,800 m, one of latitude 111,412 m (WGS 84)."""
    projected = geodetic_to_plane(np.array([[60, 179.999], [60, -179.999], [60.001, 179.999]]))
    assert projected[1] == pytest.approx([111.6, 0], abs=0.01)
    assert projected[2] == pytest.approx([0, 111.41], abs=0.01)


def test_lever_arm_of_the_antenna_is_read_from_tf(tmp_path: Path) -> None:
    mounted = transforms("/tf_static", (0, "base_link", "antenna", Pose2D(0.5, 0, 0)))
    with log_of(
        tmp_path / "a.mcap",
        STRAIGHT,
        COMPASS,
        points("/gps", *((t, x + 5, 7) for t, x in DRIVE_X), frame="antenna"),
        mounted,
    ) as log:
        located = PoseProvider(log).laser_poses(TIMES, FUSED)
        assert located.poses[:, 0] == pytest.approx([4.5, 5.5, 6.5], abs=0.05)


def test_log_without_sensors_has_no_gps_and_no_compass(tmp_path: Path) -> None:
    with log_of(tmp_path / "a.mcap", STRAIGHT) as log:
        assert find_gps(log) is None and find_compass(log) is None


def imu(topic: str, *orientations: tuple[float, tuple[float, float, float, float]], known: bool = True) -> Write:
    def write(log) -> None:  # type: ignore[no-untyped-def]
        log.add_topic(topic, IMU_TYPE)
        for seconds, (x, y, z, w) in orientations:
            stamp = round(seconds * SECOND)
            unknown, still = np.zeros(9), _new("geometry_msgs/msg/Vector3", x=0.0, y=0.0, z=0.0)
            message = _new(
                IMU_TYPE,
                header=_header(stamp, "imu"),
                orientation=_new("geometry_msgs/msg/Quaternion", x=x, y=y, z=z, w=w),
                orientation_covariance=unknown if known else np.append(-1.0, np.zeros(8)),
                angular_velocity=still,
                angular_velocity_covariance=unknown,
                linear_acceleration=still,
                linear_acceleration_covariance=unknown,
            )
            log.write(topic, stamp, _serialize(message))

    return write


def turned(heading: float, scale: float = 1.0) -> tuple[float, float, float, float]:
    return 0.0, 0.0, scale * math.sin(heading / 2), scale * math.cos(heading / 2)


@pytest.mark.parametrize(("variance", "known", "std"), [(2.25, 2, 1.5), (2.25, 0, math.nan), (-1.0, 2, math.nan)])
def test_stated_covariance_of_fixes_is_read_where_it_is_known(
    tmp_path: Path, variance: float, known: int, std: float
) -> None:
    fixes = satellites("/gps/fix", (1.0, 50.0, 8.0), (1.5, 50.0, 8.0), variance=variance, known=known)
    with log_of(tmp_path / "a.mcap", fixes) as log:
        topic = find_gps(log)
        assert topic is not None
        assert read_gps(log, topic).stds == pytest.approx([std, std], nan_ok=True)


def test_orientations_of_an_imu_are_read(tmp_path: Path) -> None:
    good = imu("/imu", (1.0, turned(0.5)), (1.5, turned(3.1, 1.1)), (2.0, turned(-3.1)), (2.5, (0.0, 0.0, 0.0, 0.0)))
    with log_of(tmp_path / "a.mcap", good) as log:
        topic = find_imu(log)
        assert topic is not None
        readings = read_imu(log, topic)
        assert readings.skipped == 1 and "/imu: 1 messages without a usable value" in readings.notes[0]
        assert imu_headings(readings, np.eye(3)) == pytest.approx([0.5, 3.1, 2 * math.pi - 3.1], abs=1e-9)
        # mounted with its y axis ahead: the robot's heading is a quarter turn further
        ahead = np.array([[0.0, 1, 0], [-1, 0, 0], [0, 0, 1]])
        assert imu_headings(readings, ahead)[0] == pytest.approx(0.5 + math.pi / 2)


def test_imu_is_fused_where_it_is_asked_for_and_has_orientations(tmp_path: Path) -> None:
    headings = imu("/imu", *((t, turned(2.0)) for t, _ in DRIVE_X))
    with log_of(tmp_path / "a.mcap", STRAIGHT, headings) as log:
        assert PoseProvider(log).laser_poses(TIMES).source == "odom"
        assert PoseProvider(log).laser_poses(TIMES, FUSED).origin == "/odom, /imu"
        assert PoseProvider(log).laser_poses(TIMES, FUSED).poses[:, 2] == pytest.approx([0, 0, 0], abs=1e-3)
    with log_of(tmp_path / "b.mcap", STRAIGHT, COMPASS, headings) as log:
        assert PoseProvider(log).laser_poses(TIMES, FUSED).origin == "/odom, /compass"
        asked = PoseProvider(log, inputs=FusionInputs(imu_topic="/imu")).laser_poses(TIMES, FUSED)
        assert asked.origin == "/odom, /imu"
    without = imu("/imu", *((t, turned(0.0)) for t, _ in DRIVE_X), known=False)
    with log_of(tmp_path / "c.mcap", STRAIGHT, without) as log:
        fused = PoseProvider(log).laser_poses(TIMES, FUSED)
        assert fused.origin == "/odom" and "/imu has no orientations: it is not used" in fused.notes


def test_one_of_several_imus_has_to_be_chosen_where_one_is_asked_for(tmp_path: Path) -> None:
    two = [imu(topic, *((t, turned(0.0)) for t, _ in DRIVE_X)) for topic in ("/imu/a", "/imu/b")]
    with log_of(tmp_path / "a.mcap", STRAIGHT, GPS, *two) as log:
        assert PoseProvider(log).laser_poses(TIMES).origin == "/odom, /gps"
        with pytest.raises(LogReadError) as error:
            PoseProvider(log, inputs=FusionInputs(("odom", "imu"))).laser_poses(TIMES, FUSED)
        assert (
            "2 topics to choose from: /imu/a, /imu/b" in error.value.what and "--imu-topic /imu/a" in error.value.hint
        )
