"""Refinement: from a guess to the primitive that makes the log's own rays most likely, with its uncertainty.

For every candidate (what the networks found, and things in the map that they missed):

1. the rays that pass it are gathered, and what stands behind it is read from the map and from the other candidates;
2. every kind is fitted, from several starts (turned, mirrored), coarsely to few rays and then to all of them;
3. kinds are weighed by their evidence, the likelihood averaged over all parameters (importance sampling): a square
   that explains the rays as well as a rectangle does is the likelier one, since it has one size less to choose;
4. the same samples give the mean and the covariance of the parameters.

Candidates see each other's shadows: all are fitted once, those that the rays contradict or that are found twice go,
and what is left is fitted again beside the others. The noise is found from the rays on the way.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from concurrent.futures import Executor, ThreadPoolExecutor
from dataclasses import dataclass, field
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from detect.beams import (
    FAMILY,
    Backdrop,
    Beams,
    MapCells,
    Sensor,
    backdrop,
    behind,
    circumradius,
    explained,
    gather,
    in_table,
    parameters,
)
from detect.raycost import MEASURED, MISS, PARAMETERS, RANGE, STOP, costs, descend, margins, slopes, trace
from mapping.grid import OccupancyGrid
from prim.frames import Pose2D, Scan
from prim.metrics import polygon_areas
from prim.raycast import FloatArray
from prim.shapes import SIZE_KEYS, Kind, Primitive

REACH = 0.07
"""Rays that come within this (m) of a candidate are looked at."""

COARSE_RAYS = 800
COARSE_BLURS = np.array([0.03, 0.012])
FINE_BLURS = np.array([0.008, 0.003, 0.001])
COARSE_STEPS, FINE_STEPS = 10, 12
TOLERANCE = 0.02
"""A fit ends where a step gains less than this (nats)."""

HOPELESS = 60.0
"""A kind whose coarse fit is this much (nats) less likely than the best one's is not fitted to all rays."""

WAYS = 2
"""So many of a kind's coarse fits are gone on with."""

ALIKE = 1.3
"""A triangle whose sides are no more unlike than this may have been fitted with the wrong apex."""

SIMPLER = {Kind.RECTANGLE: Kind.SQUARE, Kind.ELLIPSE: Kind.CIRCLE}
"""Kinds that are special cases of others, and fitted wherever these are."""

ROUNDS = 2
"""So often all candidates are fitted beside each other, once they are told apart."""

CONTENDER = 7.0
"""Kinds whose evidence is within this (nats) of the best one's are sampled."""

LONGEST = 0.7
"""Sizes are taken to be even up to this (m), before the rays are asked."""

SAMPLES = (300, 300, 600)
DEGREES = 6.0
"""So many samples are drawn in each round, from Student's t with so many degrees of freedom: its tails are heavy."""

EFFECTIVE = 0.15
"""In all rounds but the last, weights are made more alike until this share of the samples counts."""

LEAST_STD = (1e-4, 1e-4, 1e-3, 1e-4, 1e-4)
MOST_TURN = 0.5
"""Bounds on what samples are spread over (m, rad)."""

LEAST_NOISE = 0.002
"""Noise (m) below this is not told apart: poses and ranges as logs hold them are no better."""

LEAST_GAIN = 25.0
"""A primitive makes the rays more likely than an empty place does by at least so much (nats)."""

WORST_MISFIT = 0.35
"""Of the rays that meet a primitive, the map explains each better by no more than this (nats) on average."""

SAME = 0.25
"""Two candidates that share more than this (of the smaller one's area) are one."""

CLEARED_FIRST, CLEARED = 0.03, 0.02
"""So far (m) around a candidate the map's cells are its own and not what stands behind: first, and when it is fitted."""

MOVED, MOVED_SHARE = 0.05, 0.005
"""What stands behind has changed where more than such a share of rays ends elsewhere (m): all is fitted anew."""

FEW = 20
"""Fewer rays than this do not tell the noise."""

START_NOISE = 0.03
"""The noise (m) where nothing tells it."""


@dataclass(frozen=True)
class Fit:
    """A kind fitted to rays: the five parameters, the cost (nats), and the information on its own parameters."""

    kind: Kind
    p: FloatArray
    cost: float
    information: FloatArray


@dataclass(frozen=True)
class Refined:
    """A primitive that rays were fitted to.

    ``std`` (m, rad) by name: x, y, theta and the sizes; ``covariance`` in the same order; ``chances`` of the kinds;
    ``gain``: by how much (nats) the rays are likelier than without it; ``misfit``: by how much (nats a ray) the map
    explains those that meet it better; ``rays``: how many do.
    """

    primitive: Primitive
    std: Mapping[str, float]
    covariance: FloatArray
    chances: Mapping[Kind, float]
    gain: float
    misfit: float
    rays: int

    @property
    def score(self) -> float:
        """The chance that the kind is right."""
        return self.chances[self.primitive.kind]


@dataclass
class Candidate:
    """One thing that is fitted: where it was first seen, the rays around it, and what is known of it by now."""

    start: Primitive
    beams: Beams
    map_behind: Backdrop | None = None
    fits: list[Fit] = field(default_factory=list)

    @property
    def now(self) -> Primitive:
        """The best that is known of it."""
        return primitive_of(self.fits[0].kind, self.fits[0].p) if self.fits else self.start


def refine(
    primitives: Sequence[Primitive],
    scans: Iterable[tuple[Scan, Pose2D]],
    grid: OccupancyGrid,
    noise_std: float | None = None,
    threads: int = 2,
) -> tuple[list[Refined | None], float]:
    """Fits primitives (as the networks found them in ``grid``) to the rays of the scans that the grid was made of.

    Returns, in the order given, each one refined, or None for one that no ray passes or that another one stands for
    as well; and the noise (m), found from the rays where it is not given.
    """
    around, span = gather(scans, primitives, REACH)
    candidates = [Candidate(start, beams) for start, beams in zip(primitives, around, strict=True)]
    seen = [one for one in candidates if len(one.beams)]
    if not seen:
        return [None] * len(primitives), noise_std or START_NOISE
    sensor = Sensor.of(noise_std or first_noise(seen), span)
    with ThreadPoolExecutor(threads) as pool:
        cells = MapCells.of(grid)
        look_behind(seen, cells, CLEARED_FIRST)
        fit_all(pool, seen, [True] * len(seen), sensor)
        alone = _once(seen, sensor)
        if noise_std is None:
            sensor = Sensor.of(measured_noise(alone, sensor), span)
        for _ in range(ROUNDS):
            changed = look_behind(alone, cells, CLEARED)
            fit_all(pool, alone, changed, sensor)
        if noise_std is None:
            sensor = Sensor.of(measured_noise(alone, sensor), span)
        beams = [before_others(one, alone, sensor) for one in alone]
        whole = [backdrop(one.beams, grid.occupied, grid.frame) for one in alone]
        refined = list(pool.map(lambda *of: finish(*of, sensor), alone, beams, whole))
    made = {id(one): result for one, result in zip(alone, refined, strict=True)}
    return [made.get(id(one)) for one in candidates], sensor.std


def fit_all(pool: Executor, candidates: Sequence[Candidate], anew: Sequence[bool], sensor: Sensor) -> None:
    """Fits all candidates beside what was known of the others before: ``anew``, or from where they are."""
    beams = [before_others(one, candidates, sensor) for one in candidates]
    fits = pool.map(lambda one, own, new: (search if new else again)(one, own, sensor), candidates, beams, anew)
    for one, found in zip(candidates, list(fits), strict=True):
        one.fits = found


def look_behind(candidates: Sequence[Candidate], cells: MapCells, margin: float) -> list[bool]:
    """Reads from the map what stands behind each candidate: the map without their own cells.

    Whose cells are a candidate's is better known the second time; returns for which that changed much.
    """
    occupied = cells.without([one.now for one in candidates], margin)
    changed = []
    for one in candidates:
        before = one.map_behind
        one.map_behind = backdrop(one.beams, occupied, cells.frame)
        moved = before is None or np.mean(np.abs(before.stops - one.map_behind.stops) > MOVED) > MOVED_SHARE
        changed.append(bool(moved))
    return changed


def first_noise(candidates: Sequence[Candidate]) -> float:
    """A first guess (m) of the noise: how far ranges are from where the starts would stop them, robustly."""
    residuals = np.concatenate([_residuals(one.beams, one.start) for one in candidates])
    if len(residuals) < 10:
        return START_NOISE
    return max(1.4826 * float(np.median(np.abs(residuals))), LEAST_NOISE, 0.005)


def _residuals(beams: Beams, primitive: Primitive) -> FloatArray:
    """How far (m) measured ranges are from a primitive that their rays meet."""
    distance = np.empty(len(beams))
    trace(FAMILY[primitive.kind], parameters(primitive), beams.rays, distance)
    hit = (distance < beams.far) & (beams.kinds == MEASURED)
    return np.asarray(beams.rays[hit, RANGE] - distance[hit])


def measured_noise(candidates: Sequence[Candidate], sensor: Sensor) -> float:
    """The noise (m) that makes the rays which meet candidates most likely, those that were cut off among them."""
    met = [_met(one, before_others(one, candidates, sensor)) for one in candidates]
    distance, kinds, z = (np.concatenate(part) for part in zip(*met, strict=True))
    count = int(np.count_nonzero(kinds == MEASURED))
    if count < FEW:
        return sensor.std

    def cost(log_std: float) -> float:
        std = math.exp(log_std)
        table = Sensor.of(std, sensor.span).table
        return count * log_std - float(in_table(table, kinds, (distance - z) / std).sum())

    return max(math.exp(_least(cost, math.log(sensor.std))), LEAST_NOISE)


def _met(candidate: Candidate, beams: Beams) -> tuple[FloatArray, NDArray[np.int8], FloatArray]:
    """Where (m) beams meet a candidate, what they measured (kind), and the range or its limit (m)."""
    distance = np.empty(len(beams))
    trace(FAMILY[candidate.now.kind], parameters(candidate.now), beams.rays, distance)
    meets = (distance < beams.rays[:, STOP]) & (distance < beams.far)
    return distance[meets], beams.kinds[meets], beams.rays[meets, RANGE]


def _least(cost: Callable[[float], float], at: float, step: float = 0.5) -> float:
    """Where a function of one valley is least: stepped down to, then a parabola through three points, twice."""
    here = cost(at)
    for _ in range(12):
        left, right = cost(at - step), cost(at + step)
        if min(left, right) >= here:
            curve = left + right - 2 * here
            at += 0.5 * step * (left - right) / curve if curve > 0 else 0.0
            if step < 0.1:
                return at
            step, here = step / 6, cost(at)
        elif left < right:
            at, here = at - step, left
        else:
            at, here = at + step, right
    return at


def _ties() -> dict[Kind, FloatArray]:
    """For each kind the matrix (5, K) from its own parameters to x, y, theta, width, height."""
    full = np.eye(PARAMETERS)
    tied = full[:, :4].copy()
    tied[4, 3] = 1.0
    return {
        Kind.SQUARE: tied,
        Kind.RECTANGLE: full,
        Kind.CIRCLE: np.ascontiguousarray(tied[:, [0, 1, 3]]),
        Kind.TRIANGLE: full,
        Kind.ELLIPSE: full,
    }


TIES = _ties()
"""For each kind the matrix (5, K) that maps its own parameters to x, y, theta, width, height."""

NAMES = {kind: ("x", "y", *(() if kind is Kind.CIRCLE else ("theta",)), *SIZE_KEYS[kind]) for kind in Kind}
"""For each kind its own parameters' names, in the order of TIES' columns."""

HALF = (Kind.CIRCLE, Kind.ELLIPSE)
"""Kinds whose sizes are half lengths."""

PERIOD = {Kind.SQUARE: math.pi / 2, Kind.RECTANGLE: math.pi, Kind.TRIANGLE: 2 * math.pi, Kind.ELLIPSE: math.pi}


def log_prior(kind: Kind) -> float:
    """The logarithm of the density of a kind's parameters (but its place), before the rays are asked.

    All sizes up to LONGEST and all angles are alike. A rectangle is found in one of two ways to name its sides (and
    an ellipse its axes), each of them half of what it might be.
    """
    sizes = len(SIZE_KEYS[kind]) * math.log(2 / LONGEST if kind in HALF else 1 / LONGEST)
    angle = -math.log(PERIOD[kind]) if kind in PERIOD else 0.0
    return sizes + angle + (math.log(2) if kind in (Kind.RECTANGLE, Kind.ELLIPSE) else 0.0)


MOMENTS = {
    Kind.SQUARE: (12.0, 12.0),
    Kind.RECTANGLE: (12.0, 12.0),
    Kind.CIRCLE: (4.0, 4.0),
    Kind.TRIANGLE: (24.0, 18.0),
    Kind.ELLIPSE: (4.0, 4.0),
}
"""A size's square is so many times the variance of the area along it."""


def starts(of: Primitive, kind: Kind) -> list[FloatArray]:
    """Where the fit of a kind begins, for something that was first taken for ``of``: same place, same spread."""
    x, y, theta, *sizes = parameters(of).tolist()
    spread = [size / math.sqrt(factor) for size, factor in zip(sizes, MOMENTS[of.kind], strict=True)]
    if of.kind is kind is not Kind.TRIANGLE:
        turns = [0.0] if kind is Kind.CIRCLE else [0.0, math.pi / 4]
    elif kind is Kind.TRIANGLE:
        turns = [0.0, math.pi / 2, math.pi, -math.pi / 2]
        if of.kind is kind:
            turns += [2 * math.pi / 3, -2 * math.pi / 3]
    else:
        turns = [0.0] if kind is Kind.CIRCLE else [0.0, math.pi / 4]
    made = []
    mean = math.sqrt(spread[0] * spread[1])
    for turn in turns:
        along, across = spread
        if abs(math.sin(turn)) > 0.9:
            along, across = across, along
        elif abs(math.sin(turn)) > 0.1 or kind in (Kind.SQUARE, Kind.CIRCLE):
            along = across = mean
        a, b = (math.sqrt(factor) for factor in MOMENTS[kind])
        made.append(np.array([x, y, 0.0 if kind is Kind.CIRCLE else theta + turn, a * along, b * across]))
    return made


def search(candidate: Candidate, beams: Beams, sensor: Sensor) -> list[Fit]:
    """Every kind fitted to a candidate's beams from all its starts, likeliest first.

    Starts are fitted to some of the rays, and held against all of them, beside what the candidate was taken for; from
    the best of each kind the fit goes on with all rays.
    """
    now = candidate.now
    step = max(1, len(beams) // COARSE_RAYS)
    tried = {kind: [_coarse(kind, p, beams, sensor, step).p for p in starts(now, kind)] for kind in Kind}
    tried[now.kind].append(parameters(now))
    ranked = {kind: _ranked(kind, ways, beams, sensor) for kind, ways in tried.items()}
    limit = min(ways[0][0] for ways in ranked.values()) + HOPELESS
    hopeful = {kind for kind, ways in ranked.items() if ways[0][0] < limit}
    hopeful |= {simple for kind, simple in SIMPLER.items() if kind in hopeful}
    return _ordered(
        [
            _fine(kind, [p for cost, p in ranked[kind] if cost < ranked[kind][0][0] + HOPELESS][:WAYS], beams, sensor)
            for kind in Kind
            if kind in hopeful
        ]
    )


def _coarse(kind: Kind, p: FloatArray, beams: Beams, sensor: Sensor, step: int) -> Fit:
    """A fit to every ``step``-th beam."""
    return _fit(kind, p, beams, sensor, COARSE_BLURS, COARSE_STEPS, step)


def _ranked(kind: Kind, ways: Sequence[FloatArray], beams: Beams, sensor: Sensor) -> list[tuple[float, FloatArray]]:
    """Parameters of a kind with their costs (nats) over all beams, somewhat blurred, best first."""
    out = np.empty(len(ways))
    costs(FAMILY[kind], np.stack(ways), beams.rays, beams.kinds, sensor.std, sensor.table, float(FINE_BLURS[0]), out)
    return sorted(zip(out.tolist(), ways, strict=True), key=lambda one: one[0])


def again(candidate: Candidate, beams: Beams, sensor: Sensor) -> list[Fit]:
    """A candidate's kinds fitted again, from where they are."""
    return _ordered([_fine(fit.kind, [fit.p], beams, sensor) for fit in candidate.fits])


def _fine(kind: Kind, ways: Sequence[FloatArray], beams: Beams, sensor: Sensor) -> Fit:
    """The best fit to all beams from some ``ways``; a triangle's also with the other two corners as its apex."""
    best = min((_fit(kind, p, beams, sensor, FINE_BLURS, FINE_STEPS) for p in ways), key=lambda fit: fit.cost)
    if kind is not Kind.TRIANGLE:
        return best
    others = [_fit(kind, p, beams, sensor, FINE_BLURS, FINE_STEPS) for p in other_apexes(best.p)]
    return min([best, *others], key=lambda fit: fit.cost)


def other_apexes(p: FloatArray) -> list[FloatArray]:
    """The isosceles triangles most like a triangle that have its other corners as apexes; none where they are unlike.

    Where all sides are much alike, any corner may be taken for the apex.
    """
    x, y, theta, base, height = p.tolist()
    leg = math.hypot(base / 2, height)
    if not 1 / ALIKE < leg / base < ALIKE:
        return []
    mean = (leg + base) / 2  # of the two sides at the new apex; the new base is the leg across from it
    tall = math.sqrt(mean**2 - leg**2 / 4)
    turn = math.pi - math.atan2(height, base / 2)  # from the base to a leg, taken counter-clockwise
    return [np.array([x, y, theta + way, leg, tall]) for way in (turn, -turn)]


def before_others(candidate: Candidate, among: Sequence[Candidate], sensor: Sensor) -> Beams:
    """A candidate's beams, with what they say where they miss it."""
    others = [one.now for one in among if one is not candidate]
    assert candidate.map_behind is not None
    return behind(candidate.beams, candidate.map_behind, others, sensor)


def _ordered(fits: Sequence[Fit]) -> list[Fit]:
    """Fits by their evidence, as far as a Gaussian tells it, best first."""
    return sorted(fits, key=lambda fit: -laplace(fit))


def laplace(fit: Fit) -> float:
    """The logarithm of a fit's evidence, where its likelihood is a Gaussian's."""
    size = len(fit.information)
    sign, log_determinant = np.linalg.slogdet(fit.information + np.eye(size))
    volume = 0.5 * (size * math.log(2 * math.pi) - log_determinant)
    return -fit.cost + volume + log_prior(fit.kind)


def _fit(
    kind: Kind, p: FloatArray, beams: Beams, sensor: Sensor, blurs: FloatArray, steps: int, step: int = 1
) -> Fit:
    """The nearest best fit of a kind."""
    tie = TIES[kind]
    found, information = p.copy(), np.zeros((tie.shape[1], tie.shape[1]))
    cost = descend(
        FAMILY[kind],
        found,
        tie,
        beams.rays,
        beams.kinds,
        step,
        sensor.std,
        sensor.table,
        blurs,
        steps,
        TOLERANCE,
        information,
    )
    return Fit(kind, found, cost, information)


def _once(candidates: Sequence[Candidate], sensor: Sensor) -> list[Candidate]:
    """The candidates without those that stand where a likelier one does."""
    gains = {id(one): gain_of(one, candidates, sensor) for one in candidates}
    stay: list[Candidate] = []
    for one in sorted(candidates, key=lambda one: -gains[id(one)]):
        if all(_share(one.now, other.now) <= SAME for other in stay):
            stay.append(one)
    return stay


def gain_of(candidate: Candidate, among: Sequence[Candidate], sensor: Sensor) -> float:
    """By how much (nats) the rays are likelier with the candidate than with nothing in its place."""
    beams = before_others(candidate, among, sensor)
    return float(-beams.rays[:, MISS].sum() - candidate.fits[0].cost)


def _share(a: Primitive, b: Primitive) -> float:
    """How much two primitives share, of the smaller one's area."""
    if math.hypot(a.x - b.x, a.y - b.y) > circumradius(a) + circumradius(b):
        return 0.0
    first, second, shared = polygon_areas(a, b)
    return shared / min(first, second)


def finish(candidate: Candidate, beams: Beams, whole: Backdrop, sensor: Sensor) -> Refined:
    """Weighs a candidate's kinds and gives the likeliest one's parameters, with their uncertainty."""
    evidence = {fit.kind: laplace(fit) for fit in candidate.fits}
    top = max(evidence.values())
    sampled: dict[Kind, Sampled] = {}
    for fit in candidate.fits:
        if evidence[fit.kind] > top - CONTENDER:
            sampled[fit.kind] = sample(fit, beams, sensor)
            evidence[fit.kind] = sampled[fit.kind].evidence
    kind = max(sampled, key=lambda one: evidence[one])
    weights = {one: math.exp(value - evidence[kind]) for one, value in evidence.items()}
    chances = {one: weights.get(one, 0.0) / sum(weights.values()) for one in Kind}
    made = sampled[kind]
    primitive, std, covariance = told(kind, made)
    gain = float(-beams.rays[:, MISS].sum() - made.cost)
    misfit, rays = misfit_of(primitive, beams, whole, sensor)
    return Refined(primitive, std, covariance, chances, gain, misfit, rays)


def misfit_of(primitive: Primitive, beams: Beams, whole: Backdrop, sensor: Sensor) -> tuple[float, int]:
    """By how much (nats a ray) the map explains the rays that meet a primitive better; and how many they are."""
    distance = np.empty(len(beams))
    trace(FAMILY[primitive.kind], parameters(primitive), beams.rays, distance)
    meets = distance < beams.rays[:, STOP]
    if not meets.any():
        return 0.0, 0
    stops = np.where(meets, distance, 1.0)
    own = np.log(explained(beams, stops, meets, 0.0, sensor))
    free = np.log(explained(beams, whole.stops, whole.ends, whole.spread, sensor))
    return float((free - own)[meets].mean()), int(meets.sum())


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
    mean, spread = at, _bounded(np.linalg.inv(fit.information + np.eye(size)), fit.kind, floor)
    split = Split.of(fit, tie @ (16 * spread) @ tie.T, beams, sensor)
    rounds = _draws(size)
    for count, (standard, log_density) in enumerate(rounds, start=1):
        lower = np.linalg.cholesky(spread)
        points = mean + standard @ lower.T
        cost = split.costs(points @ tie.T)
        log_weight = -cost - log_density + np.log(np.diag(lower)).sum()
        weight = np.exp(log_weight - log_weight.max())
        share = _tempered(weight, EFFECTIVE if count < len(rounds) else 0.0)
        mean = share @ points
        centred = points - mean
        spread = _bounded((share[:, None] * centred).T @ centred, fit.kind, floor)
    evidence = float(log_weight.max() + np.log(weight.mean())) + log_prior(fit.kind)
    return Sampled(mean, spread, evidence, float(split.costs((tie @ mean)[None])[0]), float(1 / (share**2).sum()))


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
        margins(FAMILY[fit.kind], fit.p, covariance, beams.rays, sure)
        hit, missed = sure > 1, sure < -1
        gradient, information = np.zeros(PARAMETERS), np.zeros((PARAMETERS, PARAMETERS))
        constant = slopes(
            FAMILY[fit.kind],
            fit.p,
            beams.rays[hit],
            beams.kinds[hit],
            1,
            sensor.std,
            sensor.table,
            1e-9,
            gradient,
            information,
        )
        constant -= float(beams.rays[missed, MISS].sum())
        return cls(fit, constant, gradient, information, beams.of(~hit & ~missed), sensor)

    def costs(self, shapes: FloatArray) -> FloatArray:
        """The costs (nats) of shapes (M, 5); infinite where a size is none."""
        moved = shapes - self.fit.p
        parabola = self.constant + moved @ self.gradient + 0.5 * ((moved @ self.information) * moved).sum(axis=1)
        return parabola + exact_costs(self.fit.kind, shapes, self.unsure, self.sensor)


def _tempered(weight: FloatArray, least: float) -> FloatArray:
    """Weights, made more alike until this share of the samples counts."""
    power = 1.0
    share = weight / weight.sum()
    while 1 / (share**2).sum() < least * len(weight) and power > 1e-3:
        power *= 0.7
        share = weight**power / (weight**power).sum()
    return np.asarray(share)


def _bounded(covariance: FloatArray, kind: Kind, floor: FloatArray) -> FloatArray:
    """A covariance that samples can be drawn with: no narrower than ``floor``, no wider in angle than MOST_TURN."""
    bounded = covariance + np.diag(floor**2)
    if kind is not Kind.CIRCLE and bounded[2, 2] > MOST_TURN**2:
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
    longest = LONGEST / 2 if kind in HALF else LONGEST
    right = ((shapes[:, 3:] > 1e-3) & (shapes[:, 3:] < longest)).all(axis=1)
    safe = np.where(right[:, None], shapes, shapes[np.argmax(right)])
    costs(FAMILY[kind], np.ascontiguousarray(safe), beams.rays, beams.kinds, sensor.std, sensor.table, 0.0, out)
    return np.where(right, out, np.inf)


def primitive_of(kind: Kind, p: FloatArray) -> Primitive:
    """A primitive of five parameters, in canonical form."""
    x, y, theta, width, height = p.tolist()
    size = (width, height)[: len(SIZE_KEYS[kind])]
    return Primitive(kind, x, y, None if kind is Kind.CIRCLE else theta, size).canonical()


def told(kind: Kind, made: Sampled) -> tuple[Primitive, dict[str, float], FloatArray]:
    """The primitive that samples tell, its standard deviations by name, and its covariance in their order."""
    primitive = primitive_of(kind, TIES[kind] @ made.mean)
    names, covariance = NAMES[kind], made.covariance
    if kind in (Kind.RECTANGLE, Kind.ELLIPSE) and made.mean[3] < made.mean[4]:
        order = [0, 1, 2, 4, 3]
        covariance = covariance[np.ix_(order, order)]
    std = np.sqrt(np.diag(covariance)).tolist()
    return primitive, dict(zip(names, std, strict=True)), covariance
