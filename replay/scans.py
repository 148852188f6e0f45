"""Which scans of a log are replayed: the topic, the time, the stride."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from prim.errors import LogReadError, UsageError
from prim.frames import Scan, Stamps
from prim.log import LogReader, Topic
from prim.messages import SCAN_TYPE, decode_scan, decode_stamp
from replay.localize import ScanTimes


@dataclass(frozen=True)
class Selection:
    """Which scans to replay: seconds after the first scan, a number of scans, every ``stride``-th.

    Raises UsageError on a selection that can hold nothing.
    """

    start: float | None = None
    end: float | None = None
    duration: float | None = None
    n_scans: int | None = None
    stride: int = 1

    def __post_init__(self) -> None:
        if self.end is not None and self.duration is not None:
            raise UsageError("--end and --duration say the same: give one of them")
        if self.stride < 1:
            raise UsageError(f"--stride is {self.stride}: it must be at least 1")
        if self.n_scans is not None and self.n_scans < 1:
            raise UsageError(f"--n-scans is {self.n_scans}: it must be at least 1")
        if self.duration is not None and self.duration <= 0:
            raise UsageError(f"--duration is {self.duration:g}: it must be above 0")
        if self.end is not None and self.end <= (self.start or 0.0):
            raise UsageError(f"--end {self.end:g} is not after --start {self.start or 0:g}")

    def pick(self, stamps: Stamps) -> NDArray[np.intp]:
        """Indices of the selected scans among all, in the log's order."""
        seconds = (stamps - stamps.min()) / 1e9
        start = self.start or 0.0
        end = start + self.duration if self.duration is not None else self.end
        within = (seconds >= start) & (seconds <= (np.inf if end is None else end))
        return np.flatnonzero(within)[:: self.stride][: self.n_scans]


class ScanLog:
    """The scans of one topic of a log. Raises LogReadError where there is none, or more than one to choose from."""

    def __init__(self, log: LogReader, topic: str | None, selection: Selection) -> None:
        self._log = log
        self.topic = _scan_topic(log, topic)
        all_stamps = [stamp for _, stamp in log.decoded(self.topic, decode_stamp)]
        self.total = len(all_stamps)
        stamps = np.array(all_stamps, dtype=np.int64)
        self.indices = selection.pick(stamps) if self.total else np.zeros(0, dtype=np.intp)
        if not len(self.indices):
            span = f"{(stamps.max() - stamps.min()) / 1e9:.1f} s" if self.total else "none"
            what = f"no scan is selected of the {self.total} on {self.topic.name} ({span} in all)"
            raise LogReadError(log.path, what, "give another --start, --end or --duration")
        self.stamps = stamps[self.indices]
        self.first = next(scan for _, scan in self)
        self._check_geometry(self.first)

    @property
    def times(self) -> ScanTimes:
        """When the selected scans were taken, and in which frame."""
        return ScanTimes(self.stamps, self.first.frame_id)

    @property
    def duration(self) -> float:
        """Seconds from the first selected scan to the last."""
        return float(self.stamps.max() - self.stamps.min()) / 1e9

    def __len__(self) -> int:
        return len(self.indices)

    def __iter__(self) -> Iterator[tuple[int, Scan]]:
        """(position among the selected, scan), streamed from the log."""
        wanted = iter(self.indices.tolist())
        upcoming = next(wanted, None)
        position = 0
        for index, message in enumerate(self._log.messages(self.topic.name)):
            if index == upcoming:
                try:
                    scan = decode_scan(message.data)
                except ValueError as error:
                    what = f"scan {index} of {self.topic.name} cannot be decoded: {error}"
                    raise LogReadError(self._log.path, what) from None
                yield position, scan
                position += 1
                upcoming = next(wanted, None)
            # the rest of the log is read all the same, since only its end shows whether messages are missing

    def _check_geometry(self, scan: Scan) -> None:
        if not scan.range_max > max(scan.range_min, 0.0):
            what = f"scans on {self.topic.name} have range_min {scan.range_min:g} and range_max {scan.range_max:g} m"
            raise LogReadError(self._log.path, what, "their range_max must be above range_min and 0")


def turned_over(scan: Scan) -> Scan:
    """The scan of a laser that is mounted upside down, as seen from above."""
    return replace(scan, angle_min=-scan.angle_min, angle_increment=-scan.angle_increment)


def _scan_topic(log: LogReader, wanted: str | None) -> Topic:
    topics = log.of_type(SCAN_TYPE)
    names = ", ".join(topic.name for topic in topics)
    if wanted is not None:
        chosen = [topic for topic in topics if topic.name == wanted]
        if not chosen:
            hint = f"its scan topics: {names}" if topics else _listing(log)
            raise LogReadError(log.path, f"no LaserScan on {wanted}", hint)
        return chosen[0]
    if not topics:
        raise LogReadError(log.path, "no LaserScan in this log", _listing(log))
    if len(topics) > 1:
        raise LogReadError(log.path, f"{len(topics)} scan topics: {names}", "choose one with --scan-topic")
    return topics[0]


def _listing(log: LogReader) -> str:
    topics = sorted(log.topics.values(), key=lambda topic: topic.name)
    listed = ", ".join(f"{topic.name} ({topic.type or topic.encoding})" for topic in topics)
    return f"its topics: {listed}" if listed else "it has no topics at all"
