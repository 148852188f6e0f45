"""The compiled kernels against plain loops."""

import math
from fractions import Fraction

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mapping.deterministic import DeterministicMapper
from mapping.grid import GridFrame, cell_of
from mapping.kernels import FREE, OCCUPIED, UNSEEN, mark_scan
from mapping.mapper import make_mapper
from mapping.probabilistic import ProbabilisticMapper, inverse_sensor_model, log_odds
from prim.scan import Scan
from prim.se2 import Pose2D


def bresenham(row: int, col: int, end_row: int, end_col: int) -> list[tuple[int, int]]:
    """Return the cells from start to end by the textbook's algorithm: integers and an error term."""
    d_row, d_col = abs(end_row - row), abs(end_col - col)
    step_row, step_col = (1 if end_row >= row else -1), (1 if end_col >= col else -1)
    steep = d_row > d_col
    major, minor = (d_row, d_col) if steep else (d_col, d_row)
    cells = [(row, col)]
    error = 2 * minor - major
    for _ in range(major):
        side = error >= 0
        error += 2 * minor - 2 * major * side
        row += step_row if steep else step_row * side
        col += step_col * side if steep else step_col
        cells.append((row, col))
    return cells


def mark_line(end_row: int, end_col: int, hit: bool, rows: int, cols: int, row: int, col: int) -> np.ndarray:
    """Return the states after one ray between the centres of (row, col) and (end_row, end_col); cells of 1 m."""
    states = np.full((rows, cols), UNSEEN, np.uint8)
    dx, dy = end_col - col, end_row - row
    z = math.hypot(dx, dy)
    direction = np.array([[dx / z, dy / z]]) if z else np.array([[1.0, 0.0]])
    limits = (0.0, 2 * z + 1) if hit else (0.0, z)
    ranges = np.array([max(z, 0.25) if hit else math.inf])
    mark_scan(states, (0, 0, 1.0), (ranges, direction, col + 0.5, row + 0.5, 1.0, 0.0, *limits))
    return states


CELLS = st.integers(-40, 60)


@given(CELLS, CELLS, CELLS, CELLS, st.booleans())
def test_lines_are_bresenham_lines_and_clipping_moves_no_cell(
    row: int, col: int, end_row: int, end_col: int, hit: bool
) -> None:
    if (row, col) == (end_row, end_col):
        return
    rows, cols = 20, 30
    expected = np.full((rows, cols), UNSEEN, np.uint8)
    line = bresenham(row, col, end_row, end_col)
    for r, c in line[:-1] if hit else line:
        if 0 <= r < rows and 0 <= c < cols:
            expected[r, c] = FREE
    if hit and 0 <= end_row < rows and 0 <= end_col < cols:
        expected[end_row, end_col] = OCCUPIED
    assert (mark_line(end_row, end_col, hit, rows, cols, row, col) == expected).all()


@given(st.integers(0, 3000), st.integers(0, 3000))
def test_long_lines_are_exact(end_row: int, end_col: int) -> None:
    if max(end_row, end_col) == 0:
        return
    states = mark_line(end_row, end_col, False, 3001, 3001, 0, 0)
    rows, cols = np.array(bresenham(0, 0, end_row, end_col)).T
    assert np.count_nonzero(states == FREE) == len(rows)
    assert (states[rows, cols] == FREE).all()


@given(st.integers(1, 700_000), st.data())
def test_fixed_point_offsets_are_exact(steps: int, data: st.DataObject) -> None:
    """Compare floor(k m / n + 1/2) in rational numbers with the kernel's arithmetic, up to its stated limit."""
    from mapping.kernels import HALF, SHIFT, fixed_point_slope

    minor, step = data.draw(st.integers(0, steps)), data.draw(st.integers(0, steps))
    slope = fixed_point_slope(minor, steps)
    exact = math.floor(Fraction(step * minor, steps) + Fraction(1, 2))
    assert (step * slope + HALF) >> SHIFT == exact


def test_a_ray_never_frees_the_cell_that_it_hits_nor_one_that_another_hits() -> None:
    rng = np.random.default_rng(0)
    mapper = DeterministicMapper(0.1, (-3, -3, 3, 3))
    scan = Scan(0, "laser", 0.0, 2 * math.pi / 400, 0.01, 9.0, rng.uniform(0.3, 2.8, 400).astype(np.float32))
    pose = Pose2D(0.03, -0.04, 0.3)
    mapper.update(scan, pose)
    grid = mapper.grid()
    for x, y in scan.points(pose):
        row, col = cell_of(y, 0.1) - grid.frame.row, cell_of(x, 0.1) - grid.frame.col
        assert grid.probability[row, col] == 1


@pytest.mark.parametrize(
    ("coordinate", "resolution", "cell"),
    [
        (0.3, 0.1, 3),
        (0.2998, 0.1, 2),
        (0.29999, 0.1, 3),
        (-0.3, 0.1, -3),
        (0.0, 0.1, 0),
        (1.0, 0.01, 100),
        (0.07, 0.01, 7),
        (-1e-12, 0.1, 0),
    ],
)
def test_a_border_belongs_to_the_cell_above(coordinate: float, resolution: float, cell: int) -> None:
    assert cell_of(coordinate, resolution) == cell


def test_frames_cover_their_bounds_exactly() -> None:
    frame = GridFrame.covering((-1.1, -0.3, 1.1, 0.7), 0.1)
    assert (frame.cols, frame.rows) == (22, 10)
    assert frame.bounds == pytest.approx((-1.1, -0.3, 1.1, 0.7))
    assert GridFrame.covering(frame.bounds, 0.1) == frame


def slow_log_odds(scan: Scan, pose: Pose2D, frame: GridFrame) -> np.ndarray:
    """Compute Eqs. 3 and 4 by plain loops: Bresenham's line to the end point, extended at its slope by 0.03 m."""
    odds = np.zeros(frame.shape)
    resolution = frame.resolution
    col, row = cell_of(pose.x, resolution), cell_of(pose.y, resolution)
    for z, bearing in zip(scan.ranges.tolist(), bearings_of(scan, pose), strict=True):
        if not (z >= scan.range_min and z > 0):
            continue
        hit = z < scan.range_max
        z = min(z, scan.range_max)
        dx, dy = math.cos(bearing), math.sin(bearing)
        d_col = cell_of(pose.x + z * dx, resolution) - col
        d_row = cell_of(pose.y + z * dy, resolution) - row
        within = d_col == d_row == 0
        along_x = abs(dx) >= abs(dy) if within else abs(d_col) >= abs(d_row)
        steps, minor = (abs(d_col), abs(d_row)) if along_x else (abs(d_row), abs(d_col))
        slope = Fraction(minor, steps) if steps else Fraction(min(abs(dx), abs(dy)) / max(abs(dx), abs(dy)))
        last = steps
        if hit:
            far = (pose.x + (z + 0.03) * dx, pose.y + (z + 0.03) * dy)
            last = abs(cell_of(far[0], resolution) - col) if along_x else abs(cell_of(far[1], resolution) - row)
        for step in range(last + 1):
            aside = math.floor(step * slope + Fraction(1, 2))
            at_col = col + (step if along_x else aside) * (1 if dx >= 0 else -1)
            at_row = row + (aside if along_x else step) * (1 if dy >= 0 else -1)
            r, c = at_row - frame.row, at_col - frame.col
            if 0 <= r < frame.rows and 0 <= c < frame.cols:
                centre = ((at_col + 0.5) * resolution - pose.x, (at_row + 0.5) * resolution - pose.y)
                d = math.hypot(*centre) - z if hit else -1.0
                odds[r, c] += log_odds(inverse_sensor_model(d))
    return odds


def bearings_of(scan: Scan, pose: Pose2D) -> list[float]:
    return [pose.theta + scan.angle_min + i * scan.angle_increment for i in range(len(scan.ranges))]


@pytest.mark.parametrize("resolution", [0.01, 0.05, 0.1, 0.2])
@settings(max_examples=25)
@given(seed=st.integers(0, 10**6))
def test_prob_agrees_with_plain_loops(resolution: float, seed: int) -> None:
    """On coarse grids too, where a ray may end in the cell that it starts from."""
    rng = np.random.default_rng(seed)
    ranges = (rng.random(12) ** 3 * 1.2).astype(np.float32)
    ranges[rng.random(12) < 0.2] = np.inf
    scan = Scan(0, "laser", -3.0, 0.5123, 0.005, 1.0, ranges)
    pose = Pose2D(*rng.uniform(-0.6, 0.6, 2), rng.uniform(-3, 3))
    mapper = ProbabilisticMapper(resolution, (-0.5, -0.5, 0.5, 0.5))
    mapper.update(scan, pose)
    expected = slow_log_odds(scan, pose, mapper.grid().frame)
    assert mapper.grid().probability == pytest.approx(1 / (1 + np.exp(-expected)), abs=2e-5)


@pytest.mark.parametrize("name", ["det", "prob"])
@pytest.mark.parametrize("far", [1e4, 167772.16, 1e6, 1e9, 1e18, 1e300, math.inf, math.nan])
def test_scans_from_far_off_the_grid_change_nothing(name: str, far: float) -> None:
    """A scan from beyond 2^21 cells is not used; nearer ones are clipped."""
    rng = np.random.default_rng(0)
    for x, y in ((far, 0.0), (-far, 0.3), (0.2, far), (-far, -far)):
        mapper = make_mapper(name, 0.01, (-1, -1, 1, 1))
        scan = Scan(0, "laser", -3.1, 0.0123, 0.01, 30.0, rng.uniform(0.1, 29, 500).astype(np.float32))
        mapper.update(scan, Pose2D(x, y, 0.3))
        assert (mapper.grid().probability == 0.5).all()


@pytest.mark.parametrize("name", ["det", "prob"])
def test_a_scanner_without_a_range_max_frees_to_the_bounds(name: str) -> None:
    mapper = make_mapper(name, 0.01, (-1, -1, 1, 1))
    ranges = np.array([np.inf, 0.5, 1e30], dtype=np.float32)
    mapper.update(Scan(0, "laser", 0.0, math.pi / 2, 0.01, math.inf, ranges), Pose2D(0.005, 0.005))
    grid = mapper.grid()
    assert grid.free[100, 100:].all()
    assert grid.occupied[150, 100]
    assert grid.free[100, 1:100].all()
