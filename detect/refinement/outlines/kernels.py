"""The compiled kernel of free outlines: the likelihood of rays given any closed polygon, and its derivatives.

As detect.refinement.likelihood.kernels for kinds, with the vertices as parameters. A ray's line has a signed offset
from each vertex; it meets the polygon's hull exactly if the largest offset is above 0 and the smallest below, and its
clearance is the smaller of both distances. The range is that of the first edge crossed, convex or not.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from prim.compiled import compiled

FAST = {"arcp", "contract", "reassoc", "nsz"}
"""Fast-math flags: as those of detect.refinement.likelihood.kernels."""

kernel = compiled(inline="never", fastmath=FAST)
part = compiled(cache=False, forceinline=True, fastmath=FAST)

ORIGIN_X, ORIGIN_Y, DIRECTION_X, DIRECTION_Y, RANGE, OCCLUSION, BACKGROUND = range(7)
MEASURED = 0
TABLE_REACH = 12.0
TABLE_SPACING = 64
"""Rows of rays, the outcome of a measured range, and the table of log-likelihoods, as
detect.refinement.likelihood.kernels has them: what is compiled in stands in the same file.
"""

FAR = 1e30
"""Stands for a miss."""

BLOCK = 256
"""Rays that are intersected at once."""

OFFSET, ALONG, HIGH, LOW, ALONG_HIGH, ALONG_LOW, AT_HIGH, AT_LOW, NEAREST, EDGE, FARTHEST = range(11)
SCRATCH_ROWS = 11
"""Rows of scratch (11, BLOCK)."""

LEAST_INCIDENCE = 0.05
"""The least cosine between a ray and an edge's normal that the range's slope reckons with."""

NO_GRADIENT = np.zeros(0)
NO_INFORMATION = np.zeros((0, 0))
"""Stand for derivatives that are not wanted."""


@part
def _lookup(table: Any, row: int, x: float) -> float:
    """Interpolate a row of the table linearly at x."""
    place = (min(max(x, -TABLE_REACH), TABLE_REACH) + TABLE_REACH) * TABLE_SPACING
    entry = min(int(place), 2 * int(TABLE_REACH) * TABLE_SPACING - 1)
    low = float(table[row, entry])
    return low + (place - entry) * (float(table[row, entry + 1]) - low)


@part
def _range_information(outcome: int, slope: float, x: float, sigma: float) -> float:
    """Return the information (1 / m²) of a ray that hits on its range."""
    if outcome != MEASURED:
        return slope * slope
    return -slope / (x * sigma) if abs(x) > 1e-6 else 1.0 / (sigma * sigma)


@part
def _intersect(vertices: Any, rays: Any, first: int, count: int, scratch: Any) -> None:
    """Set offsets, the extreme vertices, and the first edge that each ray of a block crosses."""
    corners = len(vertices)
    for i in range(count):
        scratch[HIGH, i], scratch[LOW, i], scratch[NEAREST, i], scratch[EDGE, i] = -FAR, FAR, FAR, -1.0
        scratch[FARTHEST, i] = -FAR
        x, y = (
            vertices[corners - 1, 0] - rays[ORIGIN_X, first + i],
            vertices[corners - 1, 1] - rays[ORIGIN_Y, first + i],
        )
        dx, dy = rays[DIRECTION_X, first + i], rays[DIRECTION_Y, first + i]
        scratch[OFFSET, i], scratch[ALONG, i] = dx * y - dy * x, dx * x + dy * y
    for corner in range(corners):
        vx, vy = vertices[corner, 0], vertices[corner, 1]
        before = float(corner - 1 if corner else corners - 1)
        for i in range(count):
            dx, dy = rays[DIRECTION_X, first + i], rays[DIRECTION_Y, first + i]
            x, y = vx - rays[ORIGIN_X, first + i], vy - rays[ORIGIN_Y, first + i]
            offset, along = dx * y - dy * x, dx * x + dy * y
            past, past_along = scratch[OFFSET, i], scratch[ALONG, i]
            crosses = (offset > 0.0) != (past > 0.0)
            at = (past_along * offset - along * past) / (offset - past if crosses else 1.0)
            nearer = crosses and at > 0.0 and at < scratch[NEAREST, i]
            scratch[NEAREST, i] = at if nearer else scratch[NEAREST, i]
            scratch[EDGE, i] = before if nearer else scratch[EDGE, i]
            higher, lower = offset > scratch[HIGH, i], offset < scratch[LOW, i]
            scratch[HIGH, i] = offset if higher else scratch[HIGH, i]
            scratch[ALONG_HIGH, i] = along if higher else scratch[ALONG_HIGH, i]
            scratch[AT_HIGH, i] = float(corner) if higher else scratch[AT_HIGH, i]
            scratch[LOW, i] = offset if lower else scratch[LOW, i]
            scratch[ALONG_LOW, i] = along if lower else scratch[ALONG_LOW, i]
            scratch[AT_LOW, i] = float(corner) if lower else scratch[AT_LOW, i]
            scratch[FARTHEST, i] = max(scratch[FARTHEST, i], along)
            scratch[OFFSET, i], scratch[ALONG, i] = offset, along


@kernel
def outline_ranges(vertices: Any, rays: Any, out: Any) -> None:
    """Cast rays against a closed polygon.

    Args:
        vertices: (V, 2) in metres.
        rays: (7, N).
        out: (N,) gets the ranges (m); FAR for a miss.
    """
    scratch = np.empty((SCRATCH_ROWS, BLOCK))
    centre_x, centre_y, reach = 0.0, 0.0, 0.0
    for corner in range(len(vertices)):
        centre_x, centre_y = centre_x + vertices[corner, 0], centre_y + vertices[corner, 1]
    centre_x, centre_y = centre_x / len(vertices), centre_y / len(vertices)
    for corner in range(len(vertices)):
        reach = max(reach, math.hypot(vertices[corner, 0] - centre_x, vertices[corner, 1] - centre_y))
    for first in range(0, len(out), BLOCK):
        count = min(BLOCK, len(out) - first)
        passes = False
        for i in range(first, first + count):
            x, y = centre_x - rays[ORIGIN_X, i], centre_y - rays[ORIGIN_Y, i]
            passes |= abs(x * rays[DIRECTION_Y, i] - y * rays[DIRECTION_X, i]) <= reach
        if not passes:
            out[first : first + count] = FAR
            continue
        _intersect(vertices, rays, first, count, scratch)
        for i in range(count):
            meets = scratch[FARTHEST, i] > 0.0 and min(scratch[HIGH, i], -scratch[LOW, i]) > 0.0
            out[first + i] = scratch[NEAREST, i] if meets else FAR


@kernel
def outline_likelihood(  # noqa: C901 - one pass over the rays
    vertices: Any, data: Any, blur: float, gradient: Any, information: Any
) -> float:
    """Compute the negative log-likelihood of all rays, its gradient, and the information.

    Args:
        vertices: (V, 2) in metres, the closed polygon's.
        data: Rays (7, N), outcomes (N,), range noise (m), and the table of log-likelihoods.
        blur: Half-width (m) of the smooth step at silhouettes.
        gradient: (2 V,) gets the gradient by the vertices' coordinates; where it is empty, it and the information are
            not computed.
        information: (2 V, 2 V) gets the information (Gauss and Newton's, the squared score at silhouettes); where it
            is empty, it is not computed.

    Returns:
        The cost (nats).
    """
    rays, outcomes, sigma, table = data
    wanted, informs = len(gradient) > 0, len(information) > 0
    scratch = np.empty((SCRATCH_ROWS, BLOCK))
    index, slope = np.empty(4, np.int64), np.empty(4)
    gradient[:] = 0.0
    information[:] = 0.0
    total = 0.0
    for first in range(0, len(outcomes), BLOCK):
        count = min(BLOCK, len(outcomes) - first)
        _intersect(vertices, rays, first, count, scratch)
        for n in range(count):
            i = first + n
            above, below = scratch[HIGH, n], -scratch[LOW, n]
            side, corner, clearance = 1.0, int(scratch[AT_HIGH, n]), above
            at = scratch[ALONG_HIGH, n]
            if below < above:
                side, corner, clearance, at = -1.0, int(scratch[AT_LOW, n]), below, scratch[ALONG_LOW, n]
            edge = -1
            if clearance > 0.0:
                at, edge = scratch[NEAREST, n], int(scratch[EDGE, n])
            missed = clearance <= 0.0 if blur <= 0.0 else clearance <= -blur
            if missed or at >= rays[OCCLUSION, i] or scratch[FARTHEST, n] < 0.0:
                total += rays[BACKGROUND, i]
                continue
            x = (max(at, 0.0) - rays[RANGE, i]) / sigma
            hit = _lookup(table, outcomes[i], x)
            responsibility, step = 1.0, 0.0
            if clearance >= blur:
                total += hit
            else:
                u = 0.5 * (clearance / blur + 1.0)
                share = u * u * (3.0 - 2.0 * u)
                hits, misses = math.exp(hit), math.exp(rays[BACKGROUND, i])
                likelihood = share * hits + (1.0 - share) * misses
                total += math.log(likelihood)
                responsibility = share * hits / likelihood
                step = (hits - misses) / likelihood * 3.0 * u * (1.0 - u) / blur
            if not wanted:
                continue
            score = _lookup(table, 3 + outcomes[i], x) / sigma
            weight = responsibility * _range_information(outcomes[i], score, x, sigma)
            score *= responsibility
            dx, dy = rays[DIRECTION_X, i], rays[DIRECTION_Y, i]
            used = 2
            index[0], index[1], slope[0], slope[1] = 2 * corner, 2 * corner + 1, dx, dy
            if edge >= 0:
                used = 4
                after = edge + 1 if edge + 1 < len(vertices) else 0
                ex, ey = vertices[after, 0] - vertices[edge, 0], vertices[after, 1] - vertices[edge, 1]
                length = math.sqrt(ex * ex + ey * ey) + 1e-12
                nx, ny = ey / length, -ex / length
                incidence = nx * dx + ny * dy
                if abs(incidence) < LEAST_INCIDENCE:
                    incidence = LEAST_INCIDENCE if incidence > 0.0 else -LEAST_INCIDENCE
                nx, ny = nx / incidence, ny / incidence
                hx = rays[ORIGIN_X, i] + at * dx - vertices[edge, 0]
                hy = rays[ORIGIN_Y, i] + at * dy - vertices[edge, 1]
                share = min(max((hx * ex + hy * ey) / (length * length), 0.0), 1.0)
                index[0], index[1], index[2], index[3] = 2 * edge, 2 * edge + 1, 2 * after, 2 * after + 1
                slope[0], slope[1] = nx * (1.0 - share), ny * (1.0 - share)
                slope[2], slope[3] = nx * share, ny * share
            for a in range(used):
                gradient[index[a]] -= score * slope[a]
                for b in range(used if informs else 0):
                    information[index[a], index[b]] += weight * slope[a] * slope[b]
            if step != 0.0:
                by_x, by_y = -side * dy * step, side * dx * step
                gradient[2 * corner] -= by_x
                gradient[2 * corner + 1] -= by_y
                if informs:
                    information[2 * corner, 2 * corner] += by_x * by_x
                    information[2 * corner, 2 * corner + 1] += by_x * by_y
                    information[2 * corner + 1, 2 * corner] += by_x * by_y
                    information[2 * corner + 1, 2 * corner + 1] += by_y * by_y
    return -total


@kernel
def project_on_harmonics(
    moves: Any, basis: Any, by_vertices: Any, of_vertices: Any, gradient: Any, information: Any
) -> None:
    """Compute the gradient and the information by coefficients that move each vertex along one direction.

    The information of :func:`outline_likelihood` links neighbouring vertices alone.

    Args:
        moves: (V, 2) how far (m) a vertex moves where its harmonics sum up to 1.
        basis: (V, K) the harmonics at the vertices.
        by_vertices: (2 V,) gradient by the vertices' coordinates.
        of_vertices: (2 V, 2 V) information on these.
        gradient: (K,) gets the gradient by the coefficients.
        information: (K, K) gets the information on them.
    """
    count, size = basis.shape
    gradient[:] = 0.0
    information[:] = 0.0
    for a in range(count):
        ax, ay = moves[a, 0], moves[a, 1]
        slope = by_vertices[2 * a] * ax + by_vertices[2 * a + 1] * ay
        b = a + 1 if a + 1 < count else 0
        bx, by = moves[b, 0], moves[b, 1]
        own = ax * (of_vertices[2 * a, 2 * a] * ax + 2.0 * of_vertices[2 * a, 2 * a + 1] * ay)
        own += ay * of_vertices[2 * a + 1, 2 * a + 1] * ay
        link = ax * (of_vertices[2 * a, 2 * b] * bx + of_vertices[2 * a, 2 * b + 1] * by)
        link += ay * (of_vertices[2 * a + 1, 2 * b] * bx + of_vertices[2 * a + 1, 2 * b + 1] * by)
        for k in range(size):
            gradient[k] += slope * basis[a, k]
            for m in range(size):
                information[k, m] += basis[a, k] * (own * basis[a, m] + link * basis[b, m])
                information[k, m] += basis[b, k] * link * basis[a, m]
