"""JSON as RFC 8259 has it: what is written has no NaN and no Infinity, what cannot be read raises ValueError."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from typing import Any

import numpy as np

SHOWN = 80
"""A value that a message quotes is cut to this many characters; set by hand."""


MAX_BYTES = 16_000_000
"""Larger JSON is not read: as objects it would take some ten times as much memory. Set by hand."""


def finite(value: Any) -> Any:
    """Return a value as JSON can hold it.

    Args:
        value: A JSON value, in which numbers may be NumPy's and lists arrays or tuples.

    Returns:
        The same with plain lists, objects and numbers; null (None) in the place of every number that is not finite.
    """
    if isinstance(value, Mapping):
        return {key: finite(item) for key, item in value.items()}
    if isinstance(value, np.ndarray | np.generic):
        return finite(value.tolist())
    if isinstance(value, list | tuple):
        return [finite(item) for item in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


def dumps(value: Any, indent: int | None = None) -> str:
    """Write a value as JSON, see :func:`finite`.

    Args:
        value: The value.
        indent: Spaces for each level; None for a single line.

    Returns:
        The text.
    """
    return json.dumps(finite(value), indent=indent, allow_nan=False)


def loads(text: str | bytes) -> Any:
    """Parse JSON.

    Raises:
        ValueError: It is none, nested too deeply to be read, or larger than MAX_BYTES.
    """
    if len(text) > MAX_BYTES:
        raise ValueError(f"it is of {len(text) / 1e6:.0f} MB, more than {MAX_BYTES / 1e6:.0f}")
    try:
        return json.loads(text)
    except RecursionError:
        raise ValueError("it is nested too deeply") from None


def shown(value: Any) -> str:
    """Return a JSON value as a message quotes it: shortened where it is long."""
    try:
        text = json.dumps(value, default=repr)
    except (RecursionError, ValueError):
        return "a value that cannot be shown"
    return text if len(text) <= SHOWN else f"{text[: SHOWN - 1]}…"
