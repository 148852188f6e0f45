"""Primitives that moved while a log was recorded: refined by the scans since they stand where they stand now.

The map of all scans, and fits to all rays, mix the places of a primitive that was pushed. At every look the recent
scans judge what was refined by all of them (:func:`detect.refinement.standing.judge_places`). Where they contradict
some of it, primitives are detected in a map of the recent scans, too, and refined by these. The first ones count only
if the older scans contradict them in turn: they were not there before. From then on these are refined by the scans
since, as long as later scans agree. Objects of no kind stay, but for those where something that moved stands now. The
error bars of all are widened where the later ones of the scans that they are fitted to disagree
(:func:`replay.detection.mixed_places.add_disagreement`). Where nothing moves, nothing changes.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from detect.detection import Detection, Detections, Rejection, SensorErrors, UnknownObject
from detect.refinement.options import DEFAULTS as REFINEMENT
from detect.refinement.options import RefinementOptions
from detect.refinement.refine import Effort, WarmStart, refine_detections
from detect.refinement.standing import Judgement, Verdict, judge_places
from detect.refinement.surroundings.levels import MapLevels
from mapping.grid import UNKNOWN, OccupancyGrid
from prim.metrics import outline_overlap, overlap_coefficient
from prim.scan import Scan
from prim.se2 import Pose2D
from prim.threads import cores
from replay.detection.mixed_places import add_disagreement

Pieces = Sequence[tuple[Scan, Pose2D]]
"""Scans, or their pieces, with the laser's poses."""


@dataclass(frozen=True)
class MovedOptions:
    """How far errors of poses reach, and what is one primitive; set by hand.

    Attributes:
        pose_deviations: The errors of poses are within so many standard deviations …
        pose_distance: … those of headings as they matter at this distance from the laser (m).
        max_shared: Of two detections that share more of the smaller one's area, one is wrong.
        looks: For so many looks the recent scans are searched for what was found, and by all scans is no more.
        min_shift: What all scans tell to be of no kind has moved where the scans before say that it was elsewhere by
            more than this (m), or not there: a wrong shape looks shifted by less.
    """

    pose_deviations: float = 4.0
    pose_distance: float = 2.0
    max_shared: float = 0.25
    looks: int = 3
    min_shift: float = 0.03


DEFAULTS = MovedOptions()


@dataclass(frozen=True)
class Look:
    """What is known at a look.

    Attributes:
        detections: What was refined by all scans so far.
        grid: Their map.
        levels: The map as refinement takes it.
        noise_std: The range noise (m).
        recent: The pieces of the recent scans.
        scans: The pieces of a subset of all scans.
    """

    detections: Detections
    grid: OccupancyGrid
    levels: MapLevels
    noise_std: float
    recent: Pieces
    scans: Pieces

    @property
    def since(self) -> int:
        """The stamp (ns) of the first recent scan."""
        return self.recent[0][0].stamp


class MovedPrimitives:
    """The primitives that moved, as far as is known.

    Args:
        make_map: Makes a map of some scans, in the frame of the detector's map.
        detect: Detects primitives in a map.
        pose_std: Standard deviations of the poses' positions (m) and headings (rad).
        refinement: Numeric parameters of the fits.
        options: Those of what moves.
    """

    def __init__(
        self,
        make_map: Callable[[Pieces], OccupancyGrid],
        detect: Callable[[OccupancyGrid], Detections],
        pose_std: tuple[float, float],
        refinement: RefinementOptions = REFINEMENT,
        options: MovedOptions = DEFAULTS,
    ) -> None:
        self._make_map = make_map
        self._detect = detect
        position, heading = pose_std
        self._slack = options.pose_deviations * math.hypot(position, heading * options.pose_distance)
        self._refinement = refinement
        self._options = options
        self._moved: tuple[Detection, ...] = ()
        self._sensor_errors: SensorErrors | None = None
        self._lost: list[tuple[Detection, int]] = []  # and for how many looks

    def correct(self, look: Look, scans: Callable[[], Iterable[tuple[Scan, Pose2D]]], effort: Effort) -> Detections:
        """Replace what recent scans contradict by what they show.

        Args:
            look: What is known.
            scans: Returns the scans by which primitives that moved are refined, those since they did.
            effort: How thoroughly they are refined. Given a warm start, what stands is one.

        Returns:
            The detections as the recent scans have them; the same ones where these contradict nothing.
        """
        found, self._sensor_errors = look.detections.found, look.detections.sensor
        judged = self._judge(found, look.recent, look.levels, look.noise_std)
        stands = [d for d, judgement in zip(found, judged, strict=True) if judgement.verdict is Verdict.STANDS]
        self._moved = tuple(moved for moved in self._moved if not self._stood_always(moved, stands, look))
        if not (self._has_lost(found) or self._moved) and len(stands) == len(found):
            return look.detections
        pieces = list(scans())
        self._moved = self._without_things(self._refine_moved(look, judged, stands, pieces, effort), look)
        if not self._moved:
            return look.detections
        gone = [judgement.verdict is Verdict.GONE for judgement in judged]
        keeps = [not away and not self._shares(d, self._moved) for d, away in zip(found, gone, strict=True)]
        kept = [d for d, keep in zip(found, keeps, strict=True) if keep]
        dropped = [_rejection(d) for d, keep in zip(found, keeps, strict=True) if not keep]
        honest = [
            add_disagreement(
                detection,
                pieces,
                look.levels,
                look.noise_std,
                self._slack,
                sensor_errors=look.detections.sensor,
            )
            for detection in (*kept, *self._moved)
        ]
        answer = sorted(honest, key=lambda detection: -detection.score)
        return replace(
            look.detections,
            found=tuple(answer),
            rejected=tuple(_by_score([*look.detections.rejected, *dropped])),
            objects=tuple(thing for thing in look.detections.objects if not self._is_replaced(thing)),
        )

    def _has_lost(self, found: Sequence[Detection]) -> bool:
        """Return whether something was found at one of the last looks, and by the rays of all scans is no more.

        A primitive that was pushed is none of the kinds to scans that show it in two places.
        """
        lost = [(known, looks + 1) for known, looks in self._lost if not self._shares(known, found)]
        self._lost = [(known, 0) for known in found] + [pair for pair in lost if pair[1] <= self._options.looks]
        return len(self._lost) > len(found)

    def _without_things(self, moved: Sequence[Detection], look: Look) -> tuple[Detection, ...]:
        """Leave out what is an object of no kind by all scans, and stood there before the recent ones too."""
        limit, things = self._options.max_shared, look.detections.objects

        def stood(detection: Detection) -> bool:
            """Return whether the scans before it came have it there, where an object of no kind is."""
            outline, since = detection.primitive.outline(), detection.since or look.since
            if not any(outline_overlap(thing.outline, outline) > limit for thing in things):
                return False
            older = [piece for piece in look.scans if piece[0].stamp < since]
            earliest = older[: max(len(older) // 6, 1)]  # later ones may have come after it did
            (judgement,) = self._judge([detection], earliest, look.levels, look.noise_std)
            is_known = judgement.is_seen or judgement.verdict is Verdict.MOVED
            return is_known and not self._is_away(detection, judgement)

        return tuple(detection for detection in moved if not stood(detection))

    def _is_away(self, detection: Detection, judgement: Judgement) -> bool:
        """Return whether scans say that something is not there, or shifted by more than a wrong shape seems to be."""
        before, after = detection.primitive, judgement.nearby
        shift = math.hypot(after.x - before.x, after.y - before.y)
        is_shifted = judgement.verdict is Verdict.MOVED and shift > self._options.min_shift
        return judgement.verdict is Verdict.GONE or is_shifted

    def _is_replaced(self, thing: UnknownObject) -> bool:
        """Return whether an object of no kind, by the rays of all scans, shares too much with what moved."""
        limit = self._options.max_shared
        return any(outline_overlap(thing.outline, moved.primitive.outline()) > limit for moved in self._moved)

    def _stood_always(self, moved: Detection, stands: Sequence[Detection], look: Look) -> bool:
        """Return whether what was refined by all scans in the place of something that moved stood there all along."""
        rivals = [detection for detection in stands if self._shares(detection, [moved])]
        since = moved.since or look.since
        older = [piece for piece in look.scans if piece[0].stamp < since]
        later = [piece for piece in look.scans if piece[0].stamp >= since]
        before, after = (self._judge(rivals, scans, look.levels, look.noise_std) for scans in (older, later))
        return any(first.is_seen and second.is_seen for first, second in zip(before, after, strict=True))

    def _refine_moved(
        self,
        look: Look,
        judged: Sequence[Judgement],
        stands: Sequence[Detection],
        scans: Pieces,
        effort: Effort,
    ) -> tuple[Detection, ...]:
        """Return the primitives that moved, each refined by the scans since."""
        recent_map = self._make_map(look.recent)
        grid = overlay(look.grid, recent_map)
        recent = self._without_overlaps([*self._detect(recent_map).found, *self._detect(grid).found], [])
        nearby = _moved_nearby(look.detections.found, judged)
        if effort.warm_start is not None:
            effort = replace(effort, warm_start=WarmStart(_since(stands, look.since), look.noise_std))
        effort = replace(effort, since=look.since)
        new = _since(self._without_overlaps([*recent, *nearby], self._moved), look.since).found
        pieces = scans if self._moved else look.recent
        refined = self._refine([*self._moved, *new], look, grid, pieces, effort)
        levels = MapLevels.of(grid, self._refinement)
        again = self._judge(refined, look.recent, levels, look.noise_std)
        contradicted = [judgement.verdict is not Verdict.STANDS for judgement in again]
        lost = [d.since != look.since and wrong for d, wrong in zip(refined, contradicted, strict=True)]
        if any(lost):
            kept = [d for d, away in zip(refined, lost, strict=True) if not away]
            new = _since(self._without_overlaps([*recent, *_moved_nearby(refined, again)], kept), look.since).found
            refined = self._refine([*kept, *new], look, grid, pieces, effort)
        refined += self._still_standing(refined, look, levels)
        known = [d for d in stands if not self._shares(d, self._moved)]
        arrived = [d for d in refined if not self._shares(d, known)]
        return tuple(arrived if self._moved else self._not_there_before(arrived, look, levels))

    def _still_standing(self, refined: Sequence[Detection], look: Look, levels: MapLevels) -> list[Detection]:
        """Return what moved before and is too little seen now to be refined, as it was, if nothing contradicts it."""
        unseen = self._without_overlaps(self._moved, refined)
        judged = self._judge(unseen, look.recent, levels, look.noise_std)
        return [d for d, judgement in zip(unseen, judged, strict=True) if judgement.verdict is Verdict.STANDS]

    def _not_there_before(self, arrived: list[Detection], look: Look, levels: MapLevels) -> list[Detection]:
        """Return those that the scans before the recent ones contradict."""
        older = [piece for piece in look.scans if piece[0].stamp < look.since]
        judged = self._judge(arrived, older, levels, look.noise_std)
        return [d for d, judgement in zip(arrived, judged, strict=True) if judgement.verdict is not Verdict.STANDS]

    def _refine(
        self, wanted: Sequence[Detection], look: Look, grid: OccupancyGrid, scans: Pieces, effort: Effort
    ) -> list[Detection]:
        """Refine detections, each by the scans since its own stamp; return those that the rays support."""
        first = min([look.since, *(d.since for d in wanted if d.since is not None)])
        later = [piece for piece in scans if piece[0].stamp >= first]
        candidates = Detections(tuple(wanted), ())
        refined, _ = refine_detections(candidates, later, grid, look.noise_std, cores(), effort, self._refinement)
        return list(refined.found)

    def _judge(
        self, detections: Sequence[Detection], scans: Pieces, levels: MapLevels, noise_std: float
    ) -> list[Judgement]:
        limits, errors = self._refinement.standing, self._sensor_errors
        return judge_places(detections, scans, levels, noise_std, cores(), self._slack, limits, errors)

    def _without_overlaps(self, detections: Sequence[Detection], others: Sequence[Detection]) -> list[Detection]:
        """Return those that overlap none of some others, and none before them."""
        kept: list[Detection] = []
        for detection in detections:
            if not self._shares(detection, [*others, *kept]):
                kept.append(detection)
        return kept

    def _shares(self, detection: Detection, others: Sequence[Detection]) -> bool:
        """Return whether a detection's outline shares too much with one of some others."""
        limit = self._options.max_shared
        return any(overlap_coefficient(detection.primitive, other.primitive) > limit for other in others)


def overlay(grid: OccupancyGrid, recent: OccupancyGrid) -> OccupancyGrid:
    """Lay a map of recent scans over that of all: where these saw a cell, they have the last word.

    Args:
        grid: The map of all scans.
        recent: The map of the recent ones, in the same frame.

    Returns:
        The map.
    """
    seen = recent.probability != UNKNOWN
    visits = grid.visits
    if visits is not None and recent.visits is not None:
        visits = np.where(seen, recent.visits, visits)
    return replace(grid, probability=np.where(seen, recent.probability, grid.probability), visits=visits)


def _moved_nearby(detections: Sequence[Detection], judged: Sequence[Judgement]) -> list[Detection]:
    """Return those that were moved, where they were moved to."""
    return [
        replace(detection, primitive=judgement.nearby)
        for detection, judgement in zip(detections, judged, strict=True)
        if judgement.verdict is Verdict.MOVED
    ]


def _since(detections: Sequence[Detection], stamp: int) -> Detections:
    """Return detections as those of the scans from a stamp (ns) on."""
    return Detections(tuple(replace(detection, since=stamp) for detection in detections), ())


def _by_score(rejections: list[Rejection]) -> list[Rejection]:
    return sorted(rejections, key=lambda rejection: -rejection.score)


def _rejection(detection: Detection) -> Rejection:
    primitive = detection.primitive
    reason = "the recent scans contradict it: it was moved"
    return Rejection(primitive.kind, detection.score, primitive.x, primitive.y, reason, detection)
