"""The paper's probabilistic mapper (III-A, Eqs. 1 to 4): log-odds and an inverse sensor model."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from mapping.grid import Layer, OccupancyGrid
from mapping.rays import MARGIN_CELLS, add_log_odds, end_extent
from prim.frames import Pose2D, Scan
from prim.raycast import FloatArray
from prim.world import Bounds

FREE_PROBABILITY = 0.3
HIT_PROBABILITY = 0.9
REACH = 0.03
"""Eq. 4's model ends this far (m) before and behind the measured range."""

SPACING = REACH / 300
"""The model is looked up in a table with an entry every so many metres, and linear in between."""


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


class ProbabilisticMapper:
    """Adds up the log-odds of the inverse sensor model over all rays.

    One update per ray and cell, l <- l + l(o|s) - l(o) with l(o) = 0 (the signs of the paper's Eq. 3 are a
    misprint). A ray is Bresenham's line to its end point, walked on at the same slope to 0.03 m behind it; a ray
    without a return applies 0.3 up to range_max. Bounds as in :class:`mapping.deterministic.DeterministicMapper`.
    """

    name = "prob"

    def __init__(self, resolution: float = 0.01, bounds: Bounds | None = None) -> None:
        self.resolution = resolution
        self._layer = Layer(resolution, bounds, 0.0, np.float32, margin=REACH)
        steps = math.ceil((REACH + MARGIN_CELLS * resolution) / SPACING)
        distances = SPACING * np.arange(-steps, steps + 1, dtype=np.float64)
        self._table = log_odds(inverse_sensor_model(distances)).astype(np.float32)

    def update(self, scan: Scan, pose: Pose2D) -> None:
        """Adds one scan, taken by a laser at ``pose`` in the map frame."""
        place = (pose.x, pose.y, math.cos(pose.theta), math.sin(pose.theta))
        limits = (scan.range_min, scan.range_max)
        rays = (scan.ranges, scan.directions, place, limits, 1 / self.resolution)
        layer = self._layer
        if not layer.fixed:
            layer.cover(*end_extent(*rays))
        add_log_odds(layer.array, layer.frame.row, layer.frame.col, *rays, REACH, self._table, SPACING)

    def grid(self) -> OccupancyGrid:
        """The map so far."""
        frame, odds = self._layer.crop()
        return OccupancyGrid(frame, probability_of(np.asarray(odds, dtype=np.float32)))

    def finish(self) -> OccupancyGrid:
        """The map of all scans."""
        return self.grid()
