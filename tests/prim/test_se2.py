"""Planar rigid motions: the group's laws, covariances against Jacobians by differences, interpolation."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from prim import se2
from prim.se2 import Pose2D, Trajectory, angle_difference, wrap_angle, wrap_angles

COORDINATES = st.floats(-5, 5)
POSES = st.builds(Pose2D, COORDINATES, COORDINATES, st.floats(-3, 3))
POSE_PAIRS = st.integers(0, 9).flatmap(lambda n: st.tuples(*[arrays(float, (n, 3), elements=COORDINATES)] * 2))
STEPS = 1e-6 * np.eye(3)


def as_pose(row: np.ndarray) -> Pose2D:
    return Pose2D(*row.tolist())


def assert_same_poses(poses: np.ndarray, expected: np.ndarray) -> None:
    """Poses (N, 3) agree, headings modulo 2 pi."""
    difference = np.asarray(poses) - np.asarray(expected)
    difference[:, 2] = wrap_angles(difference[:, 2])
    assert difference == pytest.approx(np.zeros_like(difference), abs=1e-9)


def covariances(rng: np.random.Generator, count: int) -> np.ndarray:
    roots = rng.normal(size=(count, 3, 3))
    return roots @ roots.transpose(0, 2, 1)


@given(POSES, POSES)
def test_composition_applies_the_child_first(parent: Pose2D, child: Pose2D) -> None:
    points = np.array([[1.0, 2.0], [-3.0, 0.5]])
    assert (parent @ child).apply(points) == pytest.approx(parent.apply(child.apply(points)), abs=1e-9)


@given(POSES)
def test_a_pose_composed_with_its_inverse_is_the_identity(pose: Pose2D) -> None:
    both = pose @ pose.inverse()
    assert (both.x, both.y, both.theta) == pytest.approx((0, 0, 0), abs=1e-9)


@given(POSE_PAIRS)
def test_arrays_are_composed_as_single_poses_are(pair: tuple[np.ndarray, np.ndarray]) -> None:
    poses, children = pair
    single = [as_pose(pose) @ as_pose(child) for pose, child in zip(poses, children, strict=True)]
    expected = np.array([(pose.x, pose.y, pose.theta) for pose in single]).reshape(-1, 3)
    assert_same_poses(se2.compose_poses(poses, children), expected)


@given(POSE_PAIRS)
def test_relative_poses_invert_composition(pair: tuple[np.ndarray, np.ndarray]) -> None:
    poses, others = pair
    relative = se2.relative_poses(poses, others)
    assert_same_poses(se2.compose_poses(poses, relative), others)
    assert_same_poses(se2.relative_poses(poses, se2.compose_poses(poses, others)), others)
    assert (relative[:, 2] >= -math.pi).all() and (relative[:, 2] <= math.pi).all()


@given(arrays(float, st.tuples(st.integers(1, 9), st.just(3)), elements=COORDINATES))
def test_integrated_steps_lead_along_the_poses(poses: np.ndarray) -> None:
    steps = se2.relative_steps(poses)
    assert not steps[0].any()
    assert_same_poses(se2.integrate_steps(steps, poses[0]), poses)
    from_origin = se2.integrate_steps(steps)
    start = np.broadcast_to(poses[0], poses.shape)
    assert_same_poses(se2.compose_poses(start, from_origin), poses)


@given(st.floats(-10, 10), st.floats(-10, 10))
def test_rotations_add_up_and_keep_lengths(first: float, second: float) -> None:
    points = np.array([[1.0, 2.0], [-3.0, 0.5], [0.0, 0.0]])
    rotated = se2.rotate(points, first)
    assert se2.rotate(rotated, second) == pytest.approx(se2.rotate(points, first + second), abs=1e-9)
    assert np.hypot(*rotated.T) == pytest.approx(np.hypot(*points.T))
    assert se2.rotate([[1.0, 0.0]], first) == pytest.approx(np.array([[math.cos(first), math.sin(first)]]))


def test_an_uncertain_heading_moves_a_child_sideways() -> None:
    """A heading that is off by s moves a point 2 m ahead by 2 s sideways."""
    turned = Pose2D(0, 0, math.pi / 2, np.diag([0.0, 0.0, 0.01])) @ Pose2D(2, 0, 0)
    assert turned.covariance == pytest.approx(np.array([[0.04, 0, -0.02], [0, 0, 0], [-0.02, 0, 0.01]]))


@given(POSES, POSES, st.integers(0, 2**32))
def test_composed_covariance_is_first_order(parent: Pose2D, child: Pose2D, seed: int) -> None:
    """J P J' + K Q K', with the Jacobians J and K by differences."""
    p, q = covariances(np.random.default_rng(seed), 2)

    def compose(v: np.ndarray) -> np.ndarray:
        pose = Pose2D(*v[:3]) @ Pose2D(*v[3:])
        return np.array([pose.x, pose.y, v[2] + v[5]])

    at = np.array([parent.x, parent.y, parent.theta, child.x, child.y, child.theta])
    jacobian = np.column_stack([(compose(at + e) - compose(at - e)) / 2e-6 for e in 1e-6 * np.eye(6)])
    expected = jacobian[:, :3] @ p @ jacobian[:, :3].T + jacobian[:, 3:] @ q @ jacobian[:, 3:].T
    composed = Pose2D(parent.x, parent.y, parent.theta, p) @ Pose2D(child.x, child.y, child.theta, q)
    assert composed.covariance == pytest.approx(expected, rel=1e-5, abs=1e-5)


@given(POSE_PAIRS, st.integers(0, 2**32))
def test_covariances_of_arrays_are_composed_as_those_of_single_poses_are(
    pair: tuple[np.ndarray, np.ndarray], seed: int
) -> None:
    poses, children = pair
    given_covariances = covariances(np.random.default_rng(seed), len(poses))
    carried = se2.compose_covariances(given_covariances, poses, children)
    for pose, child, covariance, found in zip(poses, children, given_covariances, carried, strict=True):
        expected = (Pose2D(*pose.tolist(), covariance) @ as_pose(child)).covariance
        assert found == pytest.approx(expected, rel=1e-9, abs=1e-9)


@given(arrays(float, st.tuples(st.integers(0, 5), st.just(3)), elements=COORDINATES), st.integers(0, 2**32))
def test_motions_of_the_frame_are_what_errors_of_poses_make_of_it(poses: np.ndarray, seed: int) -> None:
    spread = covariances(np.random.default_rng(seed), len(poses))
    motions = se2.frame_motions(spread, poses)
    back = [se2.frame_covariances(one, pose[None])[0] for one, pose in zip(motions, poses, strict=True)]
    scale = 1 + np.abs(motions).max(initial=0.0)
    assert np.reshape(back, spread.shape) == pytest.approx(
        spread, abs=1e-9 * scale * (1 + np.abs(poses).max(initial=0.0)) ** 2
    )


@given(arrays(float, st.tuples(st.integers(0, 5), st.just(3)), elements=COORDINATES), st.integers(0, 2**32))
def test_an_uncertain_frame_adds_to_the_poses_in_it(poses: np.ndarray, seed: int) -> None:
    """As J P J', with the Jacobian J by differences of a frame near the identity composed with each pose."""
    covariance = covariances(np.random.default_rng(seed), 1)[0]
    added = se2.frame_covariances(covariance, poses)
    for pose, found in zip(poses, added, strict=True):
        moved = [
            se2.compose_poses(sign * STEPS, np.broadcast_to(pose, (3, 3)))  # a row for each parameter of the frame
            for sign in (1, -1)
        ]
        jacobian = ((moved[0] - moved[1]) / 2e-6).T
        assert found == pytest.approx(jacobian @ covariance @ jacobian.T, rel=1e-4, abs=1e-4)


def test_interpolated_headings_turn_along_the_shorter_arc() -> None:
    trajectory = Trajectory.from_unsorted([0, 100], [[0, 0, 3.0], [1, 2, -3.0]])
    poses, within = trajectory.at(np.array([50, -1, 101]))
    assert poses[0] == pytest.approx([0.5, 1.0, -math.pi])
    assert within.tolist() == [True, False, False]


def test_poses_are_sorted_and_the_last_of_a_stamp_remains() -> None:
    trajectory = Trajectory.from_unsorted([200, 100, 200], [[1, 0, 0], [2, 0, 0], [3, 0, 0]])
    assert trajectory.stamps.tolist() == [100, 200]
    assert trajectory.poses[:, 0].tolist() == [2, 3]


def test_a_single_pose_is_valid_at_its_stamp_alone() -> None:
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


@given(st.floats(-1000, 1000))
def test_wrapped_angles_are_within_a_turn_and_equal_modulo_a_turn(angle: float) -> None:
    wrapped = wrap_angle(angle)
    assert -math.pi <= wrapped <= math.pi
    assert math.cos(wrapped) == pytest.approx(math.cos(angle), abs=1e-9)
    assert wrap_angles(np.array([angle]))[0] == wrapped


@given(st.floats(-10, 10), st.floats(-10, 10), st.floats(0.1, 7))
def test_angle_difference_is_the_shorter_way(a: float, b: float, period: float) -> None:
    difference = angle_difference(a, b, period)
    assert -period / 2 - 1e-9 <= difference <= period / 2 + 1e-9
    turns = (a - b - difference) / period
    assert turns == pytest.approx(round(turns), abs=1e-6)
