"""The compiled kernels of refinement: how well a primitive explains the rays that pass it.

Every kind is a unit shape (a box, a disc, a triangle) that is stretched, turned and moved, so that one ray in the
unit shape's own frame tells the distance to all of them, and its derivatives. What a ray says of a shape is where it
meets it (r) and by how much it hits or misses it (s, the distance of the ray's line from the nearer silhouette).

A ray that hits has the likelihood of its range at r, one that misses that of what stands behind. Between the two the
likelihood jumps; a footprint of half-width ``blur`` (m) blends them over -blur < s < blur, so that there is a slope
to descend: it shrinks as the fit comes near. With ``blur`` 0 the likelihood is exact.

Parameters are always five: x, y, theta, width, height; a square's and a circle's two sizes are tied by the matrix
that maps a kind's own parameters to these. Compiled code is cached beside this file and made anew when this file
changes, so that every constant it uses must stand here.
"""

from __future__ import annotations

import math
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mapping.rays import compiled, inline

kernel = compiled(inline="never", fastmath={"arcp", "contract", "reassoc", "nsz"})
"""Divisions by what stays the same may become products; infinities and NaN keep their meaning."""

BOX, DISC, TRIANGLE = 0, 1, 2
"""Unit shapes: [-1/2, 1/2]², radius 1, and corners (-1/2, -1/3), (1/2, -1/3), (0, 2/3)."""

X, Y, THETA, WIDTH, HEIGHT = range(5)
PARAMETERS = 5

ORIGIN_X, ORIGIN_Y, DIRECTION_X, DIRECTION_Y, RANGE, STOP, MISS = range(7)
"""Columns of beams (N, 7): the ray; the measured range, or the limit it is beyond; from where on (m) something else
stops it; the logarithm of its likelihood if it misses the shape."""

MEASURED, TOO_NEAR, NO_RETURN, SAYS_NOTHING = 0, 1, 2, 3

TABLE_REACH = 12.0
TABLE_SPACING = 64
"""The tables hold so many entries per standard deviation, up to TABLE_REACH of them at both sides."""

SMALLEST, LARGEST = 0.02, 1.2
"""Width and height (m; of a disc the semi-axes) stay between these while a fit descends."""

EDGE_X = (0.0, 2.0 / math.sqrt(5.0), -2.0 / math.sqrt(5.0))
EDGE_Y = (-1.0, 1.0 / math.sqrt(5.0), 1.0 / math.sqrt(5.0))
EDGE_AT = (1.0 / 3.0, 2.0 / (3.0 * math.sqrt(5.0)), 2.0 / (3.0 * math.sqrt(5.0)))
"""The unit triangle's edges: outward normals, and their distances from the centroid."""

FAR, BEHIND = 1e30, 1e31
ENDLESS = 1e20
"""Stands for the inverse of nothing: a ray along a side never meets it."""


@lru_cache(maxsize=1)
def _normal() -> tuple[NDArray[np.float64], ...]:
    """X as the tables have it, exp(-x²/2), and Phi(-x)."""
    x = np.arange(-TABLE_REACH * TABLE_SPACING, TABLE_REACH * TABLE_SPACING + 1) / TABLE_SPACING
    return x, np.exp(-(x**2) / 2), np.array([0.5 * math.erfc(value / math.sqrt(2)) for value in x])


def not_below(cut: NDArray[np.float64]) -> NDArray[np.float64]:
    """The chance (N,) that a standard normal number is not below each ``cut``."""
    x, _, above = _normal()
    return np.interp(cut, x, above)


def tables(outlier: float) -> NDArray[np.float64]:
    """Log-likelihoods (rows 0 to 2) and their slopes (rows 3 to 5) over x = (r - z) / sigma; r is where a ray ends.

    Row MEASURED: log(exp(-x²/2) + outlier), the density in units of its peak; TOO_NEAR: log(Phi(-x) + outlier), z the
    sensor's least range; NO_RETURN: log(Phi(x) + outlier), z its largest.
    """
    x, density, below = _normal()
    phi = density / math.sqrt(2 * math.pi)
    measured, near, far = density + outlier, below + outlier, below[::-1] + outlier
    slopes = [-x * density / measured, -phi / near, phi / far]
    return np.stack([np.log(measured), np.log(near), np.log(far), *slopes])


@inline
def looked_up(table: Any, row: int, x: float) -> float:
    """A row of the table at x, linear between its entries."""
    place = (min(max(x, -TABLE_REACH), TABLE_REACH) + TABLE_REACH) * TABLE_SPACING
    entry = min(int(place), 2 * int(TABLE_REACH) * TABLE_SPACING - 1)
    low = float(table[row, entry])
    return low + (place - entry) * (float(table[row, entry + 1]) - low)


@inline
def entry(family: int, lx: float, ly: float, ux: float, uy: float) -> tuple[float, float, float]:
    """Where the line l + t u enters a unit shape: t (below 0 from inside), and the outward normal there.

    FAR where it does not meet the shape, BEHIND where the shape lies behind l.
    """
    t, nx, ny = -FAR, 0.0, 0.0
    if family == DISC:
        square, half = ux * ux + uy * uy, ux * lx + uy * ly
        inside = half * half - square * (lx * lx + ly * ly - 1.0)
        if inside < 0:
            return FAR, 0.0, 0.0
        root = math.sqrt(inside)
        if root < half:
            return BEHIND, 0.0, 0.0
        t = (-half - root) / square
        return t, lx + t * ux, ly + t * uy
    leave = FAR
    if family == BOX:
        along = 1.0 / ux if ux != 0.0 else ENDLESS
        across = 1.0 / uy if uy != 0.0 else ENDLESS
        near_x, far_x = -0.5 * abs(along) - lx * along, 0.5 * abs(along) - lx * along
        near_y, far_y = -0.5 * abs(across) - ly * across, 0.5 * abs(across) - ly * across
        leave = min(far_x, far_y)
        if near_x > near_y:
            t, nx = near_x, (-1.0 if ux > 0 else 1.0)
        else:
            t, ny = near_y, (-1.0 if uy > 0 else 1.0)
    else:
        for edge in range(3):
            ex, ey = EDGE_X[edge], EDGE_Y[edge]
            towards = ex * ux + ey * uy
            gap = EDGE_AT[edge] - ex * lx - ey * ly
            crossing = gap / towards if towards != 0.0 else (ENDLESS if gap >= 0 else -ENDLESS)
            if towards < 0:
                if crossing > t:
                    t, nx, ny = crossing, ex, ey
            else:
                leave = min(leave, crossing)
    if t > leave:
        return FAR, 0.0, 0.0
    if leave < 0:
        return BEHIND, 0.0, 0.0
    return t, nx, ny


@inline
def extreme(family: int, mx: float, my: float) -> tuple[float, float]:
    """The point of a unit shape that lies farthest along (mx, my)."""
    if family == DISC:
        length = math.sqrt(mx * mx + my * my)
        return mx / length, my / length
    if family == BOX:
        return (0.5 if mx >= 0 else -0.5), (0.5 if my >= 0 else -0.5)
    low, high = 0.5 * abs(mx) - my / 3.0, 2.0 * my / 3.0
    if high >= low:
        return 0.0, 2.0 / 3.0
    return (0.5 if mx >= 0 else -0.5), -1.0 / 3.0


@inline
def slide(sign: float, ax: float, ay: float, bx: float, by: float, width: float, height: float, dr: Any) -> None:
    """How the distance to an ellipse's silhouette changes with its angle and axes: its point slides on the outline.

    (ax, ay) is the ray's normal and (bx, by) its direction in the ellipse's own frame; ``sign`` tells the side.
    """
    reach = math.sqrt((width * ax) ** 2 + (height * ay) ** 2)
    along = width * width * ax * bx + height * height * ay * by
    unlike = width * width - height * height
    dr[THETA] = sign * (unlike * (ay * bx + ax * by) / reach - along * unlike * ax * ay / reach**3)
    dr[WIDTH] = sign * (2 * width * ax * bx / reach - along * width * ax * ax / reach**3)
    dr[HEIGHT] = sign * (2 * height * ay * by / reach - along * height * ay * ay / reach**3)


@inline
def told_by(
    family: int, p: Any, cos: float, sin: float, beam: Any, blur: float, dr: Any, ds: Any
) -> tuple[float, float]:
    """Where a ray meets a shape (r) and by how much it hits it (s), both in metres, with derivatives by p.

    Where s is below -blur nothing else is set. A ray that misses by less has the r of the silhouette's point.
    """
    dx, dy = beam[DIRECTION_X], beam[DIRECTION_Y]
    ox, oy = beam[ORIGIN_X] - p[X], beam[ORIGIN_Y] - p[Y]
    width, height = p[WIDTH], p[HEIGHT]
    nx, ny = -dy, dx
    ax, ay = cos * nx + sin * ny, cos * ny - sin * nx
    mx, my = width * ax, height * ay
    offset = ox * nx + oy * ny
    qx, qy = extreme(family, mx, my)
    above = mx * qx + my * qy - offset
    sx, sy = extreme(family, -mx, -my)
    below = offset - mx * sx - my * sy
    sign, s = 1.0, above
    if below < above:
        sign, s, qx, qy = -1.0, below, sx, sy
    if s < -blur:
        return 0.0, s
    tx, ty = width * qx, height * qy
    px, py = cos * tx - sin * ty, sin * tx + cos * ty
    ds[X], ds[Y] = sign * nx, sign * ny
    ds[THETA] = sign * (ny * px - nx * py)
    ds[WIDTH], ds[HEIGHT] = sign * ax * qx, sign * ay * qy
    lx, ly = (cos * ox + sin * oy) / width, (cos * oy - sin * ox) / height
    ux, uy = (cos * dx + sin * dy) / width, (cos * dy - sin * dx) / height
    t, gx, gy = FAR, 0.0, 0.0
    if s > 0:
        t, gx, gy = entry(family, lx, ly, ux, uy)
    if t == BEHIND:
        return 0.0, -FAR
    if t == FAR:
        bx, by = cos * dx + sin * dy, cos * dy - sin * dx
        dr[X], dr[Y] = dx, dy
        dr[THETA] = dy * px - dx * py
        dr[WIDTH], dr[HEIGHT] = bx * qx, by * qy
        if family == DISC:
            slide(sign, ax, ay, bx, by, width, height, dr)
        return (px - ox) * dx + (py - oy) * dy, s
    hx, hy = lx + t * ux, ly + t * uy
    scale = 1.0 / (gx * ux + gy * uy)
    dr[X] = (gx * cos / width - gy * sin / height) * scale
    dr[Y] = (gx * sin / width + gy * cos / height) * scale
    dr[THETA] = (gy * width * hx / height - gx * height * hy / width) * scale
    dr[WIDTH], dr[HEIGHT] = gx * hx / width * scale, gy * hy / height * scale
    return t, s


@inline
def share_hit(s: float, blur: float) -> float:
    """How much of a ray's footprint hits: 0 at -blur, 1 at blur, smooth in between."""
    if s >= blur:
        return 1.0
    if s <= -blur:
        return 0.0
    u = 0.5 * (s / blur + 1.0)
    return u * u * (3.0 - 2.0 * u)


@kernel
def passing(
    directions: Any, cos: float, sin: float, x: float, y: float, reach: float, kinds: Any, chosen: Any
) -> int:
    """Which beams of a scan that say something come within ``reach`` of (x, y), as seen from the laser; their number.

    ``directions`` (N, 2) are in the laser's frame, turned by (cos, sin); indices are left in ``chosen``.
    """
    ahead, aside = cos * x + sin * y, cos * y - sin * x
    count = 0
    for i in range(len(directions)):
        dx, dy = directions[i, 0], directions[i, 1]
        if abs(dx * aside - dy * ahead) < reach and dx * ahead + dy * aside > -reach and kinds[i] != SAYS_NOTHING:
            chosen[count] = i
            count += 1
    return count


@kernel
def pass_by(family: int, p: Any, beams: Any, out: Any) -> None:
    """By how much (N,) the lines of beams hit a shape (m), below 0 for a miss; -FAR where it lies behind them."""
    cos, sin = math.cos(p[THETA]), math.sin(p[THETA])
    dr, ds = np.zeros(PARAMETERS), np.zeros(PARAMETERS)
    for i in range(len(beams)):
        out[i] = told_by(family, p, cos, sin, beams[i], FAR, dr, ds)[1]


@kernel
def trace(family: int, p: Any, beams: Any, out: Any) -> None:
    """Distances (N,) of beams to a shape, FAR for a miss; 0 from inside."""
    cos, sin = math.cos(p[THETA]), math.sin(p[THETA])
    dr, ds = np.zeros(PARAMETERS), np.zeros(PARAMETERS)
    for i in range(len(beams)):
        r, s = told_by(family, p, cos, sin, beams[i], 0.0, dr, ds)
        out[i] = max(r, 0.0) if s > 0 else FAR


@kernel
def margins(family: int, p: Any, covariance: Any, beams: Any, blur: float, out: Any) -> None:
    """By how many standard deviations (N,) beams hit a shape whose parameters have a ``covariance`` (5, 5).

    Below 0 for a miss, 0 where its footprint of half-width ``blur`` (m) meets an edge. A beam that something else
    stops before it comes to the shape misses it for certain.
    """
    cos, sin = math.cos(p[THETA]), math.sin(p[THETA])
    dr, ds = np.zeros(PARAMETERS), np.zeros(PARAMETERS)
    for i in range(len(beams)):
        r, s = told_by(family, p, cos, sin, beams[i], FAR, dr, ds)
        if r >= beams[i, STOP] or s == -FAR:
            out[i] = -FAR
            continue
        variance = 1e-12
        for a in range(PARAMETERS):
            for b in range(PARAMETERS):
                variance += ds[a] * covariance[a, b] * ds[b]
        clear = s - blur if s > blur else (s + blur if s < -blur else 0.0)
        out[i] = clear / math.sqrt(variance)


@kernel
def costs(family: int, samples: Any, beams: Any, kinds: Any, sigma: float, table: Any, blur: float, out: Any) -> None:
    """The negative log-likelihood of all beams for each of many shapes: ``samples`` (M, 5), ``out`` (M,)."""
    dr, ds = np.zeros(PARAMETERS), np.zeros(PARAMETERS)
    for k in range(len(samples)):
        p = samples[k]
        cos, sin = math.cos(p[THETA]), math.sin(p[THETA])
        total = 0.0
        for i in range(len(beams)):
            beam = beams[i]
            r, s = told_by(family, p, cos, sin, beam, blur, dr, ds)
            miss = beam[MISS]
            share = share_hit(s, blur) if r < beam[STOP] else 0.0
            if share <= 0.0:
                total -= miss
                continue
            hit = looked_up(table, kinds[i], (max(r, 0.0) - beam[RANGE]) / sigma)
            total -= hit if share >= 1.0 else math.log(share * math.exp(hit) + (1.0 - share) * math.exp(miss))
        out[k] = total


@kernel
def slopes(
    family: int,
    p: Any,
    beams: Any,
    kinds: Any,
    step: int,
    sigma: float,
    table: Any,
    blur: float,
    gradient: Any,
    information: Any,
) -> float:
    """The negative log-likelihood of every ``step``-th beam, times ``step``; its gradient (5,), information (5, 5).

    Information is Gauss and Newton's for rays that hit, and the squared score for what silhouettes say.
    """
    dr, ds, score = np.zeros(PARAMETERS), np.zeros(PARAMETERS), np.zeros(PARAMETERS)
    gradient[:] = 0.0
    information[:] = 0.0
    cos, sin = math.cos(p[THETA]), math.sin(p[THETA])
    total = 0.0
    for i in range(0, len(beams), step):
        beam = beams[i]
        r, s = told_by(family, p, cos, sin, beam, blur, dr, ds)
        miss = beam[MISS]
        share = share_hit(s, blur) if r < beam[STOP] else 0.0
        if share <= 0.0:
            total -= miss
            continue
        x = (max(r, 0.0) - beam[RANGE]) / sigma
        hit = looked_up(table, kinds[i], x)
        steep = looked_up(table, 3 + kinds[i], x) / sigma
        responsible, edge = 1.0, 0.0
        if share < 1.0:
            hit_chance, miss_chance = math.exp(hit), math.exp(miss)
            likelihood = share * hit_chance + (1.0 - share) * miss_chance
            total -= math.log(likelihood)
            responsible = share * hit_chance / likelihood
            u = 0.5 * (s / blur + 1.0)
            edge = (hit_chance - miss_chance) / likelihood * 3.0 * u * (1.0 - u) / blur
        else:
            total -= hit
        curve = steep * steep
        if kinds[i] == MEASURED:  # -x * (share that is no outlier) is the slope: what is left of it over x
            curve = -steep / (x * sigma) if abs(x) > 1e-6 else 1.0 / (sigma * sigma)
        for a in range(PARAMETERS):
            score[a] = edge * ds[a]
            gradient[a] -= responsible * steep * dr[a] + score[a]
        for a in range(PARAMETERS):
            for b in range(a + 1):
                information[a, b] += responsible * curve * dr[a] * dr[b] + score[a] * score[b]
    for a in range(PARAMETERS):
        gradient[a] *= step
        for b in range(a + 1):
            information[a, b] *= step
            information[b, a] = information[a, b]
    return total * step


@inline
def solve(matrix: Any, vector: Any, damping: float, out: Any, lower: Any, size: int) -> bool:
    """Solves (matrix + damping diag(matrix)) out = vector by Cholesky's factors; False where there are none."""
    for a in range(size):
        for b in range(a + 1):
            total = matrix[a, b]
            if a == b:
                total += damping * matrix[a, a] + 1e-9
            for c in range(b):
                total -= lower[a, c] * lower[b, c]
            if a == b:
                if not total > 0:
                    return False
                lower[a, a] = math.sqrt(total)
            else:
                lower[a, b] = total / lower[b, b]
    for a in range(size):
        total = vector[a]
        for c in range(a):
            total -= lower[a, c] * out[c]
        out[a] = total / lower[a, a]
    for a in range(size - 1, -1, -1):
        total = out[a]
        for c in range(a + 1, size):
            total -= lower[c, a] * out[c]
        out[a] = total / lower[a, a]
    return True


@inline
def project(tie: Any, gradient: Any, full: Any, downhill: Any, information: Any) -> None:
    """A kind's own downhill direction (K,) and information (K, K), of those of the five parameters."""
    size = tie.shape[1]
    for k in range(size):
        downhill[k] = 0.0
        for a in range(PARAMETERS):
            downhill[k] -= tie[a, k] * gradient[a]
        for m in range(size):
            information[k, m] = 0.0
            for a in range(PARAMETERS):
                for b in range(PARAMETERS):
                    information[k, m] += tie[a, k] * full[a, b] * tie[b, m]


@inline
def step_to(p: Any, tie: Any, change: Any, trial: Any) -> None:
    """Where a change (K,) of a kind's own parameters leads; a size is no more than halved or doubled."""
    for a in range(PARAMETERS):
        trial[a] = p[a]
        for k in range(tie.shape[1]):
            trial[a] += tie[a, k] * change[k]
    for a in (WIDTH, HEIGHT):
        trial[a] = min(max(trial[a], 0.5 * p[a], SMALLEST), 2 * p[a], LARGEST)


@kernel
def descend(
    family: int,
    p: Any,
    tie: Any,
    beams: Any,
    kinds: Any,
    step: int,
    sigma: float,
    table: Any,
    blurs: Any,
    iterations: int,
    tolerance: float,
    information: Any,
) -> float:
    """Moves p (5,) downhill by Levenberg and Marquardt's steps, with one blur after the other.

    ``tie`` (5, K) maps a kind's own parameters to the five. Returns the cost at the last blur, and leaves there the
    ``information`` (K, K) on a kind's own parameters.
    """
    size = tie.shape[1]
    gradient, full = np.zeros(PARAMETERS), np.zeros((PARAMETERS, PARAMETERS))
    other_gradient, other_full = np.zeros(PARAMETERS), np.zeros((PARAMETERS, PARAMETERS))
    downhill, change, lower = np.zeros(size), np.zeros(size), np.zeros((size, size))
    trial = np.zeros(PARAMETERS)
    cost = 0.0
    for blur in blurs:
        cost = slopes(family, p, beams, kinds, step, sigma, table, blur, gradient, full)
        damping = 1e-2
        for _ in range(iterations):
            project(tie, gradient, full, downhill, information)
            if not solve(information, downhill, damping, change, lower, size):
                damping = max(10 * damping, 1e-3)
                continue
            step_to(p, tie, change, trial)
            found = slopes(family, trial, beams, kinds, step, sigma, table, blur, other_gradient, other_full)
            if found < cost:
                gained = cost - found
                cost = found
                p[:] = trial
                gradient[:] = other_gradient
                full[:] = other_full
                damping = max(0.2 * damping, 1e-6)
                if gained < tolerance:
                    break
            else:
                damping *= 8
                if damping > 1e4:
                    break
    project(tie, gradient, full, downhill, information)
    return cost


@kernel
def walk(
    occupied: Any, row: int, col: int, inverse_resolution: float, beams: Any, most: Any, stops: Any, ends: Any
) -> None:
    """Where (m) beams end in a map: in the first occupied cell, or (``ends`` False) where they leave it.

    ``occupied`` (rows, cols) begins at cell (row, col) of the plane; ``most`` (N,) are the sensor's largest ranges.
    """
    rows, cols = occupied.shape
    for i in range(len(beams)):
        x, y = beams[i, ORIGIN_X] * inverse_resolution - col, beams[i, ORIGIN_Y] * inverse_resolution - row
        dx, dy = beams[i, DIRECTION_X], beams[i, DIRECTION_Y]
        far = most[i] * inverse_resolution
        c, r = math.floor(x), math.floor(y)
        step_c, step_r = (1 if dx > 0 else -1), (1 if dy > 0 else -1)
        per_c = abs(1.0 / dx) if dx != 0.0 else FAR
        per_r = abs(1.0 / dy) if dy != 0.0 else FAR
        next_c = ((c + 1 - x) if dx > 0 else (x - c)) * per_c if dx != 0.0 else FAR
        next_r = ((r + 1 - y) if dy > 0 else (y - r)) * per_r if dy != 0.0 else FAR
        at, ends[i] = 0.0, False
        while at < far:
            leave = min(next_c, next_r)
            inside = 0 <= c < cols and 0 <= r < rows
            if inside and occupied[r, c]:
                at, ends[i] = 0.5 * (at + leave), True
                break
            beyond = (c < 0 and dx <= 0) or (c >= cols and dx >= 0) or (r < 0 and dy <= 0) or (r >= rows and dy >= 0)
            if beyond:
                break
            at = leave
            if next_c <= next_r:
                c += step_c
                next_c += per_c
            else:
                r += step_r
                next_r += per_r
        stops[i] = min(at, far) / inverse_resolution
