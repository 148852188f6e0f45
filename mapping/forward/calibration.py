"""From the forward model's fit to a calibrated probability of occupancy.

A stopping probability is no occupancy: where the noise is large, a surface is spread over several cells, each of
which stops few of the rays that reach it. What separates the inside of an object from the outside is how probable it
is, given the ranges, that rays reach the cell. Let a be a ray's posterior probability to have reached the cell. Sums
over the rays give its expected visits, sum(a); its arrival probability R = sum(a^2) / sum(a), the mean of a weighted
by itself; and the effective number of visits, sum(a^2). With o the stopping probability, 1 - (1 - o) R approximates
the probability that a surface lies before the cell's far side. Its log-odds, those of its mean over the
neighbourhood, ln(o) and the noise are the features of a logistic regression, whose coefficients were fitted on
recorded sessions (``python -m bench.calibrate fit``).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mapping.forward.sieve import convolve, gaussian_kernel
from prim.arrays import BoolGrid
from prim.compiled import kernel


@dataclass(frozen=True, slots=True)
class CalibrationOptions:
    """The logistic regression from the fit to probabilities of occupancy."""

    coefficients: tuple[tuple[float, float, float], ...] = (
        (5.378, 0.726, -0.468),
        (-0.362, -0.794, 0.081),
        (4.796, 0.233, -0.149),
        (0.196, 0.390, -0.072),
    )
    """Rows: 1, the cell's log-odds, its neighbourhood's, ln(o). Columns: times 1, L, L^2 with L = ln(sigma in cells).
    Fitted by ``python -m bench.calibrate fit`` on seeds 10000 to 10023."""

    min_effective_visits: float = 0.5
    """A cell with a smaller effective number of visits (rays) than this is unknown. Set by hand."""

    max_weight: float = 5.0
    """In the mean over a neighbourhood a cell's weight is its visits, or this where they are more. Set by hand."""

    neighbourhood: float = 1.0
    """Standard deviation (cells) of the Gaussian mean over a neighbourhood. Set by hand."""

    min_noise_cells: float = 0.5
    """Smaller noise counts as this (cells): the range that the regression was fitted for."""

    max_noise_cells: float = 60.0
    """Larger noise counts as this (cells)."""

    probability_margin: float = 1e-6
    """Probabilities are clipped to this far from 0 and 1 before their log-odds are taken. Set by hand."""


CALIBRATION = CalibrationOptions()


def surface_probability(
    stopping: NDArray[np.float32],
    arrival_probability: NDArray[np.float32],
    visits: NDArray[np.float32],
    options: CalibrationOptions = CALIBRATION,
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Compute the probability that a surface lies before each cell's far side.

    Args:
        stopping: Stopping probabilities (rows, cols).
        arrival_probability: Arrival probabilities (rows, cols), see :class:`mapping.forward.mapper.ForwardFit`.
        visits: Expected visits (rows, cols).
        options: The regression.

    Returns:
        The probabilities (rows, cols), and their means over each cell's neighbourhood, see ``max_weight``.
    """
    probability = np.asarray(1 - (1 - stopping) * arrival_probability, dtype=np.float32)
    weight = np.minimum(visits, np.float32(options.max_weight))
    scratch, weighted, weights = (np.empty_like(probability) for _ in range(3))
    gaussian = gaussian_kernel(options.neighbourhood)
    convolve(probability * weight, gaussian, scratch, weighted)
    convolve(weight, gaussian, scratch, weights)
    neighbourhood = weighted / np.maximum(weights, np.float32(1e-9))
    return probability, np.asarray(neighbourhood, dtype=np.float32)


def is_known(
    arrival_probability: NDArray[np.float32], visits: NDArray[np.float32], options: CalibrationOptions = CALIBRATION
) -> BoolGrid:
    """Return which cells have enough effective visits to be known.

    Args:
        arrival_probability: Arrival probabilities (rows, cols).
        visits: Expected visits (rows, cols).
        options: The regression.

    Returns:
        Known cells (rows, cols).
    """
    return np.asarray(arrival_probability * visits >= options.min_effective_visits)


def occupancy(
    stopping: NDArray[np.float32],
    arrival_probability: NDArray[np.float32],
    visits: NDArray[np.float32],
    noise_cells: float,
    options: CalibrationOptions = CALIBRATION,
) -> NDArray[np.float32]:
    """Compute the probabilities of occupancy.

    Args:
        stopping: Stopping probabilities (rows, cols).
        arrival_probability: Arrival probabilities (rows, cols), see :class:`mapping.forward.mapper.ForwardFit`.
        visits: Expected visits (rows, cols).
        noise_cells: Standard deviation of the range noise (cells).
        options: The regression.

    Returns:
        Probabilities (rows, cols) float32; 0.5 where a cell is unknown.
    """
    surface, neighbourhood = surface_probability(stopping, arrival_probability, visits, options)
    probability = np.empty_like(stopping)
    log_noise = math.log(min(max(noise_cells, options.min_noise_cells), options.max_noise_cells))
    weights = np.array(options.coefficients) @ (1.0, log_noise, log_noise**2)
    effective_visits, min_effective_visits = arrival_probability * visits, options.min_effective_visits
    margin = options.probability_margin
    _logistic(surface, neighbourhood, stopping, effective_visits, weights, min_effective_visits, margin, probability)
    return probability


@kernel
def _logistic(
    surface: Any,
    neighbourhood: Any,
    stopping: Any,
    effective_visits: Any,
    weights: Any,
    min_effective_visits: float,
    margin: float,
    probability: Any,
) -> None:
    """Apply the logistic regression to all cells; ``effective_visits`` is sum(a^2), see the module."""
    for i in range(surface.shape[0]):
        for j in range(surface.shape[1]):
            if effective_visits[i, j] < min_effective_visits:
                probability[i, j] = 0.5
                continue
            p = min(max(surface[i, j], margin), 1 - margin)
            q = min(max(neighbourhood[i, j], margin), 1 - margin)
            odds = weights[0] + weights[1] * math.log(p / (1 - p)) + weights[2] * math.log(q / (1 - q))
            odds += weights[3] * math.log(stopping[i, j])
            probability[i, j] = 1 / (1 + math.exp(-min(max(odds, -30.0), 30.0)))
