"""A rough estimate of the range noise from the ranges alone, without a map."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from prim.normal import NORMAL_MAD


def neighbour_noise(ranges: NDArray[np.float32]) -> float | None:
    """Estimate the range noise from the differences of neighbouring beams, by their median absolute deviation.

    Args:
        ranges: Ranges (N,) in m, in the order of their beams; those that are not finite are left out.

    Returns:
        The standard deviation (m), too large where the ranges of neighbouring beams differ by themselves; None where
        there are no two beams.
    """
    differences = np.diff(ranges[np.isfinite(ranges)])
    if not len(differences):
        return None
    return float(np.median(np.abs(differences))) * NORMAL_MAD / math.sqrt(2)
