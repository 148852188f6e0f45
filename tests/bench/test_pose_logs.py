"""Logs and poses that benchmarks of poses compare: the same scans, one frame, poses with noise."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest

from bench.pose_heldout import aligned, same_scans
from bench.pose_primitives import with_noisy_poses
from prim.errors import LogReadError
from prim.log import open_log
from prim.scan import Scan
from prim.se2 import compose_poses, wrap_angles
from recorder.sensors import Lidar
from recorder.session import SessionOptions, record_session
from replay.ground_truth import GroundTruth
from replay.poses.fusion_options import FusionInputs, SensorNoise
from replay.poses.laser_poses import FUSED
from replay.poses.pose_provider import PoseProvider
from replay.scans.scan_log import ScanLog
from replay.scans.selection import Selection

NOISE = SensorNoise(0.02, math.radians(1))


def test_noisy_poses_replace_all_others(tmp_path: Path) -> None:
    source, target = tmp_path / "source.mcap", tmp_path / "noisy.mcap"
    record_session(source, SessionOptions(motion="drive", duration=20.0, lidar=Lidar(rays=2)))
    with_noisy_poses(source, target, 0, NOISE)
    with open_log(source) as before, open_log(target) as log:
        scans = ScanLog(log, Selection())
        assert GroundTruth.read(log).world == GroundTruth.read(before).world  # type: ignore[union-attr]
        truth = PoseProvider(log).laser_poses(scans.times, "truth").poses
        error = PoseProvider(log).laser_poses(scans.times, "odom").poses - truth
        error[:, 2] = wrap_angles(error[:, 2])
        assert error.std(axis=0) == pytest.approx([0.02, 0.02, math.radians(1)], rel=0.2)
        with pytest.raises(LogReadError):
            PoseProvider(log, inputs=FusionInputs(("gps",))).laser_poses(scans.times, FUSED)


def test_poses_are_moved_together_into_one_frame() -> None:
    rng = np.random.default_rng(0)
    reference = rng.normal(size=(20, 3))
    moved = compose_poses(np.repeat([[3.0, -2.0, 2.5]], 20, axis=0), reference)
    difference = aligned(moved, reference) - reference
    difference[:, 2] = wrap_angles(difference[:, 2])
    assert np.abs(difference).max() < 1e-9


def test_scans_are_the_same_by_their_ranges_and_nearest_in_time() -> None:
    def scan(stamp: int, value: float) -> Scan:
        return Scan(stamp, "laser", 0.0, 0.1, 0.0, 10.0, np.full(3, value, np.float32))

    others = [scan(stamp, value) for stamp, value in ((0, 1.0), (10, 2.0), (20, 1.0), (30, 1.0))]
    wanted = [scan(19, 1.0), scan(28, 1.0), scan(11, 2.0)]
    stamps = [np.array([one.stamp for one in scans]) for scans in (wanted, others)]
    assert same_scans(wanted, others, *stamps).tolist() == [2, 3, 1]
