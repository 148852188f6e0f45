"""Kalman filter and smoother of poses: against filterpy, against the joint posterior, and on simulated drives."""

import math
from dataclasses import dataclass, replace

import numpy as np
import pytest
from filterpy.kalman import ExtendedKalmanFilter

from prim.arrays import FloatArray, Stamps
from prim.metrics import pose_nees, pose_rmse
from prim.se2 import Trajectory, integrate_steps, relative_poses, relative_steps, wrap_angles
from replay.poses.fusion import Fusion, PoseEstimate
from replay.poses.fusion_filter import filter_nodes
from replay.poses.fusion_nodes import FusionNodes, weighted_path_lengths
from replay.poses.fusion_options import FusionOptions, NoiseEstimationOptions, SensorNoise
from replay.poses.kalman import REJECTED, FilterState, smooth

SECOND = 10**9
TRUE_NOISE = SensorNoise(0.1, math.radians(3), 0.05, math.radians(2), 0.0)


@dataclass(frozen=True)
class Drive:
    """A simulated drive with the recorder's model of noise."""

    stamps: Stamps
    truth: FloatArray
    odometry: Trajectory
    fixes: FloatArray
    headings: FloatArray

    def nodes(
        self,
        odometry: bool = True,
        gps: bool = True,
        compass: bool = True,
        fix_stds: FloatArray | None = None,
        has_north: bool = True,
    ) -> FusionNodes:
        return FusionNodes.from_readings(
            self.stamps,
            self.odometry if odometry else None,
            (self.stamps, self.fixes) if gps else None,
            (self.stamps, self.headings) if compass else None,
            fix_stds=fix_stds,
            has_north=has_north,
        )

    def errors(self, estimate: PoseEstimate) -> tuple[float, float]:
        return pose_rmse(estimate.poses, self.truth)


def drive(seed: int, count: int = 600) -> Drive:
    rng = np.random.default_rng(seed)
    turns = np.repeat(rng.normal(0, 0.05, count // 20), 20)
    steps = np.column_stack((np.full(count, 0.02), np.zeros(count), turns))
    steps[0] = 0
    truth = integrate_steps(steps, np.array([0.5, -0.3, 1.0]))
    distances = np.hypot(steps[:, 0], steps[:, 1])[:, None] + 0.03 * np.abs(steps[:, 2:])
    noise = rng.standard_normal((count, 3)) * (0.05, 0.05, math.radians(2)) * np.sqrt(distances)
    odometry = integrate_steps(steps + noise)
    stamps = np.arange(count) * (SECOND // 10) + SECOND
    fixes = truth[:, :2] + rng.normal(0, 0.1, (count, 2))
    headings = wrap_angles(truth[:, 2] + rng.normal(0, math.radians(3), count))
    truth[:, 2] = wrap_angles(truth[:, 2])
    return Drive(stamps, truth, Trajectory(stamps, odometry), fixes, headings)


def test_filter_agrees_with_filterpy() -> None:
    driven = drive(1, 60)
    fusion = Fusion(driven.nodes(), TRUE_NOISE)
    filtered = fusion.filtered()
    other = ExtendedKalmanFilter(3, 2)
    initial = fusion.initial_state
    other.x, other.P = initial.mean, initial.covariance
    nodes = fusion.nodes
    for k in range(len(nodes.stamps)):
        step, distance = nodes.steps[k], nodes.variance_scales[k]
        cos, sin = math.cos(other.x[2]), math.sin(other.x[2])
        moved = np.array([cos * step[0] - sin * step[1], sin * step[0] + cos * step[1], step[2]])
        other.F = np.array([[1, 0, -moved[1]], [0, 1, moved[0]], [0, 0, 1]])
        other.Q = np.diag([0.05**2, 0.05**2, math.radians(2) ** 2]) * distance + 1e-10 * np.eye(3)
        other.x = other.x + moved
        other.P = other.F @ other.P @ other.F.T + other.Q
        other.update(nodes.fixes[k], lambda _: np.eye(2, 3), lambda x: x[:2], 0.01 * np.eye(2))
        near = other.x[2] + float(wrap_angles(nodes.headings[k] - other.x[2]))
        other.update(
            np.array([near]), lambda _: np.array([[0.0, 0, 1]]), lambda x: x[2:], np.array([[math.radians(3) ** 2]])
        )
        assert filtered.poses[k] == pytest.approx(np.append(other.x[:2], wrap_angles(other.x[2])), abs=1e-9)
        assert filtered.covariances[k] == pytest.approx(other.P, abs=1e-12)


def test_smoother_and_frame_covariance_agree_with_the_joint_posterior() -> None:
    """The problem is linear where the robot does not move: the joint posterior of all nodes is one inverse."""
    rng = np.random.default_rng(2)
    count, place, turn = 12, 0.02, 0.03
    stamps = np.arange(count) * SECOND
    still = Trajectory(stamps, np.tile([0.4, 0.2, 0.1], (count, 1)))
    fixes, headings = 0.3 + rng.normal(0, 0.1, (count, 2)), 0.1 + rng.normal(0, 0.05, count)
    nodes = replace(
        FusionNodes.from_readings(stamps, still, (stamps, fixes), (stamps, headings)), variance_scales=np.ones(count)
    )
    fusion = Fusion(nodes, SensorNoise(0.1, 0.05, place, turn, 0.0))
    found = fusion.smoothed()
    initial = fusion.initial_state
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
    # the filter makes a step before the first node as well
    first = 1 / (initial.covariance.diagonal() + 1e-10 + variances - 1e-10)
    information[:3, :3] += np.diag(first)
    vector[:3] += first * initial.mean
    covariance = np.linalg.inv(information)
    assert found.poses.ravel() == pytest.approx(covariance @ vector, abs=1e-8)
    for k in range(count):
        assert found.covariances[k] == pytest.approx(covariance[3 * k : 3 * k + 3, 3 * k : 3 * k + 3], abs=1e-10)
    poses = found.poses
    motion = np.hstack([[[1, 0, y], [0, 1, -x], [0, 0, 1]] for x, y, _ in poses]) / count
    assert found.frame_covariance(stamps) == pytest.approx(motion @ covariance @ motion.T, rel=1e-6, abs=1e-12)

    known = FilterState(np.array([2.0, -1.0, 1.3]), np.diag([1e-6, 4e-6, 9e-6]))
    moved = found.seen_from_first(known)
    turn = np.array([[math.cos(t := 1.3 - poses[0, 2]), -math.sin(t), 0], [math.sin(t), math.cos(t), 0], [0, 0, 1]])
    for k, (x, y, theta) in enumerate(poses - poses[0]):
        # to first order in the errors of both: where this one is seen from the first, whose own error moves it
        carried = np.array([[1, 0, -y], [0, 1, x], [0, 0, 1]])
        both = covariance[np.ix_(rows := [0, 1, 2, 3 * k, 3 * k + 1, 3 * k + 2], rows)]
        apart = np.hstack((-carried, np.eye(3)))
        spread = apart @ both @ apart.T + carried @ turn.T @ np.diag([1e-6, 4e-6, 9e-6]) @ turn @ carried.T
        assert moved.poses[k] == pytest.approx([2, -1, 1.3] + turn @ [x, y, theta], abs=1e-12)
        assert moved.covariances[k] == pytest.approx(turn @ spread @ turn.T, abs=1e-10)


@pytest.mark.parametrize("seed", range(3))
def test_smoothed_poses_are_more_accurate_than_filtered_ones_and_consistent(seed: int) -> None:
    driven = drive(seed)
    fusion = Fusion(driven.nodes())
    smoothed = fusion.smoothed()
    metres, radians = driven.errors(smoothed)
    forward_metres, forward_radians = driven.errors(fusion.filtered())
    assert metres < 0.032 and radians < math.radians(0.8)
    assert metres < 0.9 * forward_metres and radians < 0.9 * forward_radians
    assert 1.5 < pose_nees(smoothed.poses, driven.truth, smoothed.covariances) < 5


def test_noise_is_estimated_from_the_log() -> None:
    found = [Fusion(drive(seed).nodes()).noise for seed in range(4)]
    assert np.mean([noise.position_std for noise in found]) == pytest.approx(0.1, rel=0.05)
    assert np.mean([noise.heading_std for noise in found]) == pytest.approx(math.radians(3), rel=0.05)
    assert np.mean([noise.odometry_translation_std for noise in found]) == pytest.approx(0.05, rel=0.25)
    assert np.mean([noise.odometry_rotation_std for noise in found]) == pytest.approx(math.radians(2), rel=0.25)
    assert all(noise.heading_bias == 0 for noise in found)


def test_given_noise_is_not_changed() -> None:
    noise = Fusion(drive(0).nodes(), SensorNoise(position_std=0.3, odometry_translation_std=0.2)).noise
    assert (noise.position_std, noise.odometry_translation_std) == (0.3, 0.2)
    assert noise.heading_std == pytest.approx(math.radians(3), rel=0.2)


@pytest.mark.parametrize(
    ("sensors", "metres", "degrees"),
    [
        ({"odometry": True, "gps": True, "compass": False}, 0.04, 6.0),
        ({"odometry": True, "gps": False, "compass": True}, 1.0, 0.9),
        ({"odometry": False, "gps": True, "compass": True}, 0.08, 4.0),
        ({"odometry": True, "gps": False, "compass": False}, 12.0, 180.0),
    ],
)
def test_any_sufficient_subset_of_the_sensors_gives_poses(
    sensors: dict[str, bool], metres: float, degrees: float
) -> None:
    driven = drive(3)
    nodes = driven.nodes(**sensors)
    if not sensors["gps"]:  # the position is known relative to the odometry's start only
        driven = replace(driven, truth=driven.truth - np.append(driven.truth[0, :2], 0.0))
    found = Fusion(nodes).smoothed()
    assert np.isfinite(found.poses).all() and np.isfinite(found.covariances).all()
    error = driven.errors(found)
    assert error[0] < metres and error[1] < math.radians(degrees)


def test_no_sensor_at_all_is_an_error() -> None:
    with pytest.raises(ValueError, match="no sensor"):
        FusionNodes.from_readings(np.arange(3), None, None, None)
    with pytest.raises(ValueError, match="within the time"):
        FusionNodes.from_readings(np.arange(3), Trajectory(np.array([10, 11]), np.zeros((2, 3))), None, None)


def test_outliers_among_fixes_and_headings_are_rejected() -> None:
    driven = drive(4)
    rng = np.random.default_rng(0)
    outlier = rng.random(len(driven.stamps)) < 0.05
    fixes, headings = driven.fixes.copy(), driven.headings.copy()
    fixes[outlier] += rng.normal(0, 5, (outlier.sum(), 2))
    headings[outlier] += 2.0
    clean, disturbed = Fusion(driven.nodes()), Fusion(replace(driven, fixes=fixes, headings=headings).nodes())
    found = disturbed.smoothed()
    assert driven.errors(found)[0] < 1.3 * driven.errors(clean.smoothed())[0]
    assert (found.decisions[outlier, 1] == REJECTED).all()
    assert found.reading_counts(0)[1] >= 0.8 * outlier.sum() and found.reading_counts(1)[1] < 1.3 * outlier.sum()


def test_filter_recovers_after_the_robot_was_carried_away() -> None:
    driven = drive(5)
    truth, fixes = driven.truth.copy(), driven.fixes.copy()
    truth[300:, 0] += 5
    fixes[300:, 0] += 5
    fusion = Fusion(replace(driven, fixes=fixes).nodes(), TRUE_NOISE)
    assert np.abs(fusion.filtered().poses[380:, :2] - truth[380:, :2]).max() < 0.4
    smoothed = fusion.smoothed().poses[:, :2]
    assert np.abs(smoothed - truth[:, :2])[np.r_[:299, 321:600]].max() < 0.25  # the smoother does not spread the jump


def test_filter_recovers_from_odometry_that_stands_still() -> None:
    driven = drive(11)
    frozen = Trajectory(driven.stamps, np.tile(driven.odometry.poses[:1], (len(driven.stamps), 1)))
    found = Fusion(replace(driven, odometry=frozen).nodes()).smoothed()
    metres, _ = driven.errors(found)
    assert metres < 0.5 and found.reading_counts(0)[1] < 0.5 * len(driven.stamps)
    assert np.sqrt(found.covariances[:, 0, 0]).mean() > 0.02


def test_noise_is_estimated_from_a_subset_of_readings_between_the_scans() -> None:
    options = FusionOptions(estimation=NoiseEstimationOptions(max_nodes=200))
    driven = drive(10)
    between = driven.stamps + SECOND // 20
    nodes = FusionNodes.from_readings(
        between, driven.odometry, (driven.stamps, driven.fixes), (driven.stamps, driven.headings)
    )
    assert Fusion(nodes, None, options).noise.position_std == pytest.approx(0.1, rel=0.15)


def test_compass_bias_is_estimated() -> None:
    driven = drive(6)
    fusion = Fusion(replace(driven, headings=wrap_angles(driven.headings + 0.2)).nodes())
    assert fusion.noise.heading_bias == pytest.approx(0.2, abs=0.08)
    assert driven.errors(fusion.smoothed())[1] < math.radians(4)


def test_lever_arm_of_the_antenna_is_accounted_for() -> None:
    driven = drive(7)
    at = np.array([0.3, -0.1])
    cos, sin = np.cos(driven.truth[:, 2]), np.sin(driven.truth[:, 2])
    fixes = driven.fixes + np.column_stack((cos * at[0] - sin * at[1], sin * at[0] + cos * at[1]))
    nodes = FusionNodes.from_readings(
        driven.stamps,
        driven.odometry,
        (driven.stamps, fixes),
        (driven.stamps, driven.headings),
        (float(at[0]), float(at[1])),
    )
    assert driven.errors(Fusion(nodes).smoothed())[0] < 0.032


def test_readings_between_the_scans_are_used_at_their_own_stamps() -> None:
    driven = drive(8)
    later = driven.stamps[:-1] + SECOND // 25
    truth, _ = Trajectory(driven.stamps, driven.truth).at(later)
    fixes = truth[:, :2] + driven.fixes[:-1] - driven.truth[:-1, :2]
    nodes = FusionNodes.from_readings(
        driven.stamps[::3], driven.odometry, (later, fixes), (driven.stamps, driven.headings)
    )
    found = Fusion(nodes).smoothed()
    at = np.searchsorted(found.stamps, driven.stamps[::3])
    assert pose_rmse(found.poses[at], driven.truth[::3])[0] < 0.034


@pytest.mark.parametrize("stride", [2, 7])
def test_subset_of_nodes_has_the_same_trajectory(stride: int) -> None:
    nodes = drive(9).nodes()
    thin = nodes.subset(np.arange(0, len(nodes.stamps), stride))
    assert integrate_steps(thin.steps)[-1] == pytest.approx(integrate_steps(nodes.steps)[::stride][-1], abs=1e-9)
    assert thin.variance_scales.sum() == pytest.approx(
        nodes.variance_scales[: stride * (len(thin.variance_scales) - 1) + 1].sum()
    )


def test_travelled_distance_includes_turns() -> None:
    turned = Trajectory(np.arange(3), np.array([[0, 0, 0], [0.3, 0.4, 0], [0.3, 0.4, 1.0]]))
    assert weighted_path_lengths(turned, 0.03) == pytest.approx([0, 0.5, 0.53])


def test_gates_reject_one_in_a_thousand() -> None:
    rng, options = np.random.default_rng(0), FusionOptions()
    assert np.mean((rng.standard_normal((100_000, 2)) ** 2).sum(axis=1) > options.fix_gate) == pytest.approx(
        0.001, abs=4e-4
    )
    assert np.mean(rng.standard_normal(100_000) ** 2 > options.heading_gate) == pytest.approx(0.001, abs=4e-4)


def wandering(rng: np.random.Generator, count: int, std: float, time: float, columns: int = 2) -> FloatArray:
    """Errors (count, columns) of a first-order Gauss-Markov process, ten a second."""
    left = math.exp(-0.1 / time)
    errors = rng.normal(0, std, (count, columns))
    errors[1:] *= math.sqrt(1 - left**2)
    for k in range(1, count):
        errors[k] += left * errors[k - 1]
    return errors


def test_smoother_of_wandering_errors_agrees_with_the_joint_posterior() -> None:
    """As without them: the problem is linear where the robot does not move."""
    rng = np.random.default_rng(3)
    count, std, time = 10, 0.4, 3.0
    stamps = np.arange(count) * SECOND
    still = Trajectory(stamps, np.tile([0.4, 0.2, 0.1], (count, 1)))
    fixes = 0.3 + rng.normal(0, 0.1, (count, 2))
    nodes = FusionNodes.from_readings(stamps, still, (stamps, fixes), (stamps, np.full(count, 0.1)))
    noise = np.ones(11)
    noise[:5] = 0.1, 0.05, 0.02, 0.03, 0.0
    noise[[7, 8, 9]] = std, time, 0.0
    output = filter_nodes(nodes, noise, FilterState(np.array([0.3, 0.3, 0.1]), 0.25 * np.eye(3)), FusionOptions())
    gains = np.zeros_like(output.covariances)
    smooth(output, gains)
    left = math.exp(-1 / time)
    # x and its error at each node: a random walk of the one, and a decay of the other
    information, vector = np.zeros((2 * count, 2 * count)), np.zeros(2 * count)
    for k in range(count):
        both = slice(2 * k, 2 * k + 2)
        information[both, both] += 100.0
        vector[both] += 100.0 * fixes[k, 0]
        walk = nodes.variance_scales[k] * 0.02**2 + 1e-10
        for at, kept, variance in (
            (2 * k, 1.0, 0.25 + walk if k == 0 else walk),
            (2 * k + 1, left, std**2 + 2e-10 if k == 0 else std**2 * (1 - left**2) + 1e-10),
        ):
            information[at, at] += 1 / variance
            if k:
                information[at - 2, at - 2] += kept**2 / variance
                information[at, at - 2] -= kept / variance
                information[at - 2, at] -= kept / variance
            elif at == 0:
                vector[0] += 0.3 / variance
    covariance = np.linalg.inv(information)
    mean = covariance @ vector
    assert output.means[:, [0, 3]].ravel() == pytest.approx(mean, abs=1e-6)
    for k in range(count):
        assert output.covariances[k][np.ix_([0, 3], [0, 3])] == pytest.approx(
            covariance[2 * k : 2 * k + 2, 2 * k : 2 * k + 2], rel=1e-5
        )


def test_wandering_errors_follow_what_is_learnt_of_the_pose() -> None:
    root = np.random.default_rng(0).normal(size=(6, 6))
    belief = FilterState(np.arange(6.0), root @ root.T)
    seen, variances = np.array([0.5, 0.7, 2.5]), np.diag([0.1, 0.2, 0.3])
    # a measurement of the pose by which its posterior is what is given
    before = belief.covariance[:3, :3]
    added = np.linalg.inv(variances) - np.linalg.inv(before)
    joint = np.linalg.inv(belief.covariance)
    joint[:3, :3] += added
    covariance = np.linalg.inv(joint)
    pull = np.linalg.solve(variances, seen) - np.linalg.solve(before, belief.mean[:3])
    mean = covariance @ (np.linalg.solve(belief.covariance, belief.mean) + np.append(pull, np.zeros(3)))
    found = belief.with_pose(seen, variances)
    assert found.mean == pytest.approx(mean) and found.covariance == pytest.approx(covariance)


@pytest.mark.parametrize("seed", range(3))
def test_wandering_fixes_are_found_and_reckoned_with(seed: int) -> None:
    driven = drive(seed, 2400)
    fixes = driven.fixes + wandering(np.random.default_rng(100 + seed), 2400, 0.5, 10.0)
    other = replace(driven, fixes=fixes)
    fusion = Fusion(other.nodes(), None)
    wander = fusion.noise.position_wander
    assert wander is not None and 0.25 < wander.std < 1 and 3 < wander.time < 40
    assert fusion.noise.position_std == pytest.approx(0.1, rel=0.15)
    found = fusion.smoothed()
    assert other.errors(found)[0] < 0.4 and pose_nees(found.poses, driven.truth, found.covariances) < 9
    assert Fusion(driven.nodes()).noise.position_wander is None


@pytest.mark.parametrize("seed", [17, 22])
def test_wandering_fixes_are_known_from_a_bad_odometry_by_what_a_receiver_states(seed: int) -> None:
    """A fix a second for a minute: by themselves they could be right, and the odometry ten times as bad as it is."""
    driven, rng = drive(seed), np.random.default_rng(seed)
    fixes = driven.truth[:, :2] + rng.normal(0, 0.05, (600, 2))
    fixes += wandering(np.random.default_rng(seed + 50), 600, 1.5, 60.0)
    readings = driven.stamps[::10], fixes[::10]
    stated = FusionNodes.from_readings(driven.stamps, driven.odometry, readings, None, fix_stds=np.full(60, 1.5))
    noise = Fusion(stated).noise
    assert noise.position_wander is not None and 0.5 < noise.position_wander.std < 3
    assert noise.odometry_translation_std == pytest.approx(0.05, rel=0.5)
    unknown = Fusion(replace(stated, stated_fix_std=None)).noise
    assert unknown.position_wander is None and unknown.odometry_translation_std > 0.2


def test_fixes_count_by_what_is_stated_of_each() -> None:
    driven, rng = drive(13), np.random.default_rng(13)
    stds = np.where(np.arange(600) % 200 < 100, 0.02, 1.0)
    other = replace(driven, fixes=driven.truth[:, :2] + stds[:, None] * rng.standard_normal((600, 2)))
    found = Fusion(other.nodes(fix_stds=stds)).smoothed()
    assert other.errors(found)[0] < 0.06 and pose_nees(found.poses, driven.truth, found.covariances) < 6


@pytest.mark.parametrize("seed", range(2))
def test_headings_of_an_imu_have_any_zero_and_drift(seed: int) -> None:
    driven = drive(seed)
    drift = np.cumsum(np.random.default_rng(seed).normal(0, 0.01, 600))
    other = replace(driven, headings=wrap_angles(driven.headings + drift - 2.0))
    found = Fusion(other.nodes(has_north=False)).smoothed()
    metres, radians = driven.errors(found)
    assert metres < 0.035 and radians < math.radians(5)
    assert pose_nees(found.poses, driven.truth, found.covariances) < 6


def test_scales_of_an_odometry_are_found_and_corrected() -> None:
    driven = drive(14, 1200)
    scaled = integrate_steps(relative_steps(driven.odometry.poses) * [1 / 1.1, 1 / 1.1, 1 / 0.9])
    other = replace(driven, odometry=Trajectory(driven.stamps, scaled))
    fusion = Fusion(other.nodes())
    assert fusion.noise.distance_scale == pytest.approx(1.1, abs=0.04)
    assert fusion.noise.turn_scale == pytest.approx(0.9, abs=0.02)
    assert other.errors(fusion.smoothed())[0] < 0.035
    assert Fusion(driven.nodes()).noise.distance_scale is None


def test_smoother_is_linear_about_the_headings_that_all_fixes_give() -> None:
    """By coarse fixes alone the heading is not known for a while, and what was guessed then must not bend the way."""
    rng = np.random.default_rng(15)
    angles = np.linspace(0, 2 * math.pi, 600)
    truth = np.column_stack((1.5 * np.sin(angles), 1.5 - 1.5 * np.cos(angles), angles + 1.2))
    cos, sin = math.cos(1.2), math.sin(1.2)
    truth[:, :2] = truth[:, :2] @ np.array([[cos, sin], [-sin, cos]])
    stamps = np.arange(600) * (SECOND // 10)
    fixes = truth[:, :2] + rng.normal(0, 0.7, (600, 2))
    odometry = Trajectory(stamps, integrate_steps(relative_steps(truth)))
    nodes = FusionNodes.from_readings(stamps, odometry, (stamps[::10], fixes[::10]), None)
    noise = SensorNoise(0.7, None, 0.002, 0.002)
    found = Fusion(nodes, noise).smoothed().poses
    seen = relative_poses(np.repeat(found[:1], 600, axis=0), found)
    expected = relative_poses(np.repeat(truth[:1], 600, axis=0), truth)
    assert np.abs(seen[:, :2] - expected[:, :2]).max() < 0.01


def test_gain_over_odometry_is_what_fixes_add() -> None:
    driven = drive(16)
    assert Fusion(driven.nodes()).gain_over_odometry() > 2
    coarse = replace(driven, fixes=driven.truth[:, :2] + np.random.default_rng(0).normal(0, 30, (600, 2)))
    assert Fusion(coarse.nodes(compass=False)).gain_over_odometry() < 1.05
    assert Fusion(driven.nodes(odometry=False)).gain_over_odometry() == math.inf
