"""The compiled kernels of pose estimation: an extended Kalman filter and a Rauch-Tung-Striebel smoother.

The state is the robot's x, y (m) and heading (rad, not wrapped) in the map frame. Time is cut into nodes; from one to
the next the robot moves by a step that is measured in its own frame (Thrun, Burgard and Fox, Probabilistic
Robotics, 2005, chapter 5: odometry as control), whose variances grow with distance, turns and time (see
:class:`Measurements`). At a node there may be a position fix, a heading, and a scan's log-likelihood of the pose.
Covariances are stored as the six numbers xx, xy, xt, yy, yt, tt of their upper triangles.

filterpy's filter does the same at some 70 to 150 microseconds a node; these take below one (bench/poses.py), which
makes it affordable to estimate the noise by filtering a log some fifty times. The tests compare them with filterpy.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from prim.arrays import FloatArray
from prim.compiled import inline, kernel

FIX_STD, HEADING_STD, TRANSLATION_STD, ROTATION_STD, HEADING_BIAS = range(5)
"""Indices into the noise parameters (5,): standard deviations of fixes (m) and headings (rad); those of a step's
translation (m, along each axis) and rotation (rad) where its variance scale is 1, that is after one metre straight on
or, without odometry, after one second; and the constant offset of all headings (rad)."""

USED, REJECTED = 1, 2
"""The gate's decision on a measurement; 0 where there is none."""


class FilterState(NamedTuple):
    """A Gaussian belief about the robot's pose.

    Attributes:
        pose: The mean (3,): x, y (m), heading (rad, not wrapped).
        covariance: Its covariance, the six numbers (6,) of the upper triangle.
    """

    pose: FloatArray
    covariance: FloatArray


class QuadraticTerms(NamedTuple):
    """Quadratic approximations of the scans' log-likelihoods, one a node; zeros where a node has no scan.

    The log-likelihood of a pose that differs from the center by d is, up to a constant, g . d - d' I d / 2. I is not
    the negative Hessian, but the information estimated by the outer products of single rays' scores (Berndt, Hall,
    Hall and Hausman, 1974; see mapping.forward.scan_likelihood).

    Attributes:
        gradients: The gradients g (N, 3).
        information: The information matrices I (N, 6).
        centers: The poses (N, 3) that the approximations are made at.
    """

    gradients: FloatArray
    information: FloatArray
    centers: FloatArray


class Measurements(NamedTuple):
    """What is measured at N nodes.

    Attributes:
        steps: Motions (N, 3) since the node before (or the initial state), in the robot's own frame there.
        variance_scales: The variances (N,) of each step's process noise, in units of the squared standard deviations
            at TRANSLATION_STD and ROTATION_STD. With odometry a length in m, in which turns and time count as
            distance; without odometry the time in s (see FusionNodes).
        fixes: Positions of the antenna (N, 2) in m; NaN where there is none.
        headings: Compass headings (N,) in rad; NaN where there is none.
        scans: The scans' log-likelihoods; of N nodes, or of none at all.
    """

    steps: FloatArray
    variance_scales: FloatArray
    fixes: FloatArray
    headings: FloatArray
    scans: QuadraticTerms


class Gate(NamedTuple):
    """When a measurement is rejected.

    Attributes:
        threshold: A measurement with a larger squared normalised innovation is rejected.
        max_rejections: After so many rejections in a row the next measurement is used even if it fails the test. The
            covariance is inflated by the squared innovation first, along the axes that are measured, so that the
            estimate moves most of the way to the measurement.
    """

    threshold: float
    max_rejections: int


class FilterModel(NamedTuple):
    """The parameters of the filter.

    Attributes:
        noise: The noise parameters (5,), indexed by FIX_STD and so on.
        lever_arm: The antenna's position on the robot (2,) in m.
        fix_gate: Of position fixes.
        heading_gate: Of headings.
        min_step_variance: Added to the variances of each step's process noise (m^2, rad^2).
    """

    noise: FloatArray
    lever_arm: FloatArray
    fix_gate: Gate
    heading_gate: Gate
    min_step_variance: float


class FilterOutput(NamedTuple):
    """What the filter fills at N nodes.

    Attributes:
        poses: Poses (N, 3) after each node's measurements.
        covariances: Their covariances (N, 6).
        predicted_poses: Poses (N, 3) before them.
        predicted_covariances: Their covariances (N, 6).
        costs: Minus twice the log-likelihood (N,) of each node's fix and heading, up to a constant.
        decisions: Whether each node's fix and heading (N, 2) were USED, REJECTED or absent (0).
    """

    poses: FloatArray
    covariances: FloatArray
    predicted_poses: FloatArray
    predicted_covariances: FloatArray
    costs: FloatArray
    decisions: NDArray[np.int64]

    @classmethod
    def empty(cls, nodes: int) -> FilterOutput:
        """Return uninitialised arrays for so many nodes."""
        return cls(
            np.empty((nodes, 3)),
            np.empty((nodes, 6)),
            np.empty((nodes, 3)),
            np.empty((nodes, 6)),
            np.empty(nodes),
            np.empty((nodes, 2), np.int64),
        )


@inline
def _wrap(angle: float) -> float:
    """Return the angle (rad) in [-pi, pi): kernels cannot call prim.se2.wrap_angle, which is not compiled."""
    return angle - 2 * math.pi * math.floor((angle + math.pi) / (2 * math.pi))


@inline
def _update(pose: Any, cov: Any, hx: float, hy: float, ht: float, variance: float, innovation: float) -> None:
    """Update the state with one scalar measurement that is linear in it with coefficients hx, hy, ht."""
    xx, xy, xt, yy, yt, tt = cov[0], cov[1], cov[2], cov[3], cov[4], cov[5]
    a = xx * hx + xy * hy + xt * ht
    b = xy * hx + yy * hy + yt * ht
    c = xt * hx + yt * hy + tt * ht
    spread = hx * a + hy * b + ht * c + variance
    gain = innovation / spread
    pose[0] += a * gain
    pose[1] += b * gain
    pose[2] += c * gain
    cov[0], cov[1], cov[2] = xx - a * a / spread, xy - a * b / spread, xt - a * c / spread
    cov[3], cov[4], cov[5] = yy - b * b / spread, yt - b * c / spread, tt - c * c / spread


@inline
def _invert(cov: Any, out: Any) -> None:
    """Invert a symmetric 3 x 3 matrix given by its six numbers."""
    xx, xy, xt, yy, yt, tt = cov[0], cov[1], cov[2], cov[3], cov[4], cov[5]
    a, b, c = yy * tt - yt * yt, xt * yt - xy * tt, xy * yt - xt * yy
    scale = 1 / (xx * a + xy * b + xt * c)
    out[0], out[1], out[2] = a * scale, b * scale, c * scale
    out[3], out[4], out[5] = (xx * tt - xt * xt) * scale, (xy * xt - xx * yt) * scale, (xx * yy - xy * xy) * scale


@inline
def _predict(pose: Any, cov: Any, step: Any, position_variance: float, heading_variance: float) -> None:
    """Move the state by a step in the robot's frame and add the process noise."""
    cos, sin = math.cos(pose[2]), math.sin(pose[2])
    dx, dy = cos * step[0] - sin * step[1], sin * step[0] + cos * step[1]
    pose[0] += dx
    pose[1] += dy
    pose[2] += step[2]
    xx, xy, xt, yy, yt, tt = cov[0], cov[1], cov[2], cov[3], cov[4], cov[5]
    cov[0] = xx - 2 * dy * xt + dy * dy * tt + position_variance
    cov[1] = xy + dx * xt - dy * yt - dx * dy * tt
    cov[2] = xt - dy * tt
    cov[3] = yy + 2 * dx * yt + dx * dx * tt + position_variance
    cov[4] = yt + dx * tt
    cov[5] = tt + heading_variance


@inline
def _update_with_scan(pose: Any, cov: Any, gradient: Any, information: Any, center: Any, work: Any) -> None:
    """Update the state with one row of QuadraticTerms, in information form."""
    dx, dy, dt = pose[0] - center[0], pose[1] - center[1], _wrap(pose[2] - center[2])
    i = information
    gx = gradient[0] - i[0] * dx - i[1] * dy - i[2] * dt
    gy = gradient[1] - i[1] * dx - i[3] * dy - i[4] * dt
    gt = gradient[2] - i[2] * dx - i[4] * dy - i[5] * dt
    _invert(cov, work)
    for k in range(6):
        work[k] += i[k]
    _invert(work, cov)
    pose[0] += cov[0] * gx + cov[1] * gy + cov[2] * gt
    pose[1] += cov[1] * gx + cov[3] * gy + cov[4] * gt
    pose[2] += cov[2] * gx + cov[4] * gy + cov[5] * gt


@inline
def _update_with_fix(
    pose: Any, cov: Any, predicted: Any, fix: Any, lever: Any, variance: float, gate: Gate, rejections: int
) -> tuple[float, int]:
    """Update the state with a position fix of the antenna at the lever arm.

    Returns its cost (minus twice the log-likelihood, up to a constant; capped at the gate where it is rejected) and
    the number of rejections in a row. After ``gate.max_rejections`` of them the robot is taken to have been moved by
    the innovation, unmeasured: that inflates ``predicted``, the predicted covariance (6,), as well, so that the
    smoother does not spread the jump over earlier steps.
    """
    x, y = fix[0], fix[1]
    cos, sin = math.cos(pose[2]), math.sin(pose[2])
    lx, ly = cos * lever[0] - sin * lever[1], sin * lever[0] + cos * lever[1]
    nx, ny = x - pose[0] - lx, y - pose[1] - ly
    xx = cov[0] - 2 * ly * cov[2] + ly * ly * cov[5] + variance
    xy = cov[1] + lx * cov[2] - ly * cov[4] - lx * ly * cov[5]
    yy = cov[3] + 2 * lx * cov[4] + lx * lx * cov[5] + variance
    determinant = xx * yy - xy * xy
    squared = (yy * nx * nx - 2 * xy * nx * ny + xx * ny * ny) / determinant
    size = math.log(determinant)
    if squared > gate.threshold:
        if rejections < gate.max_rejections:
            return gate.threshold + size, rejections + 1
        cov[0] += nx * nx
        cov[3] += ny * ny
        predicted[0] += nx * nx
        predicted[3] += ny * ny
    _update(pose, cov, 1.0, 0.0, -ly, variance, nx)
    ny = y - pose[1] - (math.sin(pose[2]) * lever[0] + math.cos(pose[2]) * lever[1])
    _update(pose, cov, 0.0, 1.0, lx, variance, ny)
    return min(squared, gate.threshold) + size, 0


@inline
def _update_with_heading(
    pose: Any, cov: Any, predicted: Any, heading: float, variance: float, gate: Gate, rejections: int
) -> tuple[float, int]:
    """Update the state with a heading; arguments and result are those of _update_with_fix."""
    innovation = _wrap(heading - pose[2])
    spread = cov[5] + variance
    squared = innovation * innovation / spread
    size = math.log(spread)
    if squared > gate.threshold:
        if rejections < gate.max_rejections:
            return gate.threshold + size, rejections + 1
        cov[5] += innovation * innovation
        predicted[5] += innovation * innovation
    _update(pose, cov, 0.0, 0.0, 1.0, variance, innovation)
    return min(squared, gate.threshold) + size, 0


@kernel
def run_filter(initial: FilterState, measurements: Measurements, model: FilterModel, output: FilterOutput) -> None:
    """Run the extended Kalman filter over N nodes.

    Args:
        initial: The belief before the first step; copied, and left unchanged.
        measurements: What is measured at the nodes.
        model: The parameters of the filter.
        output: Filled; arrays of N rows.
    """
    # unpacked once: each access to a tuple's array costs an atomic reference count
    steps, variance_scales, noise, lever = (
        measurements.steps,
        measurements.variance_scales,
        model.noise,
        model.lever_arm,
    )
    fixes, headings = measurements.fixes, measurements.headings
    gradients, information, centers = (
        measurements.scans.gradients,
        measurements.scans.information,
        measurements.scans.centers,
    )
    poses, covariances, costs, decisions = output.poses, output.covariances, output.costs, output.decisions
    predicted_poses, predicted_covariances = output.predicted_poses, output.predicted_covariances
    pose, cov, work = initial.pose.copy(), initial.covariance.copy(), np.empty(6)
    fix_variance, heading_variance = noise[FIX_STD] ** 2, noise[HEADING_STD] ** 2
    fix_gate, heading_gate, min_variance = model.fix_gate, model.heading_gate, model.min_step_variance
    fix_rejections = heading_rejections = 0
    for k in range(len(steps)):
        translation_variance = variance_scales[k] * noise[TRANSLATION_STD] ** 2 + min_variance
        rotation_variance = variance_scales[k] * noise[ROTATION_STD] ** 2 + min_variance
        _predict(pose, cov, steps[k], translation_variance, rotation_variance)
        predicted_poses[k], predicted_covariances[k] = pose, cov
        predicted = predicted_covariances[k]
        costs[k] = 0.0
        decisions[k] = 0
        if not math.isnan(fixes[k, 0]):
            cost, fix_rejections = _update_with_fix(
                pose, cov, predicted, fixes[k], lever, fix_variance, fix_gate, fix_rejections
            )
            costs[k] += cost
            decisions[k, 0] = REJECTED if fix_rejections else USED
        if not math.isnan(headings[k]):
            heading = headings[k] - noise[HEADING_BIAS]
            cost, heading_rejections = _update_with_heading(
                pose, cov, predicted, heading, heading_variance, heading_gate, heading_rejections
            )
            costs[k] += cost
            decisions[k, 1] = REJECTED if heading_rejections else USED
        if len(gradients):
            _update_with_scan(pose, cov, gradients[k], information[k], centers[k], work)
        poses[k], covariances[k] = pose, cov


@kernel
def smooth(filtered: FilterOutput, gains: Any) -> None:
    """Run the backward pass of Rauch, Tung and Striebel (1965) over a filter's output.

    Each node's estimate then rests on all measurements, the later ones too.

    Args:
        filtered: What :func:`run_filter` filled; poses and covariances become the smoothed ones.
        gains: Filled (N, 3, 3): the smoother's gains, by which a node's error depends on the next one's.
    """
    poses, covs = filtered.poses, filtered.covariances
    predicted, predicted_covs = filtered.predicted_poses, filtered.predicted_covariances
    info = np.empty(6)
    f, p, gain = np.empty((3, 3)), np.empty((3, 3)), np.empty((3, 3))
    change, product = np.empty((3, 3)), np.empty((3, 3))
    for k in range(len(poses) - 2, -1, -1):
        dx, dy = predicted[k + 1, 0] - poses[k, 0], predicted[k + 1, 1] - poses[k, 1]
        _invert(predicted_covs[k + 1], info)
        _unpack(covs[k], f)
        for i in range(3):  # covariance times the transposed Jacobian of the motion
            p[i, 0], p[i, 1], p[i, 2] = f[i, 0] - dy * f[i, 2], f[i, 1] + dx * f[i, 2], f[i, 2]
        _unpack(info, f)
        _multiply(p, f, gain)
        gains[k] = gain
        for i in range(3):
            correction = 0.0
            for j in range(3):
                correction += gain[i, j] * (poses[k + 1, j] - predicted[k + 1, j])
            poses[k, i] += correction
        for i in range(6):
            info[i] = covs[k + 1, i] - predicted_covs[k + 1, i]
        _unpack(info, change)
        _multiply(gain, change, product)
        n = 0
        for i in range(3):
            for j in range(i, 3):
                added = 0.0
                for m in range(3):
                    added += product[i, m] * gain[j, m]
                covs[k, n] += added
                n += 1


@kernel
def mean_frame_covariance(poses: Any, covariances: Any, gains: Any, selected: Any) -> Any:
    """Compute the covariance of the map frame that the mean error of selected smoothed poses causes.

    An error of a pose moves what is seen from it: by the pose's own error at its place, turned about it. The motion
    is given at the map's origin. Errors of different nodes are correlated: the regression of node j's error on
    that of node k > j is the product of the gains between them.

    Args:
        poses: Smoothed poses (N, 3).
        covariances: Their covariances (N, 6).
        gains: The smoother's gains (N, 3, 3).
        selected: Which nodes to average over (N,), bool.

    Returns:
        The covariance (3, 3) of the frame's x, y (m) and heading (rad) at its origin.
    """
    cov, lever, carried = np.empty((3, 3)), np.eye(3), np.zeros((3, 3))
    later, total = np.zeros((3, 3)), np.zeros((3, 3))
    count = 0
    for k in range(len(poses) - 1, -1, -1):
        if k < len(poses) - 1:
            # covariance of this error with the sum of the later ones, moved to the origin
            _multiply(gains[k], carried, later)
        _unpack(covariances[k], cov)
        lever[2, 0], lever[2, 1] = poses[k, 1], -poses[k, 0]  # transposed
        if selected[k]:
            count += 1
            _multiply(cov, lever, carried)
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
def _unpack(six: Any, out: Any) -> None:
    """Fill a symmetric 3 x 3 matrix from its six numbers."""
    out[0, 0], out[0, 1], out[0, 2] = six[0], six[1], six[2]
    out[1, 0], out[1, 1], out[1, 2] = six[1], six[3], six[4]
    out[2, 0], out[2, 1], out[2, 2] = six[2], six[4], six[5]


@inline
def _multiply(a: Any, b: Any, out: Any) -> None:
    """Compute the product of two 3 x 3 matrices."""
    for i in range(3):
        for j in range(3):
            out[i, j] = a[i, 0] * b[0, j] + a[i, 1] * b[1, j] + a[i, 2] * b[2, j]


def pack_symmetric(matrices: FloatArray) -> FloatArray:
    """Return the six numbers (..., 6) of symmetric matrices (..., 3, 3)."""
    return matrices[..., [0, 0, 0, 1, 1, 2], [0, 1, 2, 1, 2, 2]].copy()


def unpack_symmetric(six: FloatArray) -> FloatArray:
    """Return the symmetric matrices (..., 3, 3) of six numbers each (..., 6)."""
    return six[..., [0, 1, 2, 1, 3, 4, 2, 4, 5]].reshape(*six.shape[:-1], 3, 3)
