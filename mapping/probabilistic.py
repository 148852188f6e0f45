"""The paper's probabilistic mapper (III-A, Eqs. 1 to 4): log-odds and an inverse sensor model."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from mapping.grid import GrowingGrid, OccupancyGrid
from mapping.kernels import TABLE_MARGIN_CELLS, add_log_odds, scan_arrays, scan_extent
from prim.arrays import FloatArray
from prim.scan import Scan
from prim.se2 import Pose2D
from prim.world import Bounds


@dataclass(frozen=True, slots=True)
class ProbabilisticOptions:
    """Parameters of the inverse sensor models."""

    free_probability: float = 0.3
    """Probability of occupancy before the measured range (Eq. 4)."""

    hit_probability: float = 0.9
    """Probability of occupancy at the measured range (Eq. 4)."""

    reach: float = 0.03
    """Eq. 4's ramps end this far (m) before and behind the measured range."""

    gaussian_reach: float = 4.0
    """The Gaussian model ends this many standard deviations before and behind the range: exp(-8) is 3e-4."""

    min_noise_cells: float = 0.3
    """Lower bound of the Gaussian model's standard deviation (cells). Set by hand."""

    table_entries: int = 300
    """Entries of the table on each side of the range, within the reach; linear in between. Set by hand."""


DEFAULTS = ProbabilisticOptions()


def log_odds(probability: FloatArray | float) -> FloatArray:
    """Return the log-odds ln(p / (1 - p)) of probabilities (Eq. 1)."""
    p = np.asarray(probability, dtype=float)
    return np.asarray(np.log(p / (1 - p)))


def probability_of(odds: NDArray[np.floating]) -> NDArray[np.float32]:
    """Return the probabilities 1 - 1 / (1 + exp(l)) of log-odds, in single precision (Eq. 2)."""
    probability = -np.asarray(odds, dtype=np.float32)
    with np.errstate(over="ignore"):
        np.exp(probability, out=probability)
    probability += 1
    return np.reciprocal(probability, out=probability)


def inverse_sensor_model(d: FloatArray | float, options: ProbabilisticOptions = DEFAULTS) -> FloatArray:
    """Return the probability that a cell is occupied, given its distance behind the measured range (Eq. 4).

    0.3 up to 0.03 m before the range, linear up to 0.9 at it, linear down to 0.5 at 0.03 m behind it, 0.5 beyond.

    Args:
        d: Distance of the cell's centre minus the measured range (m).
        options: The model's parameters.

    Returns:
        The probabilities, shaped like ``d``.
    """
    at = [-options.reach, 0.0, options.reach]
    return np.asarray(np.interp(d, at, [options.free_probability, options.hit_probability, 0.5]))


def gaussian_sensor_model(d: FloatArray | float, std: float, options: ProbabilisticOptions = DEFAULTS) -> FloatArray:
    """Return the Gaussian inverse sensor model (the paper's future work).

    b + (0.9 - b) exp(-d^2 / 2 std^2), with b = 0.3 before the measured range and 0.5 behind it.

    Args:
        d: Distance of the cell's centre minus the measured range (m).
        std: Standard deviation of the range noise (m).
        options: The model's parameters.

    Returns:
        The probabilities, shaped like ``d``.
    """
    distance = np.asarray(d, dtype=float)
    base = np.where(distance < 0, options.free_probability, 0.5)
    return np.asarray(base + (options.hit_probability - base) * np.exp(-0.5 * (distance / std) ** 2))


class ProbabilisticMapper:
    """Mapper that adds up the log-odds of an inverse sensor model over all rays: Eq. 4's, or the Gaussian.

    One update per ray and cell, l <- l + l(o|s) - l(o) with l(o) = 0 (the signs of the paper's Eq. 3 are a
    misprint). A ray is Bresenham's line to its end point, extended at the same slope by the model's reach; a ray
    without a return applies 0.3 up to range_max.
    """

    name = "prob"
    counts_visits = False
    dropout_share: float | None = None

    def __init__(
        self,
        resolution: float = 0.01,
        bounds: Bounds | None = None,
        noise_std: float | None = None,
        options: ProbabilisticOptions = DEFAULTS,
    ) -> None:
        """Start with an empty map.

        Args:
            resolution: Side of a cell (m).
            bounds: (x0, y0, x1, y1) (m) of the map; None: it grows with the scans.
            noise_std: Standard deviation (m) of the Gaussian sensor model; None: Eq. 4's model.
            options: The model's parameters.
        """
        self.resolution = resolution
        self.noise_std = None if noise_std is None else max(noise_std, options.min_noise_cells * resolution)
        self._options = options
        reach = options.reach if self.noise_std is None else options.gaussian_reach * self.noise_std
        spacing = reach / options.table_entries
        steps = math.ceil((reach + TABLE_MARGIN_CELLS * resolution) / spacing)
        distances = spacing * np.arange(-steps, steps + 1, dtype=np.float64)
        table = log_odds(self._sensor_model(distances, reach)).astype(np.float32)
        self._model = (reach, table, spacing)
        self._cells = GrowingGrid(resolution, bounds, 0.0, np.float32, margin=reach)

    def _sensor_model(self, distances: FloatArray, reach: float) -> FloatArray:
        if self.noise_std is None:
            return inverse_sensor_model(distances, self._options)
        model = gaussian_sensor_model(distances, self.noise_std, self._options)
        far = inverse_sensor_model(np.sign(distances), self._options)
        return np.where(np.abs(distances) < reach, model, far)

    def update(self, scan: Scan, pose: Pose2D) -> None:
        """See :meth:`mapping.mapper.Mapper.update`."""
        arrays = scan_arrays(scan, pose)
        cells, inverse_resolution = self._cells, 1 / self.resolution
        if not cells.fixed:
            cells.cover(*scan_extent(scan, pose, self.resolution))
        place = (cells.frame.row, cells.frame.col, inverse_resolution)
        add_log_odds(cells.array, place, arrays, self._model)

    accumulate = update

    def grid(self) -> OccupancyGrid:
        """Return the map so far."""
        frame, odds = self._cells.crop()
        return OccupancyGrid(frame, probability_of(np.asarray(odds, dtype=np.float32)))

    def finish(self) -> OccupancyGrid:
        """Return the map of all scans."""
        return self.grid()
