"""How often a replay looks: bounded by cells, so that large maps take no longer than small ones."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from replay.intervals import (
    DETECTED_CELLS,
    DETECTIONS,
    MAP_SNAPSHOT_CELLS,
    NEVER,
    detection_interval,
    is_due,
    snapshot_interval,
)
from replay.options import ReplayOptions

SCANS = st.integers(1, 10**6)
CELLS = st.integers(1, 10**9)


def times(interval: int | None, scans: int) -> int:
    """How often something is due at positions 0, N, 2N and so on."""
    return 0 if interval is None else -(-scans // interval)


@given(scans=SCANS, cells=CELLS)
def test_looks_along_the_way_stay_within_their_cells(scans: int, cells: int) -> None:
    looks = detection_interval(ReplayOptions(), scans, cells, is_shown=True)
    count = times(looks.scans, scans)
    assert count <= DETECTIONS and count * cells <= DETECTED_CELLS
    maps = times(snapshot_interval(ReplayOptions(), scans, cells).scans, scans)
    assert maps == 1 or maps * cells <= MAP_SNAPSHOT_CELLS


@pytest.mark.parametrize(("scans", "interval"), [(1, 1), (7, 1), (8, 2), (100, 15), (105, 15), (5505, 787)])
def test_small_maps_are_searched_eight_times(scans: int, interval: int) -> None:
    looks = detection_interval(ReplayOptions(), scans, 40_000, is_shown=True)
    assert (looks.scans, looks.note) == (interval, "")
    searched = {position for position in range(scans) if is_due(position, interval)} | {scans - 1}
    assert min(scans, DETECTIONS // 2) <= len(searched) <= DETECTIONS
    assert is_due(0, interval)


def test_a_replay_that_is_not_shown_looks_at_the_end() -> None:
    assert detection_interval(ReplayOptions(), 100, 40_000, is_shown=False) == NEVER


@pytest.mark.parametrize("is_shown", [True, False])
def test_what_is_asked_for_is_done(is_shown: bool) -> None:
    assert detection_interval(ReplayOptions(detect_every="end"), 100, 40_000, is_shown) == NEVER
    assert detection_interval(ReplayOptions(detect_every=7), 100, 10**9, is_shown).scans == 7


def test_large_maps_are_said_to_be_searched_seldom() -> None:
    looks = detection_interval(ReplayOptions(), 700, DETECTED_CELLS // 3, is_shown=True)
    assert looks.scans == 234 and "3 times along the way: more often with --detect-every 117" in looks.note
    looks = detection_interval(ReplayOptions(), 700, DETECTED_CELLS + 1, is_shown=True)
    assert looks.scans is None and "at the end only" in looks.note
    single = detection_interval(ReplayOptions(), 700, DETECTED_CELLS, is_shown=True)
    assert single == looks, "a look after the first scan alone shows nothing"
