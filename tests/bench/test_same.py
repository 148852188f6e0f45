"""The regression check sees every difference."""

from __future__ import annotations

import math
from typing import Any

import pytest

from bench.same import TOLERANCE, added_keys, compare, differences


@pytest.mark.parametrize(
    ("before", "after", "size"),
    [
        ({"x": 1.0}, {"x": 1.0 + 1e-5}, 1e-5),
        ({"x": 200.0}, {"x": 201.0}, 0.005),
        ({"x": 1.0}, {"x": math.nan}, math.inf),
        ({"x": math.nan}, {"x": 1.0}, math.inf),
        ({"x": 1}, {"x": True}, math.inf),
        ({"x": None}, {"x": 0.0}, math.inf),
        ({"kind": "circle"}, {"kind": "ellipse"}, math.inf),
        ({"x": 1.0}, {}, math.inf),
        ([1.0, 2.0], [1.0], math.inf),
    ],
)
def test_each_difference_is_found(before: Any, after: Any, size: float) -> None:
    [(_, found)] = differences(before, after)
    assert found == pytest.approx(size)
    runs = [{"logs": {}, "reports": {"a": value}} for value in (before, after)]
    assert compare(*runs) == (size <= TOLERANCE)


def test_keys_may_be_added(capsys: pytest.CaptureFixture[str]) -> None:
    before = {"primitives": [{"x": 1.0}, {"x": 2.0}]}
    after = {"primitives": [{"x": 1.0, "other": 0.0}, {"x": 2.0, "other": 0.5}], "objects": []}
    assert not list(differences(before, after)) and list(differences(after, before))
    assert set(added_keys(before, after)) == {".primitives[].other", ".objects"}
    runs = [{"logs": {}, "reports": {"a": value}} for value in (before, after)]
    assert compare(*runs) and not compare(*runs[::-1])
    assert "1 equal to the last bit" in capsys.readouterr().out


def test_equal_reports_have_no_differences() -> None:
    report = {"x": [1.0, None, True, "a"], "y": {"z": 0}}
    assert not list(differences(report, {**report}))
