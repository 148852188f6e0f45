"""None of the kinds: what else may explain a candidate's rays, and how likely that is.

Four hypotheses compete with the kinds for the same rays: a deformed primitive, a free polygon and templates of few
parameters (detect.refinement.outlines), which are shapes of their own, and a part of something larger, which goes on
in the map.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import shapely

from detect.refinement.candidates import Candidate
from detect.refinement.fitting.evidence import laplace_evidence
from detect.refinement.fitting.fit import KindFit, refit
from detect.refinement.likelihood.geometry import primitive_of
from detect.refinement.likelihood.rays import RayBundle
from detect.refinement.likelihood.sensor_model import BeamModel
from detect.refinement.options import DEFAULTS, OtherOptions
from detect.refinement.outlines.contact import contact_of, is_flush
from detect.refinement.outlines.flush import are_flush
from detect.refinement.outlines.free_outline import OutlineCost, StarOutline, fit_free_outline, score_test
from detect.refinement.outlines.polygons import contour_of, fit_polygons, polygon_starts
from detect.refinement.outlines.templates import fit_templates
from prim.arrays import FloatArray
from prim.metrics import outline_iou
from prim.shapes import Kind, Primitive


@dataclass(frozen=True)
class Alternative:
    """A hypothesis beside the kinds.

    Attributes:
        vertices: (V, 2) its outline in m, map frame.
        log_odds: Log Bayes factor against the likeliest kind (nats); of one that does not replace the kind the log
            odds themselves, since it says nothing of how many things there are of no kind.
        std: Standard deviation (m) of the outline, across it; the median over its vertices.
        reason: What it is, in words and numbers.
        replaces_kind: Whether a candidate is reported as this where it is likelier than the kinds; else the kind is
            reported, with the probability that is left.
    """

    vertices: FloatArray
    log_odds: float
    std: float
    reason: str
    replaces_kind: bool = True


def free_alternatives(
    candidate: Candidate, bundle: RayBundle, candidates: Sequence[Candidate], sensor: BeamModel
) -> list[Alternative]:
    """Fit outlines of no kind to a candidate's rays.

    Args:
        candidate: The fitted candidate.
        bundle: Its rays with their background.
        candidates: All candidates.
        sensor: The sensor.

    Returns:
        Those that differ from the likeliest kind's outline.
    """
    fits = refit(candidate.fits, bundle, sensor, candidate.options.fit) if candidate.is_rough else candidate.fits
    rated = [(laplace_evidence(fit, sensor.dispersion, candidate.options.evidence), fit) for fit in fits]
    rated.sort(key=lambda item: -item[0])
    evidence, best = rated[0]
    deformed = _deformed(candidate, best, bundle, sensor)
    polygon = _polygon(candidate, evidence, bundle, candidates, sensor)
    outline, other = primitive_of(best.kind, best.p).outline(), candidate.options.other
    found = _different([one for one in (deformed, polygon) if one is not None], outline, other)
    if any(one.log_odds > other.overwhelming for one in found):
        return found
    return found + _different(_templates(candidate, rated, bundle, sensor), outline, other)


def _different(found: Sequence[Alternative], outline: FloatArray, options: OtherOptions) -> list[Alternative]:
    """Return the alternatives that differ from the likeliest kind's outline (V, 2)."""
    return [one for one in found if outline_iou(one.vertices, outline) < 1 - options.min_difference]


def _deformed(candidate: Candidate, best: KindFit, bundle: RayBundle, sensor: BeamModel) -> Alternative | None:
    """Fit the deformed outline of the best kind; None where the score test promises too little."""
    options, other = candidate.options.outline, candidate.options.other
    blur = max(sensor.footprint, options.least_blur)
    star = StarOutline.of(primitive_of(best.kind, best.p), options)
    cost = OutlineCost(star, bundle, sensor, options)
    if score_test(cost, max(options.test_blur, blur), options)[1] < other.min_gain:
        return None
    fit = fit_free_outline(cost, blur, options)
    reason = f"a free outline explains its rays better by {fit.log_bayes_factor:.0f} nats"
    return Alternative(star.deformed(fit.coefficients, options), fit.log_bayes_factor, fit.std, reason)


def _polygon(
    candidate: Candidate, evidence: float, bundle: RayBundle, candidates: Sequence[Candidate], sensor: BeamModel
) -> Alternative | None:
    """Fit polygons; None where there is nothing to begin with."""
    options = candidate.options.polygon
    others = [other.current for other in candidates if other is not candidate]
    likeliest = {fit.kind: fit for fit in reversed(candidate.fits)}
    starts = polygon_starts([primitive_of(fit.kind, fit.p) for fit in likeliest.values()], options)
    contour = contour_of(candidate.current, candidate.cells, others, candidate.walls, options)
    if contour is not None:
        starts.append(contour)
    if not starts:
        return None
    fit = fit_polygons(starts, bundle, sensor, options)
    log_odds = fit.log_evidence - evidence - candidate.options.other.polygon_handicap
    reason = f"a polygon of {len(fit.vertices)} vertices explains its rays better by {log_odds:.0f} nats"
    return Alternative(fit.vertices, log_odds, fit.std, reason)


def _templates(
    candidate: Candidate, rated: Sequence[tuple[float, KindFit]], bundle: RayBundle, sensor: BeamModel
) -> list[Alternative]:
    """Fit templates in the frames of the fitted kinds, which come with their evidence, likeliest first."""
    options, evidence = candidate.options, rated[0][0]
    primitives = [primitive_of(fit.kind, fit.p) for _, fit in rated]
    found = []
    for fit in fit_templates(primitives, evidence, bundle, sensor, options.evidence, options.templates):
        log_odds = fit.log_evidence - evidence - options.other.template_handicap
        reason = f"{fit.name} explains its rays better by {log_odds:.0f} nats"
        found.append(Alternative(fit.vertices, log_odds, fit.std, reason))
    return found


def larger_alternatives(
    candidate: Candidate, primitive: Primitive, std: float, others: Sequence[Primitive], sensor: BeamModel
) -> list[Alternative]:
    """Ask whether a candidate is a part of something larger.

    Args:
        candidate: The fitted candidate.
        primitive: What it is reported as.
        std: Standard deviation (m) of its place.
        others: The other primitives that are reported.
        sensor: The sensor.

    Returns:
        The hypotheses; none where nothing unexplained touches the candidate, and no side of it is flush with what is
        beside it.
    """
    options = candidate.options
    outline, found = primitive.outline(), []
    rays = candidate.bundle if candidate.around is None else candidate.around
    contact = contact_of(primitive, rays, candidate.cells, others, candidate.walls, sensor, options.contact)
    if contact.cells:
        nats = contact.nats
        reason = f"a part of something larger: its rays are likelier by {nats:.0f} nats with what touches it"
        found.append(Alternative(outline, nats - options.contact.min_nats, std, reason))
    beside_other = any(are_flush(primitive, other, options.touching) for other in others)
    if beside_other or is_flush(primitive, candidate.cells, options.contact):
        reason = "one side is flush with what is beside it: as likely a part of that"
        found.append(Alternative(outline, math.log(options.other.flush), std, reason, replaces_kind=False))
    return found


def other_log_odds(
    alternatives: Sequence[Alternative], likeliest_kind: float, options: OtherOptions = DEFAULTS.other
) -> float:
    """Return the log posterior odds of «none of the kinds».

    Args:
        alternatives: The hypotheses, each with its odds against the likeliest kind.
        likeliest_kind: Posterior probability of that kind among the kinds.
        options: The prior.

    Returns:
        Nats; -inf where there is no alternative.
    """
    if not alternatives:
        return -math.inf
    prior = prior_log_odds(options)
    together = float(np.logaddexp.reduce([one.log_odds + prior * one.replaces_kind for one in alternatives]))
    return together + math.log(max(likeliest_kind, 1 / len(Kind)))


def other_probability(
    alternatives: Sequence[Alternative], likeliest_kind: float, options: OtherOptions = DEFAULTS.other
) -> float:
    """Return the posterior probability of «none of the kinds».

    Args:
        alternatives: The hypotheses, each with its odds against the likeliest kind.
        likeliest_kind: Posterior probability of that kind among the kinds.
        options: The prior.

    Returns:
        0 to 1; 0 where there is no alternative.
    """
    return float(np.exp(-np.logaddexp(0.0, -other_log_odds(alternatives, likeliest_kind, options))))


def expected_share(log_odds: Sequence[float], options: OtherOptions = DEFAULTS.other) -> float:
    """Estimate the share of things that are none of the kinds from all things of a log together.

    In a building most things are none of the kinds, in a hall of pallets most are rectangles: the share is a
    parameter of the log (empirical Bayes; Robbins 1956), with a Dirichlet prior of one count for each kind and one
    for none of them, found by expectation and maximisation.

    Args:
        log_odds: Of each thing, the log posterior odds (nats) of «none of the kinds» under ``options.prior``.
        options: The prior, and when the iteration ends.

    Returns:
        The share; about ``options.prior`` where there are few things.
    """
    factors = np.asarray(log_odds, float) - prior_log_odds(options)
    counts = 1 / options.prior
    share = options.prior
    for _ in range(options.share_rounds):
        odds = prior_log_odds(replace(options, prior=share)) + factors
        share = (1 + float(np.exp(-np.logaddexp(0.0, -odds)).sum())) / (counts + len(factors))
    return share


def prior_log_odds(options: OtherOptions = DEFAULTS.other) -> float:
    """Return the log prior odds of «none of the kinds» against one kind; the kinds share what is left evenly."""
    return math.log(options.prior / (1 - options.prior)) + math.log(len(Kind))


def simple_outline(vertices: FloatArray) -> FloatArray:
    """Return a closed outline (V, 2) that does not cross itself: the largest part where it does."""
    polygon = shapely.Polygon(vertices)
    if polygon.is_valid:
        return vertices
    parts = shapely.get_parts(shapely.make_valid(polygon))
    areas = [part.area for part in parts]
    return np.asarray(shapely.get_coordinates(shapely.get_exterior_ring(parts[int(np.argmax(areas))]))[:-1])
