"""Poses from odometry, GPS and compass together: filtered forwards, smoothed backwards, and the noise found."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from prim.arrays import FloatArray, Stamps
from prim.se2 import Trajectory, wrap_angle, wrap_angles
from replay.poses.kalman import (
    BIAS,
    FIX_STD,
    GATES,
    HEADING_STD,
    METRES,
    RADIANS,
    REJECTED,
    USED,
    common,
    run,
    smooth,
)

LEVER = 0.03
"""A turn by one radian wears on the odometry as so many metres of way."""

STANDING = 4e-4
"""A second wears on the odometry as so many metres of way, whether the robot moves or not: by 1 mm, as a rule."""

DEFAULT_ODOMETRY = 0.05, math.radians(2)
"""Odometry's noise after one metre (m, rad), where a log tells nothing about it."""

DEFAULT_DRIFT = 0.1, math.radians(20)
"""How far a robot without odometry gets in one second (m, rad), as a random walk, where a log does not tell."""

START_READINGS = 20
"""The first so many fixes and headings tell where the filter begins."""

START_TURN = 0.5
"""How unsure (rad) the first heading is where a compass tells it; without one it is anywhere."""

ALIGNED = 5.0
"""The heading is read off the fixes as soon as they reach this many times as far as they scatter."""

PRIOR_SPREAD = 1.5
"""What is believed of each standard deviation before the log is seen: off by a factor e^1.5 either way."""

MOST_ROUNDS = 15
LEARNT = 1e-3
"""The noise is found when a round changes no logarithm by more."""

NUDGE, BIAS_NUDGE = 0.05, 0.005
"""Steps of the differences that derivatives are taken by: in logarithms, and in rad."""

MOST_NODES = 20_000
"""The noise is found from at most about so many nodes with readings, evenly spread."""

BIAS_SCORE = 12.0
"""A compass is taken to be biased where the likelihood says so: one in 2000 that are not (chi squared)."""

NO_GATES = np.full(2, np.inf)
"""Without odometry nothing tells a turn from a heading that is wrong."""

LEAST_STD, MOST_STD = 1e-5, 1e3


@dataclass(frozen=True)
class PoseNoise:
    """Standard deviations: of fixes (m) and headings (rad); of the odometry after a metre of way (m, rad).

    ``bias`` (rad) is what all headings are off by. Without odometry ``metres`` and ``radians`` are of a random walk
    in a second. None is to be found from the log.
    """

    fixes: float | None = None
    headings: float | None = None
    metres: float | None = None
    radians: float | None = None
    bias: float | None = None


@dataclass(frozen=True)
class Nodes:
    """The moments of a log that something is known or asked of, as :func:`replay.poses.kalman.run` takes them.

    ``start`` (3,) is where the odometry begins; ``moves`` whether there is any.
    """

    stamps: Stamps
    steps: FloatArray
    ways: FloatArray
    fixes: FloatArray
    headings: FloatArray
    lever: FloatArray
    start: FloatArray
    moves: bool

    @property
    def has_fixes(self) -> NDArray[np.bool_]:
        """At which nodes there is a fix."""
        return ~np.isnan(self.fixes[:, 0])

    @property
    def has_headings(self) -> NDArray[np.bool_]:
        """At which nodes there is a heading."""
        return ~np.isnan(self.headings)

    def part(self, begin: int, end: int | None) -> Nodes:
        """The nodes from ``begin`` to ``end``."""
        piece = slice(begin, end)
        return replace(
            self,
            stamps=self.stamps[piece],
            steps=self.steps[piece],
            ways=self.ways[piece],
            fixes=self.fixes[piece],
            headings=self.headings[piece],
        )

    def only(self, kept: NDArray[np.intp]) -> Nodes:
        """Some of the nodes (by rising index, the first one among them), with the steps between them."""
        walked = walk(self.steps)[kept]
        ways = np.diff(np.cumsum(self.ways)[kept], prepend=0.0)
        return replace(
            self,
            stamps=self.stamps[kept],
            steps=steps_between(walked),
            ways=ways,
            fixes=self.fixes[kept],
            headings=self.headings[kept],
        )


@dataclass(frozen=True)
class Estimate:
    """Poses (N, 3) at the nodes with covariances (N, 3, 3), and what was made of each sensor's readings.

    ``gains`` (N, 3, 3) tell how the errors of smoothed poses go together (see :func:`replay.poses.kalman.smooth`).
    """

    stamps: Stamps
    poses: FloatArray
    covariances: FloatArray
    noise: PoseNoise
    verdicts: NDArray[np.int64]
    gains: FloatArray | None = None

    def frame_covariance(self, stamps: Stamps) -> FloatArray:
        """How unsure the place of a map is that is made from the poses at ``stamps``: covariance (3, 3) of its x, y
        (m) and heading (rad) at its origin. Raises ValueError on poses that were not smoothed.
        """
        if self.gains is None:
            raise ValueError("only the errors of smoothed poses are known to go together")
        chosen = np.isin(self.stamps, stamps)
        found: FloatArray = common(self.poses, six_of(self.covariances), self.gains, chosen)
        return found

    def used(self, sensor: int) -> tuple[int, int]:
        """How many readings of GPS (0) or compass (1) were used, and how many were not."""
        column = self.verdicts[:, sensor]
        return int(np.count_nonzero(column == USED)), int(np.count_nonzero(column == REJECTED))


@dataclass(frozen=True)
class Filtered:
    """What the filter leaves: see :func:`replay.poses.kalman.run`."""

    states: FloatArray
    covs: FloatArray
    predicted: FloatArray
    predicted_covs: FloatArray
    costs: FloatArray
    verdicts: NDArray[np.int64]


def nodes_at(
    stamps: Stamps,
    odometry: Trajectory | None,
    fixes: tuple[Stamps, FloatArray] | None,
    headings: tuple[Stamps, FloatArray] | None,
    lever: tuple[float, float] = (0.0, 0.0),
) -> Nodes:
    """The nodes of a log: at ``stamps`` (N,) that poses are asked for, and at those of all fixes and headings.

    What lies outside the odometry's time is left out, and without odometry what lies outside the sensors'.
    Raises ValueError where nothing is left.
    """
    readings = [item[0] for item in (fixes, headings) if item is not None]
    known = [odometry.stamps] if odometry is not None else readings
    if not known:
        raise ValueError("there is no sensor at all")
    first, last = min(item[0] for item in known), max(item[-1] for item in known)
    every = np.unique(np.concatenate((stamps, *readings)))
    every = every[(every >= first) & (every <= last)]
    if not len(every):
        raise ValueError("nothing lies within the time of the sensors")
    start = np.zeros(3)
    if odometry is None:
        steps, ways = np.zeros((len(every), 3)), np.diff(every, prepend=every[0]) / 1e9
    else:
        walked, _ = odometry.at(every)
        start, steps = walked[0], steps_between(walked)
        ways = np.diff(np.interp(every, odometry.stamps, way_of(odometry)), prepend=0.0)
        ways[0] = 0.0
        ways += STANDING * np.diff(every, prepend=every[0]) / 1e9
    return Nodes(
        every,
        steps,
        ways,
        _placed(every, fixes, 2),
        _placed(every, headings, 1)[:, 0],
        np.array(lever),
        start,
        odometry is not None,
    )


def _placed(stamps: Stamps, readings: tuple[Stamps, FloatArray] | None, columns: int) -> FloatArray:
    """Readings (N, columns) at the nodes that they belong to; NaN elsewhere."""
    placed = np.full((len(stamps), columns), np.nan)
    if readings is not None:
        within = (readings[0] >= stamps[0]) & (readings[0] <= stamps[-1])
        placed[np.searchsorted(stamps, readings[0][within])] = readings[1].reshape(-1, columns)[within]
    return placed


def way_of(odometry: Trajectory) -> FloatArray:
    """How far the robot has gone at each pose (N,): the way of its centre, and LEVER for each radian of turning."""
    change = np.diff(odometry.poses, axis=0)
    way = np.hypot(change[:, 0], change[:, 1]) + LEVER * np.abs(wrap_angles(change[:, 2]))
    return np.concatenate(([0.0], np.cumsum(way)))


def steps_between(poses: FloatArray) -> FloatArray:
    """Each pose (N, 3) seen from the one before it; the first step is none."""
    change = np.diff(poses, axis=0)
    cos, sin = np.cos(poses[:-1, 2]), np.sin(poses[:-1, 2])
    steps = np.zeros_like(poses)
    steps[1:, 0] = cos * change[:, 0] + sin * change[:, 1]
    steps[1:, 1] = cos * change[:, 1] - sin * change[:, 0]
    steps[1:, 2] = wrap_angles(change[:, 2])
    return steps


def walk(steps: FloatArray, start: FloatArray | None = None) -> FloatArray:
    """Where steps (N, 3) lead from ``start`` on (the origin): poses (N, 3), headings not wrapped."""
    x, y, theta = np.zeros(3) if start is None else start
    heading = theta + np.cumsum(steps[:, 2])
    before = np.concatenate(([theta], heading[:-1]))
    cos, sin = np.cos(before), np.sin(before)
    dx, dy = cos * steps[:, 0] - sin * steps[:, 1], sin * steps[:, 0] + cos * steps[:, 1]
    return np.column_stack((x + np.cumsum(dx), y + np.cumsum(dy), heading))


class Fusion:
    """Filters and smooths the nodes of a log; noise that is not ``given`` is found from the log."""

    def __init__(self, nodes: Nodes, given: PoseNoise | None = None) -> None:
        self.nodes = nodes
        self._given = given or PoseNoise()
        self._noise = self._first_noise()
        self._start, self._spread = self._first_pose()
        self._learn()

    @property
    def noise(self) -> PoseNoise:
        """The noise as given or found; None where it is neither."""
        fixes, headings, metres, radians, bias = self._noise.tolist()
        has_fixes, has_headings = bool(self.nodes.has_fixes.any()), bool(self.nodes.has_headings.any())
        given = self._given
        return PoseNoise(
            fixes if has_fixes else None,
            headings if has_headings else None,
            metres if has_fixes or given.metres else None,
            radians if has_fixes or has_headings or given.radians else None,
            bias if has_headings else None,
        )

    @property
    def odometry_std(self) -> FloatArray:
        """What is reckoned with: the odometry's standard deviations (3,) after one metre of way, m, m, rad."""
        return self._noise[[METRES, METRES, RADIANS]]

    def filtered(self) -> Estimate:
        """Each pose from what was measured until then."""
        kept = self._run(self.nodes, self._noise)
        return self._estimate(self.nodes.stamps, kept)

    @property
    def start(self) -> tuple[FloatArray, FloatArray]:
        """Where the robot begins, as far as is known before anything is measured: pose (3,), covariance (6,)."""
        return self._start.copy(), self._spread.copy()

    def advance(
        self, begin: int, end: int, state: FloatArray, spread: FloatArray, worse: float
    ) -> tuple[FloatArray, FloatArray]:
        """The filter over the nodes from ``begin`` to ``end``: pose and covariance (6,) at the last one.

        ``state`` and ``spread`` are those before the first.

        The odometry's variances are taken to be ``worse`` times what they are thought to be.
        """
        part = self.nodes.part(begin, end)
        kept = self._run(part, self._worse(worse), start=(state, spread))
        return kept.states[-1].copy(), kept.covs[-1].copy()

    def _worse(self, times: float) -> FloatArray:
        """The noise, with odometry whose variances are so many times as large."""
        noise = self._noise.copy()
        noise[[METRES, RADIANS]] *= math.sqrt(times)
        return noise

    def smoothed(self, scans: FloatArray | None = None, worse: float = 1.0, nodes: int | None = None) -> Estimate:
        """Each pose from all that was measured, and what ``scans`` (N, 12) say (see :func:`replay.poses.kalman.run`).

        The odometry's variances are taken to be ``worse`` times what they are thought to be. With ``nodes``, only
        the first so many poses, from what was measured until the last of them.
        """
        part = self.nodes.part(0, nodes)
        kept = self._run(part, self._worse(worse), None if scans is None else scans[:nodes])
        gains = np.zeros((len(kept.states), 3, 3))
        smooth(kept.states, kept.covs, kept.predicted, kept.predicted_covs, gains)
        return self._estimate(part.stamps, kept, gains)

    def _estimate(self, stamps: Stamps, kept: Filtered, gains: FloatArray | None = None) -> Estimate:
        poses = kept.states.copy()
        poses[:, 2] = wrap_angles(poses[:, 2])
        return Estimate(stamps, poses, matrices_of(kept.covs), self.noise, kept.verdicts, gains)

    def _run(
        self,
        nodes: Nodes,
        noise: FloatArray,
        scans: FloatArray | None = None,
        start: tuple[FloatArray, FloatArray] | None = None,
    ) -> Filtered:
        n = len(nodes.stamps)
        state, spread = start or (self._start, self._spread)
        kept = Filtered(
            np.empty((n, 3)),
            np.empty((n, 6)),
            np.empty((n, 3)),
            np.empty((n, 6)),
            np.empty(n),
            np.empty((n, 2), np.int64),
        )
        run(
            state,
            spread,
            nodes.steps,
            nodes.ways,
            nodes.fixes,
            nodes.headings,
            nodes.lever,
            noise,
            GATES if nodes.moves else NO_GATES,
            np.zeros((0, 12)) if scans is None else scans,
            kept.states,
            kept.covs,
            kept.predicted,
            kept.predicted_covs,
            kept.costs,
            kept.verdicts,
        )
        return kept

    def _first_noise(self) -> FloatArray:
        """What is given, else what differences between neighbouring readings show, else what is usual."""
        given, nodes = self._given, self.nodes
        usual = DEFAULT_ODOMETRY if nodes.moves else DEFAULT_DRIFT
        return np.array(
            [
                given.fixes or _scatter(np.diff(nodes.fixes[nodes.has_fixes], axis=0)) or 1.0,
                given.headings or _scatter(wrap_angles(np.diff(nodes.headings[nodes.has_headings]))) or 0.1,
                given.metres or usual[0],
                given.radians or usual[1],
                given.bias or 0.0,
            ]
        )

    def _first_pose(self) -> tuple[FloatArray, FloatArray]:
        """Where the filter begins, and how sure that is: covariance (6,)."""
        nodes = self.nodes
        walked = walk(nodes.steps)
        x, y, theta = nodes.start.tolist()
        turn = LEAST_STD
        if nodes.has_headings.any():
            at = np.flatnonzero(nodes.has_headings)[:START_READINGS]
            theta = _mean_angle(nodes.headings[at] - walked[at, 2])
            turn = START_TURN
        elif nodes.has_fixes.any():
            theta, turn = self._aligned(walked), 1.0
        place = LEAST_STD
        if nodes.has_fixes.any():
            at = np.flatnonzero(nodes.has_fixes)[:START_READINGS]
            cos, sin = math.cos(theta), math.sin(theta)
            gone = walked[at, :2] @ np.array([[cos, sin], [-sin, cos]])
            x, y = np.median(nodes.fixes[at] - gone, axis=0).tolist()
            place = 1.0 + 10 * float(self._noise[FIX_STD])
        return np.array([x, y, theta]), np.array([place**2, 0, 0, place**2, 0, turn**2])

    def _aligned(self, walked: FloatArray) -> float:
        """The heading at the start by which the way of the odometry fits the fixes best (Procrustes)."""
        at = np.flatnonzero(self.nodes.has_fixes)
        gone, fixes = walked[at, :2], self.nodes.fixes[at]
        reach = np.hypot(*(gone - gone[0]).T)
        far = np.flatnonzero(reach > ALIGNED * self._noise[FIX_STD])
        count = max(int(far[0]) + 1, START_READINGS) if len(far) else len(at)
        gone, fixes = gone[:count] - gone[:count].mean(axis=0), fixes[:count] - fixes[:count].mean(axis=0)
        across = float((gone[:, 0] * fixes[:, 1] - gone[:, 1] * fixes[:, 0]).sum())
        return math.atan2(across, float((gone * fixes).sum()))

    def _unknown(self) -> list[int]:
        """Which parts of the noise are to be found, the bias apart.

        Without odometry the motion is anything but a random walk of normal steps, and the sensors' noise stays what
        differences between neighbouring readings show.
        """
        given, nodes = self._given, self.nodes
        found = []
        if given.fixes is None and nodes.has_fixes.any() and nodes.moves:
            found.append(FIX_STD)
        if given.headings is None and nodes.has_headings.any() and nodes.moves:
            found.append(HEADING_STD)
        if nodes.has_fixes.any() and given.metres is None:
            found.append(METRES)
        if (nodes.has_fixes.any() or nodes.has_headings.any()) and given.radians is None:
            found.append(RADIANS)
        return found

    def _learn(self) -> None:
        """Finds the noise by maximum likelihood of the innovations, and whether the compass is biased."""
        unknown = self._unknown()
        if not unknown:
            return
        told = np.flatnonzero(self.nodes.has_fixes | self.nodes.has_headings)[:: self._stride()]
        nodes = self.nodes.only(np.union1d([0], told))
        self._noise = self._likeliest(nodes, unknown)
        both = nodes.moves and nodes.has_headings.any() and nodes.has_fixes.any()
        if not (both and self._given.bias is None):
            return
        slope = self._slopes(nodes, self._noise, [BIAS])[:, 0]
        if slope.sum() ** 2 > BIAS_SCORE * (slope**2).sum():
            self._noise = self._likeliest(nodes, [*unknown, BIAS])

    def _stride(self) -> int:
        """Every how many readings are enough to find the noise from."""
        told = np.count_nonzero(self.nodes.has_fixes | self.nodes.has_headings)
        return max(1, -(-int(told) // MOST_NODES))

    def _likeliest(self, nodes: Nodes, unknown: list[int]) -> FloatArray:
        """The most likely noise (Berndt, Hall, Hall and Hausman 1974): scoring steps, halved where they overshoot."""
        noise, usual = self._noise.copy(), self._noise.copy()
        cost = self._cost(nodes, noise, usual, unknown)
        for _ in range(MOST_ROUNDS):
            slopes = self._slopes(nodes, noise, unknown)
            believed = -_off(noise, usual, unknown) / PRIOR_SPREAD**2
            information = slopes.T @ slopes + np.diag(_weights(unknown)) + 1e-9 * np.eye(len(unknown))
            step = np.linalg.solve(information, slopes.sum(axis=0) + believed)
            step = np.clip(step, -1.5, 1.5)
            share = 1.0
            while share > 0.05:
                tried = _nudged(noise, unknown, share * step)
                now = self._cost(nodes, tried, usual, unknown)
                if now <= cost:
                    break
                share /= 2
            else:
                break
            noise, cost = tried, now
            if np.abs(share * step).max() < LEARNT:
                break
        return noise

    def _cost(self, nodes: Nodes, noise: FloatArray, usual: FloatArray, unknown: list[int]) -> float:
        prior = (_off(noise, usual, unknown) ** 2).sum() / PRIOR_SPREAD**2
        return float(self._run(nodes, noise).costs.sum() + prior)

    def _slopes(self, nodes: Nodes, noise: FloatArray, unknown: list[int]) -> FloatArray:
        """Each node's derivatives (N, len(unknown)) of the log-likelihood, by central differences."""
        columns = []
        for index in unknown:
            size = BIAS_NUDGE if index == BIAS else NUDGE
            up, down = (self._run(nodes, _nudged(noise, [index], np.array([s]))).costs for s in (size, -size))
            columns.append((down - up) / (4 * size))
        return np.column_stack(columns)


def six_of(matrices: FloatArray) -> FloatArray:
    """The six numbers (..., 6) of symmetric matrices (..., 3, 3)."""
    return matrices[..., [0, 0, 0, 1, 1, 2], [0, 1, 2, 1, 2, 2]].copy()


def matrices_of(six: FloatArray) -> FloatArray:
    """The symmetric matrices (..., 3, 3) of six numbers each (..., 6)."""
    return six[..., [0, 1, 2, 1, 3, 4, 2, 4, 5]].reshape(*six.shape[:-1], 3, 3)


def _off(noise: FloatArray, usual: FloatArray, unknown: list[int]) -> FloatArray:
    """How far logarithms are from what is usual; the bias has no prior."""
    return np.array([0.0 if index == BIAS else math.log(noise[index] / usual[index]) for index in unknown])


def _weights(unknown: list[int]) -> FloatArray:
    return np.array([0.0 if index == BIAS else PRIOR_SPREAD**-2 for index in unknown])


def _nudged(noise: FloatArray, unknown: list[int], by: FloatArray) -> FloatArray:
    """The noise with some of its parts changed: in the logarithm, but for the bias."""
    changed = noise.copy()
    for index, change in zip(unknown, by.tolist(), strict=True):
        if index == BIAS:
            changed[index] = wrap_angle(changed[index] + change)
        else:
            changed[index] = min(max(changed[index] * math.exp(change), LEAST_STD), MOST_STD)
    return changed


def _scatter(differences: FloatArray) -> float:
    """The standard deviation of one of two readings, by the median size of their differences; 0 if there is none."""
    return float(np.median(np.abs(differences))) / 0.6745 / math.sqrt(2) if differences.size else 0.0


def _mean_angle(angles: FloatArray) -> float:
    return math.atan2(float(np.median(np.sin(angles))), float(np.median(np.cos(angles))))
