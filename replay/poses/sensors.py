"""What a log's sensors say about the robot's motion: odometry, position fixes and headings."""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from prim.arrays import FloatArray, Stamps
from prim.errors import LogReadError
from prim.log.mcap import LogReader
from prim.log.messages import (
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
from prim.log.source import Topic
from prim.se2 import Trajectory

GPS_TYPES = (POINT_TYPE, FIX_TYPE)
COMPASS_TYPES = (VECTOR_TYPE,)
GPS_NAMES = ("gps", "gnss", "fix", "navsat")
COMPASS_NAMES = ("compass", "north")
"""Points and vectors on topics with such a word in their names are taken for a GPS's and a compass's unasked."""

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
    """What a sensor measured, by rising ``stamps`` (N,): ``values`` (N, 3), metres or the direction of north."""

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
    """What poses can be fused from; None for what a log does not have. ``notes``: what a user should know."""

    odometry: Odometry | None
    gps: Readings | None
    compass: Readings | None
    notes: tuple[str, ...] = ()

    @property
    def topics(self) -> str:
        """The topics, for people."""
        return ", ".join(reading.topic for reading in (self.odometry, self.gps, self.compass) if reading)


def read_sensors(log: LogReader, odometry: Topic | None, gps: Topic | None, compass: Topic | None) -> Sensed:
    """What is on the sensors' topics. Raises LogReadError."""
    moved = read_odometry(log, odometry) if odometry else None
    fixes = read_gps(log, gps) if gps else None
    norths = read_compass(log, compass) if compass else None
    notes = sum((reading.notes for reading in (moved, fixes, norths) if reading), ())
    return Sensed(
        moved,
        fixes if fixes and len(fixes.stamps) else None,
        norths if norths and len(norths.stamps) else None,
        notes,
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
    likely = [topic for topic in topics if not set(names).isdisjoint(re.split(r"[/_]", topic.name.lower()))]
    if len(likely) > 1:
        listed = ", ".join(topic.name for topic in likely)
        raise LogReadError(log.path, f"{len(likely)} topics to choose from: {listed}", f"choose one with {option}")
    return likely[0] if likely else None


def read_gps(log: LogReader, topic: Topic) -> Readings:
    """Position fixes (m): points as they are, satellites' as east and north of the first. Raises LogReadError."""
    satellites = topic.type == FIX_TYPE
    readings = _read(
        log, topic, decode_fix if satellites else decode_vector, lambda fix: math.isfinite(fix.x + fix.y)
    )
    if not satellites or not len(readings.stamps):
        return readings
    return replace(readings, values=flattened(readings.values))


def read_compass(log: LogReader, topic: Topic) -> Readings:
    """Vectors that point north, in the sensor's frame. Raises LogReadError."""
    return _read(log, topic, decode_vector, lambda north: 1e-9 < math.hypot(north.x, north.y, north.z) < math.inf)


def _read(
    log: LogReader, topic: Topic, decode: Callable[[bytes], StampedVector], accepts: Callable[[StampedVector], bool]
) -> Readings:
    """The usable values of a topic by rising stamp; of those with the same stamp the last."""
    values: dict[int, tuple[float, float, float]] = {}
    frame_id = ""
    unusable = 0
    for _, message in log.decoded(topic, decode):
        if accepts(message):
            values[message.stamp] = message.x, message.y, message.z
            frame_id = message.frame_id.lstrip("/")
        else:
            unusable += 1
    stamps = sorted(values)
    ordered = np.array([values[stamp] for stamp in stamps]).reshape(-1, 3)
    return Readings(topic.name, np.array(stamps, dtype=np.int64), ordered, frame_id, unusable)


def headings(readings: Readings, rotation: FloatArray) -> FloatArray:
    """The robot's headings (N,) in rad by a compass that is turned by ``rotation`` (3, 3); north is the map's +y."""
    north = readings.values @ rotation.T
    return np.arctan2(north[:, 0], north[:, 1])


def flattened(places: FloatArray) -> FloatArray:
    """Latitudes and longitudes (N, 2 or more) in degrees as metres (N, 2) east and north of the first one.

    On the plane that touches the ellipsoid there: within ten kilometres distances are right to a centimetre.
    """
    squared = FLATTENING * (2 - FLATTENING)
    latitude, longitude = np.radians(places[:, :2]).T
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
