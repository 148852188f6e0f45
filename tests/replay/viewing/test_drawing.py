"""What is drawn over the map."""

from __future__ import annotations

import numpy as np
import pytest

from prim.shapes import Kind, Primitive
from replay.viewing.drawing import ring, uncertainty_bounds


@pytest.mark.parametrize("kind", Kind)
def test_the_bounds_of_uncertainty_lie_one_standard_deviation_beside_the_outline(kind: Kind) -> None:
    size = {1: (0.3,), 2: (0.4, 0.3)}[len(kind.sizes)]
    primitive = Primitive(kind, 1.0, 2.0, 0.0 if kind.has_angle else None, size)
    exact = dict.fromkeys(kind.parameters, 0.0)
    for std, wider in (
        ({"x": 0.02, "y": 0.02}, 2 * 0.02),  # either side of the outline is as unsure as its centre
        (dict.fromkeys(kind.sizes, 0.01), 0.01 * kind.extent),
    ):
        extents = [np.ptp(ring(bound), axis=0) for bound in uncertainty_bounds(primitive, exact | std)]
        middle = np.ptp(ring(primitive), axis=0)
        assert extents[0] == pytest.approx(middle - wider, abs=1e-9)
        assert extents[1] == pytest.approx(middle + wider, abs=1e-9)
