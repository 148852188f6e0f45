"""Linear algebra with a defined result for any matrix: None where it is singular or not finite, no exception."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from prim.arrays import FloatArray

Matrix = NDArray[np.floating[Any]]
"""A matrix (K, K), or a stack of them (N, K, K)."""


def solve(matrix: Matrix, right: Matrix) -> FloatArray | None:
    """Solve linear equations.

    Args:
        matrix: (K, K), or (N, K, K).
        right: The right hand side (K,), (K, M) or (N, K, M).

    Returns:
        The solution, of the shape of ``right``; None where the matrix is singular or anything is not finite.
    """
    return _defined(np.linalg.solve, matrix, right)


def inverse(matrix: Matrix) -> FloatArray | None:
    """Return the inverse of a matrix (K, K); None where it is singular or not finite."""
    return _defined(np.linalg.inv, matrix)


def cholesky(matrix: Matrix) -> FloatArray | None:
    """Return the lower Cholesky factor of a matrix (K, K); None where it is not positive definite or not finite."""
    return _defined(np.linalg.cholesky, matrix)


def eigenvalues(matrix: Matrix) -> FloatArray | None:
    """Return the eigenvalues (K,) of a symmetric matrix (K, K), ascending; None where it is not finite."""
    return _defined(np.linalg.eigvalsh, matrix)


def principal_axes(matrix: Matrix) -> tuple[FloatArray, FloatArray] | None:
    """Decompose a symmetric matrix.

    Args:
        matrix: (K, K).

    Returns:
        Its eigenvalues (K,), ascending, and their unit eigenvectors as columns (K, K); None where it is not finite.
    """
    if not np.isfinite(matrix).all():
        return None
    try:
        with np.errstate(all="ignore"):
            values, vectors = np.linalg.eigh(matrix)
    except np.linalg.LinAlgError:
        return None
    return np.asarray(values, dtype=float), np.asarray(vectors, dtype=float)


def scatter_axes(points: FloatArray, ridge: float = 0.0) -> FloatArray:
    """Compute the principal axes of points.

    Args:
        points: (N, 2).
        ridge: Added to the variances along x and y.

    Returns:
        Unit vectors as columns (2, 2), the direction of least variance first; those of x and y where the points have
        no covariance: a single one, or one that is not finite.
    """
    covariance = np.cov((points - points.mean(axis=0)).T) if len(points) > 1 else np.zeros((2, 2))
    decomposed = principal_axes(covariance + np.eye(2) * ridge if ridge else covariance)
    return np.eye(2) if decomposed is None else decomposed[1]


def log_determinant(matrix: Matrix) -> float | None:
    """Return the logarithm of the determinant of a matrix (K, K); None where it is not positive and finite."""
    if not np.isfinite(matrix).all():
        return None
    with np.errstate(all="ignore"):  # a denormal pivot counts as 0 in some versions: that is not finite either
        sign, logarithm = np.linalg.slogdet(matrix)
    return float(logarithm) if sign > 0 and np.isfinite(logarithm) else None


def _defined(function: Callable[..., Any], *arguments: Matrix) -> FloatArray | None:
    """Return a function's value of matrices; None where one of them or the value is not finite, or it has none."""
    if not all(np.isfinite(argument).all() for argument in arguments):
        return None
    try:
        with np.errstate(all="ignore"):  # what overflows is not finite, and is found below
            value = np.asarray(function(*arguments), dtype=float)
    except np.linalg.LinAlgError:
        return None
    return value if np.isfinite(value).all() else None
