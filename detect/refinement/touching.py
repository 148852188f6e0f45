"""Things that touch: where one shape leaves structured residuals, two are tried.

The networks often make one candidate of two things that touch. Its component of the map is cut where it is concave,
the parts are fitted beside each other, and they stay where the component's rays are likelier with them than with one
free polygon, and each of them fits a kind.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from concurrent.futures import Executor
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from detect.refinement.candidates import Candidate, by_level, fit_candidates, without_candidates
from detect.refinement.fitting.evidence import exact_costs, laplace_evidence
from detect.refinement.likelihood.geometry import ranges_to
from detect.refinement.likelihood.kernels import BACKGROUND, OCCLUSION
from detect.refinement.likelihood.rays import RayBundle
from detect.refinement.likelihood.sensor_model import BeamModel, DistanceMap
from detect.refinement.misfits import find_misfits
from detect.refinement.options import DEFAULTS, RefinementOptions, TouchingOptions
from detect.refinement.outlines.cuts import Partition, partitions
from detect.refinement.outlines.flush import is_one_piece
from detect.refinement.outlines.free_outline import OutlineCost, StarOutline, fit_free_outline
from detect.refinement.outlines.polygons import contour_of, fit_polygons
from detect.refinement.surroundings.map_cells import MapCells, is_within
from mapping.morphology import label
from prim.metrics import overlap_coefficient, polygon_iou
from prim.shapes import Kind, Primitive


@dataclass
class Site:
    """A connected component of a map's cells that are not free, no larger than two primitives.

    Attributes:
        cells: Rows and columns of its cells.
        circle: The circle around it.
        members: The indices of the guesses in it.
        covered_by: The index of a guess whose rays suffice; None where none's do.
        bundle: The rays that pass its circle.
        candidates: Those of its guesses.
    """

    cells: tuple[NDArray[np.intp], NDArray[np.intp]]
    circle: Primitive
    members: list[int]
    covered_by: int | None
    bundle: RayBundle | None = None
    candidates: list[Candidate] = field(default_factory=list)

    def take(self, candidates: Sequence[Candidate]) -> None:
        """Take its own of the candidates of all guesses, and one's rays where these suffice."""
        self.candidates = [candidates[number] for number in self.members]
        if self.covered_by is not None:
            self.bundle = candidates[self.covered_by].bundle


def find_sites(
    cells: MapCells,
    guesses: Sequence[Primitive],
    numbers: Sequence[int] | None = None,
    options: RefinementOptions = DEFAULTS,
) -> list[Site]:
    """Find the components that guesses stand in.

    Args:
        cells: The map.
        guesses: The guesses.
        numbers: Which of them; None: all.
        options: Numeric parameters.

    Returns:
        The components, but for those that are too large.
    """
    labels = label(~cells.free & ~cells.large)
    sizes = np.bincount(labels.ravel())
    largest = math.pi * (options.touching.max_radius / cells.frame.resolution + 1) ** 2
    members: dict[int, list[int]] = {}
    for number in range(len(guesses)) if numbers is None else numbers:
        guess = guesses[number]
        rows, cols, points = cells.around(guess, guess.bounding_radius)
        own = labels[rows, cols][is_within(guess, points, 0.0)]
        counts = np.bincount(own[own > 0])
        if len(counts) and sizes[counts.argmax()] <= largest:
            members.setdefault(int(counts.argmax()), []).append(number)
    wanted = np.zeros(len(sizes), np.bool_)
    wanted[list(members)] = True
    where = np.flatnonzero(wanted[labels])
    order = np.argsort(labels.flat[where], kind="stable")
    where = where[order]
    found = []
    for part in np.split(where, np.flatnonzero(np.diff(labels.flat[where])) + 1) if members else []:
        at = np.divmod(part, cells.frame.cols)
        circle = _circle_around(cells, *at)
        standing = members[int(labels.flat[part[0]])]
        if circle.bounding_radius <= options.touching.max_radius:
            sufficient = (number for number in standing if _covers(guesses[number], circle, options))
            found.append(Site(at, circle, standing, next(sufficient, None)))
    return found


def _covers(guess: Primitive, circle: Primitive, options: RefinementOptions) -> bool:
    """Tell whether the rays collected around a guess are all that pass a circle."""
    apart = math.hypot(guess.x - circle.x, guess.y - circle.y)
    needed = apart + circle.bounding_radius + options.touching.reach
    return needed <= guess.bounding_radius + options.rays.reach


def _circle_around(cells: MapCells, rows: NDArray[np.intp], cols: NDArray[np.intp]) -> Primitive:
    frame = cells.frame
    points = (np.column_stack((cols + frame.col, rows + frame.row)) + 0.5) * frame.resolution
    middle = (points.min(axis=0) + points.max(axis=0)) / 2
    radius = float(np.hypot(*(points - middle).T).max()) + frame.resolution
    return Primitive(Kind.CIRCLE, float(middle[0]), float(middle[1]), None, (radius,))


@dataclass
class Trial:
    """A site where two things are tried.

    Attributes:
        site: The site.
        before: The candidates that stand in it.
        whole: The site as a candidate, with all of its rays.
        alone: Log evidence (nats) of one thing there: the best of a free polygon, a free outline, and parts that are
            made as one thing.
        evidence: That of the parts.
        partitions: Its outline cut in two, in the order in which they are tried.
        tried: The parts of the partition that was fitted last.
        parts: The parts that explain the rays better than one thing; none where none do.
    """

    site: Site
    before: list[Candidate]
    whole: Candidate
    alone: float = -math.inf
    evidence: float = -math.inf
    partitions: list[Partition] = field(default_factory=list)
    tried: list[Candidate] = field(default_factory=list)
    parts: list[Candidate] = field(default_factory=list)


def separate_touching(
    pool: Executor,
    sites: Sequence[Site],
    candidates: Sequence[Candidate],
    sensor: BeamModel,
) -> list[Trial]:
    """Try two things where no kind fits, or where a part of a component is unexplained.

    Args:
        pool: The threads.
        sites: The components that guesses stand in.
        candidates: Those that are left, fitted; ``outline`` is set.
        sensor: The sensor.

    Returns:
        The trials that succeeded: ``parts`` take the place of ``before``.
    """
    if not sites:
        return []
    left = {id(candidate) for candidate in candidates}
    trials = []
    for site in sites:
        before = [candidate for candidate in site.candidates if id(candidate) in left]
        if before and _is_suspicious(site, before):
            trials.append(Trial(site, before, _whole(site, before)))
    if not trials:
        return []
    options = candidates[0].options
    taken = {id(one) for trial in trials for one in trial.before}
    beside = [candidate for candidate in candidates if id(candidate) not in taken]
    for part in by_level([trial.whole for trial in trials]):
        own = [trial for trial in trials if trial.whole.cells is part[0].cells]
        _set_backgrounds(pool, own, beside)
    list(pool.map(lambda trial: _cut(trial, beside, sensor), trials))
    for _ in range(options.touching.tries):
        sure = options.touching.sure_nats
        tried = [trial for trial in trials if trial.partitions and trial.evidence < trial.alone + sure]
        _fit_parts(pool, tried, beside, sensor)
        for trial in tried:
            _judge(pool, trial, beside, sensor)
    found = [trial for trial in trials if trial.parts]
    list(pool.map(lambda trial: _hold_against_outlines(trial, beside, sensor), found))
    return [trial for trial in found if trial.parts and trial.evidence > trial.alone]


def _is_suspicious(site: Site, before: Sequence[Candidate]) -> bool:
    """Tell whether candidates do not fit, or leave cells of their site unexplained."""
    if any(candidate.outline is not None for candidate in before):
        return True
    cells, options = before[0].cells, before[0].options.touching
    rows, cols = site.cells
    occupied = cells.occupied[rows, cols]
    frame = cells.frame
    points = (np.column_stack((cols + frame.col, rows + frame.row)) + 0.5)[occupied] * frame.resolution
    if not len(points):
        return False
    margin = options.around * frame.resolution
    explained = np.logical_or.reduce([is_within(candidate.current, points, margin) for candidate in before])
    return bool(explained.mean() < 1 - options.unexplained)


def _whole(site: Site, before: Sequence[Candidate]) -> Candidate:
    """Return a site as a candidate."""
    assert site.bundle is not None
    made = Candidate(site.circle, site.bundle, before[0].cells, options=before[0].options, errors=before[0].errors)
    made.walls = list({id(wall): wall for candidate in before for wall in candidate.walls}.values())
    return made


def _set_backgrounds(pool: Executor, trials: Sequence[Trial], beside: Sequence[Candidate]) -> None:
    """Read from one map what stands behind sites: nothing of their own cells."""
    cells = trials[0].whole.cells
    occupied = without_candidates(cells, beside).copy()
    for trial in trials:
        occupied[trial.site.cells] = False
        for wall in trial.whole.walls:
            occupied[wall.cells] = False
    distances = DistanceMap.of(occupied, cells.frame)
    backgrounds = pool.map(lambda trial: distances.background(trial.whole.bundle), trials)
    for trial, background in zip(trials, backgrounds, strict=True):
        trial.whole.background = background


def _cut(trial: Trial, beside: Sequence[Candidate], sensor: BeamModel) -> None:
    """Fit one free polygon to a site's rays, and cut it."""
    whole = trial.whole
    polygon, touching = whole.options.polygon, whole.options.touching
    contour = contour_of(whole.start, whole.cells, [one.current for one in beside], whole.walls, polygon)
    if contour is None:
        return
    bundle = whole.rays_with_background(beside, sensor)
    fit = fit_polygons([contour], bundle, sensor, polygon)
    trial.alone = fit.log_evidence + touching.min_nats
    fine = replace(polygon, simplification=touching.simplification)
    finer = contour_of(whole.start, whole.cells, [one.current for one in beside], whole.walls, fine)
    outlines = [fit.vertices, contour, *([] if finer is None else [finer])]
    made = [partition for outline in outlines for partition in partitions(outline, touching)]
    trial.partitions = _different(sorted(made, key=lambda partition: partition.mismatch), touching)


def _hold_against_outlines(trial: Trial, beside: Sequence[Candidate], sensor: BeamModel) -> None:
    """Hold parts against one free outline about each candidate that no kind fits."""
    whole = trial.whole
    options = whole.options.outline
    model = replace(sensor, footprint=options.footprint)
    bundle = whole.rays_with_background(beside, sensor)
    for candidate in trial.before:
        if candidate.outline is not None:
            cost = OutlineCost(StarOutline.of(candidate.current, options), bundle, sensor, options)
            factor = fit_free_outline(cost, model.footprint, options).log_bayes_factor
            evidence = log_evidence_of([candidate], whole, beside, model) + factor
            trial.alone = max(trial.alone, evidence + whole.options.touching.min_nats)


def _different(made: Sequence[Partition], options: TouchingOptions) -> list[Partition]:
    """Return the first partitions, leaving out those whose parts are all but those of an earlier one."""
    chosen: list[Partition] = []
    for partition in made:
        if len(chosen) == options.tries:
            break
        if not any(_are_alike(partition, earlier, options) for earlier in chosen):
            chosen.append(partition)
    return chosen


def _are_alike(a: Partition, b: Partition, options: TouchingOptions) -> bool:
    """Tell whether each part of one partition is like one of the other's."""
    return all(max(polygon_iou(one, other) for other in b.guesses) > options.alike for one in a.guesses)


def _fit_parts(pool: Executor, trials: Sequence[Trial], beside: Sequence[Candidate], sensor: BeamModel) -> None:
    """Fit the parts of each trial's next partition beside each other."""
    for trial in trials:
        guesses = trial.partitions.pop(0).guesses
        trial.tried = [_part(guess, trial.whole, trial.whole.options.rays.reach) for guess in guesses]
    parts = [part for trial in trials for part in trial.tried]
    rounds = parts[0].options.touching.rounds if parts else 0
    for left in reversed(range(rounds)):
        for part in parts if not left else []:
            part.keep_rays(part.bundle.passing(part.current, part.options.rays.fitted_reach))
        fit_candidates(pool, parts, [left > 0] * len(parts), sensor, beside)


def _part(guess: Primitive, whole: Candidate, reach: float) -> Candidate:
    """Return a part of a site as a candidate, with the site's rays that pass it."""
    part = Candidate(guess, whole.bundle, whole.cells, None, whole.options, whole.background, errors=whole.errors)
    part.walls = whole.walls
    part.keep_rays(whole.bundle.passing(guess, reach))
    return part


def _judge(pool: Executor, trial: Trial, beside: Sequence[Candidate], sensor: BeamModel) -> None:
    """Take the parts that were tried where they are likelier than one thing, and each fits a kind."""
    touching, parts = trial.whole.options.touching, trial.tried
    shapes = [part.current for part in parts]
    evidence = log_evidence_of(parts, trial.whole, beside, sensor)
    if is_one_piece(shapes, touching):
        trial.alone = max(trial.alone, evidence + touching.min_nats)
    elif evidence > max(trial.alone, trial.evidence) and _overlap(shapes) < touching.max_shared:
        find_misfits(pool, parts, sensor, beside)
        if all(_fits(part, [*parts, *beside], sensor) for part in parts):
            trial.evidence, trial.parts = evidence, parts


def _fits(part: Candidate, present: Sequence[Candidate], sensor: BeamModel) -> bool:
    """Tell whether a part fits a kind, and enough rays say so."""
    options = part.options
    bundle = part.rays_with_background(present, sensor)
    ratio = float(-bundle.rays[BACKGROUND].sum() - part.fits[0].cost)
    met = np.count_nonzero(ranges_to(part.current, bundle.rays) < bundle.rays[OCCLUSION])
    enough = ratio > options.acceptance.min_log_ratio and int(met) > options.touching.min_rays
    return part.outline is None and enough


def _overlap(shapes: Sequence[Primitive]) -> float:
    """Return the largest share of the smaller area that two of some primitives have in common."""
    return max(overlap_coefficient(a, b) for n, a in enumerate(shapes) for b in shapes[n + 1 :])


def log_evidence_of(
    parts: Sequence[Candidate], whole: Candidate, beside: Sequence[Candidate], sensor: BeamModel
) -> float:
    """Approximate the log evidence of a site's rays by Laplace's method.

    Args:
        parts: The fitted candidates that stand there.
        whole: The site with its rays.
        beside: The candidates elsewhere.
        sensor: The sensor.

    Returns:
        Nats, comparable with a polygon's.
    """
    first, evidence = parts[0].fits[0], whole.options.evidence
    bundle = whole.rays_with_background([*parts[1:], *beside], sensor)
    cost = float(exact_costs(first.kind, first.p[None], bundle, sensor)[0])
    fits = [part.fits[0] for part in parts]
    volumes = sum(laplace_evidence(fit, sensor.dispersion, evidence) + fit.cost / sensor.dispersion for fit in fits)
    return -cost / sensor.dispersion + volumes
