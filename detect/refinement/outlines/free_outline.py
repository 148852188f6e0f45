"""Free outlines about a fitted primitive: its outline, deformed by as many harmonics as the rays support.

The radius about the centroid is the primitive's times exp(g(t)), g a Fourier series whose coefficients have a normal
prior, the smaller the higher the harmonic (a Gaussian process on the circle). The Bayes factor of the free outline
against the primitive follows by Laplace's method: the primitive is the case that all coefficients are zero.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from detect.refinement.likelihood.rays import RayBundle
from detect.refinement.likelihood.sensor_model import BeamModel
from detect.refinement.options import DEFAULTS, OutlineOptions
from detect.refinement.outlines.kernels import (
    NO_GRADIENT,
    NO_INFORMATION,
    outline_likelihood,
    outline_ranges,
    project_on_harmonics,
)
from prim import linear_algebra
from prim.arrays import FloatArray
from prim.shapes import Primitive


def ranges_of(vertices: FloatArray, bundle: RayBundle) -> FloatArray:
    """Cast rays against a closed polygon.

    Args:
        vertices: (V, 2) in metres.
        bundle: N rays.

    Returns:
        The ranges (N,) in metres; FAR for a miss.
    """
    ranges = np.empty(len(bundle))
    outline_ranges(vertices, bundle.rays, ranges)
    return ranges


@dataclass(frozen=True)
class StarOutline:
    """A primitive's outline as a function of an angle about its centroid, to be deformed.

    Attributes:
        centre: (2,) the centroid (m).
        directions: (V, 2) unit vectors from there to the vertices, counter-clockwise.
        radii: (V,) distances of the vertices (m).
        basis: (V, 2 H + 1) the harmonics at the vertices: 1, cos t, sin t, cos 2t …
    """

    centre: FloatArray
    directions: FloatArray
    radii: FloatArray
    basis: FloatArray

    @classmethod
    def of(cls, primitive: Primitive, options: OutlineOptions = DEFAULTS.outline) -> StarOutline:
        """Sample a primitive's outline.

        Of polygons all corners are among the vertices, and t is the direction's angle; of round ones t is the
        eccentric angle, by which flat ellipses are sampled evenly.

        Args:
            primitive: The primitive.
            options: How many vertices and harmonics.

        Returns:
            The outline.
        """
        centre = np.array([primitive.x, primitive.y])
        if primitive.is_round:
            vertices = primitive.outline(options.vertices) - centre
            turn = 2 * math.pi * np.arange(options.vertices) / options.vertices
        else:
            vertices = _subdivided(primitive.outline() - centre, options.vertices)
            turn = np.arctan2(vertices[:, 1], vertices[:, 0])
        radii = np.hypot(*vertices.T)
        return cls(centre, vertices / radii[:, None], radii, _harmonics(turn, options.harmonics))

    def deformed(self, coefficients: FloatArray, options: OutlineOptions = DEFAULTS.outline) -> FloatArray:
        """Deform the outline.

        Args:
            coefficients: (2 H + 1,) of the harmonics.
            options: Bounds of the deformation.

        Returns:
            The vertices (V, 2) in m.
        """
        growth = np.clip(self.basis @ coefficients, *options.growth)
        return np.asarray(self.centre + (self.radii * np.exp(growth))[:, None] * self.directions)


def _subdivided(corners: FloatArray, about: int) -> FloatArray:
    """Return a polygon (C, 2) about the origin with further vertices, evenly spread by angle; corners stay."""
    made = []
    for corner, following in zip(corners, np.roll(corners, -1, axis=0), strict=True):
        first, last = math.atan2(corner[1], corner[0]), math.atan2(following[1], following[0])
        opening = (last - first) % (2 * math.pi)
        angles = first + opening * np.linspace(0, 1, max(1, round(about * opening / (2 * math.pi))), endpoint=False)
        made.append(_on_edge(corner, following, angles))
    return np.concatenate(made)


def _on_edge(corner: FloatArray, following: FloatArray, angles: FloatArray) -> FloatArray:
    """Return the points (N, 2) of an edge's line in these directions (N,) from the origin."""
    along = following - corner
    directions = np.column_stack((np.cos(angles), np.sin(angles)))
    distance = corner[0] * along[1] - corner[1] * along[0]
    across = directions[:, 0] * along[1] - directions[:, 1] * along[0]
    return np.asarray(directions * (distance / across)[:, None])


def _harmonics(turn: FloatArray, count: int) -> FloatArray:
    """Return 1, cos t, sin t, cos 2t, … (V, 2 count + 1)."""
    angles = turn[:, None] * np.arange(1, count + 1)
    waves = np.stack((np.cos(angles), np.sin(angles)), axis=-1).reshape(len(turn), -1)
    return np.column_stack((np.ones(len(turn)), waves))


@lru_cache(maxsize=8)
def prior_precision(amplitude: float, harmonics: int, decay: float) -> FloatArray:
    """Compute the prior's precision: harmonic k has the variance amplitude² k^(-2 decay), the constant amplitude².

    Args:
        amplitude: The standard deviation of the first harmonic's.
        harmonics: How many harmonics.
        decay: By which power of k the standard deviation falls.

    Returns:
        The precision (2 H + 1,).
    """
    order = np.concatenate(([1.0], np.repeat(np.arange(1.0, harmonics + 1), 2)))
    return np.asarray(order ** (2 * decay) / amplitude**2)


@dataclass(frozen=True)
class _Expansion:
    """The cost (nats, divided by the dispersion) at some coefficients, its gradient and information there."""

    coefficients: FloatArray
    cost: float
    gradient: FloatArray
    information: FloatArray


class OutlineCost:
    """The negative log-likelihood, over the dispersion, of a primitive's deformed outline."""

    def __init__(
        self, star: StarOutline, bundle: RayBundle, sensor: BeamModel, options: OutlineOptions = DEFAULTS.outline
    ) -> None:
        self._star, self._options = star, options
        self._data, self._dispersion = sensor.data(bundle), sensor.dispersion
        size = 2 * len(star.radii)
        self._gradient, self._information = np.zeros(size), np.zeros((size, size))

    def expand(self, coefficients: FloatArray, blur: float) -> _Expansion:
        """Compute the cost with its derivatives.

        Args:
            coefficients: (2 H + 1,) of the harmonics.
            blur: Half-width (m) of silhouettes.

        Returns:
            The expansion there.
        """
        vertices = self._star.deformed(coefficients, self._options)
        cost = outline_likelihood(vertices, self._data, blur, self._gradient, self._information)
        count = len(coefficients)
        gradient, information = np.empty(count), np.empty((count, count))
        moves = vertices - self._star.centre
        project_on_harmonics(moves, self._star.basis, self._gradient, self._information, gradient, information)
        scale = 1 / self._dispersion
        return _Expansion(coefficients, scale * cost, scale * gradient, scale * information)

    def radial_std(self, there: _Expansion, precision: FloatArray) -> float:
        """Compute how well the outline is known.

        Args:
            there: The expansion at the fit.
            precision: (2 H + 1,) the prior's.

        Returns:
            The median standard deviation (m) of the vertices along the radius.
        """
        covariance = linear_algebra.inverse(there.information + np.diag(precision))
        if covariance is None:
            return math.inf
        basis = self._star.basis
        growth = np.sqrt(np.maximum(((basis @ covariance) * basis).sum(axis=1), 0.0))
        return float(np.median(growth * self._star.radii * np.exp(basis @ there.coefficients)))

    def at(self, coefficients: FloatArray, blur: float) -> float:
        """Compute the cost alone.

        Args:
            coefficients: (2 H + 1,) of the harmonics.
            blur: Half-width (m) of silhouettes.

        Returns:
            Nats, over the dispersion.
        """
        vertices = self._star.deformed(coefficients, self._options)
        cost = outline_likelihood(vertices, self._data, blur, NO_GRADIENT, NO_INFORMATION)
        return float(cost) / self._dispersion


def score_test(cost: OutlineCost, blur: float, options: OutlineOptions = DEFAULTS.outline) -> tuple[float, float]:
    """Approximate the Bayes factor of free outlines by one step from the primitive (Rao's score test).

    Args:
        cost: The cost of its deformed outline.
        blur: Half-width (m) of silhouettes.
        options: The priors.

    Returns:
        The largest log Bayes factor over the priors (nats), and the gain of log-likelihood and prior there (nats).
    """
    start = cost.expand(np.zeros(2 * options.harmonics + 1), blur)
    best, gained = -math.inf, 0.0
    for amplitude in options.amplitudes:
        precision = prior_precision(amplitude, options.harmonics, options.decay)
        step = linear_algebra.solve(start.information + np.diag(precision), start.gradient)
        if step is None:
            continue
        gain = 0.5 * float(start.gradient @ step)
        factor = gain - occam(start.information, precision)
        if factor > best:
            best, gained = factor, gain
    return best, gained


def occam(information: FloatArray, precision: FloatArray) -> float:
    """Compute what free coefficients cost: half the log-determinant of 1 + information / precision.

    Args:
        information: (K, K) of the rays on them.
        precision: (K,) the prior's.

    Returns:
        Nats.
    """
    scaled = np.eye(len(precision)) + information / np.sqrt(precision[:, None] * precision)
    logarithm = linear_algebra.log_determinant(scaled)
    return math.inf if logarithm is None else 0.5 * logarithm


@dataclass(frozen=True)
class OutlineFit:
    """A primitive's outline, deformed by what its rays say.

    Attributes:
        coefficients: (2 H + 1,) of the harmonics.
        log_bayes_factor: Against the primitive (nats).
        std: Standard deviation (m) of the outline along the radius; the median over its vertices.
    """

    coefficients: FloatArray
    log_bayes_factor: float
    std: float


def fit_free_outline(cost: OutlineCost, last_blur: float, options: OutlineOptions = DEFAULTS.outline) -> OutlineFit:
    """Fit the coefficients of a primitive's deformed outline: the posterior's mode for each prior.

    Args:
        cost: The cost.
        last_blur: Half-width (m) of silhouettes in the end.
        options: The priors and the descent.

    Returns:
        The fit for the prior with the largest evidence.
    """
    size = 2 * options.harmonics + 1
    coefficients, best = np.zeros(size), OutlineFit(np.zeros(size), -math.inf, math.inf)
    base = cost.at(np.zeros(size), last_blur)
    for amplitude in options.amplitudes:
        precision = prior_precision(amplitude, options.harmonics, options.decay)
        for blur in options.descent.blurs:
            coefficients = _descend(cost, coefficients, precision, max(blur, last_blur), options)
        there = cost.expand(coefficients, max(last_blur, options.information_blur))
        gain = base - cost.at(coefficients, last_blur) - 0.5 * float(precision @ coefficients**2)
        factor = gain - occam(there.information, precision)
        if factor > best.log_bayes_factor:
            best = OutlineFit(coefficients, factor, cost.radial_std(there, precision))
    return best


def _descend(
    cost: OutlineCost, start: FloatArray, precision: FloatArray, blur: float, options: OutlineOptions
) -> FloatArray:
    """Minimise cost and prior from a start by Levenberg and Marquardt's method at one blur."""
    damping = options.first_damping
    here = cost.expand(start, blur)
    objective = here.cost + 0.5 * float(precision @ start**2)
    for _ in range(options.descent.steps):
        curvature = here.information + np.diag(precision)
        damped = curvature + damping * np.diag(np.diag(curvature))
        step = linear_algebra.solve(damped, here.gradient + precision * here.coefficients)
        if step is None:
            break
        there = cost.expand(here.coefficients - step, blur)
        found = there.cost + 0.5 * float(precision @ there.coefficients**2)
        if found < objective:
            gain, objective, here = objective - found, found, there
            damping = max(damping * options.damping_after_success, options.min_damping)
            if gain < options.descent.tolerance:
                break
        else:
            damping *= options.damping_after_failure
            if damping > options.max_damping:
                break
    return here.coefficients
