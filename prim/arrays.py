"""The array types that signatures name."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]


BoolGrid = NDArray[np.bool_]


Stamps = NDArray[np.int64]
