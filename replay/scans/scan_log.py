"""The selected scans of a log, of one scanner or of several, streamed."""

from __future__ import annotations

import copy
import math
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from prim.arrays import Stamps
from prim.choices import ClockName
from prim.errors import LogReadError
from prim.log.decoding.codecs import Content
from prim.log.source import LogSource, Topic
from prim.scan import Scan, reconciled_angles
from prim.text import listed
from replay.notes import pluralize
from replay.poses.laser_poses import BeamTimes, ScanTimes
from replay.scans.clock import find_clock, on_clock
from replay.scans.clouds import CloudSlicer
from replay.scans.selection import Selection
from replay.scans.topics import choose_scan_topics

MAX_SWEEP = 1.0
"""The longest plausible sweep (s) in a log of one scan; set by hand."""

LONGEST_SWEEP = 3600.0
"""No sweep takes longer (s), however far apart scans are; set by hand."""

MAX_SWEEP_RATIO = 1.5
"""The longest plausible sweep over the median time from one scan to the next; set by hand."""


@dataclass(frozen=True)
class Scanner:
    """One of the scanners whose scans are replayed.

    Attributes:
        topic: Its topic.
        first: Its first usable scan in the selection.
        max_sweep: The longest plausible time of a sweep (s).
    """

    topic: Topic
    first: Scan
    max_sweep: float

    @property
    def given_sweep(self) -> float:
        """The time (s) from a scan's first beam to its last by the first scan's time_increment."""
        return self.first.time_increment * (len(self.first.ranges) - 1)

    @property
    def sweep(self) -> int:
        """The time (ns) from a scan's first beam to its last; 0 where it is not given or not plausible.

        It is negative where beams run against time.
        """
        return round(self.given_sweep * 1e9) if 0 < abs(self.given_sweep) <= self.max_sweep else 0


@dataclass(frozen=True)
class ScanLogOptions:
    """How the scans of a log are read.

    Attributes:
        topics: The topics of scans; none: found by type.
        clock: One of ClockName: which clock they are stamped by.
        heights: The lowest and the highest z (m, in the sensor's frame) of the points of a cloud that are used; None:
            all points of a planar scanner.
    """

    topics: tuple[str, ...] = ()
    clock: str = ClockName.AUTO.value
    heights: tuple[float, float] | None = None


DEFAULT_OPTIONS = ScanLogOptions()


class ScanLog:
    """The selected scans of a log, streamed in the order in which they were logged.

    Args:
        log: The log.
        selection: Which of the scans are wanted.
        options: The topics of the scans, their clock, the heights of points.

    Attributes:
        log: The log, its messages stamped by the clock that is used.
        topics: The topics in use.
        total: The number of scans on these topics whose header can be read.
        stamps: Stamps (N,) of the selected scans (ns).
        scanner: By which of the scanners each selected scan (N,) was taken.
        scanners: The scanners, in the order of their topics; those without a scan in the selection are left out.
        unusable: The scans met so far that cannot be used: number among the scans of these topics, and reason.

    Raises:
        LogReadError: There is no topic of scans, several to choose from, or no usable scan in the selection.
    """

    def __init__(self, log: LogSource, selection: Selection, options: ScanLogOptions = DEFAULT_OPTIONS) -> None:
        self.topics, self._topic_notes = choose_scan_topics(log, options.topics)
        self.log = log
        self.unusable: dict[int, str] = {}
        self._contradictions: dict[str, set[int]] = {}
        self._offsets: Stamps | None = None
        self._is_reversed = False
        self._iterated: NDArray[np.intp] | None = None
        self._slicers = {
            topic.name: CloudSlicer(options.heights, self._refusal)
            for topic in self.topics
            if topic.content is Content.CLOUD
        }
        if options.heights is not None and not self._slicers:
            raise LogReadError(log.path, f"no point clouds on {self.names}", "--slice goes with point clouds alone")
        numbers, scanner, stamps = self._read_stamps(options.clock)
        self.total = len(stamps)
        selected = selection.select(stamps) if self.total else np.zeros(0, dtype=np.intp)
        if not self.total:
            raise LogReadError(log.path, f"no scan on {self.names} can be decoded", "; ".join(log.lost))
        if not len(selected):
            span = (stamps.max() - stamps.min()) / 1e9
            what = f"no scan is selected of the {self.total} on {self.names} ({span:.1f} s in all)"
            raise LogReadError(log.path, what, "begin with the first one: --start 0")
        self._numbers = numbers[selected]
        self.stamps = stamps[selected]
        self.scanner = scanner[selected]
        self.scanners = self._find_scanners(stamps, scanner)

    @property
    def path(self) -> Path:
        """The log's path."""
        return self.log.path

    @property
    def names(self) -> str:
        """The names of the topics, for people."""
        return listed(topic.name for topic in self.topics)

    @property
    def first(self) -> Scan:
        """The first usable scan of the first scanner."""
        return self.scanners[0].first

    @property
    def expected_rays(self) -> int:
        """The number of rays of the selected scans, if each scanner's have as many as its first one."""
        beams = np.array([len(scanner.first.ranges) for scanner in self.scanners])
        return int(beams[self.scanner].sum())

    @property
    def times(self) -> ScanTimes:
        """The times of the selected scans, and the frames that they are given in."""
        return ScanTimes(
            self.stamps,
            tuple(scanner.first.frame_id for scanner in self.scanners),
            tuple(scanner.sweep for scanner in self.scanners),
            self.scanner,
            tuple(scanner.topic.name for scanner in self.scanners),
        )

    @property
    def sweep(self) -> int:
        """The time (ns) from the first beam to the last of the first scanner's scans; see :attr:`Scanner.sweep`."""
        return self.scanners[0].sweep

    def retimed(self, times: BeamTimes) -> ScanLog:
        """Return the scans with stamps (those of the first beams) and time increments by other times of their beams.

        Args:
            times: When beams are measured, relative to the stamps in the log.

        Returns:
            The scans; unchanged where a sweep takes no plausible time.
        """
        sweeps = np.array([scanner.sweep for scanner in self.scanners], dtype=np.int64)
        retimed = copy.copy(self)
        retimed._offsets = np.rint(times.first * np.abs(sweeps)).astype(np.int64)
        retimed._is_reversed = (times.last - times.first) * self.sweep < 0
        retimed.stamps = self.stamps + retimed._offsets[self.scanner]
        retimed.scanners = tuple(
            replace(scanner, first=retimed._with_times(scanner.first, k)) for k, scanner in enumerate(self.scanners)
        )
        return retimed

    def only(self, positions: NDArray[np.intp]) -> ScanLog:
        """Return the same scans, of which only those at these positions (M,) are iterated over."""
        only = copy.copy(self)
        only._iterated = positions
        return only

    def duration(self, count: int | None = None) -> float:
        """Return the time from the earliest to the latest (s) of the first ``count`` selected scans; None: of all."""
        stamps = self.stamps[:count]
        return float(stamps.max() - stamps.min()) / 1e9 if len(stamps) else 0.0

    def __len__(self) -> int:
        return len(self._numbers)

    def __iter__(self) -> Iterator[tuple[int, Scan]]:
        """Iterate over (position in the selection, scan), read from the log; unusable scans are left out."""
        chosen = range(len(self._numbers)) if self._iterated is None else self._iterated.tolist()
        positions = {int(self._numbers[position]): position for position in chosen}
        for number, topic, _, value in self.log.numbered(*self.topics, wanted=positions):
            scan = self._as_scan(number, topic, value)
            if scan.problem:
                self.unusable[number] = scan.problem
            else:
                position = positions[number]
                yield position, self._with_times(scan, int(self.scanner[position]))

    def _as_scan(self, number: int, topic: str, value: Any) -> Scan:
        """Return a message's scan; its angles are those of its ends where its increment contradicts these."""
        scan: Scan = self._slicers[topic].scan(value) if topic in self._slicers else value
        reconciled, contradiction = reconciled_angles(scan)
        if contradiction is not None:
            self._contradictions.setdefault(contradiction, set()).add(number)
        return reconciled

    def _with_times(self, scan: Scan, scanner: int) -> Scan:
        """Return a scan with its first beam's stamp and its time increment, where these are not those in the log."""
        if self._offsets is None:
            return scan
        increment = -scan.time_increment if self._is_reversed else scan.time_increment
        return replace(scan, stamp=scan.stamp + int(self._offsets[scanner]), time_increment=increment)

    def notes(self) -> list[str]:
        """Return what a user should know of the topics, and of scans that were left out, changed or irregular."""
        notes = [*self.log.notes, *self._topic_notes]
        notes += [
            f"scans are not deskewed: by their time_increment a sweep takes {scanner.given_sweep:.3g} s, where the "
            f"time from one scan to the next allows {scanner.max_sweep:.3g} s"
            for scanner in self.scanners
            if scanner.given_sweep and not scanner.sweep and math.isfinite(scanner.given_sweep)
        ]
        notes += [what.format(pluralize(len(scans), "scan")) for what, scans in self._contradictions.items()]
        return notes + self._irregularities()

    def _irregularities(self) -> list[str]:
        """Describe scans that were left out or have irregular stamps."""
        notes = []
        if self.unusable:
            number, problem = min(self.unusable.items())
            notes.append(f"{pluralize(len(self.unusable), 'scan')} cannot be used, the first one {number}: {problem}")
        of_each = [np.diff(self.stamps[self.scanner == k]) for k in np.unique(self.scanner)]
        steps = np.concatenate(of_each)
        if (steps < 0).any():
            back = pluralize(int(np.count_nonzero(steps < 0)), "time")
            notes.append(f"stamps go back {back}: scans are mapped in the order in which they were logged")
        if (steps == 0).any():
            notes.append(f"{pluralize(int(np.count_nonzero(steps == 0)), 'scan')} with the stamp of the one before")
        return notes

    def _read_stamps(self, clock: str) -> tuple[NDArray[np.intp], NDArray[np.intp], Stamps]:
        """Read the numbers, the scanners and the stamps (ns) of the scans whose header can be read."""
        index = {topic.name: k for k, topic in enumerate(self.topics)}
        rows = [
            (number, index[name], log_time, stamp) for number, name, log_time, stamp in self.log.stamps(*self.topics)
        ]
        numbers, scanner, logged, stamps = np.array(rows, dtype=np.int64).reshape(-1, 4).T
        times = {
            topic.name: (logged[scanner == k], stamps[scanner == k])
            for k, topic in enumerate(self.topics)
            if (scanner == k).any()
        }
        if times:
            found = find_clock(self.log, times, clock)
            self.log = on_clock(self.log, found)
            if not found.keeps_headers:
                names = [topic.name for topic in self.topics]
                moved = zip(scanner.tolist(), stamps.tolist(), logged.tolist(), strict=True)
                stamps = np.array([found.stamp(names[k], stamp, time) for k, stamp, time in moved], dtype=np.int64)
        return numbers.astype(np.intp), scanner.astype(np.intp), stamps

    def _find_scanners(self, stamps: Stamps, scanner: NDArray[np.intp]) -> tuple[Scanner, ...]:
        """Find the scanners that have a usable scan in the selection, and number those of the scans by them."""
        firsts = self._first_scans()
        if not firsts:
            self._none_usable()
        scanners = tuple(Scanner(self.topics[k], firsts[k], _max_sweep(stamps[scanner == k])) for k in sorted(firsts))
        renumbered = np.zeros(len(self.topics), dtype=np.intp)
        renumbered[sorted(firsts)] = np.arange(len(firsts))
        self.scanner = renumbered[self.scanner]
        return scanners

    def _first_scans(self) -> dict[int, Scan]:
        """Return the first usable scan of each topic in the selection."""
        firsts: dict[int, Scan] = {}
        expected = Counter(self.scanner.tolist()).keys()
        for position, scan in self:
            firsts.setdefault(int(self.scanner[position]), scan)
            if len(firsts) == len(expected):
                break
        return firsts

    def _none_usable(self) -> None:
        reasons = "; ".join([*self._irregularities(), *self.log.lost])
        raise LogReadError(self.log.path, f"no scan on {self.names} can be used: {reasons}")

    def _refusal(self, what: str, hint: str) -> LogReadError:
        return LogReadError(self.log.path, what, hint)


def _max_sweep(stamps: Stamps) -> float:
    """Return the longest plausible time (s) of a sweep by the stamps (ns) of a scanner's scans."""
    gaps = np.diff(np.unique(stamps))
    usual = MAX_SWEEP_RATIO * float(np.median(gaps)) / 1e9 if len(gaps) else MAX_SWEEP
    return min(usual, LONGEST_SWEEP)
