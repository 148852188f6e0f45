"""Candidates: what is fitted, each with its rays and beside the others, which may occlude it."""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import Executor
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from detect.detection import Detection
from detect.refinement.fitting.evidence import laplace_evidence, size_bounds
from detect.refinement.fitting.fit import SPECIAL_CASES, KindFit, fit_all_kinds, refit, refit_same_kind
from detect.refinement.likelihood.geometry import JACOBIANS, parameters_of, primitive_of, ranges_to
from detect.refinement.likelihood.kernels import ORIGIN_X, ORIGIN_Y
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
    occlusion_by,
    with_background,
)
from detect.refinement.options import DEFAULTS, RefinementOptions
from detect.refinement.outlines.free_outline import ranges_of
from detect.refinement.surroundings.map_cells import MapCells, is_within
from detect.refinement.surroundings.walls import Wall, walls_behind
from detect.refinement.wall_surfaces import measure_walls, sharpen
from prim.arrays import BoolGrid, FloatArray
from prim.shapes import Primitive

NOTHING = np.zeros(0)


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
        rivals: Candidates that would stand in its place, and do not occlude it.
        around: The rays that pass its circle, where ``bundle`` has only those near its outline.
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
    rivals: list[Candidate] = field(default_factory=list)
    around: RayBundle | None = None
    current: Primitive = field(init=False)
    _cached: tuple[Background, tuple[float, float], FloatArray] | None = None
    _passed: dict[int, tuple[Candidate, bool]] = field(default_factory=dict)
    _occlusion: tuple[tuple[object, ...], float, tuple[FloatArray, FloatArray]] = (), 0.0, (NOTHING, NOTHING)

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
            others: All candidates; those that no ray of it passes, and itself, are passed over.
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
        near = [other for other in others if other is not self and self._may_be_occluded_by(other)]
        errors = self.errors if errors is None else errors
        walls, nearest = self._occlusion_by(near, errors.reach)
        if errors != NO_ERRORS:
            around = Surroundings(background, self._cached[2], walls, nearest)
            return without_errors(self.bundle, around, shape or self.current, sensor, errors)
        return with_background(self.bundle, background, self._cached[2], np.minimum(walls, nearest), sensor)

    def _occlusion_by(self, others: Sequence[Candidate], reach: float) -> tuple[FloatArray, FloatArray]:
        """Return where its rays (N,) meet its walls, and others; again for as long as these are the same."""
        shapes = [other.current for other in others if other.outline is None]
        outlines = [other.outline for other in others if other.outline is not None]
        things = (self.bundle, *shapes, *self.walls, *outlines)
        earlier, at, ranges = self._occlusion
        if (
            at != reach
            or len(things) != len(earlier)
            or any(a is not b for a, b in zip(things, earlier, strict=True))
        ):
            walls = occlusion_by(self.bundle, [wall.stretch for wall in self.walls], reach)
            nearest = occlusion_by(self.bundle, shapes, reach)
            ranges = walls, np.minimum.reduce([nearest, *(ranges_of(outline, self.bundle) for outline in outlines)])
            self._occlusion = things, reach, ranges
        return ranges

    def _may_be_occluded_by(self, other: Candidate) -> bool:
        """Tell whether some of its rays pass another candidate where that was first, or nearby; it is asked once."""
        known = self._passed.get(id(other))
        if known is None or known[0] is not other:
            is_rival = any(other is rival for rival in self.rivals)
            passes = bool(self.bundle.passing(other.start, other.options.rays.reach).any())
            self._passed[id(other)] = known = other, passes and not is_rival
        return known[1]

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

    def holds_laser(self) -> bool:
        """Tell whether more than a few scans begin in what it is taken for: that is a room, or a part of one."""
        origins = np.unique(self.bundle.rays[[ORIGIN_X, ORIGIN_Y]], axis=1).T
        return bool(is_within(self.current, origins, 0.0).mean() > self.options.rays.room_share)

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
        """Tell whether a primitive in its place keeps off walls and is of a size that is wanted."""
        prior, longest = self.options.evidence, max(parameters_of(primitive)[3:])
        is_small = longest * primitive.kind.extent < prior.smallest_extent
        if is_small or longest >= size_bounds(primitive.kind, prior)[1]:
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


def find_backgrounds(pool: Executor, candidates: Sequence[Candidate], is_first: bool = False) -> list[bool]:
    """Read from the map what stands behind each candidate: the map without the candidates' own cells.

    Args:
        pool: The threads.
        candidates: The candidates; their background and walls are set.
        is_first: Whether they are not fitted yet, so that more of the cells around them may be their own.

    Returns:
        For each candidate whether its background has changed much.
    """
    changed: dict[int, bool] = {}
    for part in by_level(candidates):
        found = _find_backgrounds_at(pool, part, candidates, is_first)
        changed |= {id(candidate): was for candidate, was in zip(part, found, strict=True)}
    return [changed[id(candidate)] for candidate in candidates]


def by_level(candidates: Sequence[Candidate]) -> list[list[Candidate]]:
    """Part candidates by the cells that they are seen in, those of the first one first."""
    parts: dict[int, list[Candidate]] = {}
    for candidate in candidates:
        parts.setdefault(id(candidate.cells), []).append(candidate)
    return list(parts.values())


def without_candidates(cells: MapCells, candidates: Sequence[Candidate], is_first: bool = False) -> BoolGrid:
    """Return the occupied cells (rows, cols) of a map but for those of candidates, which may be seen in others.

    Args:
        cells: The map.
        candidates: The candidates.
        is_first: Whether they are not fitted yet, so that more of the cells around them may be their own.

    Returns:
        (rows, cols) bool.
    """
    occupied = cells.occupied
    for part in by_level(candidates):
        own, limits = part[0].cells, part[0].options.map
        coarser = max(cells.frame.resolution - own.frame.resolution, 0.0)
        margin = (limits.cleared_first if is_first else limits.cleared) + coarser
        is_finer = own.frame.resolution > cells.frame.resolution  # what is large in finer cells is the thing itself
        touching = margin if is_finer else limits.touching + coarser
        shapes = [candidate.current for candidate in part]
        occupied = occupied & cells.without(shapes, margin, touching, limits.blur + coarser)
    return occupied


def _find_backgrounds_at(
    pool: Executor, candidates: Sequence[Candidate], present: Sequence[Candidate], is_first: bool
) -> list[bool]:
    """Read from one map what stands behind the candidates that are seen in it; all that are present are left out."""
    cells, options = candidates[0].cells, candidates[0].options
    shapes, guesses = [one.current for one in candidates], [one.start for one in candidates]
    own = {id(candidate) for candidate in candidates}
    beside = [candidate.current for candidate in present if id(candidate) not in own]
    occupied = without_candidates(cells, present, is_first)
    walls = walls_behind(cells, shapes, guesses, beside, options.walls, options.lines)
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
        candidate.walls = [wall for wall in walls if candidate.bundle.passing(wall.stretch, 0.0).any()]
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
