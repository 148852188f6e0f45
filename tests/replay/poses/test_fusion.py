"""The filter and smoother of poses: against filterpy, against the whole posterior at once, and on made-up drives."""

import math
from dataclasses import dataclass, replace

import numpy as np
import pytest
from filterpy.kalman import ExtendedKalmanFilter
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from prim.arrays import FloatArray, Stamps
from prim.metrics import pose_nees, pose_rmse
from prim.se2 import Pose2D, Trajectory, wrap_angles
from replay.poses.fusion import Estimate, Fusion, Nodes, PoseNoise, nodes_at, steps_between, walk, way_of
from replay.poses.kalman import GATES, REJECTED

SECOND = 10**9
TRUE_NOISE = PoseNoise(0.1, math.radians(3), 0.05, math.radians(2), 0.0)


@dataclass(frozen=True)
class Drive:
    """A made-up drive with the recorder's kind of noise."""

    stamps: Stamps
    truth: FloatArray
    odometry: Trajectory
    fixes: FloatArray
    headings: FloatArray

    def nodes(self, odometry: bool = True, gps: bool = True, compass: bool = True) -> Nodes:
        return nodes_at(
            self.stamps,
            self.odometry if odometry else None,
            (self.stamps, self.fixes) if gps else None,
            (self.stamps, self.headings) if compass else None,
        )

    def errors(self, estimate: Estimate) -> tuple[float, float]:
        return pose_rmse(estimate.poses, self.truth)


def drive(seed: int, count: int = 600) -> Drive:
    rng = np.random.default_rng(seed)
    turns = np.repeat(rng.normal(0, 0.05, count // 20), 20)
    steps = np.column_stack((np.full(count, 0.02), np.zeros(count), turns))
    steps[0] = 0
    truth = walk(steps, np.array([0.5, -0.3, 1.0]))
    way = np.hypot(steps[:, 0], steps[:, 1])[:, None] + 0.03 * np.abs(steps[:, 2:])
    noise = rng.standard_normal((count, 3)) * (0.05, 0.05, math.radians(2)) * np.sqrt(way)
    believed = walk(steps + noise)
    stamps = np.arange(count) * (SECOND // 10) + SECOND
    fixes = truth[:, :2] + rng.normal(0, 0.1, (count, 2))
    headings = wrap_angles(truth[:, 2] + rng.normal(0, math.radians(3), count))
    truth[:, 2] = wrap_angles(truth[:, 2])
    return Drive(stamps, truth, Trajectory(stamps, believed), fixes, headings)


def test_the_filter_does_what_filterpys_does() -> None:
    one = drive(1, 60)
    fusion = Fusion(one.nodes(), TRUE_NOISE)
    found = fusion.filtered()
    other = ExtendedKalmanFilter(3, 2)
    state, spread = fusion.start
    other.x, other.P = state, np.diag(spread[[0, 3, 5]])
    nodes = fusion.nodes
    for k in range(len(nodes.stamps)):
        step, way = nodes.steps[k], nodes.ways[k]
        cos, sin = math.cos(other.x[2]), math.sin(other.x[2])
        moved = np.array([cos * step[0] - sin * step[1], sin * step[0] + cos * step[1], step[2]])
        other.F = np.array([[1, 0, -moved[1]], [0, 1, moved[0]], [0, 0, 1]])
        other.Q = np.diag([0.05**2 * way, 0.05**2 * way, math.radians(2) ** 2 * way]) + 1e-10 * np.eye(3)
        other.x = other.x + moved
        other.P = other.F @ other.P @ other.F.T + other.Q
        other.update(nodes.fixes[k], lambda _: np.eye(2, 3), lambda x: x[:2], 0.01 * np.eye(2))
        near = other.x[2] + float(wrap_angles(nodes.headings[k] - other.x[2]))
        other.update(
            np.array([near]), lambda _: np.array([[0.0, 0, 1]]), lambda x: x[2:], np.array([[math.radians(3) ** 2]])
        )
        assert found.poses[k] == pytest.approx(np.append(other.x[:2], wrap_angles(other.x[2])), abs=1e-9)
        assert found.covariances[k] == pytest.approx(other.P, abs=1e-12)


def test_the_smoother_and_its_frame_are_those_of_the_whole_posterior() -> None:
    """With a robot that does not move the problem is linear: all nodes at once, by one inverse."""
    rng = np.random.default_rng(2)
    count, place, turn = 12, 0.02, 0.03
    stamps = np.arange(count) * SECOND
    still = Trajectory(stamps, np.tile([0.4, 0.2, 0.1], (count, 1)))
    fixes, headings = 0.3 + rng.normal(0, 0.1, (count, 2)), 0.1 + rng.normal(0, 0.05, count)
    nodes = replace(nodes_at(stamps, still, (stamps, fixes), (stamps, headings)), ways=np.ones(count))
    fusion = Fusion(nodes, PoseNoise(0.1, 0.05, place, turn, 0.0))
    found = fusion.smoothed()
    start, spread = fusion.start
    variances = np.array([place, place, turn]) ** 2 + 1e-10
    information, vector = np.zeros((3 * count, 3 * count)), np.zeros(3 * count)
    sensors = np.array([0.1, 0.1, 0.05]) ** -2.0
    for k in range(count):
        at = np.arange(3 * k, 3 * k + 3)
        information[at, at] += sensors
        vector[at] += sensors * np.append(fixes[k], headings[k])
        if k:
            information[at, at] += 1 / variances
            information[at - 3, at - 3] += 1 / variances
            information[at, at - 3] -= 1 / variances
            information[at - 3, at] -= 1 / variances
    first = 1 / (spread[[0, 3, 5]] + 1e-10 + variances - 1e-10)  # the filter moves before the first node as well
    information[:3, :3] += np.diag(first)
    vector[:3] += first * start
    covariance = np.linalg.inv(information)
    assert found.poses.ravel() == pytest.approx(covariance @ vector, abs=1e-8)
    for k in range(count):
        assert found.covariances[k] == pytest.approx(covariance[3 * k : 3 * k + 3, 3 * k : 3 * k + 3], abs=1e-10)
    poses = found.poses
    motion = np.hstack([[[1, 0, y], [0, 1, -x], [0, 0, 1]] for x, y, _ in poses]) / count
    assert found.frame_covariance(stamps) == pytest.approx(motion @ covariance @ motion.T, rel=1e-6, abs=1e-12)


@pytest.mark.parametrize("seed", range(3))
def test_smoothed_poses_beat_the_filters_and_the_odometrys_and_say_how_sure_they_are(seed: int) -> None:
    one = drive(seed)
    fusion = Fusion(one.nodes())
    smoothed = fusion.smoothed()
    metres, radians = one.errors(smoothed)
    forward_metres, forward_radians = one.errors(fusion.filtered())
    assert metres < 0.032 and radians < math.radians(0.8)
    assert metres < 0.9 * forward_metres and radians < 0.9 * forward_radians
    assert 1.5 < pose_nees(smoothed.poses, one.truth, smoothed.covariances) < 5


def test_the_noise_is_found_from_the_log() -> None:
    found = [Fusion(drive(seed).nodes()).noise for seed in range(4)]
    assert np.mean([one.fixes for one in found]) == pytest.approx(0.1, rel=0.05)
    assert np.mean([one.headings for one in found]) == pytest.approx(math.radians(3), rel=0.05)
    assert np.mean([one.metres for one in found]) == pytest.approx(0.05, rel=0.25)
    assert np.mean([one.radians for one in found]) == pytest.approx(math.radians(2), rel=0.25)
    assert all(one.bias == 0 for one in found)


def test_noise_that_is_given_stays() -> None:
    noise = Fusion(drive(0).nodes(), PoseNoise(fixes=0.3, metres=0.2)).noise
    assert (noise.fixes, noise.metres) == (0.3, 0.2)
    assert noise.headings == pytest.approx(math.radians(3), rel=0.2)


@pytest.mark.parametrize(
    ("sensors", "metres", "degrees"),
    [
        ({"odometry": True, "gps": True, "compass": False}, 0.04, 6.0),
        ({"odometry": True, "gps": False, "compass": True}, 1.0, 0.9),
        ({"odometry": False, "gps": True, "compass": True}, 0.08, 4.0),
        ({"odometry": True, "gps": False, "compass": False}, 12.0, 180.0),
    ],
)
def test_any_subset_of_the_sensors_will_do(sensors: dict[str, bool], metres: float, degrees: float) -> None:
    one = drive(3)
    nodes = one.nodes(**sensors)
    if not sensors["gps"]:  # the odometry's own start is all that is known of the place
        one = replace(one, truth=one.truth - np.append(one.truth[0, :2], 0.0))
    found = Fusion(nodes).smoothed()
    assert np.isfinite(found.poses).all() and np.isfinite(found.covariances).all()
    error = one.errors(found)
    assert error[0] < metres and error[1] < math.radians(degrees)


def test_no_sensor_at_all_is_an_error() -> None:
    with pytest.raises(ValueError, match="no sensor"):
        nodes_at(np.arange(3), None, None, None)
    with pytest.raises(ValueError, match="within the time"):
        nodes_at(np.arange(3), Trajectory(np.array([10, 11]), np.zeros((2, 3))), None, None)


def test_wild_fixes_and_headings_are_left_out() -> None:
    one = drive(4)
    rng = np.random.default_rng(0)
    wild = rng.random(len(one.stamps)) < 0.05
    fixes, headings = one.fixes.copy(), one.headings.copy()
    fixes[wild] += rng.normal(0, 5, (wild.sum(), 2))
    headings[wild] += 2.0
    clean, soiled = Fusion(one.nodes()), Fusion(replace(one, fixes=fixes, headings=headings).nodes())
    found = soiled.smoothed()
    assert one.errors(found)[0] < 1.3 * one.errors(clean.smoothed())[0]
    assert (found.verdicts[wild, 1] == REJECTED).all()
    assert found.used(0)[1] >= 0.8 * wild.sum() and found.used(1)[1] < 1.3 * wild.sum()


def test_a_robot_that_is_carried_away_is_found_again() -> None:
    one = drive(5)
    truth, fixes = one.truth.copy(), one.fixes.copy()
    truth[300:, 0] += 5
    fixes[300:, 0] += 5
    fusion = Fusion(replace(one, fixes=fixes).nodes(), TRUE_NOISE)
    assert np.abs(fusion.filtered().poses[380:, :2] - truth[380:, :2]).max() < 0.4
    smoothed = fusion.smoothed().poses[:, :2]
    assert np.abs(smoothed - truth[:, :2])[np.r_[:299, 321:600]].max() < 0.25  # the jump itself stays a jump


def test_a_robot_whose_wheels_stand_still_is_not_believed_for_ever() -> None:
    one = drive(11)
    frozen = Trajectory(one.stamps, np.tile(one.odometry.poses[:1], (len(one.stamps), 1)))
    found = Fusion(replace(one, odometry=frozen).nodes()).smoothed()
    metres, _ = one.errors(found)
    assert metres < 0.5 and found.used(0)[1] < 0.5 * len(one.stamps)
    assert np.sqrt(found.covariances[:, 0, 0]).mean() > 0.02


def test_the_noise_is_found_from_readings_between_the_scans(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("replay.poses.fusion.MOST_NODES", 200)
    one = drive(10)
    between = one.stamps + SECOND // 20
    nodes = nodes_at(between, one.odometry, (one.stamps, one.fixes), (one.stamps, one.headings))
    assert Fusion(nodes).noise.fixes == pytest.approx(0.1, rel=0.15)


def test_a_biased_compass_is_found_out() -> None:
    one = drive(6)
    fusion = Fusion(replace(one, headings=wrap_angles(one.headings + 0.2)).nodes())
    assert fusion.noise.bias == pytest.approx(0.2, abs=0.08)
    assert one.errors(fusion.smoothed())[1] < math.radians(4)


def test_the_antenna_may_stand_off_the_robots_centre() -> None:
    one = drive(7)
    at = np.array([0.3, -0.1])
    cos, sin = np.cos(one.truth[:, 2]), np.sin(one.truth[:, 2])
    fixes = one.fixes + np.column_stack((cos * at[0] - sin * at[1], sin * at[0] + cos * at[1]))
    nodes = nodes_at(
        one.stamps, one.odometry, (one.stamps, fixes), (one.stamps, one.headings), (float(at[0]), float(at[1]))
    )
    assert one.errors(Fusion(nodes).smoothed())[0] < 0.032


def test_readings_at_times_of_their_own_count_where_they_were_taken() -> None:
    one = drive(8)
    later = one.stamps[:-1] + SECOND // 25
    truth, _ = Trajectory(one.stamps, one.truth).at(later)
    fixes = truth[:, :2] + one.fixes[:-1] - one.truth[:-1, :2]
    nodes = nodes_at(one.stamps[::3], one.odometry, (later, fixes), (one.stamps, one.headings))
    found = Fusion(nodes).smoothed()
    at = np.searchsorted(found.stamps, one.stamps[::3])
    assert pose_rmse(found.poses[at], one.truth[::3])[0] < 0.034


@given(hnp.arrays(float, (7, 3), elements=st.floats(-2, 2)))
def test_steps_lead_where_they_came_from(poses: FloatArray) -> None:
    assert walk(steps_between(poses), poses[0])[:, :2] == pytest.approx(poses[:, :2], abs=1e-9)
    assert np.cos(walk(steps_between(poses), poses[0])[:, 2] - poses[:, 2]) == pytest.approx(1)


@pytest.mark.parametrize("stride", [2, 7])
def test_fewer_nodes_are_the_same_drive(stride: int) -> None:
    nodes = drive(9).nodes()
    thin = nodes.only(np.arange(0, len(nodes.stamps), stride))
    assert walk(thin.steps)[-1] == pytest.approx(walk(nodes.steps)[::stride][-1], abs=1e-9)
    assert thin.ways.sum() == pytest.approx(nodes.ways[: stride * (len(thin.ways) - 1) + 1].sum())


def test_way_counts_turns() -> None:
    turned = Trajectory(np.arange(3), np.array([[0, 0, 0], [0.3, 0.4, 0], [0.3, 0.4, 1.0]]))
    assert way_of(turned) == pytest.approx([0, 0.5, 0.53])


def test_gates_let_999_of_1000_through() -> None:
    rng = np.random.default_rng(0)
    assert np.mean((rng.standard_normal((100_000, 2)) ** 2).sum(axis=1) > GATES[0]) == pytest.approx(0.001, abs=4e-4)
    assert np.mean(rng.standard_normal(100_000) ** 2 > GATES[1]) == pytest.approx(0.001, abs=4e-4)


def test_poses_carry_on_when_pushed_through_a_mount() -> None:
    from replay.poses.localize import carried, compose

    covariance = np.diag([0.01, 0.02, 0.03])
    robot, mount = Pose2D(1, 2, 0.7, covariance), Pose2D(0.2, -0.1, 0.4)
    laser = robot @ mount
    poses, mounts = np.array([[1, 2, 0.7]]), np.array([[0.2, -0.1, 0.4]])
    assert compose(poses, mounts)[0] == pytest.approx([laser.x, laser.y, laser.theta])
    assert carried(covariance[None], poses, mounts)[0] == pytest.approx(laser.covariance)
