"""The compiled kernels of pose graphs: normal equations, a Cholesky factor of 3 x 3 blocks, its selected inverse.

The factor is computed by columns from the left (George and Liu, «Computer solution of large sparse positive definite
systems», 1981), the inverse on the factor's pattern by Takahashi's equations (Takahashi, Fagan and Chin, 1973).
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from prim.arrays import FloatArray
from prim.compiled import inline, kernel


class Pattern(NamedTuple):
    """Which blocks of a factor are not zero: those below the diagonal, by columns.

    Attributes:
        places: (N,) the column of each node.
        starts: (N + 1,) where each column's blocks begin.
        rows: (K,) the row of each block, ascending within a column.
    """

    places: NDArray[np.intp]
    starts: NDArray[np.intp]
    rows: NDArray[np.intp]


class EdgeArrays(NamedTuple):
    """Measured motions between nodes.

    Attributes:
        first: (E,) nodes.
        last: (E,) nodes, seen from the first ones.
        motions: (E, 3) x, y (m), heading (rad) of the last in the frame of the first.
        information: (E, 3, 3) inverse covariances of these.
    """

    first: NDArray[np.intp]
    last: NDArray[np.intp]
    motions: FloatArray
    information: FloatArray


@inline
def _differ(pose: Any, other: Any, motion: Any, residual: Any, by_first: Any, by_last: Any) -> None:
    """Set the residual (3,) of a motion between two poses, and its slopes (3, 3) by these."""
    cos, sin = math.cos(pose[2]), math.sin(pose[2])
    dx, dy = other[0] - pose[0], other[1] - pose[1]
    turn = other[2] - pose[2] - motion[2]
    residual[0], residual[1] = cos * dx + sin * dy - motion[0], cos * dy - sin * dx - motion[1]
    residual[2] = turn - 2.0 * math.pi * math.floor((turn + math.pi) / (2.0 * math.pi))
    by_first[0, 0], by_first[0, 1], by_first[0, 2] = -cos, -sin, cos * dy - sin * dx
    by_first[1, 0], by_first[1, 1], by_first[1, 2] = sin, -cos, -cos * dx - sin * dy
    by_first[2, 0], by_first[2, 1], by_first[2, 2] = 0.0, 0.0, -1.0
    by_last[0, 0], by_last[0, 1], by_last[0, 2] = cos, sin, 0.0
    by_last[1, 0], by_last[1, 1], by_last[1, 2] = -sin, cos, 0.0
    by_last[2, 0], by_last[2, 1], by_last[2, 2] = 0.0, 0.0, 1.0


@kernel
def squared_residuals(poses: Any, edges: Any, out: Any) -> None:
    """Compute the squared normalised residuals of edges.

    Args:
        poses: (N, 3).
        edges: The :class:`EdgeArrays`.
        out: (E,) gets them.
    """
    residual, by_first, by_last = np.empty(3), np.empty((3, 3)), np.empty((3, 3))
    for k in range(len(edges.first)):
        _differ(poses[edges.first[k]], poses[edges.last[k]], edges.motions[k], residual, by_first, by_last)
        out[k] = residual @ (edges.information[k] @ residual)


@kernel
def normal_equations(
    poses: Any, edges: Any, weights: Any, pattern: Any, slots: Any, diagonal: Any, below: Any, right: Any
) -> None:
    """Set up the normal equations of Gauss and Newton's step.

    Args:
        poses: (N, 3).
        edges: The :class:`EdgeArrays`.
        weights: (E,) of the edges.
        pattern: The :class:`Pattern`.
        slots: (E,) which block below the diagonal is that of each edge.
        diagonal: (N, 3, 3) gets the blocks on the diagonal, by columns of the pattern.
        below: (K, 3, 3) gets those below.
        right: (N, 3) gets the negative gradient.
    """
    residual, by_first, by_last = np.empty(3), np.empty((3, 3)), np.empty((3, 3))
    of_first, of_last = np.empty((3, 3)), np.empty((3, 3))  # less the products of information and slopes
    diagonal[:] = 0.0
    below[:] = 0.0
    right[:] = 0.0
    for k in range(len(edges.first)):
        i, j = pattern.places[edges.first[k]], pattern.places[edges.last[k]]
        _differ(poses[edges.first[k]], poses[edges.last[k]], edges.motions[k], residual, by_first, by_last)
        of_first[:], of_last[:] = 0.0, 0.0
        _take_product(edges.information[k], by_first, of_first)
        _take_product(edges.information[k], by_last, of_last)
        of_first *= weights[k]
        of_last *= weights[k]
        _take_product(by_first.T, of_first, diagonal[i])
        _take_product(by_last.T, of_last, diagonal[j])
        if i < j:
            _take_product(by_last.T, of_first, below[slots[k]])
        else:
            _take_product(by_first.T, of_last, below[slots[k]])
        for a in range(3):
            for b in range(3):
                right[i, a] += of_first[b, a] * residual[b]
                right[j, a] += of_last[b, a] * residual[b]


@inline
def _take_product(a: Any, b: Any, out: Any) -> None:
    """Subtract from a matrix (3, M) the product of one (3, 3) and one (3, M)."""
    for i in range(3):
        for j in range(out.shape[1]):
            out[i, j] -= a[i, 0] * b[0, j] + a[i, 1] * b[1, j] + a[i, 2] * b[2, j]


@inline
def _inverse_root(a: Any, out: Any) -> bool:
    """Invert the lower Cholesky factor (3, 3) of a matrix; False where that is not positive definite."""
    if not a[0, 0] > 0.0:
        return False
    r00 = math.sqrt(a[0, 0])
    r10, r20 = a[1, 0] / r00, a[2, 0] / r00
    d1 = a[1, 1] - r10 * r10
    if not d1 > 0.0:
        return False
    r11 = math.sqrt(d1)
    r21 = (a[2, 1] - r20 * r10) / r11
    d2 = a[2, 2] - r20 * r20 - r21 * r21
    if not d2 > 0.0:
        return False
    r22 = math.sqrt(d2)
    out[:] = 0.0
    out[0, 0], out[1, 1], out[2, 2] = 1.0 / r00, 1.0 / r11, 1.0 / r22
    out[1, 0] = -r10 / (r00 * r11)
    out[2, 1] = -r21 / (r11 * r22)
    out[2, 0] = (r10 * r21 - r20 * r11) / (r00 * r11 * r22)
    return True


@kernel
def factorise(pattern: Any, diagonal: Any, below: Any, roots: Any, factor: Any) -> bool:
    """Compute the Cholesky factor of a matrix of blocks.

    Args:
        pattern: The :class:`Pattern`.
        diagonal: (N, 3, 3) the matrix's blocks on the diagonal.
        below: (K, 3, 3) those below.
        roots: (N, 3, 3) gets the inverses of the factor's blocks on the diagonal.
        factor: (K, 3, 3) gets those below.

    Returns:
        Whether the matrix is positive definite.
    """
    starts, rows, count = pattern.starts, pattern.rows, len(diagonal)
    work = np.zeros((count, 3, 3))
    head, link, at = np.full(count, -1), np.full(count, -1), np.zeros(count, np.int64)
    for j in range(count):
        work[j] = diagonal[j]
        for e in range(starts[j], starts[j + 1]):
            work[rows[e]] = below[e]
        k = head[j]
        while k != -1:
            following, own = link[k], at[k]
            for e in range(own, starts[k + 1]):
                _take_product(factor[e], factor[own].T, work[rows[e]])
            at[k] = own + 1
            if at[k] < starts[k + 1]:
                row = rows[at[k]]
                link[k], head[row] = head[row], k
            k = following
        if not _inverse_root(work[j], roots[j]):
            return False
        for e in range(starts[j], starts[j + 1]):
            factor[e] = work[rows[e]] @ roots[j].T
        if starts[j] < starts[j + 1]:
            at[j], row = starts[j], rows[starts[j]]
            link[j], head[row] = head[row], j
    return True


@kernel
def substitute(pattern: Any, roots: Any, factor: Any, right: Any) -> None:
    """Solve equations by a factor.

    Args:
        pattern: The :class:`Pattern`.
        roots: (N, 3, 3) as :func:`factorise` sets them.
        factor: (K, 3, 3).
        right: (N, 3, M) the right hand sides, changed to the solutions.
    """
    starts, rows, count, width = pattern.starts, pattern.rows, len(roots), right.shape[2]
    for j in range(count):
        for c in range(width):
            a, b, d = right[j, 0, c], right[j, 1, c], right[j, 2, c]
            for k in range(3):
                right[j, k, c] = roots[j, k, 0] * a + roots[j, k, 1] * b + roots[j, k, 2] * d
        for e in range(starts[j], starts[j + 1]):
            _take_product(factor[e], right[j], right[rows[e]])
    for j in range(count - 1, -1, -1):
        for e in range(starts[j], starts[j + 1]):
            _take_product(factor[e].T, right[rows[e]], right[j])
        for c in range(width):
            a, b, d = right[j, 0, c], right[j, 1, c], right[j, 2, c]
            for k in range(3):
                right[j, k, c] = roots[j, 0, k] * a + roots[j, 1, k] * b + roots[j, 2, k] * d


@kernel
def selected_inverse(pattern: Any, roots: Any, factor: Any, diagonal: Any, below: Any) -> None:
    """Compute the blocks of the inverse that lie on a factor's pattern.

    Args:
        pattern: The :class:`Pattern`.
        roots: (N, 3, 3) as :func:`factorise` sets them.
        factor: (K, 3, 3).
        diagonal: (N, 3, 3) gets the inverse's blocks on the diagonal.
        below: (K, 3, 3) gets those below.
    """
    starts, rows, count = pattern.starts, pattern.rows, len(roots)
    slot = np.full(count, -1)
    for j in range(count - 1, -1, -1):
        begin, end = starts[j], starts[j + 1]
        unit = np.empty((end - begin, 3, 3))
        for e in range(begin, end):
            slot[rows[e]] = e
            unit[e - begin] = factor[e] @ roots[j]
            below[e] = 0.0
        for e in range(begin, end):
            k = rows[e]
            _take_product(diagonal[k], unit[e - begin], below[e])
            for f in range(starts[k], starts[k + 1]):
                s = slot[rows[f]]
                if s >= 0:
                    _take_product(below[f], unit[e - begin], below[s])
                    _take_product(below[f].T, unit[s - begin], below[e])
        diagonal[j] = roots[j].T @ roots[j]
        for e in range(begin, end):
            _take_product(unit[e - begin].T, below[e], diagonal[j])
            slot[rows[e]] = -1
