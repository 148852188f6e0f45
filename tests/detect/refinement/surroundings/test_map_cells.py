"""The classification of a map's cells."""

from __future__ import annotations

import numpy as np
import pytest

from detect.refinement.surroundings.lines import distance_to_line, trimmed_line
from detect.refinement.surroundings.map_cells import MapCells
from mapping.grid import GridFrame, OccupancyGrid
from tests.detect.refinement.rooms import mapped, room, scans


@pytest.mark.parametrize("seed", range(3))
def test_walls_bent_by_noise_are_walls(seed: int) -> None:
    """Over their whole length, and at the room's edges to within the map's accuracy."""
    cells = MapCells.of(mapped(scans(room(), 0.5, stops=6, seed=seed)))
    assert len(cells.walls) == 4
    for wall in cells.walls:
        nx, ny, d = wall.line
        assert max(abs(nx), abs(ny)) > 0.998 and d == pytest.approx(-1.0, abs=0.04)
        assert wall.last - wall.first > 1.8


def test_trimmed_line_ignores_what_touches_the_wall() -> None:
    along = np.arange(0.0, 2.0, 0.01)
    wall = np.column_stack((along, 0.3 + 0.1 * along))
    beside = wall[60:110] + np.array([0.0, 0.025])
    line = trimmed_line(np.concatenate((wall, beside)), 0.01)
    assert distance_to_line(wall, line).max() < 0.001


def test_speckle_has_no_walls() -> None:
    """Many cells lie along a line by chance."""
    specks = np.random.default_rng(0).random((220, 220)) < 0.06
    grid = OccupancyGrid(GridFrame(0.01, -110, -110, 220, 220), np.where(specks, 0.9, 0.1).astype(np.float32))
    assert not MapCells.of(grid).large.any()


@pytest.mark.parametrize("upright", [False, True])
@pytest.mark.parametrize(("length", "kept", "gap"), [(200, 0.55, 1), (120, 1.0, 40)], ids=["random holes", "gaps"])
def test_walls_with_holes_are_walls(length: int, kept: float, gap: int, upright: bool) -> None:
    """A sharp wall whose connected components are no longer than 0.4 m."""
    wall = np.zeros((220, 220), np.bool_)
    wall[10, 10 : 10 + length] = np.random.default_rng(1).random(length) < kept
    wall[10, ::gap] &= gap == 1
    cells = np.where(wall, 0.9, 0.1).astype(np.float32)
    cells[:10] = 0.5
    if upright:
        cells, wall = cells.T.copy(), wall.T
    found = MapCells.of(OccupancyGrid(GridFrame(0.01, -110, -110, 220, 220), cells))
    assert (found.large == wall).all() and len(found.walls) == 1
