"""Replay: one log through one mapper, shown and scored as it goes."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from mapping.grid import GridFrame, OccupancyGrid
from mapping.mapper import Mapper, make_mapper
from mapping.rays import end_extent
from mapping.truth import TruthMap
from prim.errors import LogReadError, UsageError
from prim.frames import Pose2D, Scan
from prim.log import LogReader
from prim.metrics import MapScores, pose_rmse
from prim.shapes import angle_difference
from prim.world import Bounds
from replay.localize import STILL, LaserPoses, Localizer, standing_still
from replay.scans import ScanLog, Selection, turned_over
from replay.show import NullViewer, Scene, Viewer
from replay.truth import Truth

WORLD_MARGIN = 0.1
"""Automatic bounds reach this far (m) beyond the recorded world."""

MAP_FRAMES = 50
MAP_FRAME_CELLS = 40_000_000
"""By default the map is shown about this often, and no more cells are shown in all."""

Progress = Callable[[int, int], None]


@dataclass(frozen=True)
class ReplayOptions:
    """How one log is replayed; lengths in metres, times in seconds. Raises UsageError on impossible values."""

    mapper: str = "det"
    pose: str = "auto"
    resolution: float = 0.01
    bounds: Bounds | None = None
    scan_topic: str | None = None
    odom_topic: str | None = None
    laser_offset: Pose2D | None = None
    standing_still: bool = False
    selection: Selection = field(default_factory=Selection)
    rate: float | None = None
    map_every: int | None = None
    recover: bool = False

    def __post_init__(self) -> None:
        if not (0 < self.resolution < np.inf):
            raise UsageError(f"--resolution is {self.resolution:g}: it must be above 0")
        if self.bounds is not None and not (self.bounds[0] < self.bounds[2] and self.bounds[1] < self.bounds[3]):
            raise UsageError("--bounds X0 Y0 X1 Y1: X0 must be below X1 and Y0 below Y1")
        if self.rate is not None and not (0 < self.rate < np.inf):
            raise UsageError(f"--rate is {self.rate:g}: it must be above 0")
        if self.map_every is not None and self.map_every < 1:
            raise UsageError(f"--map-every is {self.map_every}: it must be at least 1")
        if self.standing_still and self.pose != "auto":
            raise UsageError(f"--standing-still and --pose {self.pose} exclude each other")


@dataclass(frozen=True)
class ReplayResult:
    """All that a replay found out."""

    path: Path
    options: ReplayOptions
    duration: float
    scans: int
    scans_used: int
    rays: int
    lost: tuple[str, ...]
    notes: tuple[str, ...]
    messages_lost: int | None
    poses: LaserPoses
    stamps: NDArray[np.int64]
    pose_rmse: tuple[float, float] | None
    grid: OccupancyGrid
    scores: MapScores | None
    seconds: dict[str, float]


class Clock:
    """Adds up the seconds spent in each stage."""

    def __init__(self) -> None:
        self.seconds: dict[str, float] = dict.fromkeys(("read", "localize", "map", "detect", "refine", "viewer"), 0.0)
        self._start = time.perf_counter()

    @contextmanager
    def stage(self, name: str) -> Iterator[None]:
        """Counts the block's time to a stage."""
        start = time.perf_counter()
        try:
            yield
        finally:
            self.seconds[name] += time.perf_counter() - start

    def total(self) -> float:
        """Seconds since the clock was made."""
        return time.perf_counter() - self._start


class Pipeline:
    """Replays one log: survey, localize, map scan by scan, score, show."""

    def __init__(
        self,
        path: Path,
        options: ReplayOptions,
        viewer: Viewer | None = None,
        progress: Progress | None = None,
    ) -> None:
        self.path = path
        self.options = options
        self.viewer: Viewer = viewer or NullViewer()
        self._progress = progress or (lambda done, total: None)
        self._clock = Clock()

    def run(self) -> ReplayResult:
        """The whole replay. Raises LogReadError, UsageError, OutputError."""
        with LogReader(self.path, recover=self.options.recover) as log:
            with self._clock.stage("read"):
                scans = ScanLog(log, self.options.scan_topic, self.options.selection)
                truth = Truth.read(log)
            with self._clock.stage("localize"):
                poses, true_poses = self._localize(log, scans, truth)
            frame = self._frame(scans, poses, truth)
            mapper = make_mapper(self.options.mapper, self.options.resolution, frame.bounds)
            judge = Judge(frame, truth, poses, true_poses)
            world = truth.world if truth else None
            scene = Scene(log.path.name, self.options.mapper, frame.bounds, world, judge.compares_poses)
            self._begin(log, scans, poses, scene)
            rays = self._map_scans(scans, poses, mapper, judge, self._map_every(len(scans), frame))
            with self._clock.stage("map"):
                grid = mapper.finish()
            scores = judge.score(grid)
            result = self._result(log, scans, poses, rays, grid, scores, judge)
            with self._clock.stage("viewer"):
                last = len(scans) - 1
                self.viewer.show_map(last, int(scans.stamps[last]), grid, scores)
                self.viewer.finish(result)
        return result

    def _localize(self, log: LogReader, scans: ScanLog, truth: Truth | None) -> tuple[LaserPoses, LaserPoses | None]:
        """The laser's poses, and the true ones where the log has both them and a true world."""
        options = self.options
        if options.standing_still:
            return standing_still(scans.times, options.laser_offset), None
        localizer = Localizer(log, options.odom_topic, options.laser_offset)
        poses = localizer.locate(scans.times, options.pose)
        if truth is None:
            return poses, None
        try:
            return poses, poses if poses.source == "truth" else localizer.locate(scans.times, "truth")
        except LogReadError:
            return poses, None

    def _frame(self, scans: ScanLog, poses: LaserPoses, truth: Truth | None) -> GridFrame:
        """The map's frame: the bounds given, else the recorded world's and a margin, else the end points'."""
        bounds = self.options.bounds
        if bounds is None and truth is not None:
            x0, y0, x1, y1 = truth.world.bounds
            m = WORLD_MARGIN
            bounds = x0 - m, y0 - m, x1 + m, y1 + m
        if bounds is not None:
            return GridFrame.covering(bounds, self.options.resolution)
        extents = [
            end_extent(
                scan.ranges,
                scan.directions,
                (pose.x, pose.y, np.cos(pose.theta), np.sin(pose.theta)),
                (scan.range_min, scan.range_max),
                1 / self.options.resolution,
            )
            for _, scan, pose in self._posed(scans, poses)
        ]
        row, col = np.min([extent[:2] for extent in extents], axis=0).tolist()
        last_row, last_col = np.max([extent[2:] for extent in extents], axis=0).tolist()
        return GridFrame(self.options.resolution, row, col, last_row - row + 1, last_col - col + 1)

    def _posed(self, scans: ScanLog, poses: LaserPoses) -> Iterator[tuple[int, Scan, Pose2D]]:
        """The scans that have a pose: position, scan as seen from above, pose of the laser."""
        source = iter(scans)
        while True:
            with self._clock.stage("read"):
                item = next(source, None)
            if item is None:
                return
            position, scan = item
            if poses.valid[position]:
                pose = Pose2D(*poses.poses[position].tolist())
                yield position, turned_over(scan) if poses.upside_down else scan, pose

    def _map_every(self, scans: int, frame: GridFrame) -> int:
        """Every how many scans the map is shown: as asked, else so that the recording stays small."""
        shown = min(MAP_FRAMES, max(1, MAP_FRAME_CELLS // (frame.rows * frame.cols)))
        return self.options.map_every or max(1, -(-scans // shown))

    def _begin(self, log: LogReader, scans: ScanLog, poses: LaserPoses, scene: Scene) -> None:
        with self._clock.stage("viewer"):
            self.viewer.begin(scene)
            first = int(scans.stamps[0])
            self.viewer.event(0, first, f"{len(scans)} of {scans.total} scans on {scans.topic.name}")
            self.viewer.event(0, first, f"poses: {poses.source} ({poses.origin})")
            for note in self._notes(log, poses):
                self.viewer.event(0, first, note, warning=True)

    @staticmethod
    def _notes(log: LogReader, poses: LaserPoses) -> list[str]:
        """What a user should know about how the log was read."""
        notes = [f"lost: {lost}" for lost in log.lost] + list(poses.notes)
        outside = int(np.count_nonzero(~poses.valid))
        if outside:
            scans = "1 scan lies" if outside == 1 else f"{outside} scans lie"
            notes.append(f"{scans} outside the time of the poses: not used")
        return notes

    def _map_scans(self, scans: ScanLog, poses: LaserPoses, mapper: Mapper, judge: Judge, map_every: int) -> int:
        """Maps, scores and shows scan by scan; returns the number of rays."""
        rays = 0
        pace = Pace(self.options.rate)
        for position, scan, pose in self._posed(scans, poses):
            stamp = int(scans.stamps[position])
            pace.wait(stamp)
            start = time.perf_counter()
            with self._clock.stage("map"):
                mapper.update(scan, pose)
            seconds = time.perf_counter() - start
            rays += len(scan.ranges)
            judge.update(position, scan, stamp)
            with self._clock.stage("viewer"):
                self.viewer.show_scan(position, stamp, pose, scan.points(pose), seconds)
                error = judge.pose_error(position)
                if error is not None:
                    self.viewer.show_pose_error(position, stamp, *error)
            if position % map_every == 0:
                with self._clock.stage("map"):
                    grid = mapper.grid()
                scores = judge.score(grid)
                with self._clock.stage("viewer"):
                    self.viewer.show_map(position, stamp, grid, scores)
            self._progress(position + 1, len(scans))
        return rays

    def _result(
        self,
        log: LogReader,
        scans: ScanLog,
        poses: LaserPoses,
        rays: int,
        grid: OccupancyGrid,
        scores: MapScores | None,
        judge: Judge,
    ) -> ReplayResult:
        return ReplayResult(
            path=self.path,
            options=self.options,
            duration=scans.duration,
            scans=scans.total,
            scans_used=int(np.count_nonzero(poses.valid)),
            rays=rays,
            lost=tuple(log.lost),
            notes=tuple(self._notes(log, poses)),
            messages_lost=log.messages_lost,
            poses=poses,
            stamps=scans.stamps,
            pose_rmse=judge.pose_rmse(),
            grid=grid,
            scores=scores,
            seconds=self._clock.seconds | {"total": self._clock.total()},
        )


class Judge:
    """Holds the replay against the truth, where the log has one."""

    def __init__(
        self, frame: GridFrame, truth: Truth | None, poses: LaserPoses, true_poses: LaserPoses | None
    ) -> None:
        self._truth = truth
        self._poses = poses
        self._true_poses = true_poses
        self._map = TruthMap(frame)

    @property
    def compares_poses(self) -> bool:
        """Whether the poses are other than the true ones, and held against them."""
        return self._true_poses is not None and self._poses.source not in ("truth", STILL)

    def update(self, position: int, scan: Scan, stamp: int) -> None:
        """Adds what a perfect sensor would have seen."""
        true = self._true_poses
        if self._truth is not None and true is not None and true.valid[position]:
            pose = Pose2D(*true.poses[position].tolist())
            self._map.update(scan, pose, self._truth.at(stamp))

    def score(self, grid: OccupancyGrid) -> MapScores | None:
        """Scores of the map so far; None without truth."""
        return None if self._true_poses is None else self._map.score(grid.probability)

    def pose_error(self, position: int) -> tuple[float, float] | None:
        """Position (m) and heading (rad) error of one scan's pose; None where poses are not compared."""
        if self._true_poses is None or not self.compares_poses or not self._true_poses.valid[position]:
            return None
        pose, true = self._poses.poses[position], self._true_poses.poses[position]
        return float(np.hypot(*(pose - true)[:2])), abs(angle_difference(float(pose[2]), float(true[2])))

    def pose_rmse(self) -> tuple[float, float] | None:
        """Root mean square position (m) and heading (rad) errors; None where poses are not compared."""
        if self._true_poses is None or not self.compares_poses:
            return None
        both = self._poses.valid & self._true_poses.valid
        return pose_rmse(self._poses.poses[both], self._true_poses.poses[both]) if both.any() else None


class Pace:
    """Holds a replay to ``rate`` times the log's own speed; None does not hold it."""

    def __init__(self, rate: float | None) -> None:
        self._rate = rate
        self._start: tuple[float, int] | None = None

    def wait(self, stamp: int) -> None:
        """Sleeps until ``stamp`` (ns) is due."""
        if self._rate is None:
            return
        if self._start is None:
            self._start = time.perf_counter(), stamp
        began, first = self._start
        ahead = (stamp - first) / 1e9 / self._rate - (time.perf_counter() - began)
        if ahead > 0:
            time.sleep(ahead)
