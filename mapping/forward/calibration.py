"""From the forward model's fit to a calibrated probability of occupancy.

A stopping probability is no occupancy: where the noise is large, a surface is spread over several cells, each of
which stops few of the rays that reach it. What separates the inside of an object from the outside is how certain it
is that rays reach the cell. With o the stopping probability and R the certainty of the rays that are expected to have
reached a cell, 1 - (1 - o) R is the probability that a surface lies before the cell's far side. Its log-odds, those
of its mean over the neighbourhood, ln(o) and the noise are the features of a logistic regression, whose coefficients
were fitted on recorded sessions (``python -m bench.calibrate fit``).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mapping.forward.sieve import blur, gaussian_kernel
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

    min_evidence: float = 0.5
    """A cell is unknown where fewer rays than this reached it, each weighted by its certainty. Set by hand."""

    full_evidence: float = 5.0
    """In the mean over a neighbourhood, cells with more evidence than this (rays) have equal weights. Set by hand."""

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
    certainty: NDArray[np.float32],
    evidence: NDArray[np.float32],
    options: CalibrationOptions = CALIBRATION,
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Compute the probability that a surface lies before each cell's far side.

    Args:
        stopping: Stopping probabilities (rows, cols).
        certainty: Certainties (rows, cols), see :class:`mapping.forward.mapper.ForwardFit`.
        evidence: Evidence (rows, cols).
        options: The regression.

    Returns:
        The probabilities (rows, cols), and their means over each cell's neighbourhood, weighted by evidence.
    """
    probability = np.asarray(1 - (1 - stopping) * certainty, dtype=np.float32)
    weight = np.minimum(evidence, np.float32(options.full_evidence))
    scratch, weighted, weights = (np.empty_like(probability) for _ in range(3))
    gaussian = gaussian_kernel(options.neighbourhood)
    blur(probability * weight, gaussian, scratch, weighted)
    blur(weight, gaussian, scratch, weights)
    neighbourhood = weighted / np.maximum(weights, np.float32(1e-9))
    return probability, np.asarray(neighbourhood, dtype=np.float32)


def is_known(
    certainty: NDArray[np.float32], evidence: NDArray[np.float32], options: CalibrationOptions = CALIBRATION
) -> BoolGrid:
    """Return which cells have enough evidence to be known.

    Args:
        certainty: Certainties (rows, cols).
        evidence: Evidence (rows, cols).
        options: The regression.

    Returns:
        Known cells (rows, cols).
    """
    return np.asarray(certainty * evidence >= options.min_evidence)


def occupancy(
    stopping: NDArray[np.float32],
    certainty: NDArray[np.float32],
    evidence: NDArray[np.float32],
    noise_cells: float,
    options: CalibrationOptions = CALIBRATION,
) -> NDArray[np.float32]:
    """Compute the probabilities of occupancy.

    Args:
        stopping: Stopping probabilities (rows, cols).
        certainty: Certainties (rows, cols), see :class:`mapping.forward.mapper.ForwardFit`.
        evidence: Evidence (rows, cols).
        noise_cells: Standard deviation of the range noise (cells).
        options: The regression.

    Returns:
        Probabilities (rows, cols) float32; 0.5 where a cell is unknown.
    """
    surface, neighbourhood = surface_probability(stopping, certainty, evidence, options)
    probability = np.empty_like(stopping)
    log_noise = math.log(min(max(noise_cells, options.min_noise_cells), options.max_noise_cells))
    weights = np.array(options.coefficients) @ (1.0, log_noise, log_noise**2)
    known, margin = certainty * evidence, options.probability_margin
    _logistic(surface, neighbourhood, stopping, known, weights, options.min_evidence, margin, probability)
    return probability


@kernel
def _logistic(
    surface: Any,
    neighbourhood: Any,
    stopping: Any,
    certain: Any,
    weights: Any,
    min_evidence: float,
    margin: float,
    probability: Any,
) -> None:
    """Apply the logistic regression to all cells; ``certain`` is certainty times evidence."""
    for i in range(surface.shape[0]):
        for j in range(surface.shape[1]):
            if certain[i, j] < min_evidence:
                probability[i, j] = 0.5
                continue
            p = min(max(surface[i, j], margin), 1 - margin)
            q = min(max(neighbourhood[i, j], margin), 1 - margin)
            odds = weights[0] + weights[1] * math.log(p / (1 - p)) + weights[2] * math.log(q / (1 - q))
            odds += weights[3] * math.log(stopping[i, j])
            probability[i, j] = 1 / (1 + math.exp(-min(max(odds, -30.0), 30.0)))
