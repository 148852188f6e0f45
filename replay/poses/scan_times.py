"""When scans were taken: what poses are wanted for."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from prim.arrays import Stamps


@dataclass(frozen=True)
class ScanTimes:
    """The scans to find poses for: their stamps (N,) in ns, the frame they are given in, and the time (ns) that the
    laser takes from the first beam to the last.
    """

    stamps: Stamps
    frame_id: str
    sweep: int = 0

    @property
    def wanted(self) -> Stamps:
        """When poses are wanted: at every scan's first beam and, where a sweep takes time, at every last one."""
        return np.concatenate((self.stamps, self.stamps + self.sweep)) if self.sweep else self.stamps
