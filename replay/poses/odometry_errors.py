"""What is wrong with an odometry all the time, by better poses: scales of its distances and turns, and its delay.

Distances and turns are compared over spans that are long beside the errors of both; the delay by the turns from scan
to scan, those of the better poses at other times.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from prim.arrays import FloatArray, Stamps
from prim.se2 import Trajectory, integrate_steps, relative_poses, relative_steps, wrap_angles


@dataclass(frozen=True)
class OdometryErrorOptions:
    """The numbers of :func:`find_odometry_errors`; set by hand.

    Attributes:
        span_distance: A span ends after so much of the way (m) …
        span_turn: … or after turns by this (rad) in all, one direction or the other.
        least_spans: Scales are found from so many spans at least.
        rounds: Scales are fitted so many times …
        outlier: … without the spans that are further off than so many times the median one.
        deviations: What is found counts where it is so many times its standard deviation …
        least_scale: … and a scale where it differs from 1 by this …
        least_delay: … and a delay where it is longer than this (s).
        longest_delay: Delays are searched up to this (s) …
        delay_step: … in steps of this (s).
        least_turn: A delay is found where the robot turns by this (rad) in all.
        furthest: Of scales, one that differs from 1 by more is no scale, but a broken odometry.
    """

    span_distance: float = 0.5
    span_turn: float = 0.5
    least_spans: int = 12
    rounds: int = 5
    outlier: float = 4.0
    deviations: float = 4.0
    least_scale: float = 2e-3
    least_delay: float = 0.015
    longest_delay: float = 1.0
    delay_step: float = 0.01
    least_turn: float = 1.0
    furthest: float = 0.5


DEFAULTS = OdometryErrorOptions()


class OdometryErrors(NamedTuple):
    """What is wrong with an odometry.

    Attributes:
        distance_scale: What its distances have to be multiplied by.
        turn_scale: What its turns have to be multiplied by.
        delay: How much later (s) than the scans it shows a motion.
    """

    distance_scale: float = 1.0
    turn_scale: float = 1.0
    delay: float = 0.0

    @property
    def has_scales(self) -> bool:
        """Whether distances or turns are scaled."""
        return self.distance_scale != 1 or self.turn_scale != 1

    def corrected(self, poses: FloatArray) -> FloatArray:
        """Take the scales out of an odometry.

        Args:
            poses: (N, 3) the robot's.

        Returns:
            (N, 3) from the same first pose on.
        """
        scales = self.distance_scale, self.distance_scale, self.turn_scale
        return integrate_steps(relative_steps(poses) * scales, poses[0])

    def notes(self, origin: str) -> tuple[str, ...]:
        """Describe the errors.

        Args:
            origin: Where the odometry comes from.

        Returns:
            Notes; none where nothing is wrong.
        """
        notes: tuple[str, ...] = ()
        if self.has_scales:
            scales = f"distances x {self.distance_scale:.3f}, turns x {self.turn_scale:.3f}"
            notes += (f"{origin}: {scales}, found from the log and corrected",)
        if self.delay:
            when = "after" if self.delay > 0 else "before"
            notes += (
                f"{origin} shows each motion {abs(self.delay):.2f} s {when} the scans do: two clocks, or a delay",
            )
        return notes


NO_ERRORS = OdometryErrors()


def find_odometry_errors(
    stamps: Stamps, odometry: FloatArray, poses: FloatArray, options: OdometryErrorOptions = DEFAULTS
) -> OdometryErrors:
    """Find what is wrong with an odometry all the time.

    Args:
        stamps: (N,) ns, rising.
        odometry: (N, 3) the robot's poses by odometry then.
        poses: (N, 3) its poses by something better.
        options: Spans, and what is significant.

    Returns:
        Those errors that are significant.
    """
    delay = _delay(stamps, odometry, poses, options)
    seen, within = Trajectory(stamps, poses).at(stamps - round(1e9 * delay))
    seen, odometry = seen[within], odometry[within]
    starts, ends = _spans(seen, options)
    if len(starts) < options.least_spans:
        return OdometryErrors(delay=delay)
    measured = relative_poses(odometry[starts], odometry[ends])
    actual = relative_poses(seen[starts], seen[ends])
    turned, has_turned = (wrap_angles(each[:, 2:]) for each in (measured, actual))
    distances = _scale(measured[:, :2], actual[:, :2], options)
    return OdometryErrors(distances, _scale(turned, has_turned, options), delay)


def _spans(poses: FloatArray, options: OdometryErrorOptions) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Cut a way into spans; return the indices of their first poses and of their last."""
    change = np.diff(poses, axis=0)
    moved = np.hypot(change[:, 0], change[:, 1]) / options.span_distance
    moved += np.abs(wrap_angles(change[:, 2])) / options.span_turn
    number = np.floor(np.concatenate(([0.0], np.cumsum(moved)))).astype(int)
    bounds = np.flatnonzero(np.diff(number, prepend=-1))
    return bounds[:-1], bounds[1:]


def _scale(measured: FloatArray, actual: FloatArray, options: OdometryErrorOptions) -> float:
    """Return the factor of measured motions (M, K) that makes them the actual ones; 1 where it is not significant.

    The measured ones are fitted by the actual ones, whose errors are small: otherwise noise would shrink it.
    """
    products, squares = (measured * actual).sum(axis=1), (actual * actual).sum(axis=1)
    share, kept = 1.0, np.ones(len(products), dtype=bool)
    for _ in range(options.rounds):
        if not (squares[kept].sum() > 0 and products[kept].sum() > 0):
            return 1.0
        share = float(products[kept].sum() / squares[kept].sum())
        apart = np.sqrt(((measured - share * actual) ** 2).sum(axis=1))
        kept = apart <= options.outlier * np.median(apart)  # wheels that slip, jumps
    std = math.sqrt(float(((products - share * squares)[kept] ** 2).sum())) / float(squares[kept].sum())
    off = abs(share - 1)
    return 1 / share if max(options.deviations * std, options.least_scale) < off < options.furthest else 1.0


def _delay(stamps: Stamps, odometry: FloatArray, poses: FloatArray, options: OdometryErrorOptions) -> float:
    """Return how much later (s) an odometry turns than better poses do; 0 where it is not significant.

    The better poses are moved in time, since to interpolate the odometry would smooth its noise.
    """
    measured = wrap_angles(np.diff(odometry[:, 2]))
    if np.abs(measured).sum() < options.least_turn:
        return 0.0
    better = Trajectory(stamps, poses)
    reach = round(options.longest_delay / options.delay_step)
    delays = np.arange(-reach, reach + 1) * options.delay_step
    within = (stamps >= stamps[0] + 1e9 * options.longest_delay) & (
        stamps <= stamps[-1] - 1e9 * options.longest_delay
    )
    steps = within[1:] & within[:-1]
    if np.count_nonzero(steps) < options.least_spans:
        return 0.0
    costs = np.empty(len(delays))
    for k, delay in enumerate(delays):
        moved, _ = better.at(stamps - round(1e9 * delay))
        actual = wrap_angles(np.diff(moved[:, 2]))[steps]
        costs[k] = _misfit(measured[steps], actual)
    best = int(np.argmin(costs))
    if best in (0, len(delays) - 1):
        return 0.0
    step = options.delay_step
    curvature = (costs[best - 1] - 2 * costs[best] + costs[best + 1]) / step**2
    if not curvature > 0:
        return 0.0
    delay = float(delays[best] + (costs[best - 1] - costs[best + 1]) / (2 * curvature * step))
    std = math.sqrt(2 * costs[best] / np.count_nonzero(steps) / curvature)
    return delay if abs(delay) > max(options.deviations * std, options.least_delay) else 0.0


def _misfit(measured: FloatArray, actual: FloatArray) -> float:
    """Return the sum of squares that measured turns (M,) leave of actual ones, whatever their scale."""
    squares = float(measured @ measured)
    scale = float(measured @ actual) / squares if squares > 0 else 0.0
    return float(((actual - scale * measured) ** 2).sum())
