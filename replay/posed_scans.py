"""The scans of a log that are replayed: which ones, and with the laser's poses."""

from __future__ import annotations

import copy
import math
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from prim.arrays import Stamps
from prim.errors import LogReadError
from prim.log.messages import SCAN_TYPE, decode_scan, decode_stamp
from prim.log.source import LogSource, Topic
from prim.scan import PosedScan, Scan, deskew, mirror_scan
from replay.notes import pluralize
from replay.poses.laser_poses import BeamTimes, LaserPoses, ScanTimes
from replay.selection import Selection
from replay.timing import StageTimer

MAX_SWEEP = 1.0
"""The longest plausible sweep (s) in a log of one scan; set by hand."""

LONGEST_SWEEP = 3600.0
"""No sweep takes longer (s), however far apart scans are; set by hand."""

MAX_SWEEP_RATIO = 1.5
"""The longest plausible sweep over the median time from one scan to the next; set by hand."""


class ScanLog:
    """The selected scans of one topic of a log, streamed.

    Args:
        log: The log.
        topic: The topic of scans; None where the log has only one.
        selection: Which of the topic's scans are wanted.

    Attributes:
        topic: The topic in use.
        total: The number of scans on the topic whose header can be read.
        stamps: Stamps (N,) of the selected scans (ns).
        first: The first usable scan of the selection.
        unusable: The scans met so far that cannot be used: index on the topic and reason.

    Raises:
        LogReadError: There is no topic of scans, more than one to choose from, or no usable scan in the selection.
    """

    def __init__(self, log: LogSource, topic: str | None, selection: Selection) -> None:
        self._log = log
        self.topic = _scan_topic(log, topic)
        self.unusable: dict[int, str] = {}
        decodable, stamps = self._read_stamps()
        self.total = len(stamps)
        gaps = np.diff(np.unique(stamps))
        usual = MAX_SWEEP_RATIO * float(np.median(gaps)) / 1e9 if len(gaps) else MAX_SWEEP
        self._max_sweep = min(usual, LONGEST_SWEEP)
        selected = selection.select(stamps) if self.total else np.zeros(0, dtype=np.intp)
        if not len(selected):
            span = f"{(stamps.max() - stamps.min()) / 1e9:.1f} s" if self.total else "none"
            what = f"no scan is selected of the {self.total} on {self.topic.name} ({span} in all)"
            raise LogReadError(log.path, what, "give another --start, --end or --duration")
        self._offset, self._is_reversed = 0, False
        self._iterated: NDArray[np.intp] | None = None
        self._indices = decodable[selected]
        self.stamps = stamps[selected]
        self.first = next((scan for _, scan in self), None) or self._none_usable()

    @property
    def path(self) -> Path:
        """The log's path."""
        return self._log.path

    @property
    def times(self) -> ScanTimes:
        """The times of the selected scans, and the frame that they are given in."""
        return ScanTimes(self.stamps, self.first.frame_id, self.sweep)

    @property
    def sweep(self) -> int:
        """The time (ns) from a scan's first beam to its last; 0 where it is not given or not plausible.

        It is negative where beams run against time.
        """
        return round(self._given_sweep * 1e9) if 0 < abs(self._given_sweep) <= self._max_sweep else 0

    def retimed(self, times: BeamTimes) -> ScanLog:
        """Return the scans with stamps (those of the first beams) and time increments by other times of their beams.

        Args:
            times: When beams are measured, relative to the stamps in the log.

        Returns:
            The scans; unchanged where a sweep takes no plausible time.
        """
        assert not self._offset and not self._is_reversed
        retimed = copy.copy(self)
        retimed._offset = round(times.first * abs(self.sweep))
        retimed._is_reversed = (times.last - times.first) * self.sweep < 0
        retimed.stamps = self.stamps + retimed._offset
        retimed.first = retimed._with_times(self.first)
        return retimed

    @property
    def _given_sweep(self) -> float:
        """The time (s) from a scan's first beam to its last by the first scan's time_increment."""
        return self.first.time_increment * (len(self.first.ranges) - 1)

    def duration(self, count: int | None = None) -> float:
        """Return the time from the earliest to the latest (s) of the first ``count`` selected scans; None: of all."""
        stamps = self.stamps[:count]
        return float(stamps.max() - stamps.min()) / 1e9 if len(stamps) else 0.0

    def __len__(self) -> int:
        return len(self._indices)

    def __iter__(self) -> Iterator[tuple[int, Scan]]:
        """Iterate over (position in the selection, scan), read from the log; unusable scans are left out."""
        positions = {index: position for position, index in enumerate(self._indices.tolist())}
        if self._iterated is not None:
            positions = {int(self._indices[position]): position for position in self._iterated.tolist()}
        for index, _, scan in self._log.numbered(self.topic, decode_scan, wanted=positions):
            if scan.problem:
                self.unusable[index] = scan.problem
            else:
                yield positions[index], self._with_times(scan)

    def only(self, positions: NDArray[np.intp]) -> ScanLog:
        """Return the same scans, of which only those at these positions (M,) are iterated over."""
        only = copy.copy(self)
        only._iterated = positions
        return only

    def _with_times(self, scan: Scan) -> Scan:
        """Return a scan with its first beam's stamp and its time increment, where these are not those in the log."""
        if not self._offset and not self._is_reversed:
            return scan
        increment = -scan.time_increment if self._is_reversed else scan.time_increment
        return replace(scan, stamp=scan.stamp + self._offset, time_increment=increment)

    def notes(self) -> list[str]:
        """Return what a user should know of scans that were left out, not deskewed, or have irregular stamps."""
        notes = []
        if self._given_sweep and not self.sweep and math.isfinite(self._given_sweep):
            notes.append(
                f"scans are not deskewed: by their time_increment a sweep takes {self._given_sweep:.3g} s, where the "
                f"time from one scan to the next allows {self._max_sweep:.3g} s"
            )
        return notes + self._irregularities()

    def _irregularities(self) -> list[str]:
        """Describe scans that were left out or have irregular stamps."""
        notes = []
        if self.unusable:
            index, problem = min(self.unusable.items())
            notes.append(f"{pluralize(len(self.unusable), 'scan')} cannot be used, the first one {index}: {problem}")
        steps = np.diff(self.stamps)
        if (steps < 0).any():
            back = pluralize(int(np.count_nonzero(steps < 0)), "time")
            notes.append(f"stamps go back {back}: scans are mapped in the order in which they were logged")
        if (steps == 0).any():
            notes.append(f"{pluralize(int(np.count_nonzero(steps == 0)), 'scan')} with the stamp of the one before")
        return notes

    def _read_stamps(self) -> tuple[NDArray[np.intp], Stamps]:
        """Read the indices and stamps (ns) of the scans whose header can be read."""
        indices, stamps = [], []
        for index, _, stamp in self._log.numbered(self.topic, decode_stamp):
            indices.append(index)
            stamps.append(stamp)
        return np.array(indices, dtype=np.intp), np.array(stamps, dtype=np.int64)

    def _none_usable(self) -> Scan:
        reasons = "; ".join([*self._irregularities(), *self._log.lost])
        raise LogReadError(self._log.path, f"no scan on {self.topic.name} can be used: {reasons}")


@dataclass(frozen=True)
class PosedScanOptions:
    """How scans are prepared for mapping.

    Attributes:
        deskew_tolerance: A scan is cut so that the laser's motion displaces a measured point within one piece by no
            more than this (m); the default is half a cell of the default resolution.
        max_range: Ranges beyond this count as no return (m); None for the scanner's own range_max.
    """

    deskew_tolerance: float = 0.005
    max_range: float | None = None


DEFAULT_OPTIONS = PosedScanOptions()


class PosedScans:
    """The scans of a log that have a pose, ready to be mapped; may be iterated over any number of times.

    Scans of a laser that is mounted upside down are mirrored, and all are cut into pieces that have a pose of their
    own where the laser moves during a sweep.

    Args:
        scan_log: The scans.
        poses: The laser's poses at these scans.
        options: How the scans are prepared.
        timer: Counts the time of reading towards the stage «read».
    """

    def __init__(
        self,
        scan_log: ScanLog,
        poses: LaserPoses,
        options: PosedScanOptions = DEFAULT_OPTIONS,
        timer: StageTimer | None = None,
    ) -> None:
        self.scan_log = scan_log
        self.poses = poses
        self._options = options
        self._timer = timer or StageTimer()

    def __iter__(self) -> Iterator[PosedScan]:
        """Iterate over the scans that have a pose, in the order of the log."""
        for position, scan in self._timer.iterate("read", self.scan_log):
            if self.poses.valid[position]:
                prepared = self._prepared(scan)
                pose, end = self.poses.at(position), self.poses.end_at(position)
                pieces = deskew(prepared, pose, end, self._options.deskew_tolerance)
                yield PosedScan(position, prepared, pose, pieces)

    def notes(self) -> list[str]:
        """Return what a user should know of the poses and of scans that were left out."""
        notes = [*self.poses.notes, *self.scan_log.notes()]
        outside = int(np.count_nonzero(~self.poses.valid))
        if outside:
            notes.append(f"{pluralize(outside, 'scan')} outside the time of the poses: not used")
        return notes

    def _prepared(self, scan: Scan) -> Scan:
        """Limit a scan's range, and mirror it where the laser is mounted upside down."""
        max_range = self._options.max_range
        if max_range is not None and scan.range_max > max_range:
            scan = replace(scan, range_max=max_range)
        return mirror_scan(scan) if self.poses.upside_down else scan


def _scan_topic(log: LogSource, wanted: str | None) -> Topic:
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
            raise LogReadError(log.path, f"no messages on {', '.join(empty_topics)}", "; ".join(log.lost))
        raise LogReadError(log.path, "no LaserScan in this log", _listing(log))
    if len(topics) > 1:
        raise LogReadError(log.path, f"{len(topics)} scan topics: {names}", "choose one with --scan-topic")
    return topics[0]


def _listing(log: LogSource) -> str:
    topics = sorted(log.topics.values(), key=lambda topic: topic.name)
    listed = ", ".join(f"{topic.name} ({topic.type or topic.encoding})" for topic in topics)
    return "; ".join([f"its topics: {listed}" if listed else "it has no topics at all", *log.lost])
