"""The compiled kernels of pose estimation: an extended Kalman filter, and the smoother that goes back over it.

The state is the robot's x, y (m) and heading (rad, not wrapped) in the map frame. Time is cut into nodes; from one to
the next the robot moves by a step that is measured in its own frame (Thrun, Burgard and Fox, Probabilistic Robotics,
2005, chapter 5: odometry as control), whose variances grow with its ``way``. At a node there may be a position fix, a
heading, and what a scan says about the pose. Covariances are kept as their six numbers xx, xy, xt, yy, yt, tt.

filterpy's filter does the same at some 70 to 150 microseconds a node; these take below one (bench/poses.py), which is
what lets the noise be found by filtering a log some fifty times. The tests hold them against filterpy.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from prim.compiled import inline, kernel

GATES = np.array([13.8, 10.8])
"""A fix or heading whose squared normalised innovation is larger is not used: 1 in 1000 (chi squared, 2 and 1)."""

PATIENCE = 20
"""So many in a row are not used; then the filter takes it that the robot is elsewhere than it believed."""

LEAST_VARIANCE = 1e-10
"""What a step adds at least (m^2, rad^2), so that covariances stay invertible."""

FIX_STD, HEADING_STD, METRES, RADIANS, BIAS = range(5)
"""What the noise consists of: standard deviations of fixes (m) and headings (rad), of the odometry's place (m) and
heading (rad) after one metre of way, and a constant that all headings are off by (rad)."""

USED, REJECTED = 1, 2


@inline
def wrapped(angle: float) -> float:
    """The angle (rad) in [-pi, pi)."""
    return angle - 2 * math.pi * math.floor((angle + math.pi) / (2 * math.pi))


@inline
def corrected(state: Any, cov: Any, hx: float, hy: float, ht: float, variance: float, innovation: float) -> None:
    """One scalar measurement, linear in the state with coefficients hx, hy, ht, brought into state and covariance."""
    xx, xy, xt, yy, yt, tt = cov[0], cov[1], cov[2], cov[3], cov[4], cov[5]
    a = xx * hx + xy * hy + xt * ht
    b = xy * hx + yy * hy + yt * ht
    c = xt * hx + yt * hy + tt * ht
    spread = hx * a + hy * b + ht * c + variance
    gain = innovation / spread
    state[0] += a * gain
    state[1] += b * gain
    state[2] += c * gain
    cov[0], cov[1], cov[2] = xx - a * a / spread, xy - a * b / spread, xt - a * c / spread
    cov[3], cov[4], cov[5] = yy - b * b / spread, yt - b * c / spread, tt - c * c / spread


@inline
def inverse(cov: Any, out: Any) -> None:
    """The inverse of a symmetric 3 x 3 matrix given by its six numbers."""
    xx, xy, xt, yy, yt, tt = cov[0], cov[1], cov[2], cov[3], cov[4], cov[5]
    a, b, c = yy * tt - yt * yt, xt * yt - xy * tt, xy * yt - xt * yy
    scale = 1 / (xx * a + xy * b + xt * c)
    out[0], out[1], out[2] = a * scale, b * scale, c * scale
    out[3], out[4], out[5] = (xx * tt - xt * xt) * scale, (xy * xt - xx * yt) * scale, (xx * yy - xy * xy) * scale


@inline
def moved(state: Any, cov: Any, step: Any, place: float, turn: float) -> None:
    """The robot makes a step (in its own frame), which adds the variances ``place`` and ``turn``."""
    cos, sin = math.cos(state[2]), math.sin(state[2])
    dx, dy = cos * step[0] - sin * step[1], sin * step[0] + cos * step[1]
    state[0] += dx
    state[1] += dy
    state[2] += step[2]
    xx, xy, xt, yy, yt, tt = cov[0], cov[1], cov[2], cov[3], cov[4], cov[5]
    cov[0] = xx - 2 * dy * xt + dy * dy * tt + place
    cov[1] = xy + dx * xt - dy * yt - dx * dy * tt
    cov[2] = xt - dy * tt
    cov[3] = yy + 2 * dx * yt + dx * dx * tt + place
    cov[4] = yt + dx * tt
    cov[5] = tt + turn


@inline
def learn_from_scan(state: Any, cov: Any, slope: Any, information: Any, looked_from: Any, work: Any) -> None:
    """What a scan says: its log-likelihood near the pose ``looked_from`` is slope . d - d' information d / 2."""
    dx, dy, dt = state[0] - looked_from[0], state[1] - looked_from[1], wrapped(state[2] - looked_from[2])
    i = information
    gx = slope[0] - i[0] * dx - i[1] * dy - i[2] * dt
    gy = slope[1] - i[1] * dx - i[3] * dy - i[4] * dt
    gt = slope[2] - i[2] * dx - i[4] * dy - i[5] * dt
    inverse(cov, work)
    for k in range(6):
        work[k] += i[k]
    inverse(work, cov)
    state[0] += cov[0] * gx + cov[1] * gy + cov[2] * gt
    state[1] += cov[1] * gx + cov[3] * gy + cov[4] * gt
    state[2] += cov[2] * gx + cov[4] * gy + cov[5] * gt


@inline
def take_fix(
    state: Any, cov: Any, before: Any, x: float, y: float, lever: Any, variance: float, gate: float, missed: int
) -> tuple[float, int]:
    """A position fix of an antenna that stands at ``lever`` on the robot: its cost, and how many in a row are missed.

    A robot that was carried elsewhere made a step that nobody measured: ``before``, the covariance that was
    predicted, gets its variance as well, so that the smoother does not lay the jump on earlier steps. The cost is
    minus twice the log-likelihood, but for a constant; that of one which is not used ends at the gate.
    """
    cos, sin = math.cos(state[2]), math.sin(state[2])
    lx, ly = cos * lever[0] - sin * lever[1], sin * lever[0] + cos * lever[1]
    nx, ny = x - state[0] - lx, y - state[1] - ly
    xx = cov[0] - 2 * ly * cov[2] + ly * ly * cov[5] + variance
    xy = cov[1] + lx * cov[2] - ly * cov[4] - lx * ly * cov[5]
    yy = cov[3] + 2 * lx * cov[4] + lx * lx * cov[5] + variance
    determinant = xx * yy - xy * xy
    squared = (yy * nx * nx - 2 * xy * nx * ny + xx * ny * ny) / determinant
    size = math.log(determinant)
    if squared > gate:
        if missed < PATIENCE:
            return gate + size, missed + 1
        cov[0] += nx * nx
        cov[3] += ny * ny
        before[0] += nx * nx
        before[3] += ny * ny
    corrected(state, cov, 1.0, 0.0, -ly, variance, nx)
    ny = y - state[1] - (math.sin(state[2]) * lever[0] + math.cos(state[2]) * lever[1])
    corrected(state, cov, 0.0, 1.0, lx, variance, ny)
    return min(squared, gate) + size, 0


@inline
def take_heading(
    state: Any, cov: Any, before: Any, heading: float, variance: float, gate: float, missed: int
) -> tuple[float, int]:
    """A heading: its cost, and how many in a row are missed (as take_fix)."""
    off = wrapped(heading - state[2])
    spread = cov[5] + variance
    squared = off * off / spread
    size = math.log(spread)
    if squared > gate:
        if missed < PATIENCE:
            return gate + size, missed + 1
        cov[5] += off * off
        before[5] += off * off
    corrected(state, cov, 0.0, 0.0, 1.0, variance, off)
    return min(squared, gate) + size, 0


@kernel
def run(
    start: Any,
    spread: Any,
    steps: Any,
    ways: Any,
    fixes: Any,
    headings: Any,
    lever: Any,
    noise: Any,
    gates: Any,
    scans: Any,
    states: Any,
    covs: Any,
    predicted: Any,
    predicted_covs: Any,
    costs: Any,
    verdicts: Any,
) -> None:
    """The filter over N nodes, from a pose ``start`` (3,) with covariance ``spread`` (6,).

    ``steps`` (N, 3): how the robot moved since the node before (or the start), in its own frame there; ``ways`` (N,):
    how far that was; ``fixes`` (N, 2) and ``headings`` (N,): NaN where there is none; ``lever`` (2,): where the
    antenna stands on the robot; ``noise`` (5,); ``gates`` (2,): a fix or heading with a larger squared normalised
    innovation is not used; ``scans`` (N or 0, 12): what a scan says at each node (zeros: nothing): slope (3),
    information (6), and the pose (3) that it was looked from.

    Fills ``states``, ``predicted`` (N, 3) and ``covs``, ``predicted_covs`` (N, 6): after and before the node's
    measurements; ``costs`` (N,): minus twice the log-likelihood of the node's fix and heading; ``verdicts`` (N, 2):
    whether fix and heading were USED, REJECTED, or not there (0).
    """
    state, cov, work = start.copy(), spread.copy(), np.empty(6)
    fix_variance, heading_variance = noise[FIX_STD] ** 2, noise[HEADING_STD] ** 2
    lost_fixes = lost_headings = 0
    for k in range(len(steps)):
        place = ways[k] * noise[METRES] ** 2 + LEAST_VARIANCE
        turn = ways[k] * noise[RADIANS] ** 2 + LEAST_VARIANCE
        moved(state, cov, steps[k], place, turn)
        predicted[k], predicted_covs[k] = state, cov
        costs[k] = 0.0
        verdicts[k] = 0
        if not math.isnan(fixes[k, 0]):
            x, y, before = fixes[k, 0], fixes[k, 1], predicted_covs[k]
            cost, missed = take_fix(state, cov, before, x, y, lever, fix_variance, gates[0], lost_fixes)
            costs[k] += cost
            verdicts[k, 0] = REJECTED if missed else USED
            lost_fixes = missed
        if not math.isnan(headings[k]):
            heading, before = headings[k] - noise[BIAS], predicted_covs[k]
            cost, missed = take_heading(state, cov, before, heading, heading_variance, gates[1], lost_headings)
            costs[k] += cost
            verdicts[k, 1] = REJECTED if missed else USED
            lost_headings = missed
        if len(scans):
            learn_from_scan(state, cov, scans[k, :3], scans[k, 3:9], scans[k, 9:], work)
        states[k], covs[k] = state, cov


@kernel
def smooth(states: Any, covs: Any, predicted: Any, predicted_covs: Any, gains: Any) -> None:
    """Rauch, Tung and Striebel's backward pass over what :func:`run` filled; ``states`` and ``covs`` become smoothed.

    Each node's estimate then rests on all measurements, the later ones too. ``gains`` (N, 3, 3) is filled: a node's
    error goes with the next one's by so much.
    """
    info = np.empty(6)
    f, p, gain = np.empty((3, 3)), np.empty((3, 3)), np.empty((3, 3))
    change, product = np.empty((3, 3)), np.empty((3, 3))
    for k in range(len(states) - 2, -1, -1):
        dx, dy = predicted[k + 1, 0] - states[k, 0], predicted[k + 1, 1] - states[k, 1]
        inverse(predicted_covs[k + 1], info)
        square(covs[k], f)
        for i in range(3):  # covariance times the transposed step
            p[i, 0], p[i, 1], p[i, 2] = f[i, 0] - dy * f[i, 2], f[i, 1] + dx * f[i, 2], f[i, 2]
        square(info, f)
        multiply(p, f, gain)
        gains[k] = gain
        for i in range(3):
            off = 0.0
            for j in range(3):
                off += gain[i, j] * (states[k + 1, j] - predicted[k + 1, j])
            states[k, i] += off
        for i in range(6):
            info[i] = covs[k + 1, i] - predicted_covs[k + 1, i]
        square(info, change)
        multiply(gain, change, product)
        n = 0
        for i in range(3):
            for j in range(i, 3):
                added = 0.0
                for m in range(3):
                    added += product[i, m] * gain[j, m]
                covs[k, n] += added
                n += 1


@kernel
def common(states: Any, covs: Any, gains: Any, chosen: Any) -> Any:
    """The covariance (3, 3) of the mean error of ``chosen`` (N,) smoothed poses, as a motion of the map's frame.

    An error of a pose moves what is seen from it: by the pose's own error at its place, turned about it. The motion
    is given at the map's origin. Errors of different nodes belong together: that of node j given that of node k > j
    is the product of the gains between them.
    """
    cov, lever, carried = np.empty((3, 3)), np.eye(3), np.zeros((3, 3))
    later, total = np.zeros((3, 3)), np.zeros((3, 3))
    count = 0
    for k in range(len(states) - 1, -1, -1):
        if k < len(states) - 1:
            multiply(
                gains[k], carried, later
            )  # covariance of this error with the sum of later ones, moved to the origin
        square(covs[k], cov)
        lever[2, 0], lever[2, 1] = states[k, 1], -states[k, 0]  # transposed
        if chosen[k]:
            count += 1
            multiply(cov, lever, carried)
            for i in range(3):
                for j in range(3):
                    for m in range(3):
                        total[i, j] += lever[m, i] * (carried[m, j] + later[m, j]) + later[m, i] * lever[m, j]
            for i in range(3):
                for j in range(3):
                    carried[i, j] += later[i, j]
        else:
            for i in range(3):
                for j in range(3):
                    carried[i, j] = later[i, j]
    return total / max(count, 1) ** 2


@inline
def square(six: Any, out: Any) -> None:
    """The symmetric 3 x 3 matrix of six numbers."""
    out[0, 0], out[0, 1], out[0, 2] = six[0], six[1], six[2]
    out[1, 0], out[1, 1], out[1, 2] = six[1], six[3], six[4]
    out[2, 0], out[2, 1], out[2, 2] = six[2], six[4], six[5]


@inline
def multiply(a: Any, b: Any, out: Any) -> None:
    """The product of two 3 x 3 matrices."""
    for i in range(3):
        for j in range(3):
            out[i, j] = a[i, 0] * b[0, j] + a[i, 1] * b[1, j] + a[i, 2] * b[2, j]
