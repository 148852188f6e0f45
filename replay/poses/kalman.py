"""The compiled kernels of pose estimation: an extended Kalman filter and a Rauch-Tung-Striebel smoother.

The state is the robot's x, y (m) and heading (rad, not wrapped) in the map frame, and, where the errors of fixes or
headings wander, what these are at the moment: x, y (m) and heading (rad). Time is cut into nodes; from one to the
next the robot moves by a step that is measured in its own frame (Thrun, Burgard and Fox, Probabilistic Robotics,
2005, chapter 5: odometry as control), whose variances grow with distance, turns and time (see
:class:`Measurements`), and wandering errors decay and are renewed (first-order Gauss-Markov processes: Gelb, Applied
Optimal Estimation, 1974, section 3.8). At a node there may be a position fix, a heading, and a scan's log-likelihood
of the pose.

filterpy's filter does the same at some 70 to 150 microseconds a node; these take one or two (bench/poses.py), which
makes it affordable to estimate the noise by filtering a log some hundred times. The tests compare them with filterpy.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from prim import linear_algebra
from prim.arrays import FloatArray
from prim.compiled import inline, kernel

FIX_STD, HEADING_STD, TRANSLATION_STD, ROTATION_STD, HEADING_BIAS = range(5)
"""Indices into the noise parameters (11,): standard deviations of fixes (m) and headings (rad); those of a step's
translation (m, along each axis) and rotation (rad) where its variance scale is 1, that is after one metre straight on
or, without odometry, after one second; and the constant offset of all headings (rad)."""

SCALES = DISTANCE_SCALE, TURN_SCALE = tuple(range(5, 7))
"""Factors that the odometry's distances and turns are multiplied by."""

WANDER = WANDER_STD, WANDER_TIME, HEADING_WANDER_STD, HEADING_WANDER_TIME = tuple(range(7, 11))
TIMES = WANDER_TIME, HEADING_WANDER_TIME
"""Standard deviations (m along each axis; rad) and time constants (s) of wandering errors of fixes and headings."""

PARAMETERS = 11
"""How many noise parameters there are."""

POSE, WITH_WANDER = 3, 6
"""Sizes of the state: of the pose alone, and with the wandering errors of fixes and headings."""

USED, REJECTED = 1, 2
"""The gate's decision on a measurement; 0 where there is none."""


class FilterState(NamedTuple):
    """A Gaussian belief about the state.

    Attributes:
        mean: (K,): x, y (m), heading (rad, not wrapped) of the robot; with K = 6 the wandering errors.
        covariance: (K, K).
    """

    mean: FloatArray
    covariance: FloatArray

    def with_pose(self, pose: FloatArray, covariance: FloatArray) -> FilterState:
        """Return the belief after something was learnt of the pose alone.

        Args:
            pose: (3,) what the pose's mean becomes.
            covariance: (3, 3) what its covariance becomes.

        Returns:
            The belief; wandering errors follow by their correlation with the pose.
        """
        before = self.covariance[:POSE, :POSE]
        gain = None if len(self.mean) == POSE else linear_algebra.solve(before, self.covariance[:POSE, POSE:])
        if gain is None:
            return FilterState(pose, covariance)
        mean = np.concatenate((pose, self.mean[POSE:] + gain.T @ (pose - self.mean[:POSE])))
        rest = self.covariance[POSE:, POSE:] + gain.T @ (covariance - before) @ gain
        shared = covariance @ gain
        return FilterState(mean, np.block([[covariance, shared], [shared.T, rest]]))


class QuadraticTerms(NamedTuple):
    """Quadratic approximations of the scans' log-likelihoods, one a node; zeros where a node has no scan.

    The log-likelihood of a pose that differs from the center by d is, up to a constant, g . d - d' I d / 2. I is not
    the negative Hessian, but the information estimated by the outer products of single rays' scores (Berndt, Hall,
    Hall and Hausman, 1974; see mapping.forward.scan_likelihood).

    Attributes:
        gradients: The gradients g (N, 3).
        information: The information matrices I (N, 3, 3).
        centers: The poses (N, 3) that the approximations are made at.
    """

    gradients: FloatArray
    information: FloatArray
    centers: FloatArray

    @classmethod
    def zeros(cls, nodes: int) -> QuadraticTerms:
        """Return those of so many nodes without a scan."""
        return cls(np.zeros((nodes, 3)), np.zeros((nodes, 3, 3)), np.zeros((nodes, 3)))


class Measurements(NamedTuple):
    """What is measured at N nodes.

    Attributes:
        steps: Motions (N, 3) since the node before (or the initial state), in the robot's own frame there.
        variance_scales: The variances (N,) of each step's process noise, in units of the squared standard deviations
            at TRANSLATION_STD and ROTATION_STD. With odometry a length in m, in which turns and time count as
            distance; without odometry the time in s (see FusionNodes).
        intervals: Times (N,) since the node before (s).
        fixes: Positions of the antenna (N, 2) in m; NaN where there is none.
        fix_scales: Factors (N,) of each fix's standard deviation.
        headings: Headings (N,) in rad; NaN where there is none.
        scans: The scans' log-likelihoods; of N nodes, or of none at all.
        references: Headings (N,) at the node before (rad, not wrapped), about which steps are linear; NaN: about the
            filter's own.
    """

    steps: FloatArray
    variance_scales: FloatArray
    intervals: FloatArray
    fixes: FloatArray
    fix_scales: FloatArray
    headings: FloatArray
    scans: QuadraticTerms
    references: FloatArray


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
        noise: The noise parameters (11,), indexed by FIX_STD and so on.
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
    """What the filter fills at N nodes, with K numbers of the state.

    Attributes:
        means: States (N, K) after each node's measurements.
        covariances: Their covariances (N, K, K).
        predicted_means: States (N, K) before them.
        predicted_covariances: Their covariances (N, K, K).
        costs: Minus twice the log-likelihood (N,) of each node's fix and heading, up to a constant.
        decisions: Whether each node's fix and heading (N, 2) were USED, REJECTED or absent (0).
        kept: How much (N, K) of each number of the state is left after a step: less than 1 of wandering errors.
        motions: Each step (N, 2) in the map frame (m), with the heading that it is linear about.
    """

    means: FloatArray
    covariances: FloatArray
    predicted_means: FloatArray
    predicted_covariances: FloatArray
    costs: FloatArray
    decisions: NDArray[np.int64]
    kept: FloatArray
    motions: FloatArray

    @classmethod
    def empty(cls, nodes: int, size: int) -> FilterOutput:
        """Return uninitialised arrays.

        Args:
            nodes: How many nodes there are.
            size: How many numbers the state has.

        Returns:
            The arrays.
        """
        return cls(
            np.empty((nodes, size)),
            np.empty((nodes, size, size)),
            np.empty((nodes, size)),
            np.empty((nodes, size, size)),
            np.empty(nodes),
            np.empty((nodes, 2), np.int64),
            np.ones((nodes, size)),
            np.empty((nodes, 2)),
        )


@inline
def _wrap(angle: float) -> float:
    """Return the angle (rad) in [-pi, pi): kernels cannot call prim.se2.wrap_angle, which is not compiled."""
    return angle - 2 * math.pi * math.floor((angle + math.pi) / (2 * math.pi))


@inline
def _update(mean: Any, cov: Any, row: Any, variance: float, innovation: float, work: Any) -> None:
    """Update the state with one scalar measurement that is linear in it with the coefficients of ``row``."""
    size = len(mean)
    spread = variance
    for i in range(size):
        work[i] = 0.0
        for j in range(size):
            work[i] += cov[i, j] * row[j]
        spread += row[i] * work[i]
    for i in range(size):
        mean[i] += work[i] * innovation / spread
        for j in range(size):
            cov[i, j] -= work[i] * work[j] / spread


@inline
def _predict(
    mean: Any, cov: Any, step: Any, reference: float, position_variance: float, heading_variance: float, motion: Any
) -> None:
    """Move the pose by a step in the robot's frame and add the process noise; ``motion`` gets it in the map frame."""
    heading = mean[2] if math.isnan(reference) else reference
    cos, sin = math.cos(heading), math.sin(heading)
    dx, dy = cos * step[0] - sin * step[1], sin * step[0] + cos * step[1]
    motion[0], motion[1] = dx, dy
    mean[0] += dx - dy * (mean[2] - heading)
    mean[1] += dy + dx * (mean[2] - heading)
    mean[2] += step[2]
    size = len(mean)
    for j in range(size):
        cov[0, j] -= dy * cov[2, j]
        cov[1, j] += dx * cov[2, j]
    for i in range(size):
        cov[i, 0] -= dy * cov[i, 2]
        cov[i, 1] += dx * cov[i, 2]
    cov[0, 0] += position_variance
    cov[1, 1] += position_variance
    cov[2, 2] += heading_variance


@inline
def _decay(mean: Any, cov: Any, noise: Any, seconds: float, min_variance: float, kept: Any) -> None:
    """Let wandering errors decay towards zero for a time, and renew them; ``kept`` gets what is left of each."""
    size = len(mean)
    for k in range(POSE, size):
        std, time = noise[WANDER_STD], noise[WANDER_TIME]
        if k == POSE + 2:
            std, time = noise[HEADING_WANDER_STD], noise[HEADING_WANDER_TIME]
        left = math.exp(-seconds / time)
        kept[k] = left
        mean[k] *= left
        for i in range(size):
            cov[i, k] *= left
        for i in range(size):
            cov[k, i] *= left
        cov[k, k] += std * std * (1 - left * left) + min_variance


@inline
def _update_with_scan(mean: Any, cov: Any, gradient: Any, information: Any, center: Any, work: Any) -> None:
    """Update the state with one row of QuadraticTerms.

    The covariance P becomes P - P' M P', where P' is its part of the pose, and M = I (1 + P' I)^-1.
    """
    size = len(mean)
    spread, inverse, gain = work[0], work[1], work[2]  # (3, 3) each
    columns, moved = cov[:, :POSE].copy(), np.empty((size, POSE))
    _multiply(columns[:POSE], information, spread)
    for i in range(POSE):
        spread[i, i] += 1.0
    _invert(spread, inverse)
    _multiply(information, inverse, gain)
    _multiply(columns, gain, moved)
    for i in range(size):
        for j in range(i, size):
            for m in range(POSE):
                cov[i, j] -= moved[i, m] * columns[j, m]
            cov[j, i] = cov[i, j]
    dx, dy, dt = mean[0] - center[0], mean[1] - center[1], _wrap(mean[2] - center[2])
    gx = gradient[0] - information[0, 0] * dx - information[0, 1] * dy - information[0, 2] * dt
    gy = gradient[1] - information[1, 0] * dx - information[1, 1] * dy - information[1, 2] * dt
    gt = gradient[2] - information[2, 0] * dx - information[2, 1] * dy - information[2, 2] * dt
    for i in range(size):
        mean[i] += cov[i, 0] * gx + cov[i, 1] * gy + cov[i, 2] * gt


@inline
def _multiply(a: Any, b: Any, out: Any) -> None:
    """Compute the product of two matrices."""
    for i in range(a.shape[0]):
        for j in range(b.shape[1]):
            out[i, j] = 0.0
            for m in range(b.shape[0]):
                out[i, j] += a[i, m] * b[m, j]


@inline
def _invert(a: Any, out: Any) -> None:
    """Invert a 3 x 3 matrix."""
    for i in range(3):
        j, k = (i + 1) % 3, (i + 2) % 3
        for m in range(3):
            n, p = (m + 1) % 3, (m + 2) % 3
            out[m, i] = a[j, n] * a[k, p] - a[j, p] * a[k, n]
    determinant = a[0, 0] * out[0, 0] + a[0, 1] * out[1, 0] + a[0, 2] * out[2, 0]
    for i in range(3):
        for m in range(3):
            out[m, i] /= determinant


@inline
def _update_with_fix(
    mean: Any, cov: Any, predicted: Any, fix: Any, lever: Any, variance: float, gate: Gate, rejections: int, work: Any
) -> tuple[float, int]:
    """Update the state with a position fix of the antenna at the lever arm.

    Returns its cost (minus twice the log-likelihood, up to a constant; capped at the gate where it is rejected) and
    the number of rejections in a row. After ``gate.max_rejections`` of them the robot is taken to have been moved by
    the innovation, unmeasured: that inflates ``predicted``, the predicted covariance, as well, so that the smoother
    does not spread the jump over earlier steps.
    """
    size = len(mean)
    along, across, product = work[0], work[1], work[2]
    along[:] = 0.0
    across[:] = 0.0
    cos, sin = math.cos(mean[2]), math.sin(mean[2])
    lx, ly = cos * lever[0] - sin * lever[1], sin * lever[0] + cos * lever[1]
    along[0], along[2], across[1], across[2] = 1.0, -ly, 1.0, lx
    nx, ny = fix[0] - mean[0] - lx, fix[1] - mean[1] - ly
    if size > POSE:
        along[POSE], across[POSE + 1] = 1.0, 1.0
        nx -= mean[POSE]
        ny -= mean[POSE + 1]
    xx, xy, yy = variance, 0.0, variance
    for i in range(size):
        for j in range(size):
            xx += along[i] * cov[i, j] * along[j]
            xy += along[i] * cov[i, j] * across[j]
            yy += across[i] * cov[i, j] * across[j]
    determinant = xx * yy - xy * xy
    squared = (yy * nx * nx - 2 * xy * nx * ny + xx * ny * ny) / determinant
    cost = math.log(determinant)
    if squared > gate.threshold:
        if rejections < gate.max_rejections:
            return gate.threshold + cost, rejections + 1
        cov[0, 0] += nx * nx
        cov[1, 1] += ny * ny
        predicted[0, 0] += nx * nx
        predicted[1, 1] += ny * ny
    _update(mean, cov, along, variance, nx, product)
    ny = fix[1] - mean[1] - (math.sin(mean[2]) * lever[0] + math.cos(mean[2]) * lever[1])
    if size > POSE:
        ny -= mean[POSE + 1]
    _update(mean, cov, across, variance, ny, product)
    return min(squared, gate.threshold) + cost, 0


@inline
def _update_with_heading(
    mean: Any, cov: Any, predicted: Any, heading: float, variance: float, gate: Gate, rejections: int, work: Any
) -> tuple[float, int]:
    """Update the state with a heading; arguments and result are those of _update_with_fix."""
    row, product = work[0], work[1]
    row[:] = 0.0
    row[2] = 1.0
    innovation, spread = heading - mean[2], cov[2, 2] + variance
    if len(mean) > POSE:
        last = POSE + 2
        row[last] = 1.0
        innovation -= mean[last]
        spread += 2 * cov[2, last] + cov[last, last]
    innovation = _wrap(innovation)
    squared = innovation * innovation / spread
    cost = math.log(spread)
    if squared > gate.threshold:
        if rejections < gate.max_rejections:
            return gate.threshold + cost, rejections + 1
        cov[2, 2] += innovation * innovation
        predicted[2, 2] += innovation * innovation
    _update(mean, cov, row, variance, innovation, product)
    return min(squared, gate.threshold) + cost, 0


@kernel
def run_filter(initial: FilterState, measurements: Measurements, model: FilterModel, output: FilterOutput) -> None:
    """Run the extended Kalman filter over N nodes.

    Args:
        initial: The belief before the first step; copied, and left unchanged.
        measurements: What is measured at the nodes.
        model: The parameters of the filter.
        output: Filled; arrays of N rows, with states of the initial one's size.
    """
    # unpacked once: each access to a tuple's array costs an atomic reference count
    steps, variance_scales, noise, lever = (
        measurements.steps,
        measurements.variance_scales,
        model.noise,
        model.lever_arm,
    )
    intervals, fixes, fix_scales, headings, references = (
        measurements.intervals,
        measurements.fixes,
        measurements.fix_scales,
        measurements.headings,
        measurements.references,
    )
    gradients, information, centers = (
        measurements.scans.gradients,
        measurements.scans.information,
        measurements.scans.centers,
    )
    means, covariances, costs, decisions = output.means, output.covariances, output.costs, output.decisions
    predicted_means, predicted_covariances = output.predicted_means, output.predicted_covariances
    kept, motions = output.kept, output.motions
    mean, cov = initial.mean.copy(), initial.covariance.copy()
    work, squares, step = np.empty((3, len(mean))), np.empty((3, 3, 3)), np.empty(3)
    fix_variance, heading_variance = noise[FIX_STD] ** 2, noise[HEADING_STD] ** 2
    fix_gate, heading_gate, min_variance = model.fix_gate, model.heading_gate, model.min_step_variance
    fix_rejections = heading_rejections = 0
    for k in range(len(steps)):
        translation_variance = variance_scales[k] * noise[TRANSLATION_STD] ** 2 + min_variance
        rotation_variance = variance_scales[k] * noise[ROTATION_STD] ** 2 + min_variance
        step[0], step[1] = steps[k, 0] * noise[DISTANCE_SCALE], steps[k, 1] * noise[DISTANCE_SCALE]
        step[2] = steps[k, 2] * noise[TURN_SCALE]
        _predict(mean, cov, step, references[k], translation_variance, rotation_variance, motions[k])
        _decay(mean, cov, noise, intervals[k], min_variance, kept[k])
        predicted_means[k], predicted_covariances[k] = mean, cov
        predicted = predicted_covariances[k]
        costs[k] = 0.0
        decisions[k] = 0
        if not math.isnan(fixes[k, 0]):
            variance = fix_variance * fix_scales[k] ** 2
            cost, fix_rejections = _update_with_fix(
                mean, cov, predicted, fixes[k], lever, variance, fix_gate, fix_rejections, work
            )
            costs[k] += cost
            decisions[k, 0] = REJECTED if fix_rejections else USED
        if not math.isnan(headings[k]):
            heading = headings[k] - noise[HEADING_BIAS]
            cost, heading_rejections = _update_with_heading(
                mean, cov, predicted, heading, heading_variance, heading_gate, heading_rejections, work
            )
            costs[k] += cost
            decisions[k, 1] = REJECTED if heading_rejections else USED
        if len(gradients):
            _update_with_scan(mean, cov, gradients[k], information[k], centers[k], squares)
        means[k], covariances[k] = mean, cov


@kernel
def smooth(filtered: FilterOutput, gains: Any) -> None:
    """Run the backward pass of Rauch, Tung and Striebel (1965) over a filter's output.

    Each node's estimate then rests on all measurements, the later ones too.

    Args:
        filtered: What :func:`run_filter` filled; means and covariances become the smoothed ones.
        gains: Filled (N, K, K): the smoother's gains, by which a node's error depends on the next one's.
    """
    means, covs = filtered.means, filtered.covariances
    predicted, predicted_covs = filtered.predicted_means, filtered.predicted_covariances
    kept, motions = filtered.kept, filtered.motions
    size = means.shape[1]
    factor, shared = np.empty((size, size)), np.empty((size, size))
    gain, product = np.empty((size, size)), np.empty((size, size))
    for k in range(len(means) - 2, -1, -1):
        _correlate_with_next(covs[k], motions[k + 1], kept[k + 1], shared)
        _factorize(predicted_covs[k + 1], factor)
        for i in range(size):
            _solve_factorized(factor, shared[i], gain[i])
        gains[k] = gain
        for i in range(size):
            for j in range(size):
                means[k, i] += gain[i, j] * (means[k + 1, j] - predicted[k + 1, j])
                product[i, j] = 0.0
                for m in range(size):
                    product[i, j] += gain[i, m] * (covs[k + 1, m, j] - predicted_covs[k + 1, m, j])
        for i in range(size):
            for j in range(i, size):
                for m in range(size):
                    covs[k, i, j] += product[i, m] * gain[j, m]
                covs[k, j, i] = covs[k, i, j]


@inline
def _correlate_with_next(cov: Any, motion: Any, kept: Any, out: Any) -> None:
    """Compute the covariance of a state with the next one as it is predicted."""
    for i in range(len(cov)):
        out[i, 0] = cov[i, 0] - motion[1] * cov[i, 2]
        out[i, 1] = cov[i, 1] + motion[0] * cov[i, 2]
        out[i, 2] = cov[i, 2]
        for j in range(POSE, len(cov)):
            out[i, j] = cov[i, j] * kept[j]


@inline
def _factorize(matrix: Any, factor: Any) -> None:
    """Fill the lower Cholesky factor of a covariance; what rounding makes negative counts as next to nothing."""
    for i in range(len(matrix)):
        for j in range(i + 1):
            rest = matrix[i, j]
            for m in range(j):
                rest -= factor[i, m] * factor[j, m]
            factor[i, j] = math.sqrt(max(rest, 1e-15 * matrix[i, i])) if i == j else rest / factor[j, j]


@inline
def _solve_factorized(factor: Any, right: Any, out: Any) -> None:
    """Solve a linear equation by the lower Cholesky factor of its matrix."""
    size = len(right)
    for i in range(size):
        out[i] = right[i]
        for m in range(i):
            out[i] -= factor[i, m] * out[m]
        out[i] /= factor[i, i]
    for i in range(size - 1, -1, -1):
        for m in range(i + 1, size):
            out[i] -= factor[m, i] * out[m]
        out[i] /= factor[i, i]


@kernel
def mean_frame_covariance(means: Any, covariances: Any, gains: Any, selected: Any) -> Any:
    """Compute the covariance of the map frame that the mean error of selected smoothed poses causes.

    An error of a pose moves what is seen from it: by the pose's own error at its place, turned about it. The motion
    is given at the map's origin. Errors of different nodes are correlated: the regression of node j's error on
    that of node k > j is the product of the gains between them.

    Args:
        means: Smoothed states (N, K), which begin with the pose.
        covariances: Their covariances (N, K, K).
        gains: The smoother's gains (N, K, K).
        selected: Which nodes to average over (N,), bool.

    Returns:
        The covariance (3, 3) of the frame's x, y (m) and heading (rad) at its origin.
    """
    size = means.shape[1]
    lever, carried = np.eye(3), np.zeros((size, 3))
    later, own, total = np.zeros((size, 3)), np.zeros((size, 3)), np.zeros((3, 3))
    count = 0
    for k in range(len(means) - 1, -1, -1):
        if k < len(means) - 1:
            # covariance of this error with the sum of the later ones, moved to the origin
            _multiply(gains[k], carried, later)
        lever[2, 0], lever[2, 1] = means[k, 1], -means[k, 0]  # transposed
        carried[:] = later
        if selected[k]:
            count += 1
            _multiply(covariances[k, :, :POSE].copy(), lever, own)
            carried += own
            for i in range(3):
                for j in range(3):
                    for m in range(3):
                        total[i, j] += lever[m, i] * carried[m, j] + later[m, i] * lever[m, j]
    return total / max(count, 1) ** 2
