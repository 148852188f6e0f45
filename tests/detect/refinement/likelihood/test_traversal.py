"""Rays through a map's cells, against the same rays stepped along in tenths of a cell."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from detect.refinement.likelihood.traversal import cast_through_map
from mapping.morphology import chessboard_distances


def test_rays_end_in_the_first_occupied_cell_or_leave() -> None:
    occupied = np.zeros((100, 100), np.bool_)
    occupied[:, 80] = True
    rays = np.zeros((7, 3))
    rays[:2] = 0.505
    rays[2:4] = [(1, -1, math.sqrt(0.5)), (0, 0, math.sqrt(0.5))]
    ranges, ends = np.zeros(3), np.zeros(3, np.bool_)
    clear = chessboard_distances(occupied)
    cast_through_map(clear, (0, 0, 100.0), rays, np.full(3, 5.0), ranges, ends)
    assert ends.tolist() == [True, False, True]
    assert ranges[0] == pytest.approx(0.3, abs=0.0051) and ranges[1] == pytest.approx(0.505, abs=0.011)
    assert ranges[2] == pytest.approx(0.3 * math.sqrt(2), abs=0.008)
    cast_through_map(clear, (0, 0, 100.0), rays, np.full(3, 0.2), ranges, ends)
    assert not ends.any() and (ranges <= 0.2 + 1e-12).all()


@given(seed=st.integers(0, 10_000), share=st.floats(0, 0.05))
@settings(max_examples=60, deadline=None)
def test_no_occupied_cell_is_passed(seed: int, share: float) -> None:
    """From within the map, from outside, and along its axes."""
    rng = np.random.default_rng(seed)
    occupied = rng.random((30, 40)) < share
    clear = chessboard_distances(occupied)
    rays = np.zeros((7, 40))
    rays[:2] = rng.uniform(-5, 45, (2, 40))
    angle = np.where(rng.random(40) < 0.2, rng.integers(0, 4, 40) * math.pi / 2, rng.uniform(0, 2 * math.pi, 40))
    rays[2:4] = np.cos(angle).round(15), np.sin(angle).round(15)
    ranges, ends = np.zeros(40), np.zeros(40, np.bool_)
    cast_through_map(clear, (0, 0, 1.0), rays, np.full(40, 100.0), ranges, ends)
    away = np.arange(0, 100, 0.1)
    for i, (x, y, dx, dy) in enumerate(rays[:4].T.tolist()):
        at = np.floor(np.column_stack((y + away * dy, x + away * dx))).astype(int)
        inside = ((at >= 0) & (at < occupied.shape)).all(axis=1)
        met = np.zeros(len(away), np.bool_)
        met[inside] = occupied[tuple(at[inside].T)]
        first = float(away[met][0]) if met.any() else math.inf
        assert ranges[i] < first + 0.8  # it ends in the middle of its way through the cell
        if ends[i]:
            place = int(y + ranges[i] * dy), int(x + ranges[i] * dx)
            assert occupied[place]
        else:
            assert not met.any()
