"""The motion sensors of a log: odometry, position fixes and compass headings."""

from __future__ import annotations

import math
import re
import shlex
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np

from prim.arrays import FloatArray, Stamps
from prim.errors import LogReadError
from prim.log.decoding.codecs import Content
from prim.log.decoding.values import StampedFix, StampedOrientation, StampedVector, planar_pose
from prim.log.messages import TRUE_POSE_TOPIC
from prim.log.source import LogSource, Topic
from prim.se2 import MAX_COORDINATE, Trajectory
from prim.text import listed
from replay.poses.transforms import is_valid_pose

GPS_CONTENTS = (Content.POINT, Content.FIX)
COMPASS_CONTENTS = (Content.VECTOR,)
IMU_CONTENTS = (Content.ORIENTATION,)
REST_HINT = "to map with the robot at rest give --standing-still"
SCANS_HINT = "find them by the scans alone: --pose scans"
"""What helps where there are no poses."""

POSE_CONTENTS = (Content.ODOMETRY, Content.POSE)
"""What may be the robot's poses."""

GPS_NAMES = ("gps", "gnss", "fix", "navsat")
COMPASS_NAMES = ("compass", "north")
"""Points and vectors are those of a GPS and a compass where the topic has such a word in its name."""

EQUATORIAL_RADIUS, FLATTENING = 6_378_137.0, 1 / 298.257223563
"""The Earth's radius at the equator (m) and its flattening (WGS 84)."""


@dataclass(frozen=True)
class OdometryLog:
    """The robot's poses on one topic.

    Attributes:
        topic: The topic's name.
        trajectory: The poses over time.
        base_frame: The robot's frame; empty where the messages do not name it.
        skipped: How many poses cannot be used.
    """

    topic: str
    trajectory: Trajectory
    base_frame: str
    skipped: int = 0

    @property
    def notes(self) -> tuple[str, ...]:
        """What a user should know."""
        if not self.skipped:
            return ()
        what = f"not finite, beyond {MAX_COORDINATE:g} m, or without a rotation"
        return (f"{self.topic}: {self.skipped} poses that are {what} were skipped",)


@dataclass(frozen=True)
class SensorReadings:
    """What a GPS or a compass measured.

    Attributes:
        topic: The topic's name.
        stamps: (N,) ns, strictly rising.
        values: Positions in m, (N, 3) of points and (N, 2) of satellite fixes; or vectors (N, 3) that point north; or
            the sensor's orientations (N, 4), unit quaternions x, y, z, w.
        frame_id: The sensor's frame.
        skipped: How many messages cannot be used.
        stds: Stated standard deviations (N,) of positions along each axis (m), NaN where there is none; None where
            the messages have none.
    """

    topic: str
    stamps: Stamps
    values: FloatArray
    frame_id: str
    skipped: int = 0
    stds: FloatArray | None = None

    @property
    def notes(self) -> tuple[str, ...]:
        """What a user should know."""
        return (f"{self.topic}: {self.skipped} messages without a usable value were skipped",) * bool(self.skipped)


@dataclass(frozen=True)
class SensorLogs:
    """What poses can be fused from.

    Attributes:
        odometry: The odometry, if any.
        gps: The position fixes, if any.
        compass: The north vectors, if any.
        imu: The orientations of an IMU, if any and if there is no compass.
        notes: What a user should know.
    """

    odometry: OdometryLog | None
    gps: SensorReadings | None
    compass: SensorReadings | None
    imu: SensorReadings | None = None
    notes: tuple[str, ...] = ()

    @property
    def topics(self) -> str:
        """The topics, as a list for people."""
        return ", ".join(sensor.topic for sensor in (self.odometry, self.gps, self.compass, self.imu) if sensor)


class SensorTopics(NamedTuple):
    """The topics of sensors; None for those that are not there, or not asked for.

    Attributes:
        odometry: Of odometry.
        gps: Of position fixes.
        compass: Of north vectors.
        imu: Of an IMU's orientations.
    """

    odometry: Topic | None
    gps: Topic | None
    compass: Topic | None
    imu: Topic | None


def read_sensors(log: LogSource, topics: SensorTopics) -> SensorLogs:
    """Read the sensors' topics.

    Args:
        log: The log.
        topics: The sensors' topics.

    Returns:
        The sensors that have usable readings.

    Raises:
        LogReadError: A message is damaged, or no pose of the odometry can be used.
    """
    poses = read_odometry(log, topics.odometry) if topics.odometry else None
    fixes = read_gps(log, topics.gps) if topics.gps else None
    norths = read_compass(log, topics.compass) if topics.compass else None
    turns = read_imu(log, topics.imu) if topics.imu else None
    notes = sum((sensor.notes for sensor in (poses, fixes, norths, turns) if sensor), ())
    if topics.imu and turns and not len(turns.stamps):
        notes += (f"{topics.imu.name} has no orientations: it is not used",)
    fixes, norths, turns = (one if one and len(one.stamps) else None for one in (fixes, norths, turns))
    return SensorLogs(poses, fixes, norths, turns, notes)


def find_pose_topic(log: LogSource, requested: str | None = None) -> Topic | None:
    """Find the topic of the robot's poses: the requested one, else the only Odometry, else the only other one.

    Args:
        log: The log.
        requested: The topic's name; None: found by type.

    Returns:
        The topic; None where there is none.

    Raises:
        LogReadError: The requested topic has no poses, or several topics fit.
    """
    poses = log.holding(*POSE_CONTENTS)
    topics = [topic for topic in poses if topic.name != TRUE_POSE_TOPIC or topic.name == requested]
    names = listed(f"{topic.name} ({topic.type})" for topic in topics) or "none"
    if requested is not None:
        chosen = [topic for topic in topics if topic.name == requested]
        if not chosen:
            there = log.topics.get(requested)
            what = f"no {'messages' if there and there.content in POSE_CONTENTS else 'poses'} on {requested}"
            raise LogReadError(log.path, what, f"topics with poses: {names}")
        return chosen[0]
    odometry = [topic for topic in topics if topic.content is Content.ODOMETRY] or topics
    if len(odometry) > 1:
        what = f"poses on {len(odometry)} topics: {', '.join(topic.name for topic in odometry)}"
        raise LogReadError(log.path, what, f"choose one with --odom-topic {shlex.quote(odometry[0].name)}")
    return odometry[0] if odometry else None


def find_odometry(log: LogSource, requested: str | None = None) -> Topic | None:
    """Find the topic of odometry: the requested one, else the only Odometry; a PoseStamped may be anything.

    Args:
        log: The log.
        requested: The topic's name; None: found by type.

    Returns:
        The topic; None where there is none.

    Raises:
        LogReadError: The requested topic has no poses, or several topics fit.
    """
    topic = find_pose_topic(log, requested)
    return topic if topic and (topic.content is Content.ODOMETRY or requested) else None


def read_odometry(log: LogSource, topic: Topic) -> OdometryLog:
    """Read the poses on a topic.

    Args:
        log: The log.
        topic: A topic of poses of any type.

    Returns:
        The poses by rising stamp.

    Raises:
        LogReadError: A message is damaged, or no pose can be used.
    """
    stamps: list[int] = []
    poses: list[tuple[float, float, float]] = []
    base_frame = ""
    skipped = 0
    for _, messages in log.decoded(topic):
        for message in messages:
            if is_valid_pose(message):
                pose = planar_pose(message)
                stamps.append(message.stamp)
                poses.append((pose.x, pose.y, pose.theta))
                base_frame = message.child_frame_id.lstrip("/")
            else:
                skipped += 1
    if not stamps:
        raise LogReadError(log.path, f"{topic.name} has no usable pose", REST_HINT)
    return OdometryLog(topic.name, Trajectory.from_unsorted(stamps, poses), base_frame, skipped)


def find_gps(log: LogSource, requested: str | None = None) -> Topic | None:
    """Find the topic of position fixes.

    Args:
        log: The log.
        requested: The topic's name; None: found by type and name.

    Returns:
        The topic; None where there is none.

    Raises:
        LogReadError: The requested topic is missing, or several topics fit.
    """
    return _find(log, GPS_CONTENTS, GPS_NAMES, requested, "--gps-topic")


def find_compass(log: LogSource, requested: str | None = None) -> Topic | None:
    """Find the topic of north vectors.

    Args:
        log: The log.
        requested: The topic's name; None: found by type and name.

    Returns:
        The topic; None where there is none.

    Raises:
        LogReadError: The requested topic is missing, or several topics fit.
    """
    return _find(log, COMPASS_CONTENTS, COMPASS_NAMES, requested, "--compass-topic")


def find_imu(log: LogSource, requested: str | None = None) -> Topic | None:
    """Find the topic of an IMU's orientations.

    Args:
        log: The log.
        requested: The topic's name; None: found by type.

    Returns:
        The topic; None where there is none.

    Raises:
        LogReadError: The requested topic is missing, or several topics fit.
    """
    return _find(log, IMU_CONTENTS, None, requested, "--imu-topic")


def _find(
    log: LogSource, contents: Sequence[Content], names: Iterable[str] | None, requested: str | None, option: str
) -> Topic | None:
    topics = log.holding(*contents)
    if requested is not None:
        chosen = [topic for topic in topics if topic.name == requested]
        if not chosen:
            there = listed(f"{topic.name} ({topic.type})" for topic in topics) or "none"
            raise LogReadError(
                log.path, f"no {' or '.join(contents)} on {requested}", f"topics with such messages: {there}"
            )
        return chosen[0]
    likely = topics
    if names is not None:
        likely = [topic for topic in topics if not set(names).isdisjoint(re.split(r"[/_]", topic.name.lower()))]
    if len(likely) > 1:
        raise LogReadError(
            log.path,
            f"{len(likely)} topics to choose from: {listed(topic.name for topic in likely)}",
            f"choose one with {option} {shlex.quote(likely[0].name)}",
        )
    return likely[0] if likely else None


def read_gps(log: LogSource, topic: Topic) -> SensorReadings:
    """Read position fixes.

    Args:
        log: The log.
        topic: A topic of points, which are read as they are, or of satellite fixes.

    Returns:
        Positions in m: of points (N, 3); of satellite fixes (N, 2), east and north of the first one.

    Raises:
        LogReadError: A message is damaged.
    """
    if topic.content is not Content.FIX:
        return _read(log, topic, _position, 3)
    readings = _read(log, topic, _coordinates, 4)
    if not len(readings.stamps):
        return readings
    stds = np.sqrt(readings.values[:, 3])
    return replace(readings, values=geodetic_to_plane(readings.values), stds=stds)


def _position(fix: StampedVector) -> tuple[float, ...] | None:
    """Return a position (3,) within MAX_COORDINATE; None for others."""
    return (fix.x, fix.y, fix.z) if abs(fix.x) <= MAX_COORDINATE and abs(fix.y) <= MAX_COORDINATE else None


def _coordinates(fix: StampedFix) -> tuple[float, ...] | None:
    """Return latitude and longitude (degrees) that can be, altitude and variance; None for others."""
    return (fix.x, fix.y, fix.z, fix.variance) if abs(fix.x) <= 90 and abs(fix.y) <= 360 else None


def read_compass(log: LogSource, topic: Topic) -> SensorReadings:
    """Read the vectors of a compass.

    Args:
        log: The log.
        topic: A topic of vectors.

    Returns:
        Vectors that point north, in the sensor's frame.

    Raises:
        LogReadError: A message is damaged.
    """

    def direction(north: StampedVector) -> tuple[float, ...] | None:
        return (north.x, north.y, north.z) if 1e-9 < math.hypot(north.x, north.y, north.z) < 1e100 else None

    return _read(log, topic, direction, 3)


def read_imu(log: LogSource, topic: Topic) -> SensorReadings:
    """Read the orientations of an IMU.

    Args:
        log: The log.
        topic: A topic of orientations.

    Returns:
        Unit quaternions; messages without an orientation are left out, and do not count as skipped.

    Raises:
        LogReadError: A message is damaged.
    """
    return _read(log, topic, _unit_quaternion, 4, lambda message: message.rotation is not None)


def _unit_quaternion(message: StampedOrientation) -> tuple[float, ...] | None:
    """Return a rotation of unit norm; None for what is no rotation."""
    rotation = message.rotation or (0.0,) * 4
    norm = math.hypot(*rotation)
    return tuple(value / norm for value in rotation) if 0.5 < norm < 2 else None


def _read(
    log: LogSource,
    topic: Topic,
    values_of: Callable[[Any], tuple[float, ...] | None],
    columns: int,
    is_there: Callable[[Any], bool] = lambda _: True,
) -> SensorReadings:
    """Read the usable values of a topic by rising stamp; of those with the same stamp the last remains."""
    values: dict[int, tuple[float, ...]] = {}
    frame_id = ""
    skipped = 0
    for _, message in log.decoded(topic):
        if not is_there(message):
            continue
        row = values_of(message)
        if row is not None:
            values[message.stamp] = row
            frame_id = message.frame_id.lstrip("/")
        else:
            skipped += 1
    stamps = sorted(values)
    ordered = np.array([values[stamp] for stamp in stamps]).reshape(-1, columns)
    return SensorReadings(topic.name, np.array(stamps, dtype=np.int64), ordered, frame_id, skipped)


def imu_headings(readings: SensorReadings, rotation: FloatArray) -> FloatArray:
    """Compute the robot's headings from the orientations of an IMU; where 0 is may be anywhere.

    Args:
        readings: N unit quaternions.
        rotation: The IMU's rotation on the robot (3, 3).

    Returns:
        Headings (N,) in rad, without jumps of a turn.
    """
    x, y, z, w = readings.values.T
    # the robot's x axis in the frame of the IMU, turned by its orientation
    ax, ay, az = rotation[0]
    east = (1 - 2 * (y * y + z * z)) * ax + 2 * (x * y - w * z) * ay + 2 * (x * z + w * y) * az
    north = 2 * (x * y + w * z) * ax + (1 - 2 * (x * x + z * z)) * ay + 2 * (y * z - w * x) * az
    return np.unwrap(np.arctan2(north, east))


def compass_headings(readings: SensorReadings, rotation: FloatArray) -> FloatArray:
    """Compute the robot's headings from a compass; north is the map's +y.

    Args:
        readings: N vectors that point north.
        rotation: The compass's rotation on the robot (3, 3).

    Returns:
        Headings (N,) in rad.
    """
    north = readings.values @ rotation.T
    return np.arctan2(north[:, 0], north[:, 1])


def geodetic_to_plane(coordinates: FloatArray) -> FloatArray:
    """Project latitudes and longitudes (N, 2 or more) in degrees to metres (N, 2) east and north of the first one.

    The plane touches the ellipsoid there: within ten kilometres distances are right to a centimetre.
    """
    squared_eccentricity = FLATTENING * (2 - FLATTENING)
    latitude, longitude = np.radians(coordinates[:, :2]).T
    normal_radius = EQUATORIAL_RADIUS / np.sqrt(1 - squared_eccentricity * np.sin(latitude) ** 2)
    geocentric = np.column_stack(
        (
            normal_radius * np.cos(latitude) * np.cos(longitude),
            normal_radius * np.cos(latitude) * np.sin(longitude),
            normal_radius * (1 - squared_eccentricity) * np.sin(latitude),
        )
    )
    sin_lat, cos_lat = np.sin(latitude[0]), np.cos(latitude[0])
    sin_lon, cos_lon = np.sin(longitude[0]), np.cos(longitude[0])
    # rows: the unit vectors that point east and north at the first point
    plane = np.array([[-sin_lon, cos_lon, 0.0], [-sin_lat * cos_lon, -sin_lat * sin_lon, cos_lat]])
    projected: FloatArray = (geocentric - geocentric[0]) @ plane.T
    return projected
