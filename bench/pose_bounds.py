"""A lower bound on the errors of a session's poses, the map being unknown: the Cramér-Rao bound of both together.

A ray from the laser at p meets a surface at the range r, in the direction d, where the unit normal is n. A small
motion of the laser, and one v of the surface along its normal, change it by

    dr = (v - n·dp - r n·d' dθ) / n·d,        d' = d turned by a quarter.

With white range noise σ each ray adds the outer product of this row, over σ², to the Fisher information of all poses
and of all that is unknown of the map. Steps of the odometry, fixes and headings add theirs. The map's unknowns are
eliminated by the Schur complement; the inverse of what remains is the bound on the poses' covariance.

What is unknown of the map is one of two:

- SHAPES: that there are these primitives and straight walls is known, and where and how large they are is not: x, y,
  heading and sizes of each primitive, the offsets of both ends of each wall (and of each side of other things). No
  estimator without bias has smaller errors, but one that knows no shapes cannot reach it.
- PATCHES: every outline is cut into patches of the length of a map's cell, both of whose ends have offsets along the
  normal: what a map of cells can know of surfaces. It is a bound for estimators without knowledge of shapes.

Both take it as known which surface a ray meets. What rays say that change from hit to miss at a silhouette is left
out: the likelihood is discontinuous there, and its information is that of the bounds of Weiss and Weinstein (see
:mod:`bench.limit`). Where it counts, the more the larger the noise is, errors may lie below this bound. Rays that
graze a surface are left out too: how their range changes is linear only over less than the poses' errors.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from detect.refinement.likelihood.geometry import JACOBIANS
from prim import linear_algebra
from prim.arrays import FloatArray
from prim.se2 import relative_steps, rotate
from prim.world import World

SHAPES, PATCHES = "shapes", "patches"
"""What is unknown of the map."""

PATCH = 0.01
"""Length of a patch (m): the side of a cell of the default map."""

GRAZING = 0.1
"""Rays that meet a surface with a smaller cosine of their angle with its normal are left out."""

MAP_STD = 1.0
"""Each unknown of the map is known to so much (m, rad) before: far worse than by any ray."""

UNIT = 5
"""Parameters of any shape: x, y (m), heading (rad), width, height (m)."""


@dataclass(frozen=True)
class Surfaces:
    """All that rays can meet in a world.

    Attributes:
        segments: (S, 4) x and y (m) of both ends.
        ellipses: (E, 5) centre x, y (m), heading (rad), semi-axis along it, semi-axis across (m).
        shapes: The primitive's index (S + E,) that each segment, then each ellipse, belongs to; -1: a wall.
    """

    segments: FloatArray
    ellipses: FloatArray
    shapes: NDArray[np.int64]

    @classmethod
    def of(cls, world: World) -> Surfaces:
        """Collect the surfaces of a world."""
        walls = np.asarray(world.walls, dtype=float).reshape(-1, 4)
        segments = [walls, *(solid.as_segments() for solid in world.solids)]
        shapes = [-1] * sum(map(len, segments))
        for number, primitive in enumerate(world.primitives):
            if not primitive.is_round:
                segments.append(primitive.as_segments())
                shapes += [number] * len(segments[-1])
        rounds = [number for number, primitive in enumerate(world.primitives) if primitive.is_round]
        ellipses = np.array([world.primitives[number].as_ellipse() for number in rounds]).reshape(-1, 5)
        return cls(np.vstack(segments), ellipses, np.array(shapes + rounds, dtype=np.int64))


@dataclass(frozen=True)
class Hits:
    """Where N rays meet surfaces.

    Attributes:
        scan: The number of each ray's scan (N,).
        surface: Which surface it meets (N,): a segment, or beyond these an ellipse.
        place: Where on it (N,): the share of the segment's length, or the angle (rad) in the ellipse's own circle.
        points: (N, 2) in m.
        normals: Unit normals (N, 2) there.
        incidence: n·d (N,).
        slopes: The derivatives (N, 3) of the range by the laser's x, y, heading.
    """

    scan: NDArray[np.int64]
    surface: NDArray[np.int64]
    place: FloatArray
    points: FloatArray
    normals: FloatArray
    incidence: FloatArray
    slopes: FloatArray

    @classmethod
    def of(cls, surfaces: Surfaces, poses: FloatArray, beams: FloatArray, max_range: float) -> Hits:
        """Cast all rays of a session.

        Args:
            surfaces: What they may meet.
            poses: The laser's poses (K, 3).
            beams: The beams' unit vectors (B, 2) in its frame.
            max_range: Surfaces further away (m) are not seen.

        Returns:
            The rays that meet a surface, without those that graze it.
        """
        parts = [_cast(surfaces, number, pose, beams, max_range) for number, pose in enumerate(poses)]
        return cls(*(np.concatenate(columns) for columns in zip(*parts, strict=True)))


def _cast(surfaces: Surfaces, number: int, pose: FloatArray, beams: FloatArray, max_range: float) -> tuple[Any, ...]:
    """Return the fields of one scan's hits."""
    origin, directions = pose[:2], rotate(beams, float(pose[2]))
    flat, shares = _meet_segments(surfaces.segments, origin, directions)
    curved, angles = _meet_ellipses(surfaces.ellipses, origin, directions)
    distances = np.hstack((flat, curved))
    surface = np.argmin(distances, axis=1)
    rows = np.arange(len(beams))
    distance, place = distances[rows, surface], np.hstack((shares, angles))[rows, surface]
    along = surfaces.segments[:, 2:] - surfaces.segments[:, :2]
    flat_normals = np.column_stack((along[:, 1], -along[:, 0])) / np.hypot(*along.T)[:, None]
    normals = np.zeros((len(beams), 2))
    is_flat = surface < len(along)
    normals[is_flat] = flat_normals[surface[is_flat]]
    _, _, theta, a, b = surfaces.ellipses[surface[~is_flat] - len(along)].T
    bent = np.column_stack((np.cos(place[~is_flat]) * b, np.sin(place[~is_flat]) * a))
    bent /= np.hypot(*bent.T)[:, None]
    cos, sin = np.cos(theta), np.sin(theta)
    normals[~is_flat] = np.column_stack((cos * bent[:, 0] - sin * bent[:, 1], sin * bent[:, 0] + cos * bent[:, 1]))
    incidence = (normals * directions).sum(axis=1)
    kept = (distance <= max_range) & (np.abs(incidence) >= GRAZING)
    normals, incidence, distance, directions = normals[kept], incidence[kept], distance[kept], directions[kept]
    turned = distance * (normals[:, 1] * directions[:, 0] - normals[:, 0] * directions[:, 1])
    slopes = -np.column_stack((normals, turned)) / incidence[:, None]
    points = origin + distance[:, None] * directions
    return np.full(len(points), number), surface[kept], place[kept], points, normals, incidence, slopes


def _meet_segments(segments: FloatArray, origin: FloatArray, directions: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the distances (B, S) along rays to segments, inf for misses, and the shares of these where they meet."""
    along, towards = segments[:, 2:] - segments[:, :2], segments[:, :2] - origin
    with np.errstate(divide="ignore", invalid="ignore"):
        scale = 1 / (directions[:, :1] * along[:, 1] - directions[:, 1:] * along[:, 0])
        distances = (towards[:, 0] * along[:, 1] - towards[:, 1] * along[:, 0]) * scale
        shares = (towards[:, 0] * directions[:, 1:] - towards[:, 1] * directions[:, :1]) * scale
        met = (distances >= 0) & (shares >= 0) & (shares <= 1)
    return np.where(met, distances, np.inf), shares


def _meet_ellipses(ellipses: FloatArray, origin: FloatArray, directions: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the distances (B, E) along rays to ellipses from outside, inf for misses, and the angles on these."""
    x, y, theta, a, b = ellipses.T
    cos, sin = np.cos(theta), np.sin(theta)
    from_x, from_y = origin[0] - x, origin[1] - y
    px, py = (cos * from_x + sin * from_y) / a, (cos * from_y - sin * from_x) / b
    ux = (cos * directions[:, :1] + sin * directions[:, 1:]) / a
    uy = (cos * directions[:, 1:] - sin * directions[:, :1]) / b
    square, half, beyond = ux**2 + uy**2, ux * px + uy * py, px**2 + py**2 - 1
    discriminant = half**2 - square * beyond
    distances = (-np.sqrt(np.maximum(discriminant, 0)) - half) / square
    met = (discriminant >= 0) & (distances >= 0)
    return np.where(met, distances, np.inf), np.arctan2(py + distances * uy, px + distances * ux)


def map_slopes(world: World, surfaces: Surfaces, hits: Hits, unknown: str) -> sparse.csr_array:
    """Return the derivatives of ranges by the map's unknowns.

    Args:
        world: The world.
        surfaces: Its surfaces.
        hits: N rays.
        unknown: SHAPES or PATCHES.

    Returns:
        (N, M); unknowns that no ray depends on are left out.
    """
    slopes = _shape_slopes(world, surfaces, hits) if unknown == SHAPES else _patch_slopes(surfaces, hits)
    return slopes[:, np.flatnonzero(np.diff(slopes.tocsc().indptr))]


def _patch_slopes(surfaces: Surfaces, hits: Hits) -> sparse.csr_array:
    """Return the derivatives of ranges by the offsets of patches' ends."""
    lengths = np.hypot(*(surfaces.segments[:, 2:] - surfaces.segments[:, :2]).T)
    a, b = surfaces.ellipses[:, 3:].T
    around = math.pi * (3 * (a + b) - np.sqrt((3 * a + b) * (a + 3 * b)))  # Ramanujan's perimeter
    counts = np.maximum(np.round(np.concatenate((lengths, around)) / PATCH), 1).astype(np.int64)
    is_flat = hits.surface < len(lengths)
    share = np.where(is_flat, hits.place, (hits.place / (2 * math.pi)) % 1) * counts[hits.surface]
    begin = np.minimum(share.astype(np.int64), counts[hits.surface] - 1)
    # a segment has a corner more than it has patches; around an ellipse the last patch ends where the first begins
    end = np.where(is_flat, begin + 1, (begin + 1) % counts[hits.surface])
    first = np.concatenate(([0], np.cumsum(counts + (np.arange(len(counts)) < len(lengths)))))
    columns = first[hits.surface] + np.stack((begin, end))
    values = np.stack((1 - share + begin, share - begin)) / hits.incidence
    rows = np.tile(np.arange(len(hits.surface)), 2)
    return sparse.csr_array((values.ravel(), (rows, columns.ravel())), shape=(len(hits.surface), int(first[-1])))


def _shape_slopes(world: World, surfaces: Surfaces, hits: Hits) -> sparse.csr_array:
    """Return the derivatives of ranges by primitives' own parameters, and by the offsets of both ends of walls."""
    rows, columns, values, first = [], [], [], 0
    shape = surfaces.shapes[hits.surface]
    for number, primitive in enumerate(world.primitives):
        own = np.flatnonzero(shape == number)
        theta, (width, height) = primitive.theta or 0.0, primitive.width_height
        arm = hits.points[own] - (primitive.x, primitive.y)
        unit = rotate(arm, -theta) / (width, height)
        normals = hits.normals[own]
        local = rotate(normals, -theta)
        turned = normals[:, 1] * arm[:, 0] - normals[:, 0] * arm[:, 1]
        moves = np.column_stack((normals, turned, local * unit)) @ JACOBIANS[primitive.kind]
        assert len(JACOBIANS[primitive.kind]) == UNIT
        size = moves.shape[1]
        rows.append(np.repeat(own, size))
        columns.append(np.tile(np.arange(first, first + size), len(own)))
        values.append((moves / hits.incidence[own, None]).ravel())
        first += size
    own = np.flatnonzero(shape < 0)
    for end, share in ((0, 1 - hits.place[own]), (1, hits.place[own])):
        rows.append(own)
        columns.append(first + 2 * hits.surface[own] + end)
        values.append(share / hits.incidence[own])
    entries = np.concatenate(values), (np.concatenate(rows), np.concatenate(columns))
    return sparse.csr_array(entries, shape=(len(shape), first + 2 * len(surfaces.segments)))


def scan_information(hits: Hits, by_map: sparse.csr_array | None, poses: int, noise_std: float) -> FloatArray:
    """Compute the information that rays hold on the poses once the map's unknowns are eliminated.

    Args:
        hits: N rays.
        by_map: The derivatives (N, M) of their ranges by the map's unknowns; None: the map is known.
        poses: Their number K.
        noise_std: The range noise (m).

    Returns:
        (3 K, 3 K), in the order x, y, heading of the first pose, and so on.
    """
    count = len(hits.scan)
    at = np.repeat(3 * hits.scan, 3) + np.tile(np.arange(3), count)
    by_pose = sparse.csr_array((hits.slopes.ravel(), (np.repeat(np.arange(count), 3), at)), shape=(count, 3 * poses))
    information = (by_pose.T @ by_pose).toarray()
    if by_map is not None:
        both = (by_pose.T @ by_map).toarray()
        of_map = (by_map.T @ by_map).toarray() + np.eye(by_map.shape[1]) * (noise_std / MAP_STD) ** 2
        eliminated = linear_algebra.solve(of_map, both.T)
        assert eliminated is not None
        information -= both @ eliminated
    return np.asarray(information / noise_std**2)


def step_information(poses: FloatArray, variances: FloatArray) -> FloatArray:
    """Compute the information of an odometry.

    Args:
        poses: The true poses (K, 3).
        variances: Of the steps (K, 3) along x, y (m²) and in heading (rad²), in the frame of the pose before; the
            first one is not used, and steps without noise are none.

    Returns:
        (3 K, 3 K).
    """
    steps, information = relative_steps(poses), np.zeros((3 * len(poses), 3 * len(poses)))
    for number in range(1, len(poses)):
        cos, sin = math.cos(poses[number - 1, 2]), math.sin(poses[number - 1, 2])
        back = np.array([[cos, sin, 0], [-sin, cos, 0], [0, 0, 1.0]])
        before = -back
        before[:2, 2] = steps[number, 1], -steps[number, 0]
        both = np.hstack((before, back))
        block = slice(3 * number - 3, 3 * number + 3)
        information[block, block] += both.T @ (both / variances[number][:, None])
    return information


def position_bound(information: FloatArray, first_is_known: bool) -> float:
    """Return the bound on the root mean square error of all positions (m).

    Args:
        information: (3 K, 3 K).
        first_is_known: Whether the first pose is known, as the origin of the map's frame.

    Returns:
        The bound; inf where the information does not determine the poses.
    """
    known = 3 if first_is_known else 0
    covariance = linear_algebra.inverse(information[known:, known:])
    if covariance is None:
        return math.inf
    variances = np.diag(covariance).reshape(-1, 3)[:, :2]
    return math.sqrt(float(variances.sum()) / (len(information) // 3))
