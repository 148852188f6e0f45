"""The mappers' protocol, and their factory."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from typing import Protocol

import numpy as np

from mapping.deterministic import DeterministicMapper
from mapping.forward.mapper import ForwardMapper
from mapping.grid import GridFrame, OccupancyGrid
from mapping.probabilistic import ProbabilisticMapper
from mapping.range_noise import check_noise
from prim.choices import MapperName, SensorModelName
from prim.errors import UsageError
from prim.scan import Scan
from prim.se2 import MAX_COORDINATE, Pose2D
from prim.world import Bounds


class Mapper(Protocol):
    """A mapper: builds an occupancy grid from scans taken at known poses.

    Attributes:
        name: One of MAPPERS.
        counts_visits: Whether its grids say how many rays reached each cell.
    """

    name: str
    counts_visits: bool

    @property
    def noise_std(self) -> float | None:
        """Standard deviation of the range noise (m), given or estimated; None where the mapper has none."""

    @property
    def dropout_share(self) -> float | None:
        """Share of the rays that met something and returned nothing; None where the mapper does not estimate it."""

    def update(self, scan: Scan, pose: Pose2D) -> None:
        """Add one scan, or the next piece of one, and update the map.

        Args:
            scan: The scan.
            pose: Pose of the laser in the map frame.
        """

    def accumulate(self, scan: Scan, pose: Pose2D) -> object:
        """Add one scan without updating the map: :meth:`finish` gives the same, :meth:`grid` need not.

        Args:
            scan: The scan.
            pose: Pose of the laser in the map frame.

        Returns:
            Nothing that callers of the protocol use.
        """

    def grid(self) -> OccupancyGrid:
        """Return the map so far; later updates do not change it."""

    def finish(self) -> OccupancyGrid:
        """Return the map of all scans."""


MIN_RESOLUTION, MAX_RESOLUTION = 1e-6, 100.0
"""The smallest and the largest side of a cell (m); set by hand."""

MAPPERS = tuple(name.value for name in MapperName)
SENSOR_MODELS = tuple(name.value for name in SensorModelName)


def takes_noise(name: str, sensor_model: str) -> bool:
    """Say whether a mapper takes the range noise.

    Args:
        name: One of MAPPERS.
        sensor_model: One of SENSOR_MODELS.

    Returns:
        Whether it does.
    """
    return name == MapperName.FORWARD or sensor_model == SensorModelName.GAUSSIAN


def check_mapper(name: str, sensor_model: str = "eq4", noise_std: float | None = None) -> None:
    """Check that a mapper and a sensor model exist and fit together.

    Args:
        name: One of MAPPERS.
        sensor_model: One of SENSOR_MODELS.
        noise_std: Standard deviation of the range noise (m), where it is given.

    Raises:
        UsageError: Where they do not.
    """
    if name not in MAPPERS:
        raise UsageError(f"there is no mapper {name!r}: choose from {', '.join(MAPPERS)}")
    if sensor_model not in SENSOR_MODELS:
        raise UsageError(f"there is no sensor model {sensor_model!r}: choose from {', '.join(SENSOR_MODELS)}")
    if sensor_model != "eq4" and name != "prob":
        raise UsageError(f"--sensor-model goes with --mapper prob, not with --mapper {name}")
    if noise_std is None:
        return
    if not takes_noise(name, sensor_model):
        raise UsageError("--noise-std goes with --mapper forward, or with --mapper prob --sensor-model gaussian")
    check_noise(noise_std)


def check_cells(resolution: float, bounds: Bounds | None) -> None:
    """Check that a map can have cells of a side and bounds.

    Args:
        resolution: Side of a cell (m).
        bounds: (x0, y0, x1, y1) (m); None where they are not given.

    Raises:
        UsageError: Where it cannot.
    """
    if not MIN_RESOLUTION <= resolution <= MAX_RESOLUTION:
        allowed = f"it must be above 0 and at most {MAX_RESOLUTION:g} m"
        if 0 < resolution < MIN_RESOLUTION:
            allowed = f"it must be at least {MIN_RESOLUTION:g} m"
        raise UsageError(f"--resolution is {resolution:g}: {allowed}")
    if bounds is None:
        return
    x0, y0, x1, y1 = bounds
    if not (-math.inf < x0 < x1 < math.inf and -math.inf < y0 < y1 < math.inf):
        given = " ".join(f"{value:g}" for value in bounds)
        raise UsageError(f"--bounds is {given}: X0 must be below X1 and Y0 below Y1")
    if max(map(abs, bounds)) > MAX_COORDINATE:
        given = " ".join(f"{value:g}" for value in bounds)
        raise UsageError(f"--bounds is {given}: no map reaches farther than {MAX_COORDINATE:g} m")
    GridFrame.covering(bounds, resolution)


def make_mapper(
    name: str,
    resolution: float,
    bounds: Bounds | None = None,
    sensor_model: str = "eq4",
    noise_std: float | None = None,
    threads: int | None = None,
) -> Mapper:
    """Make a mapper by name, its kernels compiled.

    Args:
        name: One of MAPPERS.
        resolution: Side of a cell (m).
        bounds: (x0, y0, x1, y1) (m) of the map; None: it grows with the scans.
        sensor_model: One of SENSOR_MODELS; other than ``eq4`` for ``prob`` alone.
        noise_std: Standard deviation of the range noise (m): ``forward`` estimates it where it is not given, the
            ``gaussian`` sensor model needs it.
        threads: Number of threads of ``forward``; None: one for each available core. It does not change the map.

    Returns:
        The mapper.

    Raises:
        UsageError: Where the arguments do not fit together.
    """
    check_mapper(name, sensor_model, noise_std)
    check_cells(resolution, bounds)
    if sensor_model == "gaussian" and noise_std is None:
        raise UsageError("the Gaussian sensor model needs --noise-std")
    make = _FACTORIES[name]
    warm_up = make(0.5, (-1.0, -1.0, 1.0, 1.0), noise_std, threads)
    warm_up.update(_WARM_UP_SCAN, Pose2D(0.1, 0.1))
    warm_up.grid()
    warm_up.finish()
    return make(resolution, bounds, noise_std, threads)


def _make_deterministic(
    resolution: float, bounds: Bounds | None, noise_std: float | None, threads: int | None
) -> Mapper:
    return DeterministicMapper(resolution, bounds)


def _make_probabilistic(
    resolution: float, bounds: Bounds | None, noise_std: float | None, threads: int | None
) -> Mapper:
    return ProbabilisticMapper(resolution, bounds, noise_std)


def _make_forward(resolution: float, bounds: Bounds | None, noise_std: float | None, threads: int | None) -> Mapper:
    return ForwardMapper(resolution, bounds, noise_std, threads=threads)


_FACTORIES: Mapping[str, Callable[[float, Bounds | None, float | None, int | None], Mapper]] = {
    MapperName.DET: _make_deterministic,
    MapperName.PROB: _make_probabilistic,
    MapperName.FORWARD: _make_forward,
}
"""How each mapper is made, of its resolution (m), bounds (m), range noise (m) and number of threads."""

_WARM_UP_SCAN = Scan(0, "", 0.0, 2.0, 0.1, 1.0, np.array([0.7, -np.inf, np.inf], dtype=np.float32))
