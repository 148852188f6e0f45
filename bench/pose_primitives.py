"""Primitives by poses: sessions replayed by each source of poses, and by noisy poses that do not drift."""

from __future__ import annotations

import math
import tempfile
import textwrap
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
from mcap.reader import make_reader
from mcap.writer import Writer

from prim.log import open_log
from prim.log.messages import COMPASS_TOPIC, GPS_TOPIC, ODOM_TOPIC, TF_TOPIC, encode_odometry
from prim.metrics import FOUND_IOU, outline_iou
from prim.se2 import Pose2D
from recorder.sensors import Lidar
from recorder.session import SessionOptions, record_session
from replay.options import ReplayOptions
from replay.pipeline import Pipeline
from replay.poses.fusion_options import FusionInputs, SensorNoise
from replay.poses.laser_poses import FUSED
from replay.poses.pose_provider import PoseProvider
from replay.result import ReplayResult
from replay.scans.scan_log import ScanLog
from replay.scans.selection import Selection

POSE_NOISE = SensorNoise(0.02, math.radians(1))
"""The noise that poses are given: of x and y (m), and of the heading (rad), independent from scan to scan."""

OTHER_POSES = (TF_TOPIC, GPS_TOPIC, COMPASS_TOPIC)
"""Topics that a log with such poses has no more."""

REPLAYS = {
    "as given": ReplayOptions(mapper="forward", pose="odom"),
    "matched": ReplayOptions(mapper="forward", pose="odom", match_scans=True, fuse=FusionInputs(noise=POSE_NOISE)),
}


def driven(folder: str, seed: int, rays: int = 500, noise_std: float = 0.05) -> Path:
    """Record a driven session with the default noise of odometry, GPS and compass."""
    path = Path(folder) / f"{seed}.mcap"
    record_session(path, SessionOptions(seed=seed, motion="drive", lidar=Lidar(rays=rays, noise_std=noise_std)))
    return path


def with_noisy_poses(source: Path, target: Path, seed: int, noise: SensorNoise = POSE_NOISE) -> None:
    """Copy a recorded log, its odometry replaced by the true poses with noise, without other poses but the true ones.

    Args:
        source: The log.
        target: The copy.
        seed: Seeds the noise.
        noise: Its standard deviations.
    """
    with open_log(source) as log:
        scans = ScanLog(log, Selection())
        truth = PoseProvider(log).laser_poses(scans.times, "truth").poses
        stds = [noise.position_std, noise.position_std, noise.heading_std]
        poses = truth + np.random.default_rng((seed, 1)).normal(0, stds, truth.shape)
        at = dict(zip(scans.stamps.tolist(), poses.tolist(), strict=True))
    schemas: dict[int, int] = {}
    channels: dict[int, int] = {}
    with source.open("rb") as read, target.open("wb") as write:
        reader, writer = make_reader(read), Writer(write)
        writer.start("ros2")
        for one in reader.iter_attachments():
            writer.add_attachment(one.create_time, one.log_time, one.name, one.media_type, one.data)
        for schema, channel, message in reader.iter_messages():
            if schema is None or channel.topic in OTHER_POSES:
                continue
            if channel.id not in channels:
                if schema.id not in schemas:
                    schemas[schema.id] = writer.register_schema(schema.name, schema.encoding, schema.data)
                channels[channel.id] = writer.register_channel(
                    channel.topic, channel.message_encoding, schemas[schema.id], channel.metadata
                )
            is_odometry = channel.topic == ODOM_TOPIC
            data = encode_odometry(message.log_time, Pose2D(*at[message.log_time])) if is_odometry else message.data
            writer.add_message(channels[channel.id], message.log_time, data, message.publish_time)
        writer.finish()


@dataclass
class PrimitiveErrors:
    """Primitives and their errors over several replays; z are errors over standard deviations."""

    hits: int = 0
    true: int = 0
    detected: int = 0
    positions: list[float] = field(default_factory=list)
    sizes: list[float] = field(default_factory=list)
    position_z: list[float] = field(default_factory=list)
    size_z: list[float] = field(default_factory=list)

    def add(self, result: ReplayResult) -> None:
        """Add the primitives of one replay."""
        assert result.detections is not None and result.detections.errors is not None
        detections, truth = result.detections.detections.found, result.detections.truth
        hits = [pair for pair in result.detections.errors.pairs if pair.found]
        self.hits, self.true, self.detected = (
            self.hits + len(hits),
            self.true + len(truth),
            self.detected + len(detections),
        )
        for pair in hits:
            detection, true = detections[pair.detection], truth[pair.truth]
            assert detection.std is not None
            self.positions.append(pair.position)
            self.sizes.append((pair.width + pair.height) / 2)
            self.position_z += [
                abs(detection.primitive.x - true.x) / detection.std["x"],
                abs(detection.primitive.y - true.y) / detection.std["y"],
            ]
            for key, size in detection.primitive.sizes.items():
                self.size_z.append(abs(size - true.sizes[key]) / detection.std[key])

    @property
    def f1(self) -> float:
        """The F1 score of all primitives."""
        return 2 * self.hits / max(self.true + self.detected, 1)


CHAINS = {
    "truth": ReplayOptions(mapper="forward", pose="truth"),
    "odom": ReplayOptions(mapper="forward", pose="odom"),
    "odom, matched": ReplayOptions(mapper="forward", pose="odom", match_scans=True),
    "fused": ReplayOptions(mapper="forward", pose=FUSED),
    "scans alone": ReplayOptions(mapper="forward", pose="scans"),
    "fused, matched": ReplayOptions(mapper="forward", pose=FUSED, match_scans=True),
}


def chain(job: tuple[int, str]) -> tuple[str, ReplayResult]:
    """Replay one session."""
    seed, name = job
    with tempfile.TemporaryDirectory() as folder:
        result = Pipeline(driven(folder, seed), CHAINS[name]).run()
    return name, replace(result, poses=replace(result.poses, fusion=None))


def chain_table(seeds: Sequence[int], pool: ProcessPoolExecutor) -> str:
    """Compare maps and primitives by each source of poses."""
    results: dict[str, list[ReplayResult]] = {name: [] for name in CHAINS}
    for name, result in pool.map(chain, [(seed, name) for seed in seeds for name in CHAINS]):
        results[name].append(result)
    lines = [
        "| poses | map F1 (within 1 cell) | F1 of primitives | position, mm | size, mm | position z | size z |",
        "|---|---:|---:|---:|---:|---:|---:|",
    ]
    for name, replays in results.items():
        maps = np.mean([result.scores.occupied_f1 or 0.0 for result in replays if result.scores])
        errors = PrimitiveErrors()
        for result in replays:
            errors.add(result)
        lines.append(
            f"| {name} | {maps:.3f} | {errors.f1:.3f} | {mean_and_median(errors.positions)} | "
            f"{mean_and_median(errors.sizes)} | {scaled_median(errors.position_z)} | {scaled_median(errors.size_z)} |"
        )
    return "\n".join(
        [*lines, "", f"{len(seeds)} sessions; position and size: mean / median of true positives; z: median / 0.674."]
    )


def mean_and_median(metres: Sequence[float]) -> str:
    return f"{1000 * np.mean(metres):.1f} / {1000 * np.median(metres):.1f}" if metres else "-"


def scaled_median(z: Sequence[float]) -> str:
    return f"{np.median(z) / 0.674:.2f}" if z else "-"


def noisy(job: tuple[int, str]) -> tuple[str, ReplayResult]:
    """Replay one session whose poses have noise."""
    seed, name = job
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "noisy.mcap"
        with_noisy_poses(driven(folder, seed), path, seed)
        result = Pipeline(path, REPLAYS[name]).run()
    return name, replace(result, poses=replace(result.poses, fusion=None))


def noisy_table(seeds: Sequence[int], pool: ProcessPoolExecutor) -> str:
    """Compare primitives by poses with noise that does not drift, with matching and without it."""
    results: dict[str, list[ReplayResult]] = {name: [] for name in REPLAYS}
    for name, result in pool.map(noisy, [(seed, name) for seed in seeds for name in REPLAYS]):
        results[name].append(result)
    lines = [
        "| poses | their position, mm | NEES | F1 of primitives | of another kind | as objects | not at all | "
        "position, mm | position z, RMS | size z, RMS |",
        "|---|---:|---:|---:|---:|---:|---:|---:|---:|---:|",
    ]
    for name, replays in results.items():
        errors = PrimitiveErrors()
        for result in replays:
            errors.add(result)
        lost = np.sum([lost_primitives(result) for result in replays], axis=0).tolist()
        metres = [result.pose_rmse[0] for result in replays if result.pose_rmse]
        known = [result.pose_nees for result in replays if result.pose_nees is not None]
        nees = f"{np.mean(known):.1f}" if known else ""
        lines.append(
            f"| {name} | {1000 * math.sqrt(np.mean(np.square(metres))):.1f} | {nees} | {errors.f1:.3f} | "
            f"{' | '.join(map(str, lost))} | {mean_and_median(errors.positions)} | "
            f"{root_mean_square(errors.position_z)} | {root_mean_square(errors.size_z)} |"
        )
    text = (
        f"{len(seeds)} sessions with {errors.true} primitives, some found as another kind, as objects without one, "
        "or not at all; position: mean / median of true positives; z: errors over standard deviations."
    )
    return "\n".join([*lines, "", *textwrap.wrap(text, 118)])


def lost_primitives(result: ReplayResult) -> tuple[int, int, int]:
    """Count the true primitives that are found as of another kind, as an object without one, and not at all."""
    assert result.detections is not None and result.detections.errors is not None
    detections, pairs = result.detections.detections, result.detections.errors.pairs
    found = {pair.truth for pair in pairs if pair.found}
    others = {pair.truth for pair in pairs} - found
    rest = [true for number, true in enumerate(result.detections.truth) if number not in found | others]
    objects = [
        true
        for true in rest
        if any(outline_iou(one.outline, true.outline()) >= FOUND_IOU for one in detections.objects)
    ]
    return len(others), len(objects), len(rest) - len(objects)


def root_mean_square(values: Sequence[float]) -> str:
    return f"{math.sqrt(np.mean(np.square(values))):.2f}" if values else "-"
