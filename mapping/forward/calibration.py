"""From the forward model's fit to a calibrated probability of occupancy.

A cell's chance to stop a ray is no occupancy: where the noise is large, a surface is spread over several cells, each
of which stops few of the rays that come to it. What tells the inside from the outside is how surely rays come there:
with R the certainty of the rays that are expected to have come to a cell, 1 - (1 - o) R is the chance that a surface
lies before the cell's far side. Its log-odds, those of its neighbourhood, o itself and the noise go into a logistic
regression whose coefficients were found on recorded sessions (bench/calibrate.py).
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mapping.forward.sieve import blur, taps
from prim.compiled import kernel

LEAST_EVIDENCE = 0.5
"""A cell is unknown where fewer rays than this came, each weighed by how certain that is."""

FULL_EVIDENCE = 5.0
"""In a neighbourhood, cells with more evidence than this count the same."""

LEAST_SPREAD, MOST_SPREAD = 0.5, 60.0
"""The noise, in cells, for which the regression holds; smaller and larger noise counts as this."""

CLIP = 1e-6
"""Chances are kept this far from 0 and 1."""

COEFFICIENTS = np.array(
    [
        [5.378, 0.726, -0.468],
        [-0.362, -0.794, 0.081],
        [4.796, 0.233, -0.149],
        [0.196, 0.390, -0.072],
    ]
)
"""Rows: 1, the cell's log-odds, its neighbourhood's, ln(o). Columns: times 1, L, L^2; L = ln(noise / resolution)."""


def behind_surface(
    stopping: NDArray[np.float32], certainty: NDArray[np.float32], evidence: NDArray[np.float32]
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """The chance (rows, cols) that a surface lies before a cell's far side, and its mean over the neighbourhood."""
    chance = np.asarray(1 - (1 - stopping) * certainty, dtype=np.float32)
    weight = np.minimum(evidence, np.float32(FULL_EVIDENCE))
    between, above, below = (np.empty_like(chance) for _ in range(3))
    gaussian = taps(1.0)
    blur(chance * weight, gaussian, between, above)
    blur(weight, gaussian, between, below)
    around = above / np.maximum(below, np.float32(1e-9))
    return chance, np.asarray(around, dtype=np.float32)


def known(certainty: NDArray[np.float32], evidence: NDArray[np.float32]) -> NDArray[np.bool_]:
    """Which cells (rows, cols) are known at all."""
    return np.asarray(certainty * evidence >= LEAST_EVIDENCE)


def occupancy(
    stopping: NDArray[np.float32],
    certainty: NDArray[np.float32],
    evidence: NDArray[np.float32],
    noise_cells: float,
) -> NDArray[np.float32]:
    """Probabilities of occupancy (rows, cols) float32; 0.5 where there is too little evidence.

    ``stopping``, ``certainty`` and ``evidence`` are as in :class:`mapping.forward.mapper.Fit`, ``noise_cells`` is the
    noise's standard deviation in cells.
    """
    chance, around = behind_surface(stopping, certainty, evidence)
    probability = np.empty_like(stopping)
    log_noise = math.log(min(max(noise_cells, LEAST_SPREAD), MOST_SPREAD))
    weights = COEFFICIENTS @ (1.0, log_noise, log_noise**2)
    _logistic(chance, around, stopping, certainty * evidence, weights, probability)
    return probability


@kernel
def _logistic(chance: Any, around: Any, stopping: Any, certain: Any, weights: Any, probability: Any) -> None:
    for i in range(chance.shape[0]):
        for j in range(chance.shape[1]):
            if certain[i, j] < LEAST_EVIDENCE:
                probability[i, j] = 0.5
                continue
            p, q = min(max(chance[i, j], CLIP), 1 - CLIP), min(max(around[i, j], CLIP), 1 - CLIP)
            odds = weights[0] + weights[1] * math.log(p / (1 - p)) + weights[2] * math.log(q / (1 - q))
            odds += weights[3] * math.log(stopping[i, j])
            probability[i, j] = 1 / (1 + math.exp(-min(max(odds, -30.0), 30.0)))
