"""Refinement of the detections of a replay: by a subset of the scans so far on the way, by all scans at the end."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from detect.detection import Progress, no_progress
from detect.refinement.options import DEFAULTS, RefinementOptions
from mapping.grid import OccupancyGrid
from prim.arrays import FloatArray
from prim.scan import Scan
from prim.se2 import Pose2D, frame_covariances
from prim.threads import cores

if TYPE_CHECKING:
    from detect.detection import Detection, Detections, UnknownObject
    from detect.refinement.refine import Effort
    from detect.refinement.surroundings.levels import MapLevels
    from replay.detection.moved_primitives import MovedPrimitives


@dataclass(frozen=True)
class IntermediateOptions:
    """How much work goes into detection before the last scan; all set by hand.

    Attributes:
        scans: Primitives are refined with the rays of this many scans, to twice as many.
        kind_search_growth: Kinds of primitives whose kind was certain are compared again once the number of scans has
            grown by this factor since they were last.
        proposals: At most this many connected components of the map that the networks missed are tried.
        recent_scans: What moved is searched in the scans since the last look, but in so many at least.
        proposals_from: None are tried before this many scans: maps of few scans are full of fragments.
    """

    scans: int = 30
    kind_search_growth: int = 4
    proposals: int = 6
    proposals_from: int = 40
    recent_scans: int = 20


INTERMEDIATE = IntermediateOptions()


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


class RecentScans:
    """The scans since the last look, and of the looks before as far as these are too few.

    Args:
        min_scans: How many are enough.
    """

    def __init__(self, min_scans: int) -> None:
        self._min_scans = min_scans
        self._looks: deque[list[tuple[Scan, Pose2D]]] = deque([[]])

    def add(self, scan: Scan, pose: Pose2D) -> None:
        """Add a scan or a piece of one.

        Args:
            scan: The scan or piece.
            pose: The laser's pose.
        """
        self._looks[-1].append((scan, pose))

    def pieces(self) -> list[tuple[Scan, Pose2D]]:
        """Return the pieces of the recent scans; earlier ones are forgotten."""
        while len(self._looks) > 1 and self._count(1) >= self._min_scans:
            self._looks.popleft()
        return [piece for look in self._looks for piece in look]

    def end_look(self) -> None:
        """Count the scans that come as those of another look."""
        self.pieces()
        self._looks.append([])

    def _count(self, first: int) -> int:
        """Return the number of scans from a look on."""
        return sum(scan.first_beam == 0 for look in list(self._looks)[first:] for scan, _ in look)


class DetectionRefiner:
    """Fits detections to the rays of the scans, from a warm start where it was done before.

    Args:
        noise_std: The range noise (m); None to estimate it.
        frame_covariance_at: Returns the covariance (3, 3; m, rad) of the map frame's own pose, as it matters at a
            place x, y (m); it adds to that of each primitive there. None where it is exact.
        moved: Refines what moves by the scans since it did; None: all is taken to stand.
        refinement: Numeric parameters of the fits.
        options: How much work goes into detection before the last scan.
    """

    def __init__(
        self,
        noise_std: float | None,
        frame_covariance_at: Callable[[float, float], FloatArray | None],
        moved: MovedPrimitives | None = None,
        refinement: RefinementOptions = DEFAULTS,
        options: IntermediateOptions = INTERMEDIATE,
    ) -> None:
        self._scans = ScanSubset(options.scans)
        self._recent = RecentScans(options.recent_scans)
        self._moved = moved
        self._refinement = refinement
        self._options = options
        self._noise_std = noise_std
        self._frame_covariance_at = frame_covariance_at
        self._previous: tuple[Detections, float | None] | None = None
        self._kind_search_at = 0

    def add(self, scan: Scan, pose: Pose2D) -> None:
        """Add a scan, or a piece of one, for detections before the last scan.

        Args:
            scan: The scan or piece.
            pose: The laser's pose.
        """
        self._scans.add(scan, pose)
        if self._moved is not None:
            self._recent.add(scan, pose)

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
        from detect.refinement.surroundings.levels import MapLevels

        search_kinds = self._scans.total >= self._options.kind_search_growth * self._kind_search_at
        if search_kinds:
            self._kind_search_at = self._scans.total
        proposals = self._options.proposals if self._scans.total >= self._options.proposals_from else 0
        warm_start = None if search_kinds or self._previous is None else WarmStart(*self._previous)
        effort = Effort(warm_start, proposals, rounds=0)
        levels = MapLevels.of(grid, self._refinement)
        self._previous = self._refine(detections, grid, levels, self._scans.pieces(), effort)
        refined, noise_std = self._previous
        stands = WarmStart(refined, noise_std)
        refined = self._correct(refined, grid, levels, noise_std, self._scans.pieces, Effort(stands, rounds=0))
        self._recent.end_look()
        return self._with_frame_uncertainty(refined), noise_std

    def refine(
        self,
        detections: Detections,
        grid: OccupancyGrid,
        scans: Callable[[], Iterable[tuple[Scan, Pose2D]]],
        progress: Progress = no_progress,
    ) -> tuple[Detections, float | None]:
        """Refine detections with the rays of all scans.

        Args:
            detections: What the networks found.
            grid: The map that they found it in.
            scans: Returns the pieces of all scans, with the laser's poses, each time anew.
            progress: Called with how many candidates are refined, and how many there are.

        Returns:
            The refined detections and the range noise (m), None where no ray passes any of them.
        """
        from detect.refinement.refine import THOROUGH
        from detect.refinement.surroundings.levels import MapLevels

        levels = MapLevels.of(grid, self._refinement)
        refined, noise_std = self._refine(detections, grid, levels, scans(), THOROUGH, progress)
        refined = self._correct(refined, grid, levels, noise_std, scans, THOROUGH)
        return self._with_frame_uncertainty(refined), noise_std

    def _correct(
        self,
        detections: Detections,
        grid: OccupancyGrid,
        levels: MapLevels,
        noise_std: float | None,
        scans: Callable[[], Iterable[tuple[Scan, Pose2D]]],
        effort: Effort,
    ) -> Detections:
        """Refine by the scans since what the recent ones say has moved."""
        recent = self._recent.pieces()
        if self._moved is None or noise_std is None or not recent:
            return detections
        from replay.detection.moved_primitives import Look

        return self._moved.correct(
            Look(detections, grid, levels, noise_std, recent, self._scans.pieces()), scans, effort
        )

    def _refine(
        self,
        detections: Detections,
        grid: OccupancyGrid,
        levels: MapLevels,
        scans: Iterable[tuple[Scan, Pose2D]],
        effort: Effort,
        progress: Progress = no_progress,
    ) -> tuple[Detections, float | None]:
        # imported when it is needed: a replay without refinement starts faster
        from detect.refinement.refine import refine_detections

        return refine_detections(
            detections, scans, grid, self._noise_std, cores(), effort, self._refinement, levels, progress
        )

    def _with_frame_uncertainty(self, detections: Detections) -> Detections:
        """Add the uncertainty of the map frame's pose to that of the detections."""
        found, objects = [], []
        for detection in detections.found:
            covariance = self._frame_covariance_at(detection.primitive.x, detection.primitive.y)
            if covariance is not None and detection.std:
                found.append(add_frame_uncertainty(detection, covariance))
            else:
                found.append(detection)
        for thing in detections.objects:
            x, y = thing.outline.mean(axis=0).tolist()
            covariance = self._frame_covariance_at(x, y)
            objects.append(thing if covariance is None else _in_uncertain_frame(thing, covariance))
        return replace(detections, found=tuple(found), objects=tuple(objects))


def add_frame_uncertainty(detection: Detection, frame_covariance: FloatArray) -> Detection:
    """Add the uncertainty of the map frame's own pose to a refined primitive's.

    Both errors are taken as independent (see :func:`prim.se2.frame_covariances`).

    Args:
        detection: The refined primitive.
        frame_covariance: The covariance (3, 3; m, rad) of the frame's pose.

    Returns:
        The detection with the sum of both covariances.
    """
    assert detection.covariance is not None
    primitive = detection.primitive
    added = frame_covariances(frame_covariance, np.array([[primitive.x, primitive.y, 0.0]]))[0]
    pose = [0, 1, 2][: 2 + (primitive.theta is not None)]
    covariance = detection.covariance.copy()
    covariance[np.ix_(pose, pose)] += added[np.ix_(pose, pose)]
    std = dict(zip(primitive.kind.parameters, np.sqrt(np.diag(covariance)).tolist(), strict=True))
    return replace(detection, std=std, covariance=covariance)


def _in_uncertain_frame(thing: UnknownObject, frame_covariance: FloatArray) -> UnknownObject:
    """Add the uncertainty (3, 3; m, rad) of the map frame's own pose to that of an outline, across it."""
    places = np.column_stack([thing.outline, np.zeros(len(thing.outline))])
    added = frame_covariances(frame_covariance, places)[:, :2, :2]
    variance = float(added.trace(axis1=1, axis2=2).mean()) / 2  # of one direction, whichever the outline's is
    return replace(thing, std=math.hypot(thing.std, math.sqrt(variance)))
