"""The scans of a log that are replayed, with the laser's poses."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from prim.scan import PosedScan, Scan, deskew, mirror_scan
from replay.notes import pluralize
from replay.poses.laser_poses import LaserPoses
from replay.scans.scan_log import ScanLog
from replay.timing import StageTimer


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
        self._endless, self._farthest = False, 0.0

    def __iter__(self) -> Iterator[PosedScan]:
        """Iterate over the scans that have a pose, in the order of the log."""
        for position, scan in self._timer.iterate("read", self.scan_log):
            if self.poses.valid[position]:
                prepared = self._prepared(position, scan)
                pose, end = self.poses.at(position), self.poses.end_at(position)
                pieces = deskew(prepared, pose, end, self._options.deskew_tolerance)
                yield PosedScan(position, prepared, pose, pieces, int(self.scan_log.scanner[position]))

    def notes(self) -> list[str]:
        """Return what a user should know of the poses and of scans that were left out."""
        notes = [*self.poses.notes, *self.scan_log.notes()]
        if self._endless:
            note = "the log gives no longest range: beams without a return say nothing"
            if self._farthest > 0:
                note += (
                    f"; if it is known, give it, as in --max-range {math.ceil(self._farthest)}, which is as far as "
                    "any beam returned from"
                )
            notes.append(note)
        outside = int(np.count_nonzero(~self.poses.valid))
        if outside:
            notes.append(f"{pluralize(outside, 'scan')} outside the time of the poses: not used")
        return notes

    def _prepared(self, position: int, scan: Scan) -> Scan:
        """Limit a scan's range, and mirror it where the laser is mounted upside down."""
        max_range = self._options.max_range
        if max_range is not None and scan.range_max > max_range:
            scan = replace(scan, range_max=max_range)
        if math.isinf(scan.range_max):  # how far it is free where nothing returned is not known
            endless = np.isposinf(scan.ranges)
            self._endless |= bool(endless.any())
            self._farthest = max(self._farthest, float(np.max(scan.ranges, where=scan.measured, initial=0.0)))
            scan = replace(scan, ranges=np.where(endless, np.float32(np.nan), scan.ranges))
        return mirror_scan(scan) if self.poses.is_upside_down(position) else scan
