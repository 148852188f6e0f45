"""A rough estimate of the range noise from the ranges alone, without a map."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from prim.errors import UsageError
from prim.normal import NORMAL_MAD


@dataclass(frozen=True)
class NoiseBounds:
    """The range noise that a user may give; set by hand.

    Attributes:
        least: M; a scanner's clock resolves no less.
        largest: M.
    """

    least: float = 1e-6
    largest: float = 100.0


DEFAULTS = NoiseBounds()


@dataclass(frozen=True)
class NoiseOptions:
    """How noise is estimated without a map.

    Attributes:
        most_ranges: Of more ranges, evenly spread pairs are used, about so many: all would take memory.
    """

    most_ranges: int = 1_000_000


OPTIONS = NoiseOptions()


def check_noise(noise_std: float, bounds: NoiseBounds = DEFAULTS) -> None:
    """Check a range noise that was given.

    Args:
        noise_std: Its standard deviation (m).
        bounds: What it may be.

    Raises:
        UsageError: It is not within the bounds.
    """
    if not bounds.least <= noise_std <= bounds.largest:
        allowed = f"from {bounds.least:g} to {bounds.largest:g} m"
        raise UsageError(f"--noise-std is {noise_std:g}: it must be above 0, {allowed}")


def neighbour_noise(ranges: NDArray[np.float32], options: NoiseOptions = OPTIONS) -> float | None:
    """Estimate the range noise from the differences of neighbouring beams, by their median absolute deviation.

    Args:
        ranges: Ranges (N,) in m, in the order of their beams; those that are not finite are left out.
        options: How many of them are used.

    Returns:
        The standard deviation (m), too large where the ranges of neighbouring beams differ by themselves; None where
        there are no two beams.
    """
    if len(ranges) > options.most_ranges:
        step = len(ranges) // options.most_ranges + 1
        with np.errstate(invalid="ignore"):  # beams without a return, next to each other
            differences = ranges[1::step] - ranges[:-1:step]
        differences = differences[np.isfinite(differences)]
    else:
        differences = np.diff(ranges[np.isfinite(ranges)])
    if not len(differences):
        return None
    return float(np.median(np.abs(differences))) * NORMAL_MAD / math.sqrt(2)
