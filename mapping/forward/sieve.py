"""The sieve: the restriction of the forward map to smooth fields, and the M step under it.

The stopping probabilities are a smoothed field, o = K p: each o_c is the weighted mean of its neighbours' parameters
p, with Gaussian weights K that sum to 1. Restricting the maximum-likelihood estimate to such fields is Grenander's
method of sieves (Geman and Hwang 1982): the parameter space is smaller, there is no prior distribution over it.
Neighbouring cells agree because they share parameters.

The M step has a closed form. A ray that enters cell c draws a neighbour d with probability K_cd and stops with
probability p_d; with d as a latent variable, the expected hits h_c and passes g_c of the E step give

    p_d / (1 - p_d)  <-  p_d / (1 - p_d) * [K^T (h / o)]_d / [K^T (g / (1 - o))]_d,

which does not lower the likelihood as long as neither p nor o is clipped to its bounds. Raising the ratio to a power
above 1 is over-relaxation (Salakhutdinov and Roweis 2003), which may lower it: :mod:`mapping.forward.mapper` undoes
such steps.

Numba's cache watches only this file: constants that the kernels use must stand here, model parameters are arguments.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from prim.compiled import inline, kernel

NO_COUNTS = 1e-12
"""A parameter with fewer expected hits and passes than this is left as it is."""


def gaussian_kernel(width: float, min_width: float = 0.3, truncation: float = 2.5) -> NDArray[np.float32]:
    """Return a one-dimensional Gaussian kernel.

    Args:
        width: Standard deviation (cells).
        min_width: Below this width the kernel is a single weight.
        truncation: The kernel ends at this many standard deviations.

    Returns:
        Weights (2 n + 1,) that sum to 1.
    """
    if width < min_width:
        return np.ones(1, np.float32)
    reach = max(1, round(truncation * width))
    weights = np.exp(-0.5 * (np.arange(-reach, reach + 1) / width) ** 2)
    return np.asarray(weights / weights.sum(), dtype=np.float32)


@inline
def convolve_row(source: Any, target: Any, weights: Any, index: int) -> None:
    """Compute one row of the vertical convolution.

    Args:
        source: (rows, cols).
        target: (rows, cols); row ``index`` is filled.
        weights: The kernel (2 n + 1,).
        index: The row.
    """
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
def convolve(source: Any, weights: Any, scratch: Any, target: Any) -> None:
    """Convolve an array with a kernel along both axes; what lies outside is 0.

    Args:
        source: (rows, cols).
        weights: The kernel (2 n + 1,).
        scratch: Working memory (rows, cols).
        target: Filled (rows, cols).
    """
    rows, cols = source.shape
    n = weights.shape[0] // 2
    for i in range(rows):
        for j in range(cols):
            scratch[i, j] = weights[n] * source[i, j]
        for k in range(1, n + 1):
            w = weights[n + k]
            for j in range(cols - k):
                scratch[i, j] += w * source[i, j + k]
            for j in range(k, cols):
                scratch[i, j] += w * source[i, j - k]
    for i in range(rows):
        convolve_row(scratch, target, weights, i)


@kernel
def kernel_sums(count: int, weights: Any) -> Any:
    """Compute the sum of a kernel's weights that lie within a line of cells, around each of them.

    Args:
        count: The number of cells.
        weights: The kernel (2 n + 1,).

    Returns:
        The sums (count,): 1 but near the ends.
    """
    n = weights.shape[0] // 2
    sums = np.zeros(count, np.float32)
    for i in range(count):
        for k in range(-n, n + 1):
            if 0 <= i + k < count:
                sums[i] += weights[n + k]
    return sums


@kernel
def reduce_blocks(sums: Any, stopping: Any, row_sums: Any, col_sums: Any, hits: Any, passes: Any) -> None:
    """Add up the blocks' expected counts, always in the same order; compute what the M step convolves with K^T.

    With h the expected hits and g the expected passes this is h / o and g / (1 - o), over the kernel's sums.

    Args:
        sums: Expected hits and passes (blocks, rows * cols, 2 or 3) of the E step.
        stopping: Stopping probabilities o (rows, cols).
        row_sums: The kernel's sums (rows,), see :func:`kernel_sums`.
        col_sums: The kernel's sums (cols,).
        hits: Filled (rows, cols) with h / o over the kernel's sums.
        passes: Filled (rows, cols) with g / (1 - o) over the kernel's sums.
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
def maximize(parameters: Any, active: Any, hits: Any, passes: Any, power: int, bounds: Any) -> None:
    """Compute the M step of the sieve's parameters, in place.

    Args:
        parameters: The parameters p (rows, cols).
        active: Which of them change (rows, cols).
        hits: K^T (h / o) (rows, cols), h the expected hits.
        passes: K^T (g / (1 - o)) (rows, cols), g the expected passes.
        power: How often the odds are multiplied by the ratio of the two: 1 is expectation-maximisation, more is
            over-relaxed.
        bounds: The parameters' lower and upper bound, float32.
    """
    rows, cols = parameters.shape
    for i in range(rows):
        for j in range(cols):
            h, p = hits[i, j], passes[i, j]
            if active[i, j] and h + p > NO_COUNTS:
                value = parameters[i, j]
                up, down = value, np.float32(1) - value
                for _ in range(power):
                    up *= h
                    down *= p
                    total = up + down
                    up /= total
                    down /= total
                parameters[i, j] = min(max(up, bounds[0]), bounds[1])


@kernel
def normalize(convolved: Any, row_sums: Any, col_sums: Any, bounds: Any) -> None:
    """Divide a convolved array by the kernel's sums, in place, and clip it.

    Args:
        convolved: (rows, cols).
        row_sums: The kernel's sums (rows,), see :func:`kernel_sums`.
        col_sums: The kernel's sums (cols,).
        bounds: Lower and upper bound, float32.
    """
    for i in range(convolved.shape[0]):
        for j in range(convolved.shape[1]):
            value = convolved[i, j] / (row_sums[i] * col_sums[j])
            convolved[i, j] = min(max(value, bounds[0]), bounds[1])
