"""One mapper's branch of a replay: its map, the primitives in it, and how both are evaluated and shown."""

from __future__ import annotations

from typing import NamedTuple

from mapping.grid import GridFrame, OccupancyGrid
from mapping.map_metrics import MapScores
from prim.interrupts import Interrupts
from prim.scan import PosedScan
from replay.detection.stage import DetectionResult, DetectionStage, make_detection_stage
from replay.intervals import NEVER, snapshot_interval
from replay.mapping.stage import MappingStage, Usage, make_replay_mapper
from replay.options import ReplayOptions
from replay.replay_evaluator import ReplayEvaluator
from replay.scans.posed_scans import PosedScans
from replay.timing import StageProgress, StageTimer, no_stage_progress
from replay.viewing.protocol import Viewer


class Outcome(NamedTuple):
    """What a branch comes to.

    Attributes:
        grid: The map of all scans.
        scores: Its scores; None without ground truth.
        detections: The primitives in it; None where detection was skipped.
    """

    grid: OccupancyGrid
    scores: MapScores | None
    detections: DetectionResult | None


class Branch:
    """Maps scans by one mapper and detects primitives in its map, scan by scan; a replay has one for each mapper.

    Args:
        options: Options of the replay, with this mapper alone.
        frame: The place and size of the map's grid.
        posed_scans: The scans.
        evaluator: Compares maps with the ground truth.
        viewer: Shows the map and the detections.
        shared: The timer of the replay.
        interrupts: Lets interruptions come while primitives are detected.
        progress: Called with a stage, what of it is done, and what there is in all.

    Attributes:
        options: Options of the replay, with this mapper alone.
        mapper: The mapper's name.
        seconds: The time of each stage of this branch alone, by name (s).
    """

    def __init__(
        self,
        options: ReplayOptions,
        frame: GridFrame,
        posed_scans: PosedScans,
        evaluator: ReplayEvaluator,
        viewer: Viewer,
        shared: StageTimer,
        interrupts: Interrupts,
        progress: StageProgress = no_stage_progress,
    ) -> None:
        self.options = options
        self.mapper = options.mapper
        self._evaluator = evaluator
        self._viewer = viewer
        self._interrupts = interrupts
        self._grid: OccupancyGrid | None = None
        self._detections: DetectionResult | None = None
        self._timer = timer = StageTimer(shared)
        self.seconds = timer.seconds
        self._detection = make_detection_stage(
            options, frame, posed_scans, evaluator.comparable_truth, viewer.shows, timer, progress
        )
        scans, cells = len(posed_scans.scan_log), frame.rows * frame.cols
        snapshots = snapshot_interval(options, scans, cells) if viewer.shows else NEVER
        mapper = make_replay_mapper(posed_scans, frame, options, timer)
        streaming = snapshots.scans is not None or self._detection.streaming
        self._mapping = MappingStage(mapper, snapshots.scans, streaming, options.resolution, timer)
        self._notes = [note for note in (snapshots.note, self._detection.note) if note]

    @property
    def counts_visits(self) -> bool:
        """Whether its maps say how many rays reached each cell."""
        return self._mapping.mapper.counts_visits

    @property
    def detects(self) -> bool:
        """Whether primitives are detected."""
        return isinstance(self._detection, DetectionStage)

    def update(self, posed: PosedScan) -> None:
        """Map a scan, detect primitives and show what came of it, each where it is due."""
        position, stamp = posed.position, posed.scan.stamp
        seconds = self._mapping.update(posed)
        with self._interrupts.released():
            detections = self._detection.update(posed, self._mapping.mapper)
        self._detections = detections or self._detections
        grid = self._mapping.snapshot(position, detections is not None)
        scores = None if grid is None else self._evaluator.score(grid)
        with self._timer.stage("viewer"):
            self._viewer.show_mapping_time(self.mapper, posed, seconds)
            if detections is not None:
                self._viewer.show_detections(self.mapper, position, stamp, detections)
            if grid is not None:
                self._viewer.show_map(self.mapper, position, stamp, grid, scores)

    def finish_map(self) -> OccupancyGrid:
        """Return the map of all scans, which is made once."""
        if self._grid is None:
            self._grid = self._mapping.finish()
        return self._grid

    def finish_detection(self) -> None:
        """Detect the primitives in the map of all scans."""
        grid = self.finish_map()
        with self._interrupts.released():
            self._detections = self._detection.finish(grid)

    def outcome(self) -> Outcome:
        """Return the map of all scans, and the primitives that were detected last."""
        grid = self.finish_map()
        return Outcome(grid, self._evaluator.score(grid), self._detections)

    @property
    def usage(self) -> Usage:
        """How much of the log went into the map so far."""
        return self._mapping.usage

    @property
    def noise_std(self) -> float | None:
        """The range noise that the mapper assumes (m); None for a mapper without one."""
        return self._mapping.mapper.noise_std

    @property
    def detection_skipped(self) -> str | None:
        """Why detection is not possible, where it is wanted; None otherwise."""
        return self._detection.skipped

    def notes(self, grid: OccupancyGrid) -> list[str]:
        """Return what a user should know of the final map ``grid``, and of how often it was shown and searched."""
        return [*self._notes, *self._detection.notes(), *self._mapping.notes(grid)]
