"""The compiled kernels of refinement: the likelihood of rays given a shape, its derivatives, and its maximisation.

A shape is its kind's unit outline (a convex polygon or the unit disc) stretched by width and height, turned by theta
and moved to (x, y): ``p`` (5,) throughout. In the unit outline's own frame one intersection gives the ray's range r
to the shape and its derivatives. The other quantity is the clearance s: the signed distance (m) of the ray's line
from the nearer silhouette point, positive where it hits. A ray that hits has the likelihood of its range at r; one
that misses has that of the background. At s = 0 the likelihood jumps, so that it has no derivative there. A smooth
step of half-width ``blur`` (m) blends both over -blur < s < blur; fits reduce it as they converge. With ``blur`` 0
the likelihood is exact.

Kinds with tied sizes (square, circle) or without an angle have fewer parameters of their own; the Jacobian (5, K) of
the five by those is constant. What a kind's outline is comes in as an argument, :class:`Outlines`: compiled code is
cached beside this file and made anew when this file alone changes, so that nothing that stands elsewhere may be
compiled in.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from prim.arrays import FloatArray
from prim.compiled import compiled
from prim.normal import normal_table

FAST = {"arcp", "contract", "reassoc", "nsz"}
"""Fast-math flags: reciprocals, fused operations and other orders of sums; infinities and NaN keep their meaning."""

kernel = compiled(inline="never", fastmath=FAST)
part = compiled(cache=False, forceinline=True, fastmath=FAST)
"""A function that kernels are made of."""

BOX, ROUND, TRIANGLE, POLYGON = 0, 1, 2, 3
"""Forms of unit outlines."""

FORMS = {
    ((-1 / 2, -1 / 2), (1 / 2, -1 / 2), (1 / 2, 1 / 2), (-1 / 2, 1 / 2)): BOX,
    (): ROUND,
    ((-1 / 2, -1 / 3), (1 / 2, -1 / 3), (0.0, 2 / 3)): TRIANGLE,
}
"""The unit outlines that have code of their own, faster than that of any convex polygon. They stand here as that code
has them: an outline that was edited in the table of kinds is a polygon.
"""

EDGE_X = (0.0, 2.0 / math.sqrt(5.0), -2.0 / math.sqrt(5.0))
EDGE_Y = (-1.0, 1.0 / math.sqrt(5.0), 1.0 / math.sqrt(5.0))
EDGE_OFFSET = (1.0 / 3.0, 2.0 / (3.0 * math.sqrt(5.0)), 2.0 / (3.0 * math.sqrt(5.0)))
"""The unit triangle's edges: outward normals, and distances from the centroid."""

X, Y, THETA, WIDTH, HEIGHT = range(5)
PARAMETERS = 5
"""Rows of a shape's parameters p."""

ORIGIN_X, ORIGIN_Y, DIRECTION_X, DIRECTION_Y, RANGE, OCCLUSION, BACKGROUND = range(7)
"""Rows of rays (7, N): origin (m) and unit direction; the measured range (m), or the limit that it is beyond; the
range (m) from which on something else occludes the shape; the log-likelihood of the measurement by the background.
"""

ENTRY_RANGE, MAX_RANGE = 7, 8
COLLECTED_ROWS = 9
"""Further rows while rays are collected: the range (m) at which they enter the candidate's circle, and the sensor's
largest one (m).
"""

MEASURED, TOO_NEAR, NO_RETURN, INVALID = 0, 1, 2, 3
"""Outcomes of a beam, as prim.scan.RangeOutcome; the first three are rows of the table of log-likelihoods."""

BLOCK = 256
"""Rays that are intersected with a shape at once: their intermediate results fit the fastest cache."""

TABLE_REACH = 12.0
TABLE_SPACING = 64
"""Tables reach over so many standard deviations on both sides, with so many entries for each."""

LX, LY, UX, UY, MX, MY, BX, BY, HIGH, LOW, AT_HIGH, AT_LOW = range(12)
ENTER, NX, NY = HIGH, MX, MY
SCRATCH_ROWS = 12
"""Rows of scratch (12, BLOCK) for polygons."""

FAR, BEHIND = 1e30, 1e31
ENDLESS = 1e20
"""Stand for a miss, for a shape behind the ray's origin, and for the reciprocal of 0 (a ray along an edge)."""


class Outlines(NamedTuple):
    """The unit outlines of all kinds, in the order of :class:`prim.shapes.Kind`.

    ``form`` (K,); of polygons, ``corners`` (K,) vertices each, ``vertices`` (K, V, 2) counter-clockwise, and of the
    edges from each vertex to the next the outward unit ``normals`` (K, V, 2) and distances ``offsets`` (K, V) from
    the centroid.
    """

    form: NDArray[np.int64]
    corners: NDArray[np.int64]
    vertices: FloatArray
    normals: FloatArray
    offsets: FloatArray


class RayData(NamedTuple):
    """What the likelihood is a function of, besides the shape.

    ``rays`` (7, N), ``outcomes`` (N,), the range noise ``sigma`` (m), and the ``table`` of log-likelihoods of
    :func:`likelihood_table`.
    """

    rays: FloatArray
    outcomes: NDArray[np.int8]
    sigma: float
    table: FloatArray


class RayStoreView(NamedTuple):
    """Arrays that rays are collected in: ``rays`` (COLLECTED_ROWS, room), ``outcomes`` and ``scan`` (room,)."""

    rays: FloatArray
    outcomes: NDArray[np.int8]
    scan: NDArray[np.int32]


class Intersections(NamedTuple):
    """Where the rays of a block meet a shape: ``ranges`` and ``clearances`` (BLOCK,), ``scratch`` for polygons."""

    ranges: FloatArray
    clearances: FloatArray
    scratch: FloatArray


class Starts(NamedTuple):
    """The starts of M fits.

    The kinds' ``numbers`` (M,); ``shapes`` (M, 5), parameters that a fit changes in place; ``jacobians`` (M, 5, 5),
    the derivatives of the five parameters by the kinds' own; ``counts`` (M,), how many own parameters there are.
    """

    numbers: NDArray[np.int64]
    shapes: FloatArray
    jacobians: FloatArray
    counts: NDArray[np.int64]


class Schedule(NamedTuple):
    """How Levenberg and Marquardt's method descends.

    ``blurs`` (m), one after the other; at each, at most ``iterations`` steps, ending where one gains less than
    ``tolerance`` (nats); the damping's first value and its bounds, of which the upper one ends the descent; its
    factors after a step that gains and one that does not; factor and least value where the damped information is
    singular; the bounds (m) of width and height; and the least blur (m) that the information is asked with: a jump
    has none.
    """

    blurs: FloatArray
    iterations: int
    tolerance: float
    first_damping: float
    min_damping: float
    max_damping: float
    success: float
    failure: float
    singular: tuple[float, float]
    min_size: float
    max_size: float
    information_blur: float


def upper_tail(cut: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the probability (N,) that a standard normal variable exceeds each ``cut`` (N,)."""
    x, _, upper = normal_table(TABLE_REACH, TABLE_SPACING)
    return np.interp(cut, x, upper)


def likelihood_table(outlier: float, dropout: float = 0.0) -> FloatArray:
    """Tabulate the log-likelihood of a beam and its derivative over x = (r - z) / sigma, r the range to the surface.

    Row MEASURED: log(exp(-x²/2) + outlier), the density in units of its peak. TOO_NEAR: log(Phi(-x) + outlier), z the
    sensor's range_min. NO_RETURN: log(Phi(x) + outlier), z its range_max. Rows 3 to 5 are their derivatives by x.
    With dropouts, the exponential and both Phi are multiplied by 1 - dropout, and dropout is added for a NO_RETURN.

    Args:
        outlier: The density of outliers in units of the Gaussian's peak.
        dropout: The share of beams that meet a surface and return nothing.

    Returns:
        (6, 2 * TABLE_REACH * TABLE_SPACING + 1).
    """
    x, density, upper = normal_table(TABLE_REACH, TABLE_SPACING)
    density, upper = (1 - dropout) * density, (1 - dropout) * upper
    phi = density / math.sqrt(2 * math.pi)
    measured, near, far = density + outlier, upper + outlier, upper[::-1] + outlier + dropout
    slopes = [-x * density / measured, -phi / near, phi / far]
    return np.stack([np.log(measured), np.log(near), np.log(far), *slopes])


@part
def _lookup(table: Any, row: int, x: float) -> float:
    """Interpolate a row of the table linearly at x."""
    place = (min(max(x, -TABLE_REACH), TABLE_REACH) + TABLE_REACH) * TABLE_SPACING
    entry = min(int(place), 2 * int(TABLE_REACH) * TABLE_SPACING - 1)
    low = float(table[row, entry])
    return low + (place - entry) * (float(table[row, entry + 1]) - low)


@part
def _enter_form(form: int, lx: float, ly: float, ux: float, uy: float) -> tuple[float, float, float]:
    """Intersect the line l + t u with the unit outline of a form.

    Returns:
        t at the entry (below 0 from inside) and the outward normal there; t is FAR for a miss, BEHIND where the
        outline lies behind l.
    """
    t, nx, ny = -FAR, 0.0, 0.0
    if form == ROUND:
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
    if form == BOX:
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
            gap = EDGE_OFFSET[edge] - ex * lx - ey * ly
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
def _enter_polygon(outline: Any, lx: float, ly: float, ux: float, uy: float) -> tuple[float, float, float]:
    """As :func:`_enter_form`, of a polygon: ``outline`` is the outlines and the kind's number."""
    outlines, k = outline
    t, nx, ny, leave = -FAR, 0.0, 0.0, FAR
    for edge in range(outlines.corners[k]):
        ex, ey = outlines.normals[k, edge, 0], outlines.normals[k, edge, 1]
        towards = ex * ux + ey * uy
        gap = outlines.offsets[k, edge] - ex * lx - ey * ly
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
def _form_support(form: int, mx: float, my: float) -> tuple[float, float]:
    """Return the point of a form's unit outline that is farthest along (mx, my)."""
    if form == ROUND:
        length = math.sqrt(mx * mx + my * my)
        return mx / length, my / length
    if form == BOX:
        return (0.5 if mx >= 0 else -0.5), (0.5 if my >= 0 else -0.5)
    low, high = 0.5 * abs(mx) - my / 3.0, 2.0 * my / 3.0
    if high >= low:
        return 0.0, 2.0 / 3.0
    return (0.5 if mx >= 0 else -0.5), -1.0 / 3.0


@part
def _polygon_support(outline: Any, mx: float, my: float) -> tuple[float, float]:
    """As :func:`_form_support`, of a polygon."""
    outlines, k = outline
    farthest, reach = 0, -FAR
    for corner in range(outlines.corners[k]):
        along = mx * outlines.vertices[k, corner, 0] + my * outlines.vertices[k, corner, 1]
        if along > reach:
            farthest, reach = corner, along
    return outlines.vertices[k, farthest, 0], outlines.vertices[k, farthest, 1]


@part
def _silhouette_range_gradient(
    sign: float, ax: float, ay: float, bx: float, by: float, width: float, height: float, dr: Any
) -> None:
    """Set the derivatives of the range to an ellipse's silhouette point, which slides along the outline.

    (ax, ay) is the ray's normal and (bx, by) its direction in the ellipse's own frame; ``sign`` is the side.
    """
    reach = math.sqrt((width * ax) ** 2 + (height * ay) ** 2)
    along = width * width * ax * bx + height * height * ay * by
    unlike = width * width - height * height
    dr[THETA] = sign * (unlike * (ay * bx + ax * by) / reach - along * unlike * ax * ay / reach**3)
    dr[WIDTH] = sign * (2 * width * ax * bx / reach - along * width * ax * ax / reach**3)
    dr[HEIGHT] = sign * (2 * height * ay * by / reach - along * height * ay * ay / reach**3)


@part
def _form_is_round(form: int) -> bool:
    """Return whether a form is the disc."""
    return form == ROUND


@part
def _polygon_is_round(outline: Any) -> bool:
    """No polygon is round."""
    return False


def _intersection(support: Any, enter: Any, is_round: Any) -> Any:
    """Make the intersection of one ray with a shape, with derivatives, of the unit outline's three properties.

    The function that is made takes

    - outline: what the properties take first,
    - p: (5,) parameters,
    - heading: cosine and sine of theta,
    - rays: (7, N),
    - i: which ray,
    - blur: (m),
    - gradients: two arrays (5,) that get the derivatives by p of the range and of the clearance,

    and returns the range (m) and the clearance (m). Where the clearance is below -blur, no derivative is set. A ray
    that misses by less has the range of the silhouette's point.

    Args:
        support: The support point of the unit outline along a direction.
        enter: Where a line enters it.
        is_round: Whether its silhouette's point slides along it.

    Returns:
        The compiled function.
    """

    def intersect_with_gradient(
        outline: Any, p: Any, heading: Any, rays: Any, i: int, blur: float, gradients: Any
    ) -> tuple[float, float]:
        dr, ds = gradients
        cos, sin = heading
        dx, dy = rays[DIRECTION_X, i], rays[DIRECTION_Y, i]
        ox, oy = rays[ORIGIN_X, i] - p[X], rays[ORIGIN_Y, i] - p[Y]
        width, height = p[WIDTH], p[HEIGHT]
        nx, ny = -dy, dx
        ax, ay = cos * nx + sin * ny, cos * ny - sin * nx
        mx, my = width * ax, height * ay
        offset = ox * nx + oy * ny
        qx, qy = support(outline, mx, my)
        above = mx * qx + my * qy - offset
        sx, sy = support(outline, -mx, -my)
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
            t, gx, gy = enter(outline, lx, ly, ux, uy)
        if t == BEHIND:
            return 0.0, -FAR
        if t == FAR:
            bx, by = cos * dx + sin * dy, cos * dy - sin * dx
            dr[X], dr[Y] = dx, dy
            dr[THETA] = dy * px - dx * py
            dr[WIDTH], dr[HEIGHT] = bx * qx, by * qy
            if is_round(outline):
                _silhouette_range_gradient(sign, ax, ay, bx, by, width, height, dr)
            return (px - ox) * dx + (py - oy) * dy, s
        hx, hy = lx + t * ux, ly + t * uy
        scale = 1.0 / (gx * ux + gy * uy)
        dr[X] = (gx * cos / width - gy * sin / height) * scale
        dr[Y] = (gx * sin / width + gy * cos / height) * scale
        dr[THETA] = (gy * width * hx / height - gx * height * hy / width) * scale
        dr[WIDTH], dr[HEIGHT] = gx * hx / width * scale, gy * hy / height * scale
        return t, s

    return part(intersect_with_gradient)


_form_with_gradient = _intersection(_form_support, _enter_form, _form_is_round)
_polygon_with_gradient = _intersection(_polygon_support, _enter_polygon, _polygon_is_round)


@part
def _intersect_form(form: int, p: Any, rays: Any, block: Any, met: Any) -> None:
    """Intersect a block of rays with a shape of a form, without derivatives.

    The clearance is -FAR where the shape lies behind a ray. Loops over rays have no branches, so that compilers can
    vectorise them.

    Args:
        form: BOX, ROUND or TRIANGLE.
        p: (5,) parameters.
        rays: (7, N).
        block: The first ray, and how many (at most BLOCK).
        met: The :class:`Intersections`, of which ranges and clearances are set.
    """
    first, count = block
    ranges, clearances, _ = met
    cos, sin = math.cos(p[THETA]), math.sin(p[THETA])
    x, y, width, height = p[X], p[Y], p[WIDTH], p[HEIGHT]
    to_x, to_y = 1.0 / width, 1.0 / height
    origin_x, origin_y = rays[ORIGIN_X, first : first + count], rays[ORIGIN_Y, first : first + count]
    towards_x, towards_y = rays[DIRECTION_X, first : first + count], rays[DIRECTION_Y, first : first + count]
    for i in range(count):
        dx, dy = towards_x[i], towards_y[i]
        ox, oy = origin_x[i] - x, origin_y[i] - y
        bx, by = cos * dx + sin * dy, cos * dy - sin * dx
        lx, ly, ux, uy = (cos * ox + sin * oy) * to_x, (cos * oy - sin * ox) * to_y, bx * to_x, by * to_y
        mx, my = -width * by, height * bx
        offset = oy * dx - ox * dy
        ahead = -(ox * dx + oy * dy)
        if form == BOX:
            side = 1.0 if offset >= 0.0 else -1.0
            beside = 0.5 * (abs(mx) + abs(my)) - abs(offset)
            qx, qy = (side if mx >= 0.0 else -side), (side if my >= 0.0 else -side)
            past = ahead + 0.5 * (width * qx * bx + height * qy * by)
            along = 1.0 / ux if ux != 0.0 else ENDLESS
            across = 1.0 / uy if uy != 0.0 else ENDLESS
            enter = max(-0.5 * abs(along) - lx * along, -0.5 * abs(across) - ly * across)
            leave = min(0.5 * abs(along) - lx * along, 0.5 * abs(across) - ly * across)
        elif form == ROUND:
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
                crossing = (EDGE_OFFSET[edge] - ex * lx - ey * ly) / (into if into != 0.0 else 1.0)
                enter = max(enter, crossing if into < 0.0 else -FAR)
                leave = min(leave, crossing if into > 0.0 else FAR)
        hits = beside > 0.0
        ranges[i] = enter if hits else past
        clearances[i] = -FAR if hits and leave < 0.0 else beside


@part
def _to_outline(p: Any, rays: Any, i: int, cos: float, sin: float) -> tuple[float, float, float, float, float, float]:
    """Return a ray in the unit outline's frame (origin, direction), and its direction in the shape's own frame."""
    dx, dy = rays[DIRECTION_X, i], rays[DIRECTION_Y, i]
    ox, oy = rays[ORIGIN_X, i] - p[X], rays[ORIGIN_Y, i] - p[Y]
    bx, by = cos * dx + sin * dy, cos * dy - sin * dx
    to_x, to_y = 1.0 / p[WIDTH], 1.0 / p[HEIGHT]
    return (cos * ox + sin * oy) * to_x, (cos * oy - sin * ox) * to_y, bx * to_x, by * to_y, bx, by


@part
def _intersect_polygon(outlines: Any, k: int, p: Any, rays: Any, block: Any, met: Any) -> None:
    """As :func:`_intersect_form`, for a convex polygon: edge by edge, and vertex by vertex, over all rays.

    A line misses a polygon exactly if all vertices lie on one side of it; it enters at the last of the crossings with
    edges that face it, and leaves at the first of the others (Cyrus and Beck 1978).
    """
    first, count = block
    ranges, clearances, scratch = met
    cos, sin = math.cos(p[THETA]), math.sin(p[THETA])
    width, height = p[WIDTH], p[HEIGHT]
    for i in range(count):
        lx, ly, ux, uy, bx, by = _to_outline(p, rays, first + i, cos, sin)
        scratch[LX, i], scratch[LY, i], scratch[UX, i], scratch[UY, i] = lx, ly, ux, uy
        scratch[MX, i], scratch[MY, i], scratch[BX, i], scratch[BY, i] = (
            -width * by,
            height * bx,
            width * bx,
            height * by,
        )
        scratch[HIGH, i], scratch[LOW, i], scratch[AT_HIGH, i], scratch[AT_LOW, i] = -FAR, FAR, 0.0, 0.0
        ranges[i], clearances[i] = -FAR, FAR
    for corner in range(outlines.corners[k]):
        vx, vy = outlines.vertices[k, corner, 0], outlines.vertices[k, corner, 1]
        for i in range(count):
            aside = vx * scratch[MX, i] + vy * scratch[MY, i]
            along = vx * scratch[BX, i] + vy * scratch[BY, i]
            higher, lower = aside > scratch[HIGH, i], aside < scratch[LOW, i]
            scratch[HIGH, i] = aside if higher else scratch[HIGH, i]
            scratch[AT_HIGH, i] = along if higher else scratch[AT_HIGH, i]
            scratch[LOW, i] = aside if lower else scratch[LOW, i]
            scratch[AT_LOW, i] = along if lower else scratch[AT_LOW, i]
    for edge in range(outlines.corners[k]):
        ex, ey, offset = outlines.normals[k, edge, 0], outlines.normals[k, edge, 1], outlines.offsets[k, edge]
        for i in range(count):  # ranges and clearances hold the entries and the exits meanwhile
            into = ex * scratch[UX, i] + ey * scratch[UY, i]
            crossing = (offset - ex * scratch[LX, i] - ey * scratch[LY, i]) / (into if into != 0.0 else 1.0)
            ranges[i] = max(ranges[i], crossing if into < 0.0 else -FAR)
            clearances[i] = min(clearances[i], crossing if into > 0.0 else FAR)
    for i in range(count):
        dx, dy = rays[DIRECTION_X, first + i], rays[DIRECTION_Y, first + i]
        ox, oy = rays[ORIGIN_X, first + i] - p[X], rays[ORIGIN_Y, first + i] - p[Y]
        offset = oy * dx - ox * dy
        above, below = scratch[HIGH, i] - offset, offset - scratch[LOW, i]
        beside = min(above, below)
        past = -(ox * dx + oy * dy) + (scratch[AT_LOW, i] if below < above else scratch[AT_HIGH, i])
        hits, behind = beside > 0.0, clearances[i] < 0.0
        ranges[i] = ranges[i] if hits else past
        clearances[i] = -FAR if hits and behind else beside


@part
def _intersect(outlines: Any, k: int, p: Any, rays: Any, block: Any, met: Any) -> None:
    """Intersect a block of rays with a shape of kind ``k``: as :func:`_intersect_form`, whatever its outline."""
    if outlines.form[k] == POLYGON:
        _intersect_polygon(outlines, k, p, rays, block, met)
    else:
        _intersect_form(outlines.form[k], p, rays, block, met)


@part
def _range_gradients(form: int, p: Any, rays: Any, count: int, dr: Any) -> None:
    """Set the derivatives ``dr`` (5, count) by p of the ranges to a shape that all ``rays`` (4, count) hit.

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
        if form == BOX:
            along = 1.0 / ux if ux != 0.0 else ENDLESS
            across = 1.0 / uy if uy != 0.0 else ENDLESS
            near_x, near_y = -0.5 * abs(along) - lx * along, -0.5 * abs(across) - ly * across
            by_x = near_x > near_y
            enter = max(near_x, near_y)
            gx = (-1.0 if ux > 0.0 else 1.0) if by_x else 0.0
            gy = 0.0 if by_x else (-1.0 if uy > 0.0 else 1.0)
        elif form == ROUND:
            square, half = ux * ux + uy * uy, ux * lx + uy * ly
            root = math.sqrt(max(half * half - square * (lx * lx + ly * ly - 1.0), 0.0))
            enter = (-half - root) / square
            gx, gy = lx + enter * ux, ly + enter * uy
        else:
            enter, gx, gy = -FAR, 0.0, 0.0
            for edge in range(3):
                ex, ey = EDGE_X[edge], EDGE_Y[edge]
                into = ex * ux + ey * uy
                crossing = (EDGE_OFFSET[edge] - ex * lx - ey * ly) / (into if into != 0.0 else 1.0)
                later = into < 0.0 and crossing > enter
                enter, gx, gy = (crossing if later else enter), (ex if later else gx), (ey if later else gy)
        hx, hy = lx + enter * ux, ly + enter * uy
        scale = 1.0 / (gx * ux + gy * uy)
        nx, ny = gx * to_x * scale, gy * to_y * scale
        dr[X, i], dr[Y, i] = nx * cos - ny * sin, nx * sin + ny * cos
        dr[THETA, i] = ny * width * hx - nx * height * hy
        dr[WIDTH, i], dr[HEIGHT, i] = nx * hx, ny * hy


@part
def _polygon_range_gradients(outlines: Any, k: int, p: Any, rays: Any, count: int, dr: Any, scratch: Any) -> None:
    """As :func:`_range_gradients`, for a convex polygon."""
    cos, sin = math.cos(p[THETA]), math.sin(p[THETA])
    width, height = p[WIDTH], p[HEIGHT]
    for i in range(count):
        lx, ly, ux, uy, _, _ = _to_outline(p, rays, i, cos, sin)
        scratch[LX, i], scratch[LY, i], scratch[UX, i], scratch[UY, i] = lx, ly, ux, uy
        scratch[ENTER, i], scratch[NX, i], scratch[NY, i] = -FAR, 0.0, 0.0
    for edge in range(outlines.corners[k]):
        ex, ey, offset = outlines.normals[k, edge, 0], outlines.normals[k, edge, 1], outlines.offsets[k, edge]
        for i in range(count):
            into = ex * scratch[UX, i] + ey * scratch[UY, i]
            crossing = (offset - ex * scratch[LX, i] - ey * scratch[LY, i]) / (into if into != 0.0 else 1.0)
            later = into < 0.0 and crossing > scratch[ENTER, i]
            scratch[ENTER, i] = crossing if later else scratch[ENTER, i]
            scratch[NX, i] = ex if later else scratch[NX, i]
            scratch[NY, i] = ey if later else scratch[NY, i]
    for i in range(count):
        ux, uy, gx, gy = scratch[UX, i], scratch[UY, i], scratch[NX, i], scratch[NY, i]
        hx, hy = scratch[LX, i] + scratch[ENTER, i] * ux, scratch[LY, i] + scratch[ENTER, i] * uy
        scale = 1.0 / (gx * ux + gy * uy)
        nx, ny = gx / width * scale, gy / height * scale
        dr[X, i], dr[Y, i] = nx * cos - ny * sin, nx * sin + ny * cos
        dr[THETA, i] = ny * width * hx - nx * height * hy
        dr[WIDTH, i], dr[HEIGHT, i] = nx * hx, ny * hy


@part
def _hit_fraction(s: float, blur: float) -> float:
    """Return the share of a ray's footprint that hits at clearance s: a cubic step from 0 at -blur to 1 at blur."""
    if s >= blur:
        return 1.0
    if s <= -blur:
        return 0.0
    u = 0.5 * (s / blur + 1.0)
    return u * u * (3.0 - 2.0 * u)


@kernel
def append_passing(
    directions: Any, outcomes: Any, z: Any, pose: Any, circle: Any, scan: Any, store: Any, size: int
) -> int:
    """Append a scan's valid beams that pass near a circle to the rays of a :class:`RayStoreView`.

    Args:
        directions: (N, 2) unit vectors in the laser's frame.
        outcomes: (N,) MEASURED, TOO_NEAR, NO_RETURN or INVALID.
        z: (N,) ranges, or the limits that they are beyond (m).
        pose: Of the laser: x, y (m), theta (rad).
        circle: x, y, radius (m).
        scan: The scan's largest range (m) and its number.
        store: What they are appended to, with room for N more.
        size: How many rays it holds.

    Returns:
        How many rays it holds now.
    """
    cos, sin = math.cos(pose[2]), math.sin(pose[2])
    away_x, away_y, reach = circle[0] - pose[0], circle[1] - pose[1], circle[2]
    rays = store.rays
    for i in range(len(outcomes)):
        dx = cos * directions[i, 0] - sin * directions[i, 1]
        dy = sin * directions[i, 0] + cos * directions[i, 1]
        ahead = dx * away_x + dy * away_y
        if abs(dx * away_y - dy * away_x) < reach and ahead > -reach and outcomes[i] != INVALID:
            rays[ORIGIN_X, size], rays[ORIGIN_Y, size] = pose[0], pose[1]
            rays[DIRECTION_X, size], rays[DIRECTION_Y, size] = dx, dy
            rays[RANGE, size], rays[ENTRY_RANGE, size], rays[MAX_RANGE, size] = z[i], ahead - reach, scan[0]
            store.outcomes[size], store.scan[size] = outcomes[i], scan[1]
            size += 1
    return size


@kernel
def occlude(outlines: Any, k: int, p: Any, reach: float, rays: Any) -> None:
    """Lower the OCCLUSION of rays to where they meet a shape.

    Args:
        outlines: The kinds' outlines.
        k: The kind's number.
        p: (5,) parameters.
        reach: The shape's bounding radius (m).
        rays: (7, N), changed in place.
    """
    ranges, clearances, scratch = np.empty(BLOCK), np.empty(BLOCK), np.empty((SCRATCH_ROWS, BLOCK))
    size = rays.shape[1]
    for first in range(0, size, BLOCK):
        count = min(BLOCK, size - first)
        passes = False
        for i in range(first, first + count):
            away_x, away_y = p[X] - rays[ORIGIN_X, i], p[Y] - rays[ORIGIN_Y, i]
            passes |= abs(away_x * rays[DIRECTION_Y, i] - away_y * rays[DIRECTION_X, i]) < reach
        if passes:
            _intersect(outlines, k, p, rays, (first, count), Intersections(ranges, clearances, scratch))
            for i in range(count):
                if clearances[i] > 0 and ranges[i] < rays[OCCLUSION, first + i]:
                    rays[OCCLUSION, first + i] = max(ranges[i], 0.0)


@kernel
def apply_occlusion(data: Any, background: Any, blocked: Any) -> None:
    """Set the BACKGROUND log-likelihood of rays that another surface occludes before the background.

    Args:
        data: The :class:`RayData`, changed in place.
        background: (N,) ranges (m) to the map's surface behind the shape.
        blocked: (N,) whether the map blocks a ray before it comes near; its OCCLUSION becomes 0.
    """
    rays, outcomes, sigma, table = data
    for i in range(len(outcomes)):
        if rays[OCCLUSION, i] < background[i]:
            rays[BACKGROUND, i] = _lookup(table, outcomes[i], (rays[OCCLUSION, i] - rays[RANGE, i]) / sigma)
        if blocked[i]:
            rays[OCCLUSION, i] = 0.0


@kernel
def silhouette_clearances(outlines: Any, k: int, p: Any, rays: Any, out: Any) -> None:
    """Compute the clearances of rays.

    Args:
        outlines: The kinds' outlines.
        k: The kind's number.
        p: (5,) parameters.
        rays: (7, N).
        out: (N,) gets the clearances (m): below 0 for a miss, -FAR where the shape lies behind.
    """
    ranges, scratch = np.empty(BLOCK), np.empty((SCRATCH_ROWS, BLOCK))
    for first in range(0, len(out), BLOCK):
        count = min(BLOCK, len(out) - first)
        _intersect(outlines, k, p, rays, (first, count), Intersections(ranges, out[first:], scratch))


@kernel
def cast_rays(outlines: Any, k: int, p: Any, rays: Any, out: Any) -> None:
    """Compute the ranges of rays to a shape.

    Args:
        outlines: The kinds' outlines.
        k: The kind's number.
        p: (5,) parameters.
        rays: (7, N).
        out: (N,) gets the ranges (m): FAR for a miss, 0 from inside.
    """
    clearances, scratch = np.empty(BLOCK), np.empty((SCRATCH_ROWS, BLOCK))
    for first in range(0, len(out), BLOCK):
        count = min(BLOCK, len(out) - first)
        _intersect(outlines, k, p, rays, (first, count), Intersections(out[first:], clearances, scratch))
        for i in range(count):
            out[first + i] = max(out[first + i], 0.0) if clearances[i] > 0 else FAR


@kernel
def standardized_clearances(outlines: Any, k: int, p: Any, covariance: Any, rays: Any, blur: float, out: Any) -> None:
    """Compute the clearances of rays in standard deviations, for a shape whose parameters are uncertain.

    Args:
        outlines: The kinds' outlines.
        k: The kind's number.
        p: (5,) parameters.
        covariance: (5, 5) of the parameters.
        rays: (7, N).
        blur: Half-width of the footprint (m).
        out: (N,) gets the clearances: below 0 for a miss, 0 where the footprint meets an edge, -FAR where the shape
            lies behind a ray or is occluded from it.
    """
    heading = math.cos(p[THETA]), math.sin(p[THETA])
    form = outlines.form[k]
    dr, ds = np.zeros(PARAMETERS), np.zeros(PARAMETERS)
    for i in range(len(out)):
        if form == POLYGON:
            r, s = _polygon_with_gradient((outlines, k), p, heading, rays, i, FAR, (dr, ds))
        else:
            r, s = _form_with_gradient(form, p, heading, rays, i, FAR, (dr, ds))
        if r >= rays[OCCLUSION, i] or s == -FAR:
            out[i] = -FAR
            continue
        variance = 1e-12
        for a in range(PARAMETERS):
            for b in range(PARAMETERS):
                variance += ds[a] * covariance[a, b] * ds[b]
        clear = s - blur if s > blur else (s + blur if s < -blur else 0.0)
        out[i] = clear / math.sqrt(variance)


@part
def _partition(
    rays: Any, first: int, ranges: Any, clearances: Any, blur: float, hits: Any, edges: Any, count: int
) -> Any:
    """Find which rays of a block hit a shape with all of their footprint, and which with a part of it.

    ``ranges`` and ``clearances`` are as :func:`_intersect` leaves them; ``hits`` and ``edges`` get the indices.
    Returns how many hit, how many do in part, and the background's log-likelihood of all others.
    """
    occlusions, backgrounds = rays[OCCLUSION, first : first + count], rays[BACKGROUND, first : first + count]
    hit, edge, missed = 0, 0, 0.0
    for i in range(count):
        occluded = ranges[i] >= occlusions[i]
        full = clearances[i] >= blur and clearances[i] > 0.0 and not occluded
        some = clearances[i] > -blur and not occluded
        hits[hit] = i
        hit += full
        edges[edge] = i
        edge += some and not full
        missed += 0.0 if full or some else backgrounds[i]
    return hit, edge, missed


@kernel
def negative_log_likelihoods(outlines: Any, numbers: Any, samples: Any, data: Any, blur: float, out: Any) -> None:
    """Compute the negative log-likelihood of all rays for each of many shapes.

    Args:
        outlines: The kinds' outlines.
        numbers: (M,) the kinds' numbers.
        samples: (M, 5) parameters.
        data: The :class:`RayData`.
        blur: (m).
        out: (M,) gets the costs (nats).
    """
    rays, outcomes, sigma, table = data
    ranges, clearances, scratch = np.empty(BLOCK), np.empty(BLOCK), np.empty((SCRATCH_ROWS, BLOCK))
    hits, edges = np.empty(BLOCK + 1, np.int64), np.empty(BLOCK + 1, np.int64)
    out[:] = 0.0
    for first in range(0, len(outcomes), BLOCK):
        count = min(BLOCK, len(outcomes) - first)
        for m in range(len(samples)):
            met = Intersections(ranges, clearances, scratch)
            _intersect(outlines, numbers[m], samples[m], rays, (first, count), met)
            hit, edge, total = _partition(rays, first, ranges, clearances, blur, hits, edges, count)
            for n in range(hit):
                i = hits[n]
                x = (max(ranges[i], 0.0) - rays[RANGE, first + i]) / sigma
                total += _lookup(table, outcomes[first + i], x)
            for n in range(edge):
                i = edges[n]
                x = (max(ranges[i], 0.0) - rays[RANGE, first + i]) / sigma
                share = _hit_fraction(clearances[i], blur)
                hit_likelihood = math.exp(_lookup(table, outcomes[first + i], x))
                total += math.log(share * hit_likelihood + (1.0 - share) * math.exp(rays[BACKGROUND, first + i]))
            out[m] -= total


def _gradient(  # noqa: C901 - one pass over the rays
    outlines: Any, k: int, p: Any, data: Any, blur: float, gradient: Any, information: Any
) -> float:
    """Compute the negative log-likelihood of all rays, its gradient, and the information.

    The information is Gauss and Newton's for measured ranges that hit (an outlier's weight is less, as in iteratively
    reweighted least squares), and the squared score for censored ones (Berndt, Hall, Hall and Hausman 1974). At
    silhouettes it is the sum of the former, weighted by the probability that the ray hit, and of the squared score of
    the clearance.

    Args:
        outlines: The kinds' outlines.
        k: The kind's number.
        p: (5,) parameters.
        data: The :class:`RayData`.
        blur: (m).
        gradient: (5,) gets the gradient by p.
        information: (5, 5) gets the information on p.

    Returns:
        The cost (nats).
    """
    form = outlines.form[k]
    rays, outcomes, sigma, table = data
    ranges, clearances, scratch = np.empty(BLOCK), np.empty(BLOCK), np.empty((SCRATCH_ROWS, BLOCK))
    hits, edges = np.empty(BLOCK + 1, np.int64), np.empty(BLOCK + 1, np.int64)
    hitting, dr = np.empty((RANGE, BLOCK)), np.empty((PARAMETERS, BLOCK))
    range_scores, curvature = np.empty(BLOCK), np.empty(BLOCK)
    by_range, by_clearance, score = np.zeros(PARAMETERS), np.zeros(PARAMETERS), np.zeros(PARAMETERS)
    gradient[:] = 0.0
    information[:] = 0.0
    heading = math.cos(p[THETA]), math.sin(p[THETA])
    total = 0.0
    for first in range(0, len(outcomes), BLOCK):
        count = min(BLOCK, len(outcomes) - first)
        _intersect(outlines, k, p, rays, (first, count), Intersections(ranges, clearances, scratch))
        hit, edge, missed = _partition(rays, first, ranges, clearances, blur, hits, edges, count)
        total += missed
        for n in range(hit):
            i = first + hits[n]
            x = (max(ranges[hits[n]], 0.0) - rays[RANGE, i]) / sigma
            total += _lookup(table, outcomes[i], x)
            range_scores[n] = _lookup(table, 3 + outcomes[i], x) / sigma
            curvature[n] = _range_information(outcomes[i], range_scores[n], x, sigma)
            for row in range(RANGE):
                hitting[row, n] = rays[row, i]
        if form == POLYGON:
            _polygon_range_gradients(outlines, k, p, hitting, hit, dr, scratch)
        else:
            _range_gradients(form, p, hitting, hit, dr)
        for a in range(PARAMETERS):
            gradient[a] -= _weighted_sum(range_scores, dr[a], dr[a], hit, False)
            for b in range(a + 1):
                information[a, b] += _weighted_sum(curvature, dr[a], dr[b], hit, True)
        for n in range(edge):
            i = first + edges[n]
            if form == POLYGON:
                at, aside = _polygon_with_gradient((outlines, k), p, heading, rays, i, blur, (by_range, by_clearance))
            else:
                at, aside = _form_with_gradient(form, p, heading, rays, i, blur, (by_range, by_clearance))
            x = (max(at, 0.0) - rays[RANGE, i]) / sigma
            share = _hit_fraction(aside, blur)
            hit_likelihood, miss_likelihood = math.exp(_lookup(table, outcomes[i], x)), math.exp(rays[BACKGROUND, i])
            likelihood = share * hit_likelihood + (1.0 - share) * miss_likelihood
            total += math.log(likelihood)
            responsibility = share * hit_likelihood / likelihood
            range_score = _lookup(table, 3 + outcomes[i], x) / sigma
            weight_of_range = responsibility * _range_information(outcomes[i], range_score, x, sigma)
            u = 0.5 * (aside / blur + 1.0)
            step = (hit_likelihood - miss_likelihood) / likelihood * 3.0 * u * (1.0 - u) / blur
            for a in range(PARAMETERS):
                score[a] = step * by_clearance[a]
                gradient[a] -= responsibility * range_score * by_range[a] + score[a]
                for b in range(a + 1):
                    information[a, b] += weight_of_range * by_range[a] * by_range[b] + score[a] * score[b]
    for a in range(PARAMETERS):
        for b in range(a):
            information[b, a] = information[a, b]
    return -total


_gradient_part, gradient = part(_gradient), kernel(_gradient)
"""The same, for kernels to be made of, and as a kernel."""


@part
def _weighted_sum(weight: Any, first: Any, second: Any, count: int, both: bool) -> float:
    """Return the sum of ``weight`` times ``first``, and times ``second`` where ``both`` count."""
    total = 0.0
    for n in range(count):
        total += weight[n] * first[n] * (second[n] if both else 1.0)
    return total


@part
def _range_information(outcome: int, slope: float, x: float, sigma: float) -> float:
    """Return the information (1 / m²) of a ray that hits on its range; ``slope`` is its log-likelihood's derivative.

    Of a measured range the slope is -x / sigma times the probability that it is no outlier; the information is that
    probability over sigma².
    """
    if outcome != MEASURED:
        return slope * slope
    return -slope / (x * sigma) if abs(x) > 1e-6 else 1.0 / (sigma * sigma)


@part
def _solve_damped(matrix: Any, vector: Any, damping: float, out: Any, lower: Any, size: int) -> bool:
    """Solve (matrix + damping diag(matrix)) out = vector by Cholesky; False where not positive definite."""
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
def _project(jacobian: Any, size: int, gradient: Any, full: Any, downhill: Any, information: Any) -> None:
    """Set a kind's own downhill direction (K,) and information (K, K) from those of the five parameters."""
    for k in range(size):
        downhill[k] = 0.0
        for a in range(PARAMETERS):
            downhill[k] -= jacobian[a, k] * gradient[a]
        for m in range(size):
            information[k, m] = 0.0
            for a in range(PARAMETERS):
                for b in range(PARAMETERS):
                    information[k, m] += jacobian[a, k] * full[a, b] * jacobian[b, m]


@part
def _step(p: Any, jacobian: Any, size: int, change: Any, schedule: Any, trial: Any) -> None:
    """Set the parameters after a change (K,) of a kind's own; a size is no more than halved or doubled."""
    for a in range(PARAMETERS):
        trial[a] = p[a]
        for k in range(size):
            trial[a] += jacobian[a, k] * change[k]
    for a in (WIDTH, HEIGHT):
        trial[a] = min(max(trial[a], 0.5 * p[a], schedule.min_size), 2 * p[a], schedule.max_size)


@kernel
def descend(outlines: Any, starts: Any, data: Any, schedule: Any, cost: Any, information: Any) -> None:
    """Minimise the negative log-likelihood from each of some shapes by Levenberg and Marquardt's method.

    Args:
        outlines: The kinds' outlines.
        starts: The :class:`Starts`; their shapes are changed in place.
        data: The :class:`RayData`.
        schedule: The :class:`Schedule`.
        cost: (M,) gets the costs (nats) at the last blur.
        information: (M, 5, 5) gets the information on own parameters.
    """
    numbers, shapes, jacobians, counts = starts
    for m in range(len(shapes)):
        start = shapes[m], jacobians[m], counts[m]
        cost[m] = _descend_one(outlines, numbers[m], start, data, schedule, information[m])


@part
def _descend_one(outlines: Any, number: int, start: Any, data: Any, schedule: Any, information: Any) -> float:
    """As :func:`descend`, of one start: its shape, Jacobian and count; returns its cost (nats)."""
    p, jacobian, size = start
    gradient, full = np.zeros(PARAMETERS), np.zeros((PARAMETERS, PARAMETERS))
    other_gradient, other_full = np.zeros(PARAMETERS), np.zeros((PARAMETERS, PARAMETERS))
    downhill, change, lower = np.zeros(size), np.zeros(size), np.zeros((size, size))
    trial = np.zeros(PARAMETERS)
    blurs = schedule.blurs
    cost = math.inf
    for blur in blurs:
        cost, damping = math.inf, schedule.first_damping
        trial[:] = p
        for count in range(schedule.iterations + 1):
            found = _gradient_part(outlines, number, trial, data, blur, other_gradient, other_full)
            if found < cost:
                gained = cost - found
                cost = found
                p[:] = trial
                gradient[:] = other_gradient
                full[:] = other_full
                damping = max(schedule.success * damping, schedule.min_damping) if count else damping
                if gained < schedule.tolerance:
                    break
            else:
                damping *= schedule.failure
            _project(jacobian, size, gradient, full, downhill, information)
            while damping < schedule.max_damping and not _solve_damped(
                information, downhill, damping, change, lower, size
            ):
                damping = max(schedule.singular[0] * damping, schedule.singular[1])
            if damping > schedule.max_damping:
                break
            _step(p, jacobian, size, change, schedule, trial)
    if blurs[-1] < schedule.information_blur:
        _gradient_part(outlines, number, p, data, schedule.information_blur, gradient, full)
    _project(jacobian, size, gradient, full, downhill, information)
    return cost
