"""Calibration of the forward map's probabilities of occupancy: the regression, and its reliability.

    python -m bench.calibrate fit          # coefficients of mapping.forward.calibration, from recorded sessions
    python -m bench.calibrate check        # reliability curve on other sessions; --update docs/forward.md

Training seeds begin at 10000, those of the check at 20000; no other benchmark uses them.
"""

from __future__ import annotations

import argparse
import math
import os
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from itertools import pairwise
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from bench.maps import NOISE_LEVELS, update
from bench.sessions import recorded
from mapping.forward.calibration import CALIBRATION, is_known, surface_probability
from mapping.forward.mapper import ForwardMapper
from recorder.sensors import Lidar
from recorder.session import SessionOptions

FIT_SEED, CHECK_SEED = 10_000, 20_000

KINDS = ((500, (10, 10), 0.01), (360, (6, 7), 0.01), (180, (8, 8), 0.01), (500, (8, 8), 0.02))
"""Beams, stops (columns, rows) and resolution (m) of the sessions."""

RIDGE = 0.01
"""Weight of the ridge penalty on the scaled coefficients."""

BINS = np.array([0.0, 0.01, 0.05, 0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9, 0.95, 0.99, 1.0])

Job = tuple[int, float, tuple[int, tuple[int, int], float]]
"""Seed, standard deviation of the range noise (m), and kind of a session."""


def jobs(first_seed: int, sessions: int) -> Iterator[Job]:
    for k in range(sessions):
        for noise_std in (*NOISE_LEVELS, 0.02):
            yield first_seed + k, noise_std, KINDS[k % len(KINDS)]


def features(job: Job) -> tuple[Job, NDArray[np.float64], NDArray[np.bool_], NDArray[np.float32]]:
    """Map a session and compute the regression's features of the cells that are truly occupied or free, and known.

    Cells beside a surface count as free where the noise is smaller than a cell; where it is larger they cannot be
    separated from the surface and count as neither, as in the map scores.

    Args:
        job: The session.

    Returns:
        The job; features (N, 12); which cells (N,) are truly occupied; the map's probabilities (N,).
    """
    seed, noise_std, (rays, stops, resolution) = job
    session = recorded(
        SessionOptions(seed=seed, stops=stops, lidar=Lidar(rays=rays, noise_std=noise_std)), resolution
    )
    assert session.truth is not None
    mapper = ForwardMapper(resolution, session.frame.bounds, threads=1)
    for scan, pose in session.scans:
        mapper.accumulate(scan, pose)
    fit = mapper.fit()
    free = session.truth.crossed if noise_std < resolution else session.truth.free
    used = (session.truth.occupied | free) & is_known(fit.arrival_probability, fit.visits)
    own, neighbourhood = (
        log_odds(array[used]) for array in surface_probability(fit.stopping, fit.arrival_probability, fit.visits)
    )
    stopping = np.log(fit.stopping[used].astype(np.float64))
    log_noise = math.log(fit.noise.std / resolution)
    columns = np.column_stack(
        [v * log_noise**k for v in (np.ones_like(own), own, neighbourhood, stopping) for k in range(3)]
    )
    return job, columns, session.truth.occupied[used], fit.grid().probability[used]


def log_odds(probability: NDArray[np.float32]) -> NDArray[np.float64]:
    margin = CALIBRATION.probability_margin
    p = np.clip(probability.astype(np.float64), margin, 1 - margin)
    return np.asarray(np.log(p / (1 - p)))


def fit(sessions: int) -> None:
    """Fit the logistic regression by Newton's method and print its coefficients."""
    with ProcessPoolExecutor(os.cpu_count()) as pool:
        found = list(pool.map(features, jobs(FIT_SEED, sessions)))
    x = np.concatenate([columns for _, columns, _, _ in found])
    y = np.concatenate([occupied for _, _, occupied, _ in found]).astype(float)
    scale = np.sqrt((x**2).mean(axis=0))
    x /= scale
    w = np.zeros(x.shape[1])
    for _ in range(50):
        p = 1 / (1 + np.exp(-np.clip(x @ w, -40, 40)))
        curvature = (x * (p * (1 - p) + 1e-12)[:, None]).T @ x + RIDGE * np.eye(len(w))
        w += np.linalg.solve(curvature, x.T @ (y - p) - RIDGE * w)
    print(f"{len(found)} sessions, {len(y):,} cells")
    print((w / scale).reshape(-1, 3).round(3).tolist())


def check(sessions: int) -> str:
    """Return a table: per bin of probability and range of noise, the number of cells and the share occupied."""
    with ProcessPoolExecutor(os.cpu_count()) as pool:
        found = list(pool.map(features, jobs(CHECK_SEED, sessions)))
    levels = {"σ ≤ 0.1 m": lambda std: std <= 0.1, "σ ≥ 0.25 m": lambda std: std >= 0.25}
    lines = [
        "| probability in the map | " + " | ".join(f"{name}: cells | share occupied" for name in levels) + " |",
        "|---|" + "---|---|" * len(levels),
    ]
    chosen = [
        (
            np.concatenate([p for job, _, _, p in found if is_level(job[1])]),
            np.concatenate([o for job, _, o, _ in found if is_level(job[1])]),
        )
        for is_level in levels.values()
    ]
    for low, high in pairwise(BINS):
        cells = []
        for p, occupied in chosen:
            within = (p >= low) & ((p < high) if high < 1 else (p <= high))
            share = f"{occupied[within].mean():.3f}" if within.any() else "–"
            cells.append(f"{np.count_nonzero(within):,} | {share}")
        lines.append(f"| {low:g}–{high:g} | " + " | ".join(cells) + " |")
    errors = []
    for p, occupied in chosen:
        place = np.digitize(p, BINS[1:-1])
        errors.append(
            sum(abs(p[place == k].sum() - occupied[place == k].sum()) for k in range(len(BINS) - 1)) / len(p)
        )
    lines.append("| expected calibration error | " + " | ".join(f" | {error:.4f}" for error in errors) + " |")
    return "\n".join(lines)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("what", choices=("fit", "check"))
    parser.add_argument("--sessions", type=int, default=24)
    parser.add_argument("--update", type=Path)
    options = parser.parse_args()
    if options.what == "fit":
        fit(options.sessions)
    else:
        made = check(options.sessions)
        print(made)
        if options.update:
            update(options.update, "calibration", made)
