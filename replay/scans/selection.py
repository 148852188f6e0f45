"""Which scans of a log are replayed."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from prim.arrays import Stamps
from prim.errors import UsageError


@dataclass(frozen=True)
class Selection:
    """Which scans to replay.

    Attributes:
        start: Seconds from the log's earliest scan to the first that is wanted.
        end: Seconds from the log's earliest scan to the last that is wanted; excludes ``duration``.
        duration: Seconds from ``start`` to the last scan that is wanted.
        n_scans: The largest number of scans.
        stride: Every ``stride``-th scan is taken.

    Raises:
        UsageError: The selection cannot contain anything.
    """

    start: float | None = None
    end: float | None = None
    duration: float | None = None
    n_scans: int | None = None
    stride: int = 1

    def __post_init__(self) -> None:
        if self.end is not None and self.duration is not None:
            raise UsageError("--end and --duration say the same: give one of them")
        for name, value in (("--start", self.start), ("--end", self.end), ("--duration", self.duration)):
            if value is not None and not math.isfinite(value):
                raise UsageError(f"{name} is {value:g}: it must be a number of seconds")
        if self.start is not None and self.start < 0:
            raise UsageError(f"--start is {self.start:g}: seconds are counted from the first scan on")
        if self.stride < 1:
            raise UsageError(f"--stride is {self.stride}: it must be at least 1")
        if self.n_scans is not None and self.n_scans < 1:
            raise UsageError(f"--n-scans is {self.n_scans}: it must be at least 1")
        if self.duration is not None and self.duration <= 0:
            raise UsageError(f"--duration is {self.duration:g}: it must be above 0")
        if self.end is not None and self.end <= (self.start or 0.0):
            raise UsageError(f"--end {self.end:g} is not after --start {self.start or 0:g}")

    def select(self, stamps: Stamps) -> NDArray[np.intp]:
        """Return the indices of the selected scans among those with ``stamps`` (N,) in ns, in the log's order."""
        seconds = (stamps - stamps.min()) / 1e9
        start = self.start or 0.0
        end = start + self.duration if self.duration is not None else self.end
        within = (seconds >= start) & (seconds <= (np.inf if end is None else end))
        return np.flatnonzero(within)[:: self.stride][: self.n_scans]
