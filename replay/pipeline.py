"""Replay: a log through one mapper or several, scan by scan, evaluated and shown as it goes."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

from mapping.grid import GridFrame
from prim.errors import UsageError, WorldError
from prim.interrupts import Interrupts
from prim.log import open_log
from prim.log.source import LogSource
from prim.scan import PosedScan
from replay.branch import Branch
from replay.ground_truth import GroundTruth
from replay.localization import Localization, localize, pose_scans
from replay.mapping.bounds import choose_map_bounds
from replay.mapping.memory import MemoryBudget
from replay.mapping.stage import blames_log_for_size
from replay.notes import sensor_notes
from replay.options import ReplayOptions
from replay.replay_evaluator import ReplayEvaluator
from replay.result import ReplayResult, distinct_notes
from replay.scans.posed_scans import PosedScans
from replay.scans.scan_log import ScanLog
from replay.timing import RatePacer, StageProgress, StageTimer, no_stage_progress
from replay.viewing.protocol import NullViewer, Scene, Viewer

if TYPE_CHECKING:
    from detect.detection import SensorErrors
    from replay.detection.stage import DetectionResult


class Pipeline:
    """Replays one log.

    Args:
        path: The log: a file, or a folder of a ROS 2 bag.
        options: How it is replayed.
        viewer: Shows the replay as it goes; None for no viewer.
        progress: Called with a stage («scans», «detect», «refine»), what of it is done, and what there is in all.
        interrupts: Holds interruptions back where something would be torn. While they are active, a replay that is
            interrupted ends with the results of the scans until then; else KeyboardInterrupt is raised.
    """

    def __init__(
        self,
        path: Path,
        options: ReplayOptions,
        viewer: Viewer | None = None,
        progress: StageProgress = no_stage_progress,
        interrupts: Interrupts | None = None,
    ) -> None:
        self.path = path
        self.options = options
        self.viewer: Viewer = viewer or NullViewer()
        self._progress = progress
        self._interrupts = interrupts or Interrupts()
        self._interrupted: KeyboardInterrupt | None = None
        self._timer = StageTimer()
        self._notes: list[str] = []

    def run(self) -> ReplayResult:
        """Replay the log by one mapper, from the file to the result; see :meth:`run_each`.

        Returns:
            The map, its poses and detections, and their evaluation where the log has ground truth.

        Raises:
            UsageError: The options name several mappers.
        """
        if len(self.options.mappers) > 1:
            raise UsageError(f"--mapper {self.options.mapper} names several: run_each() has a result for each")
        return self.run_each()[0]

    def run_each(self) -> tuple[ReplayResult, ...]:
        """Replay the log by each of the mappers side by side, from the file to the results.

        The viewer shows them; whoever made it closes it by :meth:`.Viewer.finish`.

        Returns:
            A result for each mapper, in the order in which the options name them.

        Raises:
            LogReadError: The log cannot be read, or lacks what the replay needs.
            UsageError: The options do not fit together or do not fit the log.
            WeightsError: The weights that the options name cannot be used.
            OutputError: The viewer's recording cannot be created.
        """
        with (
            self._abandoned_on_failure(),
            blames_log_for_size(self.path, self.options),
            open_log(self.path, recover=self.options.recover) as log,
        ):
            scans = self._read_scans(log)
            truth = self._read_truth(scans.log)
            scans, poses, true_poses, _ = self._localize(scans)
            posed_scans = pose_scans(scans, poses, self.options, self._timer)
            frame, notes = choose_map_bounds(posed_scans, self.options, truth.world if truth else None)
            self._notes += notes
            evaluator = ReplayEvaluator(frame, truth, poses, true_poses)
            budget = MemoryBudget(self.path, self.options, frame)
            budget.check(scans.expected_rays)
            branches = self._branches(frame, posed_scans, evaluator)
            self._begin_viewer(frame, posed_scans, branches, evaluator)
            with self._interrupts.held():
                self._map_and_detect(posed_scans, branches, evaluator, budget)
                results = self._results(log, posed_scans, evaluator, branches)
                self._show_results(results)
        return results

    def _read_scans(self, log: LogSource) -> ScanLog:
        """Find the scans that are to be replayed."""
        with self._timer.stage("read"):
            return ScanLog(log, self.options.selection, self.options.scan_log)

    def _read_truth(self, log: LogSource) -> GroundTruth | None:
        """Read the log's true world; note where it has one that is not valid."""
        with self._timer.stage("read"):
            try:
                return GroundTruth.read(log)
            except WorldError as error:
                self._notes.append(f"the map is not scored: {error}")
                return None

    def _localize(self, scans: ScanLog) -> Localization:
        """Find the poses of the laser, matched where that is asked for, and the true ones."""
        with self._timer.stage("localize"):
            localization = localize(scans, self.options, self._timer)
        self._notes += localization.notes
        return localization

    def _branches(self, frame: GridFrame, posed_scans: PosedScans, evaluator: ReplayEvaluator) -> list[Branch]:
        """Make a branch for each mapper: it maps, detects primitives, and shows both."""
        return [
            Branch(options, frame, posed_scans, evaluator, self.viewer, self._timer, self._interrupts, self._progress)
            for options in self.options.by_mapper()
        ]

    def _map_and_detect(
        self,
        posed_scans: PosedScans,
        branches: Sequence[Branch],
        evaluator: ReplayEvaluator,
        budget: MemoryBudget,
    ) -> None:
        """Map all scans and detect primitives by each branch; where that is interrupted, make maps of what there is.

        Raises:
            LogReadError: There are more rays than there is memory for.
            KeyboardInterrupt: There was an interruption before the first scan, or nothing is to be kept.
        """
        try:
            for posed in self._interrupts.released_while_iterating(self._paced(posed_scans)):
                evaluator.update(posed)
                self._show_scan(posed, evaluator)
                for branch in branches:
                    branch.update(posed)
                budget.check(branches[0].usage.rays)
            for branch in branches:
                branch.finish_map()
                branch.finish_detection()
        except KeyboardInterrupt as interruption:
            if not self._interrupts.active or not all(branch.usage.scans for branch in branches):
                raise
            self._interrupted = interruption
            self._interrupts.handled()
            with self._interrupts.held():
                for branch in branches:
                    branch.finish_map()

    def _paced(self, posed_scans: PosedScans) -> Iterator[PosedScan]:
        """Iterate over the scans, no faster than at the rate that is asked for, and report the progress."""
        pacer = RatePacer(self.options.rate)
        for posed in posed_scans:
            pacer.wait(posed.scan.stamp)
            yield posed
            self._progress("scans", posed.position + 1, len(posed_scans.scan_log))

    def _begin_viewer(
        self, frame: GridFrame, posed_scans: PosedScans, branches: Sequence[Branch], evaluator: ReplayEvaluator
    ) -> None:
        """Describe the replay to the viewer before the first scan."""
        scans, poses = posed_scans.scan_log, posed_scans.poses
        scene = Scene(
            log=scans.path.name,
            mappers=self.options.mappers,
            bounds=frame.bounds,
            has_scores=evaluator.scores_maps,
            has_pose_errors=evaluator.compares_poses,
            counting=tuple(branch.mapper for branch in branches if branch.counts_visits),
            detecting=tuple(branch.mapper for branch in branches if branch.detects),
            has_errors=evaluator.scores_maps and any(branch.detects for branch in branches),
            loops=None if poses.loops is None else poses.poses[poses.loops.pairs, :2],
        )
        first = int(scans.stamps[0])
        with self._timer.stage("viewer"):
            self.viewer.begin(scene)
            self.viewer.event(0, first, f"{len(scans)} of {scans.total} scans selected on {scans.names}")
            self.viewer.event(0, first, f"poses: {poses.source} ({poses.origin})")

    def _show_scan(self, posed: PosedScan, evaluator: ReplayEvaluator) -> None:
        """Show the true world, a scan, and its pose error."""
        with self._timer.stage("viewer"):
            world = evaluator.world(posed.scan.stamp)
            if world is not None:
                self.viewer.show_truth(posed.position, posed.scan.stamp, world)
            self.viewer.show_scan(posed)
            error = evaluator.pose_error(posed.position)
            if error is not None:
                self.viewer.show_pose_error(posed, *error)

    def _results(
        self,
        log: LogSource,
        posed_scans: PosedScans,
        evaluator: ReplayEvaluator,
        branches: Sequence[Branch],
    ) -> tuple[ReplayResult, ...]:
        """Collect what the stages found out: a result for each branch."""
        scans, total = posed_scans.scan_log, self._timer.total()
        lost = [f"lost: {lost}" for lost in log.lost]
        notes = [*lost, *self._notes, *posed_scans.notes()]
        done = None
        if self._interrupted is not None:
            done = min(branch.usage.scans for branch in branches)
            what = "the results are" if done < len(scans) else "the primitives are"
            notes.append(f"interrupted after {done} of {len(scans)} scans: {what} those until then")
        outcomes = [branch.outcome() for branch in branches]
        in_branches = sum(sum(branch.seconds.values()) for branch in branches)
        return tuple(
            ReplayResult(
                path=self.path,
                format=log.format,
                options=branch.options,
                duration=scans.duration(done),
                scans=scans.total,
                scans_used=branch.usage.scans,
                rays=branch.usage.rays,
                lost=tuple(log.lost),
                interrupted=self._interrupted,
                notes=(
                    *notes,
                    *branch.notes(outcome.grid),
                    *sensor_notes(_sensor_errors(outcome.detections)),
                ),
                messages_lost=log.messages_lost,
                poses=posed_scans.poses,
                stamps=scans.stamps,
                scanner=scans.scanner,
                pose_rmse=evaluator.pose_rmse(),
                pose_nees=evaluator.pose_nees(),
                grid=outcome.grid,
                noise_std=branch.noise_std,
                scores=outcome.scores,
                detections=outcome.detections,
                detection_skipped=branch.detection_skipped,
                seconds=_added(self._timer.seconds, branch.seconds)
                | {"total": total - in_branches + sum(branch.seconds.values())},
                elapsed=total,
            )
            for branch, outcome in zip(branches, outcomes, strict=True)
        )

    def _show_results(self, results: Sequence[ReplayResult]) -> None:
        """Show the final maps and detections, and the notes."""
        position, stamp = len(results[0].stamps) - 1, int(results[0].stamps[-1])
        with self._timer.stage("viewer"):
            for result in results:
                if result.detections is not None:
                    self.viewer.show_detections(result.options.mapper, position, stamp, result.detections)
                self.viewer.show_map(result.options.mapper, position, stamp, result.grid, result.scores)
            for note in distinct_notes(results):
                self.viewer.event(position, stamp, note, warning=True)

    @contextmanager
    def _abandoned_on_failure(self) -> Iterator[None]:
        """Discard what the viewer has so far where the replay fails."""
        try:
            yield
        except BaseException:
            self.viewer.abandon()
            raise


def _sensor_errors(result: DetectionResult | None) -> SensorErrors | None:
    """Return the errors of the scanner that refinement corrected; None for none."""
    return result.detections.sensor if result else None


def _added(a: Mapping[str, float], b: Mapping[str, float]) -> dict[str, float]:
    """Add the seconds of stages by name."""
    return {name: a[name] + b[name] for name in a}
