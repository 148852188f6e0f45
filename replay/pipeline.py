"""Replay: a log through a mapper, scan by scan, evaluated and shown as it goes."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import NamedTuple

from mapping.grid import GridFrame, OccupancyGrid
from mapping.map_metrics import MapScores
from prim.errors import LogReadError, WorldError
from prim.log import open_log
from prim.log.source import LogSource
from prim.scan import PosedScan
from replay.detection_stage import DetectionResult, DetectionStage, NoDetection, make_detection_stage
from replay.ground_truth import GroundTruth
from replay.mapping_stage import MappingStage, choose_grid_frame, make_replay_mapper
from replay.notes import pluralize
from replay.options import ReplayOptions
from replay.posed_scans import PosedScanOptions, PosedScans, ScanLog
from replay.poses.fusion_options import FusionInputs, SensorNoise
from replay.poses.laser_poses import FUSED, LaserPoses
from replay.poses.pose_provider import PoseProvider
from replay.replay_evaluator import ReplayEvaluator
from replay.result import ReplayResult
from replay.timing import RatePacer, StageTimer
from replay.viewing.protocol import NullViewer, Scene, Viewer

MAP_SNAPSHOTS = 50
"""By default the map is shown about this many times; set by hand."""

MAP_SNAPSHOT_CELLS = 40_000_000
"""By default no more cells than this are shown in all snapshots together: one byte each in a recording."""

Progress = Callable[[int, int], None]


class Outcome(NamedTuple):
    """What a replay comes to.

    Attributes:
        grid: The map of all scans.
        scores: Its scores; None without ground truth.
        detections: The primitives in it; None where detection was skipped.
    """

    grid: OccupancyGrid
    scores: MapScores | None
    detections: DetectionResult | None


class Pipeline:
    """Replays one log.

    Args:
        path: The log: a file, or a folder of a ROS 2 bag.
        options: How it is replayed.
        viewer: Shows the replay as it goes; None for no viewer.
        progress: Called after each scan with the number of scans so far and in all.
    """

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
        self._timer = StageTimer()
        self._notes: list[str] = []

    def run(self) -> ReplayResult:
        """Replay the log, from the file to the result.

        Returns:
            The map, its poses and detections, and their evaluation where the log has ground truth.

        Raises:
            LogReadError: The log cannot be read, or lacks what the replay needs.
            UsageError: The options do not fit together or do not fit the log.
            WeightsError: The detector's weights cannot be used, be they named or those that come with prim.
            OutputError: The viewer's recording cannot be created.
            RecordingError: The viewer's recording could not be written in full, at the end.
        """
        with self._abandoned_on_failure(), open_log(self.path, recover=self.options.recover) as log:
            scans = self._read_scans(log)
            truth = self._read_truth(log)
            poses, true_poses = self._estimate_poses(log, scans)
            posed_scans = self._posed_scans(scans, poses)
            frame = choose_grid_frame(posed_scans, self.options, truth.world if truth else None)
            evaluator = ReplayEvaluator(frame, truth, poses, true_poses)
            detection = self._make_detection_stage(frame, evaluator, poses)
            mapping = self._make_mapping_stage(frame, posed_scans, detection)
            self._begin_viewer(frame, posed_scans, mapping, detection, evaluator)
            for posed in self._paced(posed_scans):
                seconds = mapping.update(posed)
                evaluator.update(posed)
                self._show_detections(posed, detection.update(posed, mapping.mapper))
                self._show_scan(posed, seconds, evaluator)
                self._show_map(posed, mapping.snapshot(posed.position), evaluator)
            grid = mapping.finish()
            outcome = Outcome(grid, evaluator.score(grid), detection.finish(grid, posed_scans))
            result = self._result(log, posed_scans, mapping, detection, evaluator, outcome)
            self._show_result(result)
        return result

    def _read_scans(self, log: LogSource) -> ScanLog:
        """Find the scans that are to be replayed."""
        with self._timer.stage("read"):
            return ScanLog(log, self.options.scan_topic, self.options.selection)

    def _read_truth(self, log: LogSource) -> GroundTruth | None:
        """Read the log's true world; note where it has one that is not valid."""
        with self._timer.stage("read"):
            try:
                return GroundTruth.read(log)
            except WorldError as error:
                self._notes.append(f"the map is not scored: {error}")
                return None

    def _estimate_poses(self, log: LogSource, scans: ScanLog) -> tuple[LaserPoses, LaserPoses | None]:
        """Return the poses of the laser that the replay uses, matched where that is asked for, and the true ones."""
        with self._timer.stage("localize"):
            poses, true_poses = self._look_up_poses(log, scans)
            if self.options.match_scans:
                poses = self._match_scans(scans, poses)
        return poses, true_poses

    def _look_up_poses(self, log: LogSource, scans: ScanLog) -> tuple[LaserPoses, LaserPoses | None]:
        """Return the laser's poses by the source that is asked for, and the true ones where the log has them."""
        options = self.options
        provider = PoseProvider(log, options.odom_topic, options.laser_offset, options.fuse)
        times = scans.times if options.deskew else replace(scans.times, sweep=0)
        if options.standing_still:
            return provider.stationary_poses(times), None
        poses = provider.laser_poses(times, options.pose)
        fuse = replace(options.fuse, noise=SensorNoise()) if options.match_scans else options.fuse
        if fuse != FusionInputs() and poses.source != FUSED:
            self._notes.append(f"nothing is fused, since there are poses on {poses.origin}: give --pose fused")
        if poses.source == "truth":
            return poses, poses
        if not provider.has_truth:
            return poses, None
        try:
            return poses, provider.laser_poses(times, "truth")
        except LogReadError as error:
            self._notes.append(f"the poses are not held against the truth: {error.what}")
            return poses, None

    def _match_scans(self, scans: ScanLog, poses: LaserPoses) -> LaserPoses:
        """Correct the poses by matching every scan with a map of the scans."""
        from replay.poses.scan_matching import match_scans  # when it is needed: a replay without it starts faster

        options = self.options
        posed = partial(self._posed_scans, scans)
        return match_scans(
            poses, scans.stamps, posed, options.resolution, options.noise_std, options.fuse.noise, options.bounds
        )

    def _posed_scans(self, scans: ScanLog, poses: LaserPoses) -> PosedScans:
        """Give the scans their poses, and cut them where the laser moved by half a cell."""
        options = PosedScanOptions(self.options.resolution / 2, self.options.max_range)
        return PosedScans(scans, poses, options, self._timer)

    def _make_detection_stage(
        self, frame: GridFrame, evaluator: ReplayEvaluator, poses: LaserPoses
    ) -> DetectionStage | NoDetection:
        """Make the stage that detects primitives, in the map so far and in the final one."""
        truth = evaluator.comparable_truth
        return make_detection_stage(self.options, frame, truth, poses.frame_covariance, self._timer, poses.max_std)

    def _make_mapping_stage(
        self, frame: GridFrame, posed_scans: PosedScans, detection: DetectionStage | NoDetection
    ) -> MappingStage:
        """Make the stage that maps scan by scan; note where the map is too large to be shown often."""
        interval, notes = self._snapshot_interval(frame, len(posed_scans.scan_log))
        self._notes += notes
        mapper = make_replay_mapper(posed_scans, frame, self.options, self._timer)
        return MappingStage(mapper, interval, interval is not None or detection.streaming, self._timer)

    def _snapshot_interval(self, frame: GridFrame, scans: int) -> tuple[int | None, list[str]]:
        """Choose every how many scans the map is shown, so that a recording stays small; and what to note of that."""
        if not self.viewer.shows:
            return None, []
        if self.options.map_every:
            return self.options.map_every, []
        snapshots = min(MAP_SNAPSHOTS, max(1, MAP_SNAPSHOT_CELLS // (frame.rows * frame.cols)))
        note = (
            f"the map is large and shown {pluralize(snapshots, 'time')} along the way: more often with --map-every, "
            "or with a coarser --resolution"
        )
        return max(1, -(-scans // snapshots)), [note] if snapshots < min(MAP_SNAPSHOTS, scans) else []

    def _paced(self, posed_scans: PosedScans) -> Iterator[PosedScan]:
        """Iterate over the scans, no faster than at the rate that is asked for, and report the progress."""
        pacer = RatePacer(self.options.rate)
        for posed in posed_scans:
            pacer.wait(posed.scan.stamp)
            yield posed
            self._progress(posed.position + 1, len(posed_scans.scan_log))

    def _begin_viewer(
        self,
        frame: GridFrame,
        posed_scans: PosedScans,
        mapping: MappingStage,
        detection: DetectionStage | NoDetection,
        evaluator: ReplayEvaluator,
    ) -> None:
        """Describe the replay to the viewer before the first scan."""
        scans, poses = posed_scans.scan_log, posed_scans.poses
        detects = isinstance(detection, DetectionStage)
        scene = Scene(
            log=scans.path.name,
            mapper=self.options.mapper,
            bounds=frame.bounds,
            has_scores=evaluator.scores_maps,
            has_pose_errors=evaluator.compares_poses,
            has_visits=mapping.mapper.counts_visits,
            has_detections=detects,
            has_errors=detects and evaluator.scores_maps,
        )
        first = int(scans.stamps[0])
        with self._timer.stage("viewer"):
            self.viewer.begin(scene)
            self.viewer.event(0, first, f"{len(scans)} of {scans.total} scans selected on {scans.topic.name}")
            self.viewer.event(0, first, f"poses: {poses.source} ({poses.origin})")

    def _show_detections(self, posed: PosedScan, detections: DetectionResult | None) -> None:
        """Show the primitives detected after a scan, where there was a detection."""
        if detections is not None:
            with self._timer.stage("viewer"):
                self.viewer.show_detections(posed.position, posed.scan.stamp, detections)

    def _show_scan(self, posed: PosedScan, seconds: float, evaluator: ReplayEvaluator) -> None:
        """Show the true world, a scan, the time it took to map (s), and its pose error."""
        with self._timer.stage("viewer"):
            world = evaluator.world(posed.scan.stamp)
            if world is not None:
                self.viewer.show_truth(posed.position, posed.scan.stamp, world)
            self.viewer.show_scan(posed, seconds)
            error = evaluator.pose_error(posed.position)
            if error is not None:
                self.viewer.show_pose_error(posed, *error)

    def _show_map(self, posed: PosedScan, grid: OccupancyGrid | None, evaluator: ReplayEvaluator) -> None:
        """Show a snapshot of the map, where there is one, and its scores."""
        if grid is not None:
            scores = evaluator.score(grid)
            with self._timer.stage("viewer"):
                self.viewer.show_map(posed.position, posed.scan.stamp, grid, scores)

    def _result(
        self,
        log: LogSource,
        posed_scans: PosedScans,
        mapping: MappingStage,
        detection: DetectionStage | NoDetection,
        evaluator: ReplayEvaluator,
        outcome: Outcome,
    ) -> ReplayResult:
        """Collect what the stages found out."""
        scans = posed_scans.scan_log
        self._notes += [*posed_scans.notes(), *mapping.notes(outcome.grid)]
        return ReplayResult(
            path=self.path,
            options=self.options,
            duration=scans.duration,
            scans=scans.total,
            scans_used=mapping.usage.scans,
            rays=mapping.usage.rays,
            lost=tuple(log.lost),
            notes=(*(f"lost: {lost}" for lost in log.lost), *self._notes),
            messages_lost=log.messages_lost,
            poses=posed_scans.poses,
            stamps=scans.stamps,
            pose_rmse=evaluator.pose_rmse(),
            pose_nees=evaluator.pose_nees(),
            grid=outcome.grid,
            noise_std=mapping.mapper.noise_std,
            scores=outcome.scores,
            detections=outcome.detections,
            detection_skipped=detection.skipped,
            seconds=self._timer.seconds | {"total": self._timer.total()},
        )

    def _show_result(self, result: ReplayResult) -> None:
        """Show the final map and detections, the notes and the summary, and close the viewer."""
        position, stamp = len(result.stamps) - 1, int(result.stamps[-1])
        with self._timer.stage("viewer"):
            if result.detections is not None:
                self.viewer.show_detections(position, stamp, result.detections)
            for note in result.notes:
                self.viewer.event(position, stamp, note, warning=True)
            self.viewer.show_map(position, stamp, result.grid, result.scores)
            self.viewer.finish(result)

    @contextmanager
    def _abandoned_on_failure(self) -> Iterator[None]:
        """Discard what the viewer has so far where the replay fails."""
        try:
            yield
        except BaseException:
            self.viewer.abandon()
            raise
