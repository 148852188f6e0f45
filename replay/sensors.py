"""What a log's sensors say about the robot's motion: odometry, position fixes and headings."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np

from prim.errors import LogReadError
from prim.frames import Pose2D, Stamps, Trajectory
from prim.log import LogReader, Topic
from prim.messages import (
    FIX_TYPE,
    POINT_TYPE,
    VECTOR_TYPE,
    StampedPose,
    StampedVector,
    decode_fix,
    decode_poses,
    decode_vector,
    planar,
)
from prim.raycast import FloatArray

GPS_TYPES = (POINT_TYPE, FIX_TYPE)
COMPASS_TYPES = (VECTOR_TYPE,)
GPS_NAMES = ("gps", "gnss", "fix", "navsat")
COMPASS_NAMES = ("compass", "heading", "north")
"""Points and vectors on topics with such names are taken for a GPS's and a compass's without being asked."""

EQUATOR, FLATTENING = 6_378_137.0, 1 / 298.257223563
"""The Earth's radius at the equator (m) and its flattening (WGS 84)."""


@dataclass(frozen=True)
class Odometry:
    """The robot's poses on a topic: ``base`` is its frame, empty where the messages do not say."""

    topic: str
    trajectory: Trajectory
    base: str
    unusable: int = 0

    @property
    def notes(self) -> tuple[str, ...]:
        """What a user should know."""
        if not self.unusable:
            return ()
        return (f"{self.topic}: {self.unusable} poses that are not finite or have no rotation were skipped",)


@dataclass(frozen=True)
class Readings:
    """What a sensor measured, by rising ``stamps`` (N,): ``values`` (N, 2), metres or the direction of north."""

    topic: str
    stamps: Stamps
    values: FloatArray
    frame_id: str
    unusable: int = 0

    @property
    def notes(self) -> tuple[str, ...]:
        """What a user should know."""
        return (f"{self.topic}: {self.unusable} messages without a usable value were skipped",) * bool(self.unusable)


@dataclass(frozen=True)
class Sensed:
    """What poses can be fused from; None for what a log does not have."""

    odometry: Odometry | None
    gps: Readings | None
    compass: Readings | None

    @property
    def topics(self) -> str:
        """The topics, for people."""
        return ", ".join(reading.topic for reading in (self.odometry, self.gps, self.compass) if reading)

    @property
    def notes(self) -> tuple[str, ...]:
        """What a user should know."""
        return sum((reading.notes for reading in (self.odometry, self.gps, self.compass) if reading), ())


def read_sensors(log: LogReader, odometry: Topic | None, gps: Topic | None, compass: Topic | None) -> Sensed:
    """What is on the sensors' topics. Raises LogReadError."""
    return Sensed(
        read_odometry(log, odometry) if odometry else None,
        read_gps(log, gps) if gps else None,
        read_compass(log, compass) if compass else None,
    )


def is_usable(pose: StampedPose) -> bool:
    """Whether a pose is finite and has a rotation."""
    return bool(np.isfinite((*pose.translation, *pose.rotation)).all() and np.linalg.norm(pose.rotation) > 1e-3)


def read_odometry(log: LogReader, topic: Topic) -> Odometry:
    """The poses on a topic, sorted by stamp. Raises LogReadError where none can be used."""
    stamps: list[int] = []
    poses: list[tuple[float, float, float]] = []
    base = ""
    unusable = 0
    for _, messages in log.decoded(topic, partial(decode_poses, topic.type)):
        for message in messages:
            if is_usable(message):
                pose = planar(message)
                stamps.append(message.stamp)
                poses.append((pose.x, pose.y, pose.theta))
                base = message.child_frame_id.lstrip("/")
            else:
                unusable += 1
    if not stamps:
        raise LogReadError(log.path, f"{topic.name} has no usable pose", "give another --pose")
    return Odometry(topic.name, Trajectory.from_unsorted(stamps, poses), base, unusable)


def find_gps(log: LogReader, wanted: str | None = None) -> Topic | None:
    """The topic of position fixes: the one asked for, or the one whose type and name say so.

    Raises LogReadError where the one asked for is not there, or there are several.
    """
    return _find(log, GPS_TYPES, GPS_NAMES, wanted, "--gps-topic")


def find_compass(log: LogReader, wanted: str | None = None) -> Topic | None:
    """The topic of north vectors, as :func:`find_gps`."""
    return _find(log, COMPASS_TYPES, COMPASS_NAMES, wanted, "--compass-topic")


def _find(
    log: LogReader, types: Sequence[str], names: Iterable[str], wanted: str | None, option: str
) -> Topic | None:
    topics = log.of_type(*types)
    if wanted is not None:
        chosen = [topic for topic in topics if topic.name == wanted]
        if not chosen:
            there = ", ".join(f"{topic.name} ({topic.type})" for topic in topics) or "none"
            raise LogReadError(log.path, f"no {' or '.join(types)} on {wanted}", f"topics of that type: {there}")
        return chosen[0]
    likely = [topic for topic in topics if any(name in topic.name.lower() for name in names)]
    if len(likely) > 1:
        listed = ", ".join(topic.name for topic in likely)
        raise LogReadError(log.path, f"{len(likely)} topics to choose from: {listed}", f"choose one with {option}")
    return likely[0] if likely else None


def read_gps(log: LogReader, topic: Topic) -> Readings | None:
    """Position fixes (m): points as they are, satellite fixes east and north of the first one; None if there is none.

    Raises LogReadError.
    """
    satellites = topic.type == FIX_TYPE
    readings = _read(log, topic, decode_fix if satellites else decode_vector, lambda x, y: math.isfinite(x + y))
    if readings is None or not satellites:
        return readings
    return Readings(topic.name, readings.stamps, flattened(readings.values), readings.frame_id, readings.unusable)


def read_compass(log: LogReader, topic: Topic) -> Readings | None:
    """Vectors that point north (x, y in the sensor's frame); None where there is none. Raises LogReadError."""
    return _read(log, topic, decode_vector, lambda x, y: 1e-9 < math.hypot(x, y) < math.inf)


def _read(
    log: LogReader, topic: Topic, decode: Callable[[bytes], StampedVector], accepts: Callable[[float, float], bool]
) -> Readings | None:
    """The usable values of a topic by rising stamp; of those with the same stamp the last."""
    values: dict[int, tuple[float, float]] = {}
    frame_id = ""
    unusable = 0
    for _, message in log.decoded(topic, decode):
        if accepts(message.x, message.y):
            values[message.stamp] = message.x, message.y
            frame_id = message.frame_id.lstrip("/")
        else:
            unusable += 1
    if not values:
        return None
    stamps = sorted(values)
    at = np.array(stamps, dtype=np.int64)
    return Readings(topic.name, at, np.array([values[stamp] for stamp in stamps]), frame_id, unusable)


def headings(readings: Readings, mount: Pose2D) -> FloatArray:
    """The robot's headings (N,) in rad by a compass that is mounted at ``mount``; north is the map's +y."""
    return np.arctan2(readings.values[:, 0], readings.values[:, 1]) - mount.theta


def flattened(places: FloatArray) -> FloatArray:
    """Latitudes and longitudes (N, 2) in degrees as metres (N, 2) east and north of the first one.

    On the plane that touches the ellipsoid there: within ten kilometres distances are right to a centimetre.
    """
    squared = FLATTENING * (2 - FLATTENING)
    latitude, longitude = np.radians(places).T
    across = EQUATOR / np.sqrt(1 - squared * np.sin(latitude) ** 2)
    globe = np.column_stack(
        (
            across * np.cos(latitude) * np.cos(longitude),
            across * np.cos(latitude) * np.sin(longitude),
            across * (1 - squared) * np.sin(latitude),
        )
    )
    sin, cos, east, ahead = np.sin(latitude[0]), np.cos(latitude[0]), np.sin(longitude[0]), np.cos(longitude[0])
    plane = np.array([[-east, ahead, 0.0], [-sin * ahead, -sin * east, cos]])
    flat: FloatArray = (globe - globe[0]) @ plane.T
    return flat
