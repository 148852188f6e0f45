"""Registration of pairs of scans by their surfaces: points with normals, and how far those of two scans are apart.

Each scan is reduced to points on locally straight surfaces: around each beam a line is fitted to its neighbours'
ranges, which removes most of the range noise. Points of two scans correspond where they are nearest neighbours with
similar normals; their distance along the mean normal is the residual (point to line, see Chen and Medioni, «Object
modelling by registration of multiple range images», 1992), both ways, weighted by the function of Geman and McClure.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from mapping.range_noise import neighbour_noise
from prim.arrays import FloatArray
from prim.compiled import inline, kernel
from prim.scan import PosedScan, Scan
from prim.se2 import compose_poses, relative_poses


@dataclass(frozen=True)
class RegistrationOptions:
    """The numbers of the registration; set by hand."""

    max_points: int = 180
    """At most so many points of a scan are used, evenly spread."""

    point_std: float = 0.01
    """A line is fitted to so many beams that the noise of its distance comes down to this (m)."""

    min_neighbours: int = 2
    """A line is fitted to at least so many beams on either side."""

    max_neighbours: int = 4
    """A line is fitted to at most so many beams on either side: more of them blur what is no line."""

    max_slope: float = 4.0
    """Surfaces that a beam meets at a larger tangent of its angle of incidence are left out."""

    max_step: float = 0.1
    """A beam belongs to another surface where its range differs by more than this (m), ``max_noise`` standard
    deviations of the noise, and what a surface of the largest slope explains."""

    max_noise: float = 4.0
    """See ``max_step``; also how far a range may be from its line, in standard deviations."""

    max_scatter: float = 1.5
    """A line is left out where ranges scatter around it by more than this, in standard deviations of the noise."""

    rounding: float = 0.003
    """The scatter that is allowed to ranges without noise (m)."""

    min_noise: float = 0.002
    """The range noise counts as at least this (m)."""

    min_cosine: float = 0.7
    """Two points correspond where the cosine between their normals is no less."""

    robustness: float = 3.0
    """Residuals lose weight beyond this many standard deviations."""


REGISTRATION_DEFAULTS = RegistrationOptions()


@dataclass(frozen=True)
class Surfaces:
    """The surfaces that S scans show, as points in their lasers' frames at the first beams.

    Attributes:
        points: (N, 4) x, y (m) and the unit normal, each in the frame of the laser when its beam was taken.
        motions: (N, 3) the robot's poses when these were taken, relative to its pose at the scan's first beam.
        starts: (S + 1,) where each scan's points begin.
    """

    points: FloatArray
    motions: FloatArray
    starts: NDArray[np.int64]

    @classmethod
    def of(cls, scans: Sequence[PosedScan], options: RegistrationOptions = REGISTRATION_DEFAULTS) -> Surfaces:
        """Find the surfaces of scans.

        Args:
            scans: The scans, with the robot's poses.
            options: How surfaces are found.

        Returns:
            Their surfaces.
        """
        noise_std = range_noise([posed.scan for posed in scans], options)
        points, motions = [np.zeros((0, 4))], [np.zeros((0, 3))]
        for posed in scans:
            found, beams = surface_points(posed.scan, noise_std, options)
            first = np.array([[posed.pose.x, posed.pose.y, posed.pose.theta]] * len(posed.pieces))
            relative = relative_poses(first, np.array([[at.x, at.y, at.theta] for _, at in posed.pieces]))
            first_beams = [scan.first_beam for scan, _ in posed.pieces]
            points.append(found)
            motions.append(relative[np.searchsorted(first_beams, beams, side="right") - 1])
        starts = np.cumsum([len(found) for found in points])
        return cls(np.concatenate(points), np.concatenate(motions), starts.astype(np.int64))

    def thinned(self, step: int) -> Surfaces:
        """Return the surfaces with one in ``step`` points of each scan."""
        kept = np.concatenate([np.arange(a, b, step) for a, b in pairwise(self.starts.tolist())])
        starts = np.searchsorted(kept, self.starts)
        return Surfaces(self.points[kept], self.motions[kept], starts)

    def in_laser_frame(self, mount: FloatArray) -> FloatArray:
        """Return the points (N, 4) and normals in the frames that the scans' lasers had at the first beams.

        The robot's motion during a sweep is compensated for, which takes the laser's pose (3,) on it.
        """
        mounts = np.broadcast_to(mount, self.motions.shape)
        x, y, theta = relative_poses(mounts, compose_poses(self.motions, mounts)).T
        cos, sin = np.cos(theta), np.sin(theta)
        px, py, nx, ny = self.points.T
        moved = (cos * px - sin * py + x, sin * px + cos * py + y, cos * nx - sin * ny, sin * nx + cos * ny)
        return np.column_stack(moved)


def range_noise(scans: Sequence[Scan], options: RegistrationOptions = REGISTRATION_DEFAULTS) -> float:
    """Estimate the range noise of scans from the differences of neighbouring beams.

    Args:
        scans: The scans.
        options: The smallest noise.

    Returns:
        Its standard deviation (m): the median of the scans' own.
    """
    found = [std for scan in scans if (std := neighbour_noise(scan.ranges[scan.measured])) is not None]
    return max(float(np.median(found)), options.min_noise) if found else options.min_noise


def surface_points(
    scan: Scan, noise_std: float, options: RegistrationOptions = REGISTRATION_DEFAULTS
) -> tuple[FloatArray, NDArray[np.intp]]:
    """Find the points of a scan that lie on locally straight surfaces.

    For each beam, in a frame whose x axis is the beam, x = a + m y is fitted to the end points of its neighbours.

    Args:
        scan: The scan.
        noise_std: The standard deviation of its range noise (m).
        options: How many neighbours, and what a surface is.

    Returns:
        Points (M, 4): x, y (m) and the unit normal towards the laser, in the laser's frame; and their beams (M,).
    """
    count = len(scan.ranges)
    ranges = np.where(scan.measured, scan.ranges.astype(float), np.nan)
    wanted = math.ceil(((noise_std / options.point_std) ** 2 - 1) / 2)
    reach = min(max(wanted, options.min_neighbours), options.max_neighbours)
    offsets = np.arange(-reach, reach + 1)
    turns = offsets * scan.angle_increment
    neighbours = np.pad(ranges, reach, constant_values=np.nan)[np.arange(count)[:, None] + offsets + reach]
    allowed = options.max_noise * noise_std + options.max_step
    sloped = options.max_slope * np.abs(turns) * ranges[:, None]
    used = np.isfinite(neighbours) & (np.abs(neighbours - ranges[:, None]) < allowed + sloped)
    sums = np.maximum(used.sum(axis=1), 1)
    x, y = np.where(used, neighbours * np.cos(turns), 0.0), np.where(used, neighbours * np.sin(turns), 0.0)
    mean_x, mean_y = x.sum(axis=1) / sums, y.sum(axis=1) / sums
    dx, dy = np.where(used, x - mean_x[:, None], 0.0), np.where(used, y - mean_y[:, None], 0.0)
    spread = (dy * dy).sum(axis=1)
    slopes = np.divide((dx * dy).sum(axis=1), spread, out=np.full(count, np.inf), where=spread > 0)
    slopes[~(np.abs(slopes) <= options.max_slope)] = np.inf
    straight = np.isfinite(slopes) & np.isfinite(ranges) & (used.sum(axis=1) >= reach + 2)
    slopes = np.where(straight, slopes, 0.0)
    distances, lengths = mean_x - slopes * mean_y, np.hypot(1.0, slopes)
    squares = ((dx - slopes[:, None] * dy) ** 2).sum(axis=1)
    scatter = np.sqrt(squares / np.maximum(sums - 2, 1)) / lengths
    straight &= scatter < options.max_scatter * noise_std + options.rounding
    straight &= (distances > 0) & (np.abs(distances - ranges) < options.max_noise * noise_std + options.rounding)
    beams = np.flatnonzero(straight)
    beams = beams[:: max(1, -(-len(beams) // options.max_points))]
    (cos, sin), slope, length = scan.directions[beams].T, slopes[beams], lengths[beams]
    normals = (-cos - slope * sin) / length, (-sin + slope * cos) / length
    return np.column_stack((distances[beams] * cos, distances[beams] * sin, *normals)), beams


class PairTerms(NamedTuple):
    """How well P pairs of scans fit, to second order in the pose of each second laser in the frame of the first.

    Attributes:
        gradients: (P, 3) of the negative log-likelihood with respect to x, y (m), heading (rad).
        information: (P, 3, 3) by Gauss and Newton.
        misfit: (P,) sum over points of a loss from 0 (fits) to 1 (nothing near).
        points: (P,) number of points.
    """

    gradients: FloatArray
    information: FloatArray
    misfit: FloatArray
    points: FloatArray


def register_pairs(
    points: FloatArray,
    starts: NDArray[np.int64],
    pairs: NDArray[np.int64],
    relative: FloatArray,
    std: float,
    max_distance: float,
    options: RegistrationOptions = REGISTRATION_DEFAULTS,
) -> PairTerms:
    """Evaluate how well pairs of scans fit.

    Args:
        points: (N, 4) the scans' points and normals, see :meth:`Surfaces.in_laser_frame`.
        starts: (S + 1,) where each scan's points begin.
        pairs: (P, 2) indices of scans.
        relative: (P, 3) pose of each second scan's laser in the frame of the first one's.
        std: Standard deviation of the residuals (m).
        max_distance: Points that are further apart do not correspond (m).
        options: Which points correspond, and the loss.

    Returns:
        The fit.
    """
    result = np.zeros((len(pairs), 11))
    limits = max_distance, std, options.min_cosine, options.robustness
    _register(points, starts, pairs, relative, limits, result)
    information = result[:, [3, 4, 5, 4, 6, 7, 5, 7, 8]].reshape(-1, 3, 3)  # of xx, xy, xt, yy, yt, tt
    return PairTerms(result[:, :3], information, result[:, 9], result[:, 10])


@inline
def _nearest(points: Any, x: float, y: float, max_distance: float) -> int:
    """Return the index of the point (N, 2) nearest to x, y; -1 where none is within the distance."""
    best, nearest = max_distance * max_distance, -1
    for k in range(len(points)):
        distance = (points[k, 0] - x) ** 2 + (points[k, 1] - y) ** 2
        if distance < best:
            best, nearest = distance, k
    return nearest


@inline
def _add_residual(first: Any, a: int, second: Any, b: int, x: float, y: float, limits: Any, sums: Any) -> None:
    """Add the residual of two points that correspond, of which the second's is in the first scan's frame."""
    _, std, min_cosine, robustness = limits
    sums[10] += 1.0
    if a < 0 or first[a, 2] * second[b, 2] + first[a, 3] * second[b, 3] < min_cosine:
        sums[9] += 1.0
        return
    nx, ny = first[a, 2] + second[b, 2], first[a, 3] + second[b, 3]
    length = math.hypot(nx, ny)
    nx, ny = nx / length, ny / length
    residual = nx * (second[b, 0] - first[a, 0]) + ny * (second[b, 1] - first[a, 1])
    turned = ny * (second[b, 0] - x) - nx * (second[b, 1] - y)  # derivative of the residual by the heading
    square = (residual / (std * robustness)) ** 2
    sums[9] += square / (1.0 + square)
    # each correspondence counts half, since most are found from both sides
    weight = 0.5 / (std * (1.0 + square)) ** 2
    sums[0] += weight * residual * nx
    sums[1] += weight * residual * ny
    sums[2] += weight * residual * turned
    sums[3] += weight * nx * nx
    sums[4] += weight * nx * ny
    sums[5] += weight * nx * turned
    sums[6] += weight * ny * ny
    sums[7] += weight * ny * turned
    sums[8] += weight * turned * turned


@kernel
def _register(points: Any, starts: Any, pairs: Any, relative: Any, limits: Any, result: Any) -> None:
    """Add up the terms of each pair; see :func:`register_pairs`."""
    max_distance = limits[0]
    for pair in range(len(pairs)):
        a, b = pairs[pair]
        first = points[starts[a] : starts[a + 1]]
        second = points[starts[b] : starts[b + 1]].copy()
        x, y, theta = relative[pair]
        cos, sin = math.cos(theta), math.sin(theta)
        for k in range(len(second)):
            px, py, nx, ny = second[k]
            second[k, 0], second[k, 1] = cos * px - sin * py + x, sin * px + cos * py + y
            second[k, 2], second[k, 3] = cos * nx - sin * ny, sin * nx + cos * ny
        for k in range(len(second)):
            at = _nearest(first, second[k, 0], second[k, 1], max_distance)
            _add_residual(first, at, second, k, x, y, limits, result[pair])
        for k in range(len(first)):
            at = _nearest(second, first[k, 0], first[k, 1], max_distance)
            _add_residual(first, k if at >= 0 else -1, second, at, x, y, limits, result[pair])
