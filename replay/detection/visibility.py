"""Which of the wanted objects a map's cells and a scanner's beams can show at all."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from mapping.pyramid import DEFAULTS as PYRAMID
from prim.scan import Scan


@dataclass(frozen=True)
class VisibilityOptions:
    """When objects are too small to be seen; set by hand.

    Attributes:
        scans: Beams are measured in so many scans.
        min_beams: Objects that fewer beams of a scan meet, at the median range, are hardly seen from any number of
            places: the networks were trained on objects of 50 mm that beams 35 mm apart meet.
        tolerance: Sizes that differ by a smaller share are the same.
    """

    scans: int = 40
    min_beams: float = 0.5
    tolerance: float = 0.01


DEFAULTS = VisibilityOptions()


class Visibility:
    """How small an object can be to be seen.

    Args:
        resolution: The side of the finest cells that are searched (m).
        options: Numeric parameters.
    """

    def __init__(self, resolution: float, options: VisibilityOptions = DEFAULTS) -> None:
        self._resolution = resolution
        self._options = options
        self._spacings: list[float] = []

    def add(self, scan: Scan) -> None:
        """Measure how far apart the beams of a scan are at its median range; some scans suffice."""
        measured = scan.ranges[scan.measured]
        if len(self._spacings) < self._options.scans and len(measured):
            self._spacings.append(float(np.median(measured)) * abs(scan.angle_increment))

    def note(self, sizes: tuple[float, float]) -> str:
        """Say which of the wanted objects cannot be seen.

        Args:
            sizes: The smallest and the largest object that is wanted (m).

        Returns:
            What a user should know; empty where all can.
        """
        smallest, largest = sizes
        by_cells = PYRAMID.fewest_cells * self._resolution
        by_beams = self._options.min_beams * float(np.median(self._spacings)) if self._spacings else 0.0
        shown, wanted = max(by_cells, by_beams), smallest * (1 + self._options.tolerance)
        if shown <= wanted:
            return ""
        reasons = []
        if by_cells > wanted:
            reasons.append(f"below {by_cells:.2g} m are less than {PYRAMID.fewest_cells:.0f} cells across")
        if by_beams > wanted:
            reasons.append(f"below {by_beams:.2g} m are missed by every other scan at its median range")
        finer = ""
        if by_cells > wanted:
            finer = f", or finer cells with --resolution {smallest / PYRAMID.fewest_cells:.2g}"
        hint = f"search for those that are shown with --sizes {shown:.2g} {max(largest, 2.5 * shown):.2g}{finer}"
        return f"objects {' and '.join(reasons)}: {hint}"
