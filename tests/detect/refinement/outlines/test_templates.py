"""Templates: outlines, derivatives, starts, and which of them rays of a noise of 250 mm decide for."""

from __future__ import annotations

import math

import numpy as np
import pytest
import shapely

from detect.refinement.fitting.evidence import laplace_evidence
from detect.refinement.fitting.fit import fit_all_kinds, refit
from detect.refinement.likelihood.geometry import primitive_of
from detect.refinement.likelihood.kernels import BACKGROUND, FAR, OCCLUSION, RANGE
from detect.refinement.likelihood.rays import RayBundle
from detect.refinement.likelihood.sensor_model import BeamModel, surface_likelihood
from detect.refinement.options import DEFAULTS
from detect.refinement.outlines.free_outline import ranges_of
from detect.refinement.outlines.templates import (
    POSE,
    TEMPLATES,
    Cost,
    Template,
    TemplateFit,
    fit_templates,
    starts_of,
)
from prim.arrays import FloatArray
from prim.metrics import outline_iou
from prim.shapes import Kind, Primitive

NAMED = {template.name: template for template in TEMPLATES}
EVERY = pytest.mark.parametrize("template", TEMPLATES, ids=lambda template: template.name)
NOISE, BEHIND = 0.25, 0.4


def parameters(template: Template, share: float = 0.4) -> FloatArray:
    odds = math.log(share / (1 - share))
    return np.array([0.02, -0.01, 0.3, *[0.3, 0.25][: template.rigid - POSE], *[odds] * template.shares])


def rays_of(outline: FloatArray, seed: int = 0) -> tuple[RayBundle, BeamModel]:
    """Return rays from all around, with something 0.4 m behind the outline's middle."""
    rng, stops, count = np.random.default_rng(seed), 60, 60
    turn = np.repeat(rng.uniform(0, 2 * math.pi, stops), count)
    far = np.repeat(rng.uniform(0.4, 1.2, stops), count)
    aim = rng.uniform(-0.3, 0.3, stops * count)
    origins = np.stack((far * np.cos(turn), far * np.sin(turn)))
    away = np.stack((-aim * np.sin(turn), aim * np.cos(turn))) - origins
    rays = np.zeros((7, stops * count))
    rays[:2], rays[2:4], rays[OCCLUSION] = origins, away / np.hypot(*away), FAR
    scan = np.repeat(np.arange(stops, dtype=np.int32), count)
    bundle = RayBundle(rays, np.zeros(len(turn), np.int8), np.zeros(len(turn)), np.full(len(turn), 10.0), scan)
    rays[RANGE] = np.minimum(ranges_of(outline, bundle), far + BEHIND) + rng.normal(0, NOISE, len(turn))
    sensor = BeamModel.create(NOISE, 10.0)
    behind = surface_likelihood(bundle, far + BEHIND, np.ones(len(turn), np.bool_), 0.0, sensor)
    rays[BACKGROUND] = np.log(behind)
    return bundle, sensor


def fitted(outline: FloatArray, guess: Primitive) -> tuple[list[Primitive], float, list[TemplateFit]]:
    """Return the fitted kinds, likeliest first, the log evidence of that one, and the fitted templates."""
    bundle, sensor = rays_of(outline)
    fits = refit(fit_all_kinds(guess, [], bundle, sensor), bundle, sensor)
    fits.sort(key=lambda fit: -laplace_evidence(fit))
    primitives = [primitive_of(fit.kind, fit.p) for fit in fits]
    evidence = laplace_evidence(fits[0])
    return primitives, evidence, fit_templates(primitives, evidence, bundle, sensor)


@EVERY
@pytest.mark.parametrize("share", [0.1, 0.4, 0.9])
def test_outlines_are_simple_counter_clockwise_and_fill_no_more_than_the_box(
    template: Template, share: float
) -> None:
    unit = template.unit(np.full(template.shares, share))
    assert np.abs(unit).max() <= 0.5 + 1e-9
    polygon = shapely.Polygon(unit)
    assert polygon.is_valid and polygon.exterior.is_ccw and polygon.area > 0.01


@EVERY
def test_the_jacobian_is_that_of_the_vertices(template: Template) -> None:
    q, step = parameters(template), 1e-6
    jacobian = template.jacobian(q)
    for n in range(len(q)):
        move = step * np.eye(len(q))[n]
        slope = (template.vertices(q + move) - template.vertices(q - move)).ravel() / (2 * step)
        assert jacobian[:, n] == pytest.approx(slope, abs=1e-4)


@pytest.mark.parametrize("name", ["an L", "a notched box", "a parallelogram"])
def test_the_gradient_is_that_of_the_cost(name: str) -> None:
    template, step, blur = NAMED[name], 1e-6, 0.03
    q = parameters(template)
    bundle, sensor = rays_of(template.vertices(q))
    cost = Cost.of_rays(bundle, len(bundle), sensor, 0.7, DEFAULTS.templates)
    q += 0.01
    there = cost.expand(template, q, blur)
    for n in range(len(q)):
        move = step * np.eye(len(q))[n]
        slope = (cost.expand(template, q + move, blur).cost - cost.expand(template, q - move, blur).cost) / (2 * step)
        assert there.gradient[n] == pytest.approx(slope, rel=0.02, abs=0.01 * math.sqrt(there.curvature[n, n]))


@pytest.mark.parametrize("template", [one for one in TEMPLATES if one.tied], ids=lambda one: one.name)
def test_a_template_has_as_many_names_as_it_says(template: Template) -> None:
    """Of all turns by which a tied one stays the same, the smallest is a full turn over the number of names."""
    q = parameters(template)
    outline = shapely.Polygon(template.vertices(q))
    same = []
    for turn in range(1, 841):
        q[2] += 2 * math.pi / 840
        same += [turn] if outline.symmetric_difference(shapely.Polygon(template.vertices(q))).area < 1e-6 else []
    assert same == [840 // template.names * n for n in range(1, template.names + 1)]


@pytest.mark.parametrize("kind", Kind)
def test_starts_have_the_place_and_the_size_of_the_kind(kind: Kind) -> None:
    primitive = Primitive(kind, 0.3, 0.2, 0.5 if kind.has_angle else None, (0.2, 0.15)[: len(kind.sizes)])
    shape = shapely.Polygon(primitive.outline())
    starts = starts_of([primitive])
    assert starts
    for template, q in starts:
        start = shapely.Polygon(template.vertices(q))
        assert start.convex_hull.intersection(shape).area > 0.6 * shape.area, template.name


@pytest.mark.parametrize(
    ("name", "share", "guess"),
    [
        ("an L", 0.5, Kind.RECTANGLE),
        ("a U", 0.5, Kind.RECTANGLE),
        ("a kite", 0.3, Kind.TRIANGLE),
        ("a stadium", 0.6, Kind.ELLIPSE),
        ("a star of 5 points", 0.6, Kind.CIRCLE),
        ("a regular polygon of 6 sides", 0.5, Kind.CIRCLE),
    ],
)
def test_rays_of_a_template_decide_for_it(name: str, share: float, guess: Kind) -> None:
    outline = NAMED[name].vertices(parameters(NAMED[name], share))
    size = (0.12, 0.1)[: len(guess.sizes)] if guess.is_round else (0.28, 0.22)
    _, evidence, fits = fitted(outline, Primitive(guess, 0.02, -0.01, 0.3 if guess.has_angle else None, size))
    best = max(fits, key=lambda fit: fit.log_evidence)
    assert best.name == name and best.log_evidence > evidence + 5
    assert outline_iou(best.vertices, outline) > 0.75
    assert 0 < best.std < 0.01


@pytest.mark.parametrize("kind", Kind)
def test_rays_of_a_kind_decide_for_it(kind: Kind) -> None:
    size = (0.12, 0.08) if kind.is_round else (0.28, 0.2)
    true = Primitive(kind, 0.02, -0.01, 0.3 if kind.has_angle else None, size[: len(kind.sizes)])
    primitives, evidence, fits = fitted(true.outline(), true)
    assert primitives[0].kind is kind
    limit = 1 - DEFAULTS.other.min_difference
    different = [fit for fit in fits if outline_iou(fit.vertices, primitives[0].outline()) < limit]
    assert all(fit.log_evidence < evidence - 1 for fit in different)
