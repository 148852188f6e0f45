"""Poses on driven sessions: odometry, the filter, the smoother, scans matched with the map, and what comes of it.

    python -m bench.poses [fusion] [speed] [matching] [csail] [chain] [--sessions 50] [--update docs/poses.md]

Sessions as recorded by default (60 s at 10 Hz; odometry 0.05 m and 2 degrees after a metre, GPS 0.1 m, compass 3
degrees), driven, seeds from 0. Errors are root mean squares over a session's scans, without any alignment, then over
sessions. ``chain`` replays them with the forward mapper and detection, LiDAR noise 50 mm.
"""

from __future__ import annotations

import argparse
import math
import os
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np

from bench.heldout import EVERY, frame_of, rays_of, score
from bench.maps import update
from mapping.forward.mapper import ForwardMapper
from prim.arrays import FloatArray, Stamps
from prim.errors import LogReadError
from prim.log.mcap import LogReader
from prim.metrics import pose_nees, pose_rmse
from prim.se2 import Pose2D, wrap_angles
from recorder.sensors import Lidar
from recorder.session import SessionOptions, record
from replay.options import ReplayOptions
from replay.pipeline import Pipeline
from replay.posed_scans import ScanLog
from replay.poses.fusion import Fusion, Nodes, PoseNoise
from replay.poses.localize import FUSED, SENSORS, FuseOptions, LaserPoses, Localizer
from replay.poses.scan_matching import match
from replay.result import ReplayResult
from replay.selection import Selection

SUBSETS = {
    "odometry, GPS, compass": SENSORS,
    "odometry, GPS": ("odom", "gps"),
    "odometry, compass": ("odom", "compass"),
    "GPS, compass": ("gps", "compass"),
}
TRUE_NOISE = PoseNoise(0.1, math.radians(3), 0.05, math.radians(2), 0.0)
"""What the recorder adds by default."""

CHI_SQUARED = 1.96
"""95 % of normal numbers lie within so many standard deviations."""

CSAIL_RESOLUTION = 0.05
CSAIL_NOISE = {"as given": (0.05, 0.5), "with 0.1 m and 2° of noise": (0.1, 2.0)}
"""What the matcher is told about poses that do not drift: metres, degrees."""

Errors = dict[str, tuple[float, ...]]


def driven(folder: str, seed: int, rays: int = 500, noise_std: float = 0.05) -> Path:
    """A driven session as recorded by default."""
    path = Path(folder) / f"{seed}.mcap"
    record(path, SessionOptions(seed=seed, motion="drive", lidar=Lidar(rays=rays, noise_std=noise_std)))
    return path


def fusion_errors(seed: int) -> Errors:
    """RMSE (m, rad) and mean normalised error squared of each estimate; and z of the map's frame."""
    errors: Errors = {}
    with tempfile.TemporaryDirectory() as folder, LogReader(driven(folder, seed, rays=16)) as log:
        times = ScanLog(log, None, Selection()).times
        truth = Localizer(log).locate(times, "truth").poses
        odometry = Localizer(log).locate(times, "odom").poses
        errors["odometry"] = (*pose_rmse(odometry, truth), math.nan)
        for name, sensors in SUBSETS.items():
            try:
                found = Localizer(log, fuse=FuseOptions(sensors)).locate(times, FUSED)
            except LogReadError:
                continue
            assert found.covariances is not None and found.fusion is not None
            if sensors == SENSORS:
                nodes = found.fusion.nodes
                errors["filtered forwards only"] = of_estimate(found.fusion, truth, times.stamps, smooth=False)
                known = Fusion(nodes, TRUE_NOISE)
                errors["smoothed, the noise known"] = of_estimate(known, truth, times.stamps)
                errors["frame"] = frame_error(found, truth)
            nees = pose_nees(found.poses, truth, found.covariances)
            errors[f"**smoothed**: {name}"] = (*pose_rmse(found.poses, truth), nees)
    return errors


def of_estimate(fusion: Fusion, truth: FloatArray, stamps: Stamps, smooth: bool = True) -> tuple[float, ...]:
    """RMSE and normalised error of what a fusion makes of its nodes."""
    estimate = fusion.smoothed() if smooth else fusion.filtered()
    at = np.searchsorted(estimate.stamps, stamps)
    poses = estimate.poses[at]
    return *pose_rmse(poses, truth), pose_nees(poses, truth, estimate.covariances[at])


def frame_error(found: LaserPoses, truth: FloatArray) -> tuple[float, ...]:
    """The mean error of the poses as a motion of the map at its origin, over what its covariance tells."""
    assert found.frame_covariance is not None
    off = found.poses - truth
    off[:, 2] = wrap_angles(off[:, 2])
    x, y = found.poses[:, 0], found.poses[:, 1]
    motion = np.array([(off[:, 0] + off[:, 2] * y).mean(), (off[:, 1] - off[:, 2] * x).mean(), off[:, 2].mean()])
    return tuple((motion / np.sqrt(np.diag(found.frame_covariance))).tolist())


def fusion_table(seeds: Sequence[int], pool: ProcessPoolExecutor) -> str:
    found = list(pool.map(fusion_errors, seeds))
    n = len(found)
    lines = ["| poses | position, mm | heading, ° | position / odometry's | NEES |", "|---|---:|---:|---:|---:|"]
    raw = rms([errors["odometry"][0] for errors in found])
    for name in [name for name in found[0] if name != "frame"]:
        rows = [errors[name] for errors in found if name in errors]
        metres, radians = rms([row[0] for row in rows]), rms([row[1] for row in rows])
        nees = float(np.mean([row[2] for row in rows]))
        told = "" if math.isnan(nees) else f"{nees:.2f}"
        lines.append(f"| {name} | {1000 * metres:.1f} | {math.degrees(radians):.2f} | {metres / raw:.2f} | {told} |")
    z = np.array([errors["frame"] for errors in found])
    bound = CHI_SQUARED * math.sqrt(6 / n)
    lines += [
        "",
        f"{n} sessions. NEES is the mean normalised error squared: 3 where covariances are right, and within "
        f"{3 - bound:.2f} to {3 + bound:.2f} with 95 % chance over {n} independent sessions. The place of the map as "
        f"a whole: errors over told standard deviations, root mean square, "
        f"{', '.join(f'{value:.2f}' for value in rms_of(z))} (x, y, heading).",
    ]
    return "\n".join(lines)


def rms(values: Sequence[float]) -> float:
    return float(np.sqrt(np.mean(np.square(values))))


def rms_of(columns: FloatArray) -> FloatArray:
    found: FloatArray = np.sqrt((columns**2).mean(axis=0))
    return found


def speed_table() -> str:
    """How much faster than real time, best of some runs, and filterpy beside it in the same run."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "long.mcap"
        record(path, SessionOptions(seed=0, motion="drive", duration=600.0, lidar=Lidar(rays=2)))
        with LogReader(path) as log:
            scans = ScanLog(log, None, Selection())
            whole = best_of(3, lambda: Localizer(log).locate(scans.times, FUSED))
            fusion = Localizer(log).locate(scans.times, FUSED).fusion
        assert fusion is not None
        nodes = fusion.nodes
        learning = best_of(3, lambda: Fusion(nodes))
        one = best_of(20, fusion.smoothed)
        other = best_of(2, lambda: filterpy_over(nodes))
    count = len(nodes.stamps)
    return "\n".join(
        [
            "| over 600 s of log, 6000 of each reading | time | x real time |",
            "|---|---:|---:|",
            f"| all of it: reading the log, noise, filter, smoother | {whole:.3f} s | {600 / whole:,.0f} |",
            f"| noise, found from the readings | {learning:.3f} s | {600 / learning:,.0f} |",
            f"| filter and smoother, once | {one:.4f} s | {600 / one:,.0f} |",
            f"| filterpy's ExtendedKalmanFilter, forwards only | {other:.3f} s | {600 / other:,.0f} |",
            "",
            f"A node takes {1e6 * one / count:.1f} µs both ways, filterpy's {1e6 * other / count:.0f} µs one way: "
            f"{other / one:.0f} times as long.",
        ]
    )


def best_of(times: int, work: Callable[[], object]) -> float:
    best = math.inf
    for _ in range(times):
        start = time.perf_counter()
        work()
        best = min(best, time.perf_counter() - start)
    return best


def filterpy_over(nodes: Nodes) -> FloatArray:
    """The same filter, by filterpy, without gating; its last state."""
    from filterpy.kalman import ExtendedKalmanFilter

    filtered = ExtendedKalmanFilter(3, 2)
    filtered.x, filtered.P = np.append(nodes.fixes[0], nodes.headings[0]), np.eye(3)
    place, turn = np.eye(2, 3), np.array([[0.0, 0.0, 1.0]])
    fix_noise, turn_noise = np.eye(2) * 0.01, np.array([[0.05**2]])
    for step, way, fix, heading in zip(nodes.steps, nodes.ways, nodes.fixes, nodes.headings, strict=True):
        cos, sin = math.cos(filtered.x[2]), math.sin(filtered.x[2])
        dx, dy = cos * step[0] - sin * step[1], sin * step[0] + cos * step[1]
        filtered.F = np.array([[1, 0, -dy], [0, 1, dx], [0, 0, 1.0]])
        filtered.Q = np.diag([0.05**2, 0.05**2, 0.035**2]) * way
        filtered.x = filtered.x + np.array([dx, dy, step[2]])
        filtered.P = filtered.F @ filtered.P @ filtered.F.T + filtered.Q
        filtered.update(fix, lambda _: place, lambda x: x[:2], fix_noise)
        near = filtered.x[2] + (heading - filtered.x[2] + math.pi) % (2 * math.pi) - math.pi
        filtered.update(np.array([near]), lambda _: turn, lambda x: x[2:], turn_noise)
    last: FloatArray = filtered.x
    return last


def matching_errors(seed: int) -> Errors:
    """RMSE (m, rad) and time (s) of poses with and without matched scans."""
    errors: Errors = {}
    with tempfile.TemporaryDirectory() as folder:
        path = driven(folder, seed)
        with LogReader(path) as log:
            scans = ScanLog(log, None, Selection())
            truth = Localizer(log).locate(scans.times, "truth").poses
            posed = partial(Pipeline(path, ReplayOptions())._posed, scans)
            for source in ("odom", FUSED):
                poses = Localizer(log).locate(scans.times, source)
                start = time.perf_counter()
                matched = match(poses, scans.stamps, posed, 0.01)
                spent = time.perf_counter() - start
                assert matched.covariances is not None
                nees = pose_nees(matched.poses, truth, matched.covariances)
                errors[source] = (*pose_rmse(poses.poses, truth), math.nan, math.nan)
                errors[f"{source}, **matched**"] = (*pose_rmse(matched.poses, truth), nees, spent)
    return errors


def matching_table(seeds: Sequence[int], pool: ProcessPoolExecutor) -> str:
    found = list(pool.map(matching_errors, seeds))
    raw = rms([errors["odom"][0] for errors in found])
    lines = [
        "| poses | position, mm | worst | heading, ° | position / odometry's | NEES, median | time |",
        "|---|---:|---:|---:|---:|---:|---:|",
    ]
    for name in found[0]:
        rows = np.array([errors[name] for errors in found])
        metres, radians = rms(rows[:, 0].tolist()), rms(rows[:, 1].tolist())
        told = "" if math.isnan(rows[0, 2]) else f"{np.median(rows[:, 2]):.1f}"
        spent = "" if math.isnan(rows[0, 3]) else f"{np.median(rows[:, 3]):.0f} s"
        lines.append(
            f"| {name} | {1000 * metres:.1f} | {1000 * rows[:, 0].max():.1f} | {math.degrees(radians):.2f} | "
            f"{metres / raw:.2f} | {told} | {spent} |"
        )
    return "\n".join([*lines, "", f"{len(found)} sessions of 600 scans with 500 rays."])


def csail_table(path: Path) -> str:
    """Log-likelihood of held-out scans on csail.mcap, nats per ray."""
    lines = ["| poses of csail.mcap | held-out, nats per ray | matched | time |", "|---|---:|---:|---:|"]
    with LogReader(path) as log:
        scans = ScanLog(log, None, Selection())
        given = Localizer(log).locate(scans.times)
        posed = partial(Pipeline(path, ReplayOptions(resolution=CSAIL_RESOLUTION))._posed, scans)
        rng = np.random.default_rng(1)
        for name, (metres, degrees) in CSAIL_NOISE.items():
            noise = np.zeros_like(given.poses)
            if name != "as given":
                noise[:, :2] = rng.normal(0, metres, (len(noise), 2))
                noise[:, 2] = rng.normal(0, math.radians(degrees), len(noise))
            poses = replace(given, poses=given.poses + noise)
            start = time.perf_counter()
            told = PoseNoise(metres, math.radians(degrees))
            matched = match(poses, scans.stamps, posed, CSAIL_RESOLUTION, None, told)
            spent = time.perf_counter() - start
            before, after = (held_out([(one.scan, one.pose) for one in posed(of)]) for of in (poses, matched))
            lines.append(f"| {name} | {before:.3f} | {after:.3f} | {spent:.0f} s |")
    return "\n".join(lines)


def held_out(scans: list[tuple[object, Pose2D]]) -> float:
    """How likely every fifth scan is on the map of the others."""
    items: list = scans  # type: ignore[type-arg]
    frame = frame_of(items, CSAIL_RESOLUTION)
    seen = [item for number, item in enumerate(items) if number % EVERY]
    mapper = ForwardMapper(CSAIL_RESOLUTION, frame.bounds)
    for scan, pose in seen:
        mapper.keep(scan, pose)
    return score(mapper.fit().stopping, frame, rays_of(seen), rays_of(items[::EVERY]))[0]


CHAINS = {
    "truth": ReplayOptions(mapper="forward", pose="truth"),
    "odom": ReplayOptions(mapper="forward", pose="odom"),
    "odom, matched": ReplayOptions(mapper="forward", pose="odom", match_scans=True),
    "fused": ReplayOptions(mapper="forward", pose=FUSED),
    "fused, matched": ReplayOptions(mapper="forward", pose=FUSED, match_scans=True),
}


def chain(job: tuple[int, str]) -> tuple[str, ReplayResult]:
    """One session through the whole replay."""
    seed, name = job
    with tempfile.TemporaryDirectory() as folder:
        result = Pipeline(driven(folder, seed), CHAINS[name]).run()
    return name, replace(result, poses=replace(result.poses, fusion=None))


def chain_table(seeds: Sequence[int], pool: ProcessPoolExecutor) -> str:
    done: dict[str, list[ReplayResult]] = {name: [] for name in CHAINS}
    for name, result in pool.map(chain, [(seed, name) for seed in seeds for name in CHAINS]):
        done[name].append(result)
    lines = [
        "| poses | map F1 (within 1 cell) | F1 of primitives | place, mm | size, mm | place z | size z |",
        "|---|---:|---:|---:|---:|---:|---:|",
    ]
    for name, results in done.items():
        maps = np.mean([result.scores.occupied_f1 or 0.0 for result in results if result.scores])
        found = there = told = 0
        places, sizes, place_z, size_z = [], [], [], []
        for result in results:
            assert result.sighting is not None and result.sighting.errors is not None
            seen, errors = result.sighting.detections.found, result.sighting.errors
            hits = [pair for pair in errors.pairs if pair.same_kind and pair.iou >= 0.5]
            found, there, told = found + len(hits), there + len(result.sighting.truth), told + len(seen)
            for pair in hits:
                one, true = seen[pair.detection], result.sighting.truth[pair.truth]
                places.append(pair.position)
                sizes.append((pair.width + pair.height) / 2)
                assert one.std is not None
                place_z += [
                    abs(one.primitive.x - true.x) / one.std["x"],
                    abs(one.primitive.y - true.y) / one.std["y"],
                ]
                for key, size in one.primitive.sizes.items():
                    size_z.append(abs(size - true.sizes[key]) / one.std[key])
        score = 2 * found / max(there + told, 1)
        lines.append(
            f"| {name} | {maps:.3f} | {score:.3f} | {mean_and_median(places)} | {mean_and_median(sizes)} | "
            f"{scaled_median(place_z)} | {scaled_median(size_z)} |"
        )
    return "\n".join(
        [*lines, "", f"{len(seeds)} sessions; place and size: mean / median of what is found; z: median / 0.674."]
    )


def mean_and_median(metres: Sequence[float]) -> str:
    return f"{1000 * np.mean(metres):.1f} / {1000 * np.median(metres):.1f}" if metres else "-"


def scaled_median(z: Sequence[float]) -> str:
    return f"{np.median(z) / 0.674:.2f}" if z else "-"


def tables(wanted: Sequence[str], sessions: int, data: Path) -> Iterator[tuple[str, str]]:
    """Name and table of each part."""
    with ProcessPoolExecutor(os.cpu_count()) as pool:
        if "fusion" in wanted:
            yield "fusion", fusion_table(range(sessions), pool)
        if "matching" in wanted:
            yield "matching", matching_table(range(sessions), pool)
        if "chain" in wanted:
            yield "chain", chain_table(range(sessions), pool)
    if "speed" in wanted:
        yield "speed", speed_table()
    if "csail" in wanted and (data / "csail.mcap").exists():
        yield "csail", csail_table(data / "csail.mcap")


PARTS = ("fusion", "speed", "matching", "csail", "chain")


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
