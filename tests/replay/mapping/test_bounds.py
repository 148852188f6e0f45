"""Automatic bounds: single wild values, and noise, do not make a map larger than what was measured."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest

from mapping.grid import MapSizeError
from mapping.kernels import MAX_STEPS
from prim.errors import LogReadError
from prim.scan import PosedScan, Scan
from prim.se2 import Pose2D
from prim.world import World
from replay.mapping.bounds import MapBounds, bounds_of_bulk, choose_map_bounds, extent_of_scans, grid_frame_of_world
from replay.options import ReplayOptions
from replay.scans.posed_scans import PosedScans

BEAMS = 360
BEARINGS = np.linspace(-math.pi, math.pi, BEAMS, endpoint=False)
SQUARE = World((2.0, 2.0)).with_walls()


def scan_at(x: float, y: float, noise: float = 0.0, seed: int = 0) -> tuple[Scan, Pose2D]:
    """A scan of a square room of 2 m."""
    ranges = SQUARE.cast((x, y), np.column_stack((np.cos(BEARINGS), np.sin(BEARINGS))))
    ranges = ranges + noise * np.random.default_rng(seed).standard_normal(BEAMS)
    scan = Scan(0, "laser", -math.pi, 2 * math.pi / BEAMS, 0.02, 1e6, ranges.astype(np.float32))
    return scan, Pose2D(x, y, 0.0)


def source(scans: Sequence[tuple[Scan, Pose2D]]) -> PosedScans:
    posed = [PosedScan(k, scan, pose, ((scan, pose),)) for k, (scan, pose) in enumerate(scans)]

    class Source(list[PosedScan]):
        scan_log = SimpleNamespace(path=Path("a.mcap"), expected_rays=sum(len(scan.ranges) for scan, _ in scans))

    return cast(PosedScans, Source(posed))


def chosen(scans: Sequence[tuple[Scan, Pose2D]], **options: Any) -> MapBounds:
    return choose_map_bounds(source(scans), ReplayOptions(**options), None)


def places(count: int = 40) -> Iterator[tuple[float, float]]:
    rng = np.random.default_rng(7)
    return ((float(x), float(y)) for x, y in rng.uniform(-0.8, 0.8, (count, 2)))


def test_a_clean_log_is_mapped_to_its_last_end_point() -> None:
    scans = [scan_at(*place) for place in places()]
    frame, notes = chosen(scans)
    extent = extent_of_scans(scans, 0.01)
    assert extent is not None and notes == ()
    assert frame.bounds == pytest.approx(extent) and frame.bounds == pytest.approx((-1, -1, 1.01, 1.01), abs=0.011)


@pytest.mark.parametrize("length", [100.0, 3000.0, 1e5])
def test_single_far_returns_do_not_count(length: float) -> None:
    scans = [scan_at(*place) for place in places()]
    for scan, _ in scans[::3]:
        scan.ranges[17] = length
    frame, notes = chosen(scans)
    assert frame.bounds == pytest.approx((-1, -1, 1.01, 1.01), abs=0.011)
    beyond = math.ceil(40 / 3) if length < MAX_STEPS * 0.01 else 0
    assert [note.split()[0] for note in notes] == [str(beyond)] * bool(beyond)


def test_a_pose_far_away_does_not_count() -> None:
    scans = [scan_at(*place) for place in places()]
    scan, _ = scans[5]
    scans[5] = scan, Pose2D(1e8, -1e9, 0.0)
    frame, notes = chosen(scans)
    assert frame.bounds == pytest.approx((-1, -1, 1.01, 1.01), abs=0.011)
    assert (
        notes[0].startswith(f"{BEAMS + 1} end points and poses are far from all others")
        and "--bounds" not in notes[0]
    )


def test_a_corridor_that_many_beams_see_is_mapped() -> None:
    """One in eight beams ends 30 m away: that is no error."""
    scans = [scan_at(*place) for place in places()]
    for scan, _ in scans:
        scan.ranges[:45] = 30.0
    frame, notes = chosen(scans)
    assert notes == () and frame.cols * frame.resolution > 30


@pytest.mark.parametrize(("noise", "largest"), [(0.1, 5.4), (0.25, 6.0), (0.5, 8.5)])
def test_noise_does_not_make_the_map_larger(noise: float, largest: float) -> None:
    scans = [scan_at(*place, noise=noise, seed=k) for k, place in enumerate(places(60))]
    frame, notes = chosen(scans)
    extent = extent_of_scans(scans, 0.01)
    assert extent is not None and len(notes) == 1
    area = frame.rows * frame.cols * 1e-4
    assert 4.0 <= area <= largest, "a room of 2 m"
    assert (extent[2] - extent[0]) * (extent[3] - extent[1]) > (1 + 3 * noise) * area
    x0, y0, x1, y1 = frame.bounds
    assert max(x0, y0) <= -1.0 and min(x1, y1) >= 1.0, "the walls are on the map"


def test_poses_are_matched_with_a_map_of_the_bulk() -> None:
    """A map that grows with the scans is not at the mercy of one return, either."""
    scans = [scan_at(*place) for place in places()]
    assert bounds_of_bulk(source(scans), 0.01) is None
    scans[3][0].ranges[17] = 3000.0
    assert bounds_of_bulk(source(scans), 0.01) == pytest.approx((-1.5, -1.5, 1.5, 1.5), abs=0.02)
    assert bounds_of_bulk(source([]), 0.01) is None


def test_without_end_points_the_map_is_what_is_free_around_the_sensor() -> None:
    for far, reach in ((1e9, 2.0), (np.inf, 1.5)):
        scan, pose = scan_at(0.0, 0.0)
        longest = 1e10 if far == 1e9 else 1.5
        scan = replace(scan, range_max=longest, ranges=np.full(BEAMS, far, dtype=np.float32))
        frame, _ = chosen([(scan, pose)])
        assert frame.bounds == pytest.approx((-reach, -reach, reach, reach), abs=0.011)


def test_a_map_that_its_rays_cannot_see_is_refused() -> None:
    """The bounds that make it can still be given."""
    scan, pose = scan_at(0.0, 0.0)
    scan.ranges[:] = 100.0
    with pytest.raises(MapSizeError, match=r"200 x 200 m has 400 million cells|far more than 360 rays can see"):
        chosen([(scan, pose)])
    assert chosen([(scan, pose)], bounds=(-60.0, -60.0, 60.0, 60.0)).frame.rows == 12_000


def test_bounds_that_are_given_or_recorded_are_kept() -> None:
    scans = [scan_at(0.0, 0.0)]
    assert chosen(scans, bounds=(-3.0, -2.0, 1.0, 2.0)).frame.bounds == pytest.approx((-3, -2, 1, 2))
    assert grid_frame_of_world(SQUARE, 0.01).bounds == pytest.approx((-1.1, -1.1, 1.1, 1.1))
    with pytest.raises(LogReadError, match="no scan that can be used has a pose"):
        chosen([])
