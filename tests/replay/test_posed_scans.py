"""Scans with poses, the subset that refines intermediate detections, and pacing."""

from __future__ import annotations

import time
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest

from prim.log import open_log
from prim.scan import PosedScan, Scan
from prim.se2 import Pose2D
from recorder.session import Session
from replay.detection.refiner import ScanSubset
from replay.poses.pose_provider import PoseProvider
from replay.scans.posed_scans import PosedScanOptions, PosedScans, ScanLog
from replay.scans.selection import Selection
from replay.timing import MAX_WAIT, RatePacer, StageTimer


def posed_scans(
    session: Session, options: PosedScanOptions | None = None, timer: StageTimer | None = None, first_valid: int = 0
) -> list[PosedScan]:
    """Read a session's scans; those before ``first_valid`` have no pose."""
    with open_log(session.path) as log:
        scans = ScanLog(log, Selection())
        poses = PoseProvider(log).laser_poses(scans.times, "truth")
        poses = replace(poses, valid=np.arange(len(scans)) >= first_valid)
        posed = PosedScans(scans, poses, options or PosedScanOptions(), timer)
        first, second = list(posed), list(posed)
    assert [scan.position for scan in first] == [scan.position for scan in second]
    return first


def test_scans_without_a_pose_are_left_out(noisy_session: Session) -> None:
    positions = [posed.position for posed in posed_scans(noisy_session, first_valid=3)]
    assert positions == list(range(3, noisy_session.scans))


def test_max_range_limits_the_scans(noisy_session: Session) -> None:
    posed = posed_scans(noisy_session, PosedScanOptions(max_range=0.5))[0]
    assert posed.scan.range_max == 0.5
    assert np.hypot(*(posed.points - (posed.pose.x, posed.pose.y)).T).max() < 0.5


def test_reading_is_timed(noisy_session: Session) -> None:
    timer = StageTimer()
    posed_scans(noisy_session, timer=timer)
    assert 0 < timer.seconds["read"] <= timer.total()


@pytest.mark.parametrize("total", [1, 5, 9, 10, 47, 200])
def test_a_scan_subset_is_bounded_and_evenly_spread(total: int) -> None:
    subset = ScanSubset(5)
    for number in range(total):
        scan = Scan(number, "", 0.0, 1.0, 0.1, 9.0, np.ones(4, np.float32))
        subset.add(scan, Pose2D(0.0, 0.0, 0.0))
    stamps = [scan.stamp for scan, _ in subset.pieces()]
    assert stamps == sorted(stamps) and subset.total == total
    assert min(total, 5) <= len(stamps) < 10
    assert len({later - earlier for earlier, later in pairwise(stamps)}) <= 1


def test_later_pieces_of_a_scan_are_held_with_the_first(noisy_session: Session) -> None:
    subset = ScanSubset(5)
    scan = posed_scans(noisy_session)[0].scan
    for first_beam in (0, 60, 120):
        subset.add(replace(scan, first_beam=first_beam), Pose2D(0.0, 0.0, 0.0))
    assert (subset.total, len(subset.pieces())) == (1, 3)


def test_a_pacer_waits_in_proportion_and_not_beyond_its_limit(monkeypatch: pytest.MonkeyPatch) -> None:
    now, waits = [0.0], []

    def sleep(seconds: float) -> None:
        waits.append(seconds)
        now[0] += seconds

    monkeypatch.setattr(time, "perf_counter", lambda: now[0])
    monkeypatch.setattr(time, "sleep", sleep)
    pacer = RatePacer(2.0)
    for second in (0, 1, 3, 1000, 1001):
        pacer.wait(second * 10**9)
    assert waits == pytest.approx([0.5, 1.0, MAX_WAIT, 0.5])
