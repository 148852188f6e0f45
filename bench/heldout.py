"""How well each mapper's map predicts held-out ranges.

    python -m bench.heldout [--data ../shared/data] [--update docs/forward.md]

Every fifth scan is held out. The map of the others is taken as stopping probabilities, clipped, and the held-out
ranges are scored under the forward sensor model: log-likelihood per ray, in nats, larger is better. The clipping, the
range noise and the outlier share are fitted for each mapper on the scans that its map is made of.
"""

from __future__ import annotations

import argparse
import os
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from bench.maps import FIRST_SEED, session_of, update
from bench.sessions import Session, scans_with_poses
from mapping.forward.level import Level, RangeNoise, RayStore
from mapping.forward.mapper import ForwardMapper
from mapping.grid import GridFrame
from mapping.mapper import make_mapper
from prim.choices import MapperName
from prim.log import open_log
from prim.scan import Scan
from prim.se2 import Pose2D
from replay.mapping.bounds import extent_of_scans

EVERY = 5
CLIPS = (1e-5, 1e-4, 1e-3, 1e-2)
NOISE_PASSES = 12
SEEDS = range(FIRST_SEED, FIRST_SEED + 5)
LOGS = (("csail.mcap", 0.05), ("pillars4.mcap", 0.02))

Posed = list[tuple[Scan, Pose2D]]
"""Scans with the pose of their laser in the map frame."""


def rays_of(scans: Posed) -> RayStore:
    rays = RayStore()
    for scan, pose in scans:
        rays.add(scan, pose)
    return rays


def frame_of(scans: Posed, resolution: float) -> GridFrame:
    """Compute the frame of the end points of all beams; the side of a cell is ``resolution`` (m)."""
    bounds = extent_of_scans(scans, resolution)
    assert bounds is not None
    return GridFrame.covering(bounds, resolution)


def score(
    stopping: NDArray[np.float32], frame: GridFrame, training: RayStore, held_out: RayStore
) -> tuple[float, float]:
    """Score a map by held-out rays.

    Args:
        stopping: The map (rows, cols), taken as stopping probabilities.
        frame: Its frame.
        training: The rays that the clipping and the noise are fitted to.
        held_out: The rays that are scored.

    Returns:
        The mean log-likelihood of a held-out ray (nats), and the standard deviation of the fitted noise (m).
    """
    level, noise = fit_level(stopping, frame, training)
    return level.expect(held_out, noise)[1].mean_log_likelihood, noise.std


def fit_level(stopping: NDArray[np.float32], frame: GridFrame, training: RayStore) -> tuple[Level, RangeNoise]:
    """Fit the clipping of a map, and the noise, to the rays that it is made of.

    Args:
        stopping: The map (rows, cols), taken as stopping probabilities.
        frame: Its frame.
        training: The rays.

    Returns:
        The clipped map, and the noise.
    """
    best: tuple[float, Level, RangeNoise] | None = None
    for clip in CLIPS:
        level, noise = Level(frame, 0.5), RangeNoise(0.1, 0.01)
        level.set_parameters(np.clip(stopping, clip, 1 - clip).astype(np.float32))
        for _ in range(NOISE_PASSES):
            _, statistics = level.expect(training, noise)
            noise = statistics.range_noise(noise, frame.resolution)
        fit = level.expect(training, noise)[1].mean_log_likelihood
        if best is None or fit > best[0]:
            best = fit, level, noise
    assert best is not None
    return best[1], best[2]


def compare(scans: Posed, frame: GridFrame) -> dict[str, tuple[float, float]]:
    """Score each mapper's map of four fifths of the scans by the others, see :func:`score`.

    Args:
        scans: All scans.
        frame: The maps' frame.

    Returns:
        Per mapper the mean log-likelihood of a held-out ray (nats) and the noise (m).
    """
    training = [item for i, item in enumerate(scans) if i % EVERY]
    held_out = rays_of(scans[::EVERY])
    maps = {}
    for name in (MapperName.DET.value, MapperName.PROB.value):
        mapper = make_mapper(name, frame.resolution, frame.bounds)
        for scan, pose in training:
            mapper.update(scan, pose)
        maps[name] = mapper.finish().probability
    forward = ForwardMapper(frame.resolution, frame.bounds, threads=1)
    for scan, pose in training:
        forward.accumulate(scan, pose)
    fit = forward.fit()
    maps["forward, grid()"] = fit.grid().probability
    maps["forward, stopping probabilities"] = fit.stopping
    return {name: score(array, frame, rays_of(training), held_out) for name, array in maps.items()}


def scores_of_session(job: tuple[int, float]) -> dict[str, tuple[float, float]]:
    session: Session = session_of(*job)
    return compare(session.scans, session.frame)


def rows(data: Path) -> Iterator[tuple[str, dict[str, tuple[float, float]]]]:
    with ProcessPoolExecutor(os.cpu_count()) as pool:
        for noise_std in (0.05, 0.25, 0.5):
            found = list(pool.map(scores_of_session, [(seed, noise_std) for seed in SEEDS]))
            mean = {name: tuple(np.mean([scores[name] for scores in found], axis=0)) for name in found[0]}
            yield f"sessions, σ = {noise_std * 1000:g} mm (mean of {len(SEEDS)})", mean
    for name, resolution in LOGS:
        if (data / name).exists():
            with open_log(data / name) as log:
                scans = scans_with_poses(log)
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
