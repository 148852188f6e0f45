"""A map at several sizes of its cells."""

from __future__ import annotations

import math
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from mapping.grid import GridFrame, OccupancyGrid
from mapping.pyramid import coarser, levels_for
from prim.choices import DEFAULT_SIZES


def test_a_larger_cell_is_occupied_where_one_in_it_is_and_free_where_what_is_known_is() -> None:
    probability = np.full((2, 8), 0.5, np.float32)
    probability[0, 0], probability[1, 1] = 0.9, 0.1
    probability[:, 2:4] = [[0.2, 0.4], [0.1, 0.3]]
    probability[0, 4] = 0.2
    made = coarser(OccupancyGrid(GridFrame(0.01, 0, 0, 2, 8), probability), 2)
    assert made.probability.tolist() == [pytest.approx([0.9, 0.25, 0.2, 0.5])]
    assert made.frame == GridFrame(0.02, 0, 0, 1, 4) and made.visits is None


@given(
    st.integers(-9, 9), st.integers(-9, 9), st.integers(1, 12), st.integers(1, 12), st.integers(1, 5), st.randoms()
)
def test_it_is_what_each_cell_by_itself_comes_to(row, col, rows, cols, factor, random) -> None:  # type: ignore[no-untyped-def]
    values = np.array([random.choice([0.1, 0.4, 0.5, 0.8]) for _ in range(rows * cols)], np.float32)
    visits = np.array([random.random() for _ in range(rows * cols)], np.float32).reshape(rows, cols)
    grid = OccupancyGrid(GridFrame(0.01, row, col, rows, cols), values.reshape(rows, cols), visits)
    made = coarser(grid, factor)
    assert made.frame.resolution == pytest.approx(0.01 * factor)
    x0, y0, x1, y1 = grid.frame.bounds
    assert made.frame.bounds[0] <= x0 + 1e-9 and made.frame.bounds[2] >= x1 - 1e-9
    assert made.frame.bounds[1] <= y0 + 1e-9 and made.frame.bounds[3] >= y1 - 1e-9
    for (r, c), probability in np.ndenumerate(made.probability):
        inside = [
            (i, j)
            for i in range(rows)
            for j in range(cols)
            if ((row + i) // factor, (col + j) // factor) == (made.frame.row + r, made.frame.col + c)
        ]
        parts = [float(grid.probability[at]) for at in inside]
        known = [part for part in parts if part != 0.5]
        expected = max(parts) if parts and max(parts) > 0.5 else np.mean(known) if known else 0.5
        assert probability == pytest.approx(expected, abs=1e-6)
        assert made.visits is not None
        assert made.visits[r, c] == pytest.approx(sum(float(visits[at]) for at in inside) / factor, abs=1e-5)


@given(st.floats(0.001, 0.5), st.floats(0.01, 2), st.floats(2, 40))
def test_levels_cover_all_sizes_without_a_gap(resolution: float, smallest: float, growth: float) -> None:
    sizes = smallest, growth * smallest
    levels = levels_for(resolution, sizes)
    assert levels[0].extents[0] == 0
    assert levels[-1].extents[1] >= math.sqrt(2) * sizes[1] * (1 - 1e-6)
    for one, following in pairwise(levels):
        assert one.extents[1] == following.extents[0] and following.factor == 2 * one.factor
    assert levels[0].factor == 1 or 16 * levels[0].resolution <= smallest * (1 + 1e-6)


def test_what_is_searched_for_by_default() -> None:
    assert [level.factor for level in levels_for(0.01, DEFAULT_SIZES)] == [1, 2, 4, 8]
    assert [level.factor for level in levels_for(0.05, DEFAULT_SIZES)] == [1, 2]
    assert [level.factor for level in levels_for(0.01, (0.5, 2.0))] == [2, 4, 8]
