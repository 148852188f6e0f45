"""What a mapper is, and which there are."""

from __future__ import annotations

import math
from typing import Protocol

import numpy as np

from mapping.deterministic import DeterministicMapper
from mapping.forward.mapper import ForwardMapper
from mapping.grid import OccupancyGrid
from mapping.probabilistic import ProbabilisticMapper
from prim.errors import UsageError
from prim.scan import Scan
from prim.se2 import Pose2D
from prim.world import Bounds


class Mapper(Protocol):
    """Makes an occupancy grid of scans taken at known poses."""

    name: str

    @property
    def noise_std(self) -> float | None:
        """The sensor's noise (m) that the mapper reckons with; None where it does not."""

    def update(self, scan: Scan, pose: Pose2D) -> None:
        """Adds one scan, taken by a laser at ``pose`` in the map frame."""

    def keep(self, scan: Scan, pose: Pose2D) -> object:
        """As :meth:`update`, where nobody looks at the map before it is finished."""

    def grid(self) -> OccupancyGrid:
        """The map so far; later updates do not change it."""

    def finish(self) -> OccupancyGrid:
        """The map of all scans."""


MAPPERS = ("det", "prob", "forward")
SENSOR_MODELS = ("eq4", "gaussian")


def check_mapper(name: str, sensor_model: str = "eq4", noise_std: float | None = None) -> None:
    """Raises UsageError where there is no such mapper or sensor model, or where they do not go together."""
    if name not in MAPPERS:
        raise UsageError(f"there is no mapper {name!r}: choose from {', '.join(MAPPERS)}")
    if sensor_model not in SENSOR_MODELS:
        raise UsageError(f"there is no sensor model {sensor_model!r}: choose from {', '.join(SENSOR_MODELS)}")
    if sensor_model != "eq4" and name != "prob":
        raise UsageError(f"--sensor-model goes with --mapper prob, not with --mapper {name}")
    if noise_std is None:
        return
    if name != "forward" and sensor_model != "gaussian":
        raise UsageError("--noise-std goes with --mapper forward, or with --mapper prob --sensor-model gaussian")
    if not 0 < noise_std < math.inf:
        raise UsageError(f"--noise-std is {noise_std:g}: it must be above 0")


def make_mapper(
    name: str,
    resolution: float,
    bounds: Bounds | None = None,
    sensor_model: str = "eq4",
    noise_std: float | None = None,
) -> Mapper:
    """A mapper by name, over given or growing ``bounds`` (m), its kernels compiled.

    ``noise_std`` (m) is the sensor's noise: ``forward`` finds it where it is not given, ``prob`` needs it for the
    ``gaussian`` sensor model. Raises UsageError.
    """
    check_mapper(name, sensor_model, noise_std)
    if sensor_model == "gaussian" and noise_std is None:
        raise UsageError("the Gaussian sensor model needs --noise-std")
    trial = _make(name, 0.5, (-1.0, -1.0, 1.0, 1.0), noise_std)
    trial.update(_FEW_RAYS, Pose2D(0.1, 0.1))
    trial.grid()
    trial.finish()
    return _make(name, resolution, bounds, noise_std)


def _make(name: str, resolution: float, bounds: Bounds | None, noise_std: float | None) -> Mapper:
    if name == "forward":
        return ForwardMapper(resolution, bounds, noise_std)
    if name == "prob":
        return ProbabilisticMapper(resolution, bounds, noise_std)
    return DeterministicMapper(resolution, bounds)


_FEW_RAYS = Scan(0, "", 0.0, 2.0, 0.1, 1.0, np.array([0.7, -np.inf, np.inf], dtype=np.float32))
