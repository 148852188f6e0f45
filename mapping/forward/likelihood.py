"""The compiled kernels of the forward sensor model: what every ray says about the cells on its way.

A ray crosses one cell for each step along its major axis. Each cell holds a chance ``o`` to stop a ray that enters
it; ``expect`` walks the rays, weighs for each of them where it may have stopped by what it measured, and adds that
up per cell: the E step of the expectation-maximisation in mapping.forward.mapper. All lengths inside are in cells.

Compiled code is cached beside this file and made anew when this file changes, so that every constant it uses must
stand here.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from prim.compiled import compiled, inline, kernel

SHIFT = 32
ONE = float(1 << SHIFT)
FAR_CELLS = float(1 << 20)
"""A ray that starts further off the grid is not followed."""

REACH = 6.0
"""Beyond this many standard deviations the Gaussian is nothing."""

SPACING = 64
"""Entries per standard deviation in the tables."""

TOP = int(2 * REACH * SPACING)

CUT = REACH**2 / 512
"""Where the Gaussian ends, in x^2 / 512."""

CHUNK = 32
"""So many cells are walked before it is asked whether a ray is spent."""

HOLD_OUT = 5
"""Every so manyth ray is held out where the noise is to be found from rays that the map has not seen.

Which ones moves on from scan to scan: they are not the same bearings each time.
"""

NEVER_NOTHING = 1e-10
"""What is left of a ray stays above this: numbers near the smallest ones would slow the processor down a lot."""

SPENT = 1e-5
"""A ray is followed until no more than this chance is left that it came so far."""

BEFORE, BEYOND = 0.5, 0.5
"""The chances that a ray meets something before it comes to the grid, where its sensor stands off it; and that one
which leaves the grid meets something before range_max."""

WILD_TAIL = 0.1
"""The share of wild measurements that read as too near, and as no return; the rest is spread over all ranges."""

MEASURED, TOO_NEAR, NO_RETURN = 0, 1, 2
HITS, PASSES, CERTAIN = 0, 1, 2
LOG_LIKELIHOOD, STOPS, SQUARES, WILD, RAYS, VISITS = range(6)

ROOT_HALF = math.sqrt(0.5)
PEAK = 1 / math.sqrt(2 * math.pi)


def tables() -> NDArray[np.float32]:
    """Weights and second moments (5, TOP + 1) over x = (s - z) / sigma from -REACH to REACH, s where the ray stops.

    Rows MEASURED, TOO_NEAR, NO_RETURN: the measurement's weight. exp(-x^2 / 2) for a range z; Phi(-x) for one that
    read less than z = range_min; Phi(x) for more than z = range_max. Rows 3 and 4: the second moment of the noise,
    in sigma^2, given that a range is cut off below or above (moments of the truncated normal distribution).
    """
    x = np.arange(-REACH * SPACING, REACH * SPACING + 1) / SPACING
    density = np.exp(-(x**2) / 2)
    below = np.array([0.5 * math.erfc(value * ROOT_HALF) for value in x])
    above = below[::-1]
    cut_below = 1 + x * density * PEAK / below
    return np.stack([density, below, above, cut_below, cut_below[::-1]]).astype(np.float32)


@inline
def normal_cdf(u: float) -> float:
    """Phi(u)."""
    return 0.5 * math.erfc(-u * ROOT_HALF)


@inline
def normal_cdf_integral(u: float) -> float:
    """The integral of Phi up to u."""
    return u * normal_cdf(u) + PEAK * math.exp(-0.5 * u * u)


@inline
def looked_up(table: Any, row: int, x: float) -> float:
    """A row of the table at x, linear between its entries."""
    place = min(max(x + REACH, 0.0), 2 * REACH) * SPACING
    entry = min(int(place), TOP - 1)
    low = float(table[row, entry])
    return low + (place - entry) * (float(table[row, entry + 1]) - low)


@inline
def beyond(kind: int, z: float, z_min: float, z_max: float, exit_at: float, sigma: float, table: Any) -> float:
    """The likelihood of a measurement (per cell, where it is a range) whose ray has left the grid at ``exit_at``.

    What lies beyond the grid is anywhere beyond it, up to range_max: with BEYOND's chance the range is uniform over
    that, plus noise; else there is no return.
    """
    if exit_at >= z_max:
        return 1.0 if kind == NO_RETURN else 0.0
    span = z_max - exit_at
    if kind == MEASURED:
        return (
            BEYOND
            * (looked_up(table, NO_RETURN, (z - exit_at) / sigma) - looked_up(table, NO_RETURN, (z - z_max) / sigma))
            / span
        )
    if kind == TOO_NEAR:
        near = normal_cdf_integral((z_min - exit_at) / sigma) - normal_cdf_integral((z_min - z_max) / sigma)
        return BEYOND * sigma * near / span
    far = normal_cdf_integral(span / sigma) - PEAK
    return 1 - BEYOND * sigma * far / span


@inline
def before(kind: int, z: float, z_min: float, z_max: float, entry: float, sigma: float, table: Any) -> float:
    """The likelihood of a measurement whose ray was stopped before it came to the grid at ``entry``, as beyond.

    What lies between a sensor off the grid and the grid is anywhere there.
    """
    if entry <= 0:
        return 0.0
    if kind == MEASURED:
        return (
            BEFORE
            * (looked_up(table, NO_RETURN, z / sigma) - looked_up(table, NO_RETURN, (z - entry) / sigma))
            / entry
        )
    limit = z_min if kind == TOO_NEAR else z_max
    nearer = sigma * (normal_cdf_integral(limit / sigma) - normal_cdf_integral((limit - entry) / sigma)) / entry
    return BEFORE * nearer if kind == TOO_NEAR else BEFORE * max(1 - nearer, 0.0)


@inline
def wild(kind: int, z_min: float, z_max: float) -> float:
    """The likelihood of a measurement that has nothing to do with the map."""
    return (1 - 2 * WILD_TAIL) / (z_max - z_min) if kind == MEASURED else WILD_TAIL


@inline
def first_inside(offset: int, tilt: int, cells: int) -> tuple[int, int]:
    """First and last step for which 0 <= (offset + step * tilt) >> SHIFT < cells; none where the first is larger."""
    end = (cells << SHIFT) - 1
    if tilt == 0:
        return (0, 1 << 40) if 0 <= offset <= end else (1, 0)
    if tilt < 0:
        offset, tilt = end - offset, -tilt
    return -(offset // tilt), (end - offset) // tilt


@inline
def lay(x: float, y: float, dx: float, dy: float, rows: int, cols: int) -> tuple[Any, ...]:
    """A ray from (x, y) along (dx, dy), in cells of the grid: one cell per step along its major axis.

    Returns first and last step within the grid, flat index of step 0 (along the major axis only), major stride,
    minor stride, the minor coordinate's fixed-point offset and tilt, the distance of step 0 (may be below 0: only
    steps ahead of the sensor are returned) and between steps.
    """
    along_x = abs(dx) >= abs(dy)
    if along_x:
        a, b, da, db, a_cells, b_cells, a_stride, b_stride = x, y, dx, dy, cols, rows, 1, cols
    else:
        a, b, da, db, a_cells, b_cells, a_stride, b_stride = y, x, dy, dx, rows, cols, cols, 1
    step = 1 / abs(da)
    cell = math.floor(a)
    start = (cell + 0.5 - a) * step if da > 0 else (a - cell - 0.5) * step
    tilt = int(db * step * ONE)
    offset = math.floor((b + start * db) * ONE)
    first, last = first_inside(offset, tilt, b_cells)
    if da > 0:
        first, last, major = max(first, -cell), min(last, a_cells - 1 - cell), a_stride
    else:
        first, last, major = max(first, cell - a_cells + 1), min(last, cell), -a_stride
    first = max(first, 0 if start > 0 else 1)
    return first, last, cell * a_stride, major, b_stride, offset, tilt, start, step


part = compiled(cache=False, forceinline=True)
"""A part of the kernels below."""

fused = compiled(cache=False, forceinline=True, fastmath={"contract"})
"""Multiplication and addition in one step."""

fast = compiled(cache=False, forceinline=True, fastmath={"nsz", "contract", "reassoc", "nnan"})
"""Sums in any order, so that they can be taken eight at a time."""


@fused
def walk(
    line: Any, stop: int, left: Any, x_start: Any, x_step: Any, flat: Any, where: Any, chance: Any, apart: Any
) -> Any:
    """Follows a ray until it is spent or at step ``stop``; returns how many cells it came to, and what is left of it.

    ``left`` is the chance that it comes to the first.

    Fills, for each cell: ``where`` (flat index), ``chance`` (to come that far), ``apart`` ((s - z) / sigma). Whether
    the ray is spent is looked up after every CHUNK cells: a test at each would hold up all that follows it.
    """
    first, start, major, minor, offset, tilt = line
    count = 0
    step = first
    c, along = start + first * major, offset + first * tilt
    while step <= stop and left >= SPENT:
        for k in range(min(CHUNK, stop + 1 - step)):
            n = np.uintp(count + k)
            here = c + (along >> SHIFT) * minor
            where[n] = here
            chance[n] = left
            apart[n] = x_start + np.float32(np.int32(step + k)) * x_step
            left = left * (np.float32(1) - flat[np.uintp(here)]) + np.float32(NEVER_NOTHING)
            c += major
            along += tilt
        count += min(CHUNK, stop + 1 - step)
        step += CHUNK
    return count, left


@fast
def weigh_range(count: int, where: Any, chance: Any, apart: Any, flat: Any, share: Any) -> Any:
    """``share``: chance to stop in each cell, times exp(-x^2 / 2) (to 5e-4 of it); returns their sum."""
    for i in range(count):
        share[np.uintp(i)] = flat[np.uintp(where[np.uintp(i)])]
    total = np.float32(0)
    for i in range(count):
        n = np.uintp(i)
        x = apart[n]
        t = x * x * np.float32(1 / 512)
        u = min(t, np.float32(CUT))
        w = np.float32(1) - u * (np.float32(1) - u * (np.float32(0.5) - u * np.float32(1 / 6)))
        w *= w
        w *= w
        w *= w
        w *= w
        w *= w
        w *= w
        w *= w
        w *= w
        part = chance[n] * share[n] * (w if t < np.float32(CUT) else np.float32(0))
        share[n] = part
        total += part
    return total


@part
def weigh_cut(row: int, count: int, where: Any, chance: Any, apart: Any, flat: Any, table: Any, share: Any) -> Any:
    """As weigh_range, for a measurement that was cut off at one end of the sensor's range: weights from a table."""
    total = np.float32(0)
    for i in range(count):
        n = np.uintp(i)
        part = chance[n] * flat[np.uintp(where[n])] * np.float32(looked_up(table, row, apart[n]))
        share[n] = part
        total += part
    return total


@fast
def moments(count: int, factor: Any, share: Any, apart: Any) -> Any:
    """Turns shares into responsibilities in place; returns their sum and the sum of their x^2."""
    stops, squares = np.float32(0), np.float32(0)
    for i in range(count):
        n = np.uintp(i)
        q = share[n] * factor
        share[n] = q
        stops += q
        squares += q * apart[n] * apart[n]
    return stops, squares


@part
def moments_cut(row: int, count: int, factor: Any, share: Any, apart: Any, table: Any) -> Any:
    """As moments, with the noise's second moment from a table."""
    stops, squares = np.float32(0), np.float32(0)
    for i in range(count):
        n = np.uintp(i)
        q = share[n] * factor
        share[n] = q
        stops += q
        squares += q * np.float32(looked_up(table, row, apart[n]))
    return stops, squares


@part
def scatter(count: int, behind: Any, share: Any, where: Any, sums: Any, certain: bool) -> None:
    """Adds a ray's responsibilities to its cells, from the last one back; ``behind`` is what lies beyond them."""
    for i in range(count - 1, -1, -1):
        n = np.uintp(i)
        c = np.uintp(where[n])
        q = share[n]
        sums[c, HITS] += q
        sums[c, PASSES] += behind
        behind += q
        if certain:
            sums[c, CERTAIN] += behind * behind


@inline
def measured(z: float, z_min: float, z_max: float, spread: float) -> tuple[int, float, float]:
    """What was measured: its kind, the range that it tells of, and how far the ray can have come at most."""
    if z == -math.inf:
        return TOO_NEAR, z_min, z_min + REACH * spread
    if z >= z_max:
        return NO_RETURN, z_max, z_max
    return MEASURED, z, z + REACH * spread


@inline
def is_chosen(number: Any, stride: int, held_out: int) -> bool:
    """Whether a pass takes a ray: every ``stride``-th, of those held out (-1), of the others (1), or of all (0)."""
    return number % stride == 0 and (held_out == 0 or (number % HOLD_OUT == 0) == (held_out < 0))


@part
def follow(
    x: float,
    y: float,
    beam: Any,
    limits: Any,
    stopping: Any,
    lead: int,
    spread: float,
    epsilon: float,
    table: Any,
    where: Any,
    chance: Any,
    apart: Any,
    share: Any,
) -> tuple[Any, ...]:
    """One ray from (x, y): what it crosses, and how likely what it measured is.

    ``beam`` is its direction and range (-inf: nearer than range_min, inf: no return), ``limits`` are range_min and
    range_max, ``lead`` is how many of its first cells are passed over. Fills ``where``, ``chance``, ``apart`` (as
    :func:`walk`) and ``share`` (as :func:`weigh_range`).

    Returns what was measured, how many cells it came to (-1: it misses the grid), the factor of their shares in the
    density, the likelihood of what lies beyond them, that of a wild measurement, and the density of them all.
    """
    rows, cols = stopping.shape
    flat = stopping.reshape(-1)
    z_min, z_max = limits
    inverse_spread = 1 / spread
    if not (-FAR_CELLS < x < cols + FAR_CELLS and -FAR_CELLS < y < rows + FAR_CELLS):
        return 0, -1, 0.0, 0.0, 0.0, 1.0
    first, last, start, major, minor, offset, tilt, s0, ds = lay(x, y, beam[0], beam[1], rows, cols)
    if first > last:
        return 0, -1, 0.0, 0.0, 0.0, 1.0
    kind, z, furthest = measured(beam[2], z_min, z_max, spread)
    entry = 0.0 if 0 <= x < cols and 0 <= y < rows else s0 + (first - 0.5) * ds
    exit_at = s0 + (last + 0.5) * ds
    leaves = exit_at <= furthest
    stop = last if leaves else min(last, int((furthest - s0) / ds))
    line = (first + lead, start, major, minor, offset, tilt)
    x_start, x_step = np.float32((s0 - z) * inverse_spread), np.float32(ds * inverse_spread)
    comes = np.float32(1.0 if entry <= 0 else 1 - BEFORE)
    count, left = walk(line, stop, comes, x_start, x_step, flat, where, chance, apart)
    gone = 0.0
    if left >= SPENT and leaves:
        gone = left * beyond(kind, z, z_min, z_max, exit_at, spread, table)
    elif left >= SPENT and kind == NO_RETURN:
        gone = float(left)
    if kind == MEASURED:
        scale = PEAK * inverse_spread
        total = weigh_range(count, where, chance, apart, flat, share)
    else:
        scale = 1.0
        total = weigh_cut(kind, count, where, chance, apart, flat, table, share)
    wildness = epsilon * wild(kind, z_min, z_max)
    ahead = before(kind, z, z_min, z_max, entry, spread, table)
    density = (1 - epsilon) * (total * scale + gone + ahead) + wildness
    return kind, count, scale, gone, wildness, density


@inline
def stand(pose: Any, mount: Any, nudges: Any, k: int, corner: Any, per_metre: float, place: Any) -> None:
    """Where a laser stands (in cells) and looks (cosine, sine) from a pose (``k`` = 0), or from one that is nudged up
    or down along x, y or the heading (1 to 6).
    """
    x, y, theta = pose[0], pose[1], pose[2]
    if k:
        change = nudges[(k - 1) // 2] if k % 2 else -nudges[(k - 1) // 2]
        if k < 3:
            x += change
        elif k < 5:
            y += change
        else:
            theta += change
    cos, sin = math.cos(theta), math.sin(theta)
    place[0] = (x + cos * mount[0] - sin * mount[1] - corner[0]) * per_metre
    place[1] = (y + sin * mount[0] + cos * mount[1] - corner[1]) * per_metre
    place[2], place[3] = math.cos(theta + mount[2]), math.sin(theta + mount[2])


@kernel
def look(
    rays: Any,
    pose: Any,
    mount: Any,
    limits: Any,
    nudges: Any,
    corner: Any,
    resolution: float,
    stopping: Any,
    sigma: float,
    epsilon: float,
    table: Any,
    found: Any,
) -> None:
    """How likely a scan is from a robot at ``pose`` (3,), and how that changes with the pose.

    ``rays`` (N, 5): where each beam starts (x, y), its direction, and its range, in the frame of the laser, which is
    mounted on the robot at ``mount`` (3,). ``limits`` are range_min and range_max (m); ``nudges`` (3,) the steps
    (m, m, rad) of the differences. The map is given as in :func:`expect`. Where ``nudges`` are zero the likelihood
    alone is found.

    Fills ``found`` (11,): log-likelihood, its slope (3), the information as six numbers xx, xy, xt, yy, yt, tt (sums
    of products of single rays' slopes: Berndt, Hall, Hall and Hausman 1974), and how many rays are on the map.
    """
    longest = stopping.shape[0] + stopping.shape[1] + CHUNK
    where, share = np.empty(longest, np.int64), np.empty(longest, np.float32)
    apart, chance = np.empty(longest, np.float32), np.empty(longest, np.float32)
    per_metre, spread = 1 / resolution, sigma / resolution
    cells = (limits[0] * per_metre, limits[1] * per_metre)
    slope, places = np.empty(3), np.empty((7, 4))
    found[:] = 0.0
    looks = 7 if nudges[0] > 0 else 1
    for k in range(looks):
        stand(pose, mount, nudges, k, corner, per_metre, places[k])
    for i in range(len(rays)):
        here = 0.0
        counts = True
        for k in range(looks):
            cos, sin = places[k, 2], places[k, 3]
            x = places[k, 0] + (cos * rays[i, 0] - sin * rays[i, 1]) * per_metre
            y = places[k, 1] + (sin * rays[i, 0] + cos * rays[i, 1]) * per_metre
            dx, dy = cos * rays[i, 2] - sin * rays[i, 3], sin * rays[i, 2] + cos * rays[i, 3]
            beam = (dx, dy, rays[i, 4] * per_metre)
            kind, count, _, _, _, density = follow(
                x, y, beam, cells, stopping, 0, spread, epsilon, table, where, chance, apart, share
            )
            if count < 0:  # off the map: no likelier than what has nothing to do with it
                kind = measured(beam[2], cells[0], cells[1], spread)[0]
                density = epsilon * wild(kind, cells[0], cells[1])
            log_density = math.log(density * per_metre if kind == MEASURED else density)
            if k == 0:
                here, counts = log_density, count >= 0
            elif k % 2:
                slope[(k - 1) // 2] = log_density
            else:
                slope[(k - 1) // 2] = (slope[(k - 1) // 2] - log_density) / (2 * nudges[(k - 1) // 2])
        found[0] += here
        found[10] += counts
        if looks > 1:
            a, b, c = slope[0], slope[1], slope[2]
            found[1] += a
            found[2] += b
            found[3] += c
            found[4] += a * a
            found[5] += a * b
            found[6] += a * c
            found[7] += b * b
            found[8] += b * c
            found[9] += c * c


@kernel
def expect(
    scans: Any,
    first_rays: Any,
    rays: Any,
    begin: int,
    end: int,
    stride: int,
    held_out: int,
    corner: Any,
    resolution: float,
    stopping: Any,
    leads: Any,
    sigma: float,
    epsilon: float,
    table: Any,
    sums: Any,
    totals: Any,
) -> None:
    """The E step over every ``stride``-th ray from ``begin`` to ``end``: adds to ``sums`` and ``totals``.

    ``scans`` (S, 4) float64: sensor's x, y, range_min, range_max (m); ``first_rays`` (S + 1,): where each scan's rays
    begin in ``rays`` (N, 3) float32: direction in the plane, and range (m; -inf: nearer than range_min, inf: no
    return). The grid ``stopping`` (rows, cols) float32, the chance of each cell to stop a ray, begins at ``corner``
    (x, y in metres) with cells of ``resolution`` metres. ``leads`` (N,) int32, where not empty, says how many of a
    ray's first cells may be passed over: they stop and gather nothing. ``sigma`` (m) and ``epsilon`` are the noise
    and the share of wild measurements; ``table`` is made by :func:`tables`. A ``held_out`` of 1 leaves out every
    HOLD_OUT-th ray, -1 takes only those, 0 takes all.

    ``sums`` (rows * cols, 2 or 3) float32 gets the expected HITS and PASSES and, where it has a third column, the
    sum of squares of the rays' chances to have come to the cell (CERTAIN). ``totals`` (6,) float64 gets
    LOG_LIKELIHOOD, the expected STOPS, their SQUARES ((z - s)^2 in sigma^2), expected WILD, RAYS and VISITS.
    """
    certain = sums.shape[1] > 2
    longest = stopping.shape[0] + stopping.shape[1] + CHUNK
    where, share = np.empty(longest, np.int64), np.empty(longest, np.float32)
    apart, chance = np.empty(longest, np.float32), np.empty(longest, np.float32)
    per_metre, spread = 1 / resolution, sigma / resolution
    scan = np.searchsorted(first_rays, begin, side="right") - 1
    for i in range(begin, end):
        while i >= first_rays[scan + 1]:
            scan += 1
        if not is_chosen(i + scan, stride, held_out):
            continue
        x, y = (scans[scan, 0] - corner[0]) * per_metre, (scans[scan, 1] - corner[1]) * per_metre
        limits = (scans[scan, 2] * per_metre, scans[scan, 3] * per_metre)
        beam = (float(rays[i, 0]), float(rays[i, 1]), float(rays[i, 2]) * per_metre)
        lead = leads[i] if len(leads) else 0
        kind, count, scale, gone, wildness, density = follow(
            x, y, beam, limits, stopping, lead, spread, epsilon, table, where, chance, apart, share
        )
        if count < 0:
            continue
        weight = (1 - epsilon) / density
        factor = np.float32(scale * weight)
        if kind == MEASURED:
            stops, squares = moments(count, factor, share, apart)
        else:
            stops, squares = moments_cut(2 + kind, count, factor, share, apart, table)
        scatter(count, np.float32(gone * weight), share, where, sums, certain)
        totals[LOG_LIKELIHOOD] += math.log(density * per_metre if kind == MEASURED else density)
        totals[STOPS] += stops
        totals[SQUARES] += squares
        totals[WILD] += wildness / density
        totals[RAYS] += 1
        totals[VISITS] += count


@kernel
def find_leads(
    scans: Any,
    first_rays: Any,
    rays: Any,
    begin: int,
    end: int,
    corner: Any,
    resolution: float,
    marked: Any,
    leads: Any,
) -> None:
    """``leads`` (N,) int32: how many cells each of the rays ``begin`` to ``end`` crosses before a ``marked`` one."""
    rows, cols = marked.shape
    flat = marked.reshape(-1)
    scan = np.searchsorted(first_rays, begin, side="right") - 1
    for i in range(begin, end):
        while i >= first_rays[scan + 1]:
            scan += 1
        x, y = (scans[scan, 0] - corner[0]) / resolution, (scans[scan, 1] - corner[1]) / resolution
        leads[i] = 0
        if not (-FAR_CELLS < x < cols + FAR_CELLS and -FAR_CELLS < y < rows + FAR_CELLS):
            continue
        first, last, start, major, minor, offset, tilt, _, _ = lay(
            x, y, float(rays[i, 0]), float(rays[i, 1]), rows, cols
        )
        step = first
        c, along = start + first * major, offset + first * tilt
        while step <= last and not flat[np.uintp(c + (along >> SHIFT) * minor)]:
            step += 1
            c += major
            along += tilt
        leads[i] = max(step - first, 0)
