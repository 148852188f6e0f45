"""The array types that signatures name."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]
"""Real numbers, double precision."""

BoolGrid = NDArray[np.bool_]
"""A mask over the cells of a grid, [row, col]."""

Stamps = NDArray[np.int64]
"""Times (ns)."""
