"""Detection in a replay: primitives in the map so far and in the final map, refined, tracked and evaluated."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from detect.networks.weights import shipped_weights
from mapping.grid import GridFrame, OccupancyGrid
from mapping.mapper import Mapper, make_mapper
from prim.arrays import FloatArray
from prim.choices import MapperName
from prim.errors import UsageError
from prim.metrics import DetectionErrors, detection_errors
from prim.scan import PosedScan, Scan
from prim.se2 import Pose2D
from prim.shapes import Primitive
from prim.threads import preload
from replay.detection_refiner import DetectionRefiner
from replay.ground_truth import GroundTruth
from replay.options import ReplayOptions
from replay.posed_scans import PosedScans
from replay.timing import StageTimer

if TYPE_CHECKING:
    from detect.detection import Detections
    from detect.detector import Detector
    from detect.tracker import Tracker
    from replay.moved_primitives import MovedPrimitives


@dataclass(frozen=True)
class TrackIdentity:
    """The track that a detection belongs to.

    Attributes:
        id: The track's number; without a tracker, the detection's position in the list, from 1 on.
        confirmed: Whether the track is confirmed; tentative otherwise. Always true without a tracker.
        std: Standard deviations of the track's parameters by name (m, rad); None without a tracker.
    """

    id: int
    confirmed: bool = True
    std: Mapping[str, float] | None = None


@dataclass(frozen=True)
class DetectionResult:
    """The primitives detected in one map.

    Attributes:
        detections: The detections and the candidates that were rejected.
        identities: The track of each detection; without a tracker, its number.
        noise_std: The range noise that refinement estimated or was given (m); None without refinement.
        truth: The true primitives; empty without ground truth.
        errors: How the detections compare with the truth; None without ground truth.
    """

    detections: Detections
    identities: tuple[TrackIdentity, ...]
    noise_std: float | None = None
    truth: tuple[Primitive, ...] = ()
    errors: DetectionErrors | None = None


class DetectionStage:
    """Detects primitives while a log is replayed: in the map so far at intervals, and in the final map.

    Args:
        detector: The networks.
        options: Options of the replay.
        frame: The place and size of the grid of the replay's map.
        truth: The true world, in coordinates of the map; None where it is not known.
        frame_covariance: The covariance (3, 3; m, rad) of the map frame's own pose; None where it is exact.
        timer: Counts the time towards the stages «detect» and «refine».
        pose_std: Standard deviations of the poses' positions (m) and headings (rad); None where they are not known,
            so that nothing is known to move.
    """

    skipped: str | None = None

    def __init__(
        self,
        detector: Detector,
        options: ReplayOptions,
        frame: GridFrame,
        truth: GroundTruth | None,
        frame_covariance: FloatArray | None,
        timer: StageTimer,
        pose_std: tuple[float, float] | None = None,
    ) -> None:
        self._detector = detector
        self._interval = options.detect_every
        self._own_mapper = _own_mapper(detector, options, frame)
        moved = None
        if options.refine and self.streaming and pose_std is not None:
            moved = _moved_primitives(detector, options, frame, pose_std)
        self._refiner = DetectionRefiner(options.noise_std, frame_covariance, moved) if options.refine else None
        self._tracker = preload(_tracker) if self.streaming else None
        self._truth = truth
        self._timer = timer

    @property
    def streaming(self) -> bool:
        """Whether primitives are detected before the last scan."""
        return self._interval is not None

    def update(self, posed: PosedScan, mapper: Mapper) -> DetectionResult | None:
        """Add a scan, and detect primitives in the map so far where that is due.

        With an interval of N, that is after the scans at positions N - 1, 2N - 1 and so on in the selection: after N,
        2N and so on scans, where all have a pose.

        Args:
            posed: The scan, which the replay's map has already.
            mapper: The replay's mapper.

        Returns:
            What was detected; None where no detection is due.
        """
        with self._timer.stage("detect"):
            self._add(posed)
            if not self._interval or (posed.position + 1) % self._interval:
                return None
            grid = (self._own_mapper or mapper).grid()
            detections = self._detector.detect(grid)
        noise_std = None
        if self._refiner:
            with self._timer.stage("refine"):
                detections, noise_std = self._refiner.refine_so_far(detections, grid)
        return self._result(detections, posed.scan.stamp, noise_std)

    def finish(self, grid: OccupancyGrid, posed_scans: PosedScans) -> DetectionResult:
        """Detect primitives in the final map.

        Args:
            grid: The replay's map of all scans.
            posed_scans: All scans.

        Returns:
            What was detected.
        """
        with self._timer.stage("detect"):
            if self._own_mapper is not None:
                grid = self._own_mapper.finish()
            detections = self._detector.detect(grid)
        noise_std = None
        if self._refiner:
            with self._timer.stage("refine"):
                detections, noise_std = self._refiner.refine(detections, grid, lambda: _pieces(posed_scans))
        return self._result(detections, int(posed_scans.scan_log.stamps[-1]), noise_std)

    def _add(self, posed: PosedScan) -> None:
        """Add a scan to the detector's own map, and to those that refine detections before the last scan."""
        for scan, pose in posed.pieces:
            if self._refiner and self.streaming:
                self._refiner.add(scan, pose)
            if self._own_mapper is not None:
                (self._own_mapper.update if self.streaming else self._own_mapper.accumulate)(scan, pose)

    def _result(self, detections: Detections, stamp: int, noise_std: float | None) -> DetectionResult:
        """Identify the detections' tracks, and evaluate them against the truth at ``stamp`` (ns)."""
        with self._timer.stage("detect"):
            identities = self._identities(detections, stamp)
            if self._truth is None:
                return DetectionResult(detections, identities, noise_std)
            truth = tuple(self._truth.at(stamp).primitives)
            errors = detection_errors([detection.primitive for detection in detections.found], truth)
            return DetectionResult(detections, identities, noise_std, truth, errors)

    def _identities(self, detections: Detections, stamp: int) -> tuple[TrackIdentity, ...]:
        """Return the track of each detection; without a tracker, number them in their order."""
        if self._tracker is None:
            return tuple(TrackIdentity(number) for number in range(1, len(detections.found) + 1))
        tracks = self._tracker.result().update(detections.found, stamp)
        return tuple(TrackIdentity(track.id, track.confirmed, track.std) for track in tracks)


class NoDetection:
    """The stage of a replay that does not detect.

    Args:
        skipped: Why detection is not possible, where it was wanted; None where it was not.
    """

    streaming = False

    def __init__(self, skipped: str | None = None) -> None:
        self.skipped = skipped

    def update(self, posed: PosedScan, mapper: Mapper) -> None:
        """See :meth:`DetectionStage.update`."""

    def finish(self, grid: OccupancyGrid, posed_scans: PosedScans) -> None:
        """See :meth:`DetectionStage.finish`."""


def make_detection_stage(
    options: ReplayOptions,
    frame: GridFrame,
    truth: GroundTruth | None,
    frame_covariance: FloatArray | None,
    timer: StageTimer,
    pose_std: tuple[float, float] | None = None,
) -> DetectionStage | NoDetection:
    """Make the stage that detects, with the weights that are named or those that come with prim.

    Args:
        options: Options of the replay.
        frame: The place and size of the grid of the replay's map.
        truth: The true world, in coordinates of the map; None where it is not known.
        frame_covariance: The covariance (3, 3; m, rad) of the map frame's own pose; None where it is exact.
        timer: Counts the time of loading towards the stage «detect».
        pose_std: Standard deviations of the poses' positions (m) and headings (rad); None where they are not known,
            so that nothing is known to move.

    Returns:
        The stage; a :class:`NoDetection` where detection is not wanted, or where it was not explicitly asked for and
        there are no weights for the mapper, or the detector's own map would have too many cells.

    Raises:
        UsageError: Detection was explicitly asked for, by weights or an interval, and there are no weights for the
            mapper, or the detector's own map would have too many cells.
        WeightsError: The weights cannot be used, whether or not detection was explicitly asked for.
    """
    if not options.detect:
        return NoDetection()
    explicit = options.weights is not None or options.detect_every is not None
    weights = options.weights or shipped_weights(options.mapper)
    try:
        if weights is None:
            raise UsageError(f"no weights for maps of {options.mapper} come with prim: give --weights")
        detector = _load(weights, options.mapper, timer)
        return DetectionStage(detector, options, frame, truth, frame_covariance, timer, pose_std)
    except UsageError as error:
        if explicit:
            raise
        return NoDetection(str(error))


def _load(weights: Path, mapper: str, timer: StageTimer) -> Detector:
    from detect.detector import Detector  # when it is needed: a replay without detection starts faster

    with timer.stage("detect"):
        return Detector.load(weights, mapper)


def _tracker() -> Tracker:
    from detect.tracker import Tracker  # in a thread: it imports filterpy, which takes some tenths of a second

    return Tracker()


def _moved_primitives(
    detector: Detector, options: ReplayOptions, frame: GridFrame, pose_std: tuple[float, float]
) -> MovedPrimitives:
    """Make the part that refines what moves, with maps as the networks were trained on."""
    from replay.moved_primitives import MovedPrimitives  # as all that refinement needs

    def make_map(scans: Iterable[tuple[Scan, Pose2D]]) -> OccupancyGrid:
        mapper = _detectors_mapper(detector, options, frame)
        for scan, pose in scans:
            mapper.accumulate(scan, pose)
        return mapper.finish()

    return MovedPrimitives(make_map, detector.detect, pose_std)


def _pieces(posed_scans: PosedScans) -> Iterator[tuple[Scan, Pose2D]]:
    return (piece for posed in posed_scans for piece in posed.pieces)


def _own_mapper(detector: Detector, options: ReplayOptions, frame: GridFrame) -> Mapper | None:
    """Make a mapper of the kind and the cells that the detector was trained on; None where the replay's has both."""
    cell = detector.card.resolution
    if np.isclose(options.resolution, cell, rtol=1e-6) and options.sensor_model == "eq4":
        return None
    return _detectors_mapper(detector, options, frame)


def _detectors_mapper(detector: Detector, options: ReplayOptions, frame: GridFrame) -> Mapper:
    """Make a mapper of the kind and the cells that the detector was trained on."""
    cell = detector.card.resolution
    noise_std = options.noise_std if options.mapper == MapperName.FORWARD else None
    return make_mapper(options.mapper, cell, GridFrame.covering(frame.bounds, cell).bounds, "eq4", noise_std)
