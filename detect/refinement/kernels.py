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

from prim.compiled import compiled

FAST = {"arcp", "contract", "reassoc", "nsz"}
"""Divisions by what stays the same may become products; infinities and NaN keep their meaning."""

kernel = compiled(inline="never", fastmath=FAST)
part = compiled(cache=False, forceinline=True, fastmath=FAST)
"""What kernels are made of."""

BOX, DISC, TRIANGLE = 0, 1, 2
"""Unit shapes: [-1/2, 1/2]², radius 1, and corners (-1/2, -1/3), (1/2, -1/3), (0, 2/3)."""

X, Y, THETA, WIDTH, HEIGHT = range(5)
PARAMETERS = 5

ORIGIN_X, ORIGIN_Y, DIRECTION_X, DIRECTION_Y, RANGE, STOP, MISS = range(7)
"""Rows of beams (7, N): the ray; the measured range, or the limit it is beyond; from where on (m) something else
stops it; the logarithm of its likelihood if it misses the shape."""

NEAR, LIMIT = 7, 8
ROWS = 9
"""Rows that beams have besides while they are collected: from where on (m) they are near, the largest range (m)."""

MEASURED, TOO_NEAR, NO_RETURN, SAYS_NOTHING = 0, 1, 2, 3

BLOCK = 256
"""So many rays are held against a shape at once."""

TABLE_REACH = 12.0
TABLE_SPACING = 64
"""The tables hold so many entries per standard deviation, up to TABLE_REACH of them at both sides."""

SMALLEST, LARGEST = 0.02, 1.2
"""Width and height (m; of a disc the semi-axes) stay between these while a fit descends."""

HOPEFUL, HOPELESS = 1e-2, 1e4
"""A descent's damping begins with the one, and ends it beyond the other."""

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


@part
def looked_up(table: Any, row: int, x: float) -> float:
    """A row of the table at x, linear between its entries."""
    place = (min(max(x, -TABLE_REACH), TABLE_REACH) + TABLE_REACH) * TABLE_SPACING
    entry = min(int(place), 2 * int(TABLE_REACH) * TABLE_SPACING - 1)
    low = float(table[row, entry])
    return low + (place - entry) * (float(table[row, entry + 1]) - low)


@part
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


@part
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


@part
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


@part
def told_by(
    family: int, p: Any, cos: float, sin: float, beams: Any, i: int, blur: float, dr: Any, ds: Any
) -> tuple[float, float]:
    """Where ray ``i`` meets a shape (r) and by how much it hits it (s), both in metres, with derivatives by p.

    Where s is below -blur nothing else is set. A ray that misses by less has the r of the silhouette's point.
    """
    dx, dy = beams[DIRECTION_X, i], beams[DIRECTION_Y, i]
    ox, oy = beams[ORIGIN_X, i] - p[X], beams[ORIGIN_Y, i] - p[Y]
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


@part
def meet(family: int, p: Any, beams: Any, first: int, count: int, r: Any, s: Any) -> None:
    """As :func:`told_by` of ``count`` rays from the ``first`` on, without derivatives: several rays at once.

    s is -FAR where the shape lies behind a ray. There are no branches here, so that compilers can use vectors.
    """
    cos, sin = math.cos(p[THETA]), math.sin(p[THETA])
    x, y, width, height = p[X], p[Y], p[WIDTH], p[HEIGHT]
    to_x, to_y = 1.0 / width, 1.0 / height
    origin_x, origin_y = beams[ORIGIN_X, first : first + count], beams[ORIGIN_Y, first : first + count]
    towards_x, towards_y = beams[DIRECTION_X, first : first + count], beams[DIRECTION_Y, first : first + count]
    for i in range(count):
        dx, dy = towards_x[i], towards_y[i]
        ox, oy = origin_x[i] - x, origin_y[i] - y
        bx, by = cos * dx + sin * dy, cos * dy - sin * dx
        lx, ly, ux, uy = (cos * ox + sin * oy) * to_x, (cos * oy - sin * ox) * to_y, bx * to_x, by * to_y
        mx, my = -width * by, height * bx
        offset = oy * dx - ox * dy
        ahead = -(ox * dx + oy * dy)
        if family == BOX:
            side = 1.0 if offset >= 0.0 else -1.0
            beside = 0.5 * (abs(mx) + abs(my)) - abs(offset)
            qx, qy = (side if mx >= 0.0 else -side), (side if my >= 0.0 else -side)
            past = ahead + 0.5 * (width * qx * bx + height * qy * by)
            along = 1.0 / ux if ux != 0.0 else ENDLESS
            across = 1.0 / uy if uy != 0.0 else ENDLESS
            enter = max(-0.5 * abs(along) - lx * along, -0.5 * abs(across) - ly * across)
            leave = min(0.5 * abs(along) - lx * along, 0.5 * abs(across) - ly * across)
        elif family == DISC:
            side = 1.0 if offset >= 0.0 else -1.0
            length = math.sqrt(mx * mx + my * my)
            beside = length - abs(offset)
            past = ahead + side * (width * mx * bx + height * my * by) / length
            square, half = ux * ux + uy * uy, ux * lx + uy * ly
            root = math.sqrt(max(half * half - square * (lx * lx + ly * ly - 1.0), 0.0))
            enter, leave = (-half - root) / square, (root - half) / square
        else:
            left, right, top = -0.5 * mx - my / 3.0, 0.5 * mx - my / 3.0, 2.0 * my / 3.0
            above, below = max(left, right, top) - offset, offset - min(left, right, top)
            beside = min(above, below)
            side = -1.0 if below < above else 1.0
            most = max(side * left, side * right, side * top)
            at_left = -0.5 * width * bx - height * by / 3.0
            at_right = 0.5 * width * bx - height * by / 3.0
            at_top = 2.0 * height * by / 3.0
            past = ahead + (at_top if side * top >= most else (at_right if side * right >= most else at_left))
            enter, leave = -FAR, FAR
            for edge in range(3):
                ex, ey = EDGE_X[edge], EDGE_Y[edge]
                into = ex * ux + ey * uy
                crossing = (EDGE_AT[edge] - ex * lx - ey * ly) / (into if into != 0.0 else 1.0)
                enter = max(enter, crossing if into < 0.0 else -FAR)
                leave = min(leave, crossing if into > 0.0 else FAR)
        hits = beside > 0.0
        r[i] = enter if hits else past
        s[i] = -FAR if hits and leave < 0.0 else beside


@part
def turn_with(family: int, p: Any, rays: Any, count: int, dr: Any) -> None:
    """The derivatives ``dr`` (5, count) by p of the distances to a shape that all ``rays`` (4, count) hit.

    As the outline moves along its normal, so does the point where a ray enters it, along the ray.
    """
    cos, sin = math.cos(p[THETA]), math.sin(p[THETA])
    x, y, width, height = p[X], p[Y], p[WIDTH], p[HEIGHT]
    to_x, to_y = 1.0 / width, 1.0 / height
    for i in range(count):
        dx, dy = rays[DIRECTION_X, i], rays[DIRECTION_Y, i]
        ox, oy = rays[ORIGIN_X, i] - x, rays[ORIGIN_Y, i] - y
        lx, ly = (cos * ox + sin * oy) * to_x, (cos * oy - sin * ox) * to_y
        ux, uy = (cos * dx + sin * dy) * to_x, (cos * dy - sin * dx) * to_y
        if family == BOX:
            along = 1.0 / ux if ux != 0.0 else ENDLESS
            across = 1.0 / uy if uy != 0.0 else ENDLESS
            near_x, near_y = -0.5 * abs(along) - lx * along, -0.5 * abs(across) - ly * across
            by_x = near_x > near_y
            enter = max(near_x, near_y)
            gx = (-1.0 if ux > 0.0 else 1.0) if by_x else 0.0
            gy = 0.0 if by_x else (-1.0 if uy > 0.0 else 1.0)
        elif family == DISC:
            square, half = ux * ux + uy * uy, ux * lx + uy * ly
            root = math.sqrt(max(half * half - square * (lx * lx + ly * ly - 1.0), 0.0))
            enter = (-half - root) / square
            gx, gy = lx + enter * ux, ly + enter * uy
        else:
            enter, gx, gy = -FAR, 0.0, 0.0
            for edge in range(3):
                ex, ey = EDGE_X[edge], EDGE_Y[edge]
                into = ex * ux + ey * uy
                crossing = (EDGE_AT[edge] - ex * lx - ey * ly) / (into if into != 0.0 else 1.0)
                later = into < 0.0 and crossing > enter
                enter, gx, gy = (crossing if later else enter), (ex if later else gx), (ey if later else gy)
        hx, hy = lx + enter * ux, ly + enter * uy
        scale = 1.0 / (gx * ux + gy * uy)
        nx, ny = gx * to_x * scale, gy * to_y * scale
        dr[X, i], dr[Y, i] = nx * cos - ny * sin, nx * sin + ny * cos
        dr[THETA, i] = ny * width * hx - nx * height * hy
        dr[WIDTH, i], dr[HEIGHT, i] = nx * hx, ny * hy


@part
def share_hit(s: float, blur: float) -> float:
    """How much of a ray's footprint hits: 0 at -blur, 1 at blur, smooth in between."""
    if s >= blur:
        return 1.0
    if s <= -blur:
        return 0.0
    u = 0.5 * (s / blur + 1.0)
    return u * u * (3.0 - 2.0 * u)


@kernel
def keep_passing(
    directions: Any,
    kinds: Any,
    z: Any,
    pose: Any,
    circle: Any,
    of_scan: Any,
    rays: Any,
    ray_kinds: Any,
    scan: Any,
    size: int,
) -> int:
    """Adds a scan's beams that say something and come near a ``circle`` (x, y, radius) to ``size`` others.

    ``directions`` (N, 2) are in the laser's frame, ``pose`` (x, y, theta) is the laser's, ``of_scan`` its largest
    range (m) and its number. ``rays`` (ROWS, room), ``ray_kinds`` and ``scan`` (room,) get what is added; returns how
    many there are then.
    """
    cos, sin = math.cos(pose[2]), math.sin(pose[2])
    away_x, away_y, reach = circle[0] - pose[0], circle[1] - pose[1], circle[2]
    for i in range(len(kinds)):
        dx = cos * directions[i, 0] - sin * directions[i, 1]
        dy = sin * directions[i, 0] + cos * directions[i, 1]
        ahead = dx * away_x + dy * away_y
        if abs(dx * away_y - dy * away_x) < reach and ahead > -reach and kinds[i] != SAYS_NOTHING:
            rays[ORIGIN_X, size], rays[ORIGIN_Y, size] = pose[0], pose[1]
            rays[DIRECTION_X, size], rays[DIRECTION_Y, size] = dx, dy
            rays[RANGE, size], rays[NEAR, size], rays[LIMIT, size] = z[i], ahead - reach, of_scan[0]
            ray_kinds[size], scan[size] = kinds[i], of_scan[1]
            size += 1
    return size


@kernel
def stop_at(family: int, p: Any, reach: float, beams: Any) -> None:
    """Cuts the STOP of beams down to where they meet a shape, all of which lies within ``reach`` (m) of its place."""
    r, s = np.empty(BLOCK), np.empty(BLOCK)
    size = beams.shape[1]
    for first in range(0, size, BLOCK):
        count = min(BLOCK, size - first)
        passes = False
        for i in range(first, first + count):
            away_x, away_y = p[X] - beams[ORIGIN_X, i], p[Y] - beams[ORIGIN_Y, i]
            passes |= abs(away_x * beams[DIRECTION_Y, i] - away_y * beams[DIRECTION_X, i]) < reach
        if passes:
            meet(family, p, beams, first, count, r, s)
            for i in range(count):
                if s[i] > 0 and r[i] < beams[STOP, first + i]:
                    beams[STOP, first + i] = max(r[i], 0.0)


@kernel
def shade(beams: Any, kinds: Any, behind: Any, blocked: Any, sigma: float, table: Any) -> None:
    """Has beams that something stops before what is ``behind`` (N,) in the map say what they say of that (MISS).

    What is ``blocked`` (N,) in the map before it comes near stops at once.
    """
    for i in range(len(kinds)):
        if beams[STOP, i] < behind[i]:
            beams[MISS, i] = looked_up(table, kinds[i], (beams[STOP, i] - beams[RANGE, i]) / sigma)
        if blocked[i]:
            beams[STOP, i] = 0.0


@kernel
def pass_by(family: int, p: Any, beams: Any, out: Any) -> None:
    """By how much (N,) the lines of beams hit a shape (m), below 0 for a miss; -FAR where it lies behind them."""
    meet(family, p, beams, 0, len(out), np.empty(len(out)), out)


@kernel
def trace(family: int, p: Any, beams: Any, out: Any) -> None:
    """Distances (N,) of beams to a shape, FAR for a miss; 0 from inside."""
    s = np.empty(len(out))
    meet(family, p, beams, 0, len(out), out, s)
    for i in range(len(out)):
        out[i] = max(out[i], 0.0) if s[i] > 0 else FAR


@kernel
def margins(family: int, p: Any, covariance: Any, beams: Any, blur: float, out: Any) -> None:
    """By how many standard deviations (N,) beams hit a shape whose parameters have a ``covariance`` (5, 5).

    Below 0 for a miss, 0 where its footprint of half-width ``blur`` (m) meets an edge. A beam that something else
    stops before it comes to the shape misses it for certain.
    """
    cos, sin = math.cos(p[THETA]), math.sin(p[THETA])
    dr, ds = np.zeros(PARAMETERS), np.zeros(PARAMETERS)
    for i in range(len(out)):
        r, s = told_by(family, p, cos, sin, beams, i, FAR, dr, ds)
        if r >= beams[STOP, i] or s == -FAR:
            out[i] = -FAR
            continue
        variance = 1e-12
        for a in range(PARAMETERS):
            for b in range(PARAMETERS):
                variance += ds[a] * covariance[a, b] * ds[b]
        clear = s - blur if s > blur else (s + blur if s < -blur else 0.0)
        out[i] = clear / math.sqrt(variance)


@part
def hits_and_edges(beams: Any, first: int, count: int, r: Any, s: Any, blur: float, hits: Any, edges: Any) -> Any:
    """Which of some beams hit a shape with all of their footprint, and which with a part of it: their numbers.

    ``r`` and ``s`` are as :func:`meet` leaves them. Returns how many hit, how many do in part, and what all others
    are likely by (nats).
    """
    stops, misses = beams[STOP, first : first + count], beams[MISS, first : first + count]
    hit, edge, missed = 0, 0, 0.0
    for i in range(count):
        stopped = r[i] >= stops[i]
        full, some = s[i] >= blur and s[i] > 0.0 and not stopped, s[i] > -blur and not stopped
        hits[hit] = i
        hit += full
        edges[edge] = i
        edge += some and not full
        missed += 0.0 if full or some else misses[i]
    return hit, edge, missed


@kernel
def costs(
    families: Any, samples: Any, beams: Any, kinds: Any, sigma: float, table: Any, blur: float, out: Any
) -> None:
    """The negative log-likelihood of all beams for each of many shapes: ``families`` (M,), ``samples`` (M, 5)."""
    r, s = np.empty(BLOCK), np.empty(BLOCK)
    hits, edges = np.empty(BLOCK + 1, np.int64), np.empty(BLOCK + 1, np.int64)
    out[:] = 0.0
    for first in range(0, len(kinds), BLOCK):
        count = min(BLOCK, len(kinds) - first)
        for k in range(len(samples)):
            meet(families[k], samples[k], beams, first, count, r, s)
            hit, edge, total = hits_and_edges(beams, first, count, r, s, blur, hits, edges)
            for n in range(hit):
                i = hits[n]
                x = (max(r[i], 0.0) - beams[RANGE, first + i]) / sigma
                total += looked_up(table, kinds[first + i], x)
            for n in range(edge):
                i = edges[n]
                x = (max(r[i], 0.0) - beams[RANGE, first + i]) / sigma
                share = share_hit(s[i], blur)
                hit_chance = math.exp(looked_up(table, kinds[first + i], x))
                total += math.log(share * hit_chance + (1.0 - share) * math.exp(beams[MISS, first + i]))
            out[k] -= total


def _slopes(
    family: int,
    p: Any,
    beams: Any,
    kinds: Any,
    sigma: float,
    table: Any,
    blur: float,
    gradient: Any,
    information: Any,
) -> float:
    """The negative log-likelihood of all beams; its gradient (5,), information (5, 5).

    Information is Gauss and Newton's for rays that hit, and the squared score for what silhouettes say.
    """
    r, s = np.empty(BLOCK), np.empty(BLOCK)
    hits, edges = np.empty(BLOCK + 1, np.int64), np.empty(BLOCK + 1, np.int64)
    rays, dr = np.empty((RANGE, BLOCK)), np.empty((PARAMETERS, BLOCK))
    steep, curve = np.empty(BLOCK), np.empty(BLOCK)
    moved, slid, score = np.zeros(PARAMETERS), np.zeros(PARAMETERS), np.zeros(PARAMETERS)
    gradient[:] = 0.0
    information[:] = 0.0
    cos, sin = math.cos(p[THETA]), math.sin(p[THETA])
    total = 0.0
    for first in range(0, len(kinds), BLOCK):
        count = min(BLOCK, len(kinds) - first)
        meet(family, p, beams, first, count, r, s)
        hit, edge, missed = hits_and_edges(beams, first, count, r, s, blur, hits, edges)
        total += missed
        for n in range(hit):
            i = first + hits[n]
            x = (max(r[hits[n]], 0.0) - beams[RANGE, i]) / sigma
            total += looked_up(table, kinds[i], x)
            steep[n] = looked_up(table, 3 + kinds[i], x) / sigma
            curve[n] = curve_of(kinds[i], steep[n], x, sigma)
            for row in range(RANGE):
                rays[row, n] = beams[row, i]
        turn_with(family, p, rays, hit, dr)
        for a in range(PARAMETERS):
            gradient[a] -= summed(steep, dr[a], dr[a], hit, False)
            for b in range(a + 1):
                information[a, b] += summed(curve, dr[a], dr[b], hit, True)
        for n in range(edge):
            i = first + edges[n]
            at, aside = told_by(family, p, cos, sin, beams, i, blur, moved, slid)
            x = (max(at, 0.0) - beams[RANGE, i]) / sigma
            share = share_hit(aside, blur)
            hit_chance, miss_chance = math.exp(looked_up(table, kinds[i], x)), math.exp(beams[MISS, i])
            likelihood = share * hit_chance + (1.0 - share) * miss_chance
            total += math.log(likelihood)
            responsible = share * hit_chance / likelihood
            downhill = looked_up(table, 3 + kinds[i], x) / sigma
            told = responsible * curve_of(kinds[i], downhill, x, sigma)
            u = 0.5 * (aside / blur + 1.0)
            slope = (hit_chance - miss_chance) / likelihood * 3.0 * u * (1.0 - u) / blur
            for a in range(PARAMETERS):
                score[a] = slope * slid[a]
                gradient[a] -= responsible * downhill * moved[a] + score[a]
                for b in range(a + 1):
                    information[a, b] += told * moved[a] * moved[b] + score[a] * score[b]
    for a in range(PARAMETERS):
        for b in range(a):
            information[b, a] = information[a, b]
    return -total


slopes_of, slopes = part(_slopes), kernel(_slopes)
"""The same, for kernels to be made of, and as a kernel."""


@part
def summed(weight: Any, one: Any, other: Any, count: int, both: bool) -> float:
    """The sum of ``weight`` times ``one``, and times ``other`` where ``both`` count."""
    total = 0.0
    for n in range(count):
        total += weight[n] * one[n] * (other[n] if both else 1.0)
    return total


@part
def curve_of(kind: int, steep: float, x: float, sigma: float) -> float:
    """How much a ray that hits tells of its distance (1 / m²); ``steep`` is its log-likelihood's slope there.

    Of a range that was measured the slope is -x times the share that is no outlier: what is left of it over x.
    """
    if kind != MEASURED:
        return steep * steep
    return -steep / (x * sigma) if abs(x) > 1e-6 else 1.0 / (sigma * sigma)


@part
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


@part
def project(tie: Any, size: int, gradient: Any, full: Any, downhill: Any, information: Any) -> None:
    """A kind's own downhill direction (K,) and information (K, K), of those of the five parameters."""
    for k in range(size):
        downhill[k] = 0.0
        for a in range(PARAMETERS):
            downhill[k] -= tie[a, k] * gradient[a]
        for m in range(size):
            information[k, m] = 0.0
            for a in range(PARAMETERS):
                for b in range(PARAMETERS):
                    information[k, m] += tie[a, k] * full[a, b] * tie[b, m]


@part
def step_to(p: Any, tie: Any, size: int, change: Any, trial: Any) -> None:
    """Where a change (K,) of a kind's own parameters leads; a size is no more than halved or doubled."""
    for a in range(PARAMETERS):
        trial[a] = p[a]
        for k in range(size):
            trial[a] += tie[a, k] * change[k]
    for a in (WIDTH, HEIGHT):
        trial[a] = min(max(trial[a], 0.5 * p[a], SMALLEST), 2 * p[a], LARGEST)


@kernel
def descend(
    families: Any,
    shapes: Any,
    ties: Any,
    sizes: Any,
    beams: Any,
    kinds: Any,
    sigma: float,
    table: Any,
    blurs: Any,
    iterations: int,
    tolerance: float,
    known_to: float,
    cost: Any,
    information: Any,
) -> None:
    """Moves each of some ``shapes`` (M, 5) downhill by Levenberg and Marquardt's steps, one blur after the other.

    ``ties`` (M, 5, 5) map a kind's own parameters, of which there are ``sizes`` (M,), to the five. Leaves the
    ``cost`` (M,) at the last blur, and the ``information`` (M, 5, 5) on a kind's own parameters, with a blur of
    ``known_to`` (m) where the last is narrower.
    """
    for k in range(len(shapes)):
        cost[k] = descended(
            families[k],
            shapes[k],
            ties[k],
            sizes[k],
            beams,
            kinds,
            sigma,
            table,
            blurs,
            iterations,
            tolerance,
            known_to,
            information[k],
        )


@part
def descended(
    family: int,
    p: Any,
    tie: Any,
    size: int,
    beams: Any,
    kinds: Any,
    sigma: float,
    table: Any,
    blurs: Any,
    iterations: int,
    tolerance: float,
    known_to: float,
    information: Any,
) -> float:
    """As :func:`descend`, of one shape."""
    gradient, full = np.zeros(PARAMETERS), np.zeros((PARAMETERS, PARAMETERS))
    other_gradient, other_full = np.zeros(PARAMETERS), np.zeros((PARAMETERS, PARAMETERS))
    downhill, change, lower = np.zeros(size), np.zeros(size), np.zeros((size, size))
    trial = np.zeros(PARAMETERS)
    cost = math.inf
    for blur in blurs:
        cost, damping = math.inf, HOPEFUL
        trial[:] = p
        for count in range(iterations + 1):
            found = slopes_of(family, trial, beams, kinds, sigma, table, blur, other_gradient, other_full)
            if found < cost:
                gained = cost - found
                cost = found
                p[:] = trial
                gradient[:] = other_gradient
                full[:] = other_full
                damping = max(0.2 * damping, 1e-6) if count else damping
                if gained < tolerance:
                    break
            else:
                damping *= 8
            project(tie, size, gradient, full, downhill, information)
            while damping < HOPELESS and not solve(information, downhill, damping, change, lower, size):
                damping = max(10 * damping, 1e-3)
            if damping > HOPELESS:
                break
            step_to(p, tie, size, change, trial)
    if blurs[-1] < known_to:
        slopes_of(family, p, beams, kinds, sigma, table, known_to, gradient, full)
    project(tie, size, gradient, full, downhill, information)
    return cost


@kernel
def clearances(occupied: Any, out: Any) -> None:
    """How many steps (to any of 8 neighbours) it is from each cell of a map to one that is occupied, or beyond it.

    0 where it is occupied itself, no more than 255.
    """
    rows, cols = occupied.shape
    for r in range(rows):
        for c in range(cols):
            near = 0
            if r > 0 and 0 < c < cols - 1:
                near = min(out[r - 1, c - 1], out[r - 1, c], out[r - 1, c + 1], out[r, c - 1])
            out[r, c] = 0 if occupied[r, c] else min(near + 1, 255)
    for r in range(rows - 1, -1, -1):
        for c in range(cols - 1, -1, -1):
            near = 0
            if r < rows - 1 and 0 < c < cols - 1:
                near = min(out[r + 1, c - 1], out[r + 1, c], out[r + 1, c + 1], out[r, c + 1])
            out[r, c] = min(out[r, c], near + 1)


@kernel
def walk(
    clear: Any, row: int, col: int, inverse_resolution: float, beams: Any, most: Any, stops: Any, ends: Any
) -> None:
    """Where (m) beams end in a map: in the first occupied cell, or (``ends`` False) where they leave it.

    ``clear`` (rows, cols), of :func:`clearances`, begins at cell (row, col) of the plane: over what is free several
    cells are taken at once. ``most`` (N,) are the sensor's largest ranges.
    """
    rows, cols = clear.shape
    for i in range(len(stops)):
        x, y = beams[ORIGIN_X, i] * inverse_resolution - col, beams[ORIGIN_Y, i] * inverse_resolution - row
        dx, dy = beams[DIRECTION_X, i], beams[DIRECTION_Y, i]
        far = most[i] * inverse_resolution
        c, r = math.floor(x), math.floor(y)
        step_c, step_r = (1 if dx > 0 else -1), (1 if dy > 0 else -1)
        first_c, first_r = (1 if dx > 0 else 0), (1 if dy > 0 else 0)
        per_c = 1.0 / dx if dx != 0.0 else FAR
        per_r = 1.0 / dy if dy != 0.0 else FAR
        per_cell = min(abs(per_c), abs(per_r))
        at, ends[i] = 0.0, False
        while at < far:
            next_c = (c + first_c - x) * per_c if dx != 0.0 else FAR
            next_r = (r + first_r - y) * per_r if dy != 0.0 else FAR
            if 0 <= c < cols and 0 <= r < rows:
                free = clear[r, c]
                if free == 0:
                    at, ends[i] = 0.5 * (at + min(next_c, next_r)), True
                    break
                if free > 2:
                    at += (free - 1) * per_cell
                    c, r = math.floor(x + at * dx), math.floor(y + at * dy)
                    continue
            elif (c < 0 and dx <= 0) or (c >= cols and dx >= 0) or (r < 0 and dy <= 0) or (r >= rows and dy >= 0):
                break
            at = min(next_c, next_r)
            if next_c <= next_r:
                c += step_c
            else:
                r += step_r
        stops[i] = min(at, far) / inverse_resolution
