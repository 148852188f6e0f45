"""Distances, silhouettes and likelihoods of rays, against the exact shapes and against differences."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from detect.refinement import kernels
from detect.refinement.rays import FAMILY, parameters
from prim.shapes import Kind
from tests.detect.refinement.rooms import shape


def beams_around(seed: int, count: int = 300) -> np.ndarray:
    """Rays from a ring of places through the neighbourhood of the origin."""
    rng = np.random.default_rng(seed)
    turn = rng.uniform(0, 2 * math.pi, count)
    made = np.zeros((7, count))
    made[0], made[1] = 0.9 * np.cos(turn), 0.9 * np.sin(turn)
    towards = rng.normal(0, 0.12, (count, 2)).T - made[:2]
    made[2:4] = towards / np.hypot(*towards)
    made[kernels.RANGE], made[kernels.STOP] = rng.uniform(0.3, 1.6, count), 1.7
    made[kernels.MISS] = rng.uniform(-4, -0.5, count)
    return made


@given(kind=st.sampled_from(Kind), seed=st.integers(0, 10_000), theta=st.floats(-4, 4))
@settings(max_examples=60, deadline=None)
def test_distances_are_the_shapes_own(kind: Kind, seed: int, theta: float) -> None:
    primitive = shape(kind, 0.05, -0.03, theta)
    beams = beams_around(seed)
    distance = np.empty(beams.shape[1])
    kernels.trace(FAMILY[kind], parameters(primitive), beams, distance)
    exact = [primitive.cast(tuple(beam[:2]), beam[None, 2:4])[0] for beam in beams.T]
    assert np.where(distance == kernels.FAR, np.inf, distance) == pytest.approx(exact, abs=1e-9)


@pytest.mark.parametrize("kind", Kind)
def test_what_lies_behind_a_ray_is_not_met(kind: Kind) -> None:
    beams = beams_around(1)
    beams[2:4] *= -1
    distance = np.empty(beams.shape[1])
    kernels.trace(FAMILY[kind], parameters(shape(kind)), beams, distance)
    assert (distance == kernels.FAR).all()


@pytest.mark.parametrize("kind", Kind)
def test_from_inside_nothing_is_further_than_zero(kind: Kind) -> None:
    beams = beams_around(2)
    beams[:2] = 0.0
    distance = np.empty(beams.shape[1])
    kernels.trace(FAMILY[kind], parameters(shape(kind)), beams, distance)
    assert (distance == 0).all()


@pytest.mark.parametrize("kind", Kind)
@pytest.mark.parametrize("seed", range(3))
def test_slopes_are_those_of_the_costs(kind: Kind, seed: int) -> None:
    """By central differences; a table is straight between its entries, so that they agree to a few per mille."""
    beams, p = beams_around(seed, 2000), parameters(shape(kind, 0.02, 0.01))
    kinds = np.random.default_rng(seed).integers(0, 3, beams.shape[1]).astype(np.int8)
    table = kernels.tables(1e-3)
    gradient, information = np.zeros(5), np.zeros((5, 5))
    cost = kernels.slopes(FAMILY[kind], p, beams, kinds, 0.1, table, 0.01, gradient, information)
    around = np.concatenate([p + 1e-6 * np.eye(5), p - 1e-6 * np.eye(5), p[None]])
    out = np.empty(len(around))
    kernels.costs(np.full(len(around), FAMILY[kind]), around, beams, kinds, 0.1, table, 0.01, out)
    assert cost == pytest.approx(out[-1], rel=1e-12)
    scale = np.sqrt(np.diag(information)) + 1
    assert gradient / scale == pytest.approx((out[:5] - out[5:10]) / 2e-6 / scale, abs=0.15)
    assert np.linalg.eigvalsh(information).min() > -1e-6 * np.abs(information).max()


@pytest.mark.parametrize("kind", Kind)
def test_pass_by_tells_hits_from_misses(kind: Kind) -> None:
    beams, p = beams_around(5), parameters(shape(kind))
    aside, distance = np.empty(beams.shape[1]), np.empty(beams.shape[1])
    kernels.pass_by(FAMILY[kind], p, beams, aside)
    kernels.trace(FAMILY[kind], p, beams, distance)
    assert ((aside > 0) == (distance < kernels.FAR)).all()


def test_tables_hold_the_normal_distributions_logarithms() -> None:
    table = kernels.tables(0.01)
    middle = table.shape[1] // 2
    at = middle + 2 * kernels.TABLE_SPACING
    phi = 0.5 * math.erfc(2 / math.sqrt(2))
    assert table[0, at] == pytest.approx(math.log(math.exp(-2) + 0.01))
    assert table[1, at] == pytest.approx(math.log(phi + 0.01))
    assert table[2, at] == pytest.approx(math.log(1 - phi + 0.01))


def test_walks_end_in_the_first_occupied_cell_or_leave() -> None:
    occupied = np.zeros((100, 100), np.bool_)
    occupied[:, 80] = True
    beams = np.zeros((7, 3))
    beams[:2] = 0.505
    beams[2:4] = [(1, -1, math.sqrt(0.5)), (0, 0, math.sqrt(0.5))]
    stops, ends = np.zeros(3), np.zeros(3, np.bool_)
    clear = np.empty(occupied.shape, np.uint8)
    kernels.clearances(occupied, clear)
    kernels.walk(clear, 0, 0, 100.0, beams, np.full(3, 5.0), stops, ends)
    assert ends.tolist() == [True, False, True]
    assert stops[0] == pytest.approx(0.3, abs=0.0051) and stops[1] == pytest.approx(0.505, abs=0.011)
    assert stops[2] == pytest.approx(0.3 * math.sqrt(2), abs=0.008)
    kernels.walk(clear, 0, 0, 100.0, beams, np.full(3, 0.2), stops, ends)
    assert not ends.any() and (stops <= 0.2 + 1e-12).all()


@given(seed=st.integers(0, 10_000), share=st.floats(0, 0.05))
@settings(max_examples=60, deadline=None)
def test_walks_take_no_cell_for_free_that_is_not(seed: int, share: float) -> None:
    """Against the same rays, stepped along in tenths of a cell; from within the map, from outside, along its axes."""
    rng = np.random.default_rng(seed)
    occupied = rng.random((30, 40)) < share
    clear = np.empty(occupied.shape, np.uint8)
    kernels.clearances(occupied, clear)
    beams = np.zeros((7, 40))
    beams[:2] = rng.uniform(-5, 45, (2, 40))
    angle = np.where(rng.random(40) < 0.2, rng.integers(0, 4, 40) * math.pi / 2, rng.uniform(0, 2 * math.pi, 40))
    beams[2:4] = np.cos(angle).round(15), np.sin(angle).round(15)
    stops, ends = np.zeros(40), np.zeros(40, np.bool_)
    kernels.walk(clear, 0, 0, 1.0, beams, np.full(40, 100.0), stops, ends)
    away = np.arange(0, 100, 0.1)
    for i, (x, y, dx, dy) in enumerate(beams[:4].T.tolist()):
        at = np.floor(np.column_stack((y + away * dy, x + away * dx))).astype(int)
        inside = ((at >= 0) & (at < occupied.shape)).all(axis=1)
        met = np.zeros(len(away), np.bool_)
        met[inside] = occupied[tuple(at[inside].T)]
        first = float(away[met][0]) if met.any() else math.inf
        assert stops[i] < first + 0.8  # it ends in the middle of its way through the cell
        if ends[i]:
            place = int(y + stops[i] * dy), int(x + stops[i] * dx)
            assert occupied[place]
        else:
            assert not met.any()


def test_clearances_are_the_steps_to_what_is_occupied_or_beyond() -> None:
    occupied = np.zeros((9, 12), np.bool_)
    occupied[4, 7] = True
    clear = np.empty(occupied.shape, np.uint8)
    kernels.clearances(occupied, clear)
    rows, cols = np.indices(occupied.shape)
    to_cell = np.maximum(abs(rows - 4), abs(cols - 7))
    beyond = np.minimum(np.minimum(rows, 8 - rows), np.minimum(cols, 11 - cols)) + 1
    assert (clear == np.minimum(to_cell, beyond)).all()


@pytest.mark.parametrize("kind", [Kind.SQUARE, Kind.RECTANGLE, Kind.TRIANGLE])
@pytest.mark.parametrize("y", [-0.2, -0.04, 0.0, 0.04, 0.2])
def test_rays_along_a_side(kind: Kind, y: float) -> None:
    """As of a robot that stands just as a box does."""
    primitive = shape(kind, 0.0, 0.0, 0.0)
    for sign in (1.0, -1.0):
        beams = np.zeros((7, 2))
        beams[:4, 0], beams[:4, 1] = (-sign, y, sign, 0.0), (y, -sign, 0.0, sign)
        distance = np.empty(2)
        kernels.trace(FAMILY[kind], parameters(primitive), beams, distance)
        exact = [primitive.cast(tuple(beam[:2]), beam[None, 2:4])[0] for beam in beams.T]
        assert np.where(distance == kernels.FAR, np.inf, distance) == pytest.approx(exact, abs=1e-9)
