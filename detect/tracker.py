"""Detections over a replay become tracks: one id for one primitive, as long as it is seen.

Each track holds a Kalman filter for every kind it was taken for: place, angle where the kind has one, and sizes, with
a state that stays where it is but for a little process noise. No look tells how the errors of two of these go
together, so that all covariances are diagonal and each number has a filter of its own (the tests hold them against
filterpy's, which takes longer to load than a short replay to map). The track's kind is the one with the largest sum
of scores. What belongs together is decided by distance, nearest first.

Rules, all counted in looks (a look is one time that the detector was shown the map):

- a detection within GATE of no track begins a tentative one;
- a track is confirmed at its CONFIRM-th sighting; a tentative one that is missed once goes;
- a confirmed one goes when it was missed DROP times in a row.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np

from prim.arrays import FloatArray
from prim.shapes import Kind, Primitive, angle_difference

if TYPE_CHECKING:
    from detect.detection import Detection

CONFIRM = 2
DROP = 3

GATE = 0.5
"""A detection belongs to a track no further away than this share of the larger one's extent."""

LEAST_GATE = 0.06
"""And this much (m) is always near enough."""

PLACE_STD, SIZE_STD, ANGLE_STD = 0.012, 0.015, math.radians(8)
"""How far off one detection is (m, m, rad): about what the networks' errors are on noisy maps."""

LEAST_STD = 1e-3
"""Nothing is surer than this (m, rad) from one look to the next."""

DRIFT = 0.3
"""Process noise between two looks, as a share of the above: looks at one growing map err alike, and things move."""


LEAST_SCORE = 0.05
"""A sighting is as unsure as if it were seen with its score, or this if that is more, times as many rays."""


@dataclass
class _Hypothesis:
    """What a track is if it is of one kind: the ``state`` (K,) is x, y, angle where there is one, sizes; ``variance``
    (K,) is how unsure each of them is (m², rad²).
    """

    kind: Kind
    state: FloatArray
    variance: FloatArray
    score: float = 0.0

    @classmethod
    def begin(cls, detection: Detection) -> _Hypothesis:
        """From the first sighting."""
        primitive = detection.primitive
        return cls(primitive.kind, _state(primitive), _noise(detection), detection.score)

    def update(self, detection: Detection) -> None:
        """Adds a sighting; its angle is taken on the turn that is nearest to the state's."""
        primitive = detection.primitive
        seen = _state(primitive)
        if primitive.theta is not None:
            period = primitive.symmetry or self.primitive.symmetry
            turned = 0.0 if period is None else angle_difference(seen[2], self.state[2], period)
            seen[2] = self.state[2] + turned
        noise = _noise(detection)
        predicted = self.variance + noise * DRIFT**2
        gain = predicted / (predicted + noise / max(detection.score, LEAST_SCORE))
        self.state = self.state + gain * (seen - self.state)
        self.variance = (1 - gain) * predicted
        self.score += detection.score

    @property
    def primitive(self) -> Primitive:
        """The state as a primitive."""
        values = self.state.tolist()
        theta = values[2] if self.kind.has_angle else None
        sizes = values[len(values) - len(self.kind.sizes) :]
        return Primitive(self.kind, values[0], values[1], theta, tuple(max(v, 1e-3) for v in sizes)).canonical()

    @property
    def std(self) -> dict[str, float]:
        """Standard deviations (m, rad) by name."""
        return dict(zip(self.kind.parameters, np.sqrt(self.variance).tolist(), strict=True))


@dataclass
class Track:
    """One primitive over time. ``sightings`` and ``missed`` count looks; ``id`` is its own for the whole replay."""

    id: int
    sightings: int = 0
    missed: int = 0
    hypotheses: dict[Kind, _Hypothesis] = field(default_factory=dict)

    @property
    def confirmed(self) -> bool:
        """Whether it was seen often enough."""
        return self.sightings >= CONFIRM

    @property
    def best(self) -> _Hypothesis:
        """The kind with the largest sum of scores."""
        return max(self.hypotheses.values(), key=lambda one: one.score)

    @property
    def primitive(self) -> Primitive:
        """Where it is held to be."""
        return self.best.primitive

    @property
    def std(self) -> dict[str, float]:
        """How sure that is (m, rad), by name."""
        return self.best.std

    def add(self, detection: Detection) -> None:
        """A sighting."""
        primitive = detection.primitive
        if primitive.kind in self.hypotheses:
            self.hypotheses[primitive.kind].update(detection)
        else:
            self.hypotheses[primitive.kind] = _Hypothesis.begin(detection)
        self.sightings += 1
        self.missed = 0


class Tracker:
    """Keeps tracks over a replay."""

    def __init__(self) -> None:
        self.tracks: list[Track] = []
        self._next = 1

    def update(self, found: Sequence[Detection]) -> list[Track]:
        """Adds one look; returns the track of each detection, in their order."""
        chosen = self._assigned(found)
        for index, detection in enumerate(found):
            if index not in chosen:
                chosen[index] = self._begin()
            chosen[index].add(detection)
        seen = {track.id for track in chosen.values()}
        for track in self.tracks:
            if track.id not in seen:
                track.missed += 1
        self.tracks = [track for track in self.tracks if _lives(track)]
        return [chosen[index] for index in range(len(found))]

    def _begin(self) -> Track:
        track = Track(self._next)
        self._next += 1
        self.tracks.append(track)
        return track

    def _assigned(self, found: Sequence[Detection]) -> dict[int, Track]:
        """Detections with the tracks they belong to: nearest first, confirmed tracks before tentative ones."""
        pairs = []
        for index, detection in enumerate(found):
            for track in self.tracks:
                distance = _distance(detection.primitive, track.primitive)
                if distance <= _gate(detection.primitive, track.primitive):
                    pairs.append((not track.confirmed, distance, index, track))
        chosen: dict[int, Track] = {}
        taken: Counter[int] = Counter()
        for _, _, index, track in sorted(pairs, key=lambda pair: pair[:3]):
            if index not in chosen and not taken[track.id]:
                chosen[index] = track
                taken[track.id] += 1
        return chosen


def _lives(track: Track) -> bool:
    return track.missed < (DROP if track.confirmed else 1)


def _distance(a: Primitive, b: Primitive) -> float:
    return math.hypot(a.x - b.x, a.y - b.y)


def _gate(a: Primitive, b: Primitive) -> float:
    extent = max(float(np.ptp(one.outline(16), axis=0).max()) for one in (a, b))
    return max(LEAST_GATE, GATE * extent)


def _state(primitive: Primitive) -> FloatArray:
    turn = [] if primitive.theta is None else [primitive.theta]
    return np.array([primitive.x, primitive.y, *turn, *primitive.size])


def _noise(detection: Detection) -> FloatArray:
    """Variances (K,) of one sighting: its own where it was refined, else what networks' errors are."""
    primitive = detection.primitive
    if detection.std is not None:
        return np.square(list(detection.std.values())) + LEAST_STD**2
    turn = [] if primitive.theta is None else [ANGLE_STD]
    return np.square([PLACE_STD, PLACE_STD, *turn, *[SIZE_STD] * len(primitive.size)])
