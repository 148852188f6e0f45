"""Cells of a map, told apart."""

from __future__ import annotations

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import ndimage

from detect.cells import number_connected


@given(seed=st.integers(0, 10_000), share=st.floats(0, 0.6), most=st.integers(1, 40))
@settings(max_examples=50, deadline=None)
def test_what_hangs_together_is_numbered_as_scipy_does(seed: int, share: float, most: int) -> None:
    rng = np.random.default_rng(seed)
    occupied = rng.random(rng.integers(1, 60, 2)) < share
    labels, large = np.zeros(occupied.shape, np.int32), np.zeros_like(occupied)
    number_connected(occupied, float(most), labels, large)
    expected, _ = ndimage.label(occupied, np.ones((3, 3)))
    assert (labels == expected).all()
    spans = [max(part.stop - part.start for part in parts) for parts in ndimage.find_objects(expected)]
    assert (large == np.isin(expected, [k for k, span in enumerate(spans, start=1) if span > most])).all()
