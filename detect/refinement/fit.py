"""Kinds fitted to the rays that pass a candidate: from starts to the nearest best parameters."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from detect.refinement.kernels import PARAMETERS, costs, descend
from detect.refinement.rays import FAMILY, Beams, Sensor, parameters
from prim.arrays import FloatArray
from prim.shapes import Kind, Primitive

COARSE_RAYS, SEARCH_RAYS = 800, 1600
"""To about so many rays starts are fitted, and what comes of the best of them."""

KNOWN_TO = 0.001
"""What silhouettes tell is asked with this blur (m): it is a sum of jumps, which narrower ones would take for all."""


@dataclass(frozen=True)
class Descent:
    """How a fit descends: from one blur (m, half a footprint) to the next, none smaller than the sensor's own, with
    no more than so many ``steps`` at each, ending where a step gains less than the ``tolerance`` (nats).
    """

    blurs: tuple[float, ...]
    steps: int
    tolerance: float


COARSE = Descent((0.03, 0.012), 8, 0.5)
FINE = Descent((0.008, 0.001), 10, 0.1)
LAST = Descent((0.012, 0.004, 0.001, 0.0003), 10, 0.1)
"""From starts, to tell what to go on with; from the best of these; and from fits that were made before: as narrow as
silhouettes are known.
"""

HOPELESS, HOPELESS_WAY = 60.0, 20.0
"""A kind whose coarse fit is this much (nats) less likely than the best one's is not fitted to all rays, nor is
another way to the same kind by so much.
"""

WAYS = 2
"""So many of a kind's coarse fits are gone on with."""

ALIKE = 1.3
"""A triangle whose sides are no more unlike than this may have been fitted with the wrong apex."""

SIMPLER = {kind: kind.special_case for kind in Kind if kind.special_case is not None}
"""Kinds that are special cases of others; each is fitted wherever the other is."""

STRETCHED = 1.03
"""An ellipse begins with a circle whose one axis is so much longer, the other so much shorter."""


@dataclass(frozen=True)
class Fit:
    """A kind fitted to rays: the five parameters, the cost (nats), and the information on its own parameters."""

    kind: Kind
    p: FloatArray
    cost: float
    information: FloatArray


Way = tuple[Kind, FloatArray]
"""A kind, and the five parameters that a fit of it begins with."""


@dataclass(frozen=True)
class Share:
    """Some beams, ``each`` of which stands for so many."""

    beams: Beams
    each: int = 1

    @classmethod
    def of(cls, beams: Beams, about: int) -> Share:
        """About so many of the beams, evenly spread."""
        each = max(1, len(beams) // about)
        return cls(beams.of(slice(None, None, each)), each) if each > 1 else cls(beams)


def _tie(kind: Kind) -> FloatArray:
    """The matrix (5, K) from a kind's own parameters to x, y, theta, width, height."""
    full = np.eye(PARAMETERS)
    columns = [full[0], full[1], *([full[2]] if kind.has_angle else [])]
    columns += [full[3] + full[4]] if kind.is_tied else [full[3], full[4]]
    return np.column_stack(columns)


TIES = {kind: _tie(kind) for kind in Kind}
"""For each kind the matrix (5, K) that maps its own parameters to x, y, theta, width, height."""


def starts(of: Primitive, kind: Kind) -> list[FloatArray]:
    """Where the fit of a kind begins, for something that was first taken for ``of``: same place, same spread."""
    x, y, theta, *sizes = parameters(of).tolist()
    spread = [size / math.sqrt(factor) for size, factor in zip(sizes, of.kind.spread_factors, strict=True)]
    made = []
    mean = math.sqrt(spread[0] * spread[1])
    for turn in start_turns(kind, of.kind):
        along, across = spread
        if abs(math.sin(turn)) > 0.9:
            along, across = across, along
        elif abs(math.sin(turn)) > 0.1 or kind.is_tied:
            along = across = mean
        a, b = (math.sqrt(factor) for factor in kind.spread_factors)
        made.append(np.array([x, y, theta + turn if kind.has_angle else 0.0, a * along, b * across]))
    return made


def start_turns(kind: Kind, of: Kind) -> list[float]:
    """Angles (rad) from something that was taken for a kind to the starts of another kind's fit."""
    row = kind.row
    if row.period is None:
        return [0.0]
    if kind.longer_first or row.period <= math.pi / 2:
        return [0.0, min(row.period, math.pi / 2) / 2]
    turns = [0.0, math.pi / 2, math.pi, -math.pi / 2]
    if kind is of and row.regular_period is not None:
        turns += [row.regular_period, -row.regular_period]
    return turns


def search(now: Primitive, before: Sequence[Fit], beams: Beams, sensor: Sensor) -> list[Fit]:
    """Every kind that may explain what was taken for a primitive, fitted to its beams.

    Starts are fitted to some of the rays, and held against all of them, beside what it was taken for ``now`` and what
    fits it had ``before``; from the best of each kind the fit goes on with more rays.
    """
    ways = [(kind, p) for kind in Kind for p in starts(now, kind)]
    coarse = _fit_each(ways, Share.of(beams, COARSE_RAYS), sensor, COARSE)
    made = [(fit.kind, fit.p) for fit in (*coarse, *before)]
    ranked = _ranked([*made, (now.kind, parameters(now))], beams, sensor)
    best: dict[Kind, float] = {}
    for cost, (kind, _) in ranked:
        best.setdefault(kind, cost)
    hopeful = {kind for kind, cost in best.items() if cost < min(best.values()) + HOPELESS}
    hopeful |= {simple for kind, simple in SIMPLER.items() if kind in hopeful}
    chosen: list[Way] = []
    for kind in Kind:
        own = [way for cost, way in ranked if way[0] is kind and cost < best[kind] + HOPELESS_WAY]
        chosen += own[:WAYS] if kind in hopeful else []
    return _finely(chosen, Share.of(beams, SEARCH_RAYS), sensor, FINE)


def _ranked(ways: Sequence[Way], beams: Beams, sensor: Sensor) -> list[tuple[float, Way]]:
    """Ways with their costs (nats) over all beams, somewhat blurred, best first."""
    out = np.empty(len(ways))
    families = np.array([FAMILY[kind] for kind, _ in ways])
    shapes = np.stack([p for _, p in ways])
    costs(families, shapes, beams.rays, beams.kinds, sensor.std, sensor.table, FINE.blurs[0], out)
    return sorted(zip(out.tolist(), ways, strict=True), key=lambda one: one[0])


def again(fits: Sequence[Fit], beams: Beams, sensor: Sensor) -> list[Fit]:
    """Kinds fitted again, from where they are, beside those that they are special cases of."""
    return _finely([(fit.kind, fit.p) for fit in fits], Share(beams), sensor, LAST)


def again_alone(fit: Fit, beams: Beams, sensor: Sensor) -> list[Fit]:
    """One kind fitted again, and no other."""
    return _fit_each([(fit.kind, fit.p)], Share(beams), sensor, LAST)


def _finely(ways: Sequence[Way], share: Share, sensor: Sensor, how: Descent) -> list[Fit]:
    """The best fit of each kind from some ways to it; a triangle's also with the other two corners as its apex, a
    rectangle's and an ellipse's also from the square or circle that it is no better than.
    """
    best: dict[Kind, Fit] = {}

    def keep(fits: Sequence[Fit]) -> None:
        for fit in fits:
            if fit.kind not in best or fit.cost < best[fit.kind].cost:
                best[fit.kind] = fit

    keep(_fit_each(ways, share, sensor, how))
    others = [(kind, p) for kind, fit in best.items() if kind.corners == 3 for p in other_apexes(fit.p)]
    keep(_fit_each(others, share, sensor, how))
    stuck = [
        (kind, p)
        for kind, simple in SIMPLER.items()
        if simple in best and (kind not in best or best[kind].cost > best[simple].cost - how.tolerance)
        for p in unlike(kind, best[simple].p)
    ]
    keep(_fit_each(stuck, share, sensor, how))
    return list(best.values())


def unlike(kind: Kind, p: FloatArray) -> list[FloatArray]:
    """Where the fit of a ``kind`` begins whose special case has parameters ``p``: with these for a rectangle, in four
    directions a little longer for an ellipse, since a circle has none to turn to.
    """
    if SIMPLER[kind].has_angle:
        return [p]
    longer = np.array([STRETCHED, 1 / STRETCHED])
    turns = [quarter * math.pi / 4 for quarter in range(4)]
    return [np.array([p[0], p[1], turn, *(p[3:] * longer)]) for turn in turns]


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


def _fit_each(ways: Sequence[Way], share: Share, sensor: Sensor, how: Descent) -> list[Fit]:
    """The nearest best fit from each way to some of the beams; cost and information are what all would make them."""
    if not ways:
        return []
    ties = np.zeros((len(ways), PARAMETERS, PARAMETERS))
    sizes = np.array([TIES[kind].shape[1] for kind, _ in ways])
    for tie, size, (kind, _) in zip(ties, sizes.tolist(), ways, strict=True):
        tie[:, :size] = TIES[kind]
    found, cost = np.stack([p for _, p in ways]), np.empty(len(ways))
    information = np.zeros_like(ties)
    descend(
        np.array([FAMILY[kind] for kind, _ in ways]),
        found,
        ties,
        sizes,
        share.beams.rays,
        share.beams.kinds,
        sensor.std,
        sensor.table,
        np.array(list(dict.fromkeys(max(blur, sensor.footprint) for blur in how.blurs))),
        how.steps,
        how.tolerance / share.each,
        max(KNOWN_TO, sensor.footprint),
        cost,
        information,
    )
    cost, information = share.each * cost, share.each * information
    return [
        Fit(kind, p, float(nats), known[:size, :size])
        for (kind, _), p, nats, known, size in zip(ways, found, cost, information, sizes.tolist(), strict=True)
    ]


def primitive_of(kind: Kind, p: FloatArray) -> Primitive:
    """A primitive of five parameters, in canonical form."""
    x, y, theta, width, height = p.tolist()
    size = (width, height)[: len(kind.sizes)]
    return Primitive(kind, x, y, theta if kind.has_angle else None, size).canonical()
