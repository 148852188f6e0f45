"""The place and size of a replay's map: as given, of the recorded world, or of the end points of the beams.

A map of the end points must not be at the mercy of a few of them. Two things make it too large:

- Single wild returns, or poses. What lies farther from the bulk of the end points than twice its own extent is left
  out (a Tukey fence, with wider percentiles).
- Range noise, whose tails reach several standard deviations beyond the walls; the cells there take hits that are
  none, and the range noise that the forward mapper finds is too low. Where noise blurs a map by a tenth of its
  extent, a coarse forward map of a part of the scans finds the cells that the end points are from, and the map holds
  those of all but a small share of them.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from mapping.forward.mapper import ForwardFit, ForwardMapper
from mapping.grid import MAX_CELLS, GridFrame, MapSizeError
from mapping.kernels import MAX_STEPS, scan_extent
from mapping.range_noise import neighbour_noise
from prim.arrays import FloatArray
from prim.errors import LogReadError
from prim.scan import PosedScan, Scan
from prim.se2 import Pose2D
from prim.world import Bounds, World
from replay.options import ReplayOptions
from replay.poses.sensors import REST_HINT
from replay.scans.posed_scans import PosedScans

WORLD_MARGIN = 0.1
"""Automatic bounds reach this far (m) beyond the recorded world."""


@dataclass(frozen=True)
class MapBoundsOptions:
    """How the bounds of a map follow from end points; set by hand, those of noise on simulated logs.

    Attributes:
        sampled_scans: The bulk of the end points is that of at least half as many scans, evenly spread.
        tail_share: The bulk leaves out this share of them at either end of either axis.
        fence: What is mapped reaches no farther beyond the bulk than this many times its extent.
        slack: Where poses are still to be matched, the map reaches so many times its extent farther on each side.
        free_margin: Where no beam ends within reach, the map reaches so many cells beyond the sensor.
        blurred_extent: The noise is taken into account where three standard deviations of it are a larger share of
            the map's smaller side than this.
        cells_per_std: Cells of the coarse forward map in a standard deviation of the noise.
        noise_tail_share: The map leaves out this share of the end points at either end of either axis, after the
            coarse map has found the cells that they are from.
        passes: The coarse map is made anew within its own bounds at most so often.
        margin: The map then reaches so many of its cells beyond them.
        sampled_rays: A coarse map is made of about so many rays.
        least_gain: Its bounds are taken where they leave out at least this share of the area.
        free_cells: However few rays a log has, its map may have so many cells.
        cells_per_ray: And so many for each ray: more of them are seen by none.
    """

    sampled_scans: int = 400
    tail_share: float = 0.05
    fence: float = 2.0
    slack: float = 0.25
    free_margin: int = 200
    blurred_extent: float = 0.1
    cells_per_std: float = 15.0
    noise_tail_share: float = 0.005
    passes: int = 6
    margin: int = 5
    sampled_rays: int = 30_000
    least_gain: float = 0.1
    free_cells: int = 30_000_000
    cells_per_ray: int = 1000


OPTIONS = MapBoundsOptions()

MAX_COARSE_CELLS = 400
"""A coarse map has at most about so many rows and columns."""


class MapBounds(NamedTuple):
    """The place and size of a map.

    Attributes:
        frame: The smallest grid of whole cells that covers the bounds.
        notes: What a user should know of what lies outside.
    """

    frame: GridFrame
    notes: tuple[str, ...] = ()


def choose_map_bounds(
    posed_scans: PosedScans, replay: ReplayOptions, world: World | None, options: MapBoundsOptions = OPTIONS
) -> MapBounds:
    """Choose the place and size of the map's grid by the given bounds, else the recorded world, else the end points.

    Args:
        posed_scans: The scans to be mapped.
        replay: The resolution and, where they are given, the bounds.
        world: The recorded world; None where it is not known.
        options: How bounds follow from end points.

    Returns:
        The grid, and notes.

    Raises:
        LogReadError: The bounds follow from the end points, and no usable scan has a pose.
        MapSizeError: The grid would have too many cells.
    """
    if replay.bounds is not None:
        return MapBounds(GridFrame.covering(replay.bounds, replay.resolution))
    rays = posed_scans.scan_log.expected_rays
    if world is not None:
        return MapBounds(_frame(_bounds_of_world(world), replay.resolution, rays, options))
    sample = _Sample(options.sampled_scans, replay.resolution)
    extent = sample.extent_of_all(posed_scans)
    if extent is None:
        raise LogReadError(posed_scans.scan_log.path, "no scan that can be used has a pose", REST_HINT)
    points = sample.end_points()
    if not len(points):
        return MapBounds(_free_frame(sample, replay.resolution, options))
    bounds, notes = extent, []
    fence = _fence(points, sample.positions(), options)
    if not _contains(fence, extent):
        bounds, outside = _bounds_within(posed_scans, fence, extent, MAX_STEPS * replay.resolution)
        what = f"{outside} end points and poses are far from all others, and lie outside {{}}"
        notes.append(_note(what, bounds, extent, replay.resolution))
    noise = sample.noise()
    sharp = _without_noise(sample, bounds, noise, replay.resolution, options)
    if _area(sharp) < (1 - options.least_gain) * _area(bounds):
        bounds = sharp
        share = float(np.mean(~_inside(points, bounds)))
        beyond = f"range noise of about {noise:.2g} m carries {share:.0%} of the end points beyond "
        what = beyond + "{}, within which the surfaces lie"
        notes.append(_note(what, bounds, extent, replay.resolution))
    return MapBounds(_frame(bounds, replay.resolution, rays, options), tuple(notes))


def bounds_of_bulk(posed_scans: PosedScans, resolution: float, options: MapBoundsOptions = OPTIONS) -> Bounds | None:
    """Find bounds for a map that poses are matched with, where single end points or poses are far from all others.

    Args:
        posed_scans: The scans, with poses that are about right.
        resolution: Side of a cell (m).
        options: How bounds follow from end points.

    Returns:
        The bounds (m) of the others, and ``slack`` times their extent on each side; None where none is that far.
    """
    sample = _Sample(options.sampled_scans, resolution)
    extent = sample.extent_of_all(posed_scans)
    points = sample.end_points() if extent is not None else np.zeros((0, 2))
    if extent is None or not len(points):
        return None
    fence = _fence(points, sample.positions(), options)
    if _contains(fence, extent):
        return None
    (x0, y0, x1, y1), _ = _bounds_within(posed_scans, fence, extent, MAX_STEPS * resolution)
    slack = options.slack * max(x1 - x0, y1 - y0)
    return x0 - slack, y0 - slack, x1 + slack, y1 + slack


def _frame(bounds: Bounds, resolution: float, rays: int, options: MapBoundsOptions) -> GridFrame:
    """Return the grid that covers bounds. Raises MapSizeError where it has far more cells than its rays can see."""
    width, height = bounds[2] - bounds[0], bounds[3] - bounds[1]
    cells, most = width * height / resolution**2, max(options.free_cells, options.cells_per_ray * rays)
    if cells > most and most < MAX_CELLS:
        what = f"a map of {width:.0f} x {height:.0f} m has {cells / 1e6:.0f} million cells of {resolution:g} m"
        raise MapSizeError(f"{what}, far more than {rays:,} rays can see", resolution, cells / most)
    return GridFrame.covering(bounds, resolution)


def grid_frame_of_world(world: World, resolution: float) -> GridFrame:
    """Compute the place and size of the grid that a recorded world is mapped on.

    Args:
        world: The world.
        resolution: Side of a cell (m).

    Returns:
        The smallest grid of whole cells that covers the world and a margin of WORLD_MARGIN.
    """
    return GridFrame.covering(_bounds_of_world(world), resolution)


def _bounds_of_world(world: World) -> Bounds:
    x0, y0, x1, y1 = world.bounds
    return x0 - WORLD_MARGIN, y0 - WORLD_MARGIN, x1 + WORLD_MARGIN, y1 + WORLD_MARGIN


def extent_of_scans(scans: Iterable[tuple[Scan, Pose2D]], resolution: float) -> Bounds | None:
    """Compute the extent of the end points of all measured beams, and of the sensor, in whole cells.

    Args:
        scans: Scans, or pieces of them, with the laser's poses.
        resolution: Side of a cell (m).

    Returns:
        The extent (m); None without scans.
    """
    extents = [scan_extent(scan, pose, resolution) for scan, pose in scans]
    if not extents:
        return None
    row, col = np.min([extent[:2] for extent in extents], axis=0).tolist()
    last_row, last_col = np.max([extent[2:] for extent in extents], axis=0).tolist()
    return col * resolution, row * resolution, (last_col + 1) * resolution, (last_row + 1) * resolution


class _Sample:
    """Some of the scans of a log, evenly spread: at least half of a number, and all where there are fewer.

    Args:
        size: The number.
        resolution: Side of a cell (m).
    """

    def __init__(self, size: int, resolution: float) -> None:
        self._size = size
        self._resolution = resolution
        self._scans: list[PosedScan] = []

    @property
    def pieces(self) -> Iterator[tuple[Scan, Pose2D]]:
        """The scans, or pieces of them, with the laser's poses."""
        return (piece for posed in self._scans for piece in posed.pieces)

    def extent_of_all(self, posed_scans: PosedScans) -> Bounds | None:
        """Go through all scans, and keep some of them; return the extent (m) of all end points."""
        return extent_of_scans(self._kept(posed_scans), self._resolution)

    def _kept(self, posed_scans: PosedScans) -> Iterator[tuple[Scan, Pose2D]]:
        stride = 1
        for number, posed in enumerate(posed_scans):
            if number % stride == 0:
                self._scans.append(posed)
            if len(self._scans) > self._size:
                self._scans, stride = self._scans[::2], 2 * stride
            yield from posed.pieces

    def end_points(self) -> FloatArray:
        """Return the end points (N, 2) in m, map frame, of the beams that measured something within reach."""
        reach = MAX_STEPS * self._resolution
        return np.concatenate([_end_points(scan, pose, reach) for scan, pose in self.pieces])

    def positions(self) -> FloatArray:
        """Return the positions (N, 2) of the sensor in m."""
        return np.array([(pose.x, pose.y) for _, pose in self.pieces])

    def thinned(self, rays: int) -> list[tuple[Scan, Pose2D]]:
        """Return the pieces with every n-th beam alone, so that about so many rays are left."""
        step = -(-sum(len(scan.ranges) for scan, _ in self.pieces) // rays)
        if step == 1:
            return list(self.pieces)
        return [
            (replace(scan, ranges=scan.ranges[::step], angle_increment=step * scan.angle_increment), pose)
            for scan, pose in self.pieces
        ]

    def longest_range(self) -> float:
        """Return the longest range (m) that the scanners can measure."""
        return max(scan.range_max for scan, _ in self.pieces)

    def noise(self) -> float:
        """Return the range noise (m) as neighbouring beams show it."""
        return neighbour_noise(np.concatenate([scan.ranges[scan.measured] for scan, _ in self.pieces])) or 0.0


def _end_points(scan: Scan, pose: Pose2D, reach: float) -> FloatArray:
    """Return the end points (N, 2) in m, map frame, of the beams of a scan that end within reach (m)."""
    measured = scan.measured & (scan.ranges < reach)
    return pose.apply(scan.directions[measured] * scan.ranges[measured, None])


def _inside(points: FloatArray, bounds: Bounds) -> NDArray[np.bool_]:
    """Return which points (N, 2) lie within bounds."""
    x, y = points.T
    return np.asarray((bounds[0] <= x) & (x <= bounds[2]) & (bounds[1] <= y) & (y <= bounds[3]))


def _contains(outer: Bounds, inner: Bounds) -> bool:
    return outer[0] <= inner[0] and outer[1] <= inner[1] and inner[2] <= outer[2] and inner[3] <= outer[3]


def _extent(points: FloatArray) -> Bounds:
    """Return the extent of points (N, 2)."""
    (x0, y0), (x1, y1) = points.min(axis=0).tolist(), points.max(axis=0).tolist()
    return x0, y0, x1, y1


def _area(bounds: Bounds) -> float:
    return (bounds[2] - bounds[0]) * (bounds[3] - bounds[1])


def _is_blurred(bounds: Bounds, noise: float, options: MapBoundsOptions) -> bool:
    """Return whether noise (m) matters within bounds."""
    return 3 * noise > options.blurred_extent * min(bounds[2] - bounds[0], bounds[3] - bounds[1])


def _union(a: Bounds, b: Bounds) -> Bounds:
    return min(a[0], b[0]), min(a[1], b[1]), max(a[2], b[2]), max(a[3], b[3])


def _fence(points: FloatArray, positions: FloatArray, options: MapBoundsOptions) -> Bounds:
    """Return how far the map may reach, by the bulk of the end points (N, 2) and that of the positions (M, 2)."""
    shares = [options.tail_share, 1 - options.tail_share]
    bulk = np.concatenate([np.quantile(points, shares, axis=0), np.quantile(positions, shares, axis=0)])
    x0, y0, x1, y1 = _extent(bulk)
    width, height = options.fence * (x1 - x0), options.fence * (y1 - y0)
    return x0 - width, y0 - height, x1 + width, y1 + height


def _bounds_within(posed_scans: PosedScans, fence: Bounds, extent: Bounds, reach: float) -> tuple[Bounds, int]:
    """Return the extent of all end points and positions within a fence, and how many lie outside."""
    bounds, outside = None, 0
    for posed in posed_scans:
        for scan, pose in posed.pieces:
            points = np.vstack([_end_points(scan, pose, reach), (pose.x, pose.y)])
            inside = _inside(points, fence)
            outside += int(np.count_nonzero(~inside))
            if inside.any():
                bounds = _extent(points[inside]) if bounds is None else _union(bounds, _extent(points[inside]))
    return bounds or extent, outside


def _free_frame(sample: _Sample, resolution: float, options: MapBoundsOptions) -> GridFrame:
    """Return the grid of a map without end points: what is free around the sensor."""
    margin = min(options.free_margin * resolution, sample.longest_range())
    x0, y0, x1, y1 = _extent(sample.positions())
    return GridFrame.covering((x0 - margin, y0 - margin, x1 + margin, y1 + margin), resolution)


def _without_noise(
    sample: _Sample, bounds: Bounds, noise: float, resolution: float, options: MapBoundsOptions
) -> Bounds:
    """Return the bounds of the cells that end points are from, by coarse forward maps, and of the sensor.

    Each map within smaller bounds separates them better from their noise: beams that end outside leave no cells
    there to explain them. Bounds that are not blurred stay as they are: by the noise as neighbouring beams show it,
    and by that of the map.
    """
    if not _is_blurred(bounds, noise, options):
        return bounds
    pieces = sample.thinned(options.sampled_rays)
    longest = max(bounds[2] - bounds[0], bounds[3] - bounds[1])
    cell = max(noise / options.cells_per_std, longest / MAX_COARSE_CELLS, resolution)
    for _ in range(options.passes):
        mapper = ForwardMapper(cell, bounds)
        for scan, pose in pieces:
            mapper.accumulate(scan, pose)
        fit = mapper.fit()
        if not _is_blurred(bounds, mapper.noise_std or 0.0, options):
            return bounds
        before, bounds = bounds, _bounds_of_hits(fit, options.noise_tail_share)
        if bounds == before:
            break
    margin, positions = options.margin * resolution, sample.positions()
    bounds = bounds[0] - margin, bounds[1] - margin, bounds[2] + margin, bounds[3] + margin
    near = positions[_inside(positions, before)]
    return _union(bounds, _extent(near)) if len(near) else bounds


def _bounds_of_hits(fit: ForwardFit, share: float) -> Bounds:
    """Return the bounds (m) of a map's expected hits but for a share of them at either end of either axis."""
    hits = (fit.stopping * fit.visits).astype(float)
    if not hits.any():
        return fit.frame.bounds
    sides = []
    for axis, first in ((0, fit.frame.col), (1, fit.frame.row)):
        reached = np.cumsum(hits.sum(axis=axis))
        low, high = np.searchsorted(reached, [share * reached[-1], (1 - share) * reached[-1]]).tolist()
        sides.append(((first + low) * fit.frame.resolution, (first + high + 1) * fit.frame.resolution))
    (x0, x1), (y0, y1) = sides
    return x0, y0, x1, y1


def _note(what: str, bounds: Bounds, extent: Bounds, resolution: float) -> str:
    """Describe what lies outside the map's bounds, and how it can be seen where a map of all is possible."""
    inner, outer = (" ".join(f"{side:.2f}" for side in sides) for sides in (bounds, extent))
    note = what.format(f"the map's bounds ({inner})")
    try:
        GridFrame.covering(extent, resolution)
    except MapSizeError:
        return note
    return f"{note}; for all of them give --bounds {outer}"
