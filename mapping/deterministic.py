"""The paper's deterministic mapper (III-A): Bresenham's lines; the last scan wins."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from mapping.grid import UNKNOWN, GridFrame, GrowingGrid, OccupancyGrid
from mapping.kernels import FREE, OCCUPIED, UNSEEN, mark_scan, scan_arrays, scan_extent
from prim.scan import Scan
from prim.se2 import Pose2D
from prim.world import Bounds

_PROBABILITY = np.array([0.0, 1.0, UNKNOWN], dtype=np.float32)
assert (FREE, OCCUPIED, UNSEEN) == (0, 1, 2)


class DeterministicMapper:
    """Mapper that marks the cells that rays cross as free and the cells where they end as occupied.

    Cells start unknown. Per scan, all rays free their cells first; then all end points become occupied. A ray without
    a return frees its cells and marks none. Without bounds the grid grows with the end points; rays without a return
    are then followed within the bounds known so far.
    """

    name = "det"
    counts_visits = False
    noise_std: float | None = None
    dropout_share: float | None = None

    def __init__(self, resolution: float = 0.01, bounds: Bounds | None = None) -> None:
        """Start with an empty map.

        Args:
            resolution: Side of a cell (m).
            bounds: (x0, y0, x1, y1) (m) of the map; None: it grows with the scans.
        """
        self.resolution = resolution
        self._cells = GrowingGrid(resolution, bounds, UNSEEN, np.uint8)
        self._hits: list[tuple[GridFrame, NDArray[np.int64]]] = []

    def update(self, scan: Scan, pose: Pose2D) -> None:
        """See :meth:`mapping.mapper.Mapper.update`."""
        arrays = scan_arrays(scan, pose)
        cells, inverse_resolution = self._cells, 1 / self.resolution
        if not cells.fixed:
            cells.cover(*scan_extent(scan, pose, self.resolution))
        hits = mark_scan(cells.array, (cells.frame.row, cells.frame.col, inverse_resolution), arrays)
        if scan.first_beam == 0:
            self._hits.clear()
        for frame, earlier in self._hits:  # of the same scan: its end points come after all its rays
            if frame == cells.frame:
                cells.array.reshape(-1)[earlier] = OCCUPIED
        self._hits.append((cells.frame, hits))

    accumulate = update

    def grid(self) -> OccupancyGrid:
        """Return the map so far: 0 free, 1 occupied, 0.5 unknown."""
        frame, states = self._cells.crop()
        return OccupancyGrid(frame, _PROBABILITY[states])

    def finish(self) -> OccupancyGrid:
        """Return the map of all scans."""
        return self.grid()
