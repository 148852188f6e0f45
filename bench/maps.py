"""Scores of each mapper's maps, per noise level: medians over recorded sessions.

    python -m bench.maps [--sessions 50] [--update docs/forward.md] [--short README.md]

Sessions have seeds from 50000, on which no option of a mapper was chosen; at all noise levels they have the same
worlds and poses. Beside the mappers stand two variants of prob: with the Gaussian sensor model and the true noise;
and with its log-odds calibrated by a logistic regression for each noise level, on sessions of other seeds.
"""

from __future__ import annotations

import argparse
import os
import statistics
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from bench.sessions import Session, recorded
from mapping.map_metrics import MapScores, map_scores
from mapping.mapper import Mapper, make_mapper
from prim.choices import MapperName, SensorModelName
from recorder.sensors import Lidar
from recorder.session import SessionOptions

NOISE_LEVELS = (0.0, 0.05, 0.075, 0.1, 0.25, 0.375, 0.5)
CALIBRATED, GAUSSIAN = "prob, calibrated", "prob, Gaussian"
ROWS = (MapperName.DET, MapperName.PROB, CALIBRATED, GAUSSIAN, MapperName.FORWARD)
COLUMNS = ("F1", "F1 within 3", "precision", "recall", "free", "AUC")
FIRST_SEED = 50_000
CALIBRATION_SEED, CALIBRATION_SESSIONS = 30_000, 8

Scores = tuple[float | None, ...]
Line = tuple[float, float]


def session_of(seed: int, noise_std: float) -> Session:
    return recorded(SessionOptions(seed=seed, lidar=Lidar(noise_std=noise_std)))


def probability(mapper: Mapper, session: Session) -> NDArray[np.float32]:
    """Return the probabilities of occupancy (rows, cols) of a session's scans.

    Args:
        mapper: An empty mapper.
        session: The session.

    Returns:
        The map.
    """
    for scan, pose in session.scans:
        mapper.update(scan, pose)
    return mapper.finish().probability


def odds_of(p: NDArray[np.float32]) -> NDArray[np.float64]:
    clipped = np.clip(p.astype(np.float64), 1e-12, 1 - 1e-7)
    return np.asarray(np.log(clipped / (1 - clipped)))


def calibration(noise_std: float) -> Line:
    """Return intercept and slope of the logistic regression of the truth on prob's log-odds."""
    odds, truth = [], []
    for seed in range(CALIBRATION_SEED, CALIBRATION_SEED + CALIBRATION_SESSIONS):
        session = session_of(seed, noise_std)
        assert session.truth is not None
        p = probability(make_mapper(MapperName.PROB, 0.01, session.frame.bounds), session)
        used = session.truth.occupied | session.truth.free
        odds.append(odds_of(p[used]))
        truth.append(session.truth.occupied[used])
    x = np.column_stack((np.ones(sum(map(len, odds))), np.concatenate(odds)))
    y = np.concatenate(truth).astype(float)
    w = np.zeros(2)
    for _ in range(30):
        p = 1 / (1 + np.exp(-np.clip(x @ w, -40, 40)))
        w += np.linalg.solve((x * (p * (1 - p) + 1e-9)[:, None]).T @ x + 1e-6 * np.eye(2), x.T @ (y - p))
    return float(w[0]), float(w[1])


def scores_of(job: tuple[int, float, Line]) -> dict[str, Scores]:
    """Return each row's scores of one session."""
    seed, noise_std, (intercept, slope) = job
    session = session_of(seed, noise_std)
    bounds = session.frame.bounds
    maps = {name.value: probability(make_mapper(name, 0.01, bounds), session) for name in MapperName}
    maps[CALIBRATED] = 1 / (1 + np.exp(-(intercept + slope * odds_of(maps[MapperName.PROB]))))
    gaussian = make_mapper(MapperName.PROB, 0.01, bounds, SensorModelName.GAUSSIAN, max(noise_std, 1e-3))
    maps[GAUSSIAN] = probability(gaussian, session)
    assert session.truth is not None
    occupied, free = session.truth.occupied, session.truth.free
    return {
        name: as_columns(map_scores(p, occupied, free), map_scores(p, occupied, free, 3)) for name, p in maps.items()
    }


def as_columns(scores: MapScores, within_three: MapScores) -> Scores:
    return (
        scores.occupied_f1,
        within_three.occupied_f1,
        scores.occupied_precision,
        scores.occupied_recall,
        scores.free_accuracy,
        scores.auc,
    )


def median(values: list[float | None]) -> str:
    known = [value for value in values if value is not None]
    return f"{statistics.median(known):.3f}" if known else "–"


def measure(sessions: int, first_seed: int = FIRST_SEED) -> dict[tuple[float, str], list[str]]:
    """Compute the medians of each noise level and row.

    Args:
        sessions: Number of sessions.
        first_seed: Seed of the first one.

    Returns:
        Medians of the columns by noise level and row.
    """
    medians = {}
    with ProcessPoolExecutor(os.cpu_count()) as pool:
        lines = list(pool.map(calibration, NOISE_LEVELS))
        for noise_std, line in zip(NOISE_LEVELS, lines, strict=True):
            jobs = [(seed, noise_std, line) for seed in range(first_seed, first_seed + sessions)]
            found = list(pool.map(scores_of, jobs, chunksize=2))
            for row in ROWS:
                columns = zip(*(scores[row] for scores in found), strict=True)
                medians[noise_std, row] = [median(list(column)) for column in columns]
                print(noise_std, row, *medians[noise_std, row], flush=True)
    return medians


def table(medians: dict[tuple[float, str], list[str]], rows: tuple[str, ...], columns: tuple[str, ...]) -> str:
    chosen = [COLUMNS.index(column) for column in columns]
    lines = ["| LiDAR noise σ | mapper | " + " | ".join(columns) + " |", "|---|---|" + "---|" * len(columns)]
    for noise_std in NOISE_LEVELS:
        for row in rows:
            cells = " | ".join(medians[noise_std, row][k] for k in chosen)
            lines.append(f"| {noise_std * 1000:g} mm | {row} | {cells} |")
    return "\n".join(lines)


def update(path: Path, name: str, content: str) -> None:
    """Replace a table between its two marks in a document.

    Args:
        path: The document.
        name: Name of the marks.
        content: The table.
    """
    before, _, rest = path.read_text(encoding="utf-8").partition(f"<!-- {name} -->")
    after = rest.partition(f"<!-- /{name} -->")[2]
    path.write_text(f"{before}<!-- {name} -->\n{content}\n<!-- /{name} -->{after}", encoding="utf-8")


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--sessions", type=int, default=50)
    parser.add_argument("--first-seed", type=int, default=FIRST_SEED)
    parser.add_argument("--update", type=Path, help="the document that gets the whole table")
    parser.add_argument("--short", type=Path, help="the document that gets the short one")
    options = parser.parse_args()
    measured = measure(options.sessions, options.first_seed)
    if options.update:
        update(options.update, "bench-maps", table(measured, ROWS, COLUMNS))
    if options.short:
        update(options.short, "bench-maps", table(measured, tuple(MapperName), ("F1", "F1 within 3", "AUC")))
