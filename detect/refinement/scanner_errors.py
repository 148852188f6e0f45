"""Errors that all beams of a scanner have in common, estimated from all candidates together: range bias, beam width.

Both make sizes wrong, and error bars too small: silhouettes say one size, ranges another. A candidate alone shows
little of a bias, since its place and size give way; together they do. The likelihood is profiled: at each value of an
error all candidates are fitted anew, each by its likeliest kind. The bias is found by Gauss and Newton's method, with
the candidates' own parameters eliminated by Schur complements; the beams' width by a search, since the likelihood
jumps at silhouettes. A bias counts where it is significant by the candidates' own scatter, a width where it gains
enough.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from concurrent.futures import Executor
from dataclasses import dataclass, replace
from itertools import repeat

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
    """The fits of candidates, given some errors of the scanner.

    Attributes:
        errors: The errors.
        expansions: The likelihood of each candidate.
    """

    errors: ScannerErrors
    expansions: Sequence[BiasExpansion]

    @property
    def fits(self) -> list[KindFit]:
        """The fits."""
        return [one.fit for one in self.expansions]

    @property
    def cost(self) -> float:
        """The negative log-likelihood of all (nats)."""
        return sum(one.cost for one in self.expansions)


def correct_scanner_errors(
    pool: Executor, candidates: Sequence[Candidate], sensor: BeamModel, noise_std: float | None
) -> BeamModel:
    """Find the errors that all beams have in common, take them out of the candidates' rays, and fit anew.

    Args:
        pool: The threads.
        candidates: The fitted candidates; where errors are found, they are fitted anew, all kinds of them.
        sensor: The sensor so far: its noise.
        noise_std: The range noise (m) where it is known.

    Returns:
        The sensor: the same where no errors are found, else estimated anew.
    """
    search = ErrorSearch(pool, candidates, _asked(candidates), candidates[0].options.scanner)
    estimated = estimate_sensor(candidates, sensor, noise_std)
    errors = ScannerErrors(mixed=mixed_pixels(candidates, candidates, estimated, search.options))
    errors = search.likeliest(estimated, errors)
    if errors == NO_ERRORS:
        return sensor
    return search.take_out(errors, estimated, noise_std, search_kinds=True)


def settle_scanner_errors(
    pool: Executor, candidates: Sequence[Candidate], sensor: BeamModel, noise_std: float | None
) -> tuple[BeamModel, SensorErrors | None]:
    """Find the scanner's errors again by the candidates that a kind fits now, and what is unsure because of them.

    Where no kind fits any of them, nothing shows errors of the scanner: all are put back.

    Args:
        pool: The threads.
        candidates: The candidates, fitted without the errors that were found first; they are fitted again.
        sensor: The sensor, estimated without them.
        noise_std: The range noise (m) where it is known.

    Returns:
        The sensor, and the errors; the same sensor and None where none were found.
    """
    errors = candidates[0].errors
    if errors == NO_ERRORS:
        return sensor, None
    trusted = _asked([candidate for candidate in candidates if candidate.outline is None])
    search = ErrorSearch(pool, candidates, trusted, candidates[0].options.scanner)
    estimated = estimate_sensor(candidates, sensor, noise_std)
    if not trusted:
        errors = NO_ERRORS
    elif errors.range_bias or errors.reach:
        errors = search.likeliest(estimated, errors)
    estimated = search.take_out(errors, estimated, noise_std, search_kinds=errors == NO_ERRORS)
    if errors == NO_ERRORS:
        return estimated, None
    std = search.add_shared_errors(estimated, errors)
    return estimated, SensorErrors(errors.range_bias, std, 2 * errors.reach, 2 * errors.mixed)


def _asked(candidates: Sequence[Candidate]) -> list[Candidate]:
    """Return the candidates of most rays, in their order."""
    most = candidates[0].options.scanner.asked if candidates else 0
    chosen = sorted(candidates, key=lambda candidate: -len(candidate.bundle))[:most]
    numbers = {id(candidate) for candidate in chosen}
    return [candidate for candidate in candidates if id(candidate) in numbers]


@dataclass(frozen=True)
class ErrorSearch:
    """Finds a scanner's errors by the likelihood of candidates.

    Attributes:
        pool: The threads.
        candidates: All candidates: they occlude each other.
        trusted: Those that are asked.
        options: Numeric parameters.
    """

    pool: Executor
    candidates: Sequence[Candidate]
    trusted: Sequence[Candidate]
    options: ScannerOptions = DEFAULTS.scanner

    def likeliest(self, sensor: BeamModel, known: ScannerErrors) -> ScannerErrors:
        """Find the errors that count: a bias that is significant, and a width that gains enough.

        Args:
            sensor: The sensor.
            known: Mixed pixels, and what was found before.

        Returns:
            The errors.
        """
        options = self.options
        is_wide = known.reach or sensor.footprint > 0 or sensor.dispersion > sensor.options.significant_dispersion
        fits = [candidate.fits[0] for candidate in self.trusted]
        if known == NO_ERRORS and not is_wide:
            step, std = common_step(self.as_fitted(sensor), sensor, options)
            if abs(step) < options.considered * std:
                return known
        likeliest = self.with_best_bias(sensor, replace(known, reach=0.0), fits)
        if is_wide:
            footprint = 0.0 if known.reach else min(sensor.footprint, options.first_footprint)
            likeliest = self._with_width(sensor, replace(sensor, footprint=footprint), likeliest, known.reach > 0)
        errors = likeliest.errors
        std = common_step(likeliest, sensor, options)[1]
        is_biased = abs(errors.range_bias) >= max(options.min_bias, options.deviations * std)
        return errors if is_biased else replace(errors, range_bias=0.0)

    def as_fitted(self, sensor: BeamModel) -> Profile:
        """Return the candidates' likelihoods around the fits that they have, without errors of the scanner."""
        expansions = []
        for candidate in self.trusted:
            bundle, fit = candidate.rays_with_background(self.candidates, sensor), candidate.fits[0]
            expansions.append(expand_in_bias(fit, fit.cost, bundle, sensor, self.options))
        return Profile(NO_ERRORS, expansions)

    def at(self, sensor: BeamModel, errors: ScannerErrors, fits: Sequence[KindFit]) -> Profile:
        """Fit the trusted candidates, each by one kind, given some errors of the scanner; they stay as they are.

        Args:
            sensor: The sensor.
            errors: The errors.
            fits: What the fits begin with.

        Returns:
            The profile.
        """
        return Profile(errors, list(self.pool.map(self._fit, self.trusted, fits, repeat(sensor), repeat(errors))))

    def _fit(self, candidate: Candidate, fit: KindFit, sensor: BeamModel, errors: ScannerErrors) -> BiasExpansion:
        """Fit one candidate; turned rays follow its last fit."""
        options = candidate.options
        for _ in range(self.options.turns if errors.reach else 1):
            shape = primitive_of(fit.kind, fit.p)
            bundle = candidate.rays_with_background(self.candidates, sensor, errors, shape)
            (fit,) = refit_same_kind(fit, bundle, sensor, options.fit)
        if errors.reach:
            shape = primitive_of(fit.kind, fit.p)
            bundle = candidate.rays_with_background(self.candidates, sensor, errors, shape)
        cost = float(exact_costs(fit.kind, fit.p[None], bundle, sensor, options.evidence)[0])
        return expand_in_bias(fit, cost if math.isfinite(cost) else fit.cost, bundle, sensor, self.options)

    def with_best_bias(self, sensor: BeamModel, errors: ScannerErrors, fits: Sequence[KindFit]) -> Profile:
        """Find the likeliest range bias by Gauss and Newton's method.

        Args:
            sensor: The sensor.
            errors: The errors to begin with.
            fits: The fits to begin with.

        Returns:
            The profile there.
        """
        options = self.options
        profile = self.at(sensor, errors, fits)
        for _ in range(options.steps):
            step = min(max(common_step(profile, sensor, options)[0], -options.max_step), options.max_step)
            bias = min(max(profile.errors.range_bias + step, -options.max_bias), options.max_bias)
            if abs(bias - profile.errors.range_bias) < options.last_step:
                break
            profile = self.at(sensor, replace(profile.errors, range_bias=bias), profile.fits)
        return profile

    def _with_width(self, sensor: BeamModel, sharp: BeamModel, start: Profile, is_known: bool) -> Profile:
        """Return the likeliest profile with beams of a width; the one to start with where none gains enough.

        A narrow one is tried first, with the sensor as it is; what is searched for is with a ``sharp`` one.
        """
        options = self.options
        for reach in options.reaches:
            first = self.at(sensor, replace(start.errors, reach=reach), start.fits)
            gains = [a.cost - b.cost for a, b in zip(start.expansions, first.expansions, strict=True)]
            if float(np.median(gains)) > 0:
                wide = self._with_best_reach(sharp, start)
                narrow = self.at(sharp, start.errors, start.fits)
                return wide if self._gains(start, narrow, first, wide, sensor, is_known) else start
            if reach >= options.first_reach:
                break
        return start

    def _gains(
        self, start: Profile, narrow: Profile, first: Profile, wide: Profile, sensor: BeamModel, is_known: bool
    ) -> bool:
        """Tell whether a width gains enough.

        Where one was found before it must do so with the sharp sensor (``narrow`` and ``wide``): a footprint that is
        too large can make up for a width. At first either sensor may show it, as it was (``start`` and ``first``) or
        sharp: then the other errors that a width brings about are in the fits still.
        """
        if is_known:
            gain, needed = narrow.cost - wide.cost, self.options.min_gain
        else:
            gain = min(start.cost, narrow.cost) - min(wide.cost, first.cost)
            needed = self.options.min_first_gain
        return gain > needed * len(self.trusted) * sensor.dispersion

    def _with_best_reach(self, sensor: BeamModel, start: Profile) -> Profile:
        """Return the likeliest profile with beams of a width: the best of some, then halfway to its neighbours."""
        found: dict[float, Profile] = {}

        def add(reach: float, near: Profile) -> Profile:
            found[reach] = self.with_best_bias(sensor, replace(near.errors, reach=reach), near.fits)
            return found[reach]

        near = start
        for reach in self.options.reaches:
            before, near = near, add(reach, near)
            if reach > self.options.first_reach and near.cost > before.cost:
                break
        for _ in range(self.options.refinements):
            known = sorted(found)
            best = min(known, key=lambda reach: found[reach].cost)
            place = known.index(best)
            for other in (*known[max(place - 1, 0) : place], *known[place + 1 : place + 2]):
                add(0.5 * (best + other), found[best])
        return min(found.values(), key=lambda profile: profile.cost)

    def take_out(
        self, errors: ScannerErrors, sensor: BeamModel, noise_std: float | None, search_kinds: bool
    ) -> BeamModel:
        """Fit all candidates without the scanner's errors, and estimate the sensor anew.

        Args:
            errors: The errors.
            sensor: The sensor so far.
            noise_std: The range noise (m) where it is known.
            search_kinds: Whether all kinds are fitted from new starts.

        Returns:
            The sensor.
        """
        for candidate in self.candidates:
            candidate.errors = errors
            candidate.fitted_to = None if search_kinds else candidate.fitted_to
        for _ in range(self.options.turns if errors.reach else 1):
            for candidate in self.candidates:
                candidate.is_rough = True  # so that it is fitted again though its background is the same
            fit_candidates(self.pool, self.candidates, [False] * len(self.candidates), sensor)
        return estimate_sensor(self.candidates, sensor, noise_std)

    def add_shared_errors(self, sensor: BeamModel, errors: ScannerErrors) -> float | None:
        """Set what is unsure about all candidates because the scanner's errors are.

        Args:
            sensor: The sensor.
            errors: The errors that were taken out.

        Returns:
            The bias's standard deviation (m); None without a bias.
        """
        options = self.options
        std = None
        if errors.range_bias:
            fits = [candidate.fits[0] for candidate in self.trusted]
            std = common_step(self.at(sensor, errors, fits), sensor, options)[1]
        everyone = replace(self, trusted=self.candidates)
        profile = everyone.at(sensor, errors, [candidate.fits[0] for candidate in self.candidates])
        changes = [[] if std is None else [std * one.slope] for one in profile.expansions]
        if errors.reach or errors.mixed:
            unsure = math.hypot(options.reach_std, options.relative_reach_std * errors.reach)
            less, more = (
                everyone.at(sensor, replace(errors, reach=reach), profile.fits).fits
                for reach in (max(errors.reach - unsure, 0.0), errors.reach + unsure)
            )
            step = 0.5 if errors.reach else 1.0
            for change, before, after in zip(changes, less, more, strict=True):
                change.append(step * (after.p - before.p))
        for candidate, fit, change in zip(self.candidates, profile.fits, changes, strict=True):
            candidate.is_rough = True  # fitted once more, with the sensor as it was estimated last
            candidate.shared_errors = _longer_first(fit, np.array(change).T) if change else None
        return std


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
    knowing = [one for one in profile.expansions if one.curvature > 0]
    steps, known = np.array([one.step for one in knowing]), np.array([one.curvature for one in knowing])
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


def mixed_pixels(
    trusted: Sequence[Candidate],
    candidates: Sequence[Candidate],
    sensor: BeamModel,
    options: ScannerOptions = DEFAULTS.scanner,
) -> float:
    """Find the half-width of beams within which silhouettes give ranges between two surfaces.

    Args:
        trusted: The fitted candidates that are asked.
        candidates: All candidates.
        sensor: The sensor.
        options: The half-widths and the thresholds.

    Returns:
        The largest one (rad) up to which many of the rays that hold a silhouette in a half-width, and not in the one
        before, are mixed; 0 where the smallest has few, or where even the widest has many: those are errors of
        poses, which know no width.
    """
    held, between = np.zeros(len(options.mixed)), np.zeros(len(options.mixed))
    for candidate in trusted:
        bundle = candidate.rays_with_background(candidates, sensor)
        for counts, masks in zip(
            (held, between), silhouette_readings(bundle, candidate.current, options.mixed, sensor), strict=True
        ):
            counts += [np.count_nonzero(mask) for mask in masks]
    rings, mixed = np.diff(held, prepend=0.0), np.diff(between, prepend=0.0)
    many = (mixed >= options.min_mixed) & (mixed > options.min_mixed_share * rings)
    count = int(np.logical_and.accumulate(many).sum())
    return float(options.mixed[count - 1]) if 0 < count < len(many) else 0.0
