"""Tracking: each scan is matched with a map of the last keyframes, from where odometry or constant velocity predict.

A search about the prediction comes first, then a fit. Where odometry and constant velocity predict different places,
both are tried, and the better score wins. What scores low is searched for further away. Then every scan is matched
again, with the keyframes before and after it, and, where loops were closed, with all that are near.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from prim import linear_algebra
from prim.arrays import FloatArray, Stamps
from prim.scan import PosedScan
from prim.se2 import compose_poses, path_length, relative_poses, wrap_angles
from replay.poses.loops.loop_closing import ClosedLoops, LoopCloser
from replay.poses.loops.loop_errors import LoopErrors
from replay.poses.loops.submaps import Keyframes
from replay.poses.odometry_errors import NO_ERRORS, OdometryErrors
from replay.poses.scan_registration import range_noise
from replay.poses.tracking.kernels import Window
from replay.poses.tracking.local_map import LocalMap, Match, joined
from replay.poses.tracking.options import DEFAULTS, TrackingOptions
from replay.poses.tracking.points import moved, scan_points, surfels, thinned
from replay.poses.tracking.track_errors import TrackErrors


@dataclass(frozen=True)
class ScanTrack:
    """The laser's poses at N scans, by matching each with those before it.

    Attributes:
        poses: (N, 3) x, y (m), heading (rad), in the frame of the first one.
        scores: (N,) how well each fits, from 0 to 1.
        keyframes: Indices of the scans that maps were made of.
        overruled: Indices of the scans at which odometry was not followed.
        broken: Indices of the scans that fit nowhere: a new map begins there, and what lies between is a guess.
        noise_std: The range noise (m).
        stands_still: Whether odometry stands still where the scans move.
        fits: Whether scans fit well, and none is lost.
        overrules: Whether these poses are better than the odometry's: that stands still, or was often not followed,
            and scans fit well.
        odometry_errors: What is wrong with the odometry all the time.
        errors: What is unsure about the poses; None where scans were not matched anew in the end.
        closed: The loops that were closed, and how many were rejected; None where none were searched for.
    """

    poses: FloatArray
    scores: FloatArray
    keyframes: tuple[int, ...]
    overruled: tuple[int, ...]
    broken: tuple[int, ...]
    noise_std: float
    stands_still: bool = False
    fits: bool = True
    overrules: bool = False
    odometry_errors: OdometryErrors = NO_ERRORS
    errors: TrackErrors | None = None
    closed: ClosedLoops | None = None


def track(
    scans: Sequence[PosedScan],
    odometry: FloatArray | None = None,
    settled_noise: float = math.inf,
    options: TrackingOptions = DEFAULTS,
) -> ScanTrack:
    """Find the laser's poses from scans.

    Args:
        scans: N scans of one laser, in the order of time.
        odometry: The laser's poses (N, 3) by odometry; None where there is none.
        settled_noise: All are matched anew in the end, with those before and after them, where their noise is less
            than this (m); loops are closed then.
        options: Windows, maps, limits.

    Returns:
        The track.
    """
    noise_std = range_noise([posed.scan for posed in scans])
    points = [scan_points(posed, noise_std, options.points) for posed in scans]
    stamps = np.array([posed.scan.stamp for posed in scans], dtype=np.int64)
    tracker = ScanTracker(points, stamps, odometry, options)
    tracker.run()
    if noise_std < settled_noise:
        tracker.settle()
        tracker.close_loops()
    stands_still = odometry is not None and _stands_still(odometry, tracker.poses, options)
    is_wrong = stands_still or len(tracker.overruled) > options.overruled_share * len(scans)
    fits = not tracker.broken and float(np.median(tracker.scores)) > options.sure_score
    return ScanTrack(
        tracker.poses,
        tracker.scores,
        tuple(tracker.keyframes),
        tuple(tracker.overruled),
        tuple(tracker.broken),
        noise_std,
        stands_still,
        fits,
        is_wrong and fits,
        errors=tracker.errors() if noise_std < settled_noise else None,
        closed=tracker.closed,
    )


def _stands_still(odometry: FloatArray, poses: FloatArray, options: TrackingOptions) -> bool:
    """Tell whether odometry stands still where tracked poses move."""
    tracked = path_length(poses)
    return tracked > options.least_path and path_length(odometry) < options.least_share * tracked


class _Prediction(NamedTuple):
    """Where a scan is expected: its pose (3,), standard deviations (m, rad), and how far to search (m, rad)."""

    pose: FloatArray
    std: tuple[float, float]
    window: tuple[float, float]

    @property
    def information(self) -> FloatArray:
        """The information (3, 3) of a Gaussian prior."""
        place, turn = self.std
        return np.diag([place**-2, place**-2, turn**-2])


@dataclass
class ScanTracker:
    """The implementation and state of :func:`track`.

    Attributes:
        points: The points (M, 4) of each scan.
        stamps: (N,) ns.
        odometry: (N, 3); None for none.
        options: Windows, maps, limits.
        poses: (N, 3), as far as they are found.
        scores: (N,).
        keyframes: Scans that maps are made of.
        overruled: Scans at which odometry was not followed.
        broken: Scans that fit nowhere.
        searched: Scans that were found by a wide search.
        closed: The loops that were closed, and how many were rejected; None before they are searched for.
    """

    points: Sequence[FloatArray]
    stamps: Stamps
    odometry: FloatArray | None
    options: TrackingOptions = DEFAULTS
    poses: FloatArray = field(init=False)
    scores: FloatArray = field(init=False)
    keyframes: list[int] = field(default_factory=lambda: [0])
    overruled: list[int] = field(default_factory=list)
    broken: list[int] = field(default_factory=list)
    searched: list[int] = field(default_factory=list)
    closed: ClosedLoops | None = None
    _map: LocalMap | None = None
    _first: int = 0

    def __post_init__(self) -> None:
        count, places = len(self.points), self.options.points
        self.poses, self.scores = np.zeros((count, 3)), np.ones(count)
        self._matches: dict[int, Match] = {}
        self._coarse = [thinned(points, places.coarse) for points in self.points]
        self._fine = [thinned(points, places.fine) for points in self.points]

    def run(self) -> None:
        """ScanTrack all scans."""
        for number in range(1, len(self.points)):
            local = self._local_map()
            if local is None or not len(self.points[number]):
                self.poses[number] = self._predictions(number)[0].pose
                self.scores[number] = 0.0
            else:
                self._place(number, local)
            if self._is_far(number) or self.broken[-1:] == [number]:
                self.keyframes.append(number)
                self._map = None

    def settle(self) -> None:
        """Match all scans anew, some times, with the keyframes before and after them and, by loops, near them."""
        starts = [0, *(self.keyframes.index(number) for number in self.broken)]
        pieces = list(zip(starts, [*starts[1:], len(self.keyframes)], strict=True))  # what is lost begins anew
        for _ in range(self.options.settled_rounds if self._is_open else self.options.closed_rounds):
            settled = self.poses.copy()
            for start, stop in pieces:
                for first in range(start, stop, self.options.block):
                    self._settle_block(first, range(start, stop), settled)
            self.poses = self._seen_from_first(settled)

    def _settle_block(self, first: int, piece: range, settled: FloatArray) -> None:
        """Match the scans that follow some keyframes with a map of these and of those around them in their piece."""
        options, frames = self.options, self.keyframes
        after = min(first + options.block, piece.stop)
        around = [frames[number] for number in self._around(range(first, after), piece)]
        begin, end = frames[first], frames[after] if after < len(frames) else len(self.points)
        points = surfels(joined([moved(self._fine[one], self.poses[one]) for one in around]), options.surfel)
        if not len(points):
            return
        local = LocalMap(points, options.map)
        place, turn = options.settled_std if self._is_open else options.closed_std
        prior = np.diag([place**-2, place**-2, turn**-2])
        for number in range(begin, end):
            if len(self.points[number]):
                match = local.match(self.points[number], self.poses[number], None, prior)
                settled[number], self.scores[number] = match.pose, match.score
                self._matches[number] = match

    def _around(self, block: range, piece: range) -> list[int]:
        """Return the keyframes that some are matched with: those around them in time and, by loops, in place."""
        options = self.options
        before, after = block.start - options.keyframes, block.stop + options.keyframes
        last = range(max(before, piece.start), min(after, piece.stop))
        if self.closed is None or self._is_open:
            return list(last)
        poses = self.poses[self.keyframes]
        away = np.hypot(*(poses[:, :2] - poses[block].mean(axis=0)[:2]).T)
        away[self.closed.connected != self.closed.connected[block.start]] = np.inf
        nearest = np.argsort(away, kind="stable")[: options.most_near]
        return sorted({*last, *nearest[away[nearest] < options.near].tolist()})

    @property
    def _is_open(self) -> bool:
        """Whether no loop was closed so far."""
        return self.closed is None or not self.closed.loops

    def close_loops(self) -> None:
        """Find loops among the keyframes; where there are some, move all scans with these, and match them anew."""
        self.closed = LoopCloser(self._keyframes()).run()
        if self.closed.loops:
            self._follow(self.closed.poses)
            self.settle()

    def _keyframes(self) -> Keyframes:
        """Return what loops are searched in."""
        frames = np.array(self.keyframes)
        reached = np.searchsorted(frames, [*self.overruled, *self.searched])
        unsure = np.zeros(len(frames), bool)
        unsure[reached[reached < len(frames)]] = True
        nothing = np.zeros((3, 3))
        information = [self._matches[one].information if one in self._matches else nothing for one in self.keyframes]
        odometry = None if self.odometry is None else self.odometry[frames]
        points, poses = [self._fine[one] for one in self.keyframes], self.poses[frames]
        return Keyframes(points, poses, np.array(information), odometry, np.isin(frames, self.broken), unsure)

    def _follow(self, poses: FloatArray) -> None:
        """Move all scans with the keyframes before and after them (K, 3)."""
        frames = np.array(self.keyframes)
        before = np.searchsorted(frames, np.arange(len(self.poses)), side="right") - 1
        after = np.minimum(before + 1, len(frames) - 1)
        after = np.where(np.isin(frames[after], self.broken), before, after)
        share = (np.arange(len(self.poses)) - frames[before]) / np.maximum(frames[after] - frames[before], 1)
        by_before, by_after = (
            compose_poses(poses[by], relative_poses(self.poses[frames[by]], self.poses)) for by in (before, after)
        )
        change = by_after - by_before
        change[:, 2] = wrap_angles(change[:, 2])
        self.poses = by_before + share[:, None] * change

    def _covariance(self, match: Match) -> FloatArray:
        """Return the covariance (3, 3) of a match within its map: that of residuals, and what these do not show."""
        options = self.options
        residual = max(match.spread, options.points.least_noise)
        place, turn = options.least_std
        information = match.information * (options.map.residual / residual) ** 2 + np.eye(3) / options.widest**2
        covariance = linear_algebra.inverse(information)
        least = np.diag([place**2, place**2, turn**2])
        return least if covariance is None else covariance + least

    def errors(self) -> TrackErrors:
        """Return what is unsure about the settled poses."""
        options, covariances = self.options, np.zeros((len(self.points), 3, 3))
        for number, match in self._matches.items():
            covariances[number] = self._covariance(match)
        if self.closed is not None and self.closed.loops:
            return LoopErrors.by_graph(self.poses, covariances, self.keyframes, self.closed.graph, options.first_std)
        return TrackErrors.of(self.poses, covariances, self.keyframes, self.broken, options.widest, options.first_std)

    def _seen_from_first(self, poses: FloatArray) -> FloatArray:
        """Return poses in the frame of the first one."""
        seen = relative_poses(np.repeat(poses[:1], len(poses), axis=0), poses)
        seen[:, 2] = wrap_angles(seen[:, 2])
        return seen

    def _local_map(self) -> LocalMap | None:
        """Return the map of the last keyframes; None where they have no points."""
        if self._map is None:
            last = self.keyframes[self._first :][-self.options.keyframes :]
            scans = [self._fine[one] for one in last[:-1]] + [self.points[last[-1]]]
            points = joined([moved(scan, self.poses[one]) for one, scan in zip(last, scans, strict=True)])
            self._map = LocalMap(points, self.options.map) if len(points) else None
        return self._map

    def _place(self, number: int, local: LocalMap) -> None:
        """Find the pose of a scan in the map of the last keyframes."""
        options = self.options
        predictions = self._predictions(number)
        matches = [self._match(number, one, local, options.map.levels) for one in predictions[:1]]
        if len(predictions) > 1 and self._differ(*predictions):
            matches.append(self._match(number, predictions[1], local, options.map.levels))
        best = matches[0]
        if matches[-1].score > best.score + options.min_gain:
            best = matches[-1]
        if best.score < options.lost:
            wide = self._wide_match(number, predictions, local)
            if wide is not None and wide.score > best.score + options.min_gain:
                best = wide
                self.searched.append(number)
        if best.score < options.broken:
            self.broken.append(number)
            self._first = len(self.keyframes)
            self.poses[number], self.scores[number] = predictions[0].pose, best.score
            return
        self.poses[number], self.scores[number] = best.pose, best.score
        self._matches[number] = best
        if self.odometry is not None and self._is_outside(best.pose, predictions[0]):
            self.overruled.append(number)

    def _match(self, number: int, prediction: _Prediction, local: LocalMap, levels: int) -> Match:
        """Search around a prediction, and fit from what is found."""
        place, turn = prediction.std
        least_place, least_turn = self.options.least_window
        charge = self.options.charge
        cost = charge / max(place, least_place / 2), charge / max(turn, least_turn)
        window = Window(*prediction.window, self.options.map.turn, *cost)
        found = local.search(self._coarse[number], prediction.pose, window, levels)
        start = prediction.pose if found is None else found
        return local.match(self.points[number], start, prediction.pose, prediction.information)

    def _wide_match(self, number: int, predictions: Sequence[_Prediction], local: LocalMap) -> Match | None:
        """Search further away for a scan that fits nowhere near; None where nothing is found."""
        options = self.options
        reach, turn = options.wide_window
        gap = (self.stamps[number] - self.stamps[number - 1]) / 1e9
        reach = min(reach + options.speed * gap, options.widest)
        turn = math.pi if gap > options.longest_step else turn
        window = Window(reach, turn, options.map.turn, options.wide_charge, options.wide_charge)
        matches = []
        for middle in [one.pose for one in predictions] + [self.poses[number - 1]]:
            found = local.search(self._coarse[number], middle, window, options.map.wide_levels, options.broken / 2)
            if found is not None:
                matches.append(local.match(self.points[number], found))
        return max(matches, key=lambda match: match.score, default=None)

    def _predictions(self, number: int) -> list[_Prediction]:
        """Return where odometry and constant velocity expect a scan, the more trusted one first."""
        options = self.options
        gap = max((self.stamps[number] - self.stamps[number - 1]) / 1e9, options.least_gap)
        last = self.poses[number - 1 : number]
        stretch = min(max(gap / options.usual_gap, 1.0), options.most_stretch)
        before = (self.stamps[number - 1] - self.stamps[number - 2]) / 1e9 if number > 1 else 0.0
        step = np.zeros((1, 3))
        if before > 0 and gap < options.longest_step:
            step = relative_poses(self.poses[number - 2 : number - 1], last) * min(gap / before, options.most_stretch)
        place, turn = (stretch * std for std in options.velocity_std)
        reach, around = options.velocity_window
        reach = min(max(reach, options.speed * gap / 2), options.longest_reach)
        window = reach, min(around * stretch, options.wide_window[1])
        by_velocity = _Prediction(compose_poses(last, step)[0], (place, turn), window)
        if self.odometry is None:
            return [by_velocity]
        step = relative_poses(self.odometry[number - 1 : number], self.odometry[number : number + 1])
        distance, angle = math.hypot(*step[0, :2]), abs(wrap_angles(step[:, 2])[0])
        constant, share = options.odometry_std
        turn_constant, turn_share, per_metre = options.odometry_turn_std
        place, turn = constant + share * distance, turn_constant + turn_share * angle + per_metre * distance
        least_place, least_turn = options.least_window
        window = max(least_place, options.deviations * place), max(least_turn, options.deviations * turn)
        return [_Prediction(compose_poses(last, step)[0], (place, turn), window), by_velocity]

    def _differ(self, first: _Prediction, second: _Prediction) -> bool:
        """Tell whether two predictions are so far apart that a search about the first may miss the second."""
        apart = second.pose - first.pose
        place, turn = (self.options.different * size for size in first.window)
        return bool(math.hypot(*apart[:2]) > place or abs(wrap_angles(apart[2:])[0]) > turn)

    def _is_outside(self, pose: FloatArray, prediction: _Prediction) -> bool:
        """Tell whether a pose is further from a prediction than that allows."""
        apart = pose - prediction.pose
        place, turn = prediction.window
        return bool(math.hypot(*apart[:2]) > place or abs(wrap_angles(apart[2:])[0]) > turn)

    def _is_far(self, number: int) -> bool:
        """Tell whether a scan was taken so far from the last keyframe that it becomes one."""
        last = self.keyframes[-1]
        apart = relative_poses(self.poses[last : last + 1], self.poses[number : number + 1])[0]
        turn = abs(wrap_angles(apart[2:])[0])
        return bool(math.hypot(*apart[:2]) > self.options.keyframe_distance or turn > self.options.keyframe_turn)
