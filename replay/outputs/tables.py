"""Found primitives as an Arrow table."""

from __future__ import annotations

from collections.abc import Sequence

import pyarrow as pa

from detect.detection import OTHER
from prim.shapes import Kind
from replay.outputs.found_primitives import FoundPrimitive

POSE = ("x", "y", "theta")

SIZES = tuple(dict.fromkeys(name for kind in Kind for name in kind.sizes))
"""The names of all sizes of all kinds."""


def primitives_table(primitives: Sequence[FoundPrimitive]) -> pa.Table:
    """Tabulate primitives.

    Args:
        primitives: The primitives.

    Returns:
        A row for each: ``id``, ``kind``, ``x``, ``y`` (m), ``theta`` (rad), all sizes by name (m), ``score``,
        ``stage``, standard deviations as ``std_x`` and so on (m, rad), chances of the kinds as ``chance_circle`` and
        so on, and of none of them as ``chance_other``; null where a primitive has none.
    """
    numbers = {
        **{name: [getattr(found, name) for found in primitives] for name in POSE},
        **{name: [found.size.get(name) for found in primitives] for name in SIZES},
        "score": [found.score for found in primitives],
        **{f"std_{name}": [(found.std or {}).get(name) for found in primitives] for name in (*POSE, *SIZES)},
        **{f"chance_{kind}": [(found.chances or {}).get(kind) for found in primitives] for kind in (*Kind, OTHER)},
    }
    columns = {
        "id": pa.array([found.id for found in primitives], pa.int64()),
        "kind": pa.array([str(found.kind) for found in primitives], pa.string()),
        "stage": pa.array([found.stage for found in primitives], pa.string()),
    }
    return pa.table(columns | {name: pa.array(values, pa.float64()) for name, values in numbers.items()})
