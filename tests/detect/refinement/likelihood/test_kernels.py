"""Ranges, clearances and likelihoods of rays, against the exact shapes and against differences."""

from __future__ import annotations

import math

import numpy as np
import pytest
import shapely
from hypothesis import given, settings
from hypothesis import strategies as st

from detect.refinement.likelihood import kernels
from detect.refinement.likelihood.geometry import NUMBERS, OUTLINES, parameters_of, ranges_to
from prim.arrays import FloatArray
from prim.scan import RangeOutcome
from prim.shapes import Kind, Primitive
from tests.detect.refinement.rooms import shape

POLYGONS = OUTLINES._replace(form=np.where(OUTLINES.form == kernels.ROUND, kernels.ROUND, kernels.POLYGON))
"""All outlines with corners as general polygons, without the code that the kernels have for some of them."""

OUTLINES_OF = [pytest.param(OUTLINES, id="own code"), pytest.param(POLYGONS, id="as polygons")]


def rays_around(seed: int, count: int = 300) -> FloatArray:
    """Rays (7, N) from a ring of places through the neighbourhood of the origin."""
    rng = np.random.default_rng(seed)
    turn = rng.uniform(0, 2 * math.pi, count)
    rays = np.zeros((7, count))
    rays[0], rays[1] = 0.9 * np.cos(turn), 0.9 * np.sin(turn)
    towards = rng.normal(0, 0.12, (count, 2)).T - rays[:2]
    rays[2:4] = towards / np.hypot(*towards)
    rays[kernels.RANGE], rays[kernels.OCCLUSION] = rng.uniform(0.3, 1.6, count), 1.7
    rays[kernels.BACKGROUND] = rng.uniform(-4, -0.5, count)
    return rays


def ranges_of(outlines: kernels.Outlines, primitive: Primitive, rays: FloatArray) -> FloatArray:
    ranges = np.empty(rays.shape[1])
    kernels.cast_rays(outlines, NUMBERS[primitive.kind], parameters_of(primitive), rays, ranges)
    return ranges


@pytest.mark.parametrize("outlines", OUTLINES_OF)
@given(kind=st.sampled_from(Kind), seed=st.integers(0, 10_000), theta=st.floats(-4, 4))
@settings(max_examples=60, deadline=None)
def test_ranges_equal_the_exact_intersection(outlines: kernels.Outlines, kind: Kind, seed: int, theta: float) -> None:
    primitive = shape(kind, 0.05, -0.03, theta)
    rays = rays_around(seed)
    ranges = ranges_of(outlines, primitive, rays)
    exact = [primitive.cast(tuple(ray[:2]), ray[None, 2:4])[0] for ray in rays.T]
    assert np.where(ranges == kernels.FAR, np.inf, ranges) == pytest.approx(exact, abs=1e-9)


@pytest.mark.parametrize("outlines", OUTLINES_OF)
@pytest.mark.parametrize("kind", Kind)
def test_clearance_is_the_signed_distance_to_the_silhouette(outlines: kernels.Outlines, kind: Kind) -> None:
    """Against the outline's extent across each ray's line."""
    primitive, rays = shape(kind, 0.02, 0.01), rays_around(5)
    clearances, across = np.empty(rays.shape[1]), []
    kernels.silhouette_clearances(outlines, NUMBERS[kind], parameters_of(primitive), rays, clearances)
    for x, y, dx, dy in rays[:4].T.tolist():
        offsets = (primitive.outline(4000) - (x, y)) @ np.array([-dy, dx])
        across.append(min(offsets.max(), -offsets.min()))
    assert clearances == pytest.approx(across, abs=1e-6)
    assert ((clearances > 0) == (ranges_of(outlines, primitive, rays) < kernels.FAR)).all()


@pytest.mark.parametrize("outlines", OUTLINES_OF)
@pytest.mark.parametrize("kind", Kind)
def test_a_shape_behind_the_origin_is_missed(outlines: kernels.Outlines, kind: Kind) -> None:
    rays = rays_around(1)
    rays[2:4] *= -1
    assert (ranges_of(outlines, shape(kind), rays) == kernels.FAR).all()


@pytest.mark.parametrize("outlines", OUTLINES_OF)
@pytest.mark.parametrize("kind", Kind)
def test_ranges_from_inside_are_zero(outlines: kernels.Outlines, kind: Kind) -> None:
    rays = rays_around(2)
    rays[:2] = 0.0
    assert (ranges_of(outlines, shape(kind), rays) == 0).all()


@pytest.mark.parametrize("outlines", OUTLINES_OF)
@pytest.mark.parametrize("kind", Kind)
@pytest.mark.parametrize("seed", range(3))
def test_gradient_is_that_of_the_cost(outlines: kernels.Outlines, kind: Kind, seed: int) -> None:
    """By central differences; the table is linear between its entries, so that they agree to a few per mille."""
    rays, p = rays_around(seed, 2000), parameters_of(shape(kind, 0.02, 0.01))
    outcomes = np.random.default_rng(seed).integers(0, 3, rays.shape[1]).astype(np.int8)
    data = kernels.RayData(rays, outcomes, 0.1, kernels.likelihood_table(1e-3))
    gradient, information = np.zeros(5), np.zeros((5, 5))
    cost = kernels.gradient(outlines, NUMBERS[kind], p, data, 0.01, gradient, information)
    around = np.concatenate([p + 1e-6 * np.eye(5), p - 1e-6 * np.eye(5), p[None]])
    costs = np.empty(len(around))
    kernels.negative_log_likelihoods(outlines, np.full(len(around), NUMBERS[kind]), around, data, 0.01, costs)
    assert cost == pytest.approx(costs[-1], rel=1e-12)
    scale = np.sqrt(np.diag(information)) + 1
    assert gradient / scale == pytest.approx((costs[:5] - costs[5:10]) / 2e-6 / scale, abs=0.15)
    assert np.linalg.eigvalsh(information).min() > -1e-6 * np.abs(information).max()


@pytest.mark.parametrize("outlines", OUTLINES_OF)
@pytest.mark.parametrize("kind", Kind)
def test_gradient_of_rays_that_pass_the_silhouette(outlines: kernels.Outlines, kind: Kind) -> None:
    """Ray by ray, of those that miss by less than the footprint: part of their beam meets the shape."""
    footprint, p = 0.02, parameters_of(shape(kind, 0.02, 0.01))
    rays = rays_around(7, 3000)
    clearances = np.empty(rays.shape[1])
    kernels.silhouette_clearances(outlines, NUMBERS[kind], p, rays, clearances)
    rays = rays[:, (clearances < -0.002) & (clearances > -0.9 * footprint)]
    around = np.concatenate([p + 1e-6 * np.eye(5), p - 1e-6 * np.eye(5)])
    made, expected = np.zeros((rays.shape[1], 5)), np.empty((rays.shape[1], 5))
    for i in range(rays.shape[1]):
        outcomes = np.zeros(1, np.int8)
        data = kernels.RayData(rays[:, i : i + 1].copy(), outcomes, 0.1, kernels.likelihood_table(1e-3))
        kernels.gradient(outlines, NUMBERS[kind], p, data, footprint, made[i], np.zeros((5, 5)))
        costs = np.empty(len(around))
        kernels.negative_log_likelihoods(outlines, np.full(10, NUMBERS[kind]), around, data, footprint, costs)
        expected[i] = (costs[:5] - costs[5:]) / 2e-6
    assert len(made) > 50
    assert (np.abs(made - expected).sum(axis=0) <= 0.03 * np.abs(expected).sum(axis=0) + 1e-6).all()


@pytest.mark.parametrize("kind", [kind for kind in Kind if not kind.is_round])
def test_a_forms_own_code_agrees_with_that_of_polygons(kind: Kind) -> None:
    """Costs, gradients and information to rounding errors: the silhouette's too."""
    rays, p = rays_around(3, 2000), parameters_of(shape(kind, 0.02, 0.01))
    outcomes = np.random.default_rng(3).integers(0, 3, rays.shape[1]).astype(np.int8)
    data = kernels.RayData(rays, outcomes, 0.1, kernels.likelihood_table(1e-3))
    found = []
    for outlines in (OUTLINES, POLYGONS):
        gradient, information = np.zeros(5), np.zeros((5, 5))
        cost = kernels.gradient(outlines, NUMBERS[kind], p, data, 0.01, gradient, information)
        found.append([cost, *gradient, *information.ravel()])
    assert found[0] == pytest.approx(found[1], rel=1e-9, abs=1e-7 * max(map(abs, found[0])))


def test_outcomes_have_the_numbers_of_scans() -> None:
    assert list(RangeOutcome) == [kernels.MEASURED, kernels.TOO_NEAR, kernels.NO_RETURN, kernels.INVALID]


@pytest.mark.parametrize("dropout", [0.0, 0.2])
def test_table_holds_the_logarithms_of_the_normal_distribution(dropout: float) -> None:
    table, returned = kernels.likelihood_table(0.01, dropout), 1 - dropout
    middle = table.shape[1] // 2
    at = middle + 2 * kernels.TABLE_SPACING
    phi = 0.5 * math.erfc(2 / math.sqrt(2))
    assert table[0, at] == pytest.approx(math.log(returned * math.exp(-2) + 0.01))
    assert table[1, at] == pytest.approx(math.log(returned * phi + 0.01))
    assert table[2, at] == pytest.approx(math.log(returned * (1 - phi) + dropout + 0.01))
    slopes = (table[:3, at + 1] - table[:3, at - 1]) * kernels.TABLE_SPACING / 2
    assert table[3:, at] == pytest.approx(slopes, rel=1e-3)


@pytest.mark.parametrize("kind", [kind for kind in Kind if not kind.is_round])
@pytest.mark.parametrize("y", [-0.2, -0.04, 0.0, 0.04, 0.2])
def test_rays_parallel_to_an_edge(kind: Kind, y: float) -> None:
    primitive = shape(kind, 0.0, 0.0, 0.0)
    for sign in (1.0, -1.0):
        rays = np.zeros((7, 2))
        rays[:4, 0], rays[:4, 1] = (-sign, y, sign, 0.0), (y, -sign, 0.0, sign)
        exact = [primitive.cast(tuple(ray[:2]), ray[None, 2:4])[0] for ray in rays.T]
        ranges = ranges_to(primitive, rays)
        assert np.where(ranges == kernels.FAR, np.inf, ranges) == pytest.approx(exact, abs=1e-9)


@given(corners=st.integers(3, 8), seed=st.integers(0, 10_000), width=st.floats(0.1, 0.4), height=st.floats(0.1, 0.4))
@settings(max_examples=60, deadline=None)
def test_any_convex_polygon(corners: int, seed: int, width: float, height: float) -> None:
    """Outlines of the table are not the only ones: random convex polygons against shapely."""
    rng = np.random.default_rng(seed)
    turn = (np.arange(corners) + rng.uniform(0.1, 0.9, corners)) * 2 * math.pi / corners
    own = 0.5 * np.column_stack((np.cos(turn), np.sin(turn)))
    edges = np.roll(own, -1, axis=0) - own
    normals = np.column_stack((edges[:, 1], -edges[:, 0])) / np.hypot(*edges.T)[:, None]
    offsets = (normals * own).sum(axis=1)
    form, counts = np.array([kernels.POLYGON]), np.array([corners])
    outlines = kernels.Outlines(form, counts, own[None], normals[None], offsets[None])
    p = np.array([0.03, -0.02, 0.7, width, height])
    rays, ranges = rays_around(seed, 50), np.empty(50)
    kernels.cast_rays(outlines, 0, p, rays, ranges)
    cos, sin = math.cos(0.7), math.sin(0.7)
    vertices = own * (width, height) @ np.array([[cos, sin], [-sin, cos]]) + p[:2]
    polygon = shapely.Polygon(vertices)
    for (x, y, dx, dy), distance in zip(rays[:4].T.tolist(), ranges.tolist(), strict=True):
        met = polygon.exterior.intersection(shapely.LineString([(x, y), (x + 3 * dx, y + 3 * dy)]))
        first = math.inf if met.is_empty else met.distance(shapely.Point(x, y))
        assert (math.inf if distance == kernels.FAR else distance) == pytest.approx(first, abs=1e-7)
