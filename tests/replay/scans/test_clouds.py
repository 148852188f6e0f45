"""Clouds of points become scans."""

import math
from typing import NoReturn

import numpy as np
import pytest

from prim.errors import LogReadError
from prim.log.decoding.values import PointCloud
from replay.scans.clouds import CloudSlicer


def refuse(what: str, hint: str) -> NoReturn:
    raise LogReadError("cloud.mcap", what, hint)


def ring(beams: int, first: float = 0.1, distance: float = 2.0, height: float = 0.0) -> np.ndarray:
    bearings = first + 2 * math.pi * np.arange(beams) / beams
    return (
        np.column_stack((distance * np.cos(bearings), distance * np.sin(bearings), np.full(beams, height)))
        .astype(np.float32)
        .astype(float)
    )


@pytest.mark.parametrize("beams", [180, 360, 1000, 2048])
def test_each_point_of_a_planar_scanner_is_a_beam(beams: int) -> None:
    rng = np.random.default_rng(1)
    points = ring(beams) * rng.uniform(0.5, 3.0, beams)[:, None]
    scan = CloudSlicer(None, refuse).scan(PointCloud(5, "laser", rng.permutation(points)))
    assert len(scan.ranges) == beams
    ends = scan.directions * scan.ranges[:, None]
    nearest = np.abs(ends[:, None] - points[None, :, :2]).sum(axis=2).min(axis=1)
    assert nearest.max() < 1e-4
    assert (scan.stamp, scan.frame_id, scan.range_max) == (5, "laser", math.inf)


def test_beams_without_a_point_have_no_measurement() -> None:
    slicer = CloudSlicer(None, refuse)
    points = ring(360)
    slicer.scan(PointCloud(0, "", points))
    points[10:20] = math.nan
    scan = slicer.scan(PointCloud(0, "", points[:350]))
    assert np.isnan(scan.ranges).sum() == 20
    assert not np.isinf(scan.ranges).any()


def test_a_slice_of_a_3d_lidar_needs_its_heights() -> None:
    cloud = PointCloud(
        0, "", np.concatenate([ring(360, height=z, distance=2 + z) for z in np.linspace(-0.5, 0.5, 11)])
    )
    with pytest.raises(LogReadError, match=r"no planar scanner's.*--slice -?\d"):
        CloudSlicer(None, refuse).scan(cloud)
    scan = CloudSlicer((-0.03, 0.03), refuse).scan(cloud)
    assert np.nanmax(np.abs(scan.ranges - 2.0)) < 1e-5


def test_the_nearest_of_several_points_of_a_beam_counts() -> None:
    cloud = PointCloud(0, "", np.concatenate((ring(360), ring(360, distance=1.5)[40:60])))
    scan = CloudSlicer(None, refuse).scan(cloud)
    assert np.count_nonzero(scan.ranges < 1.6) == 20


def test_an_empty_cloud_is_an_empty_scan() -> None:
    assert len(CloudSlicer(None, refuse).scan(PointCloud(0, "", np.zeros((0, 3)))).ranges) == 0


def test_a_cloud_of_one_point_leaves_the_beams_to_later_ones() -> None:
    slicer = CloudSlicer(None, refuse)
    points = ring(180)
    assert len(slicer.scan(PointCloud(0, "laser", points[:1])).ranges) == 0
    assert len(slicer.scan(PointCloud(0, "laser", points)).ranges) == 180
