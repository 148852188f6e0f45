"""Which scans of a log are replayed: the topic, the time, the stride."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from prim.arrays import Stamps
from prim.errors import LogReadError
from prim.log.mcap import LogReader
from prim.log.messages import SCAN_TYPE, decode_scan, decode_stamp
from prim.log.source import Topic
from prim.scan import Scan
from replay.poses.scan_times import ScanTimes
from replay.selection import Selection

LONGEST_SWEEP, OVERLAP = 1.0, 1.5
"""A laser's turn takes no longer (s); nor so many times the time from one scan to the next, where there are two."""


class ScanLog:
    """The scans of one topic of a log. Raises LogReadError where there is none, or more than one to choose from."""

    def __init__(self, log: LogReader, topic: str | None, selection: Selection) -> None:
        self._log = log
        self.topic = _scan_topic(log, topic)
        self.unusable: dict[int, str] = {}
        decodable, stamps = self._read_stamps()
        self.total = len(stamps)
        gaps = np.diff(np.unique(stamps))
        self._longest_sweep = OVERLAP * float(np.median(gaps)) / 1e9 if len(gaps) else LONGEST_SWEEP
        picked = selection.pick(stamps) if self.total else np.zeros(0, dtype=np.intp)
        if not len(picked):
            span = f"{(stamps.max() - stamps.min()) / 1e9:.1f} s" if self.total else "none"
            what = f"no scan is selected of the {self.total} on {self.topic.name} ({span} in all)"
            raise LogReadError(log.path, what, "give another --start, --end or --duration")
        self.indices = decodable[picked]
        self.stamps = stamps[picked]
        self.first = next((scan for _, scan in self), None) or self._none_usable()

    @property
    def times(self) -> ScanTimes:
        """When the selected scans were taken, and in which frame."""
        return ScanTimes(self.stamps, self.first.frame_id, self.sweep)

    @property
    def sweep(self) -> int:
        """The time (ns) from a scan's first beam to its last; 0 where the log does not say, or nothing sensible."""
        return round(self._told_sweep * 1e9) if 0 < self._told_sweep <= self._longest_sweep else 0

    @property
    def _told_sweep(self) -> float:
        """The time (s) from a scan's first beam to its last, as the first scan has it."""
        return self.first.time_increment * (len(self.first.ranges) - 1)

    @property
    def duration(self) -> float:
        """Seconds from the first selected scan to the last."""
        return float(self.stamps.max() - self.stamps.min()) / 1e9

    def __len__(self) -> int:
        return len(self.indices)

    def __iter__(self) -> Iterator[tuple[int, Scan]]:
        """(position among the selected, scan), streamed from the log; unusable scans are left out."""
        positions = {index: position for position, index in enumerate(self.indices.tolist())}
        for index, _, scan in self._log.numbered(self.topic, decode_scan, wanted=positions):
            if scan.problem:
                self.unusable[index] = scan.problem
            else:
                yield positions[index], scan

    def notes(self) -> list[str]:
        """What a user should know of scans that were left out or have odd stamps."""
        notes = []
        if self._told_sweep and not self.sweep:
            notes.append(
                f"scans are not deskewed: by their time_increment a sweep takes {self._told_sweep:.3g} s, where the "
                f"time from one scan to the next allows {self._longest_sweep:.3g} s"
            )
        return notes + self._oddities()

    def _oddities(self) -> list[str]:
        """Scans that were left out or have odd stamps."""
        notes = []
        if self.unusable:
            index, problem = min(self.unusable.items())
            notes.append(f"{counted(len(self.unusable), 'scan')} cannot be used, the first one {index}: {problem}")
        steps = np.diff(self.stamps)
        if (steps < 0).any():
            back = counted(int(np.count_nonzero(steps < 0)), "time")
            notes.append(f"stamps go back {back}: scans are mapped in the order in which they were logged")
        if (steps == 0).any():
            notes.append(f"{counted(int(np.count_nonzero(steps == 0)), 'scan')} with the stamp of the one before")
        return notes

    def _read_stamps(self) -> tuple[NDArray[np.intp], Stamps]:
        """Indices and stamps of the scans whose header can be read."""
        indices, stamps = [], []
        for index, _, stamp in self._log.numbered(self.topic, decode_stamp):
            indices.append(index)
            stamps.append(stamp)
        return np.array(indices, dtype=np.intp), np.array(stamps, dtype=np.int64)

    def _none_usable(self) -> Scan:
        reasons = "; ".join([*self._oddities(), *self._log.lost])
        raise LogReadError(self._log.path, f"no scan on {self.topic.name} can be used: {reasons}")


def counted(count: int, what: str) -> str:
    """1 scan, 2 scans."""
    return f"{count} {what}{'' if count == 1 else 's'}"


def _scan_topic(log: LogReader, wanted: str | None) -> Topic:
    topics = log.of_type(SCAN_TYPE)
    names = ", ".join(topic.name for topic in topics)
    if wanted is not None:
        chosen = [topic for topic in topics if topic.name == wanted]
        if not chosen:
            hint = f"its scan topics: {names}" if topics else _listing(log)
            empty = wanted in log.topics and log.topics[wanted].type == SCAN_TYPE
            what = f"no messages on {wanted}" if empty else f"no LaserScan on {wanted}"
            raise LogReadError(log.path, what, hint)
        return chosen[0]
    if not topics:
        empty_topics = [topic.name for topic in log.topics.values() if topic.type == SCAN_TYPE]
        if empty_topics:
            raise LogReadError(log.path, f"no messages on {', '.join(empty_topics)}", *log.lost)
        raise LogReadError(log.path, "no LaserScan in this log", _listing(log))
    if len(topics) > 1:
        raise LogReadError(log.path, f"{len(topics)} scan topics: {names}", "choose one with --scan-topic")
    return topics[0]


def _listing(log: LogReader) -> str:
    topics = sorted(log.topics.values(), key=lambda topic: topic.name)
    listed = ", ".join(f"{topic.name} ({topic.type or topic.encoding})" for topic in topics)
    return f"its topics: {listed}" if listed else "it has no topics at all"
