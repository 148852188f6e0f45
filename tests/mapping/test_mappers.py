"""The paper's mappers: cases computed by hand, and properties; the reference map."""

import math
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mapping.deterministic import DeterministicMapper
from mapping.grid import OccupancyGrid
from mapping.mapper import MAPPERS, make_mapper
from mapping.probabilistic import (
    ProbabilisticMapper,
    ProbabilisticOptions,
    gaussian_sensor_model,
    inverse_sensor_model,
    log_odds,
    probability_of,
)
from mapping.reference_map import ReferenceMap
from prim.errors import UsageError
from prim.scan import Scan
from prim.se2 import Pose2D
from prim.world import World
from recorder.sensors import Lidar
from recorder.session import Session

HERE = (-0.2, -0.2, 0.2, 0.2)
every = pytest.mark.parametrize("name", MAPPERS)
both = pytest.mark.parametrize("name", ["det", "prob"])


def row_at(grid: OccupancyGrid, y: float) -> np.ndarray:
    return grid.probability[round((y - grid.frame.origin[1]) / grid.frame.resolution - 0.5)]


@given(range_min=st.floats(0.15, 0.9), range_max=st.floats(1.0, 9.0))
@settings(max_examples=40)
def test_ranges_at_limits_are_classified_as_scans_do(range_min: float, range_max: float) -> None:
    """In single precision, in which a range at a limit is the limit."""
    for z in (range_min, range_max):
        scan = Scan(0, "laser", 0.0, 1.0, range_min, range_max, np.array([z], dtype=np.float32))
        mapper = DeterministicMapper(0.1)
        mapper.update(scan, Pose2D(0.05, 0.05))
        assert bool(mapper.grid().occupied.any()) == bool(scan.measured[0])


def test_eq_4() -> None:
    assert inverse_sensor_model(np.array([-1, -0.03, -0.02, -0.01, 0])) == pytest.approx([0.3, 0.3, 0.5, 0.7, 0.9])
    assert inverse_sensor_model(np.array([0.015, 0.03, 1])) == pytest.approx([0.7, 0.5, 0.5])


def test_the_parameters_of_eq_4_are_options() -> None:
    options = ProbabilisticOptions(free_probability=0.4, hit_probability=0.8, reach=0.1)
    assert inverse_sensor_model([-0.1, -0.05, 0.0, 0.1], options) == pytest.approx([0.4, 0.6, 0.8, 0.5])


def test_eqs_1_and_2_are_inverse() -> None:
    p = np.linspace(0.01, 0.99, 99)
    assert probability_of(log_odds(p)) == pytest.approx(p, rel=1e-6)
    assert log_odds(0.9) == pytest.approx(2.1972246)


def test_one_ray_along_the_x_axis(make_scan: Callable[..., Scan]) -> None:
    """From the centre of cell 0, cell k lies 0.01 k m away; z = 0.10 m, so d = 0.01 k - 0.10."""
    scan, pose = make_scan(0.10), Pose2D(0.005, 0.005)
    det, prob = DeterministicMapper(0.01, HERE), ProbabilisticMapper(0.01, HERE)
    det.update(scan, pose)
    prob.update(scan, pose)
    cells = slice(20, 35)
    expected = [0.3] * 8 + [0.5, 0.7, 0.9, 0.9 - 0.4 / 3, 0.9 - 0.8 / 3, 0.5, 0.5]
    assert row_at(prob.grid(), 0.005)[cells] == pytest.approx(expected, abs=1e-5)
    assert row_at(det.grid(), 0.005)[cells].tolist() == [0] * 10 + [1] + [0.5] * 4
    for mapper in (det, prob):
        touched = mapper.grid().probability != 0.5
        assert not np.delete(touched, 20, axis=0).any()


def test_log_odds_add_up(make_scan: Callable[..., Scan]) -> None:
    """Two rays at 0.3 and one at 0.9: l = 2 l(0.3) + l(0.9) (Eq. 3, its signs put right)."""
    prob = ProbabilisticMapper(0.01, HERE)
    pose = Pose2D(0.005, 0.005)
    for z in (0.16, 0.16, 0.10):
        prob.update(make_scan(z), pose)
    odds = (0.3 / 0.7) ** 2 * 9
    assert row_at(prob.grid(), 0.005)[30] == pytest.approx(odds / (1 + odds), abs=1e-5)


def test_distance_is_to_the_cells_centre_off_the_axes(make_scan: Callable[..., Scan]) -> None:
    """A diagonal ray from a cell's centre: diagonal cell k lies 0.01 sqrt(2) k away."""
    prob = ProbabilisticMapper(0.01, HERE)
    prob.update(make_scan(0.1, angle_min=math.pi / 4), Pose2D(0.005, 0.005))
    k = np.arange(15)
    expected = inverse_sensor_model(0.01 * math.sqrt(2) * k - 0.1)
    expected[k * 0.01 * math.sqrt(2) > 0.13] = 0.5
    assert np.diag(prob.grid().probability)[20:35] == pytest.approx(expected, abs=1e-5)


@pytest.mark.parametrize("bearing", [0, 1, 2, 3])
def test_rays_that_end_on_a_border_end_in_the_cell_above_it(bearing: int, make_scan: Callable[..., Scan]) -> None:
    """From (0.05, 0.05), a border of cells of 0.01 m, 0.1 m along each axis."""
    det = DeterministicMapper(0.01, HERE)
    det.update(make_scan(0.1, angle_min=bearing * math.pi / 2), Pose2D(0.05, 0.05))
    ends = {0: (0.15, 0.05), 1: (0.05, 0.15), 2: (-0.05, 0.05), 3: (0.05, -0.05)}
    (centre,) = det.grid().frame.centres(det.grid().occupied)
    assert centre == pytest.approx(np.array(ends[bearing]) + 0.005, abs=1e-9)


@both
def test_no_return_frees_up_to_range_max_and_marks_nothing(name: str, make_scan: Callable[..., Scan]) -> None:
    for z in (math.inf, 0.1, 7.0):
        mapper = make_mapper(name, 0.01, HERE)
        mapper.update(make_scan(z, range_max=0.1), Pose2D(0.005, 0.005))
        row = row_at(mapper.grid(), 0.005)
        free = 0.0 if name == "det" else 0.3
        assert row[20:31] == pytest.approx([free] * 11, abs=1e-6)
        assert (row[31:] == 0.5).all()
        assert np.count_nonzero(mapper.grid().probability != 0.5) == 11


@both
@pytest.mark.parametrize("z", [math.nan, -math.inf, 0.0, -1.0, 0.009])
def test_ranges_that_are_no_measurements_change_nothing(name: str, z: float, make_scan: Callable[..., Scan]) -> None:
    mapper = make_mapper(name, 0.01, HERE)
    mapper.update(make_scan(z), Pose2D())
    assert (mapper.grid().probability == 0.5).all()


@both
def test_rays_from_outside_the_grid(name: str, make_scan: Callable[..., Scan]) -> None:
    mapper = make_mapper(name, 0.01, HERE)
    mapper.update(make_scan(1.0), Pose2D(-0.995, 0.005))
    row = row_at(mapper.grid(), 0.005)
    assert (row[:17] < 0.5).all()
    assert row[20] > 0.5
    mapper.update(make_scan(1.0, 1.0, 1.0, 1.0), Pose2D(50, 50))
    assert row_at(mapper.grid(), 0.005) == pytest.approx(row)


@every
def test_cells_behind_the_laser_do_not_change(name: str, make_scan: Callable[..., Scan]) -> None:
    mapper = make_mapper(name, 0.01, HERE)
    mapper.update(make_scan(1.0), Pose2D(0.305, 0.005))
    assert (mapper.grid().probability == 0.5).all()


def test_det_keeps_the_last_scan(make_scan: Callable[..., Scan]) -> None:
    det = DeterministicMapper(0.01, HERE)
    pose = Pose2D(0.005, 0.005)
    det.update(make_scan(0.10), pose)
    det.update(make_scan(0.15), pose)
    row = row_at(det.grid(), 0.005)
    assert (row[30], row[35]) == (0, 1)
    det.update(make_scan(0.10), pose)
    assert row_at(det.grid(), 0.005)[30] == 1


def random_scans(seed: int, count: int) -> list[tuple[Scan, Pose2D]]:
    rng = np.random.default_rng(seed)
    scans = []
    for _ in range(count):
        ranges = rng.uniform(0.0, 2.2, 90).astype(np.float32)
        ranges[rng.random(90) < 0.1] = rng.choice([np.nan, np.inf, -np.inf])
        scan = Scan(0, "laser", -math.pi, 2 * math.pi / 90, 0.05, 2.0, ranges)
        scans.append((scan, Pose2D(*rng.uniform(-1, 1, 2), rng.uniform(-4, 4))))
    return scans


@both
@settings(max_examples=20)
@given(seed=st.integers(0, 10**6))
def test_growing_and_given_bounds_agree(name: str, seed: int) -> None:
    """Rays that end: the grown map is the same as the one that had room from the start."""
    scans = random_scans(seed, 6)
    growing, given_bounds = make_mapper(name, 0.05), make_mapper(name, 0.05, (-4, -4, 4, 4))
    for scan, pose in scans:
        ends = Scan(**{f: getattr(scan, f) for f in scan.__slots__} | {"range_max": 9.0})
        ends.ranges[~np.isfinite(ends.ranges)] = np.nan
        growing.update(ends, pose)
        given_bounds.update(ends, pose)
    small, large = growing.grid(), given_bounds.grid()
    window = large.frame.window(small.frame)
    assert (large.probability[window] == small.probability).all()
    if name == "det":  # prob also reaches 0.03 m behind end points, beyond the grown bounds
        assert np.count_nonzero(large.probability != 0.5) == np.count_nonzero(small.probability != 0.5)


@both
@settings(max_examples=20)
@given(seed=st.integers(0, 10**6))
def test_clipping_changes_no_cell_inside(name: str, seed: int) -> None:
    small, large = make_mapper(name, 0.05, (-0.5, -0.4, 0.3, 0.7)), make_mapper(name, 0.05, (-4, -4, 4, 4))
    for scan, pose in random_scans(seed, 4):
        small.update(scan, pose)
        large.update(scan, pose)
    window = large.grid().frame.window(small.grid().frame)
    assert (large.grid().probability[window] == small.grid().probability).all()


@every
def test_grid_is_a_snapshot(name: str) -> None:
    mapper = make_mapper(name, 0.05, (-2, -2, 2, 2))
    (first, second) = random_scans(1, 2)
    mapper.update(*first)
    grid = mapper.grid()
    before = grid.probability.copy()
    mapper.update(*second)
    assert (grid.probability == before).all()
    assert (mapper.finish().probability != before).any()


def test_prob_does_not_depend_on_the_order_of_scans() -> None:
    ahead, back = make_mapper("prob", 0.05, (-2, -2, 2, 2)), make_mapper("prob", 0.05, (-2, -2, 2, 2))
    scans = random_scans(3, 10)
    for scan, pose in scans:
        ahead.update(scan, pose)
    for scan, pose in reversed(scans):
        back.update(scan, pose)
    assert ahead.grid().probability == pytest.approx(back.grid().probability, abs=1e-5)


def test_unknown_mappers_and_too_large_grids_are_refused() -> None:
    with pytest.raises(UsageError, match="det, prob"):
        make_mapper("fancy", 0.1)
    with pytest.raises(UsageError, match="million cells"):
        make_mapper("det", 0.001, (-50, -50, 50, 50))


def map_of(session: Session, name: str, scans: int | None = None) -> tuple[OccupancyGrid, ReferenceMap]:
    """Return a session's map at the session's own poses, and its reference map."""
    from prim.log import open_log
    from replay.poses.pose_provider import PoseProvider
    from replay.scans.scan_log import ScanLog
    from replay.scans.selection import Selection

    mapper = make_mapper(name, 0.01, (-1.1, -1.1, 1.1, 1.1))
    truth = ReferenceMap(mapper.grid().frame)
    with open_log(session.path) as log:
        scan_log = ScanLog(log, Selection(n_scans=scans))
        poses = PoseProvider(log).laser_poses(scan_log.times, "truth")
        for position, scan in scan_log:
            pose = Pose2D(*poses.poses[position].tolist())
            mapper.update(scan, pose)
            truth.update(scan, pose, session.world)
    return mapper.finish(), truth


def test_det_without_noise(quiet_session: Session) -> None:
    """Precision and free accuracy of the session; recall of one scan, since later grazing rays erase cells."""
    grid, truth = map_of(quiet_session, "det")
    scores = truth.score(grid.probability)
    assert scores.occupied_precision is not None and scores.occupied_precision >= 0.99
    assert scores.free_accuracy is not None and scores.free_accuracy >= 0.995
    assert scores.occupied_recall is not None and scores.occupied_recall >= 0.8
    grid, truth = map_of(quiet_session, "det", scans=1)
    recall = truth.score(grid.probability).occupied_recall
    assert recall is not None and recall >= 0.99


def test_prob_without_noise(quiet_session: Session) -> None:
    grid, truth = map_of(quiet_session, "prob")
    scores = truth.score(grid.probability)
    assert scores.occupied_recall is not None and scores.occupied_recall >= 0.99
    assert scores.free_accuracy is not None and scores.free_accuracy >= 0.995
    assert scores.auc is not None and scores.auc >= 0.999


def test_the_reference_map_of_an_empty_room_is_its_walls() -> None:
    room = World((2.0, 2.0)).with_walls()
    mapper = make_mapper("det", 0.01, (-1.1, -1.1, 1.1, 1.1))
    truth = ReferenceMap(mapper.grid().frame)
    lidar = Lidar(noise_std=0.0, rays=4000)
    scan = lidar.measure(room, Pose2D(0.003, 0.004), 0, 0.1, np.random.default_rng(0))
    truth.update(scan, Pose2D(0.003, 0.004), room)
    centres = mapper.grid().frame.centres(truth.occupied)
    assert np.abs(np.abs(centres).max(axis=1) - 1.0).max() <= 0.0051
    assert np.abs(mapper.grid().frame.centres(truth.free)).max() < 0.99
    assert not (truth.occupied & truth.free).any()


def test_the_gaussian_sensor_model() -> None:
    std = 0.2
    assert gaussian_sensor_model(0.0, std) == pytest.approx(0.9)
    at_one = math.exp(-0.5)
    assert gaussian_sensor_model([-std, std], std) == pytest.approx([0.3 + 0.6 * at_one, 0.5 + 0.4 * at_one])
    assert gaussian_sensor_model([-10.0, 10.0], std) == pytest.approx([0.3, 0.5])


def test_the_gaussian_map_is_the_model_along_a_ray() -> None:
    mapper = make_mapper("prob", 0.01, (-0.005, -0.1, 2.0, 0.1), "gaussian", 0.1)
    mapper.update(Scan(0, "laser", 0.0, 0.1, 0.03, 5.0, np.array([1.0], np.float32)), Pose2D())
    grid = mapper.grid()
    x = (np.arange(grid.frame.cols) + grid.frame.col + 0.5) * 0.01
    within = (x > 0.02) & (x < 1.38)
    found = row_at(grid, 0.005)
    assert found[within] == pytest.approx(gaussian_sensor_model(x[within] - 1.0, 0.1), abs=2e-3)
    assert (found[x > 1.45] == 0.5).all()


@pytest.mark.parametrize(("first_beam", "state"), [(1, 1.0), (0, 0.0)])
def test_end_points_of_a_scan_are_marked_after_the_rays_of_all_its_pieces(
    make_scan: Callable[..., Scan], first_beam: int, state: float
) -> None:
    mapper = DeterministicMapper(0.02, (-1.0, -1.0, 1.0, 1.0))
    mapper.update(make_scan(0.41), Pose2D(0.01, 0.01))
    mapper.update(replace(make_scan(0.81), first_beam=first_beam), Pose2D(0.01, 0.01))
    row = row_at(mapper.grid(), 0.01)
    assert (row[71], row[91]) == (state, 1.0)
