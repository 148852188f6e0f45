"""The compiled kernels that turn expected hits and passes into a smooth map of stopping chances.

The chance of a cell to stop a ray is a weighted mean of its neighbours' parameters, o = K p, with Gaussian weights K
that sum to 1 (a sieve in the sense of Grenander). A ray that enters a cell draws one of the neighbours and stops
with that one's chance, so that the M step stays exact: the likelihood rises at every pass.

Compiled code is cached beside this file and made anew when this file changes, so that every constant it uses must
stand here.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from prim.compiled import inline, kernel

LEAST, MOST = 1e-7, 1 - 1e-4
"""The bounds of a cell's stopping chance."""

TAPS_REACH = 2.5
"""The Gaussian weights end at this many standard deviations."""


def taps(width: float) -> NDArray[np.float32]:
    """Gaussian weights (2 n + 1,) of standard deviation ``width`` (cells), which sum to 1; a single one below 0.3."""
    if width < 0.3:
        return np.ones(1, np.float32)
    reach = max(1, round(TAPS_REACH * width))
    weights = np.exp(-0.5 * (np.arange(-reach, reach + 1) / width) ** 2)
    return np.asarray(weights / weights.sum(), dtype=np.float32)


@inline
def blur_across(source: Any, target: Any, weights: Any, index: int) -> None:
    """One row of the vertical pass: target[index] = sum of weights * source rows around it."""
    n = weights.shape[0] // 2
    rows = source.shape[0]
    for j in range(source.shape[1]):
        target[index, j] = 0
    for k in range(-n, n + 1):
        if 0 <= index + k < rows:
            w = weights[n + k]
            for j in range(source.shape[1]):
                target[index, j] += w * source[index + k, j]


@kernel
def blur(source: Any, weights: Any, between: Any, target: Any) -> None:
    """Separable convolution of ``source`` (rows, cols) into ``target``, 0 outside; ``between`` is room for work."""
    rows, cols = source.shape
    n = weights.shape[0] // 2
    for i in range(rows):
        for j in range(cols):
            between[i, j] = weights[n] * source[i, j]
        for k in range(1, n + 1):
            w = weights[n + k]
            for j in range(cols - k):
                between[i, j] += w * source[i, j + k]
            for j in range(k, cols):
                between[i, j] += w * source[i, j - k]
    for i in range(rows):
        blur_across(between, target, weights, i)


@kernel
def borders(count: int, weights: Any) -> Any:
    """What is left of the weights' sum around each of ``count`` cells in a line."""
    n = weights.shape[0] // 2
    sums = np.zeros(count, np.float32)
    for i in range(count):
        for k in range(-n, n + 1):
            if 0 <= i + k < count:
                sums[i] += weights[n + k]
    return sums


@kernel
def gather(sums: Any, stopping: Any, row_sums: Any, col_sums: Any, hits: Any, passes: Any) -> None:
    """Adds up the blocks' ``sums`` (blocks, rows * cols, 2 or 3), always in the same order, and divides by the model:

    ``hits`` / o and ``passes`` / (1 - o), over the sums of weights.
    """
    rows, cols = stopping.shape
    for i in range(rows):
        for j in range(cols):
            c = i * cols + j
            h = p = np.float32(0)
            for block in range(sums.shape[0]):
                h += sums[block, c, 0]
                p += sums[block, c, 1]
            norm = row_sums[i] * col_sums[j]
            o = stopping[i, j]
            hits[i, j] = h / (o * norm)
            passes[i, j] = p / ((np.float32(1) - o) * norm)


@kernel
def maximize(parameters: Any, active: Any, hits: Any, passes: Any, power: int) -> None:
    """The M step in place, from blurred hits / o and passes / (1 - o).

    A parameter's odds are multiplied by their ratio, ``power`` times: once is expectation-maximisation, more often
    over-relaxed. Only ``active`` ones change.
    """
    rows, cols = parameters.shape
    for i in range(rows):
        for j in range(cols):
            h, p = hits[i, j], passes[i, j]
            if active[i, j] and h + p > 1e-12:
                value = parameters[i, j]
                up, down = value, np.float32(1) - value
                for _ in range(power):
                    up *= h
                    down *= p
                    total = up + down
                    up /= total
                    down /= total
                parameters[i, j] = min(max(up, np.float32(LEAST)), np.float32(MOST))


@kernel
def normalise(blurred: Any, row_sums: Any, col_sums: Any) -> None:
    """Divides by the sums of weights, in place."""
    for i in range(blurred.shape[0]):
        for j in range(blurred.shape[1]):
            value = blurred[i, j] / (row_sums[i] * col_sums[j])
            blurred[i, j] = min(max(value, np.float32(LEAST)), np.float32(MOST))
