"""Refinement: from guesses to the primitives that make the log's own rays most likely, with their uncertainty.

For every candidate (detections of the networks, and components of the map that they missed):

1. the rays that pass it are collected (rays), and what stands behind it is read from the map (sensor_model, walls);
2. every kind is fitted by maximum likelihood from several starts (fit);
3. kinds are compared by their evidence, and the likeliest one's posterior gives the mean and the covariance of the
   parameters (evidence).

Candidates occlude each other: all are fitted once, duplicates are removed, and the rest is fitted again beside the
others. The sensor's noise, footprint and dispersion are estimated from the rays on the way (sensor_estimation). What
the rays contradict is rejected, with the reason.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from concurrent.futures import Executor, ThreadPoolExecutor
from dataclasses import dataclass, field, replace

import numpy as np

from detect.detection import (
    Detection,
    Detections,
    Progress,
    Rejection,
    SensorErrors,
    UnknownObject,
    no_progress,
)
from detect.refinement.bagging import PartialPosterior, partial_posteriors
from detect.refinement.candidates import Candidate, by_level, find_backgrounds, fit_candidates
from detect.refinement.fitting.evidence import compare_kinds
from detect.refinement.likelihood.geometry import parameters_of, ranges_to
from detect.refinement.likelihood.kernels import BACKGROUND, OCCLUSION
from detect.refinement.likelihood.rays import RayBundle, collect_rays
from detect.refinement.likelihood.scanner_errors import NO_ERRORS
from detect.refinement.likelihood.sensor_model import Background, BeamModel, DistanceMap, surface_likelihood
from detect.refinement.misfits import sensor_without_misfits
from detect.refinement.options import DEFAULTS, AcceptanceOptions, OtherOptions, RefinementOptions
from detect.refinement.other import (
    Alternative,
    expected_share,
    free_alternatives,
    larger_alternatives,
    other_log_odds,
    other_probability,
    simple_outline,
)
from detect.refinement.scanner_errors import correct_scanner_errors, settle_scanner_errors, with_shared_errors
from detect.refinement.sensor_estimation import estimate_dropouts, estimate_noise, estimate_sensor, initial_noise
from detect.refinement.surroundings.levels import MapLevel, MapLevels
from detect.refinement.surroundings.map_cells import MapCells
from detect.refinement.surroundings.proposals import propose
from detect.refinement.touching import Site, Trial, find_sites, separate_touching
from mapping.grid import OccupancyGrid
from prim.arrays import FloatArray
from prim.metrics import overlap_coefficient
from prim.scan import Scan
from prim.se2 import Pose2D
from prim.shapes import Kind, Primitive


@dataclass(frozen=True)
class RefinedPrimitive:
    """A primitive that was fitted to rays.

    Attributes:
        primitive: The likeliest kind at its posterior mean.
        std: Standard deviations (m, rad) by name: x, y, theta and the sizes.
        covariance: (K, K) in the same order.
        kind_probabilities: Posterior probabilities of the kinds.
        log_ratio: Log-likelihood ratio of the rays against nothing in its place (nats).
        misfit: By how much the map alone explains the rays that meet it better (nats a ray).
        rays: How many rays meet it.
        seen: Share of the directions around it in which they do.
        other_probability: Posterior probability that it is none of the kinds, whose own probabilities are those given
            that it is one.
        alternative: What it is likeliest instead; None where nothing else was found.
    """

    primitive: Primitive
    std: Mapping[str, float]
    covariance: FloatArray
    kind_probabilities: Mapping[Kind, float]
    log_ratio: float
    misfit: float
    rays: int
    seen: float
    other_probability: float = 0.0
    alternative: Alternative | None = None

    @property
    def score(self) -> float:
        """The posterior probability of its kind."""
        return (1 - self.other_probability) * self.kind_probabilities[self.primitive.kind]

    @property
    def is_other(self) -> bool:
        """Whether it is likelier none of the kinds than one of them."""
        return self.alternative is not None and self.alternative.replaces_kind and self.other_probability > 0.5

    @property
    def outline(self) -> FloatArray:
        """Vertices (N, 2) in m of what it is likeliest."""
        if self.is_other and self.alternative is not None:
            return simple_outline(self.alternative.vertices)
        return self.primitive.outline()

    def beside(self, alternatives: Sequence[Alternative], options: OtherOptions) -> RefinedPrimitive:
        """Hold the kinds against alternatives.

        Args:
            alternatives: What else it may be; none where nothing was found.
            options: The prior.

        Returns:
            The result with the posterior probability of «none of the kinds».
        """
        if not alternatives:
            return self
        likeliest = self.kind_probabilities[self.primitive.kind]
        probability = other_probability(alternatives, likeliest, options)
        best = max(alternatives, key=lambda one: one.log_odds)
        return replace(self, other_probability=probability, alternative=best)

    def averaged(self, parts: Sequence[PartialPosterior]) -> RefinedPrimitive:
        """Average the posterior with those by parts of the scans.

        Args:
            parts: The posteriors by these.

        Returns:
            The result with the mean probabilities; its shape stays.
        """
        posteriors = [PartialPosterior(self.kind_probabilities, self.other_probability), *parts]
        other = float(np.mean([one.other_probability for one in posteriors]))
        together = {
            kind: float(np.mean([(1 - one.other_probability) * one.kind_probabilities[kind] for one in posteriors]))
            for kind in self.kind_probabilities
        }
        given = {kind: share / (1 - other) if other < 1 else 0.0 for kind, share in together.items()}
        return replace(self, other_probability=other, kind_probabilities=given)


@dataclass(frozen=True)
class WarmStart:
    """What an earlier pass over a growing map came to: its detections and the noise (m)."""

    detections: Detections
    noise_std: float | None


@dataclass(frozen=True)
class Effort:
    """How thoroughly detections are refined.

    Attributes:
        warm_start: An earlier pass. Where the kind was settled then, its fit is the start, which takes a fraction of
            the time, and the map is not searched for what the networks missed.
        max_proposals: Components of the map that are proposed; None: as in the options.
        rounds: Joint fits once duplicates are gone; None: as in the options.
        since: Stamp (ns) from which on scans are used for components of the map; None for all. Detections have their
            own.
    """

    warm_start: WarmStart | None = None
    max_proposals: int | None = None
    rounds: int | None = None
    since: int | None = None


THOROUGH = Effort()


def refine_detections(
    detections: Detections,
    scans: Iterable[tuple[Scan, Pose2D]],
    grid: OccupancyGrid,
    noise_std: float | None = None,
    threads: int = 2,
    effort: Effort = THOROUGH,
    options: RefinementOptions = DEFAULTS,
    levels: MapLevels | None = None,
    progress: Progress = no_progress,
) -> tuple[Detections, float | None]:
    """Refine a map's detections, and find what the networks missed.

    Args:
        detections: Of the networks.
        scans: The scans that the map was made of, with the poses of their laser.
        grid: The map.
        noise_std: Range noise (m) where it is known.
        threads: How many are used; results do not depend on it.
        effort: How thoroughly.
        options: Numeric parameters.
        levels: The map at several sizes of its cells, where that is made already, with the same options.
        progress: Called with how many candidates are refined, and how many there are.

    Returns:
        What the rays support, likeliest kinds first, and what they do not, with the reasons; and the noise (m), None
        where nothing is supported.
    """
    levels = levels or MapLevels.of(grid, options)
    wanted, undecided = _candidates_of(detections, levels, effort)
    found = len(detections.found) + len(detections.rivals)
    warm_start = effort.warm_start
    known = _known_before(wanted, warm_start.detections, options.acceptance) if warm_start else {}
    starts = [known.get(number, detection).primitive for number, detection in enumerate(wanted)]
    refinement = Refinement(
        levels,
        noise_std,
        threads,
        guessed_noise=warm_start.noise_std if warm_start else None,
        rounds=effort.rounds,
        progress=progress,
    )
    refined = refinement.run(starts, scans, known, found, [detection.since for detection in wanted])
    kept: list[Detection] = []
    objects: list[UnknownObject] = []
    rejected = []
    results = [*enumerate(refined), *refinement.further]
    for number, result in results:
        guess = wanted[number]
        if number < found:
            reason = rejection_reason(result, options.acceptance)
        else:
            cells = levels.showing(guess.primitive).cells
            reason = proposal_rejection_reason(result, guess.primitive, cells, options.acceptance)
        if result is None or reason:
            rejected.append(_rejection(guess, result, reason))
        elif levels.is_room(result.outline):
            rejected.append(_rejection(guess, result, "most of what lies within it is free: it is a part of a room"))
        elif result.is_other:
            objects.append(object_of(result, guess.since))
        else:
            kept.append(detection_of(result, guess))
    tried = [*detections.rivals, *(pair for pair in detections.doubtful if id(pair[0]) in undecided)]
    judged = {id(rejection) for _, rejection in tried}
    rejected += [rejection for rejection in detections.rejected if id(rejection) not in judged]
    kept.sort(key=lambda detection: -detection.score)
    rejected.sort(key=lambda rejection: -rejection.score)
    objects.sort(key=lambda found: -found.score)
    noise = refinement.noise_std if kept or objects else None
    return Detections(tuple(kept), tuple(rejected), objects=tuple(objects), sensor=refinement.sensor), noise


def _candidates_of(detections: Detections, levels: MapLevels, effort: Effort) -> tuple[list[Detection], set[int]]:
    """Return what is to be refined, detections first, and the ids of proposals and detections of low score."""
    warm_start = effort.warm_start
    if warm_start:
        unsure = _missing(warm_start.detections, detections, levels.options.acceptance)
    else:
        unsure = [doubtful for doubtful, _ in detections.doubtful]
    unsure = [one for one in unsure if not levels.showing(one.primitive).cells.hides_centroid(one.primitive)]
    detected = [*detections.found, *(rival for rival, _ in detections.rivals)]
    known = [detection.primitive for detection in (*detected, *unsure)]
    proposed = [] if warm_start else propose(levels, known, effort.max_proposals)
    wanted = [*detected, *unsure, *(_without_score(primitive, effort.since) for primitive in proposed)]
    return wanted, {id(detection) for detection in unsure}


def _missing(before: Detections, now: Detections, limits: AcceptanceOptions) -> list[Detection]:
    """Return what an earlier pass had found, and the networks do not find now."""
    found = [detection.primitive for detection in now.found]
    return [
        detection
        for detection in before.found
        if all(overlap_coefficient(detection.primitive, other) <= limits.min_shared for other in found)
    ]


def _known_before(wanted: Sequence[Detection], before: Detections, limits: AcceptanceOptions) -> dict[int, Detection]:
    """Return, by the index of what is ``wanted``, the earlier detections whose kind is settled."""
    settled = [detection for detection in before.found if detection.score >= limits.settled_probability]
    known = {}
    for number, detection in enumerate(wanted):
        shared = [(overlap_coefficient(detection.primitive, other.primitive), other) for other in settled]
        same = [pair for pair in shared if pair[0] > limits.min_shared]
        if same:
            known[number] = max(same, key=lambda pair: pair[0])[1]
    return known


def _without_score(primitive: Primitive, since: int | None) -> Detection:
    """Return a component of the map as a detection: without score, box and crop."""
    return Detection(primitive, 0.0, (0.0, 0.0, 0.0, 0.0), np.zeros((0, 0), np.uint8), since=since)


def rejection_reason(result: RefinedPrimitive | None, limits: AcceptanceOptions = DEFAULTS.acceptance) -> str:
    """Say why the rays contradict a primitive.

    Args:
        result: What refinement made of it.
        limits: The thresholds.

    Returns:
        The reason; empty where they do not.
    """
    if result is None:
        return (
            "the rays speak against it, a likelier one stands in its place, its size is not wanted, "
            "or it reaches into a wall"
        )
    if result.log_ratio < limits.min_log_ratio:
        return (
            f"the rays are likelier with it by {result.log_ratio:.0f} nats only, less than {limits.min_log_ratio:g}"
        )
    if result.misfit > limits.max_misfit and not result.is_other:
        better = f"{result.misfit:.2f} nats each in the map alone, more than {limits.max_misfit:g}"
        return f"its rays are likelier by {better}"
    sizes = result.primitive.sizes
    if any(result.std[name] > limits.max_relative_std * size for name, size in sizes.items()):
        return f"its sizes are not known to within {limits.max_relative_std:.0%}"
    return ""


def proposal_rejection_reason(
    result: RefinedPrimitive | None,
    guess: Primitive,
    cells: MapCells,
    limits: AcceptanceOptions = DEFAULTS.acceptance,
) -> str:
    """Say why something that the networks did not detect, or with a low score, is no detection.

    Args:
        result: What refinement made of it.
        guess: What it was proposed as.
        cells: The map.
        limits: The thresholds.

    Returns:
        The reason; empty where it is one.
    """
    prefix = "not detected by the networks, or with a low score; "
    reason = rejection_reason(result, limits)
    if result is None or reason:
        return prefix + reason
    if result.seen < limits.min_seen:
        return f"{prefix}only {result.seen:.0%} of its outline is seen, less than {limits.min_seen:.0%}"
    if cells.is_behind_extended_wall(result.primitive):
        return f"{prefix}it reaches into a wall"
    if overlap_coefficient(result.primitive, guess) < limits.min_shared:
        return f"{prefix}what explains its rays stands elsewhere"
    probability = result.kind_probabilities[result.primitive.kind]
    if probability < limits.min_kind_probability:
        return f"{prefix}the probability of its kind is {probability:.2f}, less than {limits.min_kind_probability:g}"
    return ""


def _rejection(guess: Detection, result: RefinedPrimitive | None, reason: str) -> Rejection:
    fitted = None if result is None else detection_of(result, guess)
    return Rejection(guess.primitive.kind, guess.score, guess.primitive.x, guess.primitive.y, reason, fitted)


def detection_of(result: RefinedPrimitive, guess: Detection | None = None) -> Detection:
    """Return what was refined as a detection.

    Args:
        result: What was refined.
        guess: What it was refined from, where that was a detection: its crop and its ``since`` are kept.

    Returns:
        The detection.
    """
    outline = result.primitive.outline()
    (x0, y0), (x1, y1) = outline.min(axis=0).tolist(), outline.max(axis=0).tolist()
    return Detection(
        result.primitive,
        result.score,
        (x0, y0, x1, y1),
        np.zeros((0, 0), np.uint8) if guess is None else guess.crop,
        result.std,
        _share_of_kinds(result),
        result.covariance,
        None if guess is None else guess.since,
        result.other_probability,
    )


def _share_of_kinds(result: RefinedPrimitive) -> dict[Kind, float]:
    """Return the kinds' probabilities; with that of «none of the kinds» they sum to 1."""
    return {kind: (1 - result.other_probability) * share for kind, share in result.kind_probabilities.items()}


def object_of(result: RefinedPrimitive, since: int | None = None) -> UnknownObject:
    """Return what is likeliest none of the kinds.

    Args:
        result: What was refined.
        since: As Detection.since.

    Returns:
        The object, with the outline of the likeliest alternative.
    """
    assert result.alternative is not None
    std, reason = result.alternative.std, result.alternative.reason
    return UnknownObject(result.outline, std, result.other_probability, reason, _share_of_kinds(result), since)


SEARCHED, ESTIMATED, COMPARED = 0.3, 0.7, 0.85
"""Shares of the work that are done once candidates are fitted, the sensor is known, and kinds are compared, about."""


@dataclass
class _Done:
    """How many of some candidates are done, by the share of the work."""

    progress: Progress
    total: int

    def reach(self, share: float) -> None:
        """Tell that a share of the work is done."""
        self.progress(math.floor(share * self.total), self.total)


@dataclass
class Refinement:
    """Fits primitives to the rays of the scans that a map was made of.

    Attributes:
        levels: The map at several sizes of its cells, with the numeric parameters.
        noise_std: The range noise (m): known, or estimated by :meth:`run`.
        threads: How many are used.
        guessed_noise: A first guess (m) of the noise, where there is one.
        rounds: Joint fits once duplicates are gone; None: as in the options.
        progress: Called with how many candidates are refined, and how many there are.
        sensor: Errors of the scanner that :meth:`run` found and corrected; None where it found none.
        further: Of things that were separated by :meth:`run`, those beyond the guesses: with the index of the guess
            that they were a part of.
    """

    levels: MapLevels
    noise_std: float | None = None
    threads: int = 2
    guessed_noise: float | None = None
    rounds: int | None = None
    progress: Progress = no_progress
    sensor: SensorErrors | None = None
    further: list[tuple[int, RefinedPrimitive]] = field(default_factory=list)
    _separated: list[Trial] = field(default_factory=list)

    @property
    def options(self) -> RefinementOptions:
        """Numeric parameters, at a scale of 1."""
        return self.levels.options

    def run(
        self,
        primitives: Sequence[Primitive],
        scans: Iterable[tuple[Scan, Pose2D]],
        known: Mapping[int, Detection] | None = None,
        preferred: int = 0,
        since: Sequence[int | None] | None = None,
    ) -> list[RefinedPrimitive | None]:
        """Refine primitives beside each other.

        Args:
            primitives: The guesses.
            scans: The scans and the poses of their laser, in the map frame.
            known: By index, detections whose kind is not asked again.
            preferred: Of duplicates the first so many win against others whose log-likelihood ratio is not larger by
                ``options.acceptance.preference``.
            since: For each the stamp (ns) from which on scans are used; None for all.

        Returns:
            Each refined, in the order given; None for one that no ray passes, that is the duplicate of another, or
            whose size is not wanted, or that reaches into a wall.
        """
        if not primitives:
            return []
        shown = [self.levels.showing(primitive) for primitive in primitives]
        bounded = self.options.with_rays_for(len(primitives))
        sites = [] if self.options.closed_world else self._find_sites(primitives, shown)
        alone = [site for site in sites if site.covered_by is None]
        circles = [site.circle for site in alone]
        stamps = list(since or [None] * len(primitives))
        stamps += [stamps[site.members[0]] for site in alone]
        reaches = [level.options.rays.reach for level in shown]
        reaches += [reaches[site.members[0]] for site in alone]
        bundles, span, max_noise = collect_rays(scans, [*primitives, *circles], reaches, bounded, stamps)
        for site, bundle in zip(alone, bundles[len(primitives) :], strict=True):
            site.bundle = bundle
        detections = known or {}
        candidates = [
            Candidate(start, bundle, level.cells, detections.get(number), level.options)
            for number, (start, bundle, level) in enumerate(zip(primitives, bundles, shown, strict=False))
        ]
        _find_rivals(candidates[:preferred])
        for site in sites:
            site.take(candidates)
        seen = [candidate for candidate in candidates if len(candidate.bundle) and not candidate.holds_laser()]
        results: dict[int, RefinedPrimitive | None] = {}
        if seen:
            with ThreadPoolExecutor(self.threads) as pool:
                results = self._refine(pool, seen, candidates[:preferred], sites, span, max_noise)
        return self._in_order(candidates, results)

    def _find_sites(self, primitives: Sequence[Primitive], shown: Sequence[MapLevel]) -> list[Site]:
        """Find the components that guesses stand in, each in the cells that show it."""
        sites = []
        for level in self.levels:
            members = [number for number, one in enumerate(shown) if one is level]
            if members:
                sites += find_sites(level.cells, primitives, members, level.options)
        return sites

    def _in_order(
        self, candidates: Sequence[Candidate], results: Mapping[int, RefinedPrimitive | None]
    ) -> list[RefinedPrimitive | None]:
        """Return the guesses' results: of what was separated the part most like each; ``further`` has the rest."""
        numbers = {id(candidate): number for number, candidate in enumerate(candidates)}
        ordered = [results.get(id(candidate)) for candidate in candidates]
        self.further = []
        for trial in self._separated:
            left = list(trial.parts)
            for guess in trial.site.candidates[: len(left)]:
                best = max(left, key=lambda part: overlap_coefficient(part.current, guess.start))
                left.remove(best)
                ordered[numbers[id(guess)]] = results.get(id(best))
            first = numbers[id(trial.site.candidates[0])]
            self.further += [(first, result) for part in left if (result := results.get(id(part)))]
        return ordered

    def _refine(
        self,
        pool: Executor,
        seen: list[Candidate],
        preferred: list[Candidate],
        sites: Sequence[Site],
        span: float,
        max_noise: float,
    ) -> dict[int, RefinedPrimitive | None]:
        """Search, remove duplicates, fit jointly, estimate the sensor, and compare kinds; results by id."""
        options, known_noise = self.options, self.noise_std
        noise = known_noise or min(self.guessed_noise or initial_noise(seen, options.sensor), max_noise)
        find_backgrounds(pool, seen, is_first=True)
        dropouts = estimate_dropouts(seen, noise, options.sensor)
        sensor = BeamModel.create(noise, span, max_std=max_noise, options=options.sensor, dropout_share=dropouts)
        fit_candidates(pool, seen, [True] * len(seen), sensor)
        single = self._near_rays(without_duplicates(seen, preferred, sensor))
        if not single:
            return {}
        done = _Done(self.progress, len(single))
        done.reach(SEARCHED)
        noise = known_noise or estimate_noise(single, sensor)
        dropouts = estimate_dropouts(single, noise, options.sensor)
        sensor = BeamModel.create(noise, span, max_std=max_noise, options=options.sensor, dropout_share=dropouts)
        self._fit_jointly(pool, single, sensor)
        single = self._without_hopeless(pool, single, preferred, sensor)
        if not single:
            return {}
        single, sensor = self._find_sensor(pool, sites, single, sensor)
        done.reach(ESTIMATED)
        disperses = sensor.dispersion > options.sensor.significant_dispersion
        fit_candidates(pool, single, [disperses] * len(single), sensor)
        self.noise_std = sensor.std
        levels = [part[0].cells for part in by_level(single)]
        maps = {id(cells): DistanceMap.of(cells.occupied, cells.frame) for cells in levels}
        alone = [maps[id(candidate.cells)] for candidate in single]
        finished = pool.map(lambda one, at: finish(one, at.background(one.bundle), sensor), single, alone)
        results = {}
        for number, (candidate, result) in enumerate(zip(single, finished, strict=True), start=1):
            results[id(candidate)] = result
            done.reach(ESTIMATED + (COMPARED - ESTIMATED) * number / len(single))
        if not options.closed_world:
            results = self._beside_others(pool, single, results, sensor)
        done.reach(1.0)
        return results

    def _without_hopeless(
        self, pool: Executor, candidates: list[Candidate], preferred: list[Candidate], sensor: BeamModel
    ) -> list[Candidate]:
        """Remove what the rays speak against; what that hid is fitted again.

        They are judged after the joint fit: before it, what stands beside another thing may be far from its own.
        """
        hopeless, sure = self.options.acceptance.hopeless, {id(one) for one in preferred}
        ratios = [log_ratio_of(one, candidates, sensor) for one in candidates]
        left = [one for one, nats in zip(candidates, ratios, strict=True) if nats > hopeless or id(one) in sure]
        left = [one for one in left if not one.holds_laser()]
        if left and len(left) < len(candidates):
            fit_candidates(pool, left, find_backgrounds(pool, left), sensor)
        return left

    def _find_sensor(
        self, pool: Executor, sites: Sequence[Site], candidates: list[Candidate], sensor: BeamModel
    ) -> tuple[list[Candidate], BeamModel]:
        """Estimate the sensor by the candidates that a kind fits, once its errors are taken out of all rays.

        What fits no kind is separated then, where it is two things that do.
        """
        noise_std = self.noise_std
        sensor = correct_scanner_errors(pool, candidates, sensor, noise_std)
        is_corrected = candidates[0].errors != NO_ERRORS
        if not self.options.closed_world:
            sensor = sensor_without_misfits(pool, candidates, sensor, noise_std)
        sensor, self.sensor = settle_scanner_errors(pool, candidates, sensor, noise_std)
        if is_corrected and self.sensor is None and not self.options.closed_world:
            sensor = sensor_without_misfits(pool, candidates, sensor, noise_std)  # with all errors back
        if not self.options.closed_world:
            candidates, sensor = self._separate(pool, sites, candidates, sensor)
        return candidates, estimate_sensor(candidates, sensor, noise_std)

    def _separate(
        self, pool: Executor, sites: Sequence[Site], candidates: list[Candidate], sensor: BeamModel
    ) -> tuple[list[Candidate], BeamModel]:
        """Put two candidates where one fits no kind and two do; with them the sensor is estimated anew."""
        self._separated = separate_touching(pool, sites, candidates, sensor)
        if not self._separated:
            return candidates, sensor
        replaced = {id(candidate) for trial in self._separated for candidate in trial.before}
        parts = [part for trial in self._separated for part in trial.parts]
        present = [*(candidate for candidate in candidates if id(candidate) not in replaced), *parts]
        self._fit_jointly(pool, present, sensor)
        return present, sensor_without_misfits(pool, present, sensor, self.noise_std)

    def _beside_others(
        self,
        pool: Executor,
        candidates: list[Candidate],
        results: dict[int, RefinedPrimitive | None],
        sensor: BeamModel,
    ) -> dict[int, RefinedPrimitive | None]:
        """Hold results against «none of the kinds»: shapes of their own first, then parts of something larger."""
        limits, other = self.options.acceptance, self.options.other
        asked = [one for one in candidates if one.known is None and _may_be_something(results[id(one)], limits)]
        found = pool.map(lambda one: free_alternatives(one, one.fitted_rays, candidates, sensor), asked)
        shapes = {id(one): alternatives for one, alternatives in zip(asked, found, strict=True)}
        beside = _all_beside(results, shapes, other)
        kept = {key: _required(result).primitive for key, result in beside.items() if _is_kept(result, limits)}
        rest = [one for one in asked if id(one) in kept]

        def larger(one: Candidate) -> list[Alternative]:
            others = [primitive for key, primitive in kept.items() if key != id(one)]
            others += [part.current for part in self._parts_beside(one) if id(part) not in kept]
            std = _required(results[id(one)]).std
            return larger_alternatives(one, kept[id(one)], max(std["x"], std["y"]), others, sensor)

        parts = dict(zip(map(id, rest), pool.map(larger, rest), strict=True))
        alternatives = {key: [*found, *parts.get(key, ())] for key, found in shapes.items()}
        other = replace(other, prior=self._share_of_others(results, alternatives))
        beside = _all_beside(results, alternatives, other)
        if sensor.dispersion <= other.bagged_dispersion:
            return beside
        doubtful = [one for one in asked if _required(beside[id(one)]).other_probability < other.bagged_doubt]
        work = ((one, candidates, parts.get(id(one), ()), sensor, other) for one in doubtful)
        for one, posteriors in zip(doubtful, pool.map(lambda item: partial_posteriors(*item), work), strict=True):
            beside[id(one)] = _required(beside[id(one)]).averaged(posteriors)
        return beside

    def _share_of_others(
        self, results: Mapping[int, RefinedPrimitive | None], alternatives: Mapping[int, Sequence[Alternative]]
    ) -> float:
        """Estimate how many of the things that are reported, as a kind or as none, are none of the kinds."""
        limits, other = self.options.acceptance, self.options.other
        odds = []
        for key, result in _all_beside(results, alternatives, other).items():
            if result is not None and (result.is_other or _is_kept(result, limits)):
                replacing = [one for one in alternatives.get(key, ()) if one.replaces_kind]
                odds.append(other_log_odds(replacing, result.kind_probabilities[result.primitive.kind], other))
        return expected_share(odds, other)

    def _parts_beside(self, candidate: Candidate) -> list[Candidate]:
        """Return the other parts of what a candidate was separated from."""
        trials = [trial for trial in self._separated if candidate in trial.parts]
        return [part for trial in trials for part in trial.parts if part is not candidate]

    def _near_rays(self, candidates: list[Candidate]) -> list[Candidate]:
        """Leave out rays that pass far from the fits, and candidates without any."""
        for candidate in candidates:
            candidate.around = candidate.bundle
            candidate.keep_rays(candidate.bundle.passing(candidate.current, candidate.options.rays.fitted_reach))
        return [candidate for candidate in candidates if len(candidate.bundle)]

    def _fit_jointly(self, pool: Executor, candidates: list[Candidate], sensor: BeamModel) -> None:
        """Fit all in rounds, each beside what the others were in the round before, until none moves."""
        for _ in range(self.options.rounds if self.rounds is None else self.rounds):
            before = [parameters_of(candidate.current) for candidate in candidates]
            changed = find_backgrounds(pool, candidates)
            fit_candidates(pool, candidates, changed, sensor)
            now = [parameters_of(candidate.current) for candidate in candidates]
            moved = (np.abs(p - at).max() for p, at in zip(now, before, strict=True))
            if all(change < self.options.converged for change in moved):
                break


def _required(result: RefinedPrimitive | None) -> RefinedPrimitive:
    """Return a result that is known to be there."""
    assert result is not None
    return result


def _all_beside(
    results: Mapping[int, RefinedPrimitive | None],
    alternatives: Mapping[int, Sequence[Alternative]],
    options: OtherOptions,
) -> dict[int, RefinedPrimitive | None]:
    """Hold each result against its alternatives."""
    return {
        key: _required(result).beside(alternatives[key], options) if key in alternatives else result
        for key, result in results.items()
    }


def _may_be_something(result: RefinedPrimitive | None, limits: AcceptanceOptions) -> bool:
    """Tell whether nothing speaks against a result but that it does not fit the rays well: it may be of no kind."""
    return result is not None and not rejection_reason(replace(result, misfit=0.0), limits)


def _is_kept(result: RefinedPrimitive | None, limits: AcceptanceOptions) -> bool:
    """Tell whether a result is one of the kinds, and nothing speaks against it."""
    return result is not None and not result.is_other and not rejection_reason(result, limits)


def without_duplicates(
    candidates: Sequence[Candidate], preferred: Sequence[Candidate], sensor: BeamModel
) -> list[Candidate]:
    """Remove candidates in whose place one has a larger log-likelihood ratio, or several rivals together have one.

    Args:
        candidates: The fitted candidates.
        preferred: Those whose ratio is multiplied by ``options.acceptance.preference`` for the comparison.
        sensor: The sensor.

    Returns:
        The rest, largest ratio first.
    """
    ratios = {id(candidate): log_ratio_of(candidate, candidates, sensor) for candidate in candidates}
    for candidate in preferred:
        if id(candidate) in ratios:
            ratios[id(candidate)] *= candidate.options.acceptance.preference
    ordered = sorted(candidates, key=lambda candidate: -ratios[id(candidate)])
    stay: list[Candidate] = []
    for candidate in ordered:
        if _is_clear(candidate, stay):
            parts = _apart(other for other in ordered if any(other is rival for rival in candidate.rivals))
            if len(parts) < 2 or sum(ratios[id(part)] for part in parts) <= ratios[id(candidate)]:
                stay.append(candidate)
    return stay


def _find_rivals(candidates: Sequence[Candidate]) -> None:
    """Make those of the networks' candidates rivals that would stand in each other's place."""
    for number, candidate in enumerate(candidates):
        for other in candidates[:number]:
            if overlap_coefficient(candidate.start, other.start) > candidate.options.acceptance.max_shared:
                candidate.rivals.append(other)
                other.rivals.append(candidate)


def _apart(candidates: Iterable[Candidate]) -> list[Candidate]:
    """Return the first candidates that stand clear of those before them."""
    chosen: list[Candidate] = []
    for candidate in candidates:
        if _is_clear(candidate, chosen):
            chosen.append(candidate)
    return chosen


def _is_clear(candidate: Candidate, others: Sequence[Candidate]) -> bool:
    """Tell whether a candidate shares little of its area with any of some others."""
    limit = candidate.options.acceptance.max_shared
    return all(overlap_coefficient(candidate.current, other.current) <= limit for other in others)


def log_ratio_of(candidate: Candidate, others: Sequence[Candidate], sensor: BeamModel) -> float:
    """Compute the log-likelihood ratio of the rays with a candidate against nothing in its place.

    Args:
        candidate: The candidate.
        others: The candidates that may occlude it.
        sensor: The sensor.

    Returns:
        Nats.
    """
    bundle = candidate.rays_with_background(others, sensor)
    return float(-bundle.rays[BACKGROUND].sum() - candidate.fits[0].cost)


def finish(candidate: Candidate, map_alone: Background, sensor: BeamModel) -> RefinedPrimitive | None:
    """Compare a candidate's kinds and hold the likeliest one against the map alone.

    Args:
        candidate: The fitted candidate.
        map_alone: What its rays meet in the map with the candidate's own cells.
        sensor: The sensor.

    Returns:
        The result; None where no kind is possible there.
    """
    bundle = candidate.fitted_rays
    evidence = candidate.options.evidence
    posterior = compare_kinds(candidate.fits, bundle, sensor, candidate.is_possible, evidence)
    if posterior is None:
        return None
    posterior = with_shared_errors(posterior, candidate.shared_errors)
    map_alone = map_alone.nearer_by(candidate.errors.range_bias)
    ratio = float(-bundle.rays[BACKGROUND].sum() - posterior.cost)
    sectors = candidate.options.acceptance.sectors
    misfit, rays, seen = _compare_with_map(posterior.primitive, bundle, map_alone, sensor, sectors)
    kind_probabilities = candidate.known.kind_probabilities if candidate.known is not None else None
    return RefinedPrimitive(
        posterior.primitive,
        posterior.std,
        posterior.covariance,
        kind_probabilities or posterior.kind_probabilities,
        ratio,
        misfit,
        rays,
        seen,
    )


def _compare_with_map(
    primitive: Primitive, bundle: RayBundle, map_alone: Background, sensor: BeamModel, sectors: int
) -> tuple[float, int, float]:
    """Return the misfit (nats a ray), the number of rays that meet a primitive, and the share of directions seen."""
    ranges = ranges_to(primitive, bundle.rays)
    meets = ranges < bundle.rays[OCCLUSION]
    if not meets.any():
        return 0.0, 0, 0.0
    met, cells = bundle.select(meets), map_alone.select(meets)
    own = np.log(surface_likelihood(met, ranges[meets], np.ones(len(met), np.bool_), np.zeros(len(met)), sensor))
    free = np.log(surface_likelihood(met, cells.ranges, cells.hits_map, cells.uncertainty, sensor))
    x, y = met.rays[:2] + ranges[meets] * met.rays[2:4] - [[primitive.x], [primitive.y]]
    sector = np.floor(np.arctan2(y, x) / (2 * math.pi) * sectors).astype(int) % sectors
    return float((free - own).mean()), len(met), len(np.unique(sector)) / sectors
