"""Refinement: from a guess to the primitive that makes the log's own rays most likely, with its uncertainty.

For every candidate (what the networks found, and things in the map that they missed):

1. the rays that pass it are gathered, and what stands behind it is read from the map and from the other candidates
   (detect.refinement.rays);
2. every kind is fitted, from several starts (turned, mirrored), coarsely to few rays and then to all of them
   (detect.refinement.fit);
3. kinds are weighed by their evidence, the likelihood averaged over all parameters: a square that explains the rays
   as well as a rectangle does is the likelier one, since it has one size less to choose; the same samples give the
   mean and the covariance of the parameters (detect.refinement.evidence).

Candidates see each other's shadows: all are fitted once, those that are found twice go, and what is left is fitted
again beside the others. The noise is found from the rays on the way. What the rays contradict is no detection.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from detect.detection import Detection, Detections, Rejection
from detect.refinement.candidates import Candidate, fit_all, look_behind, share_of
from detect.refinement.evidence import weighed
from detect.refinement.kernels import MISS, STOP
from detect.refinement.map_cells import MapCells
from detect.refinement.proposals import MOST_PROPOSALS, proposals
from detect.refinement.rays import (
    Backdrop,
    Beams,
    Obstacles,
    Sensor,
    backdrop,
    explained,
    gather,
    parameters,
)
from detect.refinement.sensor_model import CLEARLY, distance_to, first_noise, measured, measured_noise
from mapping.grid import OccupancyGrid
from prim.arrays import FloatArray
from prim.scan import Scan
from prim.se2 import Pose2D
from prim.shapes import Kind, Primitive

PREFERRED = 1.5
"""What the networks found stays where it explains the rays at least 1 / this as well as what they did not find."""

REACH, REACH_FITTED = 0.07, 0.03
"""Rays that come within this (m) of a candidate are looked at: at first, and once it is fitted."""

ROUNDS, SETTLED = 2, 0.002
"""So often all candidates are fitted beside each other, once they are told apart; no more where none moves by more
than this (m, rad).
"""

LEAST_GAIN = 25.0
"""A primitive makes the rays more likely than an empty place does by at least so much (nats)."""

MOST_MISFIT = 0.25
"""Of the rays that meet a primitive, the map explains each better by no more than this (nats) on average."""

MOST_SPREAD = 0.25
"""And its sizes are known to within this share of them (one standard deviation)."""

LEAST_SEEN = 0.35
"""What the networks did not find, or hardly, must be seen in this share of the directions around it."""

LEAST_SURE = 0.33
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


@dataclass(frozen=True)
class Pace:
    """How thoroughly detections are refined; on the way, where a look follows on another, it may be done faster.

    ``before``: what an earlier look at a growing map came to, with the noise (m) that it found. What was sure of its
    kind then is fitted on from there, which takes a fraction of the time, and what was missed is not looked for.
    Without it, that is done in the ``most_proposals`` largest things of the map. ``rounds``: so often all are fitted
    beside each other, once they are told apart.
    """

    before: tuple[Detections, float | None] | None = None
    most_proposals: int = MOST_PROPOSALS
    rounds: int = ROUNDS


THOROUGH = Pace()


def refine_detections(
    detections: Detections,
    scans: Iterable[tuple[Scan, Pose2D]],
    grid: OccupancyGrid,
    noise_std: float | None = None,
    threads: int = 2,
    pace: Pace = THOROUGH,
) -> tuple[Detections, float | None]:
    """Detections in ``grid`` refined by the scans that it was made of, and what was missed in it beside them.

    ``noise_std`` (m) is the range noise, where it is known. Returns what the rays support, likeliest first, what they
    do not with the reasons, and the noise: None where no ray passes any.
    """
    cells = MapCells.of(grid)
    before, guess_std = pace.before or (None, None)
    unsure = _gone(before, detections) if before else [one for one, _ in detections.doubtful]
    unsure = [one for one in unsure if not cells.hide(one.primitive)]
    guesses = [one.primitive for one in (*detections.found, *unsure)]
    added = [_proposed(one) for one in proposals(cells, guesses, pace.most_proposals)] if before is None else []
    wanted = (*detections.found, *unsure, *added)
    known = _known_before(wanted, before)
    starts = [known.get(number, one).primitive for number, one in enumerate(wanted)]
    refined, found_std = refine(
        starts, scans, cells, noise_std, threads, known, len(detections.found), pace.rounds, guess_std
    )
    kept: list[Detection] = []
    rejected = []
    for number, (guess, made) in enumerate(zip(wanted, refined, strict=True)):
        reason = contradiction(made) if number < len(detections.found) else doubt(made, guess.primitive, cells)
        if made is None or reason:
            rejected.append(_rejected(guess, made, reason))
        else:
            kept.append(_detection(made, guess.crop))
    asked = {id(one) for one in unsure}
    judged = {id(rejection) for one, rejection in detections.doubtful if id(one) in asked}
    rejected += [one for one in detections.rejected if id(one) not in judged]
    kept.sort(key=lambda one: -one.score)
    rejected.sort(key=lambda one: -one.score)
    return Detections(tuple(kept), tuple(rejected)), found_std if kept else None


def _gone(before: Detections, detections: Detections) -> list[Detection]:
    """What an earlier look had found, and the networks do not see now."""
    now = [one.primitive for one in detections.found]
    return [one for one in before.found if all(share_of(one.primitive, other) <= LEAST_SHARED for other in now)]


def _known_before(wanted: Sequence[Detection], before: Detections | None) -> dict[int, Detection]:
    """Which of what is ``wanted`` was seen before, and was sure of its kind."""
    sure = [one for one in (before.found if before else ()) if one.score >= SURE]
    known = {}
    for number, one in enumerate(wanted):
        same = [other for other in sure if share_of(one.primitive, other.primitive) > LEAST_SHARED]
        if same:
            known[number] = max(same, key=lambda other: share_of(one.primitive, other.primitive))
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
    if share_of(made.primitive, guess) < LEAST_SHARED:
        return f"{before}what explains its rays stands elsewhere"
    if made.score < LEAST_SURE:
        return f"{before}its kind is sure by {made.score:.2f} only, less than {LEAST_SURE:g}"
    return ""


def _rejected(guess: Detection, made: Refined | None, reason: str) -> Rejection:
    fitted = None if made is None else _detection(made, guess.crop)
    return Rejection(guess.primitive.kind, guess.score, guess.primitive.x, guess.primitive.y, reason, fitted)


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
    preferred: int = 0,
    rounds: int = ROUNDS,
    guess_std: float | None = None,
) -> tuple[list[Refined | None], float | None]:
    """Fits primitives to the rays of the scans that a map was made of.

    All are fitted beside each other in so many ``rounds``. Those that are ``known``, by their index, are refined
    already: their kind is not asked for again. Of two that stand in one place, the one stays that explains the rays
    better, the first ``preferred`` ones before others. The noise (m) is ``noise_std`` where it is known, else it is
    found from the rays, which begins with ``guess_std`` where that is given.
    Returns, in the order given, each one refined, or None for one that no ray passes, that another one stands for as
    well, or that is too large or reaches into a wall; and the noise (m), found from the rays where it is not given.
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
    sensor = Sensor.of(noise_std or min(guess_std or first_noise(seen), most), span, most=most)
    with ThreadPoolExecutor(threads) as pool:
        look_behind(pool, seen, cells, CLEARED_FIRST)
        fit_all(pool, seen, [True] * len(seen), sensor)
        alone = _once(seen, candidates[:preferred], sensor)
        for one in alone:
            one.look_at(one.beams.passing(one.now, REACH_FITTED))
        alone = [one for one in alone if len(one.beams)]
        if not alone:
            return [None] * len(primitives), noise_std
        sensor = Sensor.of(noise_std or measured_noise(alone, sensor), span, most=most)
        for _ in range(rounds):
            where = [parameters(one.now) for one in alone]
            changed = look_behind(pool, alone, cells, CLEARED)
            fit_all(pool, alone, changed, sensor)
            if all(np.abs(parameters(one.now) - at).max() < SETTLED for one, at in zip(alone, where, strict=True)):
                break
        sensor = measured(alone, sensor, noise_std)
        fit_all(pool, alone, [sensor.dispersion > CLEARLY] * len(alone), sensor)
        whole = Obstacles.of(cells.occupied, cells.frame)
        refined = list(pool.map(lambda one: finish(one, backdrop(one.beams, whole), sensor), alone))
    made = {id(one): result for one, result in zip(alone, refined, strict=True)}
    return [made.get(id(one)) for one in candidates], sensor.std


def _once(candidates: Sequence[Candidate], preferred: Sequence[Candidate], sensor: Sensor) -> list[Candidate]:
    """The candidates without those that stand where a likelier one does, or a preferred one not much less likely."""
    gains = {id(one): gain_of(one, candidates, sensor) for one in candidates}
    for one in preferred:
        if id(one) in gains:
            gains[id(one)] *= PREFERRED
    stay: list[Candidate] = []
    for one in sorted(candidates, key=lambda one: -gains[id(one)]):
        if all(share_of(one.now, other.now) <= SAME for other in stay):
            stay.append(one)
    return stay


def gain_of(candidate: Candidate, among: Sequence[Candidate], sensor: Sensor) -> float:
    """By how much (nats) the rays are likelier with the candidate than with nothing in its place."""
    beams = candidate.seen_before(among, sensor)
    return float(-beams.rays[MISS].sum() - candidate.fits[0].cost)


def finish(candidate: Candidate, map_alone: Backdrop, sensor: Sensor) -> Refined | None:
    """Weighs a candidate's kinds and gives the likeliest one's parameters, with their uncertainty."""
    assert candidate.fitted_to is not None
    beams = candidate.fitted_to[1]
    told = weighed(candidate.fits, beams, sensor, candidate.may_be)
    if told is None:
        return None
    gain = float(-beams.rays[MISS].sum() - told.cost)
    misfit, rays, seen = _held_against_map(told.primitive, beams, map_alone, sensor)
    chances = candidate.known.chances if candidate.known is not None else None
    return Refined(told.primitive, told.std, told.covariance, chances or told.chances, gain, misfit, rays, seen)


def _held_against_map(
    primitive: Primitive, beams: Beams, map_alone: Backdrop, sensor: Sensor
) -> tuple[float, int, float]:
    """Of the rays that meet a primitive: by how much (nats each) the map explains them better, how many they are, and
    in what share of the directions around it they meet it.
    """
    distance = distance_to(primitive, beams)
    meets = distance < beams.rays[STOP]
    if not meets.any():
        return 0.0, 0, 0.0
    met = beams.of(meets)
    own = np.log(explained(met, distance[meets], np.ones(len(met), np.bool_), 0.0, sensor))
    free = np.log(explained(met, map_alone.stops[meets], map_alone.ends[meets], map_alone.spread, sensor))
    x, y = met.rays[:2] + distance[meets] * met.rays[2:4] - [[primitive.x], [primitive.y]]
    sectors = np.floor(np.arctan2(y, x) / (2 * math.pi) * SECTORS).astype(int) % SECTORS
    return float((free - own).mean()), len(met), len(np.unique(sectors)) / SECTORS
