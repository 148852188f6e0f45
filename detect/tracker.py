"""Tracking of detections over a replay: a primitive keeps one id as long as it is detected.

Each track holds one hypothesis for every kind that it was detected as: a Kalman filter (filterpy's) whose state is
position, angle (where the kind has one), sizes, and the velocity of the position. What stands has no velocity, and
its estimate gains by every detection. A detection that is too far from the estimate for that (its normalised
innovation squared; Bar-Shalom, Li and Kirubarajan, 2001, 5.4) makes the primitive a moving one, whose place is that
of the detection and whose velocity is constant but for white acceleration noise (ibid., 6.2.2); the first detection
that is where the last one was makes it a standing one again. The kind of a track is the one with the largest sum of
scores.

Detections are associated with tracks by greedy nearest neighbour: first within a narrow gate where kind and sizes
agree, then where they do not. Where they agree there is a wide gate, too, as far as the primitive may have been
pushed since it was detected last: of what refinement knows to have moved (``Detection.since``) it goes before the
narrow gate without agreement, of the rest behind it.

Track management, counted in updates (one for each time that the detector runs on the map):

- a detection in no track's gate starts a tentative track;
- a track is confirmed by its ``confirm_after``-th detection; a tentative one without a detection is deleted;
- a confirmed one is deleted after ``delete_after`` consecutive updates without a detection.

Importing filterpy takes some tenths of a second: what makes tracks imports this module in a thread
(replay.detection.stage).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np

from detect.kalman import KalmanFilter
from prim import linear_algebra
from prim.arrays import FloatArray
from prim.se2 import MAX_COORDINATE, angle_difference
from prim.shapes import Kind, Primitive

if TYPE_CHECKING:
    from detect.detection import Detection


@dataclass(frozen=True)
class TrackerOptions:
    """Parameters of the tracker, all set by hand; ``python -m bench.tracks`` measures how well ids persist."""

    confirm_after: int = 2
    """Detections that confirm a track."""

    delete_after: int = 5
    """Consecutive updates without a detection that delete a confirmed track."""

    max_speed: float = 0.2
    """What was not detected where it was may have been pushed at this speed (m/s): the recorded robot's."""

    max_size_ratio: float = 1.3
    """Sizes of one primitive that was pushed so far agree within this factor."""

    max_innovation: float = 25.0
    """Normalised innovation squared of position and angle above which a primitive has moved: by chance, one in
    10,000 detections (two parameters) or less."""

    min_displacement: float = 0.006
    """m; and it is displaced by this at least, as StandingOptions.min_displacement of refinement."""

    acceleration: float = 0.002
    """Spectral density (m^2/s^3) of a moving primitive's acceleration: within some seconds a push begins or ends."""

    turning: float = 0.05
    """Spectral density (rad^2/s) of a moving primitive's turning."""

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


class _Hypothesis:
    """The Kalman filter of a track under the hypothesis that it is of one kind.

    The state has the kind's K parameters (m, rad) and the velocity (m/s).

    Attributes:
        kind: The kind.
        moving: Whether it is taken to move; else its velocity is exactly 0.
        score: Sum of the detections' scores.
    """

    def __init__(self, detection: Detection, stamp: int, options: TrackerOptions) -> None:
        """Initialise the state with the first detection, at ``stamp`` (ns)."""
        self.kind = detection.primitive.kind
        self.moving = False
        self.score = detection.score
        self._options = options
        self._size = len(self.kind.parameters)
        self._stamp = stamp
        self._filter = KalmanFilter(dim_x=self._size + 2, dim_z=self._size)
        self._filter.H = np.eye(self._size, self._size + 2)
        self._last, self._last_noise = _state_of(detection.primitive), _measurement_covariance(detection, options)
        self._stand_at(self._last, self._last_noise)

    def update(self, detection: Detection, stamp: int) -> None:
        """Predict and correct by a detection, its angle unwrapped by the symmetry to the nearest of the state's."""
        measurement = _state_of(detection.primitive)
        if detection.primitive.theta is not None:
            period = detection.primitive.symmetry or self.primitive.symmetry
            theta = float(self._filter.x[2, 0])
            innovation = 0.0 if period is None else angle_difference(measurement[2], theta, period)
            measurement[2] = theta + innovation
        self._correct(measurement, _measurement_covariance(detection, self._options), detection.score, stamp)
        self.score += detection.score

    def follow(self, detection: Detection, stamp: int) -> None:
        """Predict and correct by the place alone of a detection of another kind."""
        covariance = _measurement_covariance(detection, self._options)[:2, :2]
        self._correct(_state_of(detection.primitive)[:2], covariance, detection.score, stamp)

    def _correct(self, measurement: FloatArray, noise: FloatArray, score: float, stamp: int) -> None:
        """Correct by the first parameters (M,), with their covariance (M, M), measured at a stamp (ns)."""
        seconds, self._stamp = _seconds(self._stamp, stamp), max(stamp, self._stamp)
        count = len(measurement)
        last, last_noise = self._last[:count], self._last_noise[:count, :count]
        if self.moving and not self._is_displaced(measurement, noise, last, last_noise):
            self._stand_at(self._last, self._last_noise)
        state, covariance = self._filter.x[:count, 0], self._filter.P[:count, :count]
        if not self.moving and self._is_displaced(measurement, noise, state, covariance):
            self._move_to(measurement, noise, seconds)
        else:
            self._filter.predict(F=self._transition(seconds), Q=self._process_noise(noise, seconds))
            weight = max(score, self._options.min_weight)
            self._filter.update(measurement[:, None], R=noise / weight, H=np.eye(count, self._size + 2))
        self._last[:count] = measurement
        self._last_noise[:count], self._last_noise[:, :count] = 0.0, 0.0
        self._last_noise[:count, :count] = noise

    def _is_displaced(
        self, measurement: FloatArray, noise: FloatArray, place: FloatArray, covariance: FloatArray
    ) -> bool:
        """Return whether position and angle are another place's (M,) than that with a covariance (M, M)."""
        count = min(len(measurement), self._size - len(self.kind.sizes))
        innovation, allowed = (measurement - place)[:count], (noise + covariance)[:count, :count]
        lengths = np.abs(innovation) * [1.0, 1.0, self.primitive.bounding_radius][:count]
        whitened = linear_algebra.solve(allowed, innovation)
        nis = math.inf if whitened is None else float(innovation @ whitened)
        return nis > self._options.max_innovation and float(lengths.max()) > self._options.min_displacement

    def _stand_at(self, place: FloatArray, covariance: FloatArray) -> None:
        """Take a measurement (K,) with its covariance (K, K) for the state of what stands."""
        state = self._filter
        self.moving = False
        state.x, state.P = np.zeros((self._size + 2, 1)), np.zeros((self._size + 2, self._size + 2))
        state.x[: self._size, 0], state.P[: self._size, : self._size] = place, covariance

    def _move_to(self, measurement: FloatArray, noise: FloatArray, seconds: float) -> None:
        """Take a displaced measurement (M,) for the place, and the displacement since the one before for a motion."""
        state, count, velocity = self._filter, len(measurement), slice(self._size, self._size + 2)
        displacement, uncertainty = measurement[:2] - state.x[:2, 0], state.P[:2, :2] + noise[:2, :2]
        state.P[:count], state.P[:, :count] = 0.0, 0.0
        state.x[:count, 0], state.P[:count, :count] = measurement, noise
        if seconds > 0:  # else it is a detection by the same scans, with more work
            self.moving = True
            state.x[velocity, 0] = displacement / seconds
            state.P[velocity, velocity] = uncertainty / seconds**2

    def _transition(self, seconds: float) -> FloatArray:
        """Return the state's transition matrix over a time (s): constant velocity, which is 0 for what stands."""
        transition = np.eye(self._size + 2)
        transition[:2, self._size :] = seconds * np.eye(2)
        return transition

    def _process_noise(self, noise: FloatArray, seconds: float) -> FloatArray:
        """Return the covariance of the process noise: a share of the detection's, and what may move in a time (s)."""
        covariance = np.zeros((self._size + 2, self._size + 2))
        count = len(noise)
        covariance[:count, :count] = noise * self._options.process_noise**2
        if self.moving:
            place, velocity, density = slice(0, 2), slice(self._size, None), self._options.acceleration * np.eye(2)
            covariance[place, place] += density * seconds**3 / 3
            covariance[place, velocity] += density * seconds**2 / 2
            covariance[velocity, place] += density * seconds**2 / 2
            covariance[velocity, velocity] += density * seconds
            if self.kind.has_angle:
                covariance[2, 2] += self._options.turning * seconds
        return covariance

    @property
    def primitive(self) -> Primitive:
        """The state as a primitive."""
        return self._primitive_of(self._filter.x[: self._size, 0])

    def predicted(self, stamp: int) -> Primitive:
        """The primitive where it is at a stamp (ns), if it moves on."""
        state = self._transition(_seconds(self._stamp, stamp)) @ self._filter.x
        return self._primitive_of(state[: self._size, 0])

    def _primitive_of(self, state: FloatArray) -> Primitive:
        values = np.clip(state, -MAX_COORDINATE, MAX_COORDINATE).tolist()
        theta = values[2] if self.kind.has_angle else None
        size = tuple(max(value, self._options.min_size) for value in values[self._size - len(self.kind.sizes) :])
        return Primitive(self.kind, values[0], values[1], theta, size).canonical()

    @property
    def std(self) -> dict[str, float]:
        """Standard deviations (m, rad) of the parameters by name."""
        variances = np.diag(self._filter.P)[: self._size]
        return dict(zip(self.kind.parameters, np.sqrt(variances).tolist(), strict=True))


@dataclass
class Track:
    """One primitive over time.

    Attributes:
        id: Number of the track, unique over the replay, from 1.
        options: Parameters of the tracker.
        observations: How many detections were associated with it.
        missed: Consecutive updates without a detection.
        stamp: When it was detected last (ns).
        hypotheses: The filter of each kind that it was detected as.
    """

    id: int
    options: TrackerOptions = DEFAULTS
    observations: int = 0
    missed: int = 0
    stamp: int = 0
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

    def update(self, detection: Detection, stamp: int) -> None:
        """Correct the hypothesis of the detection's kind, or start one; the others follow its place.

        Args:
            detection: The detection.
            stamp: When it was made (ns).
        """
        kind = detection.primitive.kind
        for other, hypothesis in self.hypotheses.items():
            if other is not kind:
                hypothesis.follow(detection, stamp)
        if kind in self.hypotheses:
            self.hypotheses[kind].update(detection, stamp)
        else:
            self.hypotheses[kind] = _Hypothesis(detection, stamp, self.options)
        self.observations += 1
        self.missed = 0
        self.stamp = stamp

    def distance(self, primitive: Primitive, stamp: int) -> float:
        """Compute how far (m) a detection is from where it was, or from where it moves to.

        Args:
            primitive: The detected primitive.
            stamp: When it was detected (ns).

        Returns:
            The smaller distance of the centroids.
        """
        return min(_distance(primitive, place) for place in (self.primitive, self.best.predicted(stamp)))


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

    @property
    def last_id(self) -> int:
        """The largest id that a track was ever given; 0 before the first."""
        return self._next_id - 1

    def update(self, detections: Sequence[Detection], stamp: int) -> list[Track]:
        """Associate the detections of one map with tracks.

        Args:
            detections: The detections.
            stamp: The time of the map's last scan (ns).

        Returns:
            The track of each detection, in their order.
        """
        chosen = self._associate(detections, stamp)
        for index, detection in enumerate(detections):
            if index not in chosen:
                chosen[index] = self._start()
            chosen[index].update(detection, stamp)
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

    def _associate(self, detections: Sequence[Detection], stamp: int) -> dict[int, Track]:
        """Return tracks by index of the detection: by rank, confirmed tracks first, then the nearest."""
        pairs = []
        for index, detection in enumerate(detections):
            for track in self.tracks:
                rank = self._rank(detection, track, stamp)
                if rank is not None:
                    distance = track.distance(detection.primitive, stamp)
                    pairs.append((rank, not track.confirmed, distance, index, track))
        chosen: dict[int, Track] = {}
        assigned: set[int] = set()
        for _, _, _, index, track in sorted(pairs, key=lambda pair: pair[:4]):
            if index not in chosen and track.id not in assigned:
                chosen[index] = track
                assigned.add(track.id)
        return chosen

    def _rank(self, detection: Detection, track: Track, stamp: int) -> int | None:
        """Return the rank of an association, 0 the best; None where it is impossible.

        In the narrow gate are 0, where kind and sizes agree, and 2, where they do not; in the wide one are 1, if it
        is known that the detected primitive moved, and 3 if not. Where kind or sizes do not agree, the wide gate is
        open to what is known to have moved, and comes last: what is pushed is often fitted as another kind at first.
        """
        options, primitive = self.options, detection.primitive
        distance = track.distance(primitive, stamp)
        alike = _is_alike(primitive, track.primitive, options.max_size_ratio)
        if distance <= _narrow_gate(primitive, track.primitive, options):
            return 0 if alike else 2
        reach = _seconds(track.stamp, stamp) * options.max_speed
        if not track.confirmed or distance > reach:
            return None
        if detection.since is None:
            return 3 if alike else None
        return 1 if alike else 4


def _seconds(before: int, now: int) -> float:
    """Return the time (s) from a stamp (ns) to a later one; 0 where it is none."""
    return max(now - before, 0) / 1e9


def _distance(a: Primitive, b: Primitive) -> float:
    return math.hypot(a.x - b.x, a.y - b.y)


def _is_alike(a: Primitive, b: Primitive, max_ratio: float) -> bool:
    """Return whether two primitives have the same kind and nearly the same sizes."""
    if a.kind is not b.kind:
        return False
    return all(max(one / other, other / one) <= max_ratio for one, other in zip(a.size, b.size, strict=True))


def _narrow_gate(a: Primitive, b: Primitive, options: TrackerOptions) -> float:
    """Return the largest distance (m) of two centroids that may be one primitive's."""
    extent = max(float(np.ptp(primitive.outline(16), axis=0).max()) for primitive in (a, b))
    return max(options.min_gate, options.gate_share * extent)


def _state_of(primitive: Primitive) -> FloatArray:
    angle = [] if primitive.theta is None else [primitive.theta]
    return np.array([primitive.x, primitive.y, *angle, *primitive.size])


def _measurement_covariance(detection: Detection, options: TrackerOptions) -> FloatArray:
    """Return the covariance (K, K) of a detection: its own where it was refined, else of the networks' errors."""
    primitive = detection.primitive
    if detection.covariance is not None:
        return detection.covariance + options.min_std**2 * np.eye(len(detection.covariance))
    if detection.std is not None:
        return np.diag(np.square(list(detection.std.values())) + options.min_std**2)
    angle = [] if primitive.theta is None else [options.angle_std]
    position, sizes = [options.position_std] * 2, [options.size_std] * len(primitive.size)
    return np.diag(np.square([*position, *angle, *sizes]))
