"""One recorded session: a world, a robot that moves in it, and everything it senses, written to a log."""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass, field
from pathlib import Path

import numpy as np

from prim import __version__
from prim.errors import UsageError
from prim.frames import Pose2D
from prim.log import LogWriter
from prim.messages import (
    BASE_FRAME,
    COMPASS_TOPIC,
    GPS_TOPIC,
    LASER_FRAME,
    MARKERS_TYPE,
    ODOM_FRAME,
    ODOM_TOPIC,
    ODOMETRY_TYPE,
    POINT_TYPE,
    POSE_TYPE,
    SCAN_TOPIC,
    SCAN_TYPE,
    TF_STATIC_TOPIC,
    TF_TOPIC,
    TF_TYPE,
    TRUE_POSE_TOPIC,
    TRUE_PRIMITIVES_TOPIC,
    VECTOR_TYPE,
    encode_compass,
    encode_odometry,
    encode_point,
    encode_pose,
    encode_primitives,
    encode_scan,
    encode_transforms,
)
from prim.world import World
from recorder.motion import warp_poses
from recorder.sensors import Compass, Gps, Lidar
from recorder.simulator import Simulator
from recorder.world import WorldOptions, draw_world

START = 1_735_689_600_000_000_000
"""The first stamp of every session (ns): 2025-01-01, since a session must be the same whenever it is recorded."""

_TOPICS = (
    (TF_STATIC_TOPIC, TF_TYPE),
    (TRUE_PRIMITIVES_TOPIC, MARKERS_TYPE),
    (GPS_TOPIC, POINT_TYPE),
    (COMPASS_TOPIC, VECTOR_TYPE),
    (ODOM_TOPIC, ODOMETRY_TYPE),
    (TF_TOPIC, TF_TYPE),
    (TRUE_POSE_TOPIC, POSE_TYPE),
    (SCAN_TOPIC, SCAN_TYPE),
)
_LATCHED = (TF_STATIC_TOPIC, TRUE_PRIMITIVES_TOPIC)


@dataclass(frozen=True)
class SessionOptions:
    """All that makes a session: with the same options the same bytes are written."""

    seed: int = 0
    world: WorldOptions = field(default_factory=WorldOptions)
    world_file: Path | None = None
    motion: str = "warp"
    stops: tuple[int, int] = (10, 10)
    rate: float = 10.0
    lidar: Lidar = field(default_factory=Lidar)
    gps: Gps = field(default_factory=Gps)
    compass: Compass = field(default_factory=Compass)


@dataclass(frozen=True)
class Session:
    """What was recorded."""

    path: Path
    world: World
    scans: int
    skipped: int
    duration: float


@dataclass(frozen=True)
class _Streams:
    """A random generator for each cause of chance, so that more of one never changes another."""

    world: np.random.Generator
    motion: np.random.Generator
    lidar: np.random.Generator
    gps: np.random.Generator
    compass: np.random.Generator

    @classmethod
    def from_seed(cls, seed: int) -> _Streams:
        children = np.random.SeedSequence(seed).spawn(5)
        return cls(*(np.random.default_rng(child) for child in children))


def record(path: Path, options: SessionOptions) -> Session:
    """Records a session to ``path``. Raises UsageError, WorldError, OutputError."""
    streams = _Streams.from_seed(options.seed)
    world = World.load(options.world_file) if options.world_file else draw_world(streams.world, options.world)
    poses = list(warp_poses(world, Simulator(world), streams.motion, options.stops))
    if not poses:
        raise UsageError("the robot finds no free place: every stop lies inside a primitive or touches one")
    period = 1 / options.rate
    with LogWriter(path) as log:
        _begin(log, options, world)
        for index, pose in enumerate(poses):
            stamp = START + round(index * period * 1e9)
            _write_sensors(log, stamp, pose, options, streams)
            scan = options.lidar.measure(world, pose, stamp, period, streams.lidar)
            log.write(SCAN_TOPIC, stamp, encode_scan(scan))
    stops = options.stops[0] * options.stops[1]
    return Session(path, world, len(poses), stops - len(poses), (len(poses) - 1) * period)


def _begin(log: LogWriter, options: SessionOptions, world: World) -> None:
    """What stands at the beginning of a log: the options, the exact world, the mounting of the laser."""
    log.add_metadata("prim", _describe(options))
    log.attach("world.json", "application/json", json.dumps(world.to_json(), indent=1).encode(), START)
    for topic, type_name in _TOPICS:
        log.add_topic(topic, type_name, latched=topic in _LATCHED)
    log.write(TF_STATIC_TOPIC, START, encode_transforms([(START, BASE_FRAME, LASER_FRAME, Pose2D())]))
    log.write(TRUE_PRIMITIVES_TOPIC, START, encode_primitives(START, world))


def _write_sensors(log: LogWriter, stamp: int, pose: Pose2D, options: SessionOptions, streams: _Streams) -> None:
    log.write(GPS_TOPIC, stamp, encode_point(stamp, *options.gps.measure(pose, streams.gps)))
    log.write(COMPASS_TOPIC, stamp, encode_compass(stamp, options.compass.measure(pose, streams.compass)))
    log.write(ODOM_TOPIC, stamp, encode_odometry(stamp, pose))
    log.write(TF_TOPIC, stamp, encode_transforms([(stamp, ODOM_FRAME, BASE_FRAME, pose)]))
    log.write(TRUE_POSE_TOPIC, stamp, encode_pose(stamp, pose))


def _describe(options: SessionOptions) -> dict[str, str]:
    """The recording options as metadata: SI units, JSON values."""
    described = asdict(options)
    if options.world_file:
        described |= {"world_file": options.world_file.name, "world": None}
    return {"version": __version__} | {name: json.dumps(value) for name, value in described.items()}
