"""Tracking of detections over a replay: a primitive keeps one id as long as it is detected.

Each track holds one hypothesis for every kind that it was detected as: a linear Kalman filter with a static motion
model whose state is position, angle (where the kind has one) and sizes. Detections come without correlations between
these, so that all covariances are diagonal and the filter is one scalar filter for each parameter (the tests compare
it with filterpy's, which takes longer to import than a short replay takes to map). The kind of a track is the one
with the largest sum of scores. Detections are associated with tracks by greedy nearest neighbour within a gate.

Track management, counted in updates (one for each time that the detector runs on the map):

- a detection in no track's gate starts a tentative track;
- a track is confirmed by its ``confirm_after``-th detection; a tentative one without a detection is deleted;
- a confirmed one is deleted after ``delete_after`` consecutive updates without a detection.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np

from prim.arrays import FloatArray
from prim.se2 import angle_difference
from prim.shapes import Kind, Primitive

if TYPE_CHECKING:
    from detect.detection import Detection


@dataclass(frozen=True)
class TrackerOptions:
    """Parameters of the tracker, all set by hand; ``python -m bench.tracks`` measures how well ids persist."""

    confirm_after: int = 2
    """Detections that confirm a track."""

    delete_after: int = 3
    """Consecutive updates without a detection that delete a confirmed track."""

    gate_share: float = 0.5
    """Gate on the distance of the centroids, as a share of the larger one's extent."""

    min_gate: float = 0.06
    """Smallest gate (m)."""

    position_std: float = 0.012
    """Measurement noise (m) of x and y where a detection brings no standard deviations: about the networks' errors
    on noisy maps."""

    size_std: float = 0.015
    """The same for sizes (m)."""

    angle_std: float = math.radians(8)
    """The same for the angle (rad)."""

    min_std: float = 1e-3
    """Added in quadrature to standard deviations that a detection brings (m, rad): model error."""

    process_noise: float = 0.3
    """Standard deviation of the process noise of one update, as a share of that of the detection: detections on one
    growing map have correlated errors, and primitives move."""

    min_weight: float = 0.05
    """The measurement variance of a detection that corrects a filter is divided by its score, or by this where the
    score is less; that of the detection that starts a filter is not."""

    min_size: float = 1e-3
    """Smallest size (m) of a track's primitive."""


DEFAULTS = TrackerOptions()


@dataclass
class _Hypothesis:
    """The Kalman filter of a track under the hypothesis that it is of one kind.

    Attributes:
        kind: The kind.
        options: Parameters of the filter.
        state: (K,) x, y (m), angle (rad) where the kind has one, sizes (m).
        variance: (K,) diagonal of the state's covariance (m^2, rad^2).
        score: Sum of the detections' scores.
    """

    kind: Kind
    options: TrackerOptions
    state: FloatArray
    variance: FloatArray
    score: float = 0.0

    @classmethod
    def start(cls, detection: Detection, options: TrackerOptions) -> _Hypothesis:
        """Initialise the state with the first detection."""
        primitive = detection.primitive
        variance = _measurement_variance(detection, options)
        return cls(primitive.kind, options, _state_of(primitive), variance, detection.score)

    def update(self, detection: Detection) -> None:
        """Predict and correct by a detection, its angle unwrapped by the symmetry to the nearest of the state's."""
        primitive = detection.primitive
        measurement = _state_of(primitive)
        if primitive.theta is not None:
            period = primitive.symmetry or self.primitive.symmetry
            innovation = 0.0 if period is None else angle_difference(measurement[2], self.state[2], period)
            measurement[2] = self.state[2] + innovation
        noise = _measurement_variance(detection, self.options)
        predicted = self.variance + noise * self.options.process_noise**2
        gain = predicted / (predicted + noise / max(detection.score, self.options.min_weight))
        self.state = self.state + gain * (measurement - self.state)
        self.variance = (1 - gain) * predicted
        self.score += detection.score

    @property
    def primitive(self) -> Primitive:
        """The state as a primitive."""
        values = self.state.tolist()
        theta = values[2] if self.kind.has_angle else None
        sizes = values[len(values) - len(self.kind.sizes) :]
        size = tuple(max(value, self.options.min_size) for value in sizes)
        return Primitive(self.kind, values[0], values[1], theta, size).canonical()

    @property
    def std(self) -> dict[str, float]:
        """Standard deviations (m, rad) of the parameters by name."""
        return dict(zip(self.kind.parameters, np.sqrt(self.variance).tolist(), strict=True))


@dataclass
class Track:
    """One primitive over time.

    Attributes:
        id: Number of the track, unique over the replay, from 1.
        options: Parameters of the tracker.
        observations: How many detections were associated with it.
        missed: Consecutive updates without a detection.
        hypotheses: The filter of each kind that it was detected as.
    """

    id: int
    options: TrackerOptions = DEFAULTS
    observations: int = 0
    missed: int = 0
    hypotheses: dict[Kind, _Hypothesis] = field(default_factory=dict)

    @property
    def confirmed(self) -> bool:
        """Whether enough detections were associated with it."""
        return self.observations >= self.options.confirm_after

    @property
    def is_expired(self) -> bool:
        """Whether it went without a detection for too long."""
        return self.missed >= (self.options.delete_after if self.confirmed else 1)

    @property
    def best(self) -> _Hypothesis:
        """The hypothesis of the kind with the largest sum of scores."""
        return max(self.hypotheses.values(), key=lambda hypothesis: hypothesis.score)

    @property
    def primitive(self) -> Primitive:
        """The estimate of the best hypothesis, map frame."""
        return self.best.primitive

    @property
    def std(self) -> dict[str, float]:
        """Standard deviations (m, rad) of the estimate by parameter."""
        return self.best.std

    def update(self, detection: Detection) -> None:
        """Correct the hypothesis of the detection's kind, or start one."""
        kind = detection.primitive.kind
        if kind in self.hypotheses:
            self.hypotheses[kind].update(detection)
        else:
            self.hypotheses[kind] = _Hypothesis.start(detection, self.options)
        self.observations += 1
        self.missed = 0


class Tracker:
    """A multi-object tracker over the detections of a replay.

    Attributes:
        options: Its parameters.
        tracks: All tracks that were not deleted, tentative ones included.
    """

    def __init__(self, options: TrackerOptions = DEFAULTS) -> None:
        self.options = options
        self.tracks: list[Track] = []
        self._next_id = 1

    def update(self, detections: Sequence[Detection]) -> list[Track]:
        """Associate the detections of one map with tracks; return the track of each, in their order."""
        chosen = self._associate(detections)
        for index, detection in enumerate(detections):
            if index not in chosen:
                chosen[index] = self._start()
            chosen[index].update(detection)
        detected = {track.id for track in chosen.values()}
        for track in self.tracks:
            if track.id not in detected:
                track.missed += 1
        self.tracks = [track for track in self.tracks if not track.is_expired]
        return [chosen[index] for index in range(len(detections))]

    def _start(self) -> Track:
        track = Track(self._next_id, self.options)
        self._next_id += 1
        self.tracks.append(track)
        return track

    def _associate(self, detections: Sequence[Detection]) -> dict[int, Track]:
        """Return tracks by index of the detection: confirmed tracks before tentative ones, then nearest first."""
        pairs = []
        for index, detection in enumerate(detections):
            for track in self.tracks:
                distance = _distance(detection.primitive, track.primitive)
                if distance <= _gate(detection.primitive, track.primitive, self.options):
                    pairs.append((not track.confirmed, distance, index, track))
        chosen: dict[int, Track] = {}
        assigned: set[int] = set()
        for _, _, index, track in sorted(pairs, key=lambda pair: pair[:3]):
            if index not in chosen and track.id not in assigned:
                chosen[index] = track
                assigned.add(track.id)
        return chosen


def _distance(a: Primitive, b: Primitive) -> float:
    return math.hypot(a.x - b.x, a.y - b.y)


def _gate(a: Primitive, b: Primitive, options: TrackerOptions) -> float:
    """Return the largest distance (m) of two centroids that may be one primitive's."""
    extent = max(float(np.ptp(primitive.outline(16), axis=0).max()) for primitive in (a, b))
    return max(options.min_gate, options.gate_share * extent)


def _state_of(primitive: Primitive) -> FloatArray:
    angle = [] if primitive.theta is None else [primitive.theta]
    return np.array([primitive.x, primitive.y, *angle, *primitive.size])


def _measurement_variance(detection: Detection, options: TrackerOptions) -> FloatArray:
    """Return variances (K,) of a detection: its own where it was refined, else those of the networks' errors."""
    primitive = detection.primitive
    if detection.std is not None:
        return np.square(list(detection.std.values())) + options.min_std**2
    angle = [] if primitive.theta is None else [options.angle_std]
    position, sizes = [options.position_std] * 2, [options.size_std] * len(primitive.size)
    return np.square([*position, *angle, *sizes])
