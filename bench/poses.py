"""Pose errors on driven sessions: odometry, filter, smoother, scan matching, and their effect on maps and primitives.

    python -m bench.poses [fusion] [speed] [matching] [halves] [relations] [csail] [heldout] [chain] [noisy]
        [--sessions 50] [--update docs/poses.md]

Sessions as recorded by default (60 s at 10 Hz; odometry 0.05 m and 2 degrees after a metre, GPS 0.1 m, compass 3
degrees), driven, seeds from 0. Errors are root mean squares over a session's scans, without any alignment, then over
sessions. ``chain`` replays them with the forward mapper and detection, LiDAR noise 50 mm; ``noisy`` with poses that
do not drift but have noise. ``matching`` holds errors against the bound of :mod:`bench.pose_bounds`.
"""

from __future__ import annotations

import argparse
import math
import os
import tempfile
import textwrap
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from bench.maps import update
from bench.pose_bounds import (
    PATCHES,
    SHAPES,
    Hits,
    Surfaces,
    map_slopes,
    position_bound,
    scan_information,
    step_information,
)
from bench.pose_heldout import csail_table, heldout_table
from bench.pose_primitives import chain_table, driven, noisy_table
from prim.arrays import FloatArray, Stamps
from prim.errors import LogReadError
from prim.log import open_log
from prim.log.source import LogSource
from prim.metrics import pose_nees, pose_rmse
from prim.scan import PosedScan
from prim.se2 import Trajectory, relative_poses, wrap_angles
from recorder.sensors import Lidar
from recorder.session import SessionOptions, record_session
from replay.ground_truth import GroundTruth
from replay.localization import localize
from replay.options import ReplayOptions
from replay.pipeline import Pipeline
from replay.poses.fusion import Fusion
from replay.poses.fusion_nodes import FusionNodes
from replay.poses.fusion_options import SENSORS, FusionInputs, SensorNoise
from replay.poses.laser_poses import FUSED, LaserPoses
from replay.poses.pose_provider import PoseProvider
from replay.poses.tracking.scan_tracker import ScanTrack, track
from replay.scans.posed_scans import PosedScans
from replay.scans.scan_log import ScanLog
from replay.scans.selection import Selection
from replay.timing import StageTimer

SUBSETS = {
    "odometry, GPS, compass": SENSORS,
    "odometry, GPS": ("odom", "gps"),
    "odometry, compass": ("odom", "compass"),
    "GPS, compass": ("gps", "compass"),
}
TRUE_NOISE = SensorNoise(0.1, math.radians(3), 0.05, math.radians(2), 0.0)
"""The noise that the recorder adds by default."""

NORMAL_95 = 1.96
"""95 % of normal numbers lie within so many standard deviations."""

Errors = dict[str, tuple[float, ...]]


def fusion_errors(seed: int) -> Errors:
    """Return RMSE (m, rad) and NEES of each estimate, and the normalised errors of the map frame."""
    errors: Errors = {}
    with tempfile.TemporaryDirectory() as folder, open_log(driven(folder, seed, rays=16)) as log:
        times = ScanLog(log, Selection()).times
        truth = PoseProvider(log).laser_poses(times, "truth").poses
        odometry = PoseProvider(log).laser_poses(times, "odom").poses
        errors["odometry"] = (*pose_rmse(odometry, truth), math.nan)
        for name, sensors in SUBSETS.items():
            try:
                fused = PoseProvider(log, inputs=FusionInputs(sensors)).laser_poses(times, FUSED)
            except LogReadError:
                continue
            assert fused.covariances is not None and fused.fusion is not None
            if sensors == SENSORS:
                nodes = fused.fusion.nodes
                errors["filtered only"] = estimate_errors(fused.fusion, truth, times.stamps, smooth=False)
                known = Fusion(nodes, TRUE_NOISE)
                errors["smoothed, true noise"] = estimate_errors(known, truth, times.stamps)
                errors["frame"] = normalised_frame_error(fused, truth)
            nees = pose_nees(fused.poses, truth, fused.covariances) or math.nan
            errors[f"**smoothed**: {name}"] = (*pose_rmse(fused.poses, truth), nees)
    return errors


def estimate_errors(fusion: Fusion, truth: FloatArray, stamps: Stamps, smooth: bool = True) -> tuple[float, ...]:
    """Return RMSE (m, rad) and NEES of a fusion's poses at ``stamps``, smoothed or filtered."""
    estimate = fusion.smoothed() if smooth else fusion.filtered()
    at = np.searchsorted(estimate.stamps, stamps)
    poses = estimate.poses[at]
    return *pose_rmse(poses, truth), pose_nees(poses, truth, estimate.covariances[at]) or math.nan


def normalised_frame_error(fused: LaserPoses, truth: FloatArray) -> tuple[float, ...]:
    """Return the poses' mean error as a motion (3,) of the map at its origin, over its standard deviations."""
    assert fused.frame_covariance is not None
    error = fused.poses - truth
    error[:, 2] = wrap_angles(error[:, 2])
    x, y = fused.poses[:, 0], fused.poses[:, 1]
    motion = np.array(
        [(error[:, 0] + error[:, 2] * y).mean(), (error[:, 1] - error[:, 2] * x).mean(), error[:, 2].mean()]
    )
    return tuple((motion / np.sqrt(np.diag(fused.frame_covariance))).tolist())


def fusion_table(seeds: Sequence[int], pool: ProcessPoolExecutor) -> str:
    sessions = list(pool.map(fusion_errors, seeds))
    n = len(sessions)
    lines = ["| poses | position, mm | heading, ° | position / odometry's | NEES |", "|---|---:|---:|---:|---:|"]
    raw = rms([errors["odometry"][0] for errors in sessions])
    for name in [name for name in sessions[0] if name != "frame"]:
        rows = [errors[name] for errors in sessions if name in errors]
        metres, radians = rms([row[0] for row in rows]), rms([row[1] for row in rows])
        nees = float(np.mean([row[2] for row in rows]))
        consistency = "" if math.isnan(nees) else f"{nees:.2f}"
        lines.append(
            f"| {name} | {1000 * metres:.1f} | {math.degrees(radians):.2f} | {metres / raw:.2f} | {consistency} |"
        )
    z = np.array([errors["frame"] for errors in sessions])
    bound = NORMAL_95 * math.sqrt(6 / n)
    text = (
        f"{n} sessions. NEES is the mean normalised error squared: 3 for consistent covariances, and "
        f"{3 - bound:.2f} to {3 + bound:.2f} with 95 % probability over {n} independent sessions. The pose of the "
        f"map frame: errors over estimated standard deviations, root mean square, "
        f"{', '.join(f'{value:.2f}' for value in np.sqrt((z**2).mean(axis=0)))} (x, y, heading)."
    )
    return "\n".join([*lines, "", *textwrap.wrap(text, 118)])


def rms(values: Sequence[float]) -> float:
    return float(np.sqrt(np.mean(np.square(values))))


def speed_table() -> str:
    """Compare run times with real time and with filterpy, best of several runs in one process."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "long.mcap"
        record_session(path, SessionOptions(seed=0, motion="drive", duration=600.0, lidar=Lidar(rays=2)))
        with open_log(path) as log:
            scans = ScanLog(log, Selection())
            whole = best_of(3, lambda: PoseProvider(log).laser_poses(scans.times, FUSED))
            fusion = PoseProvider(log).laser_poses(scans.times, FUSED).fusion
        assert fusion is not None
        nodes = fusion.nodes
        estimation = best_of(3, lambda: Fusion(nodes))
        smoothing = best_of(20, fusion.smoothed)
        reference = best_of(2, lambda: run_filterpy(nodes))
    count = len(nodes.stamps)
    return "\n".join(
        [
            "| 600 s of log, 6000 readings of each sensor | time | x real time |",
            "|---|---:|---:|",
            f"| in all: reading the log, noise estimation, filter, smoother | {whole:.3f} s | {600 / whole:,.0f} |",
            f"| noise estimation | {estimation:.3f} s | {600 / estimation:,.0f} |",
            f"| filter and smoother, once | {smoothing:.4f} s | {600 / smoothing:,.0f} |",
            f"| filterpy's ExtendedKalmanFilter, filter only | {reference:.3f} s | {600 / reference:,.0f} |",
            "",
            f"Per node: filter and smoother {1e6 * smoothing / count:.1f} µs, "
            f"filterpy's filter {1e6 * reference / count:.0f} µs: "
            f"{reference / smoothing:.0f} times as long.",
        ]
    )


def best_of(times: int, work: Callable[[], object]) -> float:
    best = math.inf
    for _ in range(times):
        start = time.perf_counter()
        work()
        best = min(best, time.perf_counter() - start)
    return best


def run_filterpy(nodes: FusionNodes) -> FloatArray:
    """Run the same filter by filterpy, without gating; return its last state (3,)."""
    from filterpy.kalman import ExtendedKalmanFilter

    filtered = ExtendedKalmanFilter(3, 2)
    filtered.x, filtered.P = np.append(nodes.fixes[0], nodes.headings[0]), np.eye(3)
    position, turn = np.eye(2, 3), np.array([[0.0, 0.0, 1.0]])
    fix_noise, turn_noise = np.eye(2) * 0.01, np.array([[0.05**2]])
    for step, distance, fix, heading in zip(
        nodes.steps, nodes.variance_scales, nodes.fixes, nodes.headings, strict=True
    ):
        cos, sin = math.cos(filtered.x[2]), math.sin(filtered.x[2])
        dx, dy = cos * step[0] - sin * step[1], sin * step[0] + cos * step[1]
        filtered.F = np.array([[1, 0, -dy], [0, 1, dx], [0, 0, 1.0]])
        filtered.Q = np.diag([0.05**2, 0.05**2, 0.035**2]) * distance
        filtered.x = filtered.x + np.array([dx, dy, step[2]])
        filtered.P = filtered.F @ filtered.P @ filtered.F.T + filtered.Q
        filtered.update(fix, lambda _: position, lambda x: x[:2], fix_noise)
        near = filtered.x[2] + (heading - filtered.x[2] + math.pi) % (2 * math.pi) - math.pi
        filtered.update(np.array([near]), lambda _: turn, lambda x: x[2:], turn_noise)
    last: FloatArray = filtered.x
    return last


MATCHED = {
    "odom": ReplayOptions(pose="odom", match_scans=True),
    FUSED: ReplayOptions(pose=FUSED, match_scans=True),
    "scans alone": ReplayOptions(pose="scans"),
}
"""Sources of poses whose scans are matched."""

RANGE_NOISE = (0.02, 0.05)
"""Of the sessions that are matched (m)."""

LARGE_NOISE = 0.25
"""Where scans alone are tried too (m)."""


def matching_errors(job: tuple[int, float]) -> Errors:
    """Return RMSE (m, rad), NEES, CPU time (s) and bounds of poses, matched or not, of a seed and a noise.

    The bounds (m) are those where shapes are known, and where surfaces are patches: see :mod:`bench.pose_bounds`.
    """
    seed, noise_std = job
    errors: Errors = {}
    with tempfile.TemporaryDirectory() as folder, open_log(driven(folder, seed, noise_std=noise_std)) as log:
        scans = ScanLog(log, Selection())
        truth = PoseProvider(log).laser_poses(scans.times, "truth").poses
        limits = matching_bounds(log, scans, truth, noise_std)
        for name, options in MATCHED.items():
            if noise_std == LARGE_NOISE and name != "scans alone":
                continue
            if options.match_scans:
                poses = PoseProvider(log).laser_poses(scans.times, options.pose)
                errors[name] = (*pose_rmse(poses.poses, truth), math.nan, math.nan, math.nan, math.nan)
            start = time.process_time()
            matched = localize(scans, options, StageTimer()).poses
            spent = time.process_time() - start
            nees = math.nan
            if matched.covariances is not None:  # else it is said that nothing is known of the errors
                nees = pose_nees(matched.poses, truth, matched.covariances) or math.nan
            errors[f"{name}, **matched**"] = (*pose_rmse(matched.poses, truth), nees, spent, *limits[name])
    return errors


def matching_bounds(log: LogSource, scans: ScanLog, truth: FloatArray, noise_std: float) -> dict[str, list[float]]:
    """Return the bounds (m) on positions, for SHAPES and PATCHES, by each source of poses that is matched."""
    recorded = GroundTruth.read(log)
    assert recorded is not None
    surfaces = Surfaces.of(recorded.world)
    hits = Hits.of(surfaces, truth, scans.first.directions, scans.first.range_max)
    odometry = Trajectory(scans.stamps, PoseProvider(log).laser_poses(scans.times, "odom").poses)
    nodes = FusionNodes.from_readings(scans.stamps, odometry, None, None)
    steps = step_information(truth, Fusion(nodes, TRUE_NOISE).step_variances(nodes))
    assert TRUE_NOISE.position_std and TRUE_NOISE.heading_std
    stds = [TRUE_NOISE.position_std, TRUE_NOISE.position_std, TRUE_NOISE.heading_std]
    sensors = np.diag(np.tile(np.array(stds) ** -2, len(truth)))
    limits: dict[str, list[float]] = {name: [] for name in MATCHED}
    for unknown in (SHAPES, PATCHES):
        slopes = map_slopes(recorded.world, surfaces, hits, unknown)
        by_scans = scan_information(hits, slopes, len(truth), noise_std)
        limits["odom"].append(position_bound(by_scans + steps, first_is_known=True))
        limits[FUSED].append(position_bound(by_scans + steps + sensors, first_is_known=False))
        limits["scans alone"].append(position_bound(by_scans, first_is_known=True))
    return limits


def matching_table(seeds: Sequence[int], pool: ProcessPoolExecutor) -> str:
    lines = [
        "| σ, mm | poses | position, mm | median | worst | bound | ratio | heading, ° | NEES, mean | median | CPU |",
        "|---:|---|---:|---:|---:|---:|---:|---:|---:|---:|---:|",
    ]
    differences = []
    for noise_std in (*RANGE_NOISE, LARGE_NOISE):
        sessions = list(pool.map(matching_errors, [(seed, noise_std) for seed in seeds]))
        for name in sessions[0]:
            rows = np.array([errors[name] for errors in sessions])
            metres, radians = rms(rows[:, 0].tolist()), rms(rows[:, 1].tolist())
            known = rows[~np.isnan(rows[:, 2]), 2]
            nees = f"| {known.mean():.1f} | {np.median(known):.1f}" if len(known) else "| |"
            spent, bounds = "", " | "
            if not math.isnan(rows[0, 3]):
                spent = f"{np.median(rows[:, 3]):.0f} s"
                bound = rms(rows[:, 4].tolist())
                bounds = f"{1000 * bound:.1f} | {metres / bound:.2f}"
                differences.append(float(np.abs(rows[:, 5] / rows[:, 4] - 1).max()))
            lines.append(
                f"| {1000 * noise_std:.0f} | {name} | {1000 * metres:.1f} | {1000 * np.median(rows[:, 0]):.1f} | "
                f"{1000 * rows[:, 0].max():.1f} | {bounds} | {math.degrees(radians):.2f} {nees} | {spent} |"
            )
    text = (
        f"{len(seeds)} sessions of 600 scans with 500 rays each. Bound: that of Cramér and Rao on the error of the "
        "position, poses and map together, places and sizes of primitives and walls unknown; ratio: errors over it. "
        f"With surfaces of free patches of a centimetre in their place it differs by {max(differences):.0%} at most."
    )
    return "\n".join([*lines, "", *textwrap.wrap(text, 118)])


LAGS = (1, 5, 20, 100, 400)
"""Scans between the two whose motion halves of the beams are compared by."""

HALVED = ("intel_raw.mcap", "csail_raw.mcap")

TRACKED_CELLS = 0.05
"""The map's cells (m) where buildings are tracked."""


def half(posed: PosedScan, first: int) -> PosedScan:
    """Return a scan's even beams (``first`` is 0) or its odd ones (1)."""
    scan = posed.scan
    turned = scan.angle_min + first * scan.angle_increment
    ranges = np.ascontiguousarray(scan.ranges[first::2])
    halved = replace(scan, angle_min=turned, angle_increment=2 * scan.angle_increment, ranges=ranges)
    return replace(posed, scan=halved, pieces=[(halved, posed.pose)])


def halves_table(folder: Path) -> str:
    """Compare the motions that odd and even beams say with the covariances that they claim: no truth is needed."""
    lines = [
        "| log | poses | " + " | ".join(f"{lag} scans" for lag in LAGS) + " | all |",
        "|---|---|" + "---:|" * (len(LAGS) + 1),
    ]
    for name in HALVED:
        with open_log(folder / name) as log:
            scans = ScanLog(log, Selection())
            poses = replace(PoseProvider(log).laser_poses(scans.times, "odom"), end_poses=None)
            held = list(PosedScans(scans, poses))
        odometry = poses.poses[[posed.position for posed in held]]
        for label, known in (("odometry", odometry), ("scans alone", None)):
            halves = [track([half(posed, k) for posed in held], known) for k in (0, 1)]
            differences = [motion_nees(*halves, lag) for lag in LAGS]
            cells = " | ".join(f"{value:.1f}" for value in (*differences, np.mean(differences)))
            lines.append(f"| {name} | {label} | {cells} |")
    return "\n".join([*lines, "", "NEES of the differences: 3 where the covariances of both hold."])


def motion_nees(one: ScanTrack, other: ScanTrack, lag: int) -> float:
    """Return the mean normalised squared difference of two tracks' motions over so many scans."""
    assert one.errors is not None and other.errors is not None
    first = np.arange(0, len(one.poses) - lag, max(lag // 2, 1))
    motions = [relative_poses(track.poses[first], track.poses[first + lag]) for track in (one, other)]
    apart = motions[0] - motions[1]
    apart[:, 2] = wrap_angles(apart[:, 2])
    spread = one.errors.between(first, first + lag) + other.errors.between(first, first + lag)
    return float(np.einsum("ni,nij,nj->n", apart, np.linalg.inv(spread), apart).mean())


EXACT_STAMPS = 0.002
"""Relations count where both of their stamps are those of scans within this (s)."""


def relations_table(folder: Path) -> str:
    """Score the Intel lab's poses by the relations of Kümmerle et al. (2009), on exact stamps."""
    relations = np.loadtxt(folder / "intel.relations")
    lines = [
        "| intel_raw.mcap | relations | translation, m | median | rotation, ° | CPU beside mapping alone |",
        "|---|---:|---:|---:|---:|---:|",
    ]
    plain = ReplayOptions(mapper="forward", pose="odom", resolution=TRACKED_CELLS, detect=False)
    start = time.process_time()
    Pipeline(folder / "intel_raw.mcap", plain).run()
    alone = time.process_time() - start
    for name, options in (
        ("odometry", replace(plain, match_scans=True)),
        ("scans alone", replace(plain, pose="scans")),
    ):
        start = time.process_time()
        result = Pipeline(folder / "intel_raw.mcap", options).run()
        ratio = (time.process_time() - start) / alone
        metres, degrees = relation_errors(result.stamps, result.poses.poses, relations)
        lines.append(
            f"| {name} | {len(metres)} | {metres.mean():.4f} ± {metres.std():.4f} | {np.median(metres):.4f} | "
            f"{degrees.mean():.3f} ± {degrees.std():.3f} | {ratio:.2f} |"
        )
    return "\n".join(lines)


def relation_errors(stamps: Stamps, poses: FloatArray, relations: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the errors (m, degrees) of relations (stamps, x, y, z, roll, pitch, heading) between exact stamps."""
    seconds = stamps / 1e9

    def nearest(wanted: FloatArray) -> NDArray[np.intp]:
        after = np.clip(np.searchsorted(seconds, wanted), 1, len(seconds) - 1)
        return after - (wanted - seconds[after - 1] < seconds[after] - wanted)

    first, last = nearest(relations[:, 0]), nearest(relations[:, 1])
    exact = np.abs(seconds[first] - relations[:, 0]) < EXACT_STAMPS
    exact &= np.abs(seconds[last] - relations[:, 1]) < EXACT_STAMPS
    motions = relative_poses(poses[first[exact]], poses[last[exact]])
    metres = np.hypot(*(motions[:, :2] - relations[exact, 2:4]).T)
    return metres, np.degrees(np.abs(wrap_angles(motions[:, 2] - relations[exact, 7])))


def tables(wanted: Sequence[str], sessions: int, data: Path) -> Iterator[tuple[str, str]]:
    """Yield the name and the table of each part."""
    with ProcessPoolExecutor(os.cpu_count()) as pool:
        if "fusion" in wanted:
            yield "fusion", fusion_table(range(sessions), pool)
        if "matching" in wanted:
            yield "matching", matching_table(range(sessions), pool)
        if "chain" in wanted:
            yield "chain", chain_table(range(sessions), pool)
        if "noisy" in wanted:
            yield "noisy", noisy_table(range(sessions), pool)
    if "speed" in wanted:
        yield "speed", speed_table()
    if "halves" in wanted and all((data / name).exists() for name in HALVED):
        yield "halves", halves_table(data)
    if "relations" in wanted and (data / "intel.relations").exists():
        yield "relations", relations_table(data)
    if "csail" in wanted and (data / "csail.mcap").exists():
        yield "csail", csail_table(data / "csail.mcap")
    if "heldout" in wanted and all((data / name).exists() for name in ("csail.mcap", "csail_raw.mcap")):
        yield "heldout", heldout_table(data / "csail.mcap", data / "csail_raw.mcap")


PARTS = ("fusion", "speed", "matching", "halves", "relations", "csail", "heldout", "chain", "noisy")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("parts", nargs="*", choices=[*PARTS, []], default=PARTS)
    parser.add_argument("--sessions", type=int, default=50)
    parser.add_argument("--data", type=Path, default=Path("../shared/data"))
    parser.add_argument("--update", type=Path, help="the document that gets the tables")
    options = parser.parse_args()
    for name, content in tables(options.parts or PARTS, options.sessions, options.data):
        print(f"\n{name}\n\n{content}", flush=True)
        if options.update:
            update(options.update, f"poses {name}", content)


if __name__ == "__main__":
    main()
