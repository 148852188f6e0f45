"""The options of a replay."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Final, Literal

import numpy as np

from detect.refinement.options import DEFAULTS as REFINEMENT
from detect.refinement.options import RefinementOptions
from mapping.mapper import check_cells, check_mapper, takes_noise
from prim.choices import DEFAULT_SIZES, ClockName, MapperName, PoseSourceName, SensorModelName, SweepName
from prim.errors import UsageError
from prim.se2 import Pose2D
from prim.world import Bounds
from replay.poses.fusion_options import FusionInputs, SensorNoise
from replay.poses.laser_poses import FUSED
from replay.scans.scan_log import ScanLogOptions
from replay.scans.selection import Selection

END: Final = "end"
"""The value of ``detect_every`` for one detection, after the last scan."""

MIN_RATE, MAX_RATE = 1e-3, 1e6
"""The slowest and the fastest replay, in multiples of the log's own speed; set by hand."""

MIN_POSE_NOISE, MAX_POSE_NOISE = 1e-9, 1e6
"""The smallest and the largest standard deviations of poses (m, rad) that can be given; set by hand."""

MIN_SIZE, MAX_SIZE = 1e-3, 100.0
"""The smallest and the largest object (m) that can be searched for; set by hand."""

MAX_TURN = 2 * math.pi
"""The largest turn (rad) of a laser on its robot: larger ones are degrees given as radians."""

MAX_OFFSET = 1000.0
"""The largest plausible distance (m) of a laser from its robot's origin; set by hand."""


@dataclass(frozen=True)
class ReplayOptions:
    """How a log is replayed.

    Attributes:
        mapper: The mapper: «det», «prob» or «forward»; or several, separated by commas.
        sensor_model: The inverse sensor model of «prob»: «eq4» or «gaussian».
        noise_std: The range noise (m); None to estimate it where it is needed.
        pose: The source of poses (:class:`prim.choices.PoseSourceName`).
        resolution: Side of a cell (m).
        bounds: Bounds of the map (m): x0, y0, x1, y1; None to choose them.
        scan_topic: The topics of scans that are mapped together; none: those of all scanners of one robot.
        clock: The clock that messages are stamped by (:class:`prim.choices.ClockName`).
        height_slice: The lowest and the highest z (m, in the sensor's frame) of a cloud's points that make a scan;
            None: all points of a planar scanner.
        odom_topic: The topic of poses; None: found by type. Where one is given, the source ``auto`` means ``odom``.
        laser_offset: The laser's pose on the robot (m, rad); None where tf has it.
        max_range: Ranges beyond this count as no return (m); None for the scanner's own range_max.
        max_memory: A replay that would take more memory (GB) is refused; None for half of the machine's.
        standing_still: The robot does not move: map without poses.
        fuse: What poses are fused from.
        deskew: Whether the laser's motion during a scan is compensated for.
        sweep: When the beams of a scan are measured (:class:`prim.choices.SweepName`). «start»: from the stamp on;
            «end»: until the stamp; «start-reversed» and «end-reversed»: the last beam first. «auto»: as the log says,
            unless scans clearly fit each other better otherwise.
        match_scans: Whether poses are corrected by matching scans.
        selection: Which scans are replayed.
        rate: The replay is held to this multiple of the log's speed; None for no limit.
        map_every: N to show the map after the scans at positions 0, N, 2N and so on of the selection; None to choose
            the interval.
        detect: Whether primitives are detected.
        detect_every: N to detect primitives after the first scan, after every N scans, and at the end; «end» for the
            end only; None for eight times where the replay is shown, else the end only.
        refine: Whether detections are refined with the rays.
        sizes: The smallest and the largest object that is searched for (m), by its longest side or its diameter.
        closed_world: Whether all that stands there is taken to be one of the kinds, or a wall; else what is likeliest
            none of the kinds is an object without one.
        weights: The weights of the detector; None for those that come with prim.
        recover: Whether what is left of a damaged log is read.

    Raises:
        UsageError: A value is impossible, or two exclude each other.
    """

    mapper: str = "prob"
    sensor_model: str = "eq4"
    noise_std: float | None = None
    pose: str = "auto"
    resolution: float = 0.01
    bounds: Bounds | None = None
    scan_topic: tuple[str, ...] = ()
    clock: str = ClockName.AUTO.value
    height_slice: tuple[float, float] | None = None
    odom_topic: str | None = None
    laser_offset: Pose2D | None = None
    max_range: float | None = None
    max_memory: float | None = None
    standing_still: bool = False
    fuse: FusionInputs = field(default_factory=FusionInputs)
    deskew: bool = True
    sweep: str = SweepName.AUTO.value
    match_scans: bool = False
    selection: Selection = field(default_factory=Selection)
    rate: float | None = None
    map_every: int | None = None
    detect: bool = True
    detect_every: int | Literal["end"] | None = None
    refine: bool = True
    sizes: tuple[float, float] = DEFAULT_SIZES
    closed_world: bool = False
    weights: Path | None = None
    recover: bool = False

    def __post_init__(self) -> None:
        self._check_mappers()
        check_cells(self.resolution, self.bounds)
        if self.rate is not None and not MIN_RATE <= self.rate <= MAX_RATE:
            raise UsageError(f"--rate is {self.rate:g}: it must be above 0, from {MIN_RATE:g} to {MAX_RATE:g}")
        if self.max_range is not None and not self.max_range > 0:
            raise UsageError(f"--max-range is {self.max_range:g}: it must be above 0")
        if self.max_memory is not None and not self.max_memory > 0:
            raise UsageError(f"--max-memory is {self.max_memory:g}: it must be above 0")
        if self.map_every is not None and self.map_every < 1:
            raise UsageError(f"--map-every is {self.map_every}: it must be at least 1")
        every = self.detect_every
        if every not in (None, END) and not (isinstance(every, int) and every >= 1):
            raise UsageError(f"--detect-every is {every}: it must be a number of scans, at least 1, or «{END}»")
        if not self.detect and (self.detect_every or self.weights or not self.refine):
            raise UsageError("--no-detect excludes --detect-every, --weights and --no-refine")
        self._check_sizes()
        if self.closed_world and not (self.detect and self.refine):
            raise UsageError("--closed-world is for refinement: it excludes --no-detect and --no-refine")
        if self.clock not in [*ClockName]:
            raise UsageError(f"--clock is {self.clock!r}: choose from {', '.join(ClockName)}")
        lowest, highest = self.height_slice or (0.0, 1.0)
        if not -math.inf < lowest < highest < math.inf:
            other_way = f": --slice {highest:g} {lowest:g}" if -math.inf < highest < lowest < math.inf else ""
            raise UsageError(f"--slice is {lowest:g} {highest:g}: give two heights, the lower first{other_way}")
        if self.sweep not in [*SweepName]:
            raise UsageError(f"--sweep is {self.sweep!r}: choose from {', '.join(SweepName)}")
        if not self.deskew and self.sweep != SweepName.AUTO:
            raise UsageError("--no-deskew excludes --sweep")
        self._check_poses()
        self._check_noise()

    @property
    def scan_log(self) -> ScanLogOptions:
        """How scans are read."""
        return ScanLogOptions(self.scan_topic, self.clock, self.height_slice)

    @property
    def refinement(self) -> RefinementOptions:
        """The numeric parameters of refinement."""
        evidence = replace(REFINEMENT.evidence, sizes=self.sizes)
        return replace(REFINEMENT, evidence=evidence, closed_world=self.closed_world)

    @property
    def mappers(self) -> tuple[str, ...]:
        """The names of the mappers."""
        return tuple(name.strip() for name in self.mapper.split(","))

    def by_mapper(self) -> tuple[ReplayOptions, ...]:
        """Return the options of each mapper alone: its name, and of sensor model and range noise what it takes."""
        if len(self.mappers) == 1:
            return (self,)
        return tuple(
            replace(self, mapper=name, sensor_model=model, noise_std=noise_std)
            for name, model, noise_std in self._mapper_settings()
        )

    def _mapper_settings(self) -> list[tuple[str, str, float | None]]:
        """Return each mapper's name, sensor model and range noise: those given where it takes them."""
        settings = []
        for name in self.mappers:
            model = self.sensor_model if name == MapperName.PROB else SensorModelName.EQ4.value
            settings.append((name, model, self.noise_std if takes_noise(name, model) else None))
        return settings

    def _check_mappers(self) -> None:
        settings = self._mapper_settings()
        for setting in settings:
            check_mapper(*setting)
        if len(set(self.mappers)) < len(self.mappers):
            raise UsageError(f"--mapper {self.mapper}: a mapper is named twice")
        if self.weights is not None and len(self.mappers) > 1:
            raise UsageError("--weights goes with one mapper: networks read the maps of the one they are trained on")
        _, models, noises = zip(*settings, strict=True)
        if self.sensor_model not in models:
            check_mapper(self.mappers[0], self.sensor_model)
        if self.noise_std not in noises:
            check_mapper(self.mappers[0], noise_std=self.noise_std)

    def _check_sizes(self) -> None:
        smallest, largest = self.sizes
        if not MIN_SIZE <= smallest <= largest / 2 or not largest <= MAX_SIZE:
            raise UsageError(
                f"--sizes is {smallest:g} {largest:g}: give the smallest size and the largest, at least twice as "
                f"large, from {MIN_SIZE:g} to {MAX_SIZE:g} m, such as --sizes 0.05 2"
            )
        if self.sizes != DEFAULT_SIZES and not self.detect:
            raise UsageError("--sizes is for detection: it excludes --no-detect")

    def _check_poses(self) -> None:
        if self.standing_still and (self.pose != "auto" or self.odom_topic):
            raise UsageError("--standing-still excludes --pose and --odom-topic")
        if self.standing_still and (self.match_scans or self.fuse != FusionInputs()):
            raise UsageError("--standing-still excludes --match-scans and all that says how poses are fused")
        fuses = self.pose in ("auto", FUSED)
        if not fuses and replace(self.fuse, noise=SensorNoise()) != FusionInputs():
            raise UsageError(
                f"--fuse, --gps-topic, --compass-topic and --imu-topic do not go with --pose {self.pose}"
            )
        if not fuses and not self.match_scans and self.fuse.noise != SensorNoise():
            raise UsageError("--pose-noise and --odom-noise go with --pose fused or with --match-scans")
        if self.odom_topic and self.pose not in ("auto", "odom", FUSED):
            raise UsageError(f"--odom-topic goes with --pose odom, not with --pose {self.pose}")
        if self.pose not in [*PoseSourceName]:
            raise UsageError(f"--pose is {self.pose!r}: choose from {', '.join(PoseSourceName)}")
        offset = self.laser_offset
        if offset is not None and not (np.abs((offset.x, offset.y)) < MAX_OFFSET).all():
            raise UsageError(f"--laser-offset is {offset.x:g} {offset.y:g}: it must be metres on a robot")
        if offset is not None and not abs(offset.theta) <= MAX_TURN:
            turn = f"{math.degrees(offset.theta):g} degrees"
            raise UsageError(f"--laser-offset turns by {turn}: it must be within a full turn")

    def _check_noise(self) -> None:
        noise = self.fuse.noise
        for name, metres, radians in (
            ("--pose-noise", noise.position_std, noise.heading_std),
            ("--odom-noise", noise.odometry_translation_std, noise.odometry_rotation_std),
        ):
            given = [value for value in (metres, radians) if value is not None]
            if not all(MIN_POSE_NOISE <= value <= MAX_POSE_NOISE for value in given):
                what = f"{metres or 0:g} m and {math.degrees(radians or 0):g} degrees"
                allowed = f"from {MIN_POSE_NOISE:g} to {MAX_POSE_NOISE:g} m and radians"
                raise UsageError(f"{name} is {what}: both must be above 0, {allowed}")
