"""Detection in a replay: primitives in the map so far and in the final map, refined, tracked and evaluated."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from detect.networks.weights import WeightsError, shipped_weights
from mapping.grid import GridFrame, OccupancyGrid
from mapping.mapper import Mapper, make_mapper, takes_noise
from mapping.pyramid import DEFAULTS as PYRAMID
from prim.choices import SensorModelName
from prim.errors import UsageError
from prim.metrics import DetectionErrors, detection_errors
from prim.scan import PosedScan, Scan
from prim.se2 import Pose2D
from prim.shapes import Primitive
from prim.threads import preload
from replay.detection.refiner import DetectionRefiner
from replay.detection.visibility import Visibility
from replay.ground_truth import GroundTruth
from replay.intervals import detection_interval, is_due
from replay.options import ReplayOptions
from replay.scans.posed_scans import PosedScans
from replay.timing import StageProgress, StageTimer, no_stage_progress

if TYPE_CHECKING:
    from detect.detection import Detections
    from detect.detector import Detector
    from detect.tracker import Tracker
    from replay.detection.moved_primitives import MovedPrimitives


FINE_CELLS = 4_000_000
"""A map of its own, in finer cells than the replay's, is made for detection where it has no more cells: those of 20 x
20 m at 1 cm. Set by hand."""


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
    """The primitives detected in one map, and the objects that are none.

    Attributes:
        detections: The detections, the candidates that were rejected, and the objects that are none of the kinds.
        identities: The track of each detection; without a tracker, its number.
        noise_std: The range noise that refinement estimated or was given (m); None without refinement.
        truth: The true primitives; empty without ground truth.
        errors: How the detections compare with the truth, objects aside; None without ground truth.
        object_ids: The number of each object: they follow the largest that a primitive was ever given.
    """

    detections: Detections
    identities: tuple[TrackIdentity, ...]
    noise_std: float | None = None
    truth: tuple[Primitive, ...] = ()
    errors: DetectionErrors | None = None
    object_ids: tuple[int, ...] = ()


class DetectionStage:
    """Detects primitives while a log is replayed: in the map so far at intervals, and in the final map.

    Args:
        detector: The networks.
        options: Options of the replay.
        frame: The place and size of the grid of the replay's map.
        posed_scans: The scans of the replay.
        truth: The true world, in coordinates of the map; None where it is not known.
        is_shown: Whether the replay is shown, so that primitives are detected along the way unless the options say
            otherwise.
        timer: Counts the time towards the stages «detect» and «refine».
        progress: Called with a stage, what of it is done, and what there is in all.

    Attributes:
        skipped: None: detection is possible.
        note: What a user should know of how often primitives are detected; empty where nothing.
    """

    skipped: str | None = None

    def __init__(
        self,
        detector: Detector,
        options: ReplayOptions,
        frame: GridFrame,
        posed_scans: PosedScans,
        truth: GroundTruth | None,
        is_shown: bool,
        timer: StageTimer,
        progress: StageProgress = no_stage_progress,
    ) -> None:
        self._detector = detector
        self._progress = progress
        self._posed_scans = posed_scans
        self._sizes = options.sizes
        self._visibility = Visibility(_resolution(options, frame))
        self._own_mapper = _own_mapper(options, frame)
        cells = math.prod(GridFrame.covering(frame.bounds, _resolution(options, frame)).shape)
        interval = detection_interval(options, len(posed_scans.scan_log), cells, is_shown)
        self._interval, self.note = interval.scans, interval.note
        self._refiner = self._make_refiner(options, frame) if options.refine else None
        self._tracker = preload(_tracker) if self.streaming else None
        self._has_tracks = False
        self._truth = truth
        self._timer = timer

    def _make_refiner(self, options: ReplayOptions, frame: GridFrame) -> DetectionRefiner:
        """Make what refines; it finds what moved where there are looks along the way and poses do not drift."""
        poses, moved = self._posed_scans.poses, None
        if self.streaming and poses.max_std is not None:
            moved = _moved_primitives(self._detector, options, frame, poses.max_std)
        return DetectionRefiner(options.noise_std, poses.frame_covariance_at, moved, options.refinement)

    @property
    def streaming(self) -> bool:
        """Whether primitives are detected before the last scan."""
        return self._interval is not None

    def update(self, posed: PosedScan, mapper: Mapper) -> DetectionResult | None:
        """Add a scan, and detect primitives in the map so far where that is due, but after the last scan.

        Args:
            posed: The scan, which the replay's map has already.
            mapper: The replay's mapper.

        Returns:
            What was detected; None where no detection is due.
        """
        with self._timer.stage("detect"):
            self._add(posed)
            if not self._is_due(posed.position):
                return None
            grid = (self._own_mapper or mapper).grid()
            detections = self._detector.detect(grid, self._sizes)
        noise_std = None
        if self._refiner:
            with self._timer.stage("refine"):
                detections, noise_std = self._refiner.refine_so_far(detections, grid)
        return self._result(detections, posed.scan.stamp, noise_std)

    def _is_due(self, position: int) -> bool:
        is_last = position == len(self._posed_scans.scan_log) - 1
        return self._interval is not None and is_due(position, self._interval) and not is_last

    def finish(self, grid: OccupancyGrid) -> DetectionResult:
        """Detect primitives in the final map, and refine them with the rays of all scans.

        Args:
            grid: The replay's map of all scans.

        Returns:
            What was detected.
        """
        with self._timer.stage("detect"):
            if self._own_mapper is not None:
                grid = self._own_mapper.finish()
            detections = self._detector.detect(grid, self._sizes, partial(self._progress, "detect"))
        noise_std = None
        if self._refiner:
            with self._timer.stage("refine"):
                refining = partial(self._progress, "refine")
                scans = partial(_pieces, self._posed_scans)
                detections, noise_std = self._refiner.refine(detections, grid, scans, refining)
        return self._result(detections, int(self._posed_scans.scan_log.stamps[-1]), noise_std)

    def notes(self) -> list[str]:
        """Return what a user should know of the scans so far: which of the wanted objects they cannot show."""
        note = self._visibility.note(self._sizes)
        return [note] if note else []

    def _add(self, posed: PosedScan) -> None:
        """Add a scan to the detector's own map, and to those that refine detections before the last scan."""
        for scan, pose in posed.pieces:
            self._visibility.add(scan)
            if self._refiner and self.streaming:
                self._refiner.add(scan, pose)
            if self._own_mapper is not None:
                (self._own_mapper.update if self.streaming else self._own_mapper.accumulate)(scan, pose)

    def _result(self, detections: Detections, stamp: int, noise_std: float | None) -> DetectionResult:
        """Identify the detections' tracks, and evaluate them against the truth at ``stamp`` (ns)."""
        with self._timer.stage("detect"):
            identities = self._identities(detections, stamp)
            objects = self._object_ids(detections)
            if self._truth is None:
                return DetectionResult(detections, identities, noise_std, object_ids=objects)
            truth = tuple(self._truth.at(stamp).primitives)
            errors = detection_errors([detection.primitive for detection in detections.found], truth)
            return DetectionResult(detections, identities, noise_std, truth, errors, objects)

    def _identities(self, detections: Detections, stamp: int) -> tuple[TrackIdentity, ...]:
        """Return the track of each detection; without a tracker, number them in their order."""
        if self._tracker is None:
            return tuple(TrackIdentity(number) for number in range(1, len(detections.found) + 1))
        if not detections.found and not self._has_tracks:
            return ()  # nor need the tracker be loaded yet
        self._has_tracks = True
        tracks = self._tracker.result().update(detections.found, stamp)
        return tuple(TrackIdentity(track.id, track.confirmed, track.std) for track in tracks)

    def _object_ids(self, detections: Detections) -> tuple[int, ...]:
        """Number the objects that are none of the kinds; primitives are identified before."""
        last = len(detections.found)
        if self._tracker is not None:
            last = self._tracker.result().last_id if self._has_tracks else 0
        return tuple(range(last + 1, last + 1 + len(detections.objects)))


class NoDetection:
    """The stage of a replay that does not detect.

    Args:
        skipped: Why detection is not possible, where it was wanted; None where it was not.
    """

    streaming = False
    note = ""

    def notes(self) -> list[str]:
        """See :meth:`DetectionStage.notes`."""
        return []

    def __init__(self, skipped: str | None = None) -> None:
        self.skipped = skipped

    def update(self, posed: PosedScan, mapper: Mapper) -> None:
        """See :meth:`DetectionStage.update`."""

    def finish(self, grid: OccupancyGrid) -> None:
        """See :meth:`DetectionStage.finish`."""


def make_detection_stage(
    options: ReplayOptions,
    frame: GridFrame,
    posed_scans: PosedScans,
    truth: GroundTruth | None,
    is_shown: bool,
    timer: StageTimer,
    progress: StageProgress = no_stage_progress,
) -> DetectionStage | NoDetection:
    """Make the stage that detects, with the weights that are named or those that come with prim.

    Args:
        options: Options of the replay.
        frame: The place and size of the grid of the replay's map.
        posed_scans: The scans of the replay.
        truth: The true world, in coordinates of the map; None where it is not known.
        is_shown: Whether the replay is shown.
        timer: Counts the time of loading towards the stage «detect».
        progress: Called with a stage, what of it is done, and what there is in all.

    Returns:
        The stage; a :class:`NoDetection` where detection is not wanted, or where it was not explicitly asked for and
        there are no weights for the mapper that can be used, or the detector's own map would have too many cells.

    Raises:
        UsageError: Detection was explicitly asked for, by weights or an interval, and there are no weights for the
            mapper, or the detector's own map would have too many cells.
        WeightsError: Detection was explicitly asked for, and the weights cannot be used.
    """
    if not options.detect:
        return NoDetection()
    explicit = options.weights is not None or options.detect_every is not None
    weights = options.weights or shipped_weights(options.mapper)
    try:
        if weights is None:
            raise UsageError(
                f"no weights for maps of {options.mapper} come with prim: give --weights, or --no-detect"
            )
        detector = _load(weights, options.mapper, timer)
        return DetectionStage(detector, options, frame, posed_scans, truth, is_shown, timer, progress)
    except (UsageError, WeightsError) as error:
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
    from replay.detection.moved_primitives import MovedPrimitives  # as all that refinement needs

    def make_map(scans: Iterable[tuple[Scan, Pose2D]]) -> OccupancyGrid:
        mapper = _detectors_mapper(options, frame)
        for scan, pose in scans:
            mapper.accumulate(scan, pose)
        return mapper.finish()

    def detect(grid: OccupancyGrid) -> Detections:
        return detector.detect(grid, options.sizes)

    return MovedPrimitives(make_map, detect, pose_std, refinement=options.refinement)


def _pieces(posed_scans: PosedScans) -> Iterator[tuple[Scan, Pose2D]]:
    return (piece for posed in posed_scans for piece in posed.pieces)


def _resolution(options: ReplayOptions, frame: GridFrame) -> float:
    """Return the side (m) of the cells that the detector sees: the replay's, or finer ones that small things need.

    A large map is not made twice: there only what its own cells show is found.
    """
    needed = options.sizes[0] / PYRAMID.fewest_cells
    if options.resolution <= needed * (1 + PYRAMID.rounding):
        return options.resolution
    width, height = frame.cols * frame.resolution, frame.rows * frame.resolution
    return needed if width * height / needed**2 <= FINE_CELLS else options.resolution


def _own_mapper(options: ReplayOptions, frame: GridFrame) -> Mapper | None:
    """Make a mapper of what the detector reads, with the sensor model of training; None where the replay's does."""
    if _resolution(options, frame) == options.resolution and options.sensor_model == "eq4":
        return None
    return _detectors_mapper(options, frame)


def _detectors_mapper(options: ReplayOptions, frame: GridFrame) -> Mapper:
    """Make a mapper of maps as the detector reads them."""
    cell = _resolution(options, frame)
    model = SensorModelName.EQ4
    noise_std = options.noise_std if takes_noise(options.mapper, model) else None
    return make_mapper(options.mapper, cell, GridFrame.covering(frame.bounds, cell).bounds, model, noise_std)
