"""The search for a fusion's noise: what is not given of it, whether errors wander, and what is biased."""

from __future__ import annotations

import math

import numpy as np

from prim.arrays import FloatArray
from prim.se2 import integrate_steps
from replay.poses.fusion_filter import (
    filter_nodes,
    first_noise,
    initial_state,
    median_angle,
    scatter_about_odometry,
)
from replay.poses.fusion_nodes import FusionNodes
from replay.poses.fusion_options import FusionOptions, SensorNoise
from replay.poses.kalman import (
    FIX_STD,
    HEADING_BIAS,
    HEADING_STD,
    HEADING_WANDER_STD,
    HEADING_WANDER_TIME,
    ROTATION_STD,
    SCALES,
    TRANSLATION_STD,
    TURN_SCALE,
    WANDER,
    WANDER_STD,
    WANDER_TIME,
    FilterState,
)
from replay.poses.noise_estimation import NoiseEstimator


def find_noise(nodes: FusionNodes, given: SensorNoise, options: FusionOptions) -> tuple[FloatArray, FilterState]:
    """Find the noise under which the readings are most likely.

    Args:
        nodes: The measurements.
        given: What is known of the noise; the rest is estimated.
        options: The numbers of the estimation.

    Returns:
        The noise parameters (11,), and the belief before the first node.
    """
    search = NoiseSearch(nodes, given, options)
    search.run()
    return search.noise, search.initial


class NoiseSearch:
    """The implementation and state of :func:`find_noise`, and with its arguments.

    Attributes:
        noise: The noise parameters (11,).
        initial: The belief before the first node.
    """

    def __init__(self, nodes: FusionNodes, given: SensorNoise, options: FusionOptions) -> None:
        self._nodes, self._given, self._options = nodes, given, options
        self._has_fixes, self._has_headings = bool(nodes.has_fix.any()), bool(nodes.has_heading.any())
        self.noise = first_noise(nodes, given, options)
        self.initial = initial_state(nodes, self.noise, options)
        if self._has_headings and not nodes.has_north:
            # where the 0 of an IMU is, but for what the state holds of it
            headings = integrate_steps(nodes.steps)[:, 2] + self.initial.mean[2]
            first = np.flatnonzero(nodes.has_heading)[: options.initial_readings]
            self.noise[HEADING_BIAS] = median_angle((nodes.headings - headings)[first])

    def run(self) -> None:
        """Estimate what is not given."""
        free, nodes, given, begin = self._free_parameters(), self._nodes, self._given, self.noise
        if not free:
            return
        estimator = self._estimator(self._options.estimation.max_nodes)
        self.noise = estimator.maximize(begin, free)
        if not nodes.has_odometry:
            return
        is_north_open = self._has_headings and nodes.has_north
        if self._has_fixes and is_north_open and given.heading_bias is None:
            self._find_bias(estimator, free)
        if self._has_fixes and given.position_std is None:
            self._find_wander(begin, free, WANDER_STD, WANDER_TIME)
        if is_north_open and given.heading_std is None:
            self._find_wander(begin, free, HEADING_WANDER_STD, HEADING_WANDER_TIME)
        self._find_scales(estimator, free)

    def _free_parameters(self) -> list[int]:
        """Return which noise parameters are to be estimated, without those that are not always there.

        Without odometry the motion is anything but a random walk of normal steps, and the sensors' noise stays what
        differences of neighbouring readings show.
        """
        given, nodes = self._given, self._nodes
        has_fixes, has_headings = self._has_fixes, self._has_headings
        free = {
            FIX_STD: given.position_std is None and has_fixes and nodes.has_odometry,
            HEADING_STD: given.heading_std is None and has_headings and nodes.has_odometry,
            TRANSLATION_STD: given.odometry_translation_std is None and has_fixes,
            ROTATION_STD: given.odometry_rotation_std is None and (has_fixes or has_headings),
            HEADING_WANDER_TIME: has_headings and not nodes.has_north,
        }
        return [parameter for parameter, is_free in free.items() if is_free]

    def _estimator(self, max_nodes: int) -> NoiseEstimator:
        """Return an estimator of the noise from some of the nodes with measurements."""
        measured = np.flatnonzero(self._nodes.has_fix | self._nodes.has_heading)
        nodes = self._nodes.subset(np.union1d([0], measured[:: max(1, -(-len(measured) // max_nodes))]))
        return NoiseEstimator(lambda noise: self._costs(nodes, noise), self._options.estimation)

    def _costs(self, nodes: FusionNodes, noise: FloatArray) -> FloatArray:
        """Return minus twice the log-likelihood (N,) of the readings at each node."""
        return filter_nodes(nodes, noise, self.initial, self._options).costs

    def _find_wander(self, initial: FloatArray, free: list[int], std: int, time: int) -> None:
        """Estimate a wandering error, and keep it where the readings are clearly more likely with it."""
        steps = self._nodes.steps
        moved = np.hypot(steps[:, 0], steps[:, 1]) if std == WANDER_STD else np.abs(steps[:, 2])
        spread = scatter_about_odometry(self._nodes, self.noise, std)
        if moved.sum() < spread:  # odometry that stands still says nothing of where readings should be
            return
        options, estimator = self._options, self._estimator(self._options.estimation.wander_nodes)
        plain = estimator.maximize(self.noise, free)
        modes, before = initial.copy(), self.initial
        modes[[HEADING_BIAS, *WANDER]] = self.noise[[HEADING_BIAS, *WANDER]]
        plain_cost = estimator.cost(plain, modes, free)
        stated = self._nodes.stated_fix_std if std == WANDER_STD else None
        best, found, gain = before, plain, 0.0
        for seconds in options.wander_times:
            begin = modes.copy()  # not from where the wandering is absorbed as other noise
            begin[std], begin[time] = stated or spread, seconds
            self.initial = initial_state(self._nodes, begin, self._options)
            noise = estimator.maximize(begin, [*free, std, time])
            gained = plain_cost - estimator.cost(noise, begin, [*free, std, time])
            if stated is not None:  # what the receiver says of its errors counts for both kinds of them together
                gained += self._surprise(plain[FIX_STD], stated)
                gained -= self._surprise(math.hypot(noise[FIX_STD], noise[std]), stated)
            if gained > gain:
                best, found, gain = initial_state(self._nodes, noise, self._options), noise, gained
        self.initial = before
        if gain < options.estimation.wander_gain:
            return
        self.noise, self.initial = found, best
        free += [std, time]

    def _surprise(self, std: float, stated: float) -> float:
        """Return minus twice the log-density of a standard deviation where another one is stated."""
        surprise: float = (math.log(std / stated) / self._options.estimation.stated_log_std) ** 2
        return surprise

    def _find_bias(self, estimator: NoiseEstimator, free: list[int]) -> None:
        """Estimate the offset of a compass where its score is significant."""
        if estimator.is_significant(self.noise, HEADING_BIAS):
            self.noise = estimator.maximize(self.noise, [*free, HEADING_BIAS])
            free.append(HEADING_BIAS)

    def _find_scales(self, estimator: NoiseEstimator, free: list[int]) -> None:
        """Estimate the scales of an odometry, and keep them where the readings are clearly more likely with them."""
        options = self._options.estimation
        scales = [*SCALES] if self._has_fixes else [TURN_SCALE]
        found = estimator.maximize(self.noise, [*free, *scales])
        gain = estimator.cost(self.noise, self.noise, free) - estimator.cost(found, self.noise, [*free, *scales])
        if gain > options.scale_gain and np.abs(found[scales] - 1).max() > options.least_scale:
            self.noise = found
