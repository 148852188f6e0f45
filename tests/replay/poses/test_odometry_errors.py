"""Scales and delays of odometries that are known, against better poses."""

import math
from dataclasses import replace

import numpy as np
import pytest

from prim.arrays import FloatArray, Stamps
from prim.se2 import Trajectory, compose_poses, integrate_steps, relative_poses, relative_steps, wrap_angles
from replay.poses.laser_poses import LaserPoses, ScanTimes
from replay.poses.odometry_errors import NO_ERRORS, OdometryErrors, find_odometry_errors
from replay.poses.tracking.laser_track import corrected_odometry

SECOND = 10**9


def drive(seed: int, count: int = 1200) -> tuple[Stamps, FloatArray]:
    """Ten poses a second at 0.3 m/s, with turns that come and go."""
    rng = np.random.default_rng(seed)
    turns = 0.06 * np.sin(np.cumsum(rng.normal(0, 0.15, count)))
    steps = np.column_stack((np.full(count, 0.03), np.zeros(count), turns))
    return np.arange(count) * (SECOND // 10), integrate_steps(steps)


def measured(
    truth: FloatArray, rng: np.random.Generator, distance: float = 1.0, turn: float = 1.0, slips: int = 0
) -> FloatArray:
    """An odometry of 3 cm and one degree after a metre, whose distances and turns are too long."""
    steps = relative_steps(truth) * [distance, distance, turn]
    steps[1:] += rng.normal(0, 1, (len(steps) - 1, 3)) * np.array([0.03, 0.03, math.radians(1)]) * math.sqrt(0.03)
    steps[rng.choice(np.arange(1, len(steps)), slips, replace=False)] += [0.3, 0.0, 0.4]
    return integrate_steps(steps)


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("slips", [0, 5])
def test_scales_are_found_whatever_slips(seed: int, slips: int) -> None:
    stamps, truth = drive(seed)
    odometry = measured(truth, np.random.default_rng(seed), 1.06, 0.95, slips)
    found = find_odometry_errors(stamps, odometry, truth)
    assert found.distance_scale == pytest.approx(1 / 1.06, abs=0.02)
    assert found.turn_scale == pytest.approx(1 / 0.95, abs=0.012)
    assert found.delay == 0


@pytest.mark.parametrize("seed", range(6))
def test_nothing_is_found_where_nothing_is_wrong(seed: int) -> None:
    stamps, truth = drive(seed)
    assert find_odometry_errors(stamps, measured(truth, np.random.default_rng(seed)), truth) == NO_ERRORS


@pytest.mark.parametrize("delay", [0.12, -0.3])
def test_delay_is_found_and_does_not_pass_for_a_scale(delay: float) -> None:
    stamps, truth = drive(7)
    late, _ = Trajectory(stamps, truth).at(stamps - round(delay * SECOND))
    found = find_odometry_errors(stamps, measured(late, np.random.default_rng(7)), truth)
    assert found.delay == pytest.approx(delay, abs=0.01)
    assert (found.distance_scale, found.turn_scale) == (1, 1)
    assert found.notes("/odom") == (
        f"/odom shows each motion {abs(delay):.2f} s {'after' if delay > 0 else 'before'} the scans do: "
        "two clocks, or a delay",
    )


def test_scales_are_those_of_the_motion_at_the_time_that_odometry_shows_it() -> None:
    stamps, truth = drive(7)
    late, _ = Trajectory(stamps, truth).at(stamps - 4 * SECOND // 10)
    found = find_odometry_errors(stamps, measured(late, np.random.default_rng(7), 1.06, 0.9), truth)
    assert found.turn_scale == pytest.approx(1 / 0.9, abs=0.012)
    assert found.distance_scale == pytest.approx(1 / 1.06, abs=0.02)


def test_correction_takes_the_scales_out() -> None:
    _, truth = drive(8, 200)
    scaled = integrate_steps(relative_steps(truth) * [1.1, 1.1, 0.9], truth[0])
    errors = OdometryErrors(1 / 1.1, 1 / 0.9)
    assert errors.corrected(scaled) == pytest.approx(truth, abs=1e-9)
    assert errors.notes("/odom") == ("/odom: distances x 0.909, turns x 1.111, found from the log and corrected",)


def test_odometry_that_stands_still_or_is_short_has_no_scales() -> None:
    stamps, truth = drive(9)
    assert find_odometry_errors(stamps, np.tile(truth[:1], (len(truth), 1)), truth) == NO_ERRORS
    assert find_odometry_errors(stamps[:5], truth[:5], truth[:5]) == NO_ERRORS


def test_poses_of_a_laser_away_from_the_robot_s_origin_are_corrected_about_that() -> None:
    stamps, truth = drive(10, 100)
    mounts = np.tile([0.3, 0.1, 0.5], (100, 1))
    scaled = integrate_steps(relative_steps(truth) * [1.1, 1.1, 0.9], truth[0])
    ends = np.tile([0.01, 0.0, 0.02], (100, 1))
    valid = np.arange(100) != 50
    laser = compose_poses(scaled, mounts)
    poses = LaserPoses("odom", "/odom", laser, valid, end_poses=compose_poses(laser, ends), mounts=mounts)
    order = np.random.default_rng(0).permutation(100)  # scans need not be in order
    shuffled = replace(
        poses,
        poses=laser[order],
        valid=valid[order],
        end_poses=compose_poses(laser, ends)[order],
        mounts=mounts[order],
    )
    found = corrected_odometry(shuffled, ScanTimes(stamps[order], ("laser",)), OdometryErrors(1 / 1.1, 1 / 0.9))
    expected = compose_poses(truth, mounts)[order]
    assert found.end_poses is not None and len(found.notes) == 1
    for got, wanted in ((found.poses, expected), (found.end_poses, compose_poses(expected, ends[order]))):
        apart = relative_poses(wanted, got)[shuffled.valid]
        # without the pose in the middle, two steps are one: they are scaled as it is
        assert np.abs(apart[:, :2]).max() < 0.01 and np.abs(wrap_angles(apart[:, 2])).max() < 1e-9
