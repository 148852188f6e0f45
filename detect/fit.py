"""Kinds fitted to the rays that pass a candidate: from starts to the nearest best parameters."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from detect.beams import FAMILY, Beams, Sensor, parameters
from detect.raycost import PARAMETERS, costs, descend
from prim.raycast import FloatArray
from prim.shapes import SIZE_KEYS, Kind, Primitive

COARSE_RAYS, SEARCH_RAYS = 800, 1600
"""To about so many rays starts are fitted, and what comes of the best of them."""

COARSE_BLURS = (0.03, 0.012)
FINE_BLURS = (0.008, 0.001)
LAST_BLURS = (0.012, 0.004, 0.001, 0.0003)
"""Fits go from one blur (m, half a footprint) to the next, none smaller than the sensor's own: from starts, from the
best of these, and from fits that were made before. The last is as narrow as silhouettes are known.
"""

KNOWN_TO = 0.001
"""What silhouettes tell is asked with this blur (m): it is a sum of jumps, which narrower ones would take for all."""

COARSE_STEPS, FINE_STEPS = 8, 10
TOLERANCE, ROUGH = 0.1, 0.5
"""A fit ends where a step gains less than this (nats); one that only tells what to go on with, than the latter."""

HOPELESS, HOPELESS_WAY = 60.0, 20.0
"""A kind whose coarse fit is this much (nats) less likely than the best one's is not fitted to all rays, nor is
another way to the same kind by so much.
"""

WAYS = 2
"""So many of a kind's coarse fits are gone on with."""

ALIKE = 1.3
"""A triangle whose sides are no more unlike than this may have been fitted with the wrong apex."""

SIMPLER = {Kind.RECTANGLE: Kind.SQUARE, Kind.ELLIPSE: Kind.CIRCLE}
"""Kinds that are special cases of others, and fitted wherever these are."""


@dataclass(frozen=True)
class Fit:
    """A kind fitted to rays: the five parameters, the cost (nats), and the information on its own parameters."""

    kind: Kind
    p: FloatArray
    cost: float
    information: FloatArray


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
    if kind is Kind.TRIANGLE:
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


def search(now: Primitive, beams: Beams, sensor: Sensor) -> list[Fit]:
    """Every kind that may explain what was taken for a primitive, fitted to its beams.

    Starts are fitted to some of the rays, and held against all of them, beside what it was taken for ``now``; from
    the best of each kind the fit goes on with more rays.
    """
    few = Share.of(beams, COARSE_RAYS)
    tried = {kind: [_coarse(kind, p, few, sensor).p for p in starts(now, kind)] for kind in Kind}
    tried[now.kind].append(parameters(now))
    ranked = {kind: _ranked(kind, ways, beams, sensor) for kind, ways in tried.items()}
    limit = min(ways[0][0] for ways in ranked.values()) + HOPELESS
    hopeful = {kind for kind, ways in ranked.items() if ways[0][0] < limit}
    hopeful |= {simple for kind, simple in SIMPLER.items() if kind in hopeful}
    some = Share.of(beams, SEARCH_RAYS)
    return [_fine(kind, _best_ways(ranked[kind]), some, sensor, FINE_BLURS) for kind in Kind if kind in hopeful]


def _best_ways(ranked: Sequence[tuple[float, FloatArray]]) -> list[FloatArray]:
    """Those of a kind's coarse fits that are gone on with."""
    return [p for cost, p in ranked if cost < ranked[0][0] + HOPELESS_WAY][:WAYS]


def _coarse(kind: Kind, p: FloatArray, share: Share, sensor: Sensor) -> Fit:
    """A fit that only tells what to go on with."""
    return _fit(kind, p, share, sensor, COARSE_BLURS, COARSE_STEPS, ROUGH)


def _ranked(kind: Kind, ways: Sequence[FloatArray], beams: Beams, sensor: Sensor) -> list[tuple[float, FloatArray]]:
    """Parameters of a kind with their costs (nats) over all beams, somewhat blurred, best first."""
    out = np.empty(len(ways))
    costs(FAMILY[kind], np.stack(ways), beams.rays, beams.kinds, sensor.std, sensor.table, FINE_BLURS[0], out)
    return sorted(zip(out.tolist(), ways, strict=True), key=lambda one: one[0])


def again(fits: Sequence[Fit], beams: Beams, sensor: Sensor) -> list[Fit]:
    """Kinds fitted again, from where they are."""
    return [_fine(fit.kind, [fit.p], Share(beams), sensor, LAST_BLURS) for fit in fits]


def _fine(kind: Kind, ways: Sequence[FloatArray], share: Share, sensor: Sensor, blurs: Sequence[float]) -> Fit:
    """The best fit from some ``ways``; a triangle's also with the other two corners as its apex."""
    best = min((_fit(kind, p, share, sensor, blurs, FINE_STEPS) for p in ways), key=lambda fit: fit.cost)
    if kind is not Kind.TRIANGLE:
        return best
    others = [_fit(kind, p, share, sensor, blurs, FINE_STEPS) for p in other_apexes(best.p)]
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


def _fit(
    kind: Kind,
    p: FloatArray,
    share: Share,
    sensor: Sensor,
    blurs: Sequence[float],
    steps: int,
    tolerance: float = TOLERANCE,
) -> Fit:
    """The nearest best fit of a kind to some of the beams; its cost and information as all would make them."""
    tie = TIES[kind]
    found, information = p.copy(), np.zeros((tie.shape[1], tie.shape[1]))
    cost = descend(
        FAMILY[kind],
        found,
        tie,
        share.beams.rays,
        share.beams.kinds,
        sensor.std,
        sensor.table,
        np.maximum(blurs, sensor.footprint),
        steps,
        tolerance / share.each,
        max(KNOWN_TO, sensor.footprint),
        information,
    )
    return Fit(kind, found, share.each * cost, share.each * information)


def primitive_of(kind: Kind, p: FloatArray) -> Primitive:
    """A primitive of five parameters, in canonical form."""
    x, y, theta, width, height = p.tolist()
    size = (width, height)[: len(SIZE_KEYS[kind])]
    return Primitive(kind, x, y, None if kind is Kind.CIRCLE else theta, size).canonical()
