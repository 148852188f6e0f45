"""Errors that all beams of a scanner have in common, estimated from all candidates together: range bias, beam width.

Both make shapes wrong and look sure: silhouettes say one size, ranges another. One candidate alone cannot tell much of
a bias, since its size and place give way; all together do. The likelihood is profiled: at each value of an error every
candidate is fitted anew, by its likeliest kind. The bias is found by Gauss and Newton's method, with the candidates'
own parameters eliminated by Schur complements; the beam's width by a search, since the likelihood jumps at
silhouettes. An error counts where it gains enough, and where the candidates agree on it.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from concurrent.futures import Executor
from dataclasses import dataclass, replace

import numpy as np

from detect.detection import SensorErrors
from detect.refinement.candidates import Candidate, fit_candidates
from detect.refinement.fitting.evidence import Posterior, exact_costs
from detect.refinement.fitting.fit import KindFit, refit_same_kind
from detect.refinement.likelihood.geometry import JACOBIANS, NUMBERS, OUTLINES, primitive_of
from detect.refinement.likelihood.kernels import PARAMETERS, RANGE, gradient
from detect.refinement.likelihood.rays import RayBundle
from detect.refinement.likelihood.scanner_errors import NO_ERRORS, ScannerErrors, silhouette_readings
from detect.refinement.likelihood.sensor_model import BeamModel
from detect.refinement.options import DEFAULTS, ScannerOptions
from detect.refinement.sensor_estimation import estimate_sensor
from prim import linear_algebra
from prim.arrays import FloatArray
from prim.normal import NORMAL_MAD


@dataclass(frozen=True)
class BiasExpansion:
    """One candidate's likelihood around its fit, as a function of the range bias, its own parameters eliminated.

    Attributes:
        fit: The fit.
        cost: Its exact negative log-likelihood (nats).
        score: Derivative of the cost by the bias (nats / m).
        curvature: Its second derivative (nats / m²): what the candidate knows of the bias; 0 for nothing.
        slope: (5,) derivatives of its parameters by the bias.
    """

    fit: KindFit
    cost: float
    score: float
    curvature: float
    slope: FloatArray

    @property
    def step(self) -> float:
        """What the candidate alone would add to the bias (m)."""
        return -self.score / self.curvature if self.curvature else 0.0


@dataclass(frozen=True)
class Profile:
    """The fits of all candidates, given some errors of the scanner.

    Attributes:
        errors: The errors.
        candidates: The likelihood of each.
    """

    errors: ScannerErrors
    candidates: Sequence[BiasExpansion]

    @property
    def fits(self) -> list[KindFit]:
        """The fits."""
        return [candidate.fit for candidate in self.candidates]

    @property
    def cost(self) -> float:
        """The negative log-likelihood of all (nats)."""
        return sum(candidate.cost for candidate in self.candidates)

    def steps(self) -> tuple[FloatArray, FloatArray]:
        """Return what each candidate that knows of the bias would add to it (m), and what it knows (nats / m²)."""
        knowing = [candidate for candidate in self.candidates if candidate.curvature > 0]
        return np.array([one.step for one in knowing]), np.array([one.curvature for one in knowing])


def correct_scanner_errors(
    pool: Executor, candidates: Sequence[Candidate], sensor: BeamModel, noise_std: float | None
) -> tuple[BeamModel, SensorErrors | None]:
    """Find the errors that all beams have in common, take them out of the candidates' rays, and fit anew.

    Args:
        pool: The threads.
        candidates: The fitted candidates; where errors are found, they are fitted anew, all kinds of them.
        sensor: The sensor, estimated as if there were none.
        noise_std: The range noise (m) where it is known.

    Returns:
        The sensor, estimated anew where errors were found, and these; None for none.
    """
    if not candidates:
        return sensor, None
    options = candidates[0].options.scanner
    errors = ScannerErrors(mixed=mixed_pixels(candidates, sensor, options))
    errors = _likeliest(pool, candidates, sensor, errors, options)
    if errors == NO_ERRORS:
        return sensor, None
    for candidate in candidates:
        candidate.errors, candidate.fitted_to = errors, None
    sensor = _fit_again(pool, candidates, sensor, noise_std, options)
    if errors.range_bias or errors.reach:
        errors = _likeliest(pool, candidates, sensor, errors, options)
    for candidate in candidates:
        candidate.errors, candidate.is_rough = errors, True
    sensor = _fit_again(pool, candidates, sensor, noise_std, options)
    std = _add_shared_errors(pool, candidates, sensor, errors, options)
    return sensor, SensorErrors(errors.range_bias, std, 2 * errors.reach, 2 * errors.mixed)


def errors_of(found: SensorErrors | None) -> ScannerErrors:
    """Return errors that were found as they are taken out of rays.

    Args:
        found: The errors; None for none.

    Returns:
        The errors.
    """
    if found is None:
        return NO_ERRORS
    return ScannerErrors(found.range_bias, 0.5 * found.nearest_within, 0.5 * found.mixed_within)


def _add_shared_errors(
    pool: Executor,
    candidates: Sequence[Candidate],
    sensor: BeamModel,
    errors: ScannerErrors,
    options: ScannerOptions,
) -> float | None:
    """Set what is unsure about candidates because the scanner's errors are; return the bias's std (m), if any."""
    profile = profile_at(pool, candidates, sensor, errors, [candidate.fits[0] for candidate in candidates])
    std = bias_std(profile, sensor, options) if errors.range_bias else None
    changes = [[] if std is None else [std * one.slope] for one in profile.candidates]
    if errors.reach:
        unsure = math.hypot(options.reach_std, options.relative_reach_std * errors.reach)
        sides = [
            profile_at(pool, candidates, sensor, replace(errors, reach=errors.reach + sign * unsure), profile.fits)
            for sign in (-1, 1)
        ]
        for change, before, after in zip(changes, *(side.fits for side in sides), strict=True):
            change.append(0.5 * (after.p - before.p))
    for candidate, fit, change in zip(candidates, profile.fits, changes, strict=True):
        candidate.is_rough = True
        candidate.shared_errors = _longer_first(fit, np.array(change).T) if change else None
    return std


def _longer_first(fit: KindFit, changes: FloatArray) -> FloatArray:
    """Return changes (5, E) of a fit's parameters in the order of sizes that its kind is reported with."""
    swapped = fit.kind.longer_first and fit.p[3] < fit.p[4]
    return changes[[0, 1, 2, 4, 3]] if swapped else changes


def with_shared_errors(posterior: Posterior, shared: FloatArray | None) -> Posterior:
    """Add to a posterior's covariance what is unsure about the scanner's errors.

    Args:
        posterior: The posterior, given these errors.
        shared: (5, E) by how much the parameters change with one standard deviation of each error; None for none.

    Returns:
        The posterior.
    """
    if shared is None:
        return posterior
    jacobian = JACOBIANS[posterior.primitive.kind]
    own = (jacobian / (jacobian**2).sum(axis=0)).T @ shared
    covariance = posterior.covariance + own @ own.T
    std = dict(zip(posterior.std, np.sqrt(np.diag(covariance)).tolist(), strict=True))
    return replace(posterior, covariance=covariance, std=std)


def _fit_again(
    pool: Executor,
    candidates: Sequence[Candidate],
    sensor: BeamModel,
    noise_std: float | None,
    options: ScannerOptions,
) -> BeamModel:
    """Fit all candidates with the scanner's errors taken out, and estimate the sensor anew."""
    turns = options.turns if candidates[0].errors.reach else 1
    for _ in range(turns):
        fit_candidates(pool, candidates, [False] * len(candidates), sensor)
        for candidate in candidates:
            candidate.is_rough = True
    return estimate_sensor(candidates, sensor, noise_std)


def _likeliest(
    pool: Executor,
    candidates: Sequence[Candidate],
    sensor: BeamModel,
    known: ScannerErrors,
    options: ScannerOptions,
) -> ScannerErrors:
    """Return the errors that count: known mixed pixels, and a bias and a width that gain enough."""
    is_wide = known.reach or sensor.footprint > 0 or sensor.dispersion > sensor.options.significant_dispersion
    if known == NO_ERRORS and not is_wide:
        step, std = common_step(_as_fitted(candidates, sensor), sensor, options)
        if abs(step) < options.considered * std:
            return known
    fits = [candidate.fits[0] for candidate in candidates]
    biased = with_best_bias(pool, candidates, sensor, replace(known, reach=0.0), fits)
    if is_wide:
        blurred = replace(sensor, footprint=0.0 if known.reach else min(sensor.footprint, options.first_footprint))
        wide = _with_best_reach(pool, candidates, blurred, biased, options)
        if biased.cost - wide.cost > options.min_gain * len(candidates) * sensor.dispersion:
            biased = wide
    errors = biased.errors
    return errors if is_biased(biased, sensor, options) else replace(errors, range_bias=0.0)


def _as_fitted(candidates: Sequence[Candidate], sensor: BeamModel) -> Profile:
    """Return the candidates' likelihoods around the fits that they have."""
    expansions = []
    for candidate in candidates:
        bundle, fit = candidate.rays_with_background(candidates, sensor), candidate.fits[0]
        expansions.append(expand_in_bias(fit, fit.cost, bundle, sensor, candidate.options.scanner))
    return Profile(NO_ERRORS, expansions)


def _with_best_reach(
    pool: Executor,
    candidates: Sequence[Candidate],
    sensor: BeamModel,
    start: Profile,
    options: ScannerOptions,
) -> Profile:
    """Return the likeliest profile with beams of a width: the best of some, then of those halfway to its neighbours."""
    found: dict[float, Profile] = {}

    def at(reach: float, near: Profile) -> Profile:
        found[reach] = with_best_bias(pool, candidates, sensor, replace(near.errors, reach=reach), near.fits)
        return found[reach]

    near = start
    for reach in options.reaches:
        near = at(reach, near)
    for _ in range(options.refinements):
        known = sorted(found)
        best = min(known, key=lambda reach: found[reach].cost)
        around = [other for k, other in enumerate(known) if abs(k - known.index(best)) == 1]
        for other in around:
            at(0.5 * (best + other), found[best])
    return min(found.values(), key=lambda profile: profile.cost)


def profile_at(
    pool: Executor,
    candidates: Sequence[Candidate],
    sensor: BeamModel,
    errors: ScannerErrors,
    fits: Sequence[KindFit],
) -> Profile:
    """Fit all candidates, each by one kind, given some errors of the scanner.

    Args:
        pool: The threads.
        candidates: The candidates, which stay as they are.
        sensor: The sensor.
        errors: The errors.
        fits: What the fits begin with.

    Returns:
        The profile.
    """

    def expand(pair: tuple[Candidate, KindFit]) -> BiasExpansion:
        candidate, fit = pair
        options = candidate.options
        for _ in range(options.scanner.turns if errors.reach else 1):
            shape = primitive_of(fit.kind, fit.p)
            bundle = candidate.rays_with_background(candidates, sensor, errors, shape)
            (fit,) = refit_same_kind(fit, bundle, sensor, options.fit)
        if errors.reach:
            bundle = candidate.rays_with_background(candidates, sensor, errors, primitive_of(fit.kind, fit.p))
        cost = float(exact_costs(fit.kind, fit.p[None], bundle, sensor, options.evidence)[0])
        return expand_in_bias(fit, cost if math.isfinite(cost) else fit.cost, bundle, sensor, options.scanner)

    return Profile(errors, list(pool.map(expand, zip(candidates, fits, strict=True))))


def expand_in_bias(
    fit: KindFit, cost: float, bundle: RayBundle, sensor: BeamModel, options: ScannerOptions = DEFAULTS.scanner
) -> BiasExpansion:
    """Expand a candidate's likelihood in the range bias to second order.

    Derivatives by the bias are differences: the likelihood does not jump there. The fit's own parameters are
    eliminated by the Schur complement.

    Args:
        fit: The fit.
        cost: Its cost (nats).
        bundle: The rays that it was made to.
        sensor: The sensor.
        options: The step of the differences.

    Returns:
        The expansion; it knows nothing where the fit's information is singular.
    """
    jacobian, step = JACOBIANS[fit.kind], options.difference * sensor.std
    blur = max(sensor.footprint, sensor.options.min_score_blur)
    costs, slopes = np.empty(3), np.empty((3, PARAMETERS))
    information = np.zeros((PARAMETERS, PARAMETERS))
    for k in (0, 2, 1):  # the middle one last: its information stays
        rays = bundle.rays.copy()
        rays[RANGE] -= (k - 1) * step
        data = sensor.data(bundle.with_rays(rays))
        costs[k] = gradient(OUTLINES, NUMBERS[fit.kind], fit.p, data, blur, slopes[k], information)
    own = slopes @ jacobian
    crossed = (own[2] - own[0]) / (2 * step)
    inverse = linear_algebra.inverse(jacobian.T @ information @ jacobian)
    if inverse is None:
        return BiasExpansion(fit, cost, 0.0, 0.0, np.zeros(PARAMETERS))
    score = (costs[2] - costs[0]) / (2 * step) - crossed @ inverse @ own[1]
    curvature = (costs[2] + costs[0] - 2 * costs[1]) / step**2 - crossed @ inverse @ crossed
    return BiasExpansion(fit, cost, float(score), max(float(curvature), 0.0), -jacobian @ inverse @ crossed)


def with_best_bias(
    pool: Executor,
    candidates: Sequence[Candidate],
    sensor: BeamModel,
    errors: ScannerErrors,
    fits: Sequence[KindFit],
) -> Profile:
    """Find the likeliest range bias by Gauss and Newton's method.

    Each step is the candidates' mean, weighted by what they know, without those far from their median.

    Args:
        pool: The threads.
        candidates: The candidates.
        sensor: The sensor.
        errors: The errors to begin with.
        fits: The fits to begin with.

    Returns:
        The profile there.
    """
    options = candidates[0].options.scanner
    profile = profile_at(pool, candidates, sensor, errors, fits)
    for _ in range(options.steps):
        step = min(max(common_step(profile, sensor, options)[0], -options.max_step), options.max_step)
        bias = min(max(profile.errors.range_bias + step, -options.max_bias), options.max_bias)
        if abs(bias - profile.errors.range_bias) < options.last_step:
            break
        profile = profile_at(pool, candidates, sensor, replace(profile.errors, range_bias=bias), profile.fits)
    return profile


def common_step(
    profile: Profile, sensor: BeamModel, options: ScannerOptions = DEFAULTS.scanner
) -> tuple[float, float]:
    """Combine what candidates would add to the bias.

    Args:
        profile: The candidates' likelihoods.
        sensor: The sensor, whose dispersion widens what they know.
        options: The thresholds.

    Returns:
        Their weighted mean (m), without those that lie far from the median, and its standard deviation, no less than
        the scatter between them says; 0 and infinity where none knows anything.
    """
    steps, known = profile.steps()
    if not len(steps):
        return 0.0, math.inf
    own = np.sqrt(sensor.dispersion / known)
    median = float(np.median(steps))
    scatter = NORMAL_MAD * float(np.median(np.abs(steps - median)))
    near = np.abs(steps - median) <= options.agreement * np.hypot(own, scatter)
    weights = known * near
    mean = float((weights @ steps) / weights.sum())
    squares = float(weights @ np.square(steps - mean)) / sensor.dispersion
    freedom = int(np.count_nonzero(near)) - 1
    excess = max(squares / freedom, 1.0) if freedom else 1.0
    return mean, math.sqrt(excess * sensor.dispersion / weights.sum())


def bias_std(profile: Profile, sensor: BeamModel, options: ScannerOptions = DEFAULTS.scanner) -> float:
    """Return the standard deviation (m) of a profile's range bias."""
    return common_step(profile, sensor, options)[1]


def is_biased(profile: Profile, sensor: BeamModel, options: ScannerOptions = DEFAULTS.scanner) -> bool:
    """Tell whether a profile's range bias is significant."""
    bias = abs(profile.errors.range_bias)
    return bias >= max(options.min_bias, options.deviations * bias_std(profile, sensor, options))


def mixed_pixels(
    candidates: Sequence[Candidate], sensor: BeamModel, options: ScannerOptions = DEFAULTS.scanner
) -> float:
    """Find the half-width of beams within which silhouettes give ranges between two surfaces.

    Args:
        candidates: The fitted candidates.
        sensor: The sensor.
        options: The half-widths and the thresholds.

    Returns:
        The largest one (rad) up to which many of the rays that hold a silhouette in a half-width, and not in the one
        before, are mixed; 0 where the smallest has few.
    """
    held, between = np.zeros(len(options.mixed)), np.zeros(len(options.mixed))
    for candidate in candidates:
        bundle = candidate.rays_with_background(candidates, sensor)
        for counts, masks in zip(
            (held, between), silhouette_readings(bundle, candidate.current, options.mixed, sensor), strict=True
        ):
            counts += [np.count_nonzero(mask) for mask in masks]
    rings, mixed = np.diff(held, prepend=0.0), np.diff(between, prepend=0.0)
    many = (mixed >= options.min_mixed) & (mixed > options.min_mixed_share * rings)
    count = int(np.logical_and.accumulate(many).sum())
    return float(options.mixed[count - 1]) if count else 0.0
