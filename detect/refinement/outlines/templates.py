"""Shapes of few parameters that are none of the kinds: L, U, T, cross, star, half disc, stadium and others.

Where the noise is large, rays do not pay for a free outline's many parameters. A template is a unit outline that a
few shares shape, stretched by width and height, turned and moved as the kinds' are, with priors as theirs: positions
flat, sizes uniform up to the same extent, angles uniform, shares uniform from 0 to 1. All templates are equally
likely a priori. A descent has the logarithms of the odds of shares for parameters, which have no bounds.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import lru_cache, partial

import numpy as np

from detect.refinement.likelihood.kernels import RayData
from detect.refinement.likelihood.rays import RayBundle
from detect.refinement.likelihood.sensor_model import BeamModel
from detect.refinement.options import DEFAULTS, Descent, EvidenceOptions, TemplateOptions
from detect.refinement.outlines.kernels import NO_GRADIENT, NO_INFORMATION, outline_likelihood
from detect.refinement.outlines.polygons import std_across
from prim import linear_algebra
from prim.arrays import FloatArray
from prim.shapes import Kind, Primitive

POSE = 3
"""Parameters before the sizes: x, y (m), theta (rad)."""

DIFFERENCE = 1e-4
"""The step of a share, as a part of what is left to 1, that its derivative is taken over."""

BLUNTEST = 0.85
"""The largest inner radius of a star, as a share of that of the regular polygon around it: beyond, it is that."""

Shaped = Callable[..., FloatArray]
"""From shares to the vertices (V, 2) of a unit outline in a box from -1/2 to 1/2, counter-clockwise."""


def _ell(width: float, height: float) -> FloatArray:
    x, y = 0.5 - width, 0.5 - height
    return np.array([(-0.5, -0.5), (0.5, -0.5), (0.5, y), (x, y), (x, 0.5), (-0.5, 0.5)])


def _notched(width: float, depth: float, place: float) -> FloatArray:
    left, y = (1 - width) * place - 0.5, 0.5 - depth
    gap = [(left + width, 0.5), (left + width, y), (left, y), (left, 0.5)]
    return np.array([(-0.5, -0.5), (0.5, -0.5), (0.5, 0.5), *gap, (-0.5, 0.5)])


def _u(width: float, depth: float) -> FloatArray:
    return _notched(width, depth, 0.5)


def _tee(stem: float, bar: float) -> FloatArray:
    x, y = stem / 2, 0.5 - bar
    return np.array([(-x, -0.5), (x, -0.5), (x, y), (0.5, y), (0.5, 0.5), (-0.5, 0.5), (-0.5, y), (-x, y)])


def _cross(width: float, height: float) -> FloatArray:
    x, y = width / 2, height / 2
    right = [(x, -0.5), (x, -y), (0.5, -y), (0.5, y), (x, y), (x, 0.5)]
    return np.array(right + [(-a, -b) for a, b in right])


def _even_cross(arm: float) -> FloatArray:
    return _cross(arm, arm)


@lru_cache(maxsize=64)
def _steps(points: int) -> FloatArray:
    """Return evenly spaced numbers from -1 to 1."""
    return np.linspace(-1, 1, points)


def _arc(half: float, points: int, radius: float = 0.5) -> FloatArray:
    """Return points (N, 2) of a circle, ``half`` (rad) to both sides of the x axis."""
    angles = half * _steps(points)
    return np.column_stack((radius * np.cos(angles), radius * np.sin(angles)))


@lru_cache(maxsize=64)
def _regular(corners: int) -> FloatArray:
    return _arc(math.pi * (1 - 1 / corners), corners)


@lru_cache(maxsize=1)
def _half_disc() -> FloatArray:
    return _arc(math.pi / 2, 24) - [0.25, 0.0]


@lru_cache(maxsize=1)
def _half_ellipse() -> FloatArray:
    return np.asarray(_arc(math.pi / 2, 24) * [2.0, 1.0] - [0.5, 0.0])


def _stadium(end: float) -> FloatArray:
    right = _arc(math.pi / 2, 12) * [end, 1.0] + [0.5 - end / 2, 0.0]
    return np.concatenate((right, -right))


def _trapezoid(top: float) -> FloatArray:
    return np.array([(-0.5, -0.5), (0.5, -0.5), (top / 2, 0.5), (-top / 2, 0.5)])


def _parallelogram(shear: float) -> FloatArray:
    offset = shear - 0.5
    x = 0.5 - abs(offset)
    return np.array([(-x - offset, -0.5), (x - offset, -0.5), (x + offset, 0.5), (-x + offset, 0.5)])


def _kite(waist: float) -> FloatArray:
    return np.array([(0.0, -0.5), (0.5, waist - 0.5), (0.0, 0.5), (-0.5, waist - 0.5)])


def _arrow(depth: float) -> FloatArray:
    return np.array([(-0.5, -0.5), (0.0, depth - 0.5), (0.5, -0.5), (0.0, 0.5)])


def _scalene(apex: float) -> FloatArray:
    return np.array([(-0.5, -0.5), (0.5, -0.5), (apex - 0.5, 0.5)])


def _ring(thickness: float, opening: float) -> FloatArray:
    half = math.pi * opening
    return np.concatenate((_arc(half, 20), _arc(-half, 16, 0.5 * (1 - thickness))))


def _star(points: int, inner: float) -> FloatArray:
    """Return a star; its inner radius is a share of that of the regular polygon around it, up to BLUNTEST."""
    outline = _regular(2 * points).copy()
    outline[::2] *= inner * BLUNTEST * math.cos(math.pi / points)
    return outline


@dataclass(frozen=True)
class Start:
    """Where fits of a template begin, in the frame of a fitted kind.

    Attributes:
        corners: How many that kind has; none where it is round.
        shares: The template's shares.
        turns: Angles (rad) from the kind's.
        boxed: Whether both have the same bounding box; else the same centroid and second moments of area.
    """

    corners: int
    shares: tuple[float, ...]
    turns: tuple[float, ...]
    boxed: bool = False


def _turns(count: int, over: float = 2 * math.pi) -> tuple[float, ...]:
    return tuple(over * n / count for n in range(count))


@dataclass(frozen=True)
class Template:
    """A family of shapes.

    Attributes:
        name: What it is, for reasons.
        outline: From shares to the unit outline in a box from -1/2 to 1/2, counter-clockwise.
        starts: Where fits begin.
        names: How many turns of the parameters' angle give the same shape (both sizes exchanged, too).
        tied: Whether width and height are one and the same size.
    """

    name: str
    outline: Shaped
    starts: tuple[Start, ...]
    names: int = 1
    tied: bool = False

    @property
    def shares(self) -> int:
        """How many shares it has."""
        return len(self.starts[0].shares)

    @property
    def rigid(self) -> int:
        """How many parameters place and stretch it."""
        return POSE + (1 if self.tied else 2)

    @property
    def parameters(self) -> int:
        """How many parameters it has in all."""
        return self.rigid + self.shares

    def unit(self, shares: FloatArray) -> FloatArray:
        """Return the unit outline (V, 2) of some shares."""
        return self.outline(*shares.tolist())

    def log_prior(self, q: FloatArray, prior: EvidenceOptions) -> float:
        """Return the log prior density at some parameters, without that of the position.

        Args:
            q: (K,) x, y, theta, sizes (m), log odds of shares.
            prior: The prior of sizes.

        Returns:
            Nats (rad, m, shares).
        """
        sizes = prior.log_size_density - np.log(q[POSE : self.rigid])
        return math.log(self.names / (2 * math.pi)) + float(sizes.sum())

    def vertices(self, q: FloatArray) -> FloatArray:
        """Return the vertices (V, 2) in m of parameters (K,): x, y, theta, sizes (m), log odds of shares."""
        unit = self.unit(_shares(q[self.rigid :]))
        return np.asarray((unit * [q[POSE], q[self.rigid - 1]]) @ _turned(float(q[2])) + q[:2])

    def jacobian(self, q: FloatArray) -> FloatArray:
        """Return the Jacobian (2 V, K) of the vertices by the parameters; by shares it is a difference."""
        shares = _shares(q[self.rigid :])
        unit, size, turn = self.unit(shares), np.array([q[POSE], q[self.rigid - 1]]), _turned(float(q[2]))
        slopes = np.zeros((len(unit), 2, len(q)))
        slopes[:, 0, 0] = slopes[:, 1, 1] = 1.0
        along = (unit * size) @ turn
        slopes[:, 0, 2], slopes[:, 1, 2] = -along[:, 1], along[:, 0]
        slopes[:, :, POSE] = unit[:, :1] * turn[0]
        slopes[:, :, self.rigid - 1] += unit[:, 1:] * turn[1]
        for n, share in enumerate(shares.tolist()):
            there = shares.copy()
            there[n] += DIFFERENCE * (1 - share)
            change = (self.unit(there) - unit) * (share / DIFFERENCE)
            slopes[:, :, self.rigid + n] = (change * size) @ turn
        return slopes.reshape(-1, len(q))


def _turned(theta: float) -> FloatArray:
    """Return the matrix (2, 2) that turns rows of points."""
    cos, sin = math.cos(theta), math.sin(theta)
    return np.array([[cos, sin], [-sin, cos]])


def _shares(odds: FloatArray) -> FloatArray:
    """Return shares from the logarithms of their odds."""
    return np.asarray(1 / (1 + np.exp(-odds)))


BOX, TRIANGLE, ROUND = 4, 3, 0
"""Corners of the kinds in whose frames fits begin."""

ONCE, HALF, QUARTERS, EIGHTHS = _turns(1), _turns(2, math.pi), _turns(4), _turns(8)
LEANING, BACK = (0.0, math.pi / 2, 5 * math.pi / 4), (math.pi,)


def _polygon(corners: int) -> Template:
    period = 2 * math.pi / corners
    starts = (Start(BOX, (), _turns(4, period)), Start(ROUND, (), _turns(3, period)))
    return Template(f"a regular polygon of {corners} sides", partial(_regular, corners), starts, corners, tied=True)


def _star_of(points: int) -> Template:
    period = 2 * math.pi / points
    starts = Start(BOX, (0.85,), _turns(4, period)), Start(ROUND, (0.85,), _turns(3, period))
    return Template(f"a star of {points} points", partial(_star, points), starts, points, tied=True)


_KITES = (Start(TRIANGLE, (0.1,), ONCE), Start(TRIANGLE, (0.3,), ONCE), Start(ROUND, (0.45,), QUARTERS))

TEMPLATES = (
    Template("an L", _ell, (Start(BOX, (0.5, 0.5), QUARTERS, True), Start(TRIANGLE, (0.5, 0.5), LEANING))),
    Template("a U", _u, (Start(BOX, (0.4, 0.4), QUARTERS, True),)),
    Template("a notched box", _notched, (Start(BOX, (0.4, 0.4, 0.5), QUARTERS, True),)),
    Template("a T", _tee, (Start(BOX, (0.5, 0.5), QUARTERS, True), Start(TRIANGLE, (0.4, 0.4), BACK))),
    Template("a cross", _cross, (Start(BOX, (0.5, 0.5), ONCE, True),), names=4),
    Template("an even cross", _even_cross, (Start(BOX, (0.5,), ONCE),), names=4, tied=True),
    Template("a half disc", _half_disc, (Start(BOX, (), QUARTERS), Start(ROUND, (), EIGHTHS)), tied=True),
    Template("a half ellipse", _half_ellipse, tuple(Start(k, (), QUARTERS) for k in (BOX, ROUND, TRIANGLE))),
    Template("a stadium", _stadium, (Start(BOX, (0.4,), HALF, True), Start(ROUND, (0.6,), HALF)), names=2),
    Template("a trapezoid", _trapezoid, (Start(BOX, (0.75,), QUARTERS), Start(TRIANGLE, (0.25,), ONCE))),
    Template("a parallelogram", _parallelogram, (Start(BOX, (0.5,), HALF, True),), names=4),
    Template(
        "a kite",
        _kite,
        (*(Start(TRIANGLE, (k,), ONCE) for k in (0.1, 0.3)), Start(ROUND, (0.45,), QUARTERS)),
        names=2,
    ),
    Template("an arrow", _arrow, (Start(TRIANGLE, (0.3,), ONCE, True),)),
    Template("a scalene triangle", _scalene, (Start(TRIANGLE, (0.5,), ONCE, True),)),
    Template("a ring segment", _ring, (Start(ROUND, (0.4, 0.6), EIGHTHS), Start(TRIANGLE, (0.5, 0.5), ONCE))),
    *(_polygon(corners) for corners in (5, 6, 8)),
    *(_star_of(points) for points in (4, 5, 6, 7)),
)
"""The families."""


@dataclass(frozen=True)
class TemplateFit:
    """A template fitted to rays.

    Attributes:
        name: The template's.
        vertices: (V, 2) in m, map frame, counter-clockwise.
        log_evidence: Nats, comparable with that of kinds; the prior among templates is in it.
        std: Standard deviation (m) of the outline across it; the median over its vertices.
    """

    name: str
    vertices: FloatArray
    log_evidence: float
    std: float


@dataclass(frozen=True)
class Expansion:
    """A template's cost at some parameters, with its derivatives.

    Attributes:
        template: The template.
        q: (K,) its parameters.
        cost: Nats, with the prior of the shares' log odds.
        gradient: (K,).
        curvature: (K, K), positive definite.
    """

    template: Template
    q: FloatArray
    cost: float
    gradient: FloatArray
    curvature: FloatArray


@dataclass(frozen=True)
class Cost:
    """The negative log-likelihood of outlines, over the dispersion, scaled from some of the rays to all.

    Attributes:
        data: The rays.
        scale: How many rays each stands for, over the dispersion.
        prior: The prior of sizes.
        options: Numeric parameters.
    """

    data: RayData
    scale: float
    prior: EvidenceOptions
    options: TemplateOptions

    @classmethod
    def of_rays(
        cls, bundle: RayBundle, about: int, sensor: BeamModel, prior: EvidenceOptions, options: TemplateOptions
    ) -> Cost:
        """Make the cost of some of a bundle's rays.

        Args:
            bundle: The rays.
            about: About how many are used.
            sensor: The sensor.
            prior: The prior of sizes.
            options: Numeric parameters.

        Returns:
            The cost, scaled to all rays.
        """
        stride = max(1, len(bundle) // about)
        data = sensor.data(bundle.select(slice(None, None, stride)))
        return cls(data, stride / sensor.dispersion, prior, options)

    def of(self, vertices: FloatArray, blur: float) -> float:
        """Compute it for an outline.

        Args:
            vertices: (V, 2) in m.
            blur: Half-width (m) of silhouettes.

        Returns:
            Nats.
        """
        return float(self.scale * outline_likelihood(vertices, self.data, blur, NO_GRADIENT, NO_INFORMATION))

    def expand(self, template: Template, q: FloatArray, blur: float) -> Expansion:
        """Compute it for a template, with its derivatives; shares are uniform a priori: their log odds are not.

        Args:
            template: The template.
            q: (K,) its parameters.
            blur: Half-width (m) of silhouettes.

        Returns:
            The expansion.
        """
        vertices, jacobian = template.vertices(q), template.jacobian(q)
        gradient, information = np.zeros(vertices.size), np.zeros((vertices.size, vertices.size))
        cost = self.scale * outline_likelihood(vertices, self.data, blur, gradient, information)
        slope = self.scale * (gradient @ jacobian)
        curvature = self.scale * (jacobian.T @ information @ jacobian)
        rigid, shares = template.rigid, _shares(q[template.rigid :])
        density = shares * (1 - shares)
        slope[rigid:] += 2 * shares - 1
        diagonal = np.concatenate((np.ones(rigid), 2 * density))  # 1 m and 1 rad, as for kinds
        return Expansion(template, q, cost - float(np.log(density).sum()), slope, curvature + np.diag(diagonal))

    def log_evidence(self, there: Expansion, cost: float) -> float:
        """Approximate the log evidence by Laplace's method.

        Args:
            there: The mode, with the curvature there.
            cost: The cost there (nats).

        Returns:
            Nats; the prior among templates is in it.
        """
        logarithm = linear_algebra.log_determinant(there.curvature)
        if logarithm is None:
            return -math.inf
        volume = 0.5 * (len(there.q) * math.log(2 * math.pi) - logarithm)
        return -cost + volume + there.template.log_prior(there.q, self.prior) - math.log(len(TEMPLATES))

    def descend(self, template: Template, q: FloatArray, descent: Descent, least: float) -> Expansion:
        """Minimise it by Levenberg and Marquardt's method.

        Args:
            template: The template.
            q: (K,) the parameters that it begins with.
            descent: Blurs, one after the other, and where to end.
            least: Lower bound (m) of blurs.

        Returns:
            The last point, at the last blur.
        """
        for blur in dict.fromkeys(max(blur, least) for blur in descent.blurs):
            here = self._descend_at(self.expand(template, q, blur), descent, blur)
            q = here.q
        return here

    def _descend_at(self, start: Expansion, descent: Descent, blur: float) -> Expansion:
        options, here, damping = self.options, start, self.options.first_damping
        for _ in range(descent.steps):
            damped = here.curvature + damping * np.diag(np.diag(here.curvature))
            step = linear_algebra.solve(damped, here.gradient)
            if step is None:
                break
            there = self.expand(here.template, self.bounded(here.template, here.q - step), blur)
            if there.cost < here.cost:
                gain, here = here.cost - there.cost, there
                damping = max(damping * options.damping_after_success, options.min_damping)
                if gain < descent.tolerance:
                    break
            else:
                damping *= options.damping_after_failure
                if damping > options.max_damping:
                    break
        return here

    def bounded(self, template: Template, q: FloatArray) -> FloatArray:
        """Keep sizes and log odds within their bounds.

        Args:
            template: The template.
            q: (K,) its parameters.

        Returns:
            (K,) those nearest to them that are allowed.
        """
        rigid, odds = template.rigid, self.options.max_log_odds
        sizes = np.clip(q[POSE:rigid], self.options.min_size, self.prior.bounds[1])
        return np.concatenate((q[:POSE], sizes, np.clip(q[rigid:], -odds, odds)))


def fit_templates(
    primitives: Sequence[Primitive],
    log_evidence: float,
    bundle: RayBundle,
    sensor: BeamModel,
    prior: EvidenceOptions = DEFAULTS.evidence,
    options: TemplateOptions = DEFAULTS.templates,
) -> list[TemplateFit]:
    """Fit templates to rays, as far as starts in the frames of the fitted kinds promise something.

    Args:
        primitives: The fitted kinds, likeliest first.
        log_evidence: That of the likeliest kind (nats).
        bundle: The rays.
        sensor: The sensor.
        prior: The prior of sizes.
        options: Numeric parameters.

    Returns:
        One fit for each template that is not out of the question.
    """
    least = max(sensor.footprint, options.least_blur)
    few, some, every = (Cost.of_rays(bundle, about, sensor, prior, options) for about in options.rays)
    outline = primitives[0].outline()
    first = _first_stage(primitives, outline, few, least)
    cost = every.of(outline, least)
    base = some.of(outline, max(options.coarse.blurs[-1], least))
    promising = []
    for point in first:
        there = some.descend(point.template, point.q, options.coarse, least)
        sharp = some.expand(there.template, there.q, max(least, options.information_blur))
        promising.append((some.log_evidence(sharp, cost + there.cost - base), there))
    chosen: dict[str, Expansion] = {}
    for predicted, point in sorted(promising, key=lambda item: -item[0]):
        if predicted > log_evidence - options.margin and len(chosen) < options.fitted:
            chosen.setdefault(point.template.name, point)
    return [
        _evaluated(every.descend(point.template, point.q, options.fine, least), every, least)
        for point in chosen.values()
    ]


def _first_stage(primitives: Sequence[Primitive], outline: FloatArray, cost: Cost, least: float) -> list[Expansion]:
    """Descend some steps from the starts that are not much worse than the kind, and return the best."""
    options = cost.options
    blur = max(options.first.blurs[-1], least)
    base = cost.of(outline, blur)
    starts = [(template, cost.bounded(template, q)) for template, q in starts_of(primitives)]
    tried = [(cost.of(template.vertices(q), blur) - base, template, q) for template, q in starts]
    points = [
        cost.descend(template, q, options.first, least) for worse, template, q in tried if worse < options.screen
    ]
    points = [point for point in points if point.cost < base + options.first_screen]
    return sorted(points, key=lambda point: point.cost)[: options.kept]


def _evaluated(point: Expansion, cost: Cost, least: float) -> TemplateFit:
    """Return a fit with its evidence and uncertainty."""
    template, q = point.template, point.q
    there = cost.expand(template, q, max(least, cost.options.information_blur))
    covariance = linear_algebra.inverse(there.curvature)
    vertices, jacobian = template.vertices(q), template.jacobian(q)
    std = math.inf if covariance is None else std_across(vertices, jacobian @ covariance @ jacobian.T)
    return TemplateFit(template.name, vertices, cost.log_evidence(there, point.cost), std)


def starts_of(primitives: Sequence[Primitive]) -> list[tuple[Template, FloatArray]]:
    """Return templates with the parameters (K,) that fits begin with.

    Args:
        primitives: The fitted kinds, likeliest first; of those with equally many corners the first is used.

    Returns:
        The starts.
    """
    frames: dict[int, Primitive] = {}
    for primitive in primitives:
        frames.setdefault(primitive.kind.corners, primitive)
    return [
        (template, _start(template, frames[start.corners], start, turn))
        for template in TEMPLATES
        for start in template.starts
        if start.corners in frames
        for turn in start.turns
    ]


def _start(template: Template, primitive: Primitive, start: Start, turn: float) -> FloatArray:
    """Return the parameters (K,) of a start in a primitive's frame, turned from it."""
    middle, spread = _form_of_kind(primitive.kind, start.boxed)
    own_middle, own_spread = _form_of_start(template, start)
    size, turned = np.array(primitive.width_height), _turned(turn)
    along = np.diag(turned @ (spread * size * size[:, None]) @ turned.T)
    sizes = np.sqrt(along / np.diag(own_spread))
    if template.tied:
        sizes = np.full(2, math.sqrt(sizes[0] * sizes[1]))
    offset = middle * size - (own_middle * sizes) @ turned
    theta = primitive.theta or 0.0
    place = offset @ _turned(theta) + [primitive.x, primitive.y]
    shares = np.array(start.shares)
    return np.array([*place, theta + turn, *sizes[: template.rigid - POSE], *np.log(shares / (1 - shares))])


@lru_cache(maxsize=16)
def _form_of_kind(kind: Kind, boxed: bool) -> tuple[FloatArray, FloatArray]:
    return _form(kind.vertices, boxed)


@lru_cache(maxsize=256)
def _form_of_start(template: Template, start: Start) -> tuple[FloatArray, FloatArray]:
    return _form(template.outline(*start.shares), start.boxed)


def _form(vertices: FloatArray, boxed: bool) -> tuple[FloatArray, FloatArray]:
    """Return the middle (2,) and the spread (2, 2) of a closed outline: those of its area, or of its bounding box."""
    if boxed:
        return np.ptp(vertices, axis=0) / 2 + vertices.min(axis=0), np.diag(np.ptp(vertices, axis=0) ** 2)
    after = np.roll(vertices, -1, axis=0)
    twice = vertices[:, 0] * after[:, 1] - after[:, 0] * vertices[:, 1]
    both = vertices + after
    middle = (twice @ both) / (3 * twice.sum())
    second = np.einsum("v,vi,vj->ij", twice, both, both) + np.einsum("v,vi,vj->ij", twice, vertices, vertices)
    second += np.einsum("v,vi,vj->ij", twice, after, after)
    return middle, second / (12 * twice.sum()) - np.outer(middle, middle)
