"""How likely a kind is, and how sure its parameters: the likelihood of rays, averaged over all that they allow."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from detect.refinement.fit import SIMPLER, TIES, Fit, primitive_of
from detect.refinement.kernels import MISS, PARAMETERS, costs, margins, slopes
from detect.refinement.rays import FAMILY, Beams, Sensor
from prim.arrays import FloatArray
from prim.shapes import Kind, Primitive

SAME_SIZES = 0.0005
"""Sizes that differ by less than this (m) are the same: no thing is made, and no pose known, better."""

CONTENDER = 7.0
"""Kinds whose evidence is within this (nats) of the best one's are sampled."""

LONGEST = 0.7
"""Sizes are taken to be even up to this (m), before the rays are asked."""

SAMPLES = (300, 300, 600)
DEGREES = 6.0
"""So many samples are drawn in each round, from Student's t with so many degrees of freedom: its tails are heavy."""

EFFECTIVE = 0.15
"""In all rounds but the last, weights are made more alike until this share of the samples counts."""

LEAST_EFFECTIVE = 0.06
"""So are they in the last, until this share does: where fewer would, they would tell too small a spread."""

LEAST_STD = (1e-4, 1e-4, 1e-3, 1e-4, 1e-4)
MOST_TURN = 0.5
"""Bounds on what samples are spread over (m, rad)."""


def longest(kind: Kind) -> float:
    """What a kind's sizes stay below (m)."""
    return LONGEST / kind.extent


def log_prior(kind: Kind) -> float:
    """The logarithm of the density of a kind's parameters (but its place), before the rays are asked.

    All sizes up to LONGEST and all angles are alike. A rectangle is found in one of two ways to name its sides (and
    an ellipse its axes), each of them half of what it might be.
    """
    sizes = len(kind.sizes) * math.log(kind.extent / LONGEST)
    angle = 0.0 if kind.row.period is None else -math.log(kind.row.period)
    return sizes + angle + (math.log(2) if kind.longer_first else 0.0)


def laplace(fit: Fit, dispersion: float = 1.0) -> float:
    """The logarithm of a fit's evidence, where its likelihood is a Gaussian's."""
    size = len(fit.information)
    _, log_determinant = np.linalg.slogdet(fit.information / dispersion + np.eye(size))
    volume = 0.5 * (size * math.log(2 * math.pi) - log_determinant)
    return float(-fit.cost / dispersion + volume + log_prior(fit.kind))


@dataclass(frozen=True)
class Sampled:
    """A kind's own parameters (K,): mean and covariance; the logarithm of its evidence; the mean's cost (nats)."""

    mean: FloatArray
    covariance: FloatArray
    evidence: float
    cost: float
    effective: float


def sample(fit: Fit, beams: Beams, sensor: Sensor) -> Sampled:
    """A kind's parameters over all that rays allow, by importance sampling in rounds, each drawn from the last one's.

    Rays that surely hit the shape are summed up once, as a parabola around the fit; what is left to be asked for each
    sample is the few that pass so near to the silhouette that they might miss it or not.
    """
    tie = TIES[fit.kind]
    size = tie.shape[1]
    own = tie / (tie**2).sum(axis=0)
    at = fit.p @ own
    floor = np.array(LEAST_STD) @ own
    information = fit.information / sensor.dispersion + np.eye(size)
    mean, spread = at, _bounded(np.linalg.inv(information), fit.kind, floor)
    split = Split.of(fit, tie @ (16 * spread) @ tie.T, beams, sensor)
    rounds = _draws(size)
    for count, (standard, log_density) in enumerate(rounds, start=1):
        lower = np.linalg.cholesky(spread)
        points = mean + standard @ lower.T
        cost = split.costs(points @ tie.T)
        log_weight = -cost / sensor.dispersion - log_density + np.log(np.diag(lower)).sum()
        if not np.isfinite(log_weight).any():  # none of them is a primitive of a size that is looked for
            return Sampled(at, spread, -math.inf, fit.cost, 0.0)
        weight = np.exp(log_weight - log_weight.max())
        share = _tempered(weight, EFFECTIVE if count < len(rounds) else LEAST_EFFECTIVE)
        mean = share @ points
        centred = points - mean
        covariance = (share[:, None] * centred).T @ centred
        spread = _bounded(covariance, fit.kind, floor)
    evidence = float(log_weight.max() + np.log(weight.mean())) + log_prior(fit.kind)
    return Sampled(
        mean,
        covariance + np.diag(floor**2) / 100,
        evidence,
        float(split.costs((tie @ mean)[None])[0]),
        float(1 / (share**2).sum()),
    )


@dataclass(frozen=True)
class Split:
    """The cost of shapes near a fit: a parabola for the rays that surely hit, a constant for those that surely miss,
    and the rays that might do either.
    """

    fit: Fit
    constant: float
    gradient: FloatArray
    information: FloatArray
    unsure: Beams
    sensor: Sensor

    @classmethod
    def of(cls, fit: Fit, covariance: FloatArray, beams: Beams, sensor: Sensor) -> Split:
        """Splits beams by whether they hit shapes whose parameters have a ``covariance`` (5, 5) around the fit's."""
        sure = np.empty(len(beams))
        margins(FAMILY[fit.kind], fit.p, covariance, beams.rays, sensor.footprint, sure)
        hit, missed = sure > 1, sure < -1
        gradient, information = np.zeros(PARAMETERS), np.zeros((PARAMETERS, PARAMETERS))
        surely = beams.of(hit)
        constant = slopes(
            FAMILY[fit.kind],
            fit.p,
            surely.rays,
            surely.kinds,
            sensor.std,
            sensor.table,
            1e-9,
            gradient,
            information,
        )
        constant -= float(beams.rays[MISS, missed].sum())
        return cls(fit, constant, gradient, information, beams.of(~hit & ~missed), sensor)

    def costs(self, shapes: FloatArray) -> FloatArray:
        """The costs (nats) of shapes (M, 5); infinite where a size is none."""
        moved = shapes - self.fit.p
        parabola = self.constant + moved @ self.gradient + 0.5 * ((moved @ self.information) * moved).sum(axis=1)
        return np.asarray(parabola + exact_costs(self.fit.kind, shapes, self.unsure, self.sensor))


def _tempered(weight: FloatArray, least: float) -> FloatArray:
    """Weights, made more alike until this share of the samples counts."""
    power = 1.0
    share = weight / weight.sum()
    while 1 / (share**2).sum() < least * len(weight) and power > 1e-3:
        power *= 0.7
        share = weight**power / (weight**power).sum()
    return np.asarray(share)


def _bounded(covariance: NDArray[np.floating], kind: Kind, floor: FloatArray) -> FloatArray:
    """A covariance that samples can be drawn with: no narrower than ``floor``, no wider in angle than MOST_TURN."""
    bounded = covariance + np.diag(floor**2)
    if kind.has_angle and bounded[2, 2] > MOST_TURN**2:
        shrink = np.ones(len(bounded))
        shrink[2] = MOST_TURN / math.sqrt(bounded[2, 2])
        bounded = bounded * shrink * shrink[:, None]
    return np.asarray(bounded)


@lru_cache(maxsize=8)
def _draws(size: int) -> list[tuple[FloatArray, FloatArray]]:
    """Each round's samples (N, K) of Student's t around 0, in pairs that mirror each other, and their log-densities.

    They are the same every time.
    """
    rounds = []
    rng = np.random.default_rng(size)
    constant = math.lgamma((DEGREES + size) / 2) - math.lgamma(DEGREES / 2) - size / 2 * math.log(math.pi * DEGREES)
    for count in SAMPLES:
        normal = rng.standard_normal((count // 2, size))
        half = normal * np.sqrt(DEGREES / rng.chisquare(DEGREES, count // 2))[:, None]
        points = np.concatenate((half, -half))
        density = constant - (DEGREES + size) / 2 * np.log1p((points**2).sum(axis=1) / DEGREES)
        rounds.append((points, density))
    return rounds


def exact_costs(kind: Kind, shapes: FloatArray, beams: Beams, sensor: Sensor) -> FloatArray:
    """The exact costs (nats) of shapes (M, 5); infinite where a size is none, or longer than any."""
    out = np.empty(len(shapes))
    right = np.asarray(((shapes[:, 3:] > 1e-3) & (shapes[:, 3:] < longest(kind))).all(axis=1))
    safe = np.where(right[:, None], shapes, shapes[np.argmax(right)])
    costs(
        np.full(len(shapes), FAMILY[kind]),
        np.ascontiguousarray(safe),
        beams.rays,
        beams.kinds,
        sensor.std,
        sensor.table,
        sensor.footprint,
        out,
    )
    return np.where(right, out, np.inf)


@dataclass(frozen=True)
class Weighed:
    """The likeliest kind's primitive; ``std`` (m, rad) by name and ``covariance`` in their order; the ``chances`` of
    all kinds; the primitive's ``cost`` (nats).
    """

    primitive: Primitive
    std: Mapping[str, float]
    covariance: FloatArray
    chances: Mapping[Kind, float]
    cost: float


def weighed(
    fits: Sequence[Fit], beams: Beams, sensor: Sensor, may_be: Callable[[Primitive], bool] = lambda _: True
) -> Weighed | None:
    """Fits of several kinds to the same beams, weighed by their evidence; no kind is likelier beforehand.

    Those are left out whose primitive, over all that the rays allow, is none that ``may_be``. None where that leaves
    nothing, or where all are larger than a primitive is.
    """
    fits = [fit for fit in fits if (fit.p[3:] < longest(fit.kind)).all()]
    if not fits:
        return None
    rough = {fit.kind: laplace(fit, sensor.dispersion) for fit in fits}
    top = max(rough.values())
    sampled = {fit.kind: sample(fit, beams, sensor) for fit in fits if rough[fit.kind] > top - CONTENDER}
    sampled |= _simpler_ones(fits, sampled, beams, sensor)
    for kind, made in sampled.items():
        if not may_be(told(kind, made)[0]):
            sampled[kind] = replace(made, evidence=-math.inf)
    kind = max(sampled, key=lambda one: sampled[one].evidence)
    best = sampled[kind].evidence
    if best == -math.inf:
        return None
    weights = {one: math.exp(sampled[one].evidence - best if one in sampled else rough[one] - top) for one in rough}
    chances = {one: weights.get(one, 0.0) / sum(weights.values()) for one in Kind}
    primitive, std, covariance = told(kind, sampled[kind])
    return Weighed(primitive, std, covariance, chances, sampled[kind].cost)


def _simpler_ones(
    fits: Sequence[Fit], sampled: Mapping[Kind, Sampled], beams: Beams, sensor: Sensor
) -> dict[Kind, Sampled]:
    """Squares and circles for rectangles and ellipses whose sizes are the SAME_SIZES: these are no other kind.

    The simpler one gets all the evidence of both.
    """
    made = {}
    for kind, simpler in SIMPLER.items():
        fit = next((one for one in fits if one.kind is simpler), None)
        if fit is None or kind not in sampled or abs(sampled[kind].mean[3] - sampled[kind].mean[4]) > SAME_SIZES:
            continue
        simple = sampled.get(simpler) or sample(fit, beams, sensor)
        both = np.logaddexp(simple.evidence, sampled[kind].evidence)
        made[simpler] = replace(simple, evidence=float(both))
        made[kind] = replace(sampled[kind], evidence=-math.inf)
    return made


def told(kind: Kind, made: Sampled) -> tuple[Primitive, dict[str, float], FloatArray]:
    """The primitive that samples tell, its standard deviations by name, and its covariance in their order."""
    primitive = primitive_of(kind, TIES[kind] @ made.mean)
    names, covariance = kind.parameters, made.covariance
    if kind.longer_first and made.mean[3] < made.mean[4]:
        order = [0, 1, 2, 4, 3]
        covariance = covariance[np.ix_(order, order)]
    std = np.sqrt(np.diag(covariance)).tolist()
    return primitive, dict(zip(names, std, strict=True)), covariance
