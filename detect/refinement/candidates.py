"""Candidates: the things that refinement fits, each beside what is known of the others."""

from __future__ import annotations

import math
from collections.abc import Sequence
from concurrent.futures import Executor
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from detect.detection import Detection
from detect.refinement.evidence import laplace, longest
from detect.refinement.fit import SIMPLER, TIES, Fit, again, again_alone, primitive_of, search
from detect.refinement.map_cells import MapCells
from detect.refinement.rays import Backdrop, Beams, Obstacles, Sensor, backdrop, before, map_says, parameters
from detect.refinement.walls import Wall, walls_behind
from prim.arrays import FloatArray
from prim.metrics import polygon_areas
from prim.shapes import Primitive

WITHIN = 2.5
"""Others further away than this (m) are not reckoned with: few rays pass both, and say the same of all shapes."""

OUT_OF_QUESTION = 30.0
"""A kind whose evidence is this much (nats) less than the likeliest one's is not fitted again; with rays that are not
independent, so much times their dispersion.
"""

MOVED, MOVED_SHARE = 0.05, 0.1
"""What stands behind has changed where more than such a share of rays ends elsewhere (m): all is fitted anew."""

SAME_NOISE = 0.03
"""Noise that differs by less than this share is the same: nothing is fitted again for it."""


@dataclass
class Candidate:
    """One thing that is fitted: where it was first seen, the rays around it, and what is known of it by ``now``.

    Its fits are ``rough`` where they were made to some of the rays only.
    """

    start: Primitive
    beams: Beams
    cells: MapCells
    known: Detection | None = None
    map_behind: Backdrop | None = None
    walls: list[Wall] = field(default_factory=list)
    fits: list[Fit] = field(default_factory=list)
    fitted_to: tuple[Sensor, Beams] | None = None
    said: tuple[Backdrop, float, FloatArray] | None = None
    rough: bool = False
    now: Primitive = field(init=False)

    def __post_init__(self) -> None:
        self.now = self.start

    def seen_before(self, others: Sequence[Candidate], sensor: Sensor) -> Beams:
        """Its beams, with what they say where they miss it: of the map, of walls, and of the other candidates."""
        behind = self.map_behind
        assert behind is not None
        if self.said is None or self.said[0] is not behind or self.said[1] != sensor.std:
            self.said = behind, sensor.std, map_says(self.beams, behind, sensor)
        shapes = [one.now for one in others if one is not self and apart(one.start, self.start) < WITHIN]
        return before(self.beams, behind, self.said[2], [*shapes, *(wall.stretch for wall in self.walls)], sensor)

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
        """Whether a primitive keeps off the walls behind it, and is no larger than primitives are."""
        if max(parameters(primitive)[3:]) >= longest(primitive.kind):
            return False
        own = (wall for wall in self.walls if wall.behind is self.start)
        return not self.cells.is_pierced_by(primitive) and not any(wall.is_cut_by(primitive) for wall in own)

    def take(self, fits: list[Fit], to: Beams, by: Sensor) -> None:
        """Holds these fits to some beams for what is known of it, the first of them for the best."""
        self.fits, self.fitted_to = fits, (by, to)
        self.now = primitive_of(fits[0].kind, fits[0].p)


def fit_all(pool: Executor, candidates: Sequence[Candidate], anew: Sequence[bool], sensor: Sensor) -> None:
    """Fits all candidates beside what was known of the others before: ``anew``, or from where they are.

    Where hardly anything has changed behind and before a candidate, it stays as it is.
    """
    beams = [one.seen_before(candidates, sensor) for one in candidates]
    list(pool.map(lambda one, own, new: _fit_one(one, own, sensor, new), candidates, beams, anew))


def _fit_one(candidate: Candidate, beams: Beams, sensor: Sensor, anew: bool) -> None:
    """Leaves a candidate's kinds, likeliest first, as far as a Gaussian tells their evidence."""
    before = candidate.fitted_to
    searched = candidate.known is None and (anew or before is None)
    if before is not None and not searched and not candidate.rough and _much_alike(before, sensor, beams):
        return
    candidate.rough = searched
    if searched:
        fits = search(candidate.now, candidate.fits, beams, sensor)
    elif candidate.known is not None:
        fits = again_alone(candidate.known_fit, beams, sensor)
    else:
        fits = again(candidate.fits, beams, sensor)
    possible = [fit for fit in fits if candidate.may_be(primitive_of(fit.kind, fit.p))]
    ordered = sorted(possible or fits, key=lambda fit: -laplace(fit))
    least = laplace(ordered[0]) - OUT_OF_QUESTION * sensor.dispersion
    likely = {fit.kind for fit in ordered if laplace(fit) > least}
    likely |= {SIMPLER[kind] for kind in likely if kind in SIMPLER}
    candidate.take([fit for fit in ordered if fit.kind in likely], beams, sensor)


def _much_alike(before: tuple[Sensor, Beams], sensor: Sensor, beams: Beams) -> bool:
    """Whether fits that were made to some beams before need not be made again."""
    one, fitted_to = before
    same = abs(one.std - sensor.std) < SAME_NOISE * sensor.std and one.footprint == sensor.footprint
    return same and fitted_to.much_alike(beams)


def look_behind(pool: Executor, candidates: Sequence[Candidate], cells: MapCells, margin: float) -> list[bool]:
    """Reads from the map what stands behind each candidate: the map without their own cells.

    Whose cells are a candidate's is better known the second time; returns for which that changed much.
    """
    shapes = [one.now for one in candidates]
    occupied = cells.without(shapes, margin)
    walls = walls_behind(cells, shapes, [one.start for one in candidates])
    for wall in walls:
        occupied[wall.cells] = False
    obstacles = Obstacles.of(occupied, cells.frame)
    behind = pool.map(lambda one: backdrop(one.beams, obstacles), candidates)
    changed = []
    for one, now in zip(candidates, behind, strict=True):
        before, one.map_behind = one.map_behind, now
        one.walls = [wall for wall in walls if apart(wall.stretch, one.start) < WITHIN]
        moved = before is None or np.mean(np.abs(before.stops - now.stops) > MOVED) > MOVED_SHARE
        changed.append(bool(moved))
    return changed


def apart(a: Primitive, b: Primitive) -> float:
    """How far (m) two primitives' middles are from each other."""
    return math.hypot(a.x - b.x, a.y - b.y)


def share_of(a: Primitive, b: Primitive) -> float:
    """How much two primitives share, of the smaller one's area."""
    if apart(a, b) > a.circumradius + b.circumradius:
        return 0.0
    first, second, shared = polygon_areas(a, b)
    return shared / min(first, second)
