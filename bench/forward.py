"""Speed of the forward mapper, and accuracy of the range noise that it estimates from different initial values.

    python -m bench.forward [speed] [noise] [--rounds 5] [--data ../shared/data] [--update docs/forward.md]

Speed: 100 scans of 500 beams of a recorded world on 200 x 200 cells, from rays to the finished map, on one core and
on two: the best of all rounds (on a shared machine other processes slow down the rest), the kernels compiled before.
Noise: recorded sessions of seeds on which no option was chosen.
"""

from __future__ import annotations

import argparse
import statistics
import time
from pathlib import Path

from bench.maps import FIRST_SEED, session_of, update
from bench.sessions import Session, scans_with_poses
from mapping.forward.mapper import ForwardMapper
from mapping.grid import GridFrame
from prim.log import open_log
from prim.scan import Scan
from prim.se2 import Pose2D

BOUNDS = (-1.0, -1.0, 1.0, 1.0)
SPEED_NOISE = (0.0, 0.02, 0.05, 0.25, 0.5)
FOUND_NOISE = (0.02, 0.05, 0.1, 0.25, 0.5)
STARTS = (0.01, 0.1, 1.0)
SEEDS = range(FIRST_SEED, FIRST_SEED + 5)

Posed = list[tuple[Scan, Pose2D]]


def workload(noise_std: float) -> Posed:
    """Return 100 scans of 500 beams: those of seed 0, repeated as far as needed."""
    scans = session_of(0, noise_std).scans
    return (scans * 2)[:100]


def finish_seconds(scans: Posed, threads: int) -> float:
    mapper = ForwardMapper(0.01, BOUNDS, threads=threads)
    for scan, pose in scans:
        mapper.accumulate(scan, pose)
    began = time.perf_counter()
    mapper.finish()
    return time.perf_counter() - began


def update_seconds(scans: Posed) -> list[float]:
    mapper = ForwardMapper(0.01, BOUNDS)
    found = []
    for scan, pose in scans:
        began = time.perf_counter()
        mapper.update(scan, pose)
        found.append(time.perf_counter() - began)
    return found


def whole_seconds(scans: Posed, frame: GridFrame) -> tuple[float, float]:
    """Return the seconds that streaming a log and finishing its map take."""
    mapper = ForwardMapper(frame.resolution, frame.bounds)
    began = time.perf_counter()
    for scan, pose in scans:
        mapper.update(scan, pose)
    streamed = time.perf_counter()
    mapper.finish()
    return streamed - began, time.perf_counter() - streamed


def speed(rounds: int, data: Path) -> str:
    lines = ["| workload | one core | two cores | streaming, per scan: median | worst |", "|---|---|---|---|---|"]
    work = {noise_std: workload(noise_std) for noise_std in SPEED_NOISE}
    finish_seconds(work[0.0], 2)
    update_seconds(work[0.0])
    single: dict[float, list[float]] = {noise_std: [] for noise_std in work}
    double: dict[float, list[float]] = {noise_std: [] for noise_std in work}
    streamed: dict[float, list[float]] = {noise_std: [] for noise_std in work}
    for _ in range(rounds):
        for noise_std, scans in work.items():
            single[noise_std].append(finish_seconds(scans, 1))
            double[noise_std].append(finish_seconds(scans, 2))
            streamed[noise_std] += update_seconds(scans)
    lines += [
        f"| 50,000 rays, σ = {noise_std * 1000:g} mm | {min(single[noise_std]):.2f} s | "
        f"{min(double[noise_std]):.2f} s | {statistics.median(streamed[noise_std]) * 1e3:.1f} ms | "
        f"{max(streamed[noise_std]) * 1e3:.1f} ms |"
        for noise_std in work
    ]
    if (data / "csail.mcap").exists():
        from bench.heldout import frame_of

        with open_log(data / "csail.mcap") as log:
            scans = scans_with_poses(log)
        frame = frame_of(scans, 0.05)
        found = min((whole_seconds(scans, frame) for _ in range(rounds)), key=sum)
        rays = sum(len(scan.ranges) for scan, _ in scans)
        lines.append(
            f"| csail.mcap, {rays:,} rays, 0.05 m | – | {sum(found):.2f} s in all, {found[1]:.2f} s to finish | "
            f"{found[0] / len(scans) * 1e3:.1f} ms (mean) | – |"
        )
    return "\n".join(lines)


def noise() -> str:
    lines = ["| true σ | " + " | ".join(f"estimate from {start:g} m" for start in STARTS) + " | largest error |"]
    lines.append("|---|" + "---|" * (len(STARTS) + 1))
    for noise_std in FOUND_NOISE:
        sessions = [session_of(seed, noise_std) for seed in SEEDS]
        found = [[estimated_noise(session, start) for session in sessions] for start in STARTS]
        cells = " | ".join(f"{statistics.median(values) * 1000:.1f} mm" for values in found)
        worst = max(abs(value / noise_std - 1) for values in found for value in values)
        lines.append(f"| {noise_std * 1000:g} mm | {cells} | {worst:.1%} |")
    return "\n".join(lines)


def estimated_noise(session: Session, start: float) -> float:
    mapper = ForwardMapper(0.01, session.frame.bounds, start_std=start)
    for scan, pose in session.scans:
        mapper.accumulate(scan, pose)
    mapper.finish()
    return mapper.noise_std


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("what", nargs="*", default=("speed", "noise"), help="speed, noise; both where none is named")
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--data", type=Path, default=Path("../shared/data"))
    parser.add_argument("--update", type=Path)
    options = parser.parse_args()
    tables = {"speed": lambda: speed(options.rounds, options.data), "noise": noise}
    for what in options.what:
        name, made = f"forward-{what}", tables[what]()
        print(made)
        if options.update:
            update(options.update, name, made)
