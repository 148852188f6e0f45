"""One recorded session: a world, a robot that moves in it, and everything it senses, written to a log."""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import asdict, dataclass, field
from itertools import chain
from pathlib import Path

import numpy as np

from prim import __version__
from prim.errors import UsageError
from prim.log.messages import (
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
from prim.log.writer import LogWriter
from prim.se2 import Pose2D
from prim.world import World
from recorder.motion import Step, drive, warp
from recorder.odometry import Odometry, OdometryNoise
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
    """All that makes a session: with the same options the same bytes are written.

    ``motion`` is ``warp``, over ``stops`` (cols, rows), or ``drive``, for ``duration`` seconds at up to ``speed``
    (m/s), with odometry that drifts and, if they are ``movable``, primitives that can be pushed. ``rate`` is the
    number of scans per second.
    """

    seed: int = 0
    world: WorldOptions = field(default_factory=WorldOptions)
    world_file: Path | None = None
    motion: str = "warp"
    stops: tuple[int, int] = (10, 10)
    duration: float = 60.0
    speed: float = 0.2
    movable: bool = False
    rate: float = 10.0
    lidar: Lidar = field(default_factory=Lidar)
    gps: Gps = field(default_factory=Gps)
    compass: Compass = field(default_factory=Compass)
    odometry: OdometryNoise = field(default_factory=OdometryNoise)


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
    odometry: np.random.Generator

    @classmethod
    def from_seed(cls, seed: int) -> _Streams:
        children = np.random.SeedSequence(seed).spawn(6)
        return cls(*(np.random.default_rng(child) for child in children))


def record(path: Path, options: SessionOptions) -> Session:
    """Records a session to ``path``. Raises UsageError, WorldError, OutputError."""
    streams = _Streams.from_seed(options.seed)
    world = World.load(options.world_file) if options.world_file else draw_world(streams.world, options.world)
    steps = _steps(Simulator(world, movable=options.movable), options, streams.motion)
    first = next(steps, None)
    if first is None:
        raise UsageError("the robot finds no free place: every stop lies inside a primitive or touches one")
    period = 1 / options.rate
    count = 0
    with LogWriter(path) as log:
        _begin(log, options, world)
        sensors = _Sensors(log, options, streams)
        for step in chain([first], steps):
            sensors.write(START + round(count * period * 1e9), step)
            count += 1
    skipped = options.stops[0] * options.stops[1] - count if options.motion == "warp" else 0
    return Session(path, world, count, skipped, (count - 1) * period)


def _steps(simulator: Simulator, options: SessionOptions, rng: np.random.Generator) -> Iterator[Step]:
    """The session's moments, one for each scan."""
    if options.motion == "drive":
        count = max(1, round(options.duration * options.rate))
        return drive(simulator, rng, 1 / options.rate, count, options.speed)
    return warp(simulator, rng, options.stops)


def _begin(log: LogWriter, options: SessionOptions, world: World) -> None:
    """What stands at the beginning of a log: the options, the exact world, the mounting of the laser."""
    log.add_metadata("prim", _describe(options))
    log.attach("world.json", "application/json", json.dumps(world.to_json(), indent=1).encode(), START)
    for topic, type_name in _TOPICS:
        log.add_topic(topic, type_name, latched=topic in _LATCHED)
    log.write(TF_STATIC_TOPIC, START, encode_transforms([(START, BASE_FRAME, LASER_FRAME, Pose2D())]))


class _Sensors:
    """All that is sensed and believed at one moment, and the truth of it."""

    def __init__(self, log: LogWriter, options: SessionOptions, streams: _Streams) -> None:
        self._log = log
        self._options = options
        self._streams = streams
        self._drifts = options.motion == "drive"
        self._odometry = Odometry(options.odometry, streams.odometry)
        self._world: World | None = None

    def write(self, stamp: int, step: Step) -> None:
        """Writes one moment at ``stamp`` (ns)."""
        log, options, streams, pose = self._log, self._options, self._streams, step.pose
        if step.world is not self._world:
            log.write(TRUE_PRIMITIVES_TOPIC, stamp, encode_primitives(stamp, step.world))
            self._world = step.world
        believed = self._odometry.update(pose, step.travelled) if self._drifts else pose
        log.write(GPS_TOPIC, stamp, encode_point(stamp, *options.gps.measure(pose, streams.gps)))
        log.write(COMPASS_TOPIC, stamp, encode_compass(stamp, options.compass.measure(pose, streams.compass)))
        log.write(ODOM_TOPIC, stamp, encode_odometry(stamp, believed))
        log.write(TF_TOPIC, stamp, encode_transforms([(stamp, ODOM_FRAME, BASE_FRAME, believed)]))
        log.write(TRUE_POSE_TOPIC, stamp, encode_pose(stamp, pose))
        scan = options.lidar.measure(step.world, pose, stamp, 1 / options.rate, streams.lidar)
        log.write(SCAN_TOPIC, stamp, encode_scan(scan))


_ONLY_FOR = {"warp": ("stops",), "drive": ("duration", "speed", "movable", "odometry")}
"""Options that say something for one kind of motion alone."""


def _describe(options: SessionOptions) -> dict[str, str]:
    """The recording options as metadata: SI units, JSON values."""
    described = asdict(options)
    for name in _ONLY_FOR["warp" if options.motion == "drive" else "drive"]:
        del described[name]
    if options.world_file:
        described |= {"world_file": options.world_file.name, "world": None}
    return {"version": __version__} | {name: json.dumps(value) for name, value in described.items()}
