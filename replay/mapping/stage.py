"""The map of a replay: the place and size of its grid, its mapper, and the stage that adds scan after scan."""

from __future__ import annotations

import math
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from mapping.forward.mapper import estimate_range_noise
from mapping.grid import GridFrame, MapSizeError, OccupancyGrid
from mapping.kernels import MAX_STEPS
from mapping.mapper import Mapper, make_mapper
from prim.errors import LogReadError
from prim.scan import PosedScan, Scan
from replay.options import ReplayOptions
from replay.scans.posed_scans import PosedScans
from replay.timing import StageTimer

NOTED_DROPOUT_SHARE = 0.02
"""A larger share of dropouts is noted: free paths that graze things are taken for fewer; set by hand."""

NOISE_SCANS = 200
"""Where only the range noise is wanted, it is estimated from about this many scans, evenly spread; set by hand."""


@dataclass
class Usage:
    """How much of a log went into the map.

    Attributes:
        longest: Rays are followed no farther than this (m).
        scans: The number of scans.
        rays: The number of rays.
        hits: The number of rays that returned from a surface.
        far: How many of these returned from beyond ``longest``, so that their end points are on no map.
    """

    longest: float = math.inf
    scans: int = 0
    rays: int = 0
    hits: int = 0
    far: int = 0

    def count(self, scan: Scan) -> None:
        """Count a scan."""
        measured = scan.measured
        self.scans += 1
        self.rays += len(scan.ranges)
        self.hits += int(np.count_nonzero(measured))
        if scan.range_max > self.longest:
            self.far += int(np.count_nonzero(measured & (scan.ranges >= self.longest)))


class MappingStage:
    """Makes the map of a replay, scan by scan.

    Args:
        mapper: The mapper.
        snapshot_interval: N for a snapshot of the map after the scans at positions 0, N, 2N and so on; None for no
            snapshots.
        streaming: Whether the map is needed before the last scan, by the viewer or by the detector.
        resolution: Side of a cell (m).
        timer: Counts the time towards the stage «map».

    Attributes:
        mapper: The mapper.
        usage: What went into the map so far.
    """

    def __init__(
        self, mapper: Mapper, snapshot_interval: int | None, streaming: bool, resolution: float, timer: StageTimer
    ) -> None:
        self.mapper = mapper
        self.usage = Usage(MAX_STEPS * resolution)
        self._snapshot_interval = snapshot_interval
        self._add = mapper.update if streaming else mapper.accumulate
        self._timer = timer

    def update(self, posed: PosedScan) -> float:
        """Add a scan to the map; return the time that it took (s)."""
        start = time.perf_counter()
        with self._timer.stage("map"):
            for scan, pose in posed.pieces:
                self._add(scan, pose)
        elapsed = time.perf_counter() - start
        self.usage.count(posed.scan)
        return elapsed

    def snapshot(self, position: int, is_searched: bool) -> OccupancyGrid | None:
        """Return the map so far where it is to be shown.

        Args:
            position: The latest scan's position in the selection.
            is_searched: Whether primitives were detected in it: what is drawn over a map is of that map.

        Returns:
            The map; None where neither that is so, nor a snapshot due.
        """
        if not self._snapshot_interval or (position % self._snapshot_interval and not is_searched):
            return None
        with self._timer.stage("map"):
            return self.mapper.grid()

    def finish(self) -> OccupancyGrid:
        """Return the map of all scans."""
        with self._timer.stage("map"):
            return self.mapper.finish()

    def notes(self, grid: OccupancyGrid) -> list[str]:
        """Return what a user should know of dropouts, and where the final map ``grid`` shows nothing."""
        if not self.usage.hits:
            return [f"none of {self.usage.rays} rays returned from a surface: nothing is occupied"]
        dropouts = self.mapper.dropout_share or 0.0
        if dropouts > NOTED_DROPOUT_SHARE:
            return [
                f"about {dropouts:.0%} of the beams returned nothing where others met a surface: "
                "they are taken for dropouts, not for free paths",
                *self._notes_of_bounds(grid),
            ]
        return self._notes_of_bounds(grid)

    def _notes_of_bounds(self, grid: OccupancyGrid) -> list[str]:
        if self.usage.far:
            return [
                f"{self.usage.far} of {self.usage.hits} rays that returned from a surface are longer than "
                f"{self.usage.longest:.0f} m ({MAX_STEPS:.0f} cells): where they end is not on the map; "
                f"give --max-range {math.floor(self.usage.longest)}, or if that is right a coarser --resolution"
            ]
        if not (grid.free | grid.occupied).any():
            return ["no ray crosses the map's bounds: all of it is unknown"]
        return []


@contextmanager
def blames_log_for_size(path: Path, options: ReplayOptions) -> Iterator[None]:
    """Raise LogReadError where a map in a ``with`` block is too large because of what the log holds.

    Args:
        path: The log.
        options: Options of the replay; where they give bounds, or cells finer than by default, these are to blame.

    Yields:
        Nothing.
    """
    try:
        yield
    except MapSizeError as error:
        if options.bounds is not None or options.resolution < ReplayOptions.resolution:
            raise
        hint = (
            f"give --resolution {error.coarser:g} or a coarser one; where single ranges are too long, a --max-range, "
            "or the --bounds"
        )
        raise LogReadError(path, f"by its world, poses and ranges, {error.what}", hint) from error


def make_replay_mapper(
    posed_scans: PosedScans, frame: GridFrame, options: ReplayOptions, timer: StageTimer
) -> Mapper:
    """Make the mapper that the options name; estimate the range noise first where it needs that and lacks it.

    Args:
        posed_scans: The scans to be mapped.
        frame: The place and size of the map's grid.
        options: Mapper, sensor model, resolution and range noise.
        timer: Counts the time of estimating the noise towards the stage «map».

    Returns:
        The mapper, without a scan yet.

    Raises:
        LogReadError: The range noise is needed, and there are too few ranges to estimate it.
    """
    noise_std = options.noise_std
    if options.sensor_model == "gaussian" and noise_std is None:
        every = -(-len(posed_scans.scan_log) // NOISE_SCANS)
        pieces = [piece for posed in posed_scans if posed.position % every == 0 for piece in posed.pieces]
        with timer.stage("map"):
            noise_std = estimate_range_noise(pieces, frame)
        if noise_std is None:
            what = "too few ranges to find the noise for the Gaussian sensor model"
            raise LogReadError(posed_scans.scan_log.path, what, "give it, such as --noise-std 0.05")
    return make_mapper(options.mapper, options.resolution, frame.bounds, options.sensor_model, noise_std)
