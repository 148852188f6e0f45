"""The standard normal distribution as a table, for all likelihoods that look it up."""

from __future__ import annotations

import math
from functools import lru_cache
from typing import NamedTuple

import numpy as np

from prim.arrays import FloatArray

NORMAL_MAD = 1.4826
"""A normal distribution's standard deviation over its median absolute deviation."""


class NormalTable(NamedTuple):
    """The standard normal distribution at evenly spaced points (N,).

    Attributes:
        x: The points, from -reach to reach.
        kernel: exp(-x² / 2): the density over its peak.
        upper: Phi(-x): the probability of exceeding x.
    """

    x: FloatArray
    kernel: FloatArray
    upper: FloatArray


@lru_cache(maxsize=4)
def normal_table(reach: float, spacing: int) -> NormalTable:
    """Tabulate the standard normal distribution.

    Args:
        reach: The table reaches over so many standard deviations on both sides.
        spacing: Entries per standard deviation.

    Returns:
        The table of 2 * reach * spacing + 1 entries; it is shared: do not change it.
    """
    x = np.arange(-reach * spacing, reach * spacing + 1) / spacing
    upper = np.array([0.5 * math.erfc(value / math.sqrt(2)) for value in x])
    return NormalTable(x, np.exp(-(x**2) / 2), upper)
