"""Stopping probabilities by the direction of a ray: on surfaces that are several cells thick, at all angles."""

import math

import numpy as np
import pytest
from numpy.typing import NDArray

from mapping.forward.incidence import IncidenceOptions, directional_stopping, surface_normals

SIZE = 121


def thick_wall(normal: float, share: float = 0.15, width: float = 2.0) -> NDArray[np.float32]:
    """A wall through the middle of a map, whose stopping probabilities fall off along its normal as a Gaussian."""
    y, x = np.mgrid[:SIZE, :SIZE] - SIZE // 2
    depth = x * math.cos(normal) + y * math.sin(normal)
    return (share * np.exp(-((depth / width) ** 2) / 2)).astype(np.float32)


def mean_depth(stopping: NDArray[np.float32], direction: float, normal: float) -> float:
    """The depth along the normal at which a ray through the middle ends, on average, one trial a step."""
    dx, dy = math.cos(direction), math.sin(direction)
    step = 1 / max(abs(dx), abs(dy))
    at = np.arange(-50, 51) * step
    cols, rows = np.rint(at * dx).astype(int) + SIZE // 2, np.rint(at * dy).astype(int) + SIZE // 2
    inside = (cols >= 0) & (rows >= 0) & (cols < SIZE) & (rows < SIZE)
    ends = stopping[rows[inside], cols[inside]].astype(float)
    reached = np.concatenate(([1.0], np.cumprod(1 - ends)[:-1]))
    depths = at[inside] * math.cos(direction - normal)
    return float((reached * ends * depths).sum() / (reached * ends).sum())


@pytest.mark.parametrize("normal", [0.0, 0.4, math.pi / 4, 1.3, math.pi / 2])
def test_normals_are_those_of_the_walls(normal: float) -> None:
    normals, coherence = surface_normals(thick_wall(normal))
    near = thick_wall(normal) > 0.05
    near[:10] = near[-10:] = False
    near[:, :10] = near[:, -10:] = False
    apart = (normals - normal + math.pi / 2) % math.pi - math.pi / 2
    assert np.abs(apart[near]).max() < 0.06 and coherence[near].min() > 0.9


@pytest.mark.parametrize("normal", [0.0, math.pi / 2])
def test_rays_end_at_one_depth_whatever_their_angle(normal: float) -> None:
    plain, options = thick_wall(normal), IncidenceOptions(directions=24)
    by_direction = directional_stopping(plain, options)
    straight = mean_depth(plain, normal, normal)
    for k in (2, 4, 6, 8, 9):  # up to 68 degrees off the normal
        angle = math.pi * k / 24
        number = round((normal + angle) / math.pi * 24) % 24
        found = mean_depth(by_direction[number], normal + angle, normal)
        assert found == pytest.approx(straight, abs=0.25)
    # as it is, the last of these ends half a cell and more too soon
    assert mean_depth(plain, normal + angle, normal) < straight - 0.5


def test_rays_that_graze_a_solid_surface_do_not_all_end_in_their_first_step() -> None:
    """One straight on ends at half a cell on average; of those that graze, a few pass through one column of cells."""
    solid = np.zeros((SIZE, SIZE), np.float32)
    solid[:, SIZE // 2] = 0.99
    number, directions = 8, 24
    angle = math.pi * number / directions  # 60 degrees off the normal, which is along x
    steps = np.arange(-60, 61) / math.tan(angle)  # of x, one a row
    by_direction = directional_stopping(solid, IncidenceOptions(directions=directions))[number]

    def mean_depth(stopping: NDArray[np.float32]) -> float:
        depths = []
        for start in np.linspace(0, 1, 40, endpoint=False):
            x = steps + start / math.tan(angle) + SIZE // 2
            ends = stopping[np.arange(121), np.clip(x.astype(int), 0, SIZE - 1)].astype(float)
            reached = np.concatenate(([1.0], np.cumprod(1 - ends)[:-1]))
            depths.append((reached * ends * (x - SIZE // 2)).sum() / (reached * ends).sum())
        return float(np.mean(depths))

    assert 0.36 < mean_depth(by_direction) < 0.5
    assert mean_depth(solid) < 0.32


def test_what_has_no_normal_is_as_it_was() -> None:
    stopping = np.zeros((40, 40), np.float32)
    stopping[20, 20] = 0.7
    maps = directional_stopping(stopping)
    assert maps.shape == (IncidenceOptions().directions, 40, 40)
    assert maps[:, 20, 20] == pytest.approx(0.7, abs=0.02)
    assert not maps[:, :10].any()
    assert directional_stopping(np.full((5, 5), 1.0, np.float32)).max() <= 1
