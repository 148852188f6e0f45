"""The bound on errors of poses agrees with a value known by hand, numeric derivatives, and least squares."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from bench.pose_bounds import (
    PATCHES,
    SHAPES,
    Hits,
    Surfaces,
    map_slopes,
    position_bound,
    scan_information,
    step_information,
)
from prim.arrays import FloatArray
from prim.scan import beam_directions
from prim.se2 import relative_steps, rotate, wrap_angles
from prim.shapes import Primitive
from prim.world import World

WORLD = World(
    (4.0, 4.0),
    (
        Primitive.of("circle", 0.9, 0.2, radius=0.2),
        Primitive.of("rectangle", -0.8, -0.3, 0.4, width=0.5, height=0.3),
        Primitive.of("ellipse", 0.1, 1.0, 0.7, semi_major=0.4, semi_minor=0.2),
        Primitive.of("triangle", -0.2, -1.2, 0.3, base=0.6, height=0.4),
    ),
).with_walls()
BEAMS = beam_directions(-math.pi, 2 * math.pi / 90, 90)
POSES = np.array([[0.0, 0.1, 0.3], [0.05, 0.12, 0.35], [0.1, 0.1, 0.5]])


def test_two_perpendicular_walls_that_are_known_bound_a_position_by_the_noise_over_the_rays() -> None:
    """Rays in pairs about each wall's normal: those of a heading cancel, and x and y have n rays each."""
    tilt, count, noise_std = 0.01, 50, 0.03
    world = World((4.0, 4.0), walls=((1, -1, 1, 1), (-1, 1, 1, 1)))
    angles = np.repeat([-tilt, tilt, math.pi / 2 - tilt, math.pi / 2 + tilt], count // 2)
    beams = np.column_stack((np.cos(angles), np.sin(angles)))
    hits = Hits.of(Surfaces.of(world), np.zeros((1, 3)), beams, 5.0)
    information = scan_information(hits, None, 1, noise_std)
    expected = math.sqrt(2 * noise_std**2 / count)
    assert position_bound(information, first_is_known=False) == pytest.approx(expected, rel=1e-3)


def test_derivatives_are_those_of_the_ranges() -> None:
    surfaces = Surfaces.of(WORLD)
    hits = Hits.of(surfaces, POSES[:1], BEAMS, 5.0)
    by_shapes = map_slopes(WORLD, surfaces, hits, SHAPES).toarray()
    seen = directions_of(hits, POSES[0])

    def difference(change: float, world: World = WORLD, pose: FloatArray = POSES[0]) -> FloatArray:
        beams = rotate(BEAMS[seen], float(pose[2]))
        before = WORLD.cast((POSES[0, 0], POSES[0, 1]), rotate(BEAMS[seen], float(POSES[0, 2])))
        return (world.cast((float(pose[0]), float(pose[1])), beams) - before) / change

    step = 1e-7
    for k in range(3):
        assert difference(step, pose=POSES[0] + step * np.eye(3)[k]) == pytest.approx(hits.slopes[:, k], abs=1e-4)
    column = 0
    for number, primitive in enumerate(WORLD.primitives):
        for name in primitive.kind.parameters:
            if name in primitive.sizes:
                moved = replace(
                    primitive, size=tuple((primitive.sizes | {name: primitive.sizes[name] + step}).values())
                )
            else:
                moved = replace(primitive, **{name: getattr(primitive, name) + step})
            primitives = (*WORLD.primitives[:number], moved, *WORLD.primitives[number + 1 :])
            changed = difference(step, world=replace(WORLD, primitives=primitives))
            assert changed == pytest.approx(by_shapes[:, column], abs=1e-4), (primitive.kind, name)
            column += 1


def directions_of(hits: Hits, pose: FloatArray) -> list[int]:
    """The numbers of the beams that a scan's hits belong to."""
    bearings = np.arctan2(*(hits.points - pose[:2]).T[::-1]) - pose[2]
    return [int(np.argmin(np.abs(wrap_angles(np.arctan2(*BEAMS.T[::-1]) - bearing)))) for bearing in bearings]


@pytest.mark.parametrize("unknown", [SHAPES, PATCHES])
def test_least_squares_of_poses_and_map_reach_the_bound(unknown: str) -> None:
    """Jointly solved from noisy ranges and steps, all derivatives being constant, their errors are the bound."""
    noise_std, variances = 0.02, np.full((len(POSES), 3), 0.01**2)
    surfaces = Surfaces.of(WORLD)
    hits = Hits.of(surfaces, POSES, BEAMS, 5.0)
    by_map = map_slopes(WORLD, surfaces, hits, unknown)
    information = scan_information(hits, by_map, len(POSES), noise_std) + step_information(POSES, variances)
    bound = position_bound(information, first_is_known=True)

    rows = np.zeros((len(hits.scan), 3 * len(POSES)))
    for k in range(3):
        rows[np.arange(len(rows)), 3 * hits.scan + k] = hits.slopes[:, k]
    steps, step = np.zeros((3 * len(POSES) - 3, 3 * len(POSES))), 1e-6
    for k in range(3 * len(POSES)):
        moved = POSES + step * np.eye(3 * len(POSES))[k].reshape(POSES.shape)
        steps[:, k] = ((relative_steps(moved) - relative_steps(POSES))[1:] / step).ravel()
    dense = by_map.toarray()
    weighted = np.vstack(
        (
            np.hstack((rows, dense))[:, 3:] / noise_std,
            np.hstack((steps, np.zeros((len(steps), dense.shape[1]))))[:, 3:] / 0.01,
            np.hstack((np.zeros((dense.shape[1], 3 * len(POSES))), np.eye(dense.shape[1])))[:, 3:],
        )
    )
    rng = np.random.default_rng(0)
    trials = 4000
    noise = rng.standard_normal((len(weighted), trials))
    solved = np.linalg.lstsq(weighted, noise, rcond=None)[0][: 3 * len(POSES) - 3]
    squares = (solved.reshape(-1, 3, trials)[:, :2] ** 2).sum(axis=1)
    assert math.sqrt(squares.sum() / trials / len(POSES)) == pytest.approx(bound, rel=0.03)
    known = position_bound(scan_information(hits, None, len(POSES), noise_std), first_is_known=True)
    assert known < bound


def test_a_pose_that_no_ray_and_no_step_determine_has_no_bound() -> None:
    assert math.isinf(position_bound(np.zeros((6, 6)), first_is_known=True))
