"""How well each mapper's map foretells ranges that it has not seen.

    python -m bench.heldout [--data ../shared/data] [--update docs/forward.md]

Every fifth scan is held out. The map of the others is taken for chances to stop a ray, clipped, and the held-out
ranges are scored under the forward sensor model: log-likelihood per ray, in nats, larger is better. The clip, the
noise and the share of wild measurements are fitted for each mapper on the scans that it has seen.
"""

from __future__ import annotations

import argparse
import os
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from bench.maps import session_of, update
from bench.sessions import Session, posed_scans
from mapping.forward.level import Level, Noise, Rays
from mapping.forward.mapper import ForwardMapper
from mapping.grid import GridFrame
from mapping.kernels import end_extent
from mapping.mapper import make_mapper
from prim.log.mcap import LogReader
from prim.scan import Scan
from prim.se2 import Pose2D

EVERY = 5
CLIPS = (1e-5, 1e-4, 1e-3, 1e-2)
NOISE_PASSES = 12
SEEDS = range(5)
LOGS = (("csail.mcap", 0.05), ("pillars4.mcap", 0.02))

Posed = list[tuple[Scan, Pose2D]]


def rays_of(scans: Posed) -> Rays:
    rays = Rays()
    for scan, pose in scans:
        rays.add(scan, pose)
    return rays


def frame_of(scans: Posed, resolution: float) -> GridFrame:
    """The frame that holds all hits."""
    extents = np.array(
        [
            end_extent(
                scan.ranges,
                scan.directions,
                (pose.x, pose.y, np.cos(pose.theta), np.sin(pose.theta)),
                (scan.range_min, scan.range_max),
                1 / resolution,
            )
            for scan, pose in scans
        ]
    )
    row, col = extents[:, :2].min(axis=0).tolist()
    last_row, last_col = extents[:, 2:].max(axis=0).tolist()
    return GridFrame(resolution, row, col, last_row - row + 1, last_col - col + 1)


def score(chances: NDArray[np.float32], frame: GridFrame, seen: Rays, unseen: Rays) -> tuple[float, float]:
    """Log-likelihood per held-out ray and the noise (m), with the clip and the noise that fit the seen rays best."""
    best = (-np.inf, 0.0, 0.0)
    for clip in CLIPS:
        level, noise = Level(frame, 0.5), Noise(0.1, 0.01)
        level.restore(np.clip(chances, clip, 1 - clip).astype(np.float32))
        for _ in range(NOISE_PASSES):
            _, totals = level.expect(seen, noise)
            noise = totals.noise(noise, frame.resolution)
        fit = level.expect(seen, noise)[1].per_ray
        if fit > best[0]:
            best = fit, level.expect(unseen, noise)[1].per_ray, noise.std
    return best[1], best[2]


def compare(scans: Posed, frame: GridFrame) -> dict[str, tuple[float, float]]:
    """Each mapper's score."""
    seen = [item for i, item in enumerate(scans) if i % EVERY]
    unseen = rays_of(scans[::EVERY])
    chances = {}
    for name in ("det", "prob"):
        mapper = make_mapper(name, frame.resolution, frame.bounds)
        for scan, pose in seen:
            mapper.update(scan, pose)
        chances[name] = mapper.finish().probability
    forward = ForwardMapper(frame.resolution, frame.bounds, threads=1)
    for scan, pose in seen:
        forward.keep(scan, pose)
    fit = forward.fit()
    chances["forward, grid()"] = fit.grid().probability
    chances["forward, its stopping chances"] = fit.stopping
    return {name: score(array, frame, rays_of(seen), unseen) for name, array in chances.items()}


def of_session(job: tuple[int, float]) -> dict[str, tuple[float, float]]:
    session: Session = session_of(*job)
    return compare(session.scans, session.frame)


def rows(data: Path) -> Iterator[tuple[str, dict[str, tuple[float, float]]]]:
    with ProcessPoolExecutor(os.cpu_count()) as pool:
        for noise_std in (0.05, 0.25, 0.5):
            found = list(pool.map(of_session, [(seed, noise_std) for seed in SEEDS]))
            mean = {name: tuple(np.mean([scores[name] for scores in found], axis=0)) for name in found[0]}
            yield f"sessions, σ = {noise_std * 1000:g} mm (mean of {len(SEEDS)})", mean
    for name, resolution in LOGS:
        if (data / name).exists():
            with LogReader(data / name) as log:
                scans = posed_scans(log)
            yield f"{name}, {resolution} m", compare(scans, frame_of(scans, resolution))


def table(data: Path) -> str:
    lines: list[str] = []
    for what, scores in rows(data):
        if not lines:
            lines = ["| log | " + " | ".join(scores) + " |", "|---|" + "---|" * len(scores)]
        cells = " | ".join(f"{value:.3f} (σ {std * 1000:.0f} mm)" for value, std in scores.values())
        lines.append(f"| {what} | {cells} |")
        print(lines[-1], flush=True)
    return "\n".join(lines)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--data", type=Path, default=Path("../shared/data"))
    parser.add_argument("--update", type=Path)
    options = parser.parse_args()
    made = table(options.data)
    if options.update:
        update(options.update, "held-out", made)
