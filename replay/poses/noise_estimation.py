"""The noise parameters of a filter by maximum likelihood of its innovations.

The log-likelihood of all measurements is the sum of those of the filter's innovations (prediction error
decomposition: Schweppe, 1965). Its gradient is taken by central differences, and the information matrix from the
outer products of the single nodes' gradients (Berndt, Hall, Hall and Hausman, 1974). Standard deviations are changed
in the logarithm, the heading bias as it is.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

import numpy as np

from prim import linear_algebra
from prim.arrays import FloatArray
from prim.se2 import wrap_angle
from replay.poses.fusion_options import NoiseEstimationOptions
from replay.poses.kalman import HEADING_BIAS, SCALES, TIMES


class NoiseEstimator:
    """Maximises the likelihood of noise parameters (11,), which kalman.FIX_STD and so on index.

    Args:
        costs: Returns minus twice each node's log-likelihood (N,), given the parameters.
        options: Prior, steps and tolerances.
    """

    def __init__(self, costs: Callable[[FloatArray], FloatArray], options: NoiseEstimationOptions) -> None:
        self._costs = costs
        self._options = options

    def maximize(self, initial: FloatArray, free: Sequence[int]) -> FloatArray:
        """Maximise the posterior by scoring steps, which are halved where they overshoot.

        Args:
            initial: Where the search starts (11,), and where the prior has its mode.
            free: The indices of the parameters to be estimated.

        Returns:
            The parameters (11,).
        """
        options = self._options
        noise = initial.copy()
        cost = self.cost(noise, initial, free)
        for _ in range(options.max_iterations):
            step = self._scoring_step(noise, initial, free)
            share = 1.0
            while share > options.min_step_share:
                candidate = self._changed(noise, free, share * step)
                candidate_cost = self.cost(candidate, initial, free)
                if candidate_cost <= cost:
                    break
                share /= 2
            else:
                break
            noise, cost = candidate, candidate_cost
            if np.abs(share * step).max() < options.tolerance:
                break
        return noise

    def cost(self, noise: FloatArray, initial: FloatArray, free: Sequence[int]) -> float:
        """Compute minus twice the log-posterior, up to a constant.

        Args:
            noise: The parameters (11,).
            initial: Where their prior has its mode.
            free: The indices of those that have one.

        Returns:
            The cost.
        """
        squares = (_log_ratios(noise, initial, free) / self._prior_stds(free)) ** 2
        return float(self._costs(noise).sum() + squares.sum())

    def is_significant(self, noise: FloatArray, parameter: int) -> bool:
        """Test by its score whether a parameter differs from its value in ``noise`` (after Rao, 1948).

        The other parameters are held fixed: their scores are not projected out of this one's, which would change the
        statistic where they are correlated.

        Args:
            noise: The parameters (11,), the free ones at the maximum of their posterior.
            parameter: The index of the one to be tested.

        Returns:
            Whether the score statistic exceeds the threshold of the options.
        """
        scores = self._node_scores(noise, [parameter])[:, 0]
        return bool(scores.sum() ** 2 > self._options.score_threshold * (scores**2).sum())

    def _scoring_step(self, noise: FloatArray, initial: FloatArray, free: Sequence[int]) -> FloatArray:
        """Return a scoring step on the log-posterior (len(free),), limited in size."""
        options = self._options
        scores = self._node_scores(noise, free)
        ratios, prior_information = _log_ratios(noise, initial, free), self._prior_stds(free) ** -2.0
        prior_score = -ratios * prior_information
        information = scores.T @ scores + np.diag(prior_information) + options.ridge * np.eye(len(free))
        step = linear_algebra.solve(information, scores.sum(axis=0) + prior_score)
        if step is None:  # the readings say nothing: the search ends here
            return np.zeros(len(free))
        limited: FloatArray = np.clip(step, -options.max_step, options.max_step)
        return limited

    def _prior_stds(self, free: Sequence[int]) -> FloatArray:
        """Return the standard deviations (len(free),) of the priors (nepers)."""
        return np.array([self._prior_std(index) for index in free])

    def _prior_std(self, index: int) -> float:
        """Return the standard deviation of a parameter's prior (nepers); infinite for the bias, which has none."""
        if index == HEADING_BIAS:
            return math.inf
        if index in TIMES:
            return self._options.prior_time_std
        return self._options.prior_scale_std if index in SCALES else self._options.prior_log_std

    def _difference(self, index: int) -> float:
        """Return half the interval of central differences."""
        if index == HEADING_BIAS:
            return self._options.bias_difference
        return self._options.scale_difference if index in SCALES else self._options.log_difference

    def _node_scores(self, noise: FloatArray, free: Sequence[int]) -> FloatArray:
        """Return the gradients (N, len(free)) of each node's log-likelihood, by central differences."""
        columns = []
        for index in free:
            size = self._difference(index)
            above, below = (self._costs(self._changed(noise, [index], np.array([s]))) for s in (size, -size))
            columns.append((below - above) / (4 * size))
        return np.column_stack(columns)

    def _changed(self, noise: FloatArray, free: Sequence[int], change: FloatArray) -> FloatArray:
        """Add a change to some of the parameters: to the logarithm, except for the bias."""
        changed = noise.copy()
        for index, delta in zip(free, change.tolist(), strict=True):
            if index == HEADING_BIAS:
                changed[index] = wrap_angle(changed[index] + delta)
            else:
                std = changed[index] * math.exp(delta)
                most = self._options.max_time if index in TIMES else self._options.max_std
                changed[index] = min(max(std, self._options.min_std), most)
        return changed


def _log_ratios(noise: FloatArray, initial: FloatArray, free: Sequence[int]) -> FloatArray:
    """Return the logarithms' differences from their initial values; 0 for the bias, which has no prior."""
    return np.array([0.0 if index == HEADING_BIAS else math.log(noise[index] / initial[index]) for index in free])
