"""Scans: what a range means (REP 117), end points, and the compensation of the laser's motion."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from prim.scan import RangeOutcome, Scan, deskew, mirror_scan
from prim.se2 import Pose2D

MEASURED, TOO_NEAR, NO_RETURN, INVALID = RangeOutcome


def scan_with(ranges: list[float] | np.ndarray, range_min: float = 0.1, range_max: float = 5.0) -> Scan:
    return Scan(0, "laser", 0.0, 0.1, range_min, range_max, np.array(ranges, dtype=np.float32))


@pytest.mark.parametrize(
    ("z", "outcome"),
    [
        (math.nan, INVALID),
        (-1.0, INVALID),
        (0.0, INVALID),
        (0.05, INVALID),
        (0.1, MEASURED),
        (4.9, MEASURED),
        (5.0, NO_RETURN),
        (7.0, NO_RETURN),
        (math.inf, NO_RETURN),
        (-math.inf, TOO_NEAR),
    ],
)
def test_range_outcomes_follow_rep_117(z: float, outcome: RangeOutcome) -> None:
    scan = scan_with([z])
    assert scan.outcomes().tolist() == [outcome]
    assert scan.measured.tolist() == [outcome is MEASURED]
    assert len(scan.points(Pose2D())) == (outcome is MEASURED)


@pytest.mark.parametrize("range_min", [0.0, -1.0])
def test_ranges_of_zero_are_invalid_whatever_the_limit(range_min: float) -> None:
    assert scan_with([0.0, -0.5, 0.01], range_min).outcomes().tolist() == [INVALID, INVALID, MEASURED]


def test_a_sensor_without_a_largest_range_measures_every_finite_range() -> None:
    assert scan_with([1e9, math.inf], range_max=math.inf).outcomes().tolist() == [MEASURED, NO_RETURN]


def test_censored_ranges_hold_all_but_invalid_beams() -> None:
    used, ranges = scan_with([math.nan, -math.inf, 0.05, 1.0, 5.0, 9.0, math.inf]).censored_ranges()
    assert used.tolist() == [False, True, False, True, True, True, True]
    assert ranges.tolist() == [-math.inf, 1.0, math.inf, math.inf, math.inf]
    assert ranges.dtype == np.float32


@pytest.mark.parametrize("range_min", [0.0, -1.0])
def test_too_near_holds_no_information_where_nothing_can_be_nearer(range_min: float) -> None:
    used, ranges = scan_with([-math.inf, 1.0], range_min).censored_ranges()
    assert used.tolist() == [False, True]
    assert ranges.tolist() == [1.0]


@given(arrays(np.float32, st.integers(0, 20), elements=st.floats(width=32)), st.sampled_from([0.0, 0.5]))
def test_every_range_has_one_outcome(ranges: np.ndarray, range_min: float) -> None:
    scan = scan_with(ranges, range_min)
    used, censored = scan.censored_ranges()
    assert set(scan.outcomes().tolist()) <= {*RangeOutcome}
    assert (scan.measured <= used).all()
    assert np.isfinite(censored).sum() == scan.measured.sum()


POSES = st.builds(Pose2D, st.floats(-1, 1), st.floats(-1, 1), st.floats(-1, 1))


@given(st.integers(1, 40), POSES, POSES, st.floats(0.001, 1.0))
def test_deskewed_pieces_hold_every_beam_once(beams: int, start: Pose2D, end: Pose2D, tolerance: float) -> None:
    scan = scan_with(np.linspace(1.0, 2.0, beams))
    pieces = deskew(scan, start, end, tolerance, max_pieces=8)
    assert 1 <= len(pieces) <= min(8, beams)
    assert np.concatenate([piece.ranges for piece, _ in pieces]).tolist() == scan.ranges.tolist()
    assert np.concatenate([piece.directions for piece, _ in pieces]) == pytest.approx(scan.directions, abs=1e-12)
    assert pieces[0][0].first_beam == 0
    for piece, pose in pieces:
        assert min(start.x, end.x) - 1e-9 <= pose.x <= max(start.x, end.x) + 1e-9
        assert piece.first_beam + len(piece.ranges) <= beams


@given(POSES)
def test_a_scan_from_one_place_stays_in_one_piece(pose: Pose2D) -> None:
    scan = scan_with([1.0, 2.0])
    assert deskew(scan, pose, None, 0.01) == [(scan, pose)]
    assert deskew(scan, pose, pose, 0.01) == [(scan, pose)]


def test_a_mirrored_scan_sees_left_what_was_right() -> None:
    scan = scan_with([1.0, 2.0, 3.0])
    x, y = scan.points(Pose2D()).T
    assert mirror_scan(scan).points(Pose2D()) == pytest.approx(np.column_stack((x, -y)))
    assert np.array_equal(mirror_scan(mirror_scan(scan)).directions, scan.directions)


@pytest.mark.parametrize("limits", [(0.1, math.nan), (0.1, 0.1), (0.1, 0.0), (-1.0, 0.0), (math.nan, 5.0)])
def test_limits_that_make_a_scan_unusable_are_named(limits: tuple[float, float]) -> None:
    problem = scan_with([1.0], *limits).problem
    assert problem is not None and "range_m" in problem
    assert scan_with([1.0]).problem is None
