"""What the rays that meet candidates say of the sensor: range noise, footprint, dispersion."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from detect.refinement.candidates import Candidate
from detect.refinement.fitting.evidence import exact_costs
from detect.refinement.fitting.fit import KindFit
from detect.refinement.likelihood.geometry import JACOBIANS, NUMBERS, OUTLINES, ranges_to
from detect.refinement.likelihood.kernels import (
    MEASURED,
    NO_RETURN,
    OCCLUSION,
    PARAMETERS,
    RANGE,
    RayData,
    gradient,
    upper_tail,
)
from detect.refinement.likelihood.rays import RayBundle
from detect.refinement.likelihood.sensor_model import BeamModel, table_nearest
from detect.refinement.options import DEFAULTS, SensorOptions
from detect.refinement.outlines.kernels import NO_INFORMATION, outline_likelihood
from prim import linear_algebra
from prim.arrays import FloatArray
from prim.normal import NORMAL_MAD
from prim.shapes import Primitive


def initial_noise(candidates: Sequence[Candidate], options: SensorOptions = DEFAULTS.sensor) -> float:
    """Estimate the noise before any fit, robustly: the scaled median absolute residual from the guesses' surfaces.

    Args:
        candidates: The candidates.
        options: The bounds.

    Returns:
        Metres.
    """
    residuals = np.concatenate([_residuals(candidate.bundle, candidate.start) for candidate in candidates])
    if len(residuals) < options.min_initial_rays:
        return options.initial_noise
    return max(NORMAL_MAD * float(np.median(np.abs(residuals))), options.min_initial_noise)


def _residuals(bundle: RayBundle, primitive: Primitive) -> FloatArray:
    """Return the residuals (m) of measured ranges whose rays meet a primitive."""
    ranges = ranges_to(primitive, bundle.rays)
    hit = (ranges < bundle.max_range) & (bundle.outcomes == MEASURED)
    return np.asarray(bundle.rays[RANGE, hit] - ranges[hit])


def estimate_dropouts(
    candidates: Sequence[Candidate], noise_std: float, options: SensorOptions = DEFAULTS.sensor
) -> float:
    """Estimate the share of beams that meet a surface and return nothing, robustly.

    It is the median of the candidates' shares, weighted by their rays, among rays that pass well inside the guess, in
    front of which the map has nothing. A candidate that most rays fly through is none.

    Args:
        candidates: The candidates, with the map behind them.
        noise_std: Range noise (m).
        options: Margins and bounds.

    Returns:
        The share; 0 where nearly all rays returned.
    """
    shares, weights = [], []
    if not any((candidate.bundle.outcomes == NO_RETURN).any() for candidate in candidates):
        return 0.0
    for candidate in candidates:
        bundle, background = candidate.bundle, candidate.background
        assert background is not None
        within = ranges_to(candidate.current, bundle.rays) < bundle.max_range - options.max_residual * noise_std
        within &= bundle.passing(candidate.current, -options.footprints[-1]) & ~background.blocked
        count = int(np.count_nonzero(within))
        share = int(np.count_nonzero(bundle.outcomes[within] == NO_RETURN)) / max(count, 1)
        if share <= options.max_dropout_share:
            shares.append(share)
            weights.append(count)
    median = weighted_median(np.array(shares), np.array(weights))
    return median if median >= options.min_dropout_share else 0.0


def weighted_median(values: FloatArray, weights: NDArray[np.int64]) -> float:
    """Return the weighted median: the least value that half of the weight does not exceed.

    Args:
        values: (N,).
        weights: (N,), 0 or more.

    Returns:
        The median; 0 where nothing has a weight.
    """
    if not weights.any():
        return 0.0
    order = np.argsort(values, kind="stable")
    total = np.cumsum(weights[order])
    return float(values[order][np.searchsorted(total, total[-1] / 2)])


def estimate_sensor(candidates: Sequence[Candidate], sensor: BeamModel, noise_std: float | None) -> BeamModel:
    """Estimate noise, footprint and dispersion from all candidates together.

    What fits no kind must not spoil them: noise is measured from free outlines where these fit better, and footprint
    and dispersion are what most of the candidates agree on.

    Args:
        candidates: The fitted candidates.
        sensor: The sensor so far.
        noise_std: The range noise (m) where it is known.

    Returns:
        The sensor.
    """
    std = noise_std or estimate_noise(candidates, sensor)
    span, max_std, options, dropouts = sensor.span, sensor.max_std, sensor.options, sensor.dropout_share
    sensor = BeamModel.create(std, span, sensor.footprint, 1.0, max_std, options, dropouts)
    footprint = estimate_footprint(candidates, sensor)
    dispersion = scan_dispersion(candidates, sensor)
    if footprint > 0 or dispersion > options.significant_dispersion:
        with_footprint = replace(sensor, footprint=footprint)
        dispersion = max(dispersion, clustered_dispersion(candidates, with_footprint))
    return BeamModel.create(std, span, footprint, dispersion, max_std, options, dropouts)


def _without_outlines(candidates: Sequence[Candidate]) -> list[Candidate]:
    """Return the candidates that a kind fits."""
    return [candidate for candidate in candidates if candidate.outline is None]


def estimate_footprint(candidates: Sequence[Candidate], sensor: BeamModel) -> float:
    """Find the footprint that makes the rays near candidates' silhouettes most likely.

    Of the candidates that half counts, for each footprint, that it serves least: a shape that is wrong at its
    silhouettes asks for a wide footprint, and no others do.

    Args:
        candidates: The fitted candidates.
        sensor: The sensor.

    Returns:
        Metres; 0 where one of the two smallest is the best.
    """
    footprints = sensor.options.footprints
    widest = footprints[-1]
    fitting = _without_outlines(candidates)
    costs = np.zeros((len(fitting), len(footprints)))
    for row, candidate in zip(costs, fitting, strict=True):
        bundle, fit = candidate.rays_with_background(candidates, sensor), candidate.fits[0]
        at_edge = bundle.passing(candidate.current, widest) & ~bundle.passing(candidate.current, -widest)
        bundle = bundle.select(at_edge)
        for k, footprint in enumerate(footprints):
            cost = exact_costs(fit.kind, fit.p[None], bundle, replace(sensor, footprint=footprint))[0]
            row[k] = cost if np.isfinite(cost) else 0.0  # larger than the prior allows: no information
    more_than_none = np.sort(costs - costs[:, :1], axis=0)
    total = more_than_none[len(costs) // 2 :].sum(axis=0)
    return float(footprints[best]) if (best := int(np.argmin(total))) > 1 else 0.0


def scan_dispersion(candidates: Sequence[Candidate], sensor: BeamModel) -> float:
    """Estimate the dispersion of scans: the variance of their mean residuals over that of independent rays.

    Args:
        candidates: The fitted candidates.
        sensor: The sensor.

    Returns:
        1 or more: the median over the candidates, weighted by their scans.
    """
    options = sensor.options
    found, scans = [], []
    for candidate in candidates:
        bundle = candidate.rays_with_background(candidates, sensor)
        ranges = candidate.surface_ranges(bundle)
        error = (bundle.rays[RANGE] - ranges) / sensor.std
        clear = ranges < bundle.rays[OCCLUSION]
        clear &= (bundle.outcomes == MEASURED) & (np.abs(error) < options.max_residual)
        cut = np.minimum((bundle.max_range - sensor.span - ranges) / sensor.std, 0.0)
        error = _without_truncation(error, cut)
        count = np.bincount(bundle.scan[clear])
        total = np.bincount(bundle.scan[clear], error[clear])
        many = count >= options.min_rays_of_scan
        if many.any():
            found.append(float((total[many] ** 2 / count[many]).mean()))
            scans.append(int(np.count_nonzero(many)))
    return max(weighted_median(np.array(found), np.array(scans)), 1.0) if sum(scans) >= options.min_rays else 1.0


def clustered_dispersion(candidates: Sequence[Candidate], sensor: BeamModel) -> float:
    """Estimate the dispersion of stretches of scans, in which poses may be off together.

    The scores (gradients of the log-likelihood by a candidate's parameters) of stretches scatter more than the
    information of their rays says: a sandwich estimate clustered by time (Liang and Zeger 1986), for several lengths,
    of which the largest significant one counts; each the median over the candidates.

    Args:
        candidates: The fitted candidates.
        sensor: The sensor.

    Returns:
        1 or more.
    """
    options = sensor.options
    bundles = [candidate.rays_with_background(candidates, sensor) for candidate in candidates]
    pairs = zip(candidates, bundles, strict=True)
    scores = [score for pair in pairs if (score := _scan_scores(*pair, sensor)) is not None]
    largest = 1.0
    for length in options.stretches:
        ratios, freedom = [], []
        for score in scores:
            stretches = len(score) // length
            if stretches < options.min_stretches:
                continue
            sums = score[: stretches * length].reshape(stretches, length, -1).sum(axis=1)
            sums -= sums.mean(axis=0)
            whole = len(score) / (stretches * length) * stretches**2 / (stretches - 1)
            ratios.append(float((sums**2).sum()) * whole / sums.size)
            freedom.append(sums.size)
        if not freedom:
            continue
        found = weighted_median(np.array(ratios), np.array(freedom))
        if found > 1 + options.significance * math.sqrt(2 / sum(freedom)):
            largest = max(largest, found)
    return largest


def _scan_scores(candidate: Candidate, bundle: RayBundle, sensor: BeamModel) -> FloatArray | None:
    """Return the whitened score (S, K) of each scan's rays by a candidate's own parameters.

    Of a free outline it is that by its place. Independent rays give each a mean square of 1 / S. None where the
    information is singular.
    """
    blur = max(sensor.footprint, sensor.options.min_score_blur)
    outline = candidate.outline
    by_own = _ScoreByParameters(candidate.fits[0]) if outline is None else _ScoreByPlace(outline)
    lower = linear_algebra.cholesky(by_own.information(sensor.data(bundle), blur))
    whiten = None if lower is None else linear_algebra.inverse(lower)
    if whiten is None:
        return None
    scans, number = np.unique(bundle.scan, return_inverse=True)
    parts = (bundle.select(number == k) for k in range(len(scans)))
    return np.array([by_own.score(sensor.data(part), blur) for part in parts]) @ whiten.T


class _ScoreByParameters:
    """The score of rays by a kind's own parameters (K,), and the information (K, K)."""

    def __init__(self, fit: KindFit) -> None:
        self._fit, self._jacobian = fit, JACOBIANS[fit.kind]

    def score(self, data: RayData, blur: float) -> FloatArray:
        return np.asarray(self._jacobian.T @ self._evaluated(data, blur)[0])

    def information(self, data: RayData, blur: float) -> FloatArray:
        return np.asarray(self._jacobian.T @ self._evaluated(data, blur)[1] @ self._jacobian)

    def _evaluated(self, data: RayData, blur: float) -> tuple[FloatArray, FloatArray]:
        slope, information = np.zeros(PARAMETERS), np.zeros((PARAMETERS, PARAMETERS))
        gradient(OUTLINES, NUMBERS[self._fit.kind], self._fit.p, data, blur, slope, information)
        return slope, information


class _ScoreByPlace:
    """The score of rays by the place (2,) of an outline (V, 2), the sum of those by its vertices; the information."""

    def __init__(self, outline: FloatArray) -> None:
        self._outline = outline

    def score(self, data: RayData, blur: float) -> FloatArray:
        slope = np.zeros(self._outline.size)
        outline_likelihood(self._outline, data, blur, slope, NO_INFORMATION)
        return np.asarray(slope.reshape(-1, 2).sum(axis=0))

    def information(self, data: RayData, blur: float) -> FloatArray:
        size, count = self._outline.size, len(self._outline)
        information = np.zeros((size, size))
        outline_likelihood(self._outline, data, blur, np.zeros(size), information)
        return np.asarray(information.reshape(count, 2, count, 2).sum(axis=(0, 2)))


def _without_truncation(error: FloatArray, cut: FloatArray) -> FloatArray:
    """Standardise errors (N,) of normal distributions that are truncated below ``cut`` (N,) to mean 0, variance 1."""
    mills = np.exp(-(cut**2) / 2) / math.sqrt(2 * math.pi) / upper_tail(cut)  # inverse Mills ratio
    return np.asarray((error - mills) / np.sqrt(1 + cut * mills - mills**2))


def estimate_noise(candidates: Sequence[Candidate], sensor: BeamModel) -> float:
    """Find the noise that makes the rays which meet candidates most likely, censored measurements among them.

    Args:
        candidates: The fitted candidates.
        sensor: The sensor so far.

    Returns:
        Metres.
    """
    met = [_met(candidate, candidate.rays_with_background(candidates, sensor)) for candidate in candidates]
    return maximum_likelihood_noise(met, sensor)


def maximum_likelihood_noise(
    met: Sequence[tuple[FloatArray, NDArray[np.int8], FloatArray]], sensor: BeamModel
) -> float:
    """Find the noise that makes measurements of known surfaces most likely.

    Args:
        met: Ranges to the surfaces (m), outcomes, and measured ranges or their limits (m), each (N,).
        sensor: The sensor so far; its noise stays where too few ranges were measured.

    Returns:
        Metres.
    """
    ranges, outcomes, z = (np.concatenate(part) for part in zip(*met, strict=True))
    count = int(np.count_nonzero(outcomes == MEASURED))
    if count < sensor.options.min_rays:
        return sensor.std

    def cost(log_std: float) -> float:
        std = math.exp(log_std)
        table = BeamModel.create(std, sensor.span, options=sensor.options, dropout_share=sensor.dropout_share).table
        return count * log_std - float(table_nearest(table, outcomes, (ranges - z) / std).sum())

    std = math.exp(_minimize(cost, math.log(sensor.std), sensor.options))
    return min(max(std, sensor.options.min_noise), sensor.max_std)


def _met(candidate: Candidate, bundle: RayBundle) -> tuple[FloatArray, NDArray[np.int8], FloatArray]:
    """Return the ranges (m) at which rays meet a candidate, their outcomes, and measured ranges or limits (m)."""
    ranges = candidate.surface_ranges(bundle)
    meets = (ranges < bundle.rays[OCCLUSION]) & (ranges < bundle.max_range)
    return ranges[meets], bundle.outcomes[meets], bundle.rays[RANGE, meets]


def _minimize(cost: Callable[[float], float], at: float, options: SensorOptions) -> float:
    """Minimise a unimodal function: steps downhill, then a parabola through three points, twice."""
    here, step = cost(at), options.search_step
    for _ in range(options.search_steps):
        left, right = cost(at - step), cost(at + step)
        if min(left, right) >= here:
            curve = left + right - 2 * here
            at += 0.5 * step * (left - right) / curve if curve > 0 else 0.0
            if step < options.last_search_step:
                return at
            step, here = step / options.search_refinement, cost(at)
        elif left < right:
            at, here = at - step, left
        else:
            at, here = at + step, right
    return at
