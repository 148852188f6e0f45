"""Loops: the graph and its marginals against dense ones, robust edges, loops that close, places that look alike."""

from __future__ import annotations

import itertools
import math
from dataclasses import replace

import numpy as np
import pytest

from prim.arrays import FloatArray
from prim.scan import PosedScan
from prim.se2 import Pose2D, compose_poses, integrate_steps, relative_poses, relative_steps, wrap_angles
from prim.world import Wall, World
from recorder.odometry import Odometry, OdometryNoise
from recorder.sensors import Lidar
from replay.poses.loops.block_cholesky import BlockCholesky, elimination_pattern
from replay.poses.loops.candidates import LoopCandidate, MotionCovariances, candidates, largest_variance
from replay.poses.loops.consistency import connected, count_stretches, supported
from replay.poses.loops.graph_edges import step_edges
from replay.poses.loops.kernels import EdgeArrays
from replay.poses.loops.loop_closing import ClosedLoops, LoopCloser
from replay.poses.loops.loop_errors import LoopErrors
from replay.poses.loops.loop_search import Loop, LoopRejection, LoopSearch
from replay.poses.loops.options import DEFAULTS, GraphOptions
from replay.poses.loops.pose_graph import GEMAN_MCCLURE, HUBER, PoseGraph
from replay.poses.loops.submaps import Keyframes, Submaps
from replay.poses.tracking.kernels import Excluded, Window
from replay.poses.tracking.laser_track import loop_notes
from replay.poses.tracking.options import DEFAULTS as TRACKING
from replay.poses.tracking.points import scan_points, thinned
from replay.poses.tracking.scan_tracker import ScanTracker, track

SECOND = 10**9
LIDAR = Lidar(rays=240, range_min=0.1, range_max=8.0, noise_std=0.01)
INFORMATION = np.diag([5e4, 5e4, 2e5])
"""Of a scan that matches well."""


def random_graph(seed: int, count: int = 14) -> tuple[FloatArray, EdgeArrays]:
    """Poses (N, 3) on a way, and edges between them that do not quite fit."""
    rng = np.random.default_rng(seed)
    poses = integrate_steps(rng.normal([0.5, 0, 0.2], [0.1, 0.1, 0.3], (count, 3)))
    poses -= poses[0]
    pairs = [(k, k + 1) for k in range(count - 1)] + [(k, k + 4) for k in range(count - 4)] + [(9, 1), (0, count - 1)]
    first, last = np.array(pairs, np.intp).T
    motions = relative_poses(poses[first], poses[last]) + rng.normal(0, 0.05, (len(pairs), 3))
    roots = rng.normal(0, 1, (len(pairs), 3, 3)) + 3 * np.eye(3)
    return poses, EdgeArrays(first, last, motions, roots @ roots.transpose(0, 2, 1))


def dense_residuals(poses: FloatArray, edges: EdgeArrays) -> FloatArray:
    """Whitened residuals (3 E,)."""
    apart = relative_poses(poses[edges.first], poses[edges.last]) - edges.motions
    apart[:, 2] = wrap_angles(apart[:, 2])
    roots = np.linalg.cholesky(edges.information)
    return np.asarray(np.einsum("eji,ej->ei", roots, apart).ravel())


def dense_slopes(poses: FloatArray, edges: EdgeArrays) -> FloatArray:
    """Slopes (3 E, 3 N) by central differences."""
    columns = []
    for k in range(poses.size):
        step = np.zeros(poses.size)
        step[k] = 1e-6
        up, down = (dense_residuals(poses + sign * step.reshape(poses.shape), edges) for sign in (1, -1))
        columns.append((up - down) / 2e-6)
    return np.array(columns).T


def dense_covariance(poses: FloatArray, edges: EdgeArrays) -> FloatArray:
    """The covariance (N, 3, N, 3) of all poses, the first one known to 1e-5."""
    slopes = dense_slopes(poses, edges)
    information = slopes.T @ slopes
    information[:3, :3] += np.eye(3) / GraphOptions().first_std ** 2
    count = len(poses)
    return np.asarray(np.linalg.inv(information).reshape(count, 3, count, 3))


@pytest.mark.parametrize("seed", range(4))
def test_the_optimum_of_a_graph_is_that_of_dense_least_squares(seed: int) -> None:
    poses, edges = random_graph(seed)
    graph = PoseGraph(poses, edges, np.zeros(len(edges.first), bool), GraphOptions(tolerance=1e-12))
    graph.optimise(HUBER)
    dense = poses.copy()
    for _ in range(30):
        slopes = dense_slopes(dense, edges)[:, 3:]
        dense[1:] -= np.linalg.lstsq(slopes, dense_residuals(dense, edges))[0].reshape(-1, 3)
    assert graph.poses == pytest.approx(dense, abs=1e-6)
    assert graph.squares.sum() == pytest.approx((dense_residuals(dense, edges) ** 2).sum())
    assert graph.squares.sum() < (dense_residuals(poses, edges) ** 2).sum()


@pytest.mark.parametrize("seed", range(4))
def test_marginals_and_columns_are_those_of_the_dense_inverse(seed: int) -> None:
    poses, edges = random_graph(seed)
    graph = PoseGraph(poses, edges, np.zeros(len(edges.first), bool), GraphOptions())
    factor, dense = graph.factor(), dense_covariance(poses, edges)
    for k, block in enumerate(factor.marginals()):
        assert block == pytest.approx(dense[k, :, k], rel=1e-4, abs=1e-9)
    assert factor.column(5) == pytest.approx(dense[:, :, 5], rel=1e-4, abs=1e-9)


def test_covariances_of_motions_are_those_of_dense_poses() -> None:
    poses, edges = random_graph(3)
    graph = PoseGraph(poses, edges, np.zeros(len(edges.first), bool), GraphOptions())
    found = MotionCovariances(poses, graph.factor()).to(9, np.array([2, 6]))
    dense = dense_covariance(poses, edges)
    for other, block in zip((2, 6), found, strict=True):
        both = np.block([[dense[a, :, b] for b in (other, 9)] for a in (other, 9)])
        slopes = np.empty((3, 6))
        for k, node in enumerate((other, 9)):
            for axis in range(3):
                step = np.zeros_like(poses)
                step[node, axis] = 1e-6
                seen = [relative_poses((poses + s * step)[[other]], (poses + s * step)[[9]])[0] for s in (1, -1)]
                slopes[:, 3 * k + axis] = (seen[0] - seen[1]) / 2e-6
        assert block == pytest.approx(slopes @ both @ slopes.T, rel=1e-4, abs=1e-9)


def test_a_matrix_that_is_not_positive_definite_is_found_out() -> None:
    pattern = elimination_pattern(2, np.array([0]), np.array([1]))
    assert BlockCholesky(pattern, np.repeat(np.eye(3)[None], 2, axis=0), 0.5 * np.eye(3)[None]).is_positive
    assert not BlockCholesky(pattern, np.repeat(np.eye(3)[None], 2, axis=0), 2.0 * np.eye(3)[None]).is_positive


def square_way(drift: float = 0.0) -> FloatArray:
    """Poses (80, 3) twice round a square of 10 m, with a bias of the heading (rad) at each step."""
    steps = np.tile([1.0, 0.0, 0.0], (80, 1))
    steps[::10, 2] = math.pi / 2
    steps[0] = 0.0
    steps[1:, 2] += drift
    return integrate_steps(steps)


def way_graph(loops: list[tuple[int, int, FloatArray]], is_robust: bool = True) -> PoseGraph:
    """A graph of steps with a bias, and loops."""
    given = square_way(math.radians(0.4))
    first = np.concatenate((np.arange(79), [loop[0] for loop in loops])).astype(np.intp)
    last = np.concatenate((np.arange(1, 80), [loop[1] for loop in loops])).astype(np.intp)
    motions = np.vstack([relative_poses(given[:-1], given[1:]), *(loop[2] for loop in loops)])
    information = np.repeat(np.diag([1e3, 1e3, 1e4])[None], len(first), axis=0)
    robust = np.arange(len(first)) >= 79
    return PoseGraph(given, EdgeArrays(first, last, motions, information), robust & is_robust, GraphOptions())


def test_robust_edges_reject_false_loops_and_keep_true_ones() -> None:
    true = square_way()
    loops = [(k, k + 40, relative_poses(true[[k]], true[[k + 40]])[0]) for k in range(4, 40, 4)]
    false = [(8, 33, np.zeros(3)), (12, 61, np.array([0.5, 0.0, 1.0])), (3, 71, np.zeros(3))]
    graph = way_graph(loops + false)
    graph.optimise(HUBER)
    graph.optimise(GEMAN_MCCLURE)
    assert (graph.weights[79:88] > 0.5).all() and (graph.weights[88:] < 0.05).all()
    away = np.hypot(*(graph.poses - true)[:, :2].T)
    drifted = np.hypot(*(square_way(math.radians(0.4)) - true)[:, :2].T)
    assert away.max() < 0.3 * drifted.max()
    believed = way_graph(loops + false, is_robust=False)
    believed.optimise(HUBER)
    assert np.hypot(*(believed.poses - true)[:, :2].T).max() > 2 * away.max(), "without robust edges it is bent"


def keyframes_of(
    poses: FloatArray, walls: list[Wall], seed: int = 0, given: FloatArray | None = None, broken: int | None = None
) -> Keyframes:
    """Keyframes at poses (N, 3) between walls; the track has other poses where they are given."""
    rng, reach = np.random.default_rng(seed), 2 * float(np.abs(walls).max()) + 2
    world = World((reach, reach), (), tuple(walls))
    points = []
    for pose in poses:
        scan = LIDAR.measure(world, Pose2D(*pose.tolist()), SECOND, 0.1, rng)
        found = scan_points(PosedScan(0, scan, Pose2D(), [(scan, Pose2D())]), 0.01, TRACKING.points)
        points.append(thinned(found, TRACKING.points.fine))
    at = poses if given is None else given
    seen = relative_poses(np.repeat(at[:1], len(at), axis=0), at)
    information = np.repeat(INFORMATION[None], len(at), axis=0)
    nothing = np.zeros(len(at), bool)
    lost = nothing if broken is None else np.arange(len(at)) == broken
    return Keyframes(points, seen, information, None, lost, nothing)


def ring(seed: int = 1) -> list[Wall]:
    """Corridors of 2 m round a block of 12 m by 8 m, with boxes at their walls."""
    rng = np.random.default_rng(seed)
    walls: list[Wall] = []
    for x0, y0, x1, y1 in ((-1, -1, 13, 9), (1, 1, 11, 7)):
        corners = [(x0, y0), (x1, y0), (x1, y1), (x0, y1), (x0, y0)]
        walls += [(*a, *b) for a, b in itertools.pairwise(corners)]
    for x, y in zip(rng.uniform(1.5, 10.5, 14), rng.choice([-1, 0.6, 7, 8.6], 14), strict=True):
        w = rng.uniform(0.2, 0.8)
        walls += [(x, y, x + w, y), (x + w, y, x + w, y + 0.4), (x + w, y + 0.4, x, y + 0.4), (x, y + 0.4, x, y)]
    return walls


def round_ring(laps: float, step: float = 0.2) -> FloatArray:
    """Poses (N, 3) along the middle of the corridors, from the middle of one on."""
    poses: list[FloatArray] = []
    heading, at = 0.0, np.array([3.0, 0.0])
    corners = [np.array(c, float) for c in ((12, 0), (12, 8), (0, 8), (0, 0))]
    left = laps * 40.0
    for corner in itertools.cycle(corners):
        length = float(np.hypot(*(corner - at)))
        count = round(min(length, left) / step)
        along = np.arange(count)[:, None] * step * np.array([math.cos(heading), math.sin(heading)])
        poses.append(np.column_stack((at + along, np.full(count, heading))))
        left -= length
        if left <= 0:
            return np.vstack(poses)
        turns = heading + np.arange(9) * math.radians(10)
        poses.append(np.column_stack((np.tile(corner, (9, 1)), turns)))
        heading, at = heading + math.pi / 2, corner
    raise AssertionError


def drifted(poses: FloatArray, turn: float = math.radians(0.02)) -> FloatArray:
    """The same poses with a bias of the heading at each step."""
    steps = relative_steps(poses)
    steps[1:, 2] += turn
    return integrate_steps(steps, poses[0])


def rmse(poses: FloatArray, true: FloatArray) -> float:
    """Of positions (m), in the frame of the first pose."""
    seen = relative_poses(np.repeat(true[:1], len(true), axis=0), true)
    return float(np.sqrt(np.mean(np.sum((poses - seen)[:, :2] ** 2, axis=1))))


def wrong(closed: ClosedLoops, true: FloatArray) -> int:
    """How many loops are off by 0.3 m or 3 degrees."""
    count = 0
    for loop in closed.loops:
        apart = loop.motion - relative_poses(true[[loop.first]], true[[loop.last]])[0]
        count += math.hypot(*apart[:2]) > 0.3 or abs(wrap_angles(apart[2:])[0]) > math.radians(3)
    return count


@pytest.fixture(scope="module")
def lap() -> tuple[Keyframes, FloatArray, ClosedLoops]:
    """Keyframes of a lap and a third with drift, their true poses, and what is closed."""
    true = round_ring(1.3)
    keyframes = keyframes_of(true, ring(), given=drifted(true))
    return keyframes, true, LoopCloser(keyframes).run()


def test_a_loop_closes(lap: tuple[Keyframes, FloatArray, ClosedLoops]) -> None:
    keyframes, true, closed = lap
    assert rmse(keyframes.poses, true) > 0.3
    assert rmse(closed.poses, true) < 0.05
    assert 1 <= closed.closed <= 3 and len(closed.loops) > 10
    assert wrong(closed, true) == 0
    assert (closed.connected == 0).all()


def test_covariances_hold_what_a_loop_says(lap: tuple[Keyframes, FloatArray, ClosedLoops]) -> None:
    """Far from the start they shrink; a place that is recognised is known better than what lies half round."""
    keyframes, true, closed = lap
    edges, robust = step_edges(keyframes, GraphOptions())
    before = PoseGraph(keyframes.poses, edges, robust, GraphOptions()).factor().marginals()
    after = closed.graph.factor().marginals()
    assert largest_variance(after)[-1] < 0.1 * largest_variance(before)[-1]
    count = len(true)
    errors = LoopErrors.by_graph(closed.poses, np.zeros((count, 3, 3)), range(count), closed.graph, 1e-5)
    first, last = np.array([10, 10]), np.array([110, count - 10])
    spread = errors.between(first, last)
    motions = MotionCovariances(closed.graph.poses, closed.graph.factor())
    for a, b, block in zip(first, last, spread, strict=True):
        assert block == pytest.approx(motions.to(int(b), np.array([a]))[0], rel=1e-3, abs=1e-9)
    assert largest_variance(spread)[1] < largest_variance(spread)[0]
    apart = relative_poses(closed.poses[first], closed.poses[last]) - relative_poses(true[first], true[last])
    apart[:, 2] = wrap_angles(apart[:, 2])
    assert (np.einsum("ni,nij,nj->n", apart, np.linalg.inv(spread), apart) < 16).all()
    assert errors.since_first()[0] == pytest.approx(1e-10 * np.eye(3))


def test_a_place_beyond_the_covariance_is_not_searched(lap: tuple[Keyframes, FloatArray, ClosedLoops]) -> None:
    keyframes, _, _ = lap
    edges, robust = step_edges(keyframes, GraphOptions())
    factor = PoseGraph(keyframes.poses, edges, robust, GraphOptions()).factor()
    submaps = Submaps(keyframes, keyframes.poses, DEFAULTS)
    covariances = MotionCovariances(keyframes.poses, factor)
    assert not candidates(100, submaps, covariances, DEFAULTS), "half round nothing is near"
    (nearest, *_) = candidates(len(keyframes.poses) - 40, submaps, covariances, DEFAULTS)
    assert nearest.submap < 60
    assert DEFAULTS.least_window[0] < nearest.reach < DEFAULTS.most_window[0]
    twice = replace(DEFAULTS, deviations=2 * DEFAULTS.deviations)
    assert candidates(nearest.chunk, submaps, covariances, twice)[0].reach == pytest.approx(2 * nearest.reach)


def test_a_lost_piece_is_recognised_wherever_it_was_put() -> None:
    true = round_ring(2.0)
    given, half = true.copy(), len(true) // 2
    moved = np.tile([7.0, -30.0, 2.5], (len(true) - half, 1))
    given[half:] = compose_poses(moved, true[half:])
    closed = LoopCloser(keyframes_of(true, ring(), given=given, broken=half)).run()
    assert rmse(closed.poses, true) < 0.05
    assert wrong(closed, true) == 0 and (closed.connected == 0).all()


def corridor(spacing: float | None) -> list[Wall]:
    """A corridor of 2 m by 40 m, with posts at its walls."""
    walls: list[Wall] = [(-20, -1, 20, -1), (20, 1, -20, 1)]
    for x in np.arange(-19, 19, spacing).tolist() if spacing else []:
        for y in (-1, 0.8):
            walls += [(x, y, x, y + 0.2), (x + 0.4, y, x + 0.4, y + 0.2)]
            walls.append((x, y + 0.2 if y < 0 else y, x + 0.4, y + 0.2 if y < 0 else y))
    return walls


@pytest.mark.parametrize("spacing", [None, 2.0])
def test_places_that_look_alike_are_ambiguous(spacing: float | None) -> None:
    true = np.column_stack((np.linspace(-14, 14, 141), np.zeros(141), np.zeros(141)))
    submaps = Submaps(keyframes_of(true, corridor(spacing)), true, DEFAULTS)
    guess = np.array([0.3, 0.0, 0.0])
    assert LoopSearch(submaps, DEFAULTS).find(LoopCandidate(70, 70, guess, 3.0, 0.1)) == LoopRejection.AMBIGUOUS


def test_a_place_like_no_other_is_found_far_from_where_it_was_expected() -> None:
    true = round_ring(1.0)
    submaps = Submaps(keyframes_of(true, ring()), true, DEFAULTS)
    loop = LoopSearch(submaps, DEFAULTS).find(LoopCandidate(48, 40, np.array([-0.6, 1.0, 0.3]), 2.0, 0.5))
    assert isinstance(loop, Loop)
    assert loop.motion == pytest.approx(relative_poses(true[[40]], true[[48]])[0], abs=0.03)
    elsewhere = LoopSearch(submaps, DEFAULTS).find(LoopCandidate(100, 40, np.zeros(3), 2.0, 0.5))
    assert not isinstance(elsewhere, Loop)


@pytest.mark.parametrize("spacing", [None, 2.0])
def test_no_loop_closes_in_a_corridor_that_is_driven_once(spacing: float | None) -> None:
    true = np.column_stack((np.linspace(-18, 18, 181), np.zeros(181), np.zeros(181)))
    keyframes = keyframes_of(true, corridor(spacing), given=drifted(true))
    closed = LoopCloser(keyframes).run()
    assert not closed.loops and not closed.closed
    assert np.array_equal(closed.poses, keyframes.poses), "a track without loops stays as it is"


def test_no_loop_closes_where_corridors_look_alike() -> None:
    """Up one corridor and down another that looks the same, 5 m beside it."""
    up = np.column_stack((np.linspace(-18, 18, 181), np.zeros(181), np.zeros(181)))
    down = up[::-1] + np.array([0.0, 5.0, math.pi])
    across = np.column_stack((np.full(24, 18.0), np.linspace(0.2, 4.8, 24), np.full(24, math.pi / 2)))
    true = np.vstack((up, across, down))
    walls = [wall for y in (0, 5) for wall in (np.array(corridor(2.0)) + np.array([0, y, 0, y])).tolist()]
    closed = LoopCloser(keyframes_of(true, [(a, b, c, d) for a, b, c, d in walls], given=drifted(true))).run()
    assert wrong(closed, true) == 0


def loop_to(first: int, last: int, true: FloatArray, off: float = 0.0) -> Loop:
    motion = relative_poses(true[[first]], true[[last]])[0] + np.array([off, 0.0, 0.0])
    return Loop(first, last, motion, np.eye(3), 0.9)


def test_a_loop_alone_is_not_relied_upon() -> None:
    true = round_ring(2.0)
    pieces = np.zeros(len(true), np.intp)
    agreeing = [loop_to(10 + k, 240 + k, true) for k in (0, 4, 8)]
    assert supported(agreeing, true, pieces, DEFAULTS).all()
    assert not supported(agreeing[:2], true, pieces, DEFAULTS).any()
    assert not supported([], true, pieces, DEFAULTS).any()
    same = [loop_to(first, 240, true) for first in (10, 14, 18)]
    assert not supported(same, true, pieces, DEFAULTS).any(), "one keyframe does not support itself"
    off = [*agreeing, loop_to(12, 243, true, 2.0)]
    assert supported(off, true, pieces, DEFAULTS).tolist() == [True, True, True, False]
    lost = np.where(np.arange(len(true)) > 242, 1, 0)
    assert not supported(agreeing, true, lost, DEFAULTS).any(), "what lies between may be anything"


def test_loops_are_counted_by_stretches_and_connect_pieces() -> None:
    true = round_ring(2.0)
    loops = [loop_to(10 + k, 240 + k, true) for k in range(0, 60, 4)] + [loop_to(200, 300, true)]
    assert count_stretches(loops, 40) == 2 and count_stretches([], 40) == 0
    pieces = np.repeat([0, 1, 2, 3], [100, 100, 150, len(true) - 350]).astype(np.intp)
    assert np.unique(connected(loops[:1], pieces)).tolist() == [0, 1, 3]
    assert connected([], pieces).tolist() == pieces.tolist()


def test_steps_found_by_wide_searches_are_robust_beside_weak_ones() -> None:
    true = round_ring(0.5)
    given = keyframes_of(true[:40], ring())
    count = len(given.poses)
    unsure = replace(given, unsure=np.arange(count) == 20, broken=np.arange(count) == 30)
    edges, robust = step_edges(unsure, GraphOptions())
    assert [(int(a), int(b)) for a, b in zip(edges.first[robust], edges.last[robust], strict=True)] == [(19, 20)]
    for border in (20, 30):
        spanning = (edges.first < border) & (edges.last >= border)
        assert (edges.last - edges.first)[spanning].tolist() == ([1, 1] if border == 20 else [1])
        assert np.linalg.eigvalsh(edges.information[spanning][-1]).max() < 3
    sure, _ = step_edges(given, GraphOptions())
    assert len(sure.first) == count - 1 + count - 4 + count - 10
    with_odometry, _ = step_edges(replace(unsure, odometry=given.poses), GraphOptions())
    assert with_odometry.information[-1, 0, 0] > edges.information[-1, 0, 0]


def test_a_search_leaves_out_what_it_is_asked_to() -> None:
    true = np.column_stack((np.linspace(-14, 14, 141), np.zeros(141), np.zeros(141)))
    submaps = Submaps(keyframes_of(true, corridor(2.0)), true, DEFAULTS)
    submap, chunk = submaps.submap(70), submaps.chunk(70)
    assert submap is not None
    window = Window(3.0, 0.05, math.radians(1), 0.0, 0.0)
    free = submap.find(chunk, np.zeros(3), window, 4, 0.3)
    other = submap.find(chunk, np.zeros(3), window, 4, 0.3, Excluded(0.0, 0.0, 0.0, 0.5, 0.2))
    assert free is not None and other is not None
    assert math.hypot(*free[0][:2]) < 0.1 and free[1] >= other[1]
    assert math.hypot(*other[0][:2]) >= 0.5
    assert abs(abs(other[0][0]) - 2) < 0.1, "the next post looks the same"


def test_notes_say_what_was_closed_and_what_not(lap: tuple[Keyframes, FloatArray, ClosedLoops]) -> None:
    _, _, closed = lap
    seven = replace(closed, closed=7, rejected={LoopRejection.AMBIGUOUS: 2, LoopRejection.UNSUPPORTED: 1})
    assert loop_notes(seven) == ["7 loops closed, 2 rejected as ambiguous, 1 rejected as unsupported"]
    assert loop_notes(replace(closed, closed=1, rejected={})) == ["1 loop closed"]
    none = replace(closed, closed=0, loops=(), rejected={LoopRejection.AMBIGUOUS: 3})
    assert loop_notes(none) == ["no loop closed, 3 rejected as ambiguous"]
    assert loop_notes(replace(none, rejected={})) == []


def test_a_track_closes_its_loops() -> None:
    true = round_ring(1.25, step=0.1)
    rng, world = np.random.default_rng(2), World((30.0, 30.0), (), tuple(ring()))
    odometry = Odometry(OdometryNoise(0.15, math.radians(6)), rng)
    scans, known = [], []
    for k, pose in enumerate(true):
        at = Pose2D(*pose.tolist())
        scan = LIDAR.measure(world, at, (k + 1) * SECOND // 5, 0.2, rng)
        scans.append(PosedScan(k, scan, at, [(scan, at)]))
        odometry.update(at, 0.1)
        known.append((odometry.pose.x, odometry.pose.y, odometry.pose.theta))
    found = track(scans, np.array(known))
    assert found.closed is not None and found.closed.closed >= 1
    assert wrong(found.closed, true[list(found.keyframes)]) == 0
    assert rmse(found.poses, true) < 0.04
    assert isinstance(found.errors, LoopErrors)
    spread = found.errors.since_first()
    apart = found.poses - relative_poses(np.repeat(true[:1], len(true), axis=0), true)
    apart[:, 2] = wrap_angles(apart[:, 2])
    held = np.einsum("ni,nij,nj->n", apart[1:], np.linalg.inv(spread[1:]), apart[1:])
    assert (held < 16).mean() > 0.95


def test_scans_follow_the_keyframes_that_loops_move() -> None:
    stamps = np.arange(5, dtype=np.int64) * SECOND
    tracker = ScanTracker([np.zeros((0, 4))] * 5, stamps, None)
    tracker.poses = np.column_stack((np.arange(5.0), np.zeros(5), np.zeros(5)))
    tracker.keyframes = [0, 4]
    tracker._follow(np.array([[0.0, 0, 0], [4.0, 2.0, 0]]))
    assert tracker.poses == pytest.approx(np.column_stack((np.arange(5.0), np.arange(5) / 2, np.zeros(5))))
    tracker.poses = np.column_stack((np.arange(5.0), np.zeros(5), np.zeros(5)))
    tracker.broken = [4]
    tracker._follow(np.array([[0.0, 0, 0], [4.0, 2.0, 0]]))
    assert tracker.poses[:, 1].tolist() == [0, 0, 0, 0, 2], "scans before a gap do not follow what comes after it"
