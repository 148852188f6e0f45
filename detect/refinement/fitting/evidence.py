"""Model comparison: the evidence (marginal likelihood) of kinds, and the posterior of their parameters.

The evidence is the likelihood integrated over the prior: a square that explains the rays as well as a rectangle does
is the likelier kind, since it has a size less to choose (Occam's factor; MacKay 2003, chapter 28). The prior is
scale-free over sizes, uniform over angles, equal for all kinds, and flat over positions, which cancels in ratios.
Where scans have common errors the log-likelihood is divided by the dispersion (a power likelihood; Bissiri, Holmes
and Walker 2016).

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

from detect.refinement.fitting.fit import SPECIAL_CASES, KindFit, nearest_name
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


def size_bounds(kind: Kind, options: EvidenceOptions = DEFAULTS.evidence) -> tuple[float, float]:
    """Return the bounds (m) of a kind's sizes under the prior.

    Args:
        kind: The kind.
        options: The wanted sizes.

    Returns:
        The bounds (m): half of the extents' for radii and semi-axes.
    """
    lower, upper = options.bounds
    return lower / kind.extent, upper / kind.extent


def log_prior(kind: Kind, sizes: FloatArray, options: EvidenceOptions = DEFAULTS.evidence) -> FloatArray:
    """Return the log of the prior density of a kind's angle and sizes.

    The logarithms of sizes are uniform (Jeffreys' prior of a scale) between the bounds that all wanted things allow,
    angles over the kind's period. Where the longer size is first by definition, each shape has two names in the
    parameters' full range, of which one is found.

    Args:
        kind: The kind.
        sizes: (..., S) its own sizes (m).
        options: The wanted sizes.

    Returns:
        (...) in nats (for metres and radians).
    """
    angle = 0.0 if kind.row.period is None else -math.log(kind.row.period)
    names = math.log(2) if kind.longer_first else 0.0
    densities = options.log_size_density - np.log(np.maximum(sizes, POSITIVE))
    return np.asarray(densities.sum(axis=-1) + angle + names)


def _own_sizes(kind: Kind, points: FloatArray) -> FloatArray:
    """Return the sizes (..., S) among a kind's own parameters (..., K)."""
    return points[..., -len(kind.sizes) :]


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
    jacobian = JACOBIANS[fit.kind]
    own = fit.p @ (jacobian / (jacobian**2).sum(axis=0))
    return float(-fit.cost / dispersion + volume + log_prior(fit.kind, _own_sizes(fit.kind, own), options))


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
    """The posterior of one kind's own parameters (K,), or of one of its modes.

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
    fits: Sequence[KindFit], bundle: RayBundle, sensor: BeamModel, options: EvidenceOptions = DEFAULTS.evidence
) -> list[KindPosterior]:
    """Compute the posterior and evidence of a kind's modes by adaptive importance sampling.

    Each round is drawn from the posterior as the one before has it, each mode by itself. The samples of all modes'
    last rounds are weighted as drawn from the mixture of their proposals (the balance heuristic; Veach and Guibas
    1995), so that nothing counts twice where modes overlap: evidences of modes add up to that of the kind.

    Args:
        fits: The modes of one kind, as :func:`detect.refinement.fitting.fit.distinct_modes` names them.
        bundle: The rays.
        sensor: The sensor.
        options: The prior and the sampler's numbers.

    Returns:
        The posterior of each mode; its log evidence is -inf where no sample is a shape that the prior allows, or
        where the fit's information is not finite.
    """
    drawn = [_draw_last_round(fit, bundle, sensor, options) for fit in fits]
    rounds = [one for one in drawn if isinstance(one, Round)]
    posteriors = iter(_posteriors_of(rounds, sensor, options))
    return [next(posteriors) if isinstance(one, Round) else one for one in drawn]


@dataclass(frozen=True)
class Anchor:
    """Which point of a shape keeps its place as the shape turns and grows: where rays see one side only, that side.

    Samples are drawn of the anchor's place in that of the centroid's. The posterior of a long, unseen size is curved
    in the centroid's (it moves sideways as the shape turns), not in the anchor's. The volume is the same.

    Attributes:
        theta: The fit's angle (rad).
        shares: (2,) shares of width and height that the centroid lies beyond the anchor, in the shape's own frame;
            0 where the centroid is the anchor.
    """

    theta: float
    shares: FloatArray

    @classmethod
    def of(cls, fit: KindFit, covariance: FloatArray, options: EvidenceOptions) -> Anchor:
        """Find the anchor: how the centroid moves with sizes that are unseen.

        Args:
            fit: The fit.
            covariance: (5, 5) of its parameters.
            options: From which relative standard deviation on a size is unseen.

        Returns:
            The anchor; the centroid itself where all sizes are seen.
        """
        shares = np.zeros(2)
        turn = _rotation(np.array([fit.p[2]]))[0]
        for axis, size in enumerate((3, 4)):
            variance = covariance[size, size]
            if fit.kind.has_angle and variance > (options.unseen_size * fit.p[size]) ** 2:
                shares[axis] = np.clip(turn[:, axis] @ covariance[:2, size] / variance, -0.5, 0.5)
        return cls(float(fit.p[2]), shares)

    def moved(self, points: FloatArray, sign: float) -> FloatArray:
        """Change between the anchor's place and the centroid's.

        Args:
            points: (N, K) parameters.
            sign: 1 from the anchor's to the centroid's, -1 for the reverse.

        Returns:
            (N, K).
        """
        if not self.shares.any():
            return points
        sizes = points[:, 3:] if points.shape[1] > 4 else np.repeat(points[:, 3:], 2, axis=1)
        turns = _rotation(points[:, 2]) - _rotation(np.array([self.theta]))
        moved = points.copy()
        moved[:, :2] += sign * np.einsum("nij,nj->ni", turns, sizes * self.shares)
        return moved

    def linear(self, p: FloatArray, size: int) -> FloatArray:
        """Return the Jacobian of the anchor's parameters by the centroid's at the fit.

        Args:
            p: (5,) the fit's parameters.
            size: How many own parameters the kind has.

        Returns:
            (K, K).
        """
        made = np.eye(size)
        if self.shares.any():
            cos, sin = math.cos(self.theta), math.sin(self.theta)
            made[:2, 2] = -np.array([[-sin, -cos], [cos, -sin]]) @ (p[3:] * self.shares)
        return made


def _rotation(theta: FloatArray) -> FloatArray:
    """Return the rotation matrices (N, 2, 2) of angles (N,)."""
    cos, sin = np.cos(theta), np.sin(theta)
    return np.stack((np.stack((cos, -sin), axis=-1), np.stack((sin, cos), axis=-1)), axis=-2)


@dataclass(frozen=True)
class Round:
    """Samples of one mode, drawn from Student's t.

    Attributes:
        split: The cost function.
        anchor: In whose place of the centroid's the proposal is Student's t.
        mean: (K,) of the proposal.
        lower: (K, K) the Cholesky factor of its covariance's scale.
        points: (N, K), by the centroid.
        log_weight: (N,) log of likelihood and prior over the proposal's density; -inf where there is no such shape.
    """

    split: SplitCost
    anchor: Anchor
    mean: FloatArray
    lower: FloatArray
    points: FloatArray
    log_weight: FloatArray

    @property
    def effective(self) -> float:
        """The effective sample size (Kong 1992)."""
        weight = np.exp(self.log_weight - self.log_weight.max())
        return float(weight.sum() ** 2 / (weight**2).sum())


def _draw_last_round(
    fit: KindFit, bundle: RayBundle, sensor: BeamModel, options: EvidenceOptions
) -> Round | KindPosterior:
    """Draw rounds of samples around a fit, each from the last one's posterior; return the last one.

    There are more rounds where its effective sample size is small. Where there is no posterior, one without evidence
    is returned.
    """
    jacobian = JACOBIANS[fit.kind]
    size = jacobian.shape[1]
    own = jacobian / (jacobian**2).sum(axis=0)
    floor = _floor(fit.kind, options)
    information = fit.information / sensor.dispersion + np.eye(size)
    inverse = linear_algebra.inverse(information)
    impossible = KindPosterior(fit.p @ own, np.diag(floor**2), -math.inf, fit.cost)
    if inverse is None:
        return impossible
    spread = _bounded(inverse, fit.kind, floor, options)
    wide = jacobian @ (options.sure_deviations**2 * spread) @ jacobian.T
    anchor = Anchor.of(fit, jacobian @ spread @ jacobian.T, options)
    change = anchor.linear(fit.p, size)
    mean, spread = fit.p @ own, change @ spread @ change.T if anchor.shares.any() else spread
    split = SplitCost.of(fit, wide, bundle, sensor, options)
    planned = [*options.samples, *options.more_samples]
    for number, (standard, log_density) in enumerate(_draws(size, options), start=1):
        lower = linear_algebra.cholesky(spread)
        if lower is None:
            return impossible
        drawn = mean + standard @ lower.T
        points = anchor.moved(drawn, 1.0)
        cost = split.costs(points @ jacobian.T)
        log_weight = -cost / sensor.dispersion - log_density + np.log(np.diag(lower)).sum()
        log_weight += log_prior(fit.kind, _own_sizes(fit.kind, points), options)
        log_weight[~(np.isfinite(log_weight) & (np.abs(points) <= MAX_COORDINATE).all(axis=1))] = -math.inf
        if not np.isfinite(log_weight).any():
            return impossible
        made = Round(split, anchor, mean, lower, points, log_weight)
        enough = number >= len(options.samples) and made.effective >= options.enough_effective
        if enough or number == len(planned):
            break
        weight = np.exp(log_weight - log_weight.max())
        mean, covariance = _moments(drawn, _tempered(weight, options.min_effective * len(weight), options))
        spread = _bounded(covariance, fit.kind, floor, options)
    return made


def _floor(kind: Kind, options: EvidenceOptions) -> FloatArray:
    """Return the least standard deviations (K,) of a proposal, by a kind's own parameters."""
    jacobian = JACOBIANS[kind]
    return np.asarray(np.array(options.min_std) @ (jacobian / (jacobian**2).sum(axis=0)))


def _moments(points: FloatArray, share: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the mean (K,) and covariance (K, K) of points (N, K) with weights (N,) that sum to 1."""
    mean = share @ points
    centred = points - mean
    return mean, (share[:, None] * centred).T @ centred


def _posteriors_of(rounds: Sequence[Round], sensor: BeamModel, options: EvidenceOptions) -> list[KindPosterior]:
    """Return the posteriors of a kind's modes from the samples of all of them.

    A sample counts for each mode by the share of that mode's proposal in the density of the mixture there.
    """
    if not rounds:
        return []
    kind = rounds[0].split.fit.kind
    counts = np.array([len(one.points) for one in rounds])
    points = np.concatenate([one.points for one in rounds])
    log_weight = np.concatenate([one.log_weight for one in rounds])
    shares = np.ones((1, len(points)))
    if len(rounds) > 1:
        densities = np.array([_log_density(one, points, options) for one in rounds])
        densities += np.log(counts / counts.sum())[:, None]
        mixture = np.logaddexp.reduce(densities)
        shares = np.exp(densities - mixture)
        own = np.repeat(np.arange(len(rounds)), counts), np.arange(len(points))
        log_weight = log_weight + densities[own] - np.log(counts / counts.sum())[own[0]] - mixture
    weight = np.exp(log_weight - log_weight.max())
    posteriors = []
    for one, share in zip(rounds, shares, strict=True):
        part = weight * share
        least = options.min_effective_last * len(one.points)
        mean, covariance = _moments(points, _tempered(part, least, options))
        log_evidence = float(log_weight.max() + np.log(part.mean()))
        cost = float(one.split.costs((JACOBIANS[kind] @ mean)[None])[0])
        covariance = covariance + np.diag(_floor(kind, options) ** 2) / 100
        posteriors.append(KindPosterior(mean, covariance, log_evidence, cost))
    return posteriors


def _log_density(one: Round, points: FloatArray, options: EvidenceOptions) -> FloatArray:
    """Return the log density (N,) at points (N, K) of the proposal that a round was drawn from."""
    standard = linear_algebra.solve(one.lower, (one.anchor.moved(points, -1.0) - one.mean).T)
    if standard is None:
        return np.full(len(points), -math.inf)
    scale = float(np.log(np.diag(one.lower)).sum())
    return np.asarray(_log_density_of_t((standard**2).sum(axis=0), len(one.mean), options.degrees) - scale)


def mixture(kind: Kind, modes: Sequence[KindPosterior]) -> KindPosterior:
    """Compute the posterior of a kind from those of its modes.

    Args:
        kind: The kind.
        modes: The posteriors of its modes.

    Returns:
        The mean of the likeliest mode; the covariance of the whole mixture about it, sum of w (C + d d^T) over modes
        with weights w, covariances C and displacements d of their means, each by the nearest name of its shape; and
        the sum of the evidences.
    """
    best = max(modes, key=lambda mode: mode.log_evidence)
    if len(modes) == 1 or best.log_evidence == -math.inf:
        return best
    weights = np.exp([mode.log_evidence - best.log_evidence for mode in modes])
    jacobian = JACOBIANS[kind]
    own = jacobian / (jacobian**2).sum(axis=0)
    covariance = np.zeros_like(best.covariance)
    for weight, mode in zip(weights / weights.sum(), modes, strict=True):
        p, order = nearest_name(kind, jacobian @ mode.mean, jacobian @ best.mean)
        apart = p @ own - best.mean
        covariance += weight * (mode.covariance[np.ix_(order, order)] + np.outer(apart, apart))
    return replace(best, covariance=covariance, log_evidence=best.log_evidence + math.log(weights.sum()))


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


def _tempered(weight: FloatArray, least: float, options: EvidenceOptions) -> FloatArray:
    """Return normalised importance weights, tempered until their effective sample size is this at least."""
    power = 1.0
    share = weight / weight.sum()
    while 1 / (share**2).sum() < least and power > options.min_power:
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
    for count in (*options.samples, *options.more_samples):
        normal = rng.standard_normal((count // 2, size))
        half = normal * np.sqrt(nu / rng.chisquare(nu, count // 2))[:, None]
        points = np.concatenate((half, -half))
        rounds.append((points, _log_density_of_t((points**2).sum(axis=1), size, nu)))
    return rounds


def _log_density_of_t(squares: FloatArray, size: int, nu: float) -> FloatArray:
    """Return the log density (N,) of Student's t in so many dimensions, at these squared distances (N,)."""
    constant = math.lgamma((nu + size) / 2) - math.lgamma(nu / 2) - size / 2 * math.log(math.pi * nu)
    return np.asarray(constant - (nu + size) / 2 * np.log1p(squares / nu))


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
    sizes, (lower, upper) = shapes[:, 3:], size_bounds(kind, options)
    allowed = np.asarray(((sizes > lower) & (sizes < upper)).all(axis=1))
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
        fits: The modes of each kind.
        bundle: The rays.
        sensor: The sensor.
        is_possible: Whether a primitive may be there at all; modes whose posterior mean may not are left out.
        options: The prior and the sampler's numbers.

    Returns:
        The posterior, or None where no kind is left, all are larger than the prior allows, or none has a finite
        evidence.
    """
    fits = [fit for fit in fits if (fit.p[3:] < size_bounds(fit.kind, options)[1]).all()]
    rated = [(laplace_evidence(fit, sensor.dispersion, options), fit) for fit in fits]
    rated = [(nats, fit) for nats, fit in rated if math.isfinite(nats)]
    if not rated:
        return None
    rough = {
        kind: max(nats for nats, fit in rated if fit.kind is kind) for kind in dict.fromkeys(f.kind for _, f in rated)
    }
    top = max(rough.values())
    modes = {
        kind: [fit for nats, fit in rated if fit.kind is kind and nats >= rough[kind] - options.mode_margin]
        for kind in rough
    }

    def sample(kind: Kind) -> KindPosterior:
        """Return the posterior of a kind; without evidence where no mode is possible."""
        found = importance_sample(modes[kind], bundle, sensor, options)
        possible = [mode for mode in found if is_possible(primitive_of(kind, JACOBIANS[kind] @ mode.mean))]
        return mixture(kind, possible) if possible else replace(found[0], log_evidence=-math.inf)

    sampled = {kind: sample(kind) for kind in rough if rough[kind] >= top - options.contender}
    sampled |= _merged_special_cases(sampled, lambda kind: sample(kind) if kind in modes else None, options)
    best = max(sampled, key=lambda kind: sampled[kind].log_evidence)
    highest = sampled[best].log_evidence
    if highest == -math.inf:
        return None
    weights = {
        kind: math.exp(sampled[kind].log_evidence - highest if kind in sampled else rough[kind] - top)
        for kind in rough
    }
    kind_probabilities = {kind: weights.get(kind, 0.0) / sum(weights.values()) for kind in Kind}
    best = next((kind for kind in SPECIAL_CASES if _is_unseen(kind, best, sampled, options)), best)
    primitive, std, covariance = summarize(best, sampled[best])
    return Posterior(primitive, std, covariance, kind_probabilities, sampled[best].cost)


def _is_unseen(kind: Kind, best: Kind, sampled: Mapping[Kind, KindPosterior], options: EvidenceOptions) -> bool:
    """Tell whether a kind's special case is the best only since nobody saw a side: it must not claim its size.

    Then the kind itself is as likely but for its prior, and does not know a size.
    """
    if SPECIAL_CASES[kind] is not best or kind not in sampled:
        return False
    own = sampled[kind]
    relative = np.sqrt(np.diag(own.covariance)[-2:]) / own.mean[-2:]
    near = own.log_evidence > sampled[best].log_evidence - options.unseen_margin
    return near and bool((relative > options.unseen_size).any())


def _merged_special_cases(
    sampled: Mapping[Kind, KindPosterior],
    sample: Callable[[Kind], KindPosterior | None],
    options: EvidenceOptions,
) -> dict[Kind, KindPosterior]:
    """Return squares and circles in the place of rectangles and ellipses whose sizes agree, with both's evidence."""
    merged = {}
    for kind, special in SPECIAL_CASES.items():
        if kind not in sampled or abs(sampled[kind].mean[3] - sampled[kind].mean[4]) > options.same_sizes:
            continue
        simple = sampled.get(special) or sample(special)
        if simple is None:
            continue
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
