"""The filter over the nodes of a fusion: where it begins, with which noise, and a run of it."""

from __future__ import annotations

import math

import numpy as np

from prim.arrays import FloatArray
from prim.se2 import integrate_steps, rotate, wrap_angles
from replay.poses.fusion_nodes import FusionNodes
from replay.poses.fusion_options import FusionOptions, SensorNoise
from replay.poses.kalman import (
    FIX_STD,
    HEADING_BIAS,
    HEADING_STD,
    HEADING_WANDER_STD,
    HEADING_WANDER_TIME,
    PARAMETERS,
    POSE,
    ROTATION_STD,
    TRANSLATION_STD,
    WANDER_STD,
    WITH_WANDER,
    FilterModel,
    FilterOutput,
    FilterState,
    Gate,
    Measurements,
    QuadraticTerms,
    run_filter,
)

NORMAL_MEDIAN = 0.6745
"""The median absolute value of a standard normal variable."""


def filter_nodes(
    nodes: FusionNodes,
    noise: FloatArray,
    initial: FilterState,
    options: FusionOptions,
    scans: QuadraticTerms | None = None,
    headings: FloatArray | None = None,
) -> FilterOutput:
    """Run the filter.

    Args:
        nodes: The measurements at N nodes.
        noise: The noise parameters (11,).
        initial: The belief before the first node.
        options: Gates.
        scans: The scans' log-likelihoods of the poses at the nodes.
        headings: Headings (N,) at the nodes (rad, not wrapped) about which the motion is linear; None: the filter's
            own, which know less.

    Returns:
        States, covariances and costs at the nodes.
    """
    measurements = Measurements(
        nodes.steps,
        nodes.variance_scales,
        nodes.intervals,
        nodes.fixes,
        nodes.fix_scales,
        nodes.headings,
        QuadraticTerms.zeros(0) if scans is None else scans,
        np.full(len(nodes.stamps), np.nan) if headings is None else np.concatenate((headings[:1], headings[:-1])),
    )
    # without odometry a turn cannot be distinguished from a wrong heading, and nothing is rejected
    thresholds = (options.fix_gate, options.heading_gate) if nodes.has_odometry else (math.inf, math.inf)
    fix_gate, heading_gate = (Gate(threshold, options.max_rejections) for threshold in thresholds)
    model = FilterModel(noise, nodes.lever_arm, fix_gate, heading_gate, options.min_step_variance)
    initial = with_wander(initial, noise, options)
    output = FilterOutput.empty(len(nodes.stamps), len(initial.mean))
    run_filter(initial, measurements, model, output)
    return output


def with_wander(belief: FilterState, noise: FloatArray, options: FusionOptions) -> FilterState:
    """Return a belief with the errors that wander.

    Args:
        belief: In the pose, or in all of the state.
        noise: The noise parameters (11,).
        options: The least variance.

    Returns:
        The belief: of wandering errors nothing is known yet where it was in the pose alone.
    """
    if not noise[WANDER_STD] and not noise[HEADING_WANDER_STD]:
        return FilterState(belief.mean[:POSE], belief.covariance[:POSE, :POSE])
    if len(belief.mean) > POSE:
        return belief
    mean, covariance = np.zeros(WITH_WANDER), np.zeros((WITH_WANDER, WITH_WANDER))
    mean[:POSE], covariance[:POSE, :POSE] = belief.mean, belief.covariance
    wander = noise[[WANDER_STD, WANDER_STD, HEADING_WANDER_STD]] ** 2
    covariance[range(POSE, WITH_WANDER), range(POSE, WITH_WANDER)] = wander + options.min_step_variance
    return FilterState(mean, covariance)


def first_noise(nodes: FusionNodes, given: SensorNoise, options: FusionOptions) -> FloatArray:
    """Find the noise that an estimate begins at.

    Args:
        nodes: The measurements.
        given: What is known of it.
        options: What it is where nothing shows it.

    Returns:
        The parameters (11,): given, else what differences of neighbouring readings show, else the defaults.
    """
    translation, rotation = options.default_odometry_std if nodes.has_odometry else options.default_walk_std
    scales = nodes.fix_scales[nodes.has_fix, None]
    fix_differences = np.diff(nodes.fixes[nodes.has_fix], axis=0) / np.sqrt((scales[1:] ** 2 + scales[:-1] ** 2) / 2)
    heading_differences = wrap_angles(np.diff(nodes.headings[nodes.has_heading]))
    noise = np.ones(PARAMETERS)
    noise[FIX_STD] = given.position_std or _robust_std(fix_differences) or options.default_position_std
    noise[HEADING_STD] = given.heading_std or _robust_std(heading_differences) or options.default_heading_std
    noise[TRANSLATION_STD] = given.odometry_translation_std or translation
    noise[ROTATION_STD] = given.odometry_rotation_std or rotation
    noise[HEADING_BIAS] = given.heading_bias or 0.0
    noise[[WANDER_STD, HEADING_WANDER_STD]] = 0.0
    if nodes.has_heading.any() and not nodes.has_north:
        noise[[HEADING_WANDER_STD, HEADING_WANDER_TIME]] = options.default_imu_wander
    return noise


def initial_state(nodes: FusionNodes, noise: FloatArray, options: FusionOptions) -> FilterState:
    """Find the pose that a filter begins at.

    Args:
        nodes: The measurements.
        noise: The noise parameters (11,).
        options: Its standard deviations.

    Returns:
        The pose and its covariance, from the first readings.
    """
    odometry = integrate_steps(nodes.steps)
    x, y, theta = nodes.initial_pose.tolist()
    heading_std = options.initial_known_std
    if nodes.has_heading.any() and nodes.has_north:
        at = np.flatnonzero(nodes.has_heading)[: options.initial_readings]
        theta = median_angle(nodes.headings[at] - noise[HEADING_BIAS] - odometry[at, 2])
        heading_std = options.initial_compass_std
    elif nodes.has_fix.any():
        theta, heading_std = _aligned_heading(nodes, odometry, noise, options), options.initial_aligned_std
    position_std = options.initial_known_std
    if nodes.has_fix.any():
        at = np.flatnonzero(nodes.has_fix)[: options.initial_readings]
        cos, sin = math.cos(theta), math.sin(theta)
        moved = odometry[at, :2] @ np.array([[cos, sin], [-sin, cos]])
        x, y = np.median(nodes.fixes[at] - moved, axis=0).tolist()
        constant, multiple = options.initial_position_std
        position_std = constant + multiple * math.hypot(noise[FIX_STD], noise[WANDER_STD])
    covariance = np.diag([position_std**2, position_std**2, heading_std**2])
    return FilterState(np.array([x, y, theta]), covariance)


def _aligned_heading(nodes: FusionNodes, odometry: FloatArray, noise: FloatArray, options: FusionOptions) -> float:
    """Return the initial heading by which the odometry's poses (N, 3) fit the fixes best (Procrustes)."""
    at = np.flatnonzero(nodes.has_fix)
    moved, fixes = odometry[at, :2], nodes.fixes[at]
    reach = np.hypot(*(moved - moved[0]).T)
    error = math.hypot(noise[FIX_STD], noise[WANDER_STD])
    far = np.flatnonzero(reach > options.alignment_ratio * error)
    count = max(int(far[0]) + 1, options.initial_readings) if len(far) else len(at)
    moved, fixes = moved[:count] - moved[:count].mean(axis=0), fixes[:count] - fixes[:count].mean(axis=0)
    return _rotation_between(moved, fixes)


def scatter_about_odometry(nodes: FusionNodes, noise: FloatArray, parameter: int) -> float:
    """Measure how readings scatter about the aligned odometry.

    Args:
        nodes: The measurements.
        noise: The noise parameters (11,).
        parameter: WANDER_STD for fixes, HEADING_WANDER_STD for headings.

    Returns:
        The standard deviation (m along each axis, or rad), and no less than that of single readings.
    """
    if parameter != WANDER_STD:
        turned = integrate_steps(nodes.steps)[:, 2]
        apart = (nodes.headings - turned)[nodes.has_heading]
        return max(_robust_std(wrap_angles(apart - median_angle(apart)), 1), float(noise[HEADING_STD]))
    fixes = nodes.fixes[nodes.has_fix]
    moved = integrate_steps(nodes.steps)[nodes.has_fix, :2]
    fixes, moved = fixes - fixes.mean(axis=0), moved - moved.mean(axis=0)
    return max(_robust_std(fixes - rotate(moved, _rotation_between(moved, fixes)), 1), float(noise[FIX_STD]))


def _robust_std(values: FloatArray, readings: int = 2) -> float:
    """Return the standard deviation of single readings from the median size of values that each differ by several.

    0 where there is none.
    """
    return float(np.median(np.abs(values))) / NORMAL_MEDIAN / math.sqrt(readings) if values.size else 0.0


def _rotation_between(points: FloatArray, others: FloatArray) -> float:
    """Return the angle (rad) by which points (N, 2) fit others best, both about their means (Procrustes)."""
    cross = float((points[:, 0] * others[:, 1] - points[:, 1] * others[:, 0]).sum())
    return math.atan2(cross, float((points * others).sum()))


def median_angle(angles: FloatArray) -> float:
    """Return the angle (rad) of the medians of cosines and sines of angles (N,)."""
    return math.atan2(float(np.median(np.sin(angles))), float(np.median(np.cos(angles))))
