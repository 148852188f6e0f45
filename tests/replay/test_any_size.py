"""Objects of any size, from the log to the report."""

from __future__ import annotations

from pathlib import Path

import pytest

import prim
from prim.errors import UsageError


@pytest.fixture(scope="module")
def hall(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Seven objects of 0.4 to 1.5 m in a room of 6 x 6 m."""
    path = tmp_path_factory.mktemp("hall") / "hall.mcap"
    prim.record(str(path), seed=510, arena=(6, 6), sizes=(0.4, 1.5), per_kind=(1, 2), noise_std=0.03)
    return path


def test_large_objects_are_found_with_their_sizes(hall: Path) -> None:
    result = prim.replay(hall, mapper="forward")
    assert result.errors is not None and result.errors.f1 == 1.0
    assert result.errors.width is not None and result.errors.width < 0.002
    assert max(max(found.size.values()) for found in result.primitives) > 0.7


def test_only_the_sizes_that_are_wanted_are_reported(hall: Path) -> None:
    """Bounds are meant within a quarter."""
    small = prim.replay(hall, mapper="prob", sizes=(0.05, 0.4)).primitives
    large = prim.replay(hall, mapper="prob", sizes=(0.8, 2.0)).primitives
    assert all(max(found.size.values()) <= 0.5 for found in small)
    extents = [max(found.size.values()) * (2 if found.kind in ("circle", "ellipse") else 1) for found in large]
    assert min(extents) > 0.6 and sum(extent > 0.8 for extent in extents) == 4  # of four there are
    with pytest.raises(UsageError, match=r"sizes is 2 0\.1"):
        prim.replay(hall, sizes=(2, 0.1))
