"""Detections over a replay become tracks: one id for one primitive, as long as it is seen.

Each track holds a Kalman filter (filterpy) for every kind it was taken for: place, angle where the kind has one, and
sizes, with a state that stays where it is but for a little process noise. The track's kind is the one with the
largest sum of scores. What belongs together is decided by distance, nearest first.

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
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from prim.shapes import SIZE_KEYS, Kind, Primitive, angle_difference

if TYPE_CHECKING:
    from detect.detector import Detection

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


@dataclass
class _Hypothesis:
    """What a track is if it is of one kind: the filter's state is x, y, angle where there is one, sizes."""

    kind: Kind
    filter: Any
    score: float = 0.0

    @classmethod
    def begin(cls, detection: Detection) -> _Hypothesis:
        """From the first sighting."""
        from filterpy.kalman import KalmanFilter

        primitive = detection.primitive
        state = _state(primitive)
        noise = _noise(detection)
        made = KalmanFilter(dim_x=len(state), dim_z=len(state))
        made.x, made.P = state[:, None], noise.copy()
        made.F = made.H = np.eye(len(state))
        made.R, made.Q = noise, noise * DRIFT**2
        return cls(primitive.kind, made, detection.score)

    def update(self, detection: Detection) -> None:
        """Adds a sighting; its angle is taken on the turn that is nearest to the state's."""
        primitive = detection.primitive
        seen = _state(primitive)
        if primitive.theta is not None:
            held = self.primitive
            period = primitive.symmetry or held.symmetry
            seen[2] = self.filter.x[2, 0] + (
                0.0 if period is None else angle_difference(seen[2], self.filter.x[2, 0], period)
            )
        noise = _noise(detection)
        self.filter.predict(Q=noise * DRIFT**2)
        self.filter.update(seen[:, None], R=noise / max(detection.score, 0.05))
        self.score += detection.score

    @property
    def primitive(self) -> Primitive:
        """The state as a primitive."""
        values = self.filter.x[:, 0].tolist()
        theta = None if self.kind is Kind.CIRCLE else values[2]
        sizes = values[len(values) - len(SIZE_KEYS[self.kind]) :]
        return Primitive(self.kind, values[0], values[1], theta, tuple(max(v, 1e-3) for v in sizes)).canonical()

    @property
    def std(self) -> dict[str, float]:
        """Standard deviations (m, rad) by name."""
        names = ["x", "y", *([] if self.kind is Kind.CIRCLE else ["theta"]), *SIZE_KEYS[self.kind]]
        return dict(zip(names, np.sqrt(np.diag(self.filter.P)).tolist(), strict=True))


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


def _state(primitive: Primitive) -> NDArray[np.float64]:
    turn = [] if primitive.theta is None else [primitive.theta]
    return np.array([primitive.x, primitive.y, *turn, *primitive.size])


def _noise(detection: Detection) -> NDArray[np.float64]:
    """Covariance of one sighting: its own where it was refined, else what networks' errors are."""
    primitive = detection.primitive
    if detection.std is not None:
        return np.diag(np.square(list(detection.std.values())) + LEAST_STD**2)
    turn = [] if primitive.theta is None else [ANGLE_STD]
    return np.diag(np.square([PLACE_STD, PLACE_STD, *turn, *[SIZE_STD] * len(primitive.size)]))
