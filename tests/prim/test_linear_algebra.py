"""Linear algebra has a result for every matrix, and raises for none."""

from __future__ import annotations

import ast
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from prim import linear_algebra
from prim.arrays import FloatArray

ROOT = Path(__file__).parents[2]
RAISING = {"solve", "inv", "cholesky", "eigh", "eigvalsh", "slogdet", "svd", "pinv", "lstsq", "eig", "qr"}

ODD = st.sampled_from([0.0, 1.0, -1.0, np.nan, np.inf, 1e300, 1e-300]) | st.floats()
matrices = arrays(np.float64, (3, 3), elements=ODD)


@given(matrices)
@example(np.array([[0.0, 1.0, 0.0], [0.0, 0.0, 1.0], [1.11253693e-308, 0.0, 0.0]]))
def test_every_matrix_has_a_finite_result_or_none(matrix: FloatArray) -> None:
    results = [
        linear_algebra.solve(matrix, np.ones(3)),
        linear_algebra.inverse(matrix),
        linear_algebra.cholesky(matrix),
        linear_algebra.eigenvalues(matrix),
    ]
    assert all(result is None or np.isfinite(result).all() for result in results)
    logarithm = linear_algebra.log_determinant(matrix)
    assert logarithm is None or np.isfinite(logarithm)
    linear_algebra.principal_axes(matrix)


def test_regular_matrices_are_solved() -> None:
    matrix = np.array([[2.0, 0.5], [0.5, 1.0]])
    right = np.array([1.0, 2.0])
    solution, inverse = linear_algebra.solve(matrix, right), linear_algebra.inverse(matrix)
    assert solution is not None and inverse is not None
    assert matrix @ solution == pytest.approx(right) and inverse @ right == pytest.approx(solution)
    assert linear_algebra.log_determinant(matrix) == pytest.approx(np.log(1.75))
    assert linear_algebra.log_determinant(np.diag([-1.0, 2.0])) is None


FUNCTIONS = (
    linear_algebra.inverse,
    linear_algebra.cholesky,
    linear_algebra.eigenvalues,
    linear_algebra.principal_axes,
    linear_algebra.log_determinant,
)


@pytest.mark.parametrize("function", FUNCTIONS)
def test_what_is_not_finite_has_no_result_even_where_it_is_not_read(function: Callable[[FloatArray], object]) -> None:
    """Those of symmetric matrices read one half of them."""
    matrix = np.eye(3)
    assert function(matrix) is not None
    for row, col in ((0, 2), (2, 0)):
        odd = matrix.copy()
        odd[row, col] = np.nan
        assert function(odd) is None


def test_what_does_not_converge_has_no_result(monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(matrix: FloatArray) -> None:
        raise np.linalg.LinAlgError("Eigenvalues did not converge")

    monkeypatch.setattr(np.linalg, "eigh", fail)
    assert linear_algebra.principal_axes(np.eye(2)) is None


@pytest.mark.parametrize("points", [[[1.0, 2.0]], [[1.0, 1.0], [1.0, 1.0]], [[np.nan, 0.0], [1.0, 2.0]]])
def test_points_without_a_direction_have_axes(points: list[list[float]]) -> None:
    axes = linear_algebra.scatter_axes(np.array(points))
    assert np.abs(axes.T @ axes) == pytest.approx(np.eye(2))


def test_nothing_else_calls_what_raises() -> None:
    """Else a LinAlgError of some log would end as «this is a bug»."""
    for part in ("prim", "recorder", "mapping", "detect", "replay"):
        for path in (ROOT / part).rglob("*.py"):
            if path.name == "linear_algebra.py":
                continue
            for node in ast.walk(ast.parse(path.read_text("utf-8"))):
                if isinstance(node, ast.Attribute) and ast.unparse(node.value) == "np.linalg":
                    assert node.attr not in RAISING, f"{path}: {ast.unparse(node)}"
