"""Maximum likelihood: kinds fitted to the rays of a candidate, from several starts each.

The likelihood is rough and has several local maxima, of which Levenberg and Marquardt's method finds the nearest. So
each kind is fitted from starts at several angles, and a fit of a special case (a square) starts the general kind (a
rectangle) too. Jumps of the likelihood at silhouettes are smoothed by a blur that is reduced stage by stage
(graduated optimisation). Of each kind all distinct maxima (modes) that are likely enough are kept, best first.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np

from detect.refinement.likelihood.geometry import JACOBIANS, NUMBERS, OUTLINES, parameters_of, primitive_of
from detect.refinement.likelihood.kernels import (
    PARAMETERS,
    THETA,
    Schedule,
    Starts,
    descend,
    negative_log_likelihoods,
)
from detect.refinement.likelihood.rays import RayBundle
from detect.refinement.likelihood.sensor_model import BeamModel
from detect.refinement.options import DEFAULTS, Descent, FitOptions
from prim import linear_algebra
from prim.arrays import FloatArray
from prim.shapes import Kind, Primitive

SPECIAL_CASES = {kind: kind.special_case for kind in Kind if kind.special_case is not None}
"""The special case of each kind that has one: of a rectangle the square, of an ellipse the circle."""


@dataclass(frozen=True)
class KindFit:
    """A kind fitted to rays.

    Attributes:
        kind: The kind.
        p: (5,) the maximum-likelihood parameters x, y (m), theta (rad), width, height (m).
        cost: Negative log-likelihood there (nats), up to a constant of the noise: with the last blur, and scaled from
            the rays that were used to all of them.
        information: (K, K) on the kind's own parameters.
    """

    kind: Kind
    p: FloatArray
    cost: float
    information: FloatArray


Start = tuple[Kind, FloatArray]
"""A kind, and the parameters (5,) that a fit of it begins with."""


@dataclass(frozen=True)
class Subset:
    """Every ``stride``-th ray of a bundle."""

    bundle: RayBundle
    stride: int = 1

    @classmethod
    def of(cls, bundle: RayBundle, about: int) -> Subset:
        """Choose rays evenly.

        Args:
            bundle: The rays.
            about: About how many.

        Returns:
            The subset.
        """
        stride = max(1, len(bundle) // about)
        return cls(bundle.select(slice(None, None, stride)), stride) if stride > 1 else cls(bundle)


def starts(guess: Primitive, kind: Kind, options: FitOptions = DEFAULTS.fit) -> list[FloatArray]:
    """Make starts of a kind's fit for what was taken for another: same centroid, same second moments of area.

    Args:
        guess: What it was taken for.
        kind: The kind to fit.
        options: Numeric parameters.

    Returns:
        Parameters (5,), one for each start angle.
    """
    x, y, theta, *sizes = parameters_of(guess).tolist()
    spread = [size / math.sqrt(factor) for size, factor in zip(sizes, guess.kind.spread_factors, strict=True)]
    made = []
    mean = math.sqrt(spread[0] * spread[1])
    for turn in start_turns(kind, guess.kind):
        along, across = spread
        if abs(math.sin(turn)) > options.across:
            along, across = across, along
        elif abs(math.sin(turn)) > options.aligned or kind.is_tied:
            along = across = mean
        a, b = (math.sqrt(factor) for factor in kind.spread_factors)
        made.append(np.array([x, y, theta + turn if kind.has_angle else 0.0, a * along, b * across]))
    return made


def start_turns(kind: Kind, guessed: Kind) -> list[float]:
    """Choose the angles from a guess at which fits of a kind start.

    Two angles, half a period apart, for kinds that repeat after a quarter turn (or do so with both sizes exchanged);
    the four quarter turns for all others. If the guess is of the same kind already, its almost regular shapes may
    have been taken for each other, one regular period apart: these angles are added.

    Args:
        kind: The kind to fit.
        guessed: The guess's kind.

    Returns:
        Angles (rad).
    """
    row = kind.row
    if row.period is None:
        return [0.0]
    if kind.longer_first or row.period <= math.pi / 2:
        return [0.0, min(row.period, math.pi / 2) / 2]
    turns = [0.0, math.pi / 2, math.pi, -math.pi / 2]
    if kind is guessed and row.regular_period is not None:
        turns += [row.regular_period, -row.regular_period]
    return turns


def fit_all_kinds(
    guess: Primitive,
    earlier: Sequence[KindFit],
    bundle: RayBundle,
    sensor: BeamModel,
    options: FitOptions = DEFAULTS.fit,
) -> list[KindFit]:
    """Fit every kind that may explain a candidate's rays.

    All starts are fitted to some of the rays and compared on all of them, beside the guess and earlier fits; the
    best of each kind are fitted to more rays.

    Args:
        guess: What the candidate is taken for.
        earlier: Earlier fits.
        bundle: Its rays.
        sensor: The sensor.
        options: Numeric parameters.

    Returns:
        The distinct modes of each kind that is not out of the question, the best one of a kind first.
    """
    begin = [(kind, p) for kind in Kind for p in starts(guess, kind, options)]
    coarse = _fit_each(begin, Subset.of(bundle, options.coarse_rays), sensor, options.coarse, options)
    made = [(fit.kind, fit.p) for fit in (*coarse, *earlier)]
    ranked = _ranked([*made, (guess.kind, parameters_of(guess))], bundle, sensor, options)
    best: dict[Kind, float] = {}
    for cost, (kind, _) in ranked:
        best.setdefault(kind, cost)
    contenders = {kind for kind, cost in best.items() if cost < min(best.values()) + options.kind_cost_margin}
    contenders |= {special for kind, special in SPECIAL_CASES.items() if kind in contenders}
    chosen: list[Start] = []
    for kind in Kind:
        limit = best[kind] + options.start_cost_margin
        own = [start for cost, start in ranked if start[0] is kind and cost < limit]
        chosen += own[: options.starts_kept] if kind in contenders else []
    return _modes_of_each_kind(chosen, Subset.of(bundle, options.search_rays), sensor, options.fine, options)


def _ranked(
    candidates: Sequence[Start], bundle: RayBundle, sensor: BeamModel, options: FitOptions
) -> list[tuple[float, Start]]:
    """Return starts with their costs (nats) over all rays at the first fine blur, best first."""
    out = np.empty(len(candidates))
    numbers = np.array([NUMBERS[kind] for kind, _ in candidates])
    shapes = np.stack([p for _, p in candidates])
    negative_log_likelihoods(OUTLINES, numbers, shapes, sensor.data(bundle), options.fine.blurs[0], out)
    return sorted(zip(out.tolist(), candidates, strict=True), key=lambda item: item[0])


def refit(
    fits: Sequence[KindFit], bundle: RayBundle, sensor: BeamModel, options: FitOptions = DEFAULTS.fit
) -> list[KindFit]:
    """Fit kinds to all rays from earlier fits, and general kinds from fits of their special cases.

    Args:
        fits: The earlier fits.
        bundle: All rays.
        sensor: The sensor.
        options: Numeric parameters.

    Returns:
        The distinct modes of each kind, the best one of a kind first.
    """
    begin = [(fit.kind, fit.p) for fit in fits]
    begin += _scattered(fits, Subset.of(bundle, options.search_rays), sensor, options)
    return _modes_of_each_kind(begin, Subset(bundle), sensor, options.last, options)


def _scattered(fits: Sequence[KindFit], subset: Subset, sensor: BeamModel, options: FitOptions) -> list[Start]:
    """Return further starts about the best fit of each likely kind: scattered shapes, triangles a quarter turn on."""
    lowest = min(fit.cost for fit in fits)
    best = {fit.kind: fit for fit in sorted(fits, key=lambda fit: -fit.cost)}
    likely = [fit for fit in best.values() if fit.cost <= lowest + options.scatter_cost_margin]
    quarter_turns = [
        (fit.kind, p)
        for fit in likely
        if fit.kind.any_apex
        for p in starts(primitive_of(fit.kind, fit.p), fit.kind, options)[1:4:2]
    ]
    return quarter_turns + [start for fit in likely for start in _scattered_about(fit, subset, sensor, options)]


def _scattered_about(fit: KindFit, subset: Subset, sensor: BeamModel, options: FitOptions) -> list[Start]:
    """Return the likeliest of shapes that are scattered about a fit, by a multiple of its covariance."""
    jacobian = JACOBIANS[fit.kind]
    inverse = linear_algebra.inverse(fit.information / sensor.dispersion + np.eye(jacobian.shape[1]))
    lower = None if inverse is None else linear_algebra.cholesky(options.scatter**2 * inverse)
    if lower is None:
        return []
    shapes = fit.p + _standard_normal(options.scattered, len(lower)) @ (jacobian @ lower).T
    shapes = np.ascontiguousarray(shapes[(shapes[:, 3:] > options.min_size).all(axis=1)])
    cost, numbers = np.empty(len(shapes)), np.full(len(shapes), NUMBERS[fit.kind])
    negative_log_likelihoods(OUTLINES, numbers, shapes, sensor.data(subset.bundle), options.scatter_blur, cost)
    likeliest = np.argsort(cost, kind="stable")[: options.scatter_kept]
    return [(fit.kind, shapes[k]) for k in likeliest.tolist()]


@lru_cache(maxsize=8)
def _standard_normal(count: int, size: int) -> FloatArray:
    """Return standard normal samples (count, size), the same every time, so that results are reproducible."""
    return np.random.default_rng(size).standard_normal((count, size))


def refit_same_kind(
    fit: KindFit, bundle: RayBundle, sensor: BeamModel, options: FitOptions = DEFAULTS.fit
) -> list[KindFit]:
    """Fit one kind, and no other, to all rays from an earlier fit.

    Args:
        fit: The earlier fit.
        bundle: All rays.
        sensor: The sensor.
        options: Numeric parameters.

    Returns:
        The fit alone.
    """
    return _fit_each([(fit.kind, fit.p)], Subset(bundle), sensor, options.last, options)


def _modes_of_each_kind(
    begin: Sequence[Start], subset: Subset, sensor: BeamModel, descent: Descent, options: FitOptions
) -> list[KindFit]:
    """Return the modes of each kind from some starts, other apexes, and special cases that are no worse."""
    found: dict[Kind, list[KindFit]] = {}

    def keep(fits: Sequence[KindFit]) -> None:
        for kind in dict.fromkeys(fit.kind for fit in fits):
            own = [*found.get(kind, []), *(fit for fit in fits if fit.kind is kind)]
            found[kind] = distinct_modes(own, options)

    keep(_fit_each(begin, subset, sensor, descent, options))
    apexes = [
        (kind, p)
        for kind, fits in found.items()
        if kind.any_apex
        for p in other_apexes(fits[0].p, options.equilateral)
    ]
    keep(_fit_each(apexes, subset, sensor, descent, options))
    no_better = [
        (kind, p)
        for kind, special in SPECIAL_CASES.items()
        if special in found
        and (kind not in found or found[kind][0].cost > found[special][0].cost - descent.tolerance)
        for p in beyond_special_case(kind, found[special][0].p, options.stretch)
    ]
    keep(_fit_each(no_better, subset, sensor, descent, options))
    return [fit for fits in found.values() for fit in fits]


def distinct_modes(fits: Sequence[KindFit], options: FitOptions = DEFAULTS.fit) -> list[KindFit]:
    """Choose the modes of one kind among its fits: one fit of each, of all that are likely enough.

    Two fits are of the same mode where either lies within ``options.same_mode`` standard deviations of the other, by
    its information. All modes get those names of their shapes that are nearest to the best one's parameters.

    Args:
        fits: Fits of one kind.
        options: When modes are distinct, which are likely enough, and how many are kept.

    Returns:
        The modes, the likeliest first.
    """

    def cost(fit: KindFit) -> float:
        """Return a fit's cost; one that no prior allows must gain something: where sizes are unseen they drift."""
        is_too_large = bool(fit.p[3:].max() * fit.kind.extent > options.max_extent)
        return fit.cost + options.too_large_nats * is_too_large

    ordered = sorted(fits, key=cost)
    modes = ordered[:1]
    for fit in ordered[1:]:
        if len(modes) == options.modes_kept or not fit.cost < modes[0].cost + options.mode_cost_margin:
            break
        if not any(_is_same_mode(fit, mode, options) for mode in modes):
            p, order = nearest_name(fit.kind, fit.p, modes[0].p)
            modes.append(replace(fit, p=p, information=fit.information[np.ix_(order, order)]))
    return modes


def _is_same_mode(fit: KindFit, mode: KindFit, options: FitOptions) -> bool:
    """Tell whether two fits of one kind are of the same mode."""
    p, order = nearest_name(fit.kind, fit.p, mode.p)
    jacobian = JACOBIANS[fit.kind]
    apart = (p - mode.p) @ (jacobian / (jacobian**2).sum(axis=0))
    informations = fit.information[np.ix_(order, order)], mode.information
    return not min(float(apart @ information @ apart) for information in informations) > options.same_mode**2


def nearest_name(kind: Kind, p: FloatArray, like: FloatArray) -> tuple[FloatArray, list[int]]:
    """Choose, of the parameters that name the same shape, those nearest to others.

    Angles are the same modulo the kind's period; where the longer size is first by definition, a shape has a second
    name, with the sizes exchanged and a quarter turn. Distances are in metres: an angle's is along a circle around
    the shape.

    Args:
        kind: The kind.
        p: (5,) parameters.
        like: (5,) the others.

    Returns:
        (5,) parameters of the same shape, and the order in which the kind's own parameters are taken for them.
    """
    period, order = kind.row.period, list(range(JACOBIANS[kind].shape[1]))
    if period is None:
        return p, order
    names = [(p, order)]
    if kind.longer_first:
        names.append((np.array([p[0], p[1], p[2] + math.pi / 2, p[4], p[3]]), [*order[:3], 4, 3]))
    reach = math.hypot(like[3], like[4]) / 2

    def turned(name: FloatArray) -> FloatArray:
        turns = round(float(like[THETA] - name[THETA]) / period)
        return np.asarray(name + turns * period * np.eye(PARAMETERS)[THETA])

    def distance(name: FloatArray) -> float:
        return math.hypot(name[3] - like[3], name[4] - like[4], reach * (name[2] - like[2]))

    return min(((turned(name), order) for name, order in names), key=lambda item: distance(item[0]))


def beyond_special_case(kind: Kind, p: FloatArray, stretch: float = DEFAULTS.fit.stretch) -> list[FloatArray]:
    """Make starts of a kind's fit from a fit of its special case.

    Where that has no angle, they are stretched along four directions, since there is none to turn to.

    Args:
        kind: The kind.
        p: (5,) parameters of its special case.
        stretch: By which factor.

    Returns:
        Parameters (5,) of the starts.
    """
    if SPECIAL_CASES[kind].has_angle:
        return [p]
    longer = np.array([stretch, 1 / stretch])
    turns = [quarter * math.pi / 4 for quarter in range(4)]
    return [np.array([p[0], p[1], turn, *(p[3:] * longer)]) for turn in turns]


def other_apexes(p: FloatArray, equilateral: float = DEFAULTS.fit.equilateral) -> list[FloatArray]:
    """Find the isosceles triangles most like a given one that have its other corners as apexes.

    Where all sides are nearly the same, any corner may be taken for the apex.

    Args:
        p: (5,) parameters of an isosceles triangle: x, y, theta, base, height.
        equilateral: Sides whose ratio is beyond this factor are not nearly the same.

    Returns:
        Two sets of parameters (5,), or none.
    """
    x, y, theta, base, height = p.tolist()
    leg = math.hypot(base / 2, height)
    if not 1 / equilateral < leg / base < equilateral:
        return []
    mean = (leg + base) / 2  # of the two sides at the new apex; the new base is the leg across from it
    tall = math.sqrt(mean**2 - leg**2 / 4)
    turn = math.pi - math.atan2(height, base / 2)  # from the base to a leg, taken counter-clockwise
    return [np.array([x, y, theta + sign, leg, tall]) for sign in (turn, -turn)]


def _schedule(descent: Descent, stride: int, sensor: BeamModel, options: FitOptions) -> Schedule:
    """Return a descent as the kernel takes it: no blur is narrower than the sensor's footprint."""
    return Schedule(
        np.array(list(dict.fromkeys(max(blur, sensor.footprint) for blur in descent.blurs))),
        descent.steps,
        descent.tolerance / stride,
        options.first_damping,
        options.min_damping,
        options.max_damping,
        options.damping_after_success,
        options.damping_after_failure,
        options.damping_where_singular,
        options.min_size,
        options.max_size,
        max(options.information_blur, sensor.footprint),
    )


def _fit_each(
    begin: Sequence[Start], subset: Subset, sensor: BeamModel, descent: Descent, options: FitOptions
) -> list[KindFit]:
    """Fit from each start to a subset of the rays; cost and information are scaled to all rays."""
    if not begin:
        return []
    jacobians = np.zeros((len(begin), PARAMETERS, PARAMETERS))
    sizes = np.array([JACOBIANS[kind].shape[1] for kind, _ in begin])
    for jacobian, size, (kind, _) in zip(jacobians, sizes.tolist(), begin, strict=True):
        jacobian[:, :size] = JACOBIANS[kind]
    shapes, cost = np.stack([p for _, p in begin]), np.empty(len(begin))
    information = np.zeros_like(jacobians)
    numbers = np.array([NUMBERS[kind] for kind, _ in begin])
    schedule = _schedule(descent, subset.stride, sensor, options)
    batch = Starts(numbers, shapes, jacobians, sizes)
    descend(OUTLINES, batch, sensor.data(subset.bundle), schedule, cost, information)
    cost, information = subset.stride * cost, subset.stride * information
    return [
        KindFit(kind, p, float(nats), known[:size, :size])
        for (kind, _), p, nats, known, size in zip(begin, shapes, cost, information, sizes.tolist(), strict=True)
    ]
