import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from prim.scan import Scan
from prim.se2 import Pose2D, Trajectory, wrap_angle

COORDINATES = st.floats(-5, 5)
POSES = st.builds(Pose2D, COORDINATES, COORDINATES, st.floats(-3, 3))


@given(POSES, POSES)
def test_composition_applies_the_child_first(parent: Pose2D, child: Pose2D) -> None:
    points = np.array([[1.0, 2.0], [-3.0, 0.5]])
    assert (parent @ child).apply(points) == pytest.approx(parent.apply(child.apply(points)), abs=1e-9)


@given(POSES)
def test_inverse_undoes(pose: Pose2D) -> None:
    both = pose @ pose.inverse()
    assert (both.x, both.y, both.theta) == pytest.approx((0, 0, 0), abs=1e-9)


def test_covariance_of_a_turned_lever() -> None:
    """A heading that is off by s moves a point 2 m ahead by 2 s sideways."""
    turned = Pose2D(0, 0, math.pi / 2, np.diag([0.0, 0.0, 0.01])) @ Pose2D(2, 0, 0)
    assert turned.covariance == pytest.approx(np.array([[0.04, 0, -0.02], [0, 0, 0], [-0.02, 0, 0.01]]))


@given(POSES, POSES, st.integers(0, 2**32))
def test_composed_covariance_is_that_of_samples(parent: Pose2D, child: Pose2D, seed: int) -> None:
    """First order: the composed covariance is J P J' + K Q K', with Jacobians by differences."""
    rng = np.random.default_rng(seed)
    a, b = rng.normal(size=(2, 3, 3))
    p, q = a @ a.T, b @ b.T

    def compose(v: np.ndarray) -> np.ndarray:
        pose = Pose2D(*v[:3]) @ Pose2D(*v[3:])
        return np.array([pose.x, pose.y, v[2] + v[5]])

    at = np.array([parent.x, parent.y, parent.theta, child.x, child.y, child.theta])
    jacobian = np.column_stack([(compose(at + e) - compose(at - e)) / 2e-6 for e in 1e-6 * np.eye(6)])
    expected = jacobian[:, :3] @ p @ jacobian[:, :3].T + jacobian[:, 3:] @ q @ jacobian[:, 3:].T
    composed = Pose2D(parent.x, parent.y, parent.theta, p) @ Pose2D(child.x, child.y, child.theta, q)
    assert composed.covariance == pytest.approx(expected, rel=1e-5, abs=1e-5)


def test_interpolation_turns_the_short_way() -> None:
    trajectory = Trajectory.from_unsorted([0, 100], [[0, 0, 3.0], [1, 2, -3.0]])
    poses, within = trajectory.at(np.array([50, -1, 101]))
    assert poses[0] == pytest.approx([0.5, 1.0, -math.pi])
    assert within.tolist() == [True, False, False]


def test_poses_are_sorted_and_the_last_of_a_stamp_stays() -> None:
    trajectory = Trajectory.from_unsorted([200, 100, 200], [[1, 0, 0], [2, 0, 0], [3, 0, 0]])
    assert trajectory.stamps.tolist() == [100, 200]
    assert trajectory.poses[:, 0].tolist() == [2, 3]


def test_a_single_pose_holds_at_its_stamp_alone() -> None:
    poses, within = Trajectory.from_unsorted([100], [[1, 2, 3]]).at(np.array([99, 100]))
    assert poses[1].tolist() == pytest.approx([1, 2, 3])
    assert within.tolist() == [False, True]


def test_stamps_that_do_not_rise_are_refused() -> None:
    with pytest.raises(ValueError, match="rise"):
        Trajectory(np.array([1, 1]), np.zeros((2, 3)))


def test_nanosecond_stamps_keep_their_precision() -> None:
    start = 1_735_689_600_000_000_001
    poses, _ = Trajectory.from_unsorted([start, start + 10], [[0, 0, 0], [1, 0, 0]]).at(np.array([start + 3]))
    assert poses[0, 0] == pytest.approx(0.3)


def test_hits_follow_rep_117() -> None:
    ranges = np.array([np.nan, -np.inf, 0.0, 0.05, 0.1, 4.9, 5.0, np.inf], dtype=np.float32)
    scan = Scan(0, "laser", 0.0, 0.1, 0.1, 5.0, ranges)
    assert scan.hits.tolist() == [False, False, False, False, True, True, False, False]
    assert len(scan.points(Pose2D())) == 2


@given(st.floats(-1000, 1000))
def test_wrap_angle(angle: float) -> None:
    wrapped = wrap_angle(angle)
    assert -math.pi <= wrapped <= math.pi
    assert math.cos(wrapped) == pytest.approx(math.cos(angle), abs=1e-9)
