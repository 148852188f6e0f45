"""The clocks of a log: header stamps that the rest can rely on, whatever clock each device wrote them by.

What a message was logged at is one clock for all topics. Where the stamps in the headers disagree with each other by
it (a device that counts from its start, stamps of 0, a simulation that was reset), they are moved onto one clock.
"""

from __future__ import annotations

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


@dataclass(frozen=True)
class ClockOptions:
    """The numbers by which clocks are distinguished; set by hand."""

    max_lag: float = 0.5
    """Clocks that differ by less (s) are the same: messages take that long until they are logged."""

    steady: float = 0.25
    """Header stamps are on a steady clock where most (the middle 90 %) are within this (s) of the log's times."""

    min_jump: float = 1.0
    """Stamps that go back by less (s) are messages that arrived in another order."""

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
        offsets: What is added to stamps (ns) from the start on and after each reset of the clock; the one is used by
            which a message's stamp is nearest to when it was logged.
        notes: What a user should know.
    """

    by_log: frozenset[str] = frozenset()
    all_by_log: bool = False
    lag: int = 0
    shifts: Mapping[str, int] = field(default_factory=dict)
    offsets: tuple[int, ...] = ()
    notes: tuple[str, ...] = ()

    @property
    def keeps_headers(self) -> bool:
        """Whether the header stamps stay as they are."""
        return not (self.by_log or self.all_by_log or self.shifts or self.offsets)

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
        if self.offsets:
            return min((stamp + offset for offset in self.offsets), key=lambda moved: abs(moved - log_time))
        return stamp + self.shifts.get(topic, 0)


HEADER_CLOCK = Clock()
"""Header stamps as they are."""


def find_clock(
    log: LogSource,
    topics: Sequence[Topic],
    scan_times: Mapping[str, tuple[Stamps, Stamps]],
    choice: str,
    options: ClockOptions = DEFAULTS,
) -> Clock:
    """Find out how stamps of scans and poses come onto one clock.

    Args:
        log: The log.
        topics: The topics of scans.
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
    logged, stamps = (np.concatenate(times) for times in zip(*scan_times.values(), strict=True))
    jumps = _jumps(scan_times, options)
    if len(jumps):
        return _clock_with_resets(logged, stamps, jumps)
    max_lag = options.max_lag * SECOND
    lags = {name: _lag(*times) for name, times in scan_times.items()}
    if all(abs(lag) <= max_lag and stamps.any() for lag, _ in lags.values()):
        return HEADER_CLOCK
    reference = _lag_of_poses(log, options)
    if reference is None:
        return HEADER_CLOCK if stamps.any() else Clock(frozenset(lags), notes=(_by_log_note(list(lags), "0"),))
    return _clock_of_scans(topics, scan_times, lags, reference, options)


def _clock_of_scans(
    topics: Sequence[Topic],
    scan_times: Mapping[str, tuple[Stamps, Stamps]],
    lags: Mapping[str, tuple[int, float]],
    reference: int,
    options: ClockOptions,
) -> Clock:
    """Return the clock that brings scans onto that of the poses, which are logged ``reference`` ns late."""
    by_log: list[str] = []
    shifts: dict[str, int] = {}
    notes: list[str] = []
    for name in (topic.name for topic in topics):
        lag, spread = lags[name]
        differs = abs(lag - reference) > options.max_lag * SECOND
        if not scan_times[name][1].any():
            by_log.append(name)
        elif differs and spread <= options.steady * SECOND:
            shifts[name] = lag - reference
            side = "behind" if shifts[name] > 0 else "ahead of"
            notes.append(
                f"{name} is stamped {abs(shifts[name]) / SECOND:.3f} s {side} the poses by when both were logged: "
                "its stamps are moved by that; --clock header leaves them"
            )
        elif differs and not _overlaps(*scan_times[name], reference):
            by_log.append(name)
    if by_log:
        what = "0" if not any(scan_times[name][1].any() for name in by_log) else "those of another clock"
        notes.append(_by_log_note(by_log, what))
    return Clock(frozenset(by_log), lag=reference, shifts=shifts, notes=tuple(notes))


def _overlaps(logged: Stamps, stamps: Stamps, reference: int) -> bool:
    """Return whether the stamps are any of the times that the poses, which were logged as long, may have."""
    return bool(stamps.min() <= logged.max() - reference and stamps.max() >= logged.min() - reference)


def _by_log_note(names: Sequence[str], what: str) -> str:
    return (
        f"the stamps of {', '.join(names)} are {what}: the times at which messages were logged are used; "
        "--clock header leaves them"
    )


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


def _lag(logged: Stamps, stamps: Stamps) -> tuple[int, float]:
    """Return how long after their stamps messages are logged (ns): the median, and the spread of the middle 90 %."""
    lags = logged - stamps
    low, middle, high = np.percentile(lags, (5, 50, 95))
    return int(middle), float(high - low)


def _lag_of_poses(log: LogSource, options: ClockOptions) -> int | None:
    """Return by how much poses are logged after their stamps (ns); None where there are none with a steady clock."""
    for content in MOVING:
        for topic in log.holding(content):
            if topic.name.endswith("tf_static"):
                continue
            times = _times(log, topic, options.sampled)
            if len(times[0]) and times[1].any():
                lag, spread = _lag(*times)
                if spread <= options.steady * SECOND:
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
