"""Model comparison: the evidence (marginal likelihood) of kinds, and the posterior of their parameters.

The evidence is the likelihood integrated over the prior: a square that explains the rays as well as a rectangle does
is the likelier kind, since it has a size less to choose (Occam's factor; MacKay 2003, chapter 28). The prior is
uniform over sizes and angles, equal for all kinds, and flat over positions, which cancels in ratios. Where scans have
common errors the log-likelihood is divided by the dispersion (a power likelihood; Bissiri, Holmes and Walker 2016).

The evidence is first approximated by Laplace's method, and for the contenders computed by adaptive importance
sampling from Student's t. The samples of the last round, with tempered weights, give the posterior mean and
covariance.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from detect.refinement.fitting.fit import SPECIAL_CASES, KindFit
from detect.refinement.likelihood.geometry import JACOBIANS, NUMBERS, OUTLINES, primitive_of
from detect.refinement.likelihood.kernels import (
    BACKGROUND,
    PARAMETERS,
    gradient,
    negative_log_likelihoods,
    standardized_clearances,
)
from detect.refinement.likelihood.rays import RayBundle
from detect.refinement.likelihood.sensor_model import BeamModel
from detect.refinement.options import DEFAULTS, EvidenceOptions
from prim import linear_algebra
from prim.arrays import FloatArray
from prim.se2 import MAX_COORDINATE
from prim.shapes import Kind, Primitive

EXACT = 1e-9
"""m; the blur for rays that surely hit: as good as none."""

POSITIVE = 1e-3
"""m; a sample with a smaller size is no shape."""


def max_size(kind: Kind, options: EvidenceOptions = DEFAULTS.evidence) -> float:
    """Return the upper bound (m) of a kind's sizes under the prior.

    Args:
        kind: The kind.
        options: The largest extent.

    Returns:
        The bound (m): half the extent for radii and semi-axes.
    """
    return options.max_extent / kind.extent


def log_prior(kind: Kind, options: EvidenceOptions = DEFAULTS.evidence) -> float:
    """Return the log of the prior density of a kind's angle and sizes.

    Sizes are uniform up to :func:`max_size`, angles over the kind's period. Where the longer size is first by
    definition, each shape has two names in the parameters' full range, of which one is found.

    Args:
        kind: The kind.
        options: The largest extent.

    Returns:
        Nats (for metres and radians).
    """
    sizes = len(kind.sizes) * math.log(kind.extent / options.max_extent)
    angle = 0.0 if kind.row.period is None else -math.log(kind.row.period)
    return sizes + angle + (math.log(2) if kind.longer_first else 0.0)


def laplace_evidence(fit: KindFit, dispersion: float = 1.0, options: EvidenceOptions = DEFAULTS.evidence) -> float:
    """Approximate a fit's log evidence by Laplace's method.

    A Gaussian prior of 1 m and 1 rad around the fit keeps its volume finite where the rays leave a parameter open.

    Args:
        fit: The maximum-likelihood fit.
        dispersion: By which the log-likelihood is divided (quasi-likelihood; McCullagh and Nelder 1989).
        options: The prior.

    Returns:
        Nats.
    """
    size = len(fit.information)
    volume = 0.5 * (size * math.log(2 * math.pi) - _log_determinant(fit.information / dispersion + np.eye(size)))
    return float(-fit.cost / dispersion + volume + log_prior(fit.kind, options))


def _log_determinant(matrix: FloatArray) -> float:
    """Return the logarithm of the determinant of an information matrix (K, K) to which the unit matrix was added.

    Its eigenvalues are at least 1, which rounding can hide where the largest is beyond 1e16 times as large. Infinite
    where the matrix is not finite.
    """
    logarithm = linear_algebra.log_determinant(matrix)
    if logarithm is not None:
        return logarithm
    eigenvalues = linear_algebra.eigenvalues(matrix)
    return math.inf if eigenvalues is None else float(np.log(np.maximum(eigenvalues, 1.0)).sum())


@dataclass(frozen=True)
class KindPosterior:
    """The posterior of one kind's own parameters (K,).

    Attributes:
        mean: (K,).
        covariance: (K, K).
        log_evidence: Nats.
        cost: Negative log-likelihood at the mean (nats), by :class:`SplitCost`.
    """

    mean: FloatArray
    covariance: FloatArray
    log_evidence: float
    cost: float


def importance_sample(
    fit: KindFit, bundle: RayBundle, sensor: BeamModel, options: EvidenceOptions = DEFAULTS.evidence
) -> KindPosterior:
    """Compute a kind's posterior and evidence by adaptive importance sampling, each round drawn from the last one's.

    Args:
        fit: The maximum-likelihood fit.
        bundle: The rays.
        sensor: The sensor.
        options: The prior and the sampler's numbers.

    Returns:
        The posterior; its log evidence is -inf where no sample is a shape that the prior allows, or where the fit's
        information is not finite.
    """
    jacobian = JACOBIANS[fit.kind]
    size = jacobian.shape[1]
    own = jacobian / (jacobian**2).sum(axis=0)
    at = fit.p @ own
    floor = np.array(options.min_std) @ own
    information = fit.information / sensor.dispersion + np.eye(size)
    inverse = linear_algebra.inverse(information)
    impossible = KindPosterior(at, np.diag(floor**2), -math.inf, fit.cost)
    if inverse is None:
        return impossible
    mean, spread = at, _bounded(inverse, fit.kind, floor, options)
    wide = jacobian @ (options.sure_deviations**2 * spread) @ jacobian.T
    split = SplitCost.of(fit, wide, bundle, sensor, options)
    rounds = _draws(size, options)
    for count, (standard, log_density) in enumerate(rounds, start=1):
        lower = linear_algebra.cholesky(spread)
        if lower is None:
            return impossible
        points = mean + standard @ lower.T
        cost = split.costs(points @ jacobian.T)
        log_weight = -cost / sensor.dispersion - log_density + np.log(np.diag(lower)).sum()
        log_weight[~(np.isfinite(log_weight) & (np.abs(points) <= MAX_COORDINATE).all(axis=1))] = -math.inf
        if not np.isfinite(log_weight).any():
            return impossible
        weight = np.exp(log_weight - log_weight.max())
        last = count == len(rounds)
        share = _tempered(weight, options.min_effective_last if last else options.min_effective, options)
        mean = share @ points
        centred = points - mean
        covariance = (share[:, None] * centred).T @ centred
        spread = _bounded(covariance, fit.kind, floor, options)
    log_evidence = float(log_weight.max() + np.log(weight.mean())) + log_prior(fit.kind, options)
    return KindPosterior(
        mean,
        covariance + np.diag(floor**2) / 100,
        log_evidence,
        float(split.costs((jacobian @ mean)[None])[0]),
    )


@dataclass(frozen=True)
class SplitCost:
    """The negative log-likelihood of shapes near a fit, exact only where it must be.

    A second-order expansion for the rays that surely hit, a constant for those that surely miss, and the likelihood
    itself for the ``unsure`` ones near the silhouette.
    """

    fit: KindFit
    constant: float
    gradient: FloatArray
    information: FloatArray
    unsure: RayBundle
    sensor: BeamModel
    options: EvidenceOptions

    @classmethod
    def of(
        cls,
        fit: KindFit,
        covariance: FloatArray,
        bundle: RayBundle,
        sensor: BeamModel,
        options: EvidenceOptions = DEFAULTS.evidence,
    ) -> SplitCost:
        """Split rays by whether they hit all shapes within a region around the fit.

        Args:
            fit: The fit.
            covariance: (5, 5) that describes the region: one standard deviation to each side.
            bundle: The rays.
            sensor: The sensor.
            options: The prior's bounds.

        Returns:
            The cost.
        """
        number = NUMBERS[fit.kind]
        clearances = np.empty(len(bundle))
        standardized_clearances(OUTLINES, number, fit.p, covariance, bundle.rays, sensor.footprint, clearances)
        hit, missed = clearances > 1, clearances < -1
        slope, information = np.zeros(PARAMETERS), np.zeros((PARAMETERS, PARAMETERS))
        constant = gradient(OUTLINES, number, fit.p, sensor.data(bundle.select(hit)), EXACT, slope, information)
        constant -= float(bundle.rays[BACKGROUND, missed].sum())
        return cls(fit, constant, slope, information, bundle.select(~hit & ~missed), sensor, options)

    def costs(self, shapes: FloatArray) -> FloatArray:
        """Return the costs (M,) in nats of shapes (M, 5); infinite where a size is out of the prior's bounds."""
        moved = shapes - self.fit.p
        expansion = self.constant + moved @ self.gradient + 0.5 * ((moved @ self.information) * moved).sum(axis=1)
        return np.asarray(expansion + exact_costs(self.fit.kind, shapes, self.unsure, self.sensor, self.options))


def _tempered(weight: FloatArray, min_share: float, options: EvidenceOptions) -> FloatArray:
    """Return normalised importance weights, tempered until their effective sample size is this share at least."""
    power = 1.0
    share = weight / weight.sum()
    while 1 / (share**2).sum() < min_share * len(weight) and power > options.min_power:
        power *= options.tempering
        share = weight**power / (weight**power).sum()
    return np.asarray(share)


def _bounded(covariance: NDArray[np.floating], kind: Kind, floor: FloatArray, options: EvidenceOptions) -> FloatArray:
    """Return a proposal's covariance: no narrower than ``floor`` (K,), no wider in angle than the bound."""
    bounded = covariance + np.diag(floor**2)
    if kind.has_angle and bounded[2, 2] > options.max_turn**2:
        shrink = np.ones(len(bounded))
        shrink[2] = options.max_turn / math.sqrt(bounded[2, 2])
        bounded = bounded * shrink * shrink[:, None]
    return np.asarray(bounded)


@lru_cache(maxsize=8)
def _draws(size: int, options: EvidenceOptions) -> list[tuple[FloatArray, FloatArray]]:
    """Return each round's standard samples (N, K) of Student's t, in antithetic pairs, and their log densities (N,).

    They are the same every time, so that results are reproducible.
    """
    rounds = []
    rng = np.random.default_rng(size)
    nu = options.degrees
    constant = math.lgamma((nu + size) / 2) - math.lgamma(nu / 2) - size / 2 * math.log(math.pi * nu)
    for count in options.samples:
        normal = rng.standard_normal((count // 2, size))
        half = normal * np.sqrt(nu / rng.chisquare(nu, count // 2))[:, None]
        points = np.concatenate((half, -half))
        density = constant - (nu + size) / 2 * np.log1p((points**2).sum(axis=1) / nu)
        rounds.append((points, density))
    return rounds


def exact_costs(
    kind: Kind,
    shapes: FloatArray,
    bundle: RayBundle,
    sensor: BeamModel,
    options: EvidenceOptions = DEFAULTS.evidence,
) -> FloatArray:
    """Compute the exact negative log-likelihoods of shapes.

    Args:
        kind: Their kind.
        shapes: (M, 5) parameters.
        bundle: The rays.
        sensor: The sensor.
        options: The prior's bounds.

    Returns:
        (M,) in nats; infinite where a size is out of the prior's bounds.
    """
    out = np.empty(len(shapes))
    sizes = shapes[:, 3:]
    allowed = np.asarray(((sizes > POSITIVE) & (sizes < max_size(kind, options))).all(axis=1))
    safe = np.ascontiguousarray(np.where(allowed[:, None], shapes, shapes[np.argmax(allowed)]))
    numbers = np.full(len(shapes), NUMBERS[kind])
    negative_log_likelihoods(OUTLINES, numbers, safe, sensor.data(bundle), sensor.footprint, out)
    return np.where(allowed, out, np.inf)


@dataclass(frozen=True)
class Posterior:
    """The posterior over kinds and the likeliest kind's parameters.

    Attributes:
        primitive: The likeliest kind at its posterior mean.
        std: Standard deviations (m, rad) by parameter name.
        covariance: (K, K) in the same order.
        kind_probabilities: Posterior probabilities of all kinds; they sum to 1.
        cost: Negative log-likelihood of the primitive (nats), by :class:`SplitCost`.
    """

    primitive: Primitive
    std: Mapping[str, float]
    covariance: FloatArray
    kind_probabilities: Mapping[Kind, float]
    cost: float


def compare_kinds(
    fits: Sequence[KindFit],
    bundle: RayBundle,
    sensor: BeamModel,
    is_possible: Callable[[Primitive], bool] = lambda _: True,
    options: EvidenceOptions = DEFAULTS.evidence,
) -> Posterior | None:
    """Compare fits of several kinds to the same rays by their evidence, all kinds being equally likely a priori.

    Args:
        fits: One fit for each kind.
        bundle: The rays.
        sensor: The sensor.
        is_possible: Whether a primitive may be there at all; kinds whose posterior mean may not are left out.
        options: The prior and the sampler's numbers.

    Returns:
        The posterior, or None where no kind is left, all are larger than the prior allows, or none has a finite
        evidence.
    """
    fits = [fit for fit in fits if (fit.p[3:] < max_size(fit.kind, options)).all()]
    if not fits:
        return None
    rough = {fit.kind: laplace_evidence(fit, sensor.dispersion, options) for fit in fits}
    fits = [fit for fit in fits if math.isfinite(rough[fit.kind])]
    if not fits:
        return None
    rough = {fit.kind: rough[fit.kind] for fit in fits}
    top = max(rough.values())
    contenders = [fit for fit in fits if rough[fit.kind] >= top - options.contender]
    sampled = {fit.kind: importance_sample(fit, bundle, sensor, options) for fit in contenders}
    sampled |= _merged_special_cases(fits, sampled, bundle, sensor, options)
    for kind, posterior in sampled.items():
        if not is_possible(summarize(kind, posterior)[0]):
            sampled[kind] = replace(posterior, log_evidence=-math.inf)
    best = max(sampled, key=lambda kind: sampled[kind].log_evidence)
    highest = sampled[best].log_evidence
    if highest == -math.inf:
        return None
    weights = {
        kind: math.exp(sampled[kind].log_evidence - highest if kind in sampled else rough[kind] - top)
        for kind in rough
    }
    kind_probabilities = {kind: weights.get(kind, 0.0) / sum(weights.values()) for kind in Kind}
    primitive, std, covariance = summarize(best, sampled[best])
    return Posterior(primitive, std, covariance, kind_probabilities, sampled[best].cost)


def _merged_special_cases(
    fits: Sequence[KindFit],
    sampled: Mapping[Kind, KindPosterior],
    bundle: RayBundle,
    sensor: BeamModel,
    options: EvidenceOptions,
) -> dict[Kind, KindPosterior]:
    """Return squares and circles in the place of rectangles and ellipses whose sizes agree, with both's evidence."""
    merged = {}
    for kind, special in SPECIAL_CASES.items():
        fit = next((fit for fit in fits if fit.kind is special), None)
        if fit is None or kind not in sampled:
            continue
        if abs(sampled[kind].mean[3] - sampled[kind].mean[4]) > options.same_sizes:
            continue
        simple = sampled.get(special) or importance_sample(fit, bundle, sensor, options)
        both = np.logaddexp(simple.log_evidence, sampled[kind].log_evidence)
        merged[special] = replace(simple, log_evidence=float(both))
        merged[kind] = replace(sampled[kind], log_evidence=-math.inf)
    return merged


def summarize(kind: Kind, posterior: KindPosterior) -> tuple[Primitive, dict[str, float], FloatArray]:
    """Express a posterior in a primitive's canonical parameters.

    Args:
        kind: The kind.
        posterior: Its posterior.

    Returns:
        The primitive at the mean, standard deviations (m, rad) by name, and the covariance (K, K) in their order.
    """
    primitive = primitive_of(kind, JACOBIANS[kind] @ posterior.mean)
    covariance = posterior.covariance
    if kind.longer_first and posterior.mean[3] < posterior.mean[4]:
        order = [0, 1, 2, 4, 3]
        covariance = covariance[np.ix_(order, order)]
    std = np.sqrt(np.diag(covariance)).tolist()
    return primitive, dict(zip(kind.parameters, std, strict=True)), covariance
