"""Candidates: what is fitted, each with its rays and beside the others, which may occlude it."""

from __future__ import annotations

import math
from collections.abc import Sequence
from concurrent.futures import Executor
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from detect.detection import Detection
from detect.refinement.fitting.evidence import laplace_evidence, max_size
from detect.refinement.fitting.fit import SPECIAL_CASES, KindFit, fit_all_kinds, refit, refit_same_kind
from detect.refinement.likelihood.geometry import JACOBIANS, parameters_of, primitive_of, ranges_to
from detect.refinement.likelihood.rays import RayBundle
from detect.refinement.likelihood.scanner_errors import (
    NO_ERRORS,
    ScannerErrors,
    Surroundings,
    without_errors,
)
from detect.refinement.likelihood.sensor_model import (
    Background,
    BeamModel,
    DistanceMap,
    background_log_likelihood,
    with_background,
)
from detect.refinement.options import DEFAULTS, RefinementOptions
from detect.refinement.outlines.free_outline import ranges_of
from detect.refinement.surroundings.map_cells import MapCells
from detect.refinement.surroundings.walls import Wall, walls_behind
from detect.refinement.wall_surfaces import measure_walls, sharpen
from prim.arrays import FloatArray
from prim.shapes import Primitive


@dataclass
class Candidate:
    """One thing that is fitted.

    Attributes:
        start: The guess.
        bundle: The rays around it.
        cells: The map.
        known: A detection of an earlier pass whose kind is not asked again.
        options: The numbers of refinement.
        background: What stands behind it in the map.
        walls: Straight walls near it.
        fits: The fits, likeliest kind first.
        fitted_to: The sensor and the rays, with their background, of these fits.
        is_rough: Whether they were made to some of the rays only.
        errors: Errors of the scanner, which are taken out of its rays.
        shared_errors: (5, E) by how much its parameters change with one standard deviation of each error of the
            scanner; None for none.
        outline: Vertices (V, 2) in m of a free outline, where the rays say that no kind fits; else None.
        current: The primitive as far as it is known.
    """

    start: Primitive
    bundle: RayBundle
    cells: MapCells
    known: Detection | None = None
    options: RefinementOptions = DEFAULTS
    background: Background | None = None
    walls: list[Wall] = field(default_factory=list)
    fits: list[KindFit] = field(default_factory=list)
    fitted_to: tuple[BeamModel, RayBundle] | None = None
    is_rough: bool = False
    errors: ScannerErrors = NO_ERRORS
    shared_errors: FloatArray | None = None
    outline: FloatArray | None = None
    current: Primitive = field(init=False)
    _cached: tuple[Background, tuple[float, float], FloatArray] | None = None

    def __post_init__(self) -> None:
        self.current = self.start

    def rays_with_background(
        self,
        others: Sequence[Candidate],
        sensor: BeamModel,
        errors: ScannerErrors | None = None,
        shape: Primitive | None = None,
    ) -> RayBundle:
        """Return its rays with what they measure where they miss it: the map, walls and other candidates.

        Args:
            others: All candidates; those far away, and itself, are passed over.
            sensor: The sensor.
            errors: Errors of the scanner that are taken out; None: those that are known.
            shape: Where it is thought to be, which these depend on; None: where it was fitted last.

        Returns:
            Its rays, the rows OCCLUSION and BACKGROUND set.
        """
        background = self.background
        assert background is not None
        beams = sensor.std, sensor.dropout_share
        if self._cached is None or self._cached[0] is not background or self._cached[1] != beams:
            self._cached = background, beams, background_log_likelihood(self.bundle, background, sensor)
        reach = self.options.map.occluder_distance
        near = [other for other in others if other is not self and centroid_distance(other.start, self.start) < reach]
        shapes = [other.current for other in near if other.outline is None]
        walls = [wall.stretch for wall in self.walls]
        occlusion = [ranges_of(other.outline, self.bundle) for other in near if other.outline is not None]
        errors = self.errors if errors is None else errors
        if errors != NO_ERRORS:
            around = Surroundings(background, self._cached[2], shapes, walls, occlusion)
            return without_errors(self.bundle, around, shape or self.current, sensor, errors)
        return with_background(self.bundle, background, self._cached[2], [*shapes, *walls], sensor, occlusion)

    def keep_rays(self, chosen: NDArray[np.bool_]) -> None:
        """Leave out all rays but the chosen ones (N,)."""
        self.bundle = self.bundle.select(chosen)
        self.background = self.background and self.background.select(chosen)
        self.fitted_to = self.fitted_to and (self.fitted_to[0], self.fitted_to[1].select(chosen))

    @property
    def fitted_rays(self) -> RayBundle:
        """The rays, with their background, that it was fitted to last."""
        assert self.fitted_to is not None
        return self.fitted_to[1]

    def surface_ranges(self, bundle: RayBundle) -> FloatArray:
        """Return the ranges (N,) in m at which rays meet its free outline, else the primitive; FAR for a miss."""
        return ranges_to(self.current, bundle.rays) if self.outline is None else ranges_of(self.outline, bundle)

    @property
    def known_fit(self) -> KindFit:
        """The best fit of the kind that it is known to be, or a start of it."""
        if self.fits:
            return self.fits[0]
        kind = self.start.kind
        return KindFit(kind, parameters_of(self.start), 0.0, np.eye(JACOBIANS[kind].shape[1]))

    def is_possible(self, primitive: Primitive) -> bool:
        """Tell whether a primitive in its place keeps off walls and is no larger than the prior allows."""
        if max(parameters_of(primitive)[3:]) >= max_size(primitive.kind, self.options.evidence):
            return False
        own = (wall for wall in self.walls if wall.behind is self.start)
        depth = self.options.walls.depth
        return not self.cells.is_behind_wall(primitive) and not any(wall.is_cut_by(primitive, depth) for wall in own)

    def set_fits(self, fits: list[KindFit], bundle: RayBundle, sensor: BeamModel) -> None:
        """Take fits for what is known of it.

        Args:
            fits: The fits, the likeliest kind first.
            bundle: The rays that they were made to.
            sensor: The sensor that they were made with.
        """
        self.fits, self.fitted_to = fits, (sensor, bundle)
        self.current = primitive_of(fits[0].kind, fits[0].p)


def fit_candidates(
    pool: Executor,
    candidates: Sequence[Candidate],
    search: Sequence[bool],
    sensor: BeamModel,
    beside: Sequence[Candidate] = (),
) -> None:
    """Fit all candidates in parallel, each beside what was known of the others before.

    A candidate whose background and occlusion have hardly changed stays as it is.

    Args:
        pool: The threads.
        candidates: The candidates.
        search: For each whether all kinds are fitted from new starts, or from the fits that there are.
        sensor: The sensor.
        beside: Further candidates that may occlude these, and stay as they are.
    """
    present = [*candidates, *beside]
    bundles = [candidate.rays_with_background(present, sensor) for candidate in candidates]
    work = zip(candidates, bundles, search, strict=True)
    list(pool.map(lambda item: _fit_candidate(item[0], item[1], item[2], sensor), work))


def _fit_candidate(candidate: Candidate, bundle: RayBundle, search: bool, sensor: BeamModel) -> None:
    """Fit a candidate's kinds; those that are out of the question by Laplace's evidence go."""
    earlier, options = candidate.fitted_to, candidate.options
    searched = candidate.known is None and (search or earlier is None)
    unchanged = earlier is not None and _is_unchanged(earlier, sensor, bundle, options)
    if unchanged and not searched and not candidate.is_rough:
        return
    candidate.is_rough = searched
    if searched:
        fits = fit_all_kinds(candidate.current, candidate.fits, bundle, sensor, options.fit)
    elif candidate.known is not None:
        fits = refit_same_kind(candidate.known_fit, bundle, sensor, options.fit)
    else:
        fits = refit(candidate.fits, bundle, sensor, options.fit)
    possible = [fit for fit in fits if candidate.is_possible(primitive_of(fit.kind, fit.p))]
    rated = [(laplace_evidence(fit, options=options.evidence), fit) for fit in possible or fits]
    # the dispersion is left out here, and multiplies the limit: only the Occam factors differ from dividing by it
    rated.sort(key=lambda item: -item[0])
    limit = rated[0][0] - options.evidence.log_evidence_margin * sensor.dispersion
    likely = {fit.kind for evidence, fit in rated if evidence > limit}
    likely |= {SPECIAL_CASES[kind] for kind in likely if kind in SPECIAL_CASES}
    candidate.set_fits([fit for _, fit in rated if fit.kind in likely], bundle, sensor)


def _is_unchanged(
    earlier: tuple[BeamModel, RayBundle], sensor: BeamModel, bundle: RayBundle, options: RefinementOptions
) -> bool:
    """Tell whether fits to earlier rays hold for these."""
    before, fitted_to = earlier
    same_noise = abs(before.std - sensor.std) < options.sensor.same_noise * sensor.std
    same_noise &= abs(before.dropout_share - sensor.dropout_share) <= options.sensor.same_dropouts
    return same_noise and before.footprint == sensor.footprint and fitted_to.is_similar(bundle, options)


def find_backgrounds(
    pool: Executor,
    candidates: Sequence[Candidate],
    cells: MapCells,
    margin: float,
    options: RefinementOptions = DEFAULTS,
) -> list[bool]:
    """Read from the map what stands behind each candidate: the map without the candidates' own cells.

    Args:
        pool: The threads.
        candidates: The candidates; their background and walls are set.
        cells: The map.
        margin: Cells this near (m) to a candidate are its own.
        options: How walls are found.

    Returns:
        For each candidate whether its background has changed much.
    """
    shapes, guesses = [one.current for one in candidates], [one.start for one in candidates]
    occupied = cells.without(shapes, margin)
    walls = walls_behind(cells, shapes, guesses, options.walls, options.lines)
    for wall in walls:
        occupied[wall.cells] = False
    distances = DistanceMap.of(occupied, cells.frame)
    seen = list(pool.map(lambda candidate: distances.background(candidate.bundle), candidates))
    straight = measure_walls(cells.walls, _rays_beside(candidates, seen, options), cells.frame.resolution)
    changed = []
    for candidate, cast in zip(candidates, seen, strict=True):
        background = sharpen(cast, candidate.bundle, straight, cells.frame.resolution, options.surfaces)
        limits = candidate.options.map
        before, candidate.background = candidate.background, background
        near = limits.occluder_distance
        candidate.walls = [wall for wall in walls if centroid_distance(wall.stretch, candidate.start) < near]
        if before is None:
            changed.append(True)
            continue
        moved = np.abs(before.ranges - background.ranges) > limits.moved_range
        changed.append(bool(np.mean(moved) > limits.moved_share))
    return changed


def _rays_beside(
    candidates: Sequence[Candidate], backgrounds: Sequence[Background], options: RefinementOptions
) -> list[tuple[RayBundle, Background]]:
    """Return the rays of each candidate that pass clear of it, with their background."""
    pairs = []
    for candidate, background in zip(candidates, backgrounds, strict=True):
        clear = ~candidate.bundle.passing(candidate.current, options.surfaces.clear)
        pairs.append((candidate.bundle.select(clear), background.select(clear)))
    return pairs


def centroid_distance(a: Primitive, b: Primitive) -> float:
    """Return the distance (m) of two primitives' centroids.

    Args:
        a: One.
        b: The other.

    Returns:
        Metres.
    """
    return math.hypot(a.x - b.x, a.y - b.y)
