"""Wording of notes and tables."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from detect.detection import SensorErrors


def pluralize(count: int, noun: str) -> str:
    """Return a count with its noun.

    Args:
        count: The number.
        noun: The noun in the singular, whose plural ends with «s».

    Returns:
        Such as «1 scan» or «2 scans».
    """
    return f"{count} {noun}{'' if count == 1 else 's'}"


def sensor_notes(errors: SensorErrors | None) -> list[str]:
    """Describe the errors of the scanner that refinement corrected; empty where there are none."""
    if errors is None:
        return []
    notes = []
    if errors.range_bias_std is not None:
        length, std = abs(errors.range_bias) * 1000, errors.range_bias_std * 1000
        word = "long" if errors.range_bias > 0 else "short"
        notes.append(f"ranges are {length:.1f} ± {std:.1f} mm too {word}: corrected for primitives, not in the map")
    if errors.nearest_within:
        width = math.degrees(errors.nearest_within)
        notes.append(f"beams are {width:.1f}° wide, and read the nearest surface: corrected for primitives")
    if errors.mixed_within:
        width = math.degrees(errors.mixed_within)
        notes.append(f"beams at edges, {width:.1f}° wide, read ranges between two surfaces: left out for primitives")
    return notes
