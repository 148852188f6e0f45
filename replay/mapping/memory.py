"""The memory that a replay may take: it is refused before it takes more."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

from mapping.grid import GridFrame
from prim.choices import MapperName
from prim.errors import LogReadError
from prim.memory import machine_memory
from replay.options import ReplayOptions

GIGABYTE = 1e9


@dataclass(frozen=True)
class MemoryCosts:
    """What a replay takes, rounded up; measured by the peak memory of replays of 0.04 to 100 million cells.

    Attributes:
        base: Whatever is replayed (bytes).
        cell: For each cell of the map, with the detection of primitives in it (bytes), by mapper.
        ray: For each ray, by mapper: forward keeps all (bytes).
    """

    base: int = 300_000_000
    cell: Mapping[str, int] = field(
        default_factory=lambda: {MapperName.DET: 30, MapperName.PROB: 30, MapperName.FORWARD: 100}
    )
    ray: Mapping[str, int] = field(default_factory=lambda: {MapperName.FORWARD: 16})


class MemoryBudget:
    """Refuses a replay that would take more memory than is allowed.

    Args:
        log: The log.
        options: The mappers, and how much memory they may take.
        frame: The place and size of the map's grid.
        costs: What a replay takes.
    """

    def __init__(self, log: Path, options: ReplayOptions, frame: GridFrame, costs: MemoryCosts | None = None) -> None:
        costs = costs or MemoryCosts()
        self._log = log
        self._cells = frame.rows * frame.cols
        self._per_ray = sum(costs.ray.get(mapper, 0) for mapper in options.mappers)
        self._fixed = costs.base + self._cells * sum(costs.cell[mapper] for mapper in options.mappers)
        self._allowed = options.max_memory or machine_memory() / 2 / GIGABYTE

    def check(self, rays: int) -> None:
        """Check that there is room.

        Args:
            rays: The number of rays so far, or that are expected.

        Raises:
            LogReadError: There is not.
        """
        allowed, needed = self._allowed * GIGABYTE, self._fixed + rays * self._per_ray
        if needed <= allowed:
            return
        gigabytes = needed / GIGABYTE
        what = (
            f"{rays / 1e6:.3g} million rays on a map of {self._cells / 1e6:.3g} million cells take about "
            f"{gigabytes:.3g} GB of memory, more than {self._allowed:.3g} GB"
        )
        more = f"allow it with --max-memory {math.ceil(1.01 * gigabytes * 10) / 10:g}"
        if self._fixed >= allowed:
            raise LogReadError(self._log, what, f"{more}, or take larger cells")
        stride = math.ceil(rays * self._per_ray / (allowed - self._fixed))
        raise LogReadError(self._log, what, f"replay fewer scans with --stride {stride}, or {more}")
