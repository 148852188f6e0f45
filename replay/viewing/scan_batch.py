"""Scans that are gathered to be sent to the viewer together: a batch costs little more than one scan."""

from __future__ import annotations

import time
from typing import NamedTuple

from prim.arrays import FloatArray
from prim.se2 import Pose2D

MAX_SCANS = 100
"""A batch is sent when it holds so many scans; set by hand."""

MAX_AGE = 0.1
"""While somebody is watching, a batch is sent when its first scan is older than this (s); set by hand."""


class ScanEntry(NamedTuple):
    """One scan as it is drawn.

    Attributes:
        position: The scan's position in the selection.
        stamp: Its stamp (ns).
        pose: The laser's pose.
        points: End points (M, 2) in the map frame (m).
        scanner: Which of the scanners took it, from 0.
    """

    position: int
    stamp: int
    pose: Pose2D
    points: FloatArray
    scanner: int = 0


class ScanBatch:
    """Gathers scans until they are due.

    Args:
        live: Every scan is due at once.
        watched: Somebody is watching: scans are due after MAX_AGE.
    """

    def __init__(self, live: bool, watched: bool) -> None:
        self._max_scans = 1 if live else MAX_SCANS
        self._max_age = MAX_AGE if watched else float("inf")
        self._entries: list[ScanEntry] = []
        self._started = 0.0

    def add(self, entry: ScanEntry) -> bool:
        """Add a scan; return whether the batch is due."""
        if not self._entries:
            self._started = time.perf_counter()
        self._entries.append(entry)
        return len(self._entries) >= self._max_scans or time.perf_counter() - self._started > self._max_age

    def take(self) -> list[ScanEntry]:
        """Return the scans gathered so far, and begin anew."""
        entries, self._entries = self._entries, []
        return entries
