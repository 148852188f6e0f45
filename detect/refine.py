"""Refinement: from a guess to the primitive that makes the log's own rays most likely, with its uncertainty.

For every candidate (what the networks found, and things in the map that they missed):

1. the rays that pass it are gathered, and what stands behind it is read from the map and from the other candidates
   (detect.beams);
2. every kind is fitted, from several starts (turned, mirrored), coarsely to few rays and then to all of them
   (detect.fit);
3. kinds are weighed by their evidence, the likelihood averaged over all parameters: a square that explains the rays
   as well as a rectangle does is the likelier one, since it has one size less to choose; the same samples give the
   mean and the covariance of the parameters (detect.evidence).

Candidates see each other's shadows: all are fitted once, those that are found twice go, and what is left is fitted
again beside the others. The noise is found from the rays on the way. What the rays contradict is no detection.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from concurrent.futures import Executor, ThreadPoolExecutor
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from detect.beams import (
    FAMILY,
    Backdrop,
    Beams,
    Sensor,
    backdrop,
    behind,
    explained,
    gather,
    in_table,
    parameters,
)
from detect.cells import MapCells, circumradius
from detect.detector import Detection, Detections, Rejection
from detect.evidence import exact_costs, laplace, weighed
from detect.fit import TIES, Fit, again, primitive_of, search
from detect.proposals import proposals
from detect.raycost import MEASURED, MISS, RANGE, STOP, not_below, trace
from detect.walls import Wall, walls_behind
from mapping.grid import OccupancyGrid
from prim.frames import Pose2D, Scan
from prim.metrics import polygon_areas
from prim.raycast import FloatArray
from prim.shapes import Kind, Primitive

WITHIN = 2.5
"""Others further away than this (m) are not reckoned with: few rays pass both, and say the same of all shapes."""

MOST_DOUBTFUL = 24
"""Of what the networks were unsure of, no more than this is asked the rays about: the best."""

REACH, REACH_FITTED = 0.07, 0.03
"""Rays that come within this (m) of a candidate are looked at: at first, and once it is fitted."""

OUT_OF_QUESTION = 60.0
"""A kind whose evidence is this much (nats) less than the likeliest one's is not fitted again."""

ROUNDS = 2
"""So often all candidates are fitted beside each other, once they are told apart."""

LEAST_NOISE = 0.002
"""Noise (m) below this is not told apart: poses and ranges as logs hold them are no better."""

LEAST_GAIN = 25.0
"""A primitive makes the rays more likely than an empty place does by at least so much (nats)."""

MOST_MISFIT = 0.25
"""Of the rays that meet a primitive, the map explains each better by no more than this (nats) on average."""

MOST_SPREAD = 0.2
"""And its sizes are known to within this share of them (one standard deviation)."""

LEAST_SEEN = 0.35
"""What the networks did not find, or hardly, must be seen in this share of the directions around it."""

LEAST_SURE = 0.5
"""And its kind must be at least as sure as this."""

SURE = 0.95
"""What was as sure as this of its kind at an earlier look is not asked for it again at the next."""

LEAST_SHARED = 0.25
"""And it shares this much of the smaller area with what it was first taken for."""

SECTORS = 24
"""Directions around a primitive's centroid, in which its outline is seen or not."""

SAME = 0.25
"""Two candidates that share more than this (of the smaller one's area) are one."""

CLEARED_FIRST, CLEARED = 0.03, 0.02
"""So far (m) around a candidate the map's cells are its own, not what stands behind: at first, and once fitted."""

MOVED, MOVED_SHARE = 0.05, 0.1
"""What stands behind has changed where more than such a share of rays ends elsewhere (m): all is fitted anew."""

FEW = 20
"""Fewer rays than this do not tell the noise, and fewer scans no dispersion."""

FEW_OF_SCAN = 4
"""Fewer rays of one scan than this do not tell how far it is off as a whole."""

CLEAR_ERROR = 4.0
"""A ray that is off by more standard deviations than this met something else."""

FOOTPRINTS = (0.0, 0.0005, 0.001, 0.002, 0.004, 0.008, 0.016)
"""Footprints (m) that are tried; the first two are taken for none."""

START_NOISE = 0.03
"""The noise (m) where nothing tells it."""


@dataclass(frozen=True)
class Refined:
    """A primitive that rays were fitted to.

    ``std`` (m, rad) by name: x, y, theta and the sizes; ``covariance`` in the same order; ``chances`` of the kinds;
    ``gain``: by how much (nats) the rays are likelier than without it; ``misfit``: by how much (nats a ray) the map
    explains those that meet it better; ``rays``: how many do; ``seen``: the share of its outline that they meet.
    """

    primitive: Primitive
    std: Mapping[str, float]
    covariance: FloatArray
    chances: Mapping[Kind, float]
    gain: float
    misfit: float
    rays: int
    seen: float

    @property
    def score(self) -> float:
        """The chance that the kind is right."""
        return self.chances[self.primitive.kind]


@dataclass
class Candidate:
    """One thing that is fitted: where it was first seen, the rays around it, and what is known of it by now."""

    start: Primitive
    beams: Beams
    cells: MapCells
    known: Detection | None = None
    map_behind: Backdrop | None = None
    walls: list[Wall] = field(default_factory=list)
    fits: list[Fit] = field(default_factory=list)
    fitted_to: tuple[Sensor, Beams] | None = None

    def look_at(self, chosen: NDArray[np.bool_]) -> None:
        """Leaves out all other beams."""
        self.beams = self.beams.of(chosen)
        self.map_behind = self.map_behind and self.map_behind.of(chosen)
        self.fitted_to = self.fitted_to and (self.fitted_to[0], self.fitted_to[1].of(chosen))

    @property
    def known_fit(self) -> Fit:
        """The best fit of the kind that it is known to be, or where that begins."""
        if self.fits:
            return self.fits[0]
        kind = self.start.kind
        return Fit(kind, parameters(self.start), 0.0, np.eye(TIES[kind].shape[1]))

    def may_be(self, primitive: Primitive) -> bool:
        """Whether a primitive keeps off the walls behind it."""
        return not self.cells.is_pierced_by(primitive) and not any(wall.is_cut_by(primitive) for wall in self.walls)

    @property
    def now(self) -> Primitive:
        """The best that is known of it."""
        return primitive_of(self.fits[0].kind, self.fits[0].p) if self.fits else self.start


def refine_detections(
    detections: Detections,
    scans: Iterable[tuple[Scan, Pose2D]],
    grid: OccupancyGrid,
    noise_std: float | None = None,
    threads: int = 2,
    before: Detections | None = None,
) -> tuple[Detections, float | None]:
    """Detections in ``grid`` refined by the scans that it was made of, and what was missed in it beside them.

    ``noise_std`` (m) is the range noise, where it is known; ``before``, what an earlier look at a growing map came
    to: what was sure of its kind then is fitted on from there, which takes a fraction of the time. Returns what the
    rays support, likeliest first, what they do not with the reasons, and the noise: None where no ray passes any.
    """
    cells = MapCells.of(grid)
    unsure = [] if before else [one for one, _ in detections.doubtful if not cells.hide(one.primitive)]
    unsure = sorted(unsure, key=lambda one: -one.score)[:MOST_DOUBTFUL]
    guesses = [one.primitive for one in (*detections.found, *unsure)]
    added = [_proposed(one) for one in proposals(cells, guesses)] if before is None else []
    wanted = (*detections.found, *unsure, *added)
    known = _known_before(wanted, before)
    starts = [known.get(number, one).primitive for number, one in enumerate(wanted)]
    refined, found_std = refine(starts, scans, cells, noise_std, threads, known)
    kept: list[Detection] = []
    rejected = []
    for number, (guess, made) in enumerate(zip(wanted, refined, strict=True)):
        reason = contradiction(made) if number < len(detections.found) else doubt(made, guess.primitive, cells)
        if made is None or reason:
            rejected.append(_rejected(guess, reason))
        else:
            kept.append(_detection(made, guess.crop))
    asked = {id(one) for one in unsure}
    judged = {id(rejection) for one, rejection in detections.doubtful if id(one) in asked}
    rejected += [one for one in detections.rejected if id(one) not in judged]
    kept.sort(key=lambda one: -one.score)
    rejected.sort(key=lambda one: -one.score)
    return Detections(tuple(kept), tuple(rejected)), found_std


def _known_before(wanted: Sequence[Detection], before: Detections | None) -> dict[int, Detection]:
    """Which of what is ``wanted`` was seen before, and was sure of its kind."""
    sure = [one for one in (before.found if before else ()) if one.score >= SURE]
    known = {}
    for number, one in enumerate(wanted):
        same = [other for other in sure if _share(one.primitive, other.primitive) > LEAST_SHARED]
        if same:
            known[number] = max(same, key=lambda other: _share(one.primitive, other.primitive))
    return known


def _proposed(primitive: Primitive) -> Detection:
    """Something in the map that the networks did not see: without score, box and crop."""
    return Detection(primitive, 0.0, (0.0, 0.0, 0.0, 0.0), np.zeros((0, 0), np.uint8))


def contradiction(made: Refined | None) -> str:
    """Why the rays speak against a primitive; nothing where they do not."""
    if made is None:
        return "no ray passes it, a likelier one stands in its place, or it is too large or reaches into a wall"
    if made.gain < LEAST_GAIN:
        return f"the rays are likelier with it by {made.gain:.0f} nats only, less than {LEAST_GAIN:g}"
    if made.misfit > MOST_MISFIT:
        return f"its rays are likelier by {made.misfit:.2f} nats each in the map alone, more than {MOST_MISFIT:g}"
    if any(made.std[name] > MOST_SPREAD * size for name, size in made.primitive.sizes.items()):
        return f"its sizes are not known to within {MOST_SPREAD:.0%}"
    return ""


def doubt(made: Refined | None, guess: Primitive, cells: MapCells) -> str:
    """Why something that the networks did not find, or were not sure of, is no detection; nothing where it is."""
    before = "not found, or hardly, by the networks; "
    reason = contradiction(made)
    if made is None or reason:
        return before + reason
    if made.seen < LEAST_SEEN:
        return f"{before}only {made.seen:.0%} of its outline is seen, less than {LEAST_SEEN:.0%}"
    if cells.is_touched_by(made.primitive):
        return f"{before}it reaches into a wall"
    if _share(made.primitive, guess) < LEAST_SHARED:
        return f"{before}what explains its rays stands elsewhere"
    if made.score < LEAST_SURE:
        return f"{before}its kind is sure by {made.score:.2f} only, less than {LEAST_SURE:g}"
    return ""


def _rejected(guess: Detection, reason: str) -> Rejection:
    return Rejection(guess.primitive.kind, guess.score, guess.primitive.x, guess.primitive.y, reason)


def _detection(made: Refined, crop: NDArray[np.uint8]) -> Detection:
    outline = made.primitive.outline()
    (x0, y0), (x1, y1) = outline.min(axis=0).tolist(), outline.max(axis=0).tolist()
    return Detection(made.primitive, made.score, (x0, y0, x1, y1), crop, made.std, made.chances)


def refine(
    primitives: Sequence[Primitive],
    scans: Iterable[tuple[Scan, Pose2D]],
    cells: MapCells,
    noise_std: float | None = None,
    threads: int = 2,
    known: Mapping[int, Detection] | None = None,
) -> tuple[list[Refined | None], float | None]:
    """Fits primitives to the rays of the scans that a map was made of.

    Those that are ``known``, by their index, are refined already: their kind is not asked for again. Returns, in the
    order given, each one refined, or None for one that no ray passes or that another one stands for as well; and the
    noise (m), found from the rays where it is not given.
    """
    if not primitives:
        return [], noise_std
    around, span, most = gather(scans, primitives, REACH)
    known = known or {}
    candidates = [
        Candidate(start, beams, cells, known.get(number))
        for number, (start, beams) in enumerate(zip(primitives, around, strict=True))
    ]
    seen = [one for one in candidates if len(one.beams)]
    if not seen:
        return [None] * len(primitives), noise_std
    sensor = Sensor.of(noise_std or min(first_noise(seen), most), span, most=most)
    with ThreadPoolExecutor(threads) as pool:
        look_behind(seen, cells, CLEARED_FIRST)
        fit_all(pool, seen, [True] * len(seen), sensor)
        alone = _once(seen, sensor)
        for one in alone:
            one.look_at(one.beams.passing(one.now, REACH_FITTED))
        alone = [one for one in alone if len(one.beams)]
        if not alone:
            return [None] * len(primitives), noise_std
        sensor = Sensor.of(noise_std or measured_noise(alone, sensor), span, most=most)
        for _ in range(ROUNDS):
            changed = look_behind(alone, cells, CLEARED)
            fit_all(pool, alone, changed, sensor)
        sensor = measured(alone, sensor, noise_std)
        fit_all(pool, alone, [False] * len(alone), sensor)
        whole = [backdrop(one.beams, cells.occupied, cells.frame) for one in alone]
        refined = list(pool.map(lambda one, map_alone: finish(one, map_alone, sensor), alone, whole))
    made = {id(one): result for one, result in zip(alone, refined, strict=True)}
    return [made.get(id(one)) for one in candidates], sensor.std


def fit_all(pool: Executor, candidates: Sequence[Candidate], anew: Sequence[bool], sensor: Sensor) -> None:
    """Fits all candidates beside what was known of the others before: ``anew``, or from where they are.

    Where hardly anything has changed behind and before a candidate, it stays as it is.
    """
    beams = [before_others(one, candidates, sensor) for one in candidates]
    list(pool.map(lambda one, own, new: _fit_one(one, own, sensor, new), candidates, beams, anew))


def _fit_one(candidate: Candidate, beams: Beams, sensor: Sensor, anew: bool) -> None:
    """Leaves a candidate's kinds, likeliest first, as far as a Gaussian tells their evidence."""
    before = candidate.fitted_to
    if candidate.known is not None:
        fits = again([candidate.known_fit], beams, sensor)
    elif anew or before is None:
        fits = search(candidate.now, beams, sensor)
    elif before[0] is sensor and before[1].much_alike(beams):
        return
    else:
        fits = again(candidate.fits, beams, sensor)
    possible = [fit for fit in fits if candidate.may_be(primitive_of(fit.kind, fit.p))]
    ordered = sorted(possible or fits, key=lambda fit: -laplace(fit))
    candidate.fits = [fit for fit in ordered if laplace(fit) > laplace(ordered[0]) - OUT_OF_QUESTION]
    candidate.fitted_to = sensor, beams


def look_behind(candidates: Sequence[Candidate], cells: MapCells, margin: float) -> list[bool]:
    """Reads from the map what stands behind each candidate: the map without their own cells.

    Whose cells are a candidate's is better known the second time; returns for which that changed much.
    """
    shapes = [one.now for one in candidates]
    occupied = cells.without(shapes, margin)
    walls = walls_behind(cells, shapes, [one.beams.rays[:, :2].mean(axis=0) for one in candidates])
    for wall in walls:
        occupied[wall.cells] = False
    changed = []
    for one in candidates:
        before = one.map_behind
        one.map_behind = backdrop(one.beams, occupied, cells.frame)
        one.walls = [wall for wall in walls if _apart(wall.stretch, one.start) < WITHIN]
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
    distance = _distance(primitive, beams)
    hit = (distance < beams.far) & (beams.kinds == MEASURED)
    return np.asarray(beams.rays[hit, RANGE] - distance[hit])


def measured(candidates: Sequence[Candidate], sensor: Sensor, noise_std: float | None) -> Sensor:
    """What the candidates' rays tell of the sensor: its noise where it is not given, footprint and dispersion."""
    std = noise_std or measured_noise(candidates, sensor)
    sensor = Sensor.of(std, sensor.span, sensor.footprint, most=sensor.most)
    footprint = measured_footprint(candidates, sensor)
    return Sensor.of(std, sensor.span, footprint, measured_dispersion(candidates, sensor), sensor.most)


def measured_footprint(candidates: Sequence[Candidate], sensor: Sensor) -> float:
    """The footprint (m) that makes the rays most likely which pass candidates' edges."""
    totals = np.zeros(len(FOOTPRINTS))
    for one in candidates:
        beams, fit = before_others(one, candidates, sensor), one.fits[0]
        for k, footprint in enumerate(FOOTPRINTS):
            totals[k] += exact_costs(fit.kind, fit.p[None], beams, replace(sensor, footprint=footprint))[0]
    return float(FOOTPRINTS[best]) if (best := int(np.argmin(totals))) > 1 else 0.0


def measured_dispersion(candidates: Sequence[Candidate], sensor: Sensor) -> float:
    """By how much the squared mean errors of scans' rays exceed what independent rays would make them; 1 at least."""
    squares, scans = 0.0, 0
    for one in candidates:
        beams = before_others(one, candidates, sensor)
        distance = _distance(one.now, beams)
        error = (beams.rays[:, RANGE] - distance) / sensor.std
        clear = (distance < beams.rays[:, STOP]) & (beams.kinds == MEASURED) & (np.abs(error) < CLEAR_ERROR)
        error = _without_cut(error, np.minimum((beams.far - sensor.span - distance) / sensor.std, 0.0))
        count = np.bincount(beams.scan[clear])
        total = np.bincount(beams.scan[clear], error[clear])
        many = count >= FEW_OF_SCAN
        squares += float((total[many] ** 2 / count[many]).sum())
        scans += int(np.count_nonzero(many))
    return max(squares / scans, 1.0) if scans >= FEW else 1.0


def _without_cut(error: FloatArray, cut: FloatArray) -> FloatArray:
    """Errors (in standard deviations) of a normal distribution that ends at ``cut``, with mean 0 and variance 1."""
    tail = np.exp(-(cut**2) / 2) / math.sqrt(2 * math.pi) / not_below(cut)
    return np.asarray((error - tail) / np.sqrt(1 + cut * tail - tail**2))


def _distance(primitive: Primitive, beams: Beams) -> FloatArray:
    """Where (m) beams meet a primitive; FAR where they do not."""
    distance = np.empty(len(beams))
    trace(FAMILY[primitive.kind], parameters(primitive), beams.rays, distance)
    return distance


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

    return min(max(math.exp(_least(cost, math.log(sensor.std))), LEAST_NOISE), sensor.most)


def _met(candidate: Candidate, beams: Beams) -> tuple[FloatArray, NDArray[np.int8], FloatArray]:
    """Where (m) beams meet a candidate, what they measured (kind), and the range or its limit (m)."""
    distance = _distance(candidate.now, beams)
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


def before_others(candidate: Candidate, among: Sequence[Candidate], sensor: Sensor) -> Beams:
    """A candidate's beams, with what they say where they miss it."""
    others = [one.now for one in among if one is not candidate and _apart(one.start, candidate.start) < WITHIN]
    assert candidate.map_behind is not None
    return behind(
        candidate.beams, candidate.map_behind, [*others, *(wall.stretch for wall in candidate.walls)], sensor
    )


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


def _apart(a: Primitive, b: Primitive) -> float:
    """How far (m) two primitives' middles are from each other."""
    return math.hypot(a.x - b.x, a.y - b.y)


def _share(a: Primitive, b: Primitive) -> float:
    """How much two primitives share, of the smaller one's area."""
    if _apart(a, b) > circumradius(a) + circumradius(b):
        return 0.0
    first, second, shared = polygon_areas(a, b)
    return shared / min(first, second)


def finish(candidate: Candidate, map_alone: Backdrop, sensor: Sensor) -> Refined | None:
    """Weighs a candidate's kinds and gives the likeliest one's parameters, with their uncertainty."""
    assert candidate.fitted_to is not None
    beams = candidate.fitted_to[1]
    told = weighed(candidate.fits, beams, sensor)
    if told is None or not candidate.may_be(told.primitive):
        return None
    gain = float(-beams.rays[:, MISS].sum() - told.cost)
    misfit, rays, seen = _held_against_map(told.primitive, beams, map_alone, sensor)
    chances = candidate.known.chances if candidate.known is not None else None
    return Refined(told.primitive, told.std, told.covariance, chances or told.chances, gain, misfit, rays, seen)


def _held_against_map(
    primitive: Primitive, beams: Beams, map_alone: Backdrop, sensor: Sensor
) -> tuple[float, int, float]:
    """Of the rays that meet a primitive: by how much (nats each) the map explains them better, how many they are, and
    in what share of the directions around it they meet it.
    """
    distance = _distance(primitive, beams)
    meets = distance < beams.rays[:, STOP]
    if not meets.any():
        return 0.0, 0, 0.0
    met = beams.of(meets)
    own = np.log(explained(met, distance[meets], np.ones(len(met), np.bool_), 0.0, sensor))
    free = np.log(explained(met, map_alone.stops[meets], map_alone.ends[meets], map_alone.spread, sensor))
    points = met.rays[:, :2] + distance[meets, None] * met.rays[:, 2:4] - (primitive.x, primitive.y)
    sectors = np.floor(np.arctan2(points[:, 1], points[:, 0]) / (2 * math.pi) * SECTORS).astype(int)
    return float((free - own).mean()), len(met), len(np.unique(sectors)) / SECTORS
