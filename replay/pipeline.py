"""Replay: one log through one mapper, shown and scored as it goes."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np

from detect.networks.weights import shipped_weights
from mapping.forward.mapper import find_noise
from mapping.grid import GridFrame, OccupancyGrid
from mapping.kernels import end_extent
from mapping.map_metrics import MapScores
from mapping.mapper import Mapper, make_mapper
from prim.arrays import FloatArray
from prim.errors import LogReadError, UsageError, WorldError
from prim.log.mcap import LogReader
from prim.scan import PosedScan, Scan, pieces_of, turned_over
from prim.se2 import Pose2D
from prim.world import World
from replay.detection import Lookout, Sighting
from replay.evaluation import Judge
from replay.ground_truth import Truth
from replay.options import ReplayOptions
from replay.posed_scans import ScanLog, counted
from replay.poses.fusion import PoseNoise
from replay.poses.localize import FUSED, FuseOptions, LaserPoses, Localizer
from replay.result import ReplayResult
from replay.viewer_protocol import NullViewer, Scene, Viewer

WORLD_MARGIN = 0.1
"""Automatic bounds reach this far (m) beyond the recorded world."""


MAX_WAIT = 10.0
"""A replay at a rate waits no longer (s) for the next scan, however long the log paused."""

MAP_FRAMES = 50
MAP_FRAME_CELLS = 40_000_000
"""By default the map is shown about this often, and no more cells are shown in all."""

NOISE_SCANS = 200
"""The noise is found from about so many scans, evenly spread over the log, where only the noise is wanted."""

Progress = Callable[[int, int], None]


@dataclass
class Used:
    """How much of a log went into the map."""

    scans: int = 0
    rays: int = 0
    hits: int = 0

    def count(self, scan: Scan) -> None:
        """Adds a scan."""
        self.scans += 1
        self.rays += len(scan.ranges)
        self.hits += int(np.count_nonzero(scan.hits))


class Clock:
    """Adds up the seconds spent in each stage; what is spent in a stage within another counts to the inner one."""

    def __init__(self) -> None:
        self.seconds: dict[str, float] = dict.fromkeys(("read", "localize", "map", "detect", "refine", "viewer"), 0.0)
        self._start = time.perf_counter()
        self._within: list[float] = []

    @contextmanager
    def stage(self, name: str) -> Iterator[None]:
        """Counts the block's time to a stage."""
        start = time.perf_counter()
        self._within.append(0.0)
        try:
            yield
        finally:
            spent = time.perf_counter() - start
            self.seconds[name] += spent - self._within.pop()
            if self._within:
                self._within[-1] += spent

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
        self._notes: list[str] = []
        self._blind: str | None = None

    def run(self) -> ReplayResult:
        """The whole replay. Raises LogReadError, UsageError, OutputError."""
        try:
            return self._run()
        except BaseException:
            self.viewer.abandon()
            raise

    def _run(self) -> ReplayResult:
        with LogReader(self.path, recover=self.options.recover) as log:
            with self._clock.stage("read"):
                scans = ScanLog(log, self.options.scan_topic, self.options.selection)
                truth = self._read_truth(log)
            with self._clock.stage("localize"):
                poses, true_poses = self._localize(log, scans)
                if self.options.match_scans:
                    poses = self._matched(scans, poses)
            frame = self._frame(scans, poses, truth)
            judge = Judge(frame, truth, poses, true_poses)
            lookout = self._lookout(frame, truth if judge.scores_maps else None, poses.frame_covariance)
            mapper = self._mapper(scans, poses, frame)
            scene = Scene(
                log.path.name,
                self.options.mapper,
                frame.bounds,
                judge.scores_maps,
                judge.compares_poses,
                has_evidence=self.options.mapper == "forward",
                has_detections=lookout is not None,
                has_errors=lookout is not None and judge.scores_maps,
            )
            self._begin(log, scans, poses, scene)
            used = self._map_scans(scans, poses, mapper, judge, truth, lookout, self._map_every(len(scans), frame))
            with self._clock.stage("map"):
                grid = mapper.finish()
            scores = judge.score(grid)
            last = len(scans) - 1
            stamp = int(scans.stamps[last])
            sighting = None
            if lookout is not None:
                with self._clock.stage("detect"):
                    seen = lookout.last_map(grid)
                posed = (piece for posed in self._posed(scans, poses) for piece in posed.pieces)
                sighting = self._sighting(lookout, seen, stamp, posed)
            self._note_what_was_used(scans, poses, used, grid)
            result = self._result(log, scans, poses, used, grid, mapper.noise_std, scores, sighting, judge)
            with self._clock.stage("viewer"):
                if sighting is not None:
                    self.viewer.show_sighting(last, stamp, sighting)
                for note in result.notes:
                    self.viewer.event(last, stamp, note, warning=True)
                self.viewer.show_map(last, stamp, grid, scores)
                self.viewer.finish(result)
        return result

    def _read_truth(self, log: LogReader) -> Truth | None:
        """The log's true world; a note where it has one that cannot be understood."""
        try:
            return Truth.read(log)
        except WorldError as error:
            self._notes.append(f"the map is not scored: {error}")
            return None

    def _localize(self, log: LogReader, scans: ScanLog) -> tuple[LaserPoses, LaserPoses | None]:
        """The laser's poses, and the true ones where the log has them."""
        options = self.options
        localizer = Localizer(log, options.odom_topic, options.laser_offset, options.fuse)
        times = scans.times if options.deskew else replace(scans.times, sweep=0)
        if options.standing_still:
            return localizer.stand_still(times), None
        poses = localizer.locate(times, options.pose)
        told = replace(options.fuse, noise=PoseNoise()) if options.match_scans else options.fuse
        if told != FuseOptions() and poses.source != FUSED:
            self._notes.append(f"nothing is fused, since there are poses on {poses.origin}: give --pose fused")
        if poses.source == "truth":
            return poses, poses
        if not localizer.has_truth:
            return poses, None
        try:
            return poses, localizer.locate(times, "truth")
        except LogReadError as error:
            self._notes.append(f"the poses are not held against the truth: {error.what}")
            return poses, None

    def _matched(self, scans: ScanLog, poses: LaserPoses) -> LaserPoses:
        """The poses corrected by a map that is made of the scans."""
        from replay.poses.scan_matching import match  # when it is needed: a replay without it starts faster

        options = self.options
        posed = partial(self._posed, scans)
        return match(
            poses, scans.stamps, posed, options.resolution, options.noise_std, options.fuse.noise, options.bounds
        )

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
            for posed in self._posed(scans, poses)
            for scan, pose in posed.pieces
        ]
        if not extents:
            raise LogReadError(self.path, "no scan that can be used has a pose", "give another --pose")
        row, col = np.min([extent[:2] for extent in extents], axis=0).tolist()
        last_row, last_col = np.max([extent[2:] for extent in extents], axis=0).tolist()
        return GridFrame(self.options.resolution, row, col, last_row - row + 1, last_col - col + 1)

    def _mapper(self, scans: ScanLog, poses: LaserPoses, frame: GridFrame) -> Mapper:
        """The mapper; where it needs the noise and nobody gave it, the forward model finds it first."""
        options = self.options
        noise_std = options.noise_std
        if options.sensor_model == "gaussian" and noise_std is None:
            every = -(-len(scans) // NOISE_SCANS)
            chosen = (posed for posed in self._posed(scans, poses) if posed.position % every == 0)
            some = [piece for posed in chosen for piece in posed.pieces]
            with self._clock.stage("map"):
                noise_std = find_noise(some, frame)
            if noise_std is None:
                raise LogReadError(
                    self.path,
                    "too few ranges to find the noise for the Gaussian sensor model",
                    "give it: --noise-std",
                )
        return make_mapper(options.mapper, options.resolution, frame.bounds, options.sensor_model, noise_std)

    def _lookout(self, frame: GridFrame, truth: Truth | None, spread: FloatArray | None) -> Lookout | None:
        """What looks for primitives; None, and the reason kept, where it cannot and nobody asked for it by name."""
        options = self.options
        if not options.detect:
            return None
        asked = options.weights is not None or options.detect_every is not None
        weights = options.weights or shipped_weights(options.mapper)
        try:
            if weights is None:
                raise UsageError(f"no weights for maps of {options.mapper} come with prim: give --weights")
            return self._loaded(weights, frame, truth, spread)
        except UsageError as error:
            if asked:
                raise
            self._blind = str(error)
            return None

    def _loaded(self, weights: Path, frame: GridFrame, truth: Truth | None, spread: FloatArray | None) -> Lookout:
        """The detector, with a map of its own where it reads other maps than the one that is made."""
        from detect.detector import Detector  # when it is needed: a replay without detection starts faster

        options = self.options
        with self._clock.stage("detect"):
            detector = Detector.load(weights, options.mapper)
        tracker = None
        if options.detect_every is not None:
            from detect.tracker import Tracker

            tracker = Tracker()
        cell = detector.card.resolution
        if np.isclose(options.resolution, cell, rtol=1e-6) and options.sensor_model == "eq4":
            return Lookout(detector, None, truth, tracker, options.refine, options.noise_std, spread)
        noise_std = options.noise_std if options.mapper == "forward" else None
        own = make_mapper(options.mapper, cell, GridFrame.covering(frame.bounds, cell).bounds, "eq4", noise_std)
        return Lookout(detector, own, truth, tracker, options.refine, options.noise_std, spread)

    def _posed(self, scans: ScanLog, poses: LaserPoses) -> Iterator[PosedScan]:
        """The scans that have a pose, as seen from above."""
        source = iter(scans)
        while True:
            with self._clock.stage("read"):
                item = next(source, None)
            if item is None:
                return
            position, scan = item
            if poses.valid[position]:
                seen = self._prepared(scan, poses.upside_down)
                pose, end = poses.at(position), poses.end(position)
                yield PosedScan(position, seen, pose, pieces_of(seen, pose, end, self.options.resolution / 2))

    def _prepared(self, scan: Scan, upside_down: bool) -> Scan:
        """The scan as seen from above, and no further than the largest range in use."""
        if self.options.max_range is not None and scan.range_max > self.options.max_range:
            scan = replace(scan, range_max=self.options.max_range)
        return turned_over(scan) if upside_down else scan

    def _map_every(self, scans: int, frame: GridFrame) -> int | None:
        """Every how many scans the map is shown: as asked, else so that the recording stays small."""
        if not self.viewer.shows:
            return None
        shown = min(MAP_FRAMES, max(1, MAP_FRAME_CELLS // (frame.rows * frame.cols)))
        if shown < min(MAP_FRAMES, scans) and not self.options.map_every:
            self._notes.append(
                f"the map is large and shown {counted(shown, 'time')} along the way: more often with --map-every, "
                "or with a coarser --resolution"
            )
        return self.options.map_every or max(1, -(-scans // shown))

    def _begin(self, log: LogReader, scans: ScanLog, poses: LaserPoses, scene: Scene) -> None:
        with self._clock.stage("viewer"):
            self.viewer.begin(scene)
            first = int(scans.stamps[0])
            self.viewer.event(0, first, f"{len(scans)} of {scans.total} scans selected on {scans.topic.name}")
            self.viewer.event(0, first, f"poses: {poses.source} ({poses.origin})")

    def _note_what_was_used(self, scans: ScanLog, poses: LaserPoses, used: Used, grid: OccupancyGrid) -> None:
        """What a user should know about scans that were left out, and about rays that met nothing."""
        self._notes += [*poses.notes, *scans.notes()]
        outside = int(np.count_nonzero(~poses.valid))
        if outside:
            self._notes.append(f"{counted(outside, 'scan')} outside the time of the poses: not used")
        if not used.hits:
            self._notes.append(f"none of {used.rays} rays returned from a surface: nothing is occupied")
        elif not (grid.free | grid.occupied).any():
            self._notes.append("no ray crosses the map's bounds: all of it is unknown")

    def _map_scans(
        self,
        scans: ScanLog,
        poses: LaserPoses,
        mapper: Mapper,
        judge: Judge,
        truth: Truth | None,
        lookout: Lookout | None,
        map_every: int | None,
    ) -> Used:
        """Maps, scores and shows scan by scan; returns what was used."""
        used = Used()
        shown: World | None = None
        pace = Pace(self.options.rate)
        every = self.options.detect_every if lookout else None
        add = mapper.update if map_every or every else mapper.keep
        for posed in self._posed(scans, poses):
            position, scan = posed.position, posed.scan
            stamp = int(scans.stamps[position])
            pace.wait(stamp)
            start = time.perf_counter()
            with self._clock.stage("map"):
                for piece, pose in posed.pieces:
                    add(piece, pose)
            seconds = time.perf_counter() - start
            judge.update(position, scan, stamp)
            used.count(scan)
            if lookout is not None:
                self._look(lookout, mapper, posed, stamp)
            with self._clock.stage("viewer"):
                if truth is not None and truth.at(stamp) is not shown:
                    shown = truth.at(stamp)
                    self.viewer.show_truth(position, stamp, shown)
                self.viewer.show_scan(position, stamp, posed.pose, posed.points, seconds)
                error = judge.pose_error(position)
                if error is not None:
                    self.viewer.show_pose_error(position, stamp, *error, posed.pose)
            if map_every and position % map_every == 0:
                with self._clock.stage("map"):
                    grid = mapper.grid()
                scores = judge.score(grid)
                with self._clock.stage("viewer"):
                    self.viewer.show_map(position, stamp, grid, scores)
            self._progress(position + 1, len(scans))
        return used

    def _look(self, lookout: Lookout, mapper: Mapper, posed: PosedScan, stamp: int) -> None:
        """Shows the detector a scan and, where it is time, lets it look."""
        every = self.options.detect_every
        with self._clock.stage("detect"):
            for scan, pose in posed.pieces:
                (lookout.update if every else lookout.keep)(scan, pose)
            if not every or (posed.position + 1) % every:
                return
            seen = lookout.map_so_far(mapper)
        sighting = self._sighting(lookout, seen, stamp)
        with self._clock.stage("viewer"):
            self.viewer.show_sighting(posed.position, stamp, sighting)

    def _sighting(
        self, lookout: Lookout, seen: OccupancyGrid, stamp: int, posed: Iterable[tuple[Scan, Pose2D]] | None = None
    ) -> Sighting:
        """Primitives in a map: detected, refined by the scans ``posed`` (or those so far), tracked."""
        noise_std = None
        with self._clock.stage("detect"):
            detections = lookout.detect(seen)
        if lookout.refines:
            with self._clock.stage("refine"):
                detections, noise_std = lookout.refine(detections, seen, posed)
        with self._clock.stage("detect"):
            return lookout.sighting(detections, stamp, noise_std)

    def _result(
        self,
        log: LogReader,
        scans: ScanLog,
        poses: LaserPoses,
        used: Used,
        grid: OccupancyGrid,
        noise_std: float | None,
        scores: MapScores | None,
        sighting: Sighting | None,
        judge: Judge,
    ) -> ReplayResult:
        return ReplayResult(
            path=self.path,
            options=self.options,
            duration=scans.duration,
            scans=scans.total,
            scans_used=used.scans,
            rays=used.rays,
            lost=tuple(log.lost),
            notes=(*(f"lost: {lost}" for lost in log.lost), *self._notes),
            messages_lost=log.messages_lost,
            poses=poses,
            stamps=scans.stamps,
            pose_rmse=judge.pose_rmse(),
            pose_nees=judge.pose_nees(),
            grid=grid,
            noise_std=noise_std,
            scores=scores,
            sighting=sighting,
            blind=self._blind,
            seconds=self._clock.seconds | {"total": self._clock.total()},
        )


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
        if ahead > MAX_WAIT:  # go on from here, or every scan after the pause would wait as well
            self._start = time.perf_counter() + MAX_WAIT, stamp
        if ahead > 0:
            time.sleep(min(ahead, MAX_WAIT))
