"""Primitives in a replay: which map the detector looks at, what it finds, and how right that is."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from mapping.forward.mapper import cores
from mapping.grid import OccupancyGrid
from mapping.mapper import Mapper
from prim.arrays import FloatArray
from prim.metrics import DetectionErrors, detection_errors
from prim.scan import Scan
from prim.se2 import Pose2D
from prim.shapes import Primitive
from replay.ground_truth import Truth

if TYPE_CHECKING:
    from detect.detection import Detections
    from detect.detector import Detector
    from detect.tracker import Tracker

SCANS_ON_THE_WAY = 30
"""A look on the way is refined by so many of the scans to twice as many, evenly spread."""

ASKED_AGAIN = 4
"""On the way, what was sure of its kind is asked for it again when there are so many times as many scans."""

PROPOSED, PROPOSED_FROM = 6, 40
"""On the way, what the networks missed is looked for in so many things of the map, from so many scans on: maps of few
scans are full of what might be one.
"""


@dataclass(frozen=True)
class Identity:
    """Which track a detection belongs to; ``std`` (m, rad) is the track's, by name, where looks were many."""

    id: int
    confirmed: bool = True
    std: Mapping[str, float] | None = None


@dataclass(frozen=True)
class Sighting:
    """What was found in a map, each with its identity; where there is a truth, how it compares with that.

    ``noise_std`` (m) is the range noise that refinement reckoned with; None where nothing was refined.
    """

    detections: Detections
    identities: tuple[Identity, ...]
    noise_std: float | None = None
    truth: tuple[Primitive, ...] = ()
    errors: DetectionErrors | None = None


class Lookout:
    """Looks for primitives with a detector: in the replay's map, or in one of its own where cells differ.

    ``own`` is a mapper with cells of the size that the detector reads; None where the replay's own map has them.
    With ``tracker``, for a detector that looks more than once, what is found keeps its id. With ``refines``, what is
    found is fitted to the rays, whose noise is ``noise_std`` (m) where it is known; ``frame_covariance`` (3, 3) says
    how unsure the map's own place is, which adds to what is told of each primitive's.
    """

    def __init__(
        self,
        detector: Detector,
        own: Mapper | None,
        truth: Truth | None,
        tracker: Tracker | None = None,
        refines: bool = False,
        noise_std: float | None = None,
        frame_covariance: FloatArray | None = None,
    ) -> None:
        self._detector = detector
        self._tracker = tracker
        self._own = own
        self._truth = truth
        self._noise_std = noise_std
        self._frame_covariance = frame_covariance
        self._scans: list[list[tuple[Scan, Pose2D]]] = []
        self._keeps = False
        self._before: tuple[Detections, float | None] | None = None
        self._count, self._stride = 0, 1
        self._searched_at = 0
        self.refines = refines

    def keep(self, scan: Scan, pose: Pose2D) -> None:
        """Adds a scan to the detector's own map, for a look at the end."""
        if self._own is not None:
            self._own.keep(scan, pose)

    def update(self, scan: Scan, pose: Pose2D) -> None:
        """Adds a scan to the detector's own map, for looks on the way."""
        if self.refines:
            self._keep_some(scan, pose)
        if self._own is not None:
            self._own.update(scan, pose)

    def _keep_some(self, scan: Scan, pose: Pose2D) -> None:
        """Keeps scans for looks on the way, evenly spread: every other one goes where they become too many."""
        if scan.first_beam:
            if self._keeps:
                self._scans[-1].append((scan, pose))
            return
        self._keeps = self._count % self._stride == 0
        if self._keeps:
            self._scans.append([(scan, pose)])
        self._count += 1
        if len(self._scans) >= 2 * SCANS_ON_THE_WAY:
            self._scans = self._scans[::2]
            self._stride *= 2

    def map_so_far(self, mapper: Mapper) -> OccupancyGrid:
        """The map that the detector looks at on the way."""
        return (self._own or mapper).grid()

    def last_map(self, grid: OccupancyGrid) -> OccupancyGrid:
        """The map that the detector looks at in the end, where the replay's own is ``grid``."""
        return grid if self._own is None else self._own.finish()

    def detect(self, grid: OccupancyGrid) -> Detections:
        """What the networks find in a map."""
        return self._detector.detect(grid)

    def refine(
        self, detections: Detections, grid: OccupancyGrid, scans: Iterable[tuple[Scan, Pose2D]] | None = None
    ) -> tuple[Detections, float | None]:
        """Detections fitted to the rays of all ``scans``, or of those so far; and the noise (m) of these rays.

        On the way some of the scans do, and what was sure of its kind at the last look is asked for it again only
        when there are ASKED_AGAIN times as many scans as when it was asked last.
        """
        from detect.refinement.refine import (  # when it is needed: a replay without it starts faster
            Pace,
            refine_detections,
        )

        if scans is not None:
            refined, noise_std = refine_detections(detections, scans, grid, self._noise_std, cores())
            return self._in_unsure_frame(refined), noise_std
        anew = self._count >= ASKED_AGAIN * self._searched_at
        if anew:
            self._searched_at = self._count
        some = [part for scan in self._scans for part in scan]
        most = PROPOSED if self._count >= PROPOSED_FROM else 0
        pace = Pace(None if anew else self._before, most, rounds=0)
        refined, noise_std = refine_detections(detections, some, grid, self._noise_std, cores(), pace)
        self._before = refined, noise_std
        return self._in_unsure_frame(refined), noise_std

    def _in_unsure_frame(self, detections: Detections) -> Detections:
        """Detections with what is told of their place and angle as unsure as the map's frame makes it."""
        if self._frame_covariance is None:
            return detections
        found = tuple(
            one
            if one.std is None
            else replace(one, std=spread_by_frame(one.primitive, one.std, self._frame_covariance))
            for one in detections.found
        )
        return replace(detections, found=found)

    def sighting(self, detections: Detections, stamp: int, noise_std: float | None = None) -> Sighting:
        """Detections with their identities, held against the truth at ``stamp`` (ns) where there is one."""
        identities = self._identities(detections)
        if self._truth is None:
            return Sighting(detections, identities, noise_std)
        true = tuple(self._truth.at(stamp).primitives)
        errors = detection_errors([one.primitive for one in detections.found], true)
        return Sighting(detections, identities, noise_std, true, errors)

    def _identities(self, detections: Detections) -> tuple[Identity, ...]:
        """The detections' tracks; one after the other where there is one look only."""
        if self._tracker is None:
            return tuple(Identity(number) for number in range(1, len(detections.found) + 1))
        tracks = self._tracker.update(detections.found)
        return tuple(Identity(track.id, track.confirmed, track.std) for track in tracks)


def spread_by_frame(primitive: Primitive, std: Mapping[str, float], covariance: FloatArray) -> dict[str, float]:
    """Standard deviations (m, rad, by name) of a primitive in a frame whose own place has a ``covariance`` (3, 3)."""
    moved = np.array([[1, 0, -primitive.y], [0, 1, primitive.x], [0, 0, 1]])
    added = dict(zip(("x", "y", "theta"), np.diag(moved @ covariance @ moved.T).tolist(), strict=True))
    return {name: math.sqrt(value**2 + added.get(name, 0.0)) for name, value in std.items()}
