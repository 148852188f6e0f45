"""A recorded session: a world, a robot that moves in it, and everything that it senses, written to a log."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import asdict, dataclass, field, fields
from itertools import chain
from pathlib import Path

import numpy as np

from prim import __version__, strict_json
from prim.errors import UsageError
from prim.files import check_no_input, check_output
from prim.interrupts import Interrupts
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
from prim.log.writer import RECORDED_LOG, LogWriter
from prim.se2 import Pose2D
from prim.world import World
from recorder.faults import NO_FAULTS, FaultGenerators
from recorder.motion import ExplorerOptions, Step, drive, warp
from recorder.odometry import Odometry, OdometryNoise
from recorder.placement import PlacementOptions
from recorder.sensors import Compass, Gps, Lidar
from recorder.simulator import Simulator, SimulatorOptions
from recorder.world import OtherGenerators, WorldOptions, draw_world

START = 1_735_689_600_000_000_000
"""The first stamp of every session (ns), 2025-01-01: a session must be the same whenever it is recorded."""

NS_PER_S = 1e9

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
    """All that makes a session: the same options write the same bytes.

    Attributes:
        seed: Seeds every random choice; each cause of chance has a generator of its own.
        world: What is drawn, unless the world is read from a file.
        world_file: A JSON file of the world, as World.to_json makes it.
        motion: «warp», teleported over ``stops``; or «drive», with odometry that drifts.
        stops: Columns and rows of the places that the robot is warped to.
        duration: How long it drives (s).
        speed: Largest rim speed of a wheel (m/s).
        movable: Whether a driving robot can push the primitives.
        rate: Scans per second.
        lidar: The LiDAR and its noise.
        gps: The position sensor's noise.
        compass: The heading sensor's noise.
        odometry: The noise of a driving robot's odometry.
        simulator: Robot and physics.
        explorer: How a driving robot explores.
        placement: How the primitives of a drawn world are placed.
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
    simulator: SimulatorOptions = field(default_factory=SimulatorOptions)
    explorer: ExplorerOptions = field(default_factory=ExplorerOptions)
    placement: PlacementOptions = field(default_factory=PlacementOptions)


@dataclass(frozen=True)
class Session:
    """A session that was recorded.

    Attributes:
        path: The log.
        world: The world at the start.
        scans: The number of scans.
        skipped: The number of stops where the robot would touch something, and was not put.
        duration: From the first scan to the last (s).
    """

    path: Path
    world: World
    scans: int
    skipped: int
    duration: float


@dataclass(frozen=True)
class _Generators:
    """A random generator for each cause of chance, so that more of one never changes another.

    New ones come last: the others then draw what they always drew.
    """

    world: np.random.Generator
    motion: np.random.Generator
    lidar: np.random.Generator
    gps: np.random.Generator
    compass: np.random.Generator
    odometry: np.random.Generator
    room: np.random.Generator
    clutter: np.random.Generator
    beam: np.random.Generator
    outliers: np.random.Generator
    dropouts: np.random.Generator

    @classmethod
    def from_seed(cls, seed: int) -> _Generators:
        children = np.random.SeedSequence(seed).spawn(len(fields(cls)))
        return cls(*(np.random.default_rng(child) for child in children))


def record_session(
    path: Path, options: SessionOptions, force: bool = False, interrupts: Interrupts | None = None
) -> Session:
    """Record a session to a log.

    Args:
        path: The log to write.
        options: What is recorded.
        force: Whether a file in its place may be replaced that is no earlier recording.
        interrupts: Holds interruptions back while a step is written; None: they come anywhere.

    Returns:
        What was recorded.

    Raises:
        UsageError: The primitives do not fit on the floor, the robot has no place to stand, there is another file in
            the log's place, or it is the world's own.
        WorldError: The world's file is no world.
        OutputError: The log cannot be written.
        InterruptedRunError: The recording was interrupted; the message names the file of the recorded part.
    """
    interrupts = interrupts or Interrupts()
    generators = _Generators.from_seed(options.seed)
    if options.world_file:
        check_no_input([options.world_file], [path])
        world = World.load(options.world_file)
    else:
        others = OtherGenerators(generators.room, generators.clutter)
        world = draw_world(generators.world, options.world, options.placement, others)
    check_output(path, RECORDED_LOG, force)
    steps = _steps(Simulator(world, options.movable, options.simulator), options, generators.motion)
    first = next(steps, None)
    if first is None:
        raise UsageError("the robot finds no free place: every stop lies inside a primitive or touches one")
    period = 1 / options.rate
    count = 0
    with interrupts.held(), LogWriter(path, force) as log:
        _write_preamble(log, options, world)
        writer = _StepWriter(log, options, generators)
        for step in chain([first], interrupts.released_while_iterating(steps)):  # what is left has a scan
            writer.write(START + round(count * period * NS_PER_S), step)
            count += 1
    skipped = options.stops[0] * options.stops[1] - count if options.motion == "warp" else 0
    return Session(path, world, count, skipped, (count - 1) * period)


def _steps(simulator: Simulator, options: SessionOptions, rng: np.random.Generator) -> Iterator[Step]:
    """Return the session's steps, one for each scan."""
    if options.motion == "drive":
        count = max(1, round(options.duration * options.rate))
        return drive(simulator, rng, 1 / options.rate, count, options.speed, options.explorer)
    return warp(simulator, rng, options.stops)


def _write_preamble(log: LogWriter, options: SessionOptions, world: World) -> None:
    """Write what precedes the first step: the options, the exact world, the topics, the mount of the laser."""
    log.add_metadata("prim", _describe(options))
    log.add_attachment("world.json", "application/json", strict_json.dumps(world.to_json(), indent=1).encode(), START)
    for topic, type_name in _TOPICS:
        log.add_topic(topic, type_name, latched=topic in _LATCHED)
    log.write(TF_STATIC_TOPIC, START, encode_transforms([(START, BASE_FRAME, LASER_FRAME, Pose2D())]))


class _StepWriter:
    """Writes what the robot senses at a step, and the truth."""

    def __init__(self, log: LogWriter, options: SessionOptions, generators: _Generators) -> None:
        self._log = log
        self._options = options
        self._generators = generators
        self._drifts = options.motion == "drive"
        self._odometry = Odometry(options.odometry, generators.odometry)
        self._world: World | None = None

    def write(self, stamp: int, step: Step) -> None:
        """Write one step at ``stamp`` (ns)."""
        log, options, generators, pose = self._log, self._options, self._generators, step.pose
        if step.world is not self._world:
            log.write(TRUE_PRIMITIVES_TOPIC, stamp, encode_primitives(stamp, step.world))
            self._world = step.world
        odometry = self._odometry.update(pose, step.travelled) if self._drifts else pose
        log.write(GPS_TOPIC, stamp, encode_point(stamp, *options.gps.measure(pose, generators.gps)))
        log.write(COMPASS_TOPIC, stamp, encode_compass(stamp, options.compass.measure(pose, generators.compass)))
        log.write(ODOM_TOPIC, stamp, encode_odometry(stamp, odometry))
        log.write(TF_TOPIC, stamp, encode_transforms([(stamp, ODOM_FRAME, BASE_FRAME, odometry)]))
        log.write(TRUE_POSE_TOPIC, stamp, encode_pose(stamp, pose))
        chances = FaultGenerators(generators.beam, generators.outliers, generators.dropouts)
        scan = options.lidar.measure(step.world, pose, stamp, 1 / options.rate, generators.lidar, chances)
        log.write(SCAN_TOPIC, stamp, encode_scan(scan))


_ONLY_FOR = {"warp": ("stops",), "drive": ("duration", "speed", "movable", "odometry")}
"""Options that matter for one kind of motion alone."""

_UNLESS_DEFAULT = ("simulator", "explorer", "placement")
"""Options that are described only where they are not the defaults."""

_NEWER_WORLD_OPTIONS = ("clutter", "room", "at_walls", "touching", "sizes")
"""Options of a drawn world that are described only where they are not the defaults."""

_SIMULATOR_KEYS = {"track_width": "axle"}
"""Metadata keys of the simulator's options where they are not the fields' names."""


def _describe(options: SessionOptions) -> dict[str, str]:
    """Return the recording options as the log's metadata: SI units, JSON values."""
    described = asdict(options)
    noise = options.odometry
    described["odometry"] = {"metres": noise.translation_std, "radians": noise.rotation_std}
    for name in _NEWER_WORLD_OPTIONS:
        if getattr(options.world, name) == getattr(WorldOptions(), name):
            del described["world"][name]
    if options.lidar.faults == NO_FAULTS:
        del described["lidar"]["faults"]
    described["simulator"] = {_SIMULATOR_KEYS.get(name, name): v for name, v in described["simulator"].items()}
    for name in _ONLY_FOR["warp" if options.motion == "drive" else "drive"]:
        del described[name]
    for name in _UNLESS_DEFAULT:
        if getattr(options, name) == getattr(SessionOptions(), name):
            del described[name]
    if options.world_file:
        described |= {"world_file": options.world_file.name, "world": None}
    return {"version": __version__} | {name: strict_json.dumps(value) for name, value in described.items()}
