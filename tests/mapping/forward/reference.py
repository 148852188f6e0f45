"""The forward sensor model in plain Python and double precision, written independently of the kernels."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

HIT_BEFORE, HIT_BEYOND, OUTLIER_TAIL = 0.5, 0.5, 0.1


def pdf(x: float) -> float:
    return math.exp(-x * x / 2) / math.sqrt(2 * math.pi)


def cdf(x: float) -> float:
    return 0.5 * math.erfc(-x / math.sqrt(2))


def cdf_integral(x: float) -> float:
    return x * cdf(x) + pdf(x)


def cells_of(x: float, y: float, angle: float, shape: tuple[int, int]) -> tuple[list[tuple[int, int, float]], float]:
    """Return (row, col, distance) in cells for each step along the major axis, and where the ray leaves the grid."""
    dx, dy = math.cos(angle), math.sin(angle)
    along_x = abs(dx) >= abs(dy)
    a, b, da, db = (x, y, dx, dy) if along_x else (y, x, dy, dx)
    sizes = (shape[1], shape[0]) if along_x else shape
    step = 1 if da > 0 else -1
    found = []
    major = math.floor(a)
    for k in range(-3, sum(shape) + abs(int(x)) + abs(int(y)) + 3):
        cell = major + k * step
        distance = (cell + 0.5 - a) / da
        minor = math.floor(b + distance * db)
        if distance > 0 and 0 <= cell < sizes[0] and 0 <= minor < sizes[1]:
            found.append(((minor, cell) if along_x else (cell, minor)) + (distance,))
    leaves = found[-1][2] + 0.5 / abs(da) if found else 0.0
    return found, leaves


@dataclass
class Sums:
    """Expected hits and passes per cell, and the sufficient statistics of the noise."""

    hits: np.ndarray
    passes: np.ndarray
    squares_of_arrival: np.ndarray
    log_likelihood: float = 0.0
    stops: float = 0.0
    squares: float = 0.0
    outliers: float = 0.0
    dropouts: float = 0.0
    worst_sum: float = 0.0


def expect(
    rays: list[tuple[float, float, float, float]],
    limits: tuple[float, float],
    o: np.ndarray,
    sigma: float,
    epsilon: float,
    delta: float = 0.0,
) -> Sums:
    """Compute the E step; rays are x, y, bearing and range, all lengths in cells. Densities are per cell."""
    sums = Sums(np.zeros_like(o), np.zeros_like(o), np.zeros_like(o))
    z_min, z_max = limits
    for x, y, angle, z in rays:
        cells, leaves = cells_of(x, y, angle, o.shape)
        if not cells:
            continue
        near, none = z == -math.inf, z >= z_max
        outside = not (0 <= x < o.shape[1] and 0 <= y < o.shape[0])
        half = 0.5 / max(abs(math.cos(angle)), abs(math.sin(angle)))
        entry = cells[0][2] - half if outside else 0.0
        left, parts, squares = 1 - HIT_BEFORE if entry > 0 else 1.0, [], []
        for row, col, s in cells:
            if none and s > z_max:
                break
            if near:
                u = (z_min - s) / sigma
                weight, square = cdf(u), 1 - u * pdf(u) / max(cdf(u), 1e-300)
            elif none:
                u = (z_max - s) / sigma
                weight, square = cdf(-u), 1 + u * pdf(u) / max(cdf(-u), 1e-300)
            else:
                weight, square = pdf((z - s) / sigma) / sigma, ((z - s) / sigma) ** 2
            parts.append((1 - delta) * left * o[row, col] * weight)
            squares.append(square)
            left *= 1 - o[row, col]
        gone = left * _beyond(z, near, none, leaves, z_min, z_max, sigma)
        arrived = 1 - HIT_BEFORE if entry > 0 else 1.0
        dropout = delta * (arrived - left) if none else 0.0
        outlier = epsilon * (OUTLIER_TAIL if near or none else (1 - 2 * OUTLIER_TAIL) / (z_max - z_min))
        before = _before(z, near, none, entry, z_min, z_max, sigma)
        density = (1 - epsilon) * (sum(parts) + gone + before + dropout) + outlier
        if none:  # what is lost whatever the map: delta for a ray that arrives, also where it would have gone on
            gone -= delta * left
        q = [(1 - epsilon) * part / density for part in parts]
        behind = (1 - epsilon) * gone / density
        kept = 1 - ((1 - epsilon) * delta * arrived / density if none else 0.0)
        others = (1 - epsilon) * (before + (delta * arrived if none else 0.0)) / density + outlier / density
        sums.worst_sum = max(sums.worst_sum, abs(sum(q) + behind + others - 1))
        for (row, col, _), share in reversed(list(zip(cells, q, strict=False))):
            sums.hits[row, col] += share
            sums.passes[row, col] += behind
            behind += share
            sums.squares_of_arrival[row, col] += behind**2 / kept
        sums.log_likelihood += math.log(density)
        sums.stops += sum(q)
        sums.squares += sum(share * square for share, square in zip(q, squares, strict=True))
        sums.outliers += outlier / density
        sums.dropouts += (1 - epsilon) * dropout / density
    return sums


def _before(z: float, near: bool, none: bool, entry: float, z_min: float, z_max: float, sigma: float) -> float:
    """Return the likelihood of a ray from off the grid that ends before it, uniformly."""
    if entry <= 0:
        return 0.0
    if not near and not none:
        return HIT_BEFORE * (cdf(z / sigma) - cdf((z - entry) / sigma)) / entry
    limit = z_min if near else z_max
    nearer = sigma * (cdf_integral(limit / sigma) - cdf_integral((limit - entry) / sigma)) / entry
    return HIT_BEFORE * (nearer if near else 1 - nearer)


def _beyond(z: float, near: bool, none: bool, leaves: float, z_min: float, z_max: float, sigma: float) -> float:
    if leaves >= z_max:
        return 1.0 if none else 0.0
    span = z_max - leaves
    if near:
        below = cdf_integral((z_min - leaves) / sigma) - cdf_integral((z_min - z_max) / sigma)
        return HIT_BEYOND * sigma * below / span
    if none:
        return 1 - HIT_BEYOND * sigma * (cdf_integral(span / sigma) - cdf_integral(0)) / span
    return HIT_BEYOND * (cdf((z - leaves) / sigma) - cdf((z - z_max) / sigma)) / span
