"""Detection in a replay: primitives in the map so far and in the final map, refined, tracked and evaluated."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
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
from prim.se2 import Pose2D, frame_covariances
from prim.shapes import Primitive
from prim.threads import cores
from replay.ground_truth import GroundTruth
from replay.options import ReplayOptions
from replay.posed_scans import PosedScans
from replay.timing import StageTimer

if TYPE_CHECKING:
    from detect.detection import Detections
    from detect.detector import Detector
    from detect.refinement.refine import Effort
    from detect.tracker import Tracker


@dataclass(frozen=True)
class IntermediateOptions:
    """How much work goes into detection before the last scan; all set by hand.

    Attributes:
        scans: Primitives are refined with the rays of this many scans, to twice as many.
        kind_search_growth: Kinds of primitives whose kind was certain are compared again once the number of scans has
            grown by this factor since they were last.
        proposals: At most this many connected components of the map that the networks missed are tried.
        proposals_from: None are tried before this many scans: maps of few scans are full of fragments.
    """

    scans: int = 30
    kind_search_growth: int = 4
    proposals: int = 6
    proposals_from: int = 40


INTERMEDIATE = IntermediateOptions()


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


class ScanSubset:
    """A subset of the scans so far, evenly spread: ``size`` of them, to twice as many.

    All are held at first. Whenever there are twice ``size``, every other one is dropped, and from then on half as
    many are added.

    Args:
        size: The smallest number of scans that is held, once so many were added.

    Attributes:
        total: The number of scans that were added so far.
    """

    def __init__(self, size: int) -> None:
        self.total = 0
        self._size = size
        self._stride = 1
        self._selected = False
        self._scans: list[list[tuple[Scan, Pose2D]]] = []

    def add(self, scan: Scan, pose: Pose2D) -> None:
        """Add a scan, or a piece of one: the later pieces of a scan are held where its first piece is.

        Args:
            scan: The scan or piece.
            pose: The laser's pose.
        """
        if scan.first_beam:
            if self._selected:
                self._scans[-1].append((scan, pose))
            return
        self._selected = self.total % self._stride == 0
        if self._selected:
            self._scans.append([(scan, pose)])
        self.total += 1
        if len(self._scans) >= 2 * self._size:
            self._scans = self._scans[::2]
            self._stride *= 2

    def pieces(self) -> list[tuple[Scan, Pose2D]]:
        """Return the pieces of all scans that are held."""
        return [piece for scan in self._scans for piece in scan]


class DetectionRefiner:
    """Fits detections to the rays of the scans, from a warm start where it was done before.

    Args:
        noise_std: The range noise (m); None to estimate it.
        frame_covariance: The covariance (3, 3; m, rad) of the map frame's own pose, which adds to that of each
            primitive; None where it is exact.
        options: How much work goes into detection before the last scan.
    """

    def __init__(
        self,
        noise_std: float | None,
        frame_covariance: FloatArray | None,
        options: IntermediateOptions = INTERMEDIATE,
    ) -> None:
        self.scans = ScanSubset(options.scans)
        self._options = options
        self._noise_std = noise_std
        self._frame_covariance = frame_covariance
        self._previous: tuple[Detections, float | None] | None = None
        self._kind_search_at = 0

    def refine_so_far(self, detections: Detections, grid: OccupancyGrid) -> tuple[Detections, float | None]:
        """Refine detections before the last scan, with the rays of a subset of the scans.

        Primitives whose kind was certain the last time start from there, and keep their kind (warm start), unless
        the number of scans has grown enough to search all kinds again.

        Args:
            detections: What the networks found.
            grid: The map so far, which they found it in.

        Returns:
            The refined detections and the range noise (m), None where no ray passes any of them.
        """
        from detect.refinement.refine import Effort, WarmStart

        search_kinds = self.scans.total >= self._options.kind_search_growth * self._kind_search_at
        if search_kinds:
            self._kind_search_at = self.scans.total
        proposals = self._options.proposals if self.scans.total >= self._options.proposals_from else 0
        warm_start = None if search_kinds or self._previous is None else WarmStart(*self._previous)
        effort = Effort(warm_start, proposals, rounds=0)
        self._previous = self._refine(detections, grid, self.scans.pieces(), effort)
        return self._with_frame_uncertainty(self._previous[0]), self._previous[1]

    def refine(
        self, detections: Detections, grid: OccupancyGrid, scans: Iterable[tuple[Scan, Pose2D]]
    ) -> tuple[Detections, float | None]:
        """Refine detections with the rays of all scans.

        Args:
            detections: What the networks found.
            grid: The map that they found it in.
            scans: The pieces of all scans, with the laser's poses.

        Returns:
            The refined detections and the range noise (m), None where no ray passes any of them.
        """
        from detect.refinement.refine import THOROUGH

        refined, noise_std = self._refine(detections, grid, scans, THOROUGH)
        return self._with_frame_uncertainty(refined), noise_std

    def _refine(
        self, detections: Detections, grid: OccupancyGrid, scans: Iterable[tuple[Scan, Pose2D]], effort: Effort
    ) -> tuple[Detections, float | None]:
        # imported when it is needed: a replay without refinement starts faster
        from detect.refinement.refine import refine_detections

        return refine_detections(detections, scans, grid, self._noise_std, cores(), effort)

    def _with_frame_uncertainty(self, detections: Detections) -> Detections:
        """Add the uncertainty of the map frame's pose to that of the detections."""
        if self._frame_covariance is None:
            return detections
        found = tuple(
            detection
            if detection.std is None
            else replace(
                detection, std=add_frame_uncertainty(detection.primitive, detection.std, self._frame_covariance)
            )
            for detection in detections.found
        )
        return replace(detections, found=found)


class DetectionStage:
    """Detects primitives while a log is replayed: in the map so far at intervals, and in the final map.

    Args:
        detector: The networks.
        options: Options of the replay.
        frame: The place and size of the grid of the replay's map.
        truth: The true world, in coordinates of the map; None where it is not known.
        frame_covariance: The covariance (3, 3; m, rad) of the map frame's own pose; None where it is exact.
        timer: Counts the time towards the stages «detect» and «refine».
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
    ) -> None:
        self._detector = detector
        self._interval = options.detect_every
        self._own_mapper = _own_mapper(detector, options, frame)
        self._refiner = DetectionRefiner(options.noise_std, frame_covariance) if options.refine else None
        self._tracker = _tracker() if self._interval else None
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
            pieces = (piece for posed in posed_scans for piece in posed.pieces)
            with self._timer.stage("refine"):
                detections, noise_std = self._refiner.refine(detections, grid, pieces)
        return self._result(detections, int(posed_scans.scan_log.stamps[-1]), noise_std)

    def _add(self, posed: PosedScan) -> None:
        """Add a scan to the detector's own map, and to those that refine detections before the last scan."""
        for scan, pose in posed.pieces:
            if self._refiner and self.streaming:
                self._refiner.scans.add(scan, pose)
            if self._own_mapper is not None:
                (self._own_mapper.update if self.streaming else self._own_mapper.accumulate)(scan, pose)

    def _result(self, detections: Detections, stamp: int, noise_std: float | None) -> DetectionResult:
        """Identify the detections' tracks, and evaluate them against the truth at ``stamp`` (ns)."""
        with self._timer.stage("detect"):
            identities = self._identities(detections)
            if self._truth is None:
                return DetectionResult(detections, identities, noise_std)
            truth = tuple(self._truth.at(stamp).primitives)
            errors = detection_errors([detection.primitive for detection in detections.found], truth)
            return DetectionResult(detections, identities, noise_std, truth, errors)

    def _identities(self, detections: Detections) -> tuple[TrackIdentity, ...]:
        """Return the track of each detection; without a tracker, number them in their order."""
        if self._tracker is None:
            return tuple(TrackIdentity(number) for number in range(1, len(detections.found) + 1))
        tracks = self._tracker.update(detections.found)
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
) -> DetectionStage | NoDetection:
    """Make the stage that detects, with the weights that are named or those that come with prim.

    Args:
        options: Options of the replay.
        frame: The place and size of the grid of the replay's map.
        truth: The true world, in coordinates of the map; None where it is not known.
        frame_covariance: The covariance (3, 3; m, rad) of the map frame's own pose; None where it is exact.
        timer: Counts the time of loading towards the stage «detect».

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
        return DetectionStage(detector, options, frame, truth, frame_covariance, timer)
    except UsageError as error:
        if explicit:
            raise
        return NoDetection(str(error))


def _load(weights: Path, mapper: str, timer: StageTimer) -> Detector:
    from detect.detector import Detector  # when it is needed: a replay without detection starts faster

    with timer.stage("detect"):
        return Detector.load(weights, mapper)


def _tracker() -> Tracker:
    from detect.tracker import Tracker

    return Tracker()


def _own_mapper(detector: Detector, options: ReplayOptions, frame: GridFrame) -> Mapper | None:
    """Make a mapper of the kind and the cells that the detector was trained on; None where the replay's has both."""
    cell = detector.card.resolution
    if np.isclose(options.resolution, cell, rtol=1e-6) and options.sensor_model == "eq4":
        return None
    noise_std = options.noise_std if options.mapper == MapperName.FORWARD else None
    return make_mapper(options.mapper, cell, GridFrame.covering(frame.bounds, cell).bounds, "eq4", noise_std)


def add_frame_uncertainty(
    primitive: Primitive, std: Mapping[str, float], frame_covariance: FloatArray
) -> dict[str, float]:
    """Add the uncertainty of the map frame's own pose to a primitive's.

    Both errors are taken as independent (see :func:`prim.se2.frame_covariances`).

    Args:
        primitive: The primitive.
        std: Standard deviations of its parameters in the map frame, by name (m, rad).
        frame_covariance: The covariance (3, 3; m, rad) of the frame's pose.

    Returns:
        The standard deviations with both added in quadrature, by name (m, rad).
    """
    position = np.array([[primitive.x, primitive.y, 0.0]])
    variances = np.diag(frame_covariances(frame_covariance, position)[0]).tolist()
    added = dict(zip(("x", "y", "theta"), variances, strict=True))
    return {name: math.sqrt(value**2 + added.get(name, 0.0)) for name, value in std.items()}
