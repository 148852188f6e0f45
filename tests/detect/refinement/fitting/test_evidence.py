"""The priors of the kinds, and evidence that two kinds share."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from detect.refinement.fitting.evidence import (
    Anchor,
    KindPosterior,
    _merged_special_cases,
    compare_kinds,
    importance_sample,
    laplace_evidence,
    log_prior,
    mixture,
    size_bounds,
)
from detect.refinement.fitting.fit import SPECIAL_CASES, KindFit, distinct_modes, nearest_name
from detect.refinement.likelihood.geometry import JACOBIANS, primitive_of
from detect.refinement.likelihood.rays import RayBundle
from detect.refinement.likelihood.sensor_model import BeamModel
from detect.refinement.options import DEFAULTS
from prim.shapes import Kind, Primitive


@pytest.mark.parametrize("kind", Kind)
def test_the_prior_is_a_density_over_the_shapes(kind: Kind) -> None:
    """It integrates to 1 over the parameters that are canonical: each shape has one name."""
    rng, count = np.random.default_rng(0), 20_000
    options = replace(DEFAULTS.evidence, max_extent=1e3)
    lower, upper = np.log(size_bounds(kind, options))
    turns = 2 * math.pi if kind.has_angle else 1.0
    sizes = np.exp(rng.uniform(lower, upper, (count, len(kind.sizes))))
    angles = rng.uniform(0, 2 * math.pi, count)
    canonical = np.zeros(count, np.bool_)
    for number, (size, theta) in enumerate(zip(sizes.tolist(), angles.tolist(), strict=True)):
        named = Primitive(kind, 0.0, 0.0, theta if kind.has_angle else None, tuple(size))
        canonical[number] = (named.canonical().theta, named.canonical().size) == (named.theta, named.size)
    drawn = 1 / (turns * (sizes * (upper - lower)).prod(axis=1))
    assert (np.exp(log_prior(kind, sizes, options)) / drawn)[canonical].sum() / count == pytest.approx(1.0, abs=0.05)


def test_the_prior_of_sizes_has_no_scale() -> None:
    """Ten times the size has a tenth of the density, for each size."""
    small, large = (log_prior(Kind.RECTANGLE, np.array([size, size / 2])) for size in (0.05, 0.5))
    assert float(small - large) == pytest.approx(2 * math.log(10))


@pytest.mark.parametrize(("kind", "special"), SPECIAL_CASES.items())
def test_sizes_that_agree_give_their_evidence_to_the_special_case(kind: Kind, special: Kind) -> None:
    options = DEFAULTS.evidence

    def posterior(kind: Kind, log_evidence: float) -> KindPosterior:
        mean = np.array([0.0, 0.0, *([0.0] if kind.has_angle else []), 0.2, 0.2][: len(kind.parameters)])
        return KindPosterior(mean, np.eye(len(mean)), log_evidence, 0.0)

    sampled = {kind: posterior(kind, -3.0), special: posterior(special, -2.0)}
    merged = _merged_special_cases(sampled, lambda _: None, options)
    assert merged[special].log_evidence == pytest.approx(math.log(math.exp(-3) + math.exp(-2)))
    assert merged[kind].log_evidence == -math.inf
    apart = sampled[kind].mean.copy()
    apart[-1] -= 2 * options.same_sizes
    sampled[kind] = replace(sampled[kind], mean=apart)
    assert not _merged_special_cases(sampled, lambda _: None, options)


@pytest.mark.parametrize("largest", [1e3, 1e12, 3e16, 1e20])
def test_evidence_is_finite_however_much_the_rays_say_of_one_direction(largest: float) -> None:
    """Rays that touch a shape tell one direction of its parameters a million times as well as the others."""
    rng = np.random.default_rng(0)
    for _ in range(50):
        axes = np.linalg.qr(rng.normal(size=(4, 4)))[0]
        values = np.array([largest, 1e5, 1.0, 0.0])
        information = (axes * values) @ axes.T
        fit = KindFit(Kind.SQUARE, np.array([3.6, 2.5, 0.3, 0.05, 0.05]), 634.0, information)
        expected = -634.0 + 2 * math.log(2 * math.pi) - np.log(values + 1).sum() / 2
        expected += float(log_prior(Kind.SQUARE, fit.p[3:4]))
        assert laplace_evidence(fit) == pytest.approx(
            expected, abs=8.0
        )  # half of what rounding hides: ln 1e7 at most


RAYS = RayBundle(np.zeros((7, 0)), np.zeros(0, np.int8), np.zeros(0), np.zeros(0), np.zeros(0, np.int32))
SENSOR = BeamModel.create(0.01, 5.0)
ODD = [0.0, 1.0, -1.0, 1e6, 1e20, 1e300, -1e300, math.nan, math.inf]


@settings(max_examples=60, deadline=None)
@given(
    st.sampled_from([*Kind]),
    st.lists(st.sampled_from(ODD), min_size=25, max_size=25),
    st.sampled_from([0.0, 634.0, math.nan, math.inf, -math.inf, 1e300]),
)
@example(Kind.SQUARE, [0.0] * 25, 1e300)
@example(Kind.SQUARE, [0.0, 0.0, 1e20, 0.0, 0.0, 0.0, -1.0, *[0.0] * 4, 1.0, *[0.0] * 13], 0.0)
def test_degenerate_fits_have_a_finite_posterior_or_none(kind: Kind, entries: list[float], cost: float) -> None:
    """Whatever the information is: singular, indefinite, not finite."""
    size = JACOBIANS[kind].shape[1]
    information = np.array(entries).reshape(5, 5)[:size, :size]
    with np.errstate(all="ignore"):
        information = (information + information.T) / 2
    fit = KindFit(kind, np.array([0.5, 0.5, 0.3, 0.1, 0.1]), cost, information)
    posterior = compare_kinds([fit], RAYS, SENSOR)
    assert posterior is None or np.isfinite([*posterior.std.values(), *posterior.covariance.ravel()]).all()


def fit(kind: Kind, p: list[float], cost: float = 0.0, std: float = 0.002) -> KindFit:
    return KindFit(kind, np.array(p), cost, np.eye(JACOBIANS[kind].shape[1]) / std**2)


def test_two_symmetric_modes_have_the_covariance_of_their_mixture() -> None:
    """Sum of w (C + d d^T) about the likelier one; each mode counts by its evidence."""
    own = np.diag([1e-6, 1e-6, 1e-4, 4e-6, 1e-6])
    first = KindPosterior(np.array([0.5, 0.5, 0.3, 0.2, 0.15]), own, -10.0, 3.0)
    second = KindPosterior(np.array([0.5, 0.5, 0.3 + math.pi / 2, 0.22, 0.15]), own, -10.0 - math.log(3), 4.0)
    whole = mixture(Kind.TRIANGLE, [second, first])
    assert whole.mean is first.mean and whole.cost == 3.0
    assert whole.log_evidence == pytest.approx(-10 + math.log(4 / 3))
    apart = np.array([0.0, 0.0, math.pi / 2, 0.02, 0.0])
    np.testing.assert_allclose(whole.covariance, own + np.outer(apart, apart) / 4, atol=1e-15)
    assert mixture(Kind.TRIANGLE, [first]) is first


def test_displacements_of_modes_are_modulo_the_symmetry() -> None:
    """An angle just below pi is near one just above 0, and so are exchanged sizes after a quarter turn."""
    own = np.diag([1e-6, 1e-6, 1e-4, 4e-6, 1e-6])
    first = KindPosterior(np.array([0.5, 0.5, 0.01, 0.2, 0.15]), own, -10.0, 3.0)
    turned = KindPosterior(np.array([0.5, 0.5, math.pi / 2 - 0.01, 0.15, 0.2]), own, -10.0, 3.0)
    whole = mixture(Kind.RECTANGLE, [first, turned])
    assert whole.covariance[2, 2] == pytest.approx(1e-4 + 0.02**2 / 2)
    assert np.diag(whole.covariance)[3:] == pytest.approx([2.5e-6, 2.5e-6])


@pytest.mark.parametrize("kind", Kind)
def test_the_nearest_name_is_of_the_same_shape(kind: Kind) -> None:
    rng = np.random.default_rng(1)
    for _ in range(30):
        p, like = (np.array([*rng.normal(size=2), rng.uniform(-9, 9), *rng.uniform(0.1, 0.3, 2)]) for _ in range(2))
        p = JACOBIANS[kind] @ np.linalg.pinv(JACOBIANS[kind]) @ p
        named, _ = nearest_name(kind, p, like)
        before, after = primitive_of(kind, p), primitive_of(kind, named)
        np.testing.assert_allclose(after.outline().mean(axis=0), before.outline().mean(axis=0), atol=1e-9)
        assert after.size == pytest.approx(before.size)
        if kind.row.period is not None:
            assert abs(named[2] - like[2]) <= kind.row.period / 2 + math.pi / 2
            assert math.cos(2 * math.pi / kind.row.period * ((after.theta or 0) - (before.theta or 0))) > 1 - 1e-9


def test_fits_of_one_mode_count_once_and_unlikely_modes_not_at_all() -> None:
    best = fit(Kind.RECTANGLE, [0.5, 0.5, 0.3, 0.2, 0.1], 10.0)
    again = fit(Kind.RECTANGLE, [0.501, 0.5, 0.3 - math.pi / 2, 0.1, 0.2], 10.5)
    other = fit(Kind.RECTANGLE, [0.5, 0.5, 0.3, 0.2, 0.13], 12.0)
    unlikely = fit(Kind.RECTANGLE, [0.5, 0.5, 0.3, 0.2, 0.16], 10.0 + DEFAULTS.fit.mode_cost_margin)
    assert [mode.cost for mode in distinct_modes([again, unlikely, other, best])] == [10.0, 12.0]


def test_modes_that_overlap_add_no_evidence() -> None:
    """Without rays the likelihood is 1 everywhere: the evidence of one mode, and of the same in two parts."""
    one = fit(Kind.SQUARE, [0.5, 0.5, 0.3, 0.3, 0.3], std=0.02)
    alone = importance_sample([one], RAYS, SENSOR)
    twice = importance_sample([one, replace(one, p=one.p + np.array([0.001, 0.0, 0.0, 0.0, 0.0]))], RAYS, SENSOR)
    both = np.logaddexp(*(mode.log_evidence for mode in twice))
    assert both == pytest.approx(alone[0].log_evidence, abs=0.5)
    apart = importance_sample([one, replace(one, p=one.p + np.array([50.0, 0.0, 0.0, 0.0, 0.0]))], RAYS, SENSOR)
    total = np.logaddexp(*(mode.log_evidence for mode in apart))
    assert total == pytest.approx(alone[0].log_evidence + math.log(2), abs=0.1)


def test_a_fit_that_the_prior_allows_is_preferred_where_a_size_is_unseen() -> None:
    """The likelihood is the same however deep it is; a fit that wandered beyond the prior is no other mode."""
    deep = KindFit(Kind.RECTANGLE, np.array([0.5, 0.5, 0.0, 0.2, 1.2]), 9.9, np.diag([1e6, 0.1, 1e4, 1e6, 0.1]))
    shallow = replace(deep, p=np.array([0.5, 0.2, 0.0, 0.2, 0.3]), cost=10.0)
    assert distinct_modes([deep, shallow]) == [shallow]
    assert distinct_modes([replace(deep, cost=5.0), shallow])[0].cost == 5.0


@pytest.mark.parametrize("theta", [0.0, 1.1, -2.5])
def test_the_anchor_of_an_unseen_depth_is_the_side_that_is_seen(theta: float) -> None:
    """Shapes that turn about the middle of their front, whatever their depth, differ in angle and depth alone."""
    depth = np.array([-math.sin(theta), math.cos(theta)])
    covariance = np.zeros((5, 5))
    along = np.array([*(0.5 * depth), 0.0, 0.0, 1.0])  # deeper by 1: the centroid is half of that behind the front
    covariance += 0.04 * np.outer(along, along)
    one = fit(Kind.RECTANGLE, [*(0.15 * depth), theta, 0.2, 0.3])
    anchor = Anchor.of(one, covariance, DEFAULTS.evidence)
    assert anchor.shares == pytest.approx([0.0, 0.5])
    angles, depths = np.meshgrid(theta + np.linspace(-0.3, 0.3, 5), np.linspace(0.05, 0.6, 5))
    angles, depths = angles.ravel(), depths.ravel()
    behind = np.column_stack((-np.sin(angles), np.cos(angles))) * depths[:, None] / 2
    points = np.column_stack((behind, angles, np.full_like(angles, 0.2), depths))
    drawn = anchor.moved(points, -1.0)
    np.testing.assert_allclose(drawn[:, :2], 0.5 * depths[:, None] * depth, atol=1e-12)
    np.testing.assert_allclose(anchor.moved(drawn, 1.0), points, atol=1e-12)
    step = 1e-6 * np.eye(5)
    slopes = (anchor.moved(one.p + step, -1.0) - anchor.moved(one.p - step, -1.0)) / 2e-6
    np.testing.assert_allclose(slopes.T, anchor.linear(one.p, 5), atol=1e-6)
