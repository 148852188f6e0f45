"""The pipeline as a library: lasers mounted upside down, truth that moves, repeatable results."""

import json
import os
import signal
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from prim.interrupts import Interruption, Interrupts
from prim.log.messages import (
    MARKERS_TYPE,
    POSE_TYPE,
    SCAN_TYPE,
    TF_TYPE,
    encode_pose,
    encode_primitives,
    encode_scan,
)
from prim.log.writer import LogWriter
from prim.scan import PosedScan
from prim.se2 import Pose2D
from prim.shapes import Kind, Primitive
from prim.world import World
from recorder.sensors import Lidar
from recorder.session import Session
from replay.options import ReplayOptions
from replay.pipeline import Pipeline
from replay.result import ReplayResult
from replay.scans.selection import Selection
from replay.timing import StageTimer
from replay.viewing.protocol import NullViewer
from tests.replay.poses.test_pose_provider import raw_transform

STAMP = 5 * 10**9
POSE = Pose2D(0.2, -0.1, 0.7)
WORLD = World((2.0, 2.0), (Primitive(Kind.TRIANGLE, 0.5, 0.4, 1.0, (0.2, 0.3)),)).with_walls()


def write(path: Path, rolled: bool) -> Path:
    """Write a session of one scan; a laser mounted upside down has its beams in the other order."""
    scan = Lidar(noise_std=0.0).measure(WORLD, POSE, STAMP, 0.1, np.random.default_rng(0))
    with LogWriter(path) as log:
        log.add_attachment("world.json", "application/json", json.dumps(WORLD.to_json()).encode(), STAMP)
        log.add_topic("/scan", SCAN_TYPE)
        log.add_topic("/ground_truth/pose", POSE_TYPE)
        raw_transform("base_link", "laser", (1.0, 0.0, 0.0, 0.0) if rolled else (0.0, 0.0, 0.0, 1.0))(log)
        log.write("/ground_truth/pose", STAMP, encode_pose(STAMP, POSE))
        log.write("/scan", STAMP, encode_scan(replace(scan, ranges=scan.ranges[:: -1 if rolled else 1].copy())))
    return path


@pytest.mark.parametrize("mapper", ["det", "prob"])
def test_a_laser_mounted_upside_down_gives_the_same_map(tmp_path: Path, mapper: str) -> None:
    upright, rolled = (
        Pipeline(write(tmp_path / f"{rolled}.mcap", rolled), ReplayOptions(mapper=mapper)).run()
        for rolled in (False, True)
    )
    assert np.mean(upright.grid.probability != rolled.grid.probability) < 1e-3
    assert rolled.scores is not None
    assert rolled.scores.occupied_recall is not None and rolled.scores.occupied_recall > 0.95


def test_maps_are_scored_against_moving_truth(tmp_path: Path) -> None:
    """The triangle is logged elsewhere before the second scan: cells that det marks there are correct."""
    moved = replace(WORLD, primitives=(replace(WORLD.primitives[0], x=-0.5),))
    with LogWriter(tmp_path / "a.mcap") as log:
        log.add_attachment("world.json", "application/json", json.dumps(WORLD.to_json()).encode(), STAMP)
        for topic, kind in (
            ("/scan", SCAN_TYPE),
            ("/ground_truth/pose", POSE_TYPE),
            ("/ground_truth/primitives", MARKERS_TYPE),
            ("/tf", TF_TYPE),
        ):
            log.add_topic(topic, kind)
        for index, world in enumerate((WORLD, moved)):
            stamp = STAMP + index * 10**9
            log.write("/ground_truth/primitives", stamp, encode_primitives(stamp, world))
            log.write("/ground_truth/pose", stamp, encode_pose(stamp, POSE))
            scan = Lidar(noise_std=0.0).measure(world, POSE, stamp, 0.1, np.random.default_rng(0))
            log.write("/scan", stamp, encode_scan(scan))
    result = Pipeline(tmp_path / "a.mcap", ReplayOptions(mapper="det")).run()
    assert result.scores is not None
    assert result.scores.occupied_precision == 1
    marked = result.grid.frame.centres(result.grid.occupied)
    assert np.count_nonzero(np.hypot(marked[:, 0] + 0.5, marked[:, 1] - 0.4) < 0.25) > 10


def test_a_replay_can_be_repeated(noisy_session: Session) -> None:
    def run() -> ReplayResult:
        return Pipeline(noisy_session.path, ReplayOptions(mapper="prob")).run()

    first, second = run(), run()
    assert (first.grid.probability == second.grid.probability).all()
    assert first.scores == second.scores


def test_only_rays_of_used_scans_are_counted(noisy_session: Session) -> None:
    result = Pipeline(noisy_session.path, ReplayOptions()).run()
    assert result.rays == result.scans_used * 180


def test_time_of_a_nested_stage_counts_towards_the_inner_one() -> None:
    timer = StageTimer()
    with timer.stage("refine"):
        with timer.stage("read"):
            time.sleep(0.02)
        with timer.stage("read"):
            time.sleep(0.02)
    assert timer.seconds["read"] >= 0.04 and timer.seconds["refine"] < timer.seconds["read"] / 2
    assert sum(timer.seconds.values()) <= timer.total()


class InterruptedViewer(NullViewer):
    """Interrupts the process when the fifth scan is shown."""

    def show_scan(self, posed: PosedScan) -> None:
        if posed.position == 4:
            os.kill(os.getpid(), signal.SIGINT)


def test_an_interrupted_replay_has_mapped_whole_scans(noisy_session: Session) -> None:
    options = ReplayOptions(mapper="det,prob", detect=False)
    with Interrupts() as interrupts:
        results = Pipeline(noisy_session.path, options, InterruptedViewer(), interrupts=interrupts).run_each()
    assert results[0].scans_used == 5
    for result in results:
        selection = Selection(n_scans=result.scans_used)
        until_then = Pipeline(noisy_session.path, replace(result.options, selection=selection)).run()
        assert result.interrupted is not None and result.rays == until_then.rays


def test_a_replay_that_is_interrupted_before_its_first_scan_has_no_result(
    noisy_session: Session, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("replay.pipeline.RatePacer.wait", lambda pacer, stamp: os.kill(os.getpid(), signal.SIGINT))
    with Interrupts() as interrupts, pytest.raises(Interruption):
        Pipeline(noisy_session.path, ReplayOptions(detect=False), interrupts=interrupts).run()


def test_a_replay_without_a_command_raises_what_interrupts_it(noisy_session: Session) -> None:
    with pytest.raises(KeyboardInterrupt):
        Pipeline(noisy_session.path, ReplayOptions(detect=False), InterruptedViewer()).run()
