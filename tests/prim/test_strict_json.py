"""JSON without numbers that RFC 8259 does not have."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from prim import strict_json
from prim.errors import UsageError, WorldError
from prim.metrics import polygon_iou, pose_nees
from prim.shapes import Primitive
from prim.world import World

ROOT = Path(__file__).parents[2]


def refuse(constant: str) -> None:
    raise AssertionError(f"{constant} is no JSON")


VALUES = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(),
    lambda inner: st.lists(inner) | st.dictionaries(st.text(), inner),
    max_leaves=10,
)


@given(VALUES)
def test_what_is_written_is_rfc_8259(value: Any) -> None:
    read = json.loads(strict_json.dumps(value), parse_constant=refuse)
    assert read == strict_json.finite(value)


def test_numbers_of_numpy_are_plain_ones_and_null_where_they_are_not_finite() -> None:
    value = {"a": np.float64("nan"), "b": np.array([[1.0, -np.inf]]), "c": (np.float32("inf"), np.int64(3), True)}
    assert strict_json.finite(value) == {"a": None, "b": [[1.0, None]], "c": [None, 3, True]}


def test_only_one_module_writes_json() -> None:
    """Else NaN and Infinity would come back with the next file."""
    sources = [
        path for part in ("prim", "recorder", "mapping", "detect", "replay") for path in (ROOT / part).rglob("*.py")
    ]
    others = [path.name for path in sources if "json.dump" in path.read_text("utf-8").replace("strict_json.dump", "")]
    assert others == ["strict_json.py"]


HUGE = "1" + "0" * 400


@pytest.mark.parametrize(
    "text",
    [
        f'{{"size": [{HUGE}, 2]}}',
        '{"size": [1e300, 2]}',
        '{"size": [NaN, 2]}',
        '{"size": [2, 2], "walls": [[0, 0, 1e300, 1]]}',
        f'{{"size": [2, 2], "primitives": [{{"kind": "circle", "x": {HUGE}, "y": 0, "size": {{"radius": 1}}}}]}}',
        '{"size": [2, 2], "primitives": [{"kind": "circle", "x": 1e300, "y": 0, "size": {"radius": 1}}]}',
        '{"size": ' + "[" * 100_000 + "]" * 100_000 + "}",
        '{"size": ' + "[" * 900 + "]" * 900 + "}",
    ],
    ids=["integer", "far", "nan", "wall", "primitive", "far primitive", "deep", "nested"],
)
def test_absurd_worlds_are_refused_in_one_short_line(tmp_path: Path, text: str) -> None:
    path = tmp_path / "w.json"
    path.write_text(text)
    with pytest.raises(WorldError) as error:
        World.load(path)
    assert "\n" not in str(error.value) and len(str(error.value)) < 400


def test_messages_quote_any_value_in_short() -> None:
    deep: list[Any] = []
    for _ in range(100_000):
        deep = [deep]
    assert strict_json.shown(deep) == strict_json.shown(10**5000) == "a value that cannot be shown"
    assert strict_json.shown({"a": [1, None]}) == '{"a": [1, null]}'


@pytest.mark.parametrize("value", [1e300, math.nan, math.inf, 10**400])
def test_primitives_have_plausible_values(value: float) -> None:
    with pytest.raises(UsageError, match=r"beyond 1e\+09|not finite"):
        Primitive.of("circle", value, 0.0, radius=0.1)
    with pytest.raises(UsageError, match=r"beyond 1e\+09|not finite"):
        Primitive.of("circle", 0.0, 0.0, radius=value)


def test_shapes_too_small_for_an_area_overlap_nothing() -> None:
    tiny = Primitive.of("circle", 0.0, 0.0, radius=1e-200)
    assert polygon_iou(tiny, tiny) == 0.0
    assert np.isinf(tiny.cast((1.0, 0.5), np.array([[-1.0, 0.0]]))).all()


@pytest.mark.parametrize("variance", [0.0, math.nan, math.inf])
def test_singular_covariances_have_no_nees(variance: float) -> None:
    covariances = np.stack([np.eye(3), np.diag([1.0, variance, 1.0])])
    assert pose_nees(np.ones((2, 3)), np.zeros((2, 3)), covariances) is None
    assert pose_nees(np.ones((2, 3)), np.zeros((2, 3)), np.stack([np.eye(3)] * 2)) == pytest.approx(3.0)
