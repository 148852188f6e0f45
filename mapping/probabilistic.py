"""The paper's probabilistic mapper (III-A, Eqs. 1 to 4): log-odds and an inverse sensor model."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from mapping.grid import Layer, OccupancyGrid
from mapping.kernels import MARGIN_CELLS, add_log_odds, end_extent
from prim.arrays import FloatArray
from prim.scan import Scan
from prim.se2 import Pose2D
from prim.world import Bounds

FREE_PROBABILITY = 0.3
HIT_PROBABILITY = 0.9
REACH = 0.03
"""Eq. 4's model ends this far (m) before and behind the measured range."""

LEAST_NOISE = 0.3
"""The Gaussian model is at least this many cells wide."""

GAUSSIAN_REACH = 4.0
"""The Gaussian model ends this many standard deviations before and behind the measured range."""

ENTRIES = 300
"""The model is looked up in a table with so many entries on each side of the range, and linear in between."""


def log_odds(probability: FloatArray | float) -> FloatArray:
    """Eq. 1: ln(p / (1 - p))."""
    p = np.asarray(probability, dtype=float)
    return np.asarray(np.log(p / (1 - p)))


def probability_of(odds: NDArray[np.floating]) -> NDArray[np.float32]:
    """Eq. 2: 1 - 1 / (1 + exp(l)), in single precision."""
    probability = -np.asarray(odds, dtype=np.float32)
    with np.errstate(over="ignore"):
        np.exp(probability, out=probability)
    probability += 1
    return np.reciprocal(probability, out=probability)


def inverse_sensor_model(d: FloatArray | float) -> FloatArray:
    """Eq. 4: the probability that a cell is occupied whose centre lies ``d`` metres behind the measured range.

    0.3 up to 0.03 m before it, linear up to 0.9 at it, linear down to 0.5 at 0.03 m behind it, 0.5 beyond.
    """
    return np.asarray(np.interp(d, [-REACH, 0.0, REACH], [FREE_PROBABILITY, HIT_PROBABILITY, 0.5]))


def gaussian_sensor_model(d: FloatArray | float, std: float) -> FloatArray:
    """The paper's future work: b + (0.9 - b) exp(-d^2 / 2 std^2), with b = 0.3 before the measured range, 0.5 behind.

    ``d`` as in :func:`inverse_sensor_model`, ``std`` (m) the noise's standard deviation.
    """
    distance = np.asarray(d, dtype=float)
    base = np.where(distance < 0, FREE_PROBABILITY, 0.5)
    return np.asarray(base + (HIT_PROBABILITY - base) * np.exp(-0.5 * (distance / std) ** 2))


class ProbabilisticMapper:
    """Adds up the log-odds of the inverse sensor model over all rays: Eq. 4's, or with ``noise_std`` the Gaussian.

    One update per ray and cell, l <- l + l(o|s) - l(o) with l(o) = 0 (the signs of the paper's Eq. 3 are a
    misprint). A ray is Bresenham's line to its end point, walked on at the same slope to 0.03 m behind it; a ray
    without a return applies 0.3 up to range_max. Bounds as in :class:`mapping.deterministic.DeterministicMapper`.
    """

    name = "prob"

    def __init__(
        self, resolution: float = 0.01, bounds: Bounds | None = None, noise_std: float | None = None
    ) -> None:
        self.resolution = resolution
        self.noise_std = None if noise_std is None else max(noise_std, LEAST_NOISE * resolution)
        self._reach = REACH if self.noise_std is None else GAUSSIAN_REACH * self.noise_std
        self._spacing = self._reach / ENTRIES
        self._layer = Layer(resolution, bounds, 0.0, np.float32, margin=self._reach)
        steps = math.ceil((self._reach + MARGIN_CELLS * resolution) / self._spacing)
        distances = self._spacing * np.arange(-steps, steps + 1, dtype=np.float64)
        self._table = log_odds(self._model(distances)).astype(np.float32)

    def _model(self, distances: FloatArray) -> FloatArray:
        if self.noise_std is None:
            return inverse_sensor_model(distances)
        model = gaussian_sensor_model(distances, self.noise_std)
        return np.where(np.abs(distances) < self._reach, model, inverse_sensor_model(np.sign(distances)))

    def update(self, scan: Scan, pose: Pose2D) -> None:
        """Adds one scan, taken by a laser at ``pose`` in the map frame."""
        place = (pose.x, pose.y, math.cos(pose.theta), math.sin(pose.theta))
        limits = (scan.range_min, scan.range_max)
        rays = (scan.ranges, scan.directions, place, limits, 1 / self.resolution)
        layer = self._layer
        if not layer.fixed:
            layer.cover(*end_extent(*rays))
        add_log_odds(layer.array, layer.frame.row, layer.frame.col, *rays, self._reach, self._table, self._spacing)

    keep = update

    def grid(self) -> OccupancyGrid:
        """The map so far."""
        frame, odds = self._layer.crop()
        return OccupancyGrid(frame, probability_of(np.asarray(odds, dtype=np.float32)))

    def finish(self) -> OccupancyGrid:
        """The map of all scans."""
        return self.grid()
