"""The clocks of a log: header stamps that the rest can rely on, whatever clock each device wrote them by.

What a message was logged at is one clock for all topics. Where the stamps in the headers disagree with each other by
it (a device that counts from its start, stamps of 0, a simulation that was reset), they are moved onto one clock.
"""

from __future__ import annotations

import math
from collections.abc import Container, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np

from prim.arrays import Stamps
from prim.choices import ClockName
from prim.log.decoding.codecs import Content
from prim.log.source import LogSource, Message, Numbered, Topic
from prim.scan import Scan

MOVING = (Content.TRANSFORMS, Content.ODOMETRY, Content.POSE)
"""The contents whose stamps say when the robot was where."""

SECOND = 1_000_000_000
"""Nanoseconds."""

MIN_POSES = 3
"""Fewer poses than these say nothing of their clock: someone gave them by hand; set by hand."""


@dataclass(frozen=True)
class ClockOptions:
    """The numbers by which clocks are distinguished; set by hand."""

    max_lag: float = 0.5
    """Clocks that differ by less (s) are the same: messages take that long until they are logged."""

    steady: float = 0.25
    """Header stamps are on a steady clock where most (the middle 90 %) are within this (s) of the log's times."""

    min_jump: float = 1.0
    """Stamps that go back by less (s) are messages that arrived in another order."""

    max_pose_lag: float = 10.0
    """Poses that differ by more (s) from when they were logged are on another clock: none take so long."""

    min_drift: float = 0.02
    """Drift that makes less (s) over a log is none."""

    min_deviations: float = 5.0
    """Drift is at least this many standard errors."""

    min_messages: int = 10
    """A drift is not estimated from fewer messages."""

    first: int = 500
    """By so many of the first messages of a topic it is decided whether poses are stamped by another clock at all."""

    sampled: int = 20_000
    """No more messages of a topic are read to find its clock."""


DEFAULTS = ClockOptions()


@dataclass(frozen=True)
class Clock:
    """How header stamps become stamps on one clock.

    Attributes:
        by_log: The topics whose messages are stamped by when they were logged, less ``lag``.
        all_by_log: Whether all topics are.
        lag: How long after its stamp a message is logged (ns).
        shifts: What is added to the stamps of a topic (ns).
        drifts: What is added to them besides: for each ns after a stamp (ns) so many.
        zeros: The topics some of whose stamps are 0, and how long after their stamps the others are logged (ns): so
            much before it was logged such a message is taken to be stamped.
        offsets: What is added to stamps (ns) from the start on and after each reset of the clock; the one is used by
            which a message's stamp is nearest to when it was logged.
        notes: What a user should know.
    """

    by_log: frozenset[str] = frozenset()
    all_by_log: bool = False
    lag: int = 0
    shifts: Mapping[str, int] = field(default_factory=dict)
    drifts: Mapping[str, tuple[int, float]] = field(default_factory=dict)
    zeros: Mapping[str, int] = field(default_factory=dict)
    offsets: tuple[int, ...] = ()
    notes: tuple[str, ...] = ()

    @property
    def keeps_headers(self) -> bool:
        """Whether the header stamps stay as they are."""
        return not (self.by_log or self.all_by_log or self.shifts or self.zeros or self.offsets)

    def stamp(self, topic: str, stamp: int, log_time: int) -> int:
        """Return a message's stamp (ns) on this clock.

        Args:
            topic: Its topic.
            stamp: The stamp of its header (ns).
            log_time: When it was logged (ns).

        Returns:
            The stamp.
        """
        if self.all_by_log or topic in self.by_log:
            return log_time - self.lag
        if stamp == 0 and topic in self.zeros:
            return log_time - self.zeros[topic]
        if self.offsets:
            return min((stamp + offset for offset in self.offsets), key=lambda moved: abs(moved - log_time))
        since, drift = self.drifts.get(topic, (0, 0.0))
        return stamp + self.shifts.get(topic, 0) + (round((stamp - since) * drift) if drift else 0)

    def stamps(self, topic: str, stamps: Stamps, log_times: Stamps) -> Stamps:
        """Return the stamps of many messages (ns) on this clock.

        Args:
            topic: Their topic.
            stamps: The stamps of their headers (N,) in ns.
            log_times: When they were logged (N,) in ns.

        Returns:
            The stamps (N,).
        """
        if self.keeps_headers:
            return stamps
        moved = [self.stamp(topic, *pair) for pair in zip(stamps.tolist(), log_times.tolist(), strict=True)]
        return np.array(moved, dtype=np.int64)


HEADER_CLOCK = Clock()
"""Header stamps as they are."""


def find_clock(
    log: LogSource,
    scan_times: Mapping[str, tuple[Stamps, Stamps]],
    choice: str,
    options: ClockOptions = DEFAULTS,
) -> Clock:
    """Find out how stamps of scans and poses come onto one clock.

    Args:
        log: The log.
        scan_times: By the topics' names, when each scan was logged and the stamp of its header, (N,) each, in ns.
        choice: One of ClockName: «header» leaves all stamps as they are, «log» takes when messages were logged,
            «auto» moves those onto one clock that are not.
        options: Numbers.

    Returns:
        The clock.

    Raises:
        LogReadError: A message is damaged.
    """
    if choice == ClockName.HEADER:
        return HEADER_CLOCK
    if choice == ClockName.LOG:
        return Clock(all_by_log=True)
    stamped = {name: _without_zeros(*times) for name, times in scan_times.items()}
    clock = _clock_of_stamped(log, {name: times for name, times in stamped.items() if len(times[0])}, options)
    unstamped = [name for name, times in stamped.items() if not len(times[0])]
    if unstamped:
        clock = _with_topics_by_log(clock, unstamped, "0", _lag_of_poses(log, options))
    clock = _with_zeros(clock, scan_times, stamped)
    return _with_poses(log, clock, scan_times, options)


def _without_zeros(logged: Stamps, stamps: Stamps) -> tuple[Stamps, Stamps]:
    return logged[stamps != 0], stamps[stamps != 0]


def _clock_of_stamped(
    log: LogSource, scan_times: Mapping[str, tuple[Stamps, Stamps]], options: ClockOptions
) -> Clock:
    """Return the clock that brings scans, none of them stamped 0, onto that of the poses."""
    if not scan_times:
        return HEADER_CLOCK
    jumps = _jumps(scan_times, options)
    if len(jumps):
        logged, stamps = (np.concatenate(times) for times in zip(*scan_times.values(), strict=True))
        return _clock_with_resets(logged, stamps, jumps)
    lags = {name: _find_lag(*times, options) for name, times in scan_times.items()}
    if all(lag.is_none(options) for lag in lags.values()):
        return HEADER_CLOCK
    reference = _lag_of_poses(log, options)
    return HEADER_CLOCK if reference is None else _clock_of_scans(scan_times, lags, reference, options)


def _clock_of_scans(
    scan_times: Mapping[str, tuple[Stamps, Stamps]],
    lags: Mapping[str, _Lag],
    reference: _Lag,
    options: ClockOptions,
) -> Clock:
    """Return the clock that brings scans onto that of the poses, which are logged ``reference`` late."""
    clock = Clock(lag=reference.median)
    for name, lag in lags.items():
        drifts = lag.drift != 0 and reference.drift == 0
        spread = lag.detrended if drifts else lag.spread
        differs = abs(lag.median - reference.median) > options.max_lag * SECOND or drifts
        if differs and spread <= options.steady * SECOND:
            clock = _with_shift(clock, name, lag, reference.median, drifts)
        elif differs and not _overlaps(*scan_times[name], reference.median):
            clock = _with_topics_by_log(clock, [name], "those of another clock", reference)
    return clock


def _with_shift(clock: Clock, name: str, lag: _Lag, reference: int, drifts: bool) -> Clock:
    """Move the stamps of a topic by a constant lag, and by what a clock drifts."""
    shift = lag.median - reference
    side = "behind" if shift > 0 else "ahead of"
    rate = f" in the middle, by a clock that runs {100 * abs(lag.drift):.2g} % {'slow' if lag.drift > 0 else 'fast'}"
    note = (
        f"{name} is stamped {abs(shift) / SECOND:.3f} s {side} the poses by when both were logged"
        f"{rate * drifts}: its stamps are moved by that; --clock header leaves them"
    )
    return replace(
        clock,
        shifts={**clock.shifts, name: shift},
        drifts={**clock.drifts, name: (lag.middle, lag.drift)} if drifts else clock.drifts,
        notes=(*clock.notes, note),
    )


def _with_topics_by_log(clock: Clock, names: Sequence[str], what: str, reference: _Lag | None) -> Clock:
    """Stamp topics by when their messages were logged, as much earlier as the others are."""
    note = (
        f"the stamps of {', '.join(names)} are {what}: the times at which messages were logged are used; "
        "--clock header leaves them"
    )
    lag = reference.median if reference is not None else clock.lag
    return replace(clock, by_log=clock.by_log | {*names}, lag=lag, notes=(*clock.notes, note))


def _with_zeros(
    clock: Clock,
    scan_times: Mapping[str, tuple[Stamps, Stamps]],
    stamped: Mapping[str, tuple[Stamps, Stamps]],
) -> Clock:
    """Stamp single scans whose stamp is 0 by when they were logged."""
    for name, (logged, stamps) in stamped.items():
        count = len(scan_times[name][0]) - len(logged)
        if not count or not len(logged) or name in clock.by_log:
            continue
        lag = int(np.median(logged - clock.stamps(name, stamps, logged)))
        note = (
            f"{count} of {count + len(logged)} stamps of {name} are 0: the times at which these messages were logged "
            "are used; --clock header leaves them"
        )
        clock = replace(clock, zeros={**clock.zeros, name: lag}, notes=(*clock.notes, note))
    return clock


def _with_poses(
    log: LogSource, clock: Clock, scan_times: Mapping[str, tuple[Stamps, Stamps]], options: ClockOptions
) -> Clock:
    """Move poses that are stamped by another clock than the scans onto that of these."""
    if clock.offsets:
        return clock
    name, (logged, stamps) = next(iter(scan_times.items()))
    reference = _find_lag(logged, clock.stamps(name, stamps, logged), options)
    for topic in _moving_topics(log):
        if topic.messages < MIN_POSES:
            continue
        times = _times(log, topic, options.first)
        if len(times[0]) < MIN_POSES:
            continue
        lag = _find_lag(*times, options)
        if not times[1].any():
            clock = _with_topics_by_log(clock, [topic.name], "0", reference)
        elif (
            abs(lag.median - reference.median) > options.max_pose_lag * SECOND
            and lag.spread <= options.steady * SECOND
        ):
            clock = _with_poses_moved(clock, topic.name, lag.median - reference.median)
    return clock


def _with_poses_moved(clock: Clock, name: str, shift: int) -> Clock:
    side = "behind" if shift > 0 else "ahead of"
    note = (
        f"{name} is stamped {abs(shift) / SECOND:.3f} s {side} the scans by when both were logged: its stamps are "
        "moved by that; --clock header leaves them"
    )
    return replace(clock, shifts={**clock.shifts, name: shift}, notes=(*clock.notes, note))


def _overlaps(logged: Stamps, stamps: Stamps, reference: int) -> bool:
    """Return whether the stamps are any of the times that the poses, which were logged as long, may have."""
    return bool(stamps.min() <= logged.max() - reference and stamps.max() >= logged.min() - reference)


def _jumps(scan_times: Mapping[str, tuple[Stamps, Stamps]], options: ClockOptions) -> Stamps:
    """Return when scans were logged (ns) whose stamp lies far before that of the one before, while log times rise."""
    found = []
    for logged, stamps in scan_times.values():
        back = np.flatnonzero((np.diff(stamps) < -options.min_jump * SECOND) & (np.diff(logged) >= 0)) + 1
        found.append(logged[back])
    jumps = np.unique(np.concatenate(found))
    apart = np.diff(jumps, prepend=-(1 << 62)) > options.min_jump * SECOND  # each scanner sees the same reset
    return jumps[apart]


def _clock_with_resets(logged: Stamps, stamps: Stamps, jumps: Stamps) -> Clock:
    """Return the clock that puts what follows each reset behind what was before, as it was logged."""
    parts = np.searchsorted(jumps, logged, side="right")
    if not np.bincount(parts, minlength=len(jumps) + 1).all():  # messages that are not in the order of their times
        return HEADER_CLOCK
    offsets = [int(np.median(logged[parts == part] - stamps[parts == part])) for part in range(len(jumps) + 1)]
    relative = tuple(offset - offsets[0] for offset in offsets)
    if any(b <= a for a, b in pairwise(relative)):
        return HEADER_CLOCK
    times = ", ".join(f"{(jump - logged.min()) / SECOND:.1f}" for jump in jumps)
    note = (
        f"the clock of the stamps was set back {len(jumps)} time{'s' * (len(jumps) > 1)}, {times} s into the log: "
        "stamps from then on are moved behind those before, as they were logged; --clock header leaves them"
    )
    return Clock(offsets=tuple(offsets), notes=(note,))


@dataclass(frozen=True)
class _Lag:
    """How long after their stamps the messages of a topic are logged.

    Attributes:
        median: Ns.
        spread: Of the middle 90 % (ns).
        drift: What it grows by for each ns of the stamps; 0 where that is not significant.
        detrended: The spread (ns) without the drift.
        middle: The stamp (ns) at which the lag is the median, as far as it grows.
    """

    median: int
    spread: float
    drift: float
    detrended: float
    middle: int

    def is_none(self, options: ClockOptions) -> bool:
        """Return whether messages are logged when they are stamped, but for the time that they take."""
        drifts = self.drift and self.spread > options.steady * SECOND
        return abs(self.median) <= options.max_lag * SECOND and not drifts


def _find_lag(logged: Stamps, stamps: Stamps, options: ClockOptions) -> _Lag:
    """Find how long after their stamps messages are logged, and whether that grows: by a straight line."""
    lags = logged - stamps
    low, middle, high = np.percentile(lags, (5, 50, 95))
    median, centre = int(middle), int(np.median(stamps))
    since = (stamps - centre).astype(float)
    unchanged = _Lag(median, float(high - low), 0.0, float(high - low), centre)
    if len(lags) < options.min_messages or not np.ptp(since):
        return unchanged
    relative = (lags - median).astype(float)
    since_mean, mean = since.mean(), relative.mean()
    slope = float(((since - since_mean) @ (relative - mean)) / ((since - since_mean) @ (since - since_mean)))
    offset = float(mean - slope * since_mean)
    rest = relative - slope * since - offset
    error = float(rest.std()) / (float(since.std()) * math.sqrt(len(lags)))
    growth = abs(slope) * float(np.ptp(since))
    if growth < options.min_drift * SECOND or abs(slope) < options.min_deviations * error:
        return unchanged
    low, high = np.percentile(rest, (5, 95))
    return _Lag(median + round(offset), unchanged.spread, slope, float(high - low), centre)


def _moving_topics(log: LogSource) -> list[Topic]:
    """Return the topics whose stamps say when the robot was where."""
    return [topic for content in MOVING for topic in log.holding(content) if not topic.name.endswith("tf_static")]


def _lag_of_poses(log: LogSource, options: ClockOptions) -> _Lag | None:
    """Return by how much poses are logged after their stamps; None where there are none with a steady clock."""
    for topic in _moving_topics(log):
        times = _times(log, topic, options.sampled)
        if len(times[0]) and times[1].any():
            lag = _find_lag(*times, options)
            if lag.spread <= options.steady * SECOND:
                return lag
    return None


def _times(log: LogSource, topic: Topic, count: int) -> tuple[Stamps, Stamps]:
    """Return when the first messages of a topic were logged, and their stamps (ns)."""
    pairs = []
    for message in log.stamps(topic):
        pairs.append((message.log_time, message.value))
        if len(pairs) == count:
            break
    logged, stamps = np.array(pairs, dtype=np.int64).reshape(-1, 2).T
    return logged, stamps


class ClockedLog:
    """A log whose messages are stamped by one clock: a :class:`prim.log.source.LogSource`.

    Args:
        log: The log.
        clock: The clock.
    """

    def __init__(self, log: LogSource, clock: Clock) -> None:
        self._log = log
        self._clock = clock

    def __enter__(self) -> ClockedLog:
        return self

    def __exit__(self, *exception: object) -> None:
        self._log.__exit__(*exception)

    @property
    def path(self) -> Path:
        """The log's file or folder."""
        return self._log.path

    @property
    def format(self) -> str:
        """Its format, for people."""
        return self._log.format

    @property
    def topics(self) -> Mapping[str, Topic]:
        """The log's topics by name."""
        return self._log.topics

    @property
    def metadata(self) -> Mapping[str, Mapping[str, str]]:
        """The log's metadata records by name."""
        return self._log.metadata

    @property
    def lost(self) -> Sequence[str]:
        """What could not be read so far, for people."""
        return self._log.lost

    @property
    def messages_lost(self) -> int | None:
        """The number of messages that could not be read; None where the log does not say how many there were."""
        return self._log.messages_lost

    @property
    def notes(self) -> Sequence[str]:
        """What a user should know of how the log is read."""
        return [*self._log.notes, *self._clock.notes]

    def attachment(self, name: str) -> bytes | None:
        """See :meth:`prim.log.source.LogSource.attachment`."""
        return self._log.attachment(name)

    def holding(self, *contents: Content) -> list[Topic]:
        """See :meth:`prim.log.source.LogSource.holding`."""
        return self._log.holding(*contents)

    def messages(self, *topics: str) -> Iterator[Message]:
        """See :meth:`prim.log.source.LogSource.messages`."""
        return self._log.messages(*topics)

    def decoded(self, topic: Topic) -> Iterator[tuple[int, Any]]:
        """See :meth:`prim.log.source.LogSource.decoded`."""
        for message in self.numbered(topic):
            yield message.log_time, message.value

    def numbered(self, *topics: Topic, wanted: Container[int] | None = None) -> Iterator[Numbered]:
        """See :meth:`prim.log.source.LogSource.numbered`."""
        for message in self._log.numbered(*topics, wanted=wanted):
            yield message._replace(value=self._restamped(message))

    def stamps(self, *topics: Topic) -> Iterator[Numbered]:
        """See :meth:`prim.log.source.LogSource.stamps`."""
        for message in self._log.stamps(*topics):
            yield message._replace(value=self._clock.stamp(message.topic, message.value, message.log_time))

    def _restamped(self, message: Numbered) -> Any:
        """Return a decoded message with its stamps on the clock."""
        value = message.value
        if isinstance(value, list):
            return [item._replace(stamp=self._stamp(message, item.stamp)) for item in value]
        stamp = self._stamp(message, value.stamp)
        return replace(value, stamp=stamp) if isinstance(value, Scan) else value._replace(stamp=stamp)

    def _stamp(self, message: Numbered, stamp: int) -> int:
        return self._clock.stamp(message.topic, stamp, message.log_time)


def on_clock(log: LogSource, clock: Clock) -> LogSource:
    """Stamp the messages of a log by a clock.

    Args:
        log: The log.
        clock: The clock.

    Returns:
        The log itself where header stamps stay as they are, else one with other stamps.
    """
    return log if clock.keeps_headers else ClockedLog(log, clock)
