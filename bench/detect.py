"""Accuracy and speed of the detector, compared with OpenCV's contours and ultralytics' ``predict``.

    python -m bench.detect --weights WEIGHTS [--mapper forward] [--yolo W.pt] [--update docs/detect.md]

Accuracy: maps of recorded sessions, 2 x 2 m with cells of 10 mm, seeds from 40000; the baseline is
bench/classical.py. Speed: all are timed in turns within one run; ``--yolo`` adds YOLO's weights run by ultralytics.
Needs the extra [train].
"""

from __future__ import annotations

import argparse
import statistics
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from bench import classical
from bench.maps import session_of, update
from detect.detector import Detector
from detect.networks.tiles import tile_frames, tile_image
from mapping.grid import OccupancyGrid
from mapping.mapper import make_mapper
from prim.metrics import match_primitives
from prim.shapes import Primitive

FIRST_SEED = 40_000
"""First seed of sessions that no network was trained on."""

NOISE = (0.0, 0.05, 0.1, 0.25, 0.5)
"""Standard deviations of the range noise (m)."""

ROUNDS = 30
WARM_UP = 2


@dataclass(frozen=True)
class Case:
    """A map and its true primitives."""

    grid: OccupancyGrid
    primitives: tuple[Primitive, ...]


def cases(mapper: str, noise_std: float, sessions: int) -> list[Case]:
    """Map recorded sessions.

    Args:
        mapper: Name of the mapper.
        noise_std: Standard deviation of the range noise (m).
        sessions: Number of sessions.

    Returns:
        Their maps with the true primitives.
    """
    mapped = []
    for seed in range(FIRST_SEED, FIRST_SEED + sessions):
        session = session_of(seed, noise_std)
        session_mapper = make_mapper(mapper, 0.01, session.frame.bounds)
        for scan, pose in session.scans:
            session_mapper.update(scan, pose)
        mapped.append(Case(session_mapper.finish(), session.primitives))
    return mapped


def quality(detect: Callable[[OccupancyGrid], Sequence[Primitive]], mapped: Sequence[Case]) -> tuple[float, ...]:
    """Evaluate a detector.

    Args:
        detect: The detector.
        mapped: Maps with the true primitives.

    Returns:
        F1 (correct kind, outline IoU of at least 0.5), and the mean errors of position and width (mm) of the true
        positives.
    """
    hits = detected = true = 0
    position, width = [0.0], [0.0]
    for case in mapped:
        primitives = detect(case.grid)
        pairs = [pair for pair in match_primitives(primitives, case.primitives) if pair.found]
        hits, detected, true = hits + len(pairs), detected + len(primitives), true + len(case.primitives)
        position += [1000 * pair.position for pair in pairs]
        width += [1000 * pair.width for pair in pairs]
    return 2 * hits / max(detected + true, 1), sum(position) / max(hits, 1), sum(width) / max(hits, 1)


def timed(calls: dict[str, Callable[[], Any]], rounds: int = ROUNDS) -> dict[str, tuple[float, float]]:
    """Time calls in turns, after WARM_UP rounds that do not count.

    Args:
        calls: The calls by name.
        rounds: Number of rounds.

    Returns:
        Best and median time (ms) of each call.
    """
    times: dict[str, list[float]] = {name: [] for name in calls}
    for _ in range(rounds + WARM_UP):
        for name, call in calls.items():
            began = time.perf_counter()
            call()
            times[name].append(1000 * (time.perf_counter() - began))
    counted = {name: values[WARM_UP:] for name, values in times.items()}
    return {name: (min(values), statistics.median(values)) for name, values in counted.items()}


def speed(detector: Detector, case: Case, yolo: Path | None) -> list[str]:
    """Return the table of run times on one map.

    Args:
        detector: The detector.
        case: The map.
        yolo: YOLO's .pt file; None: ultralytics is left out.

    Returns:
        The lines of the table.
    """
    tile = next(tile_frames(case.grid.frame))
    image = tile_image(case.grid, tile, detector.card.style)
    calls: dict[str, Callable[[], Any]] = {
        "**prim**: map to primitives, all networks": lambda: detector.detect(case.grid),
        "prim: YOLO alone": lambda: detector.yolo(image[None], 0.05),
        "OpenCV contours": lambda: classical.detect(case.grid),
    }
    if yolo is not None:
        from detect.training.offline import load_ultralytics

        model = load_ultralytics().YOLO(str(yolo))
        calls["ultralytics predict: YOLO alone"] = lambda: model.predict(image, imgsz=224, verbose=False)
    times = timed(calls)
    ours = times["**prim**: map to primitives, all networks"]
    lines = ["| one map of 2 x 2 m | best, ms | median, ms | best, relative to prim |", "|---|---:|---:|---:|"]
    lines += [f"| {name} | {best:.1f} | {mid:.1f} | {best / ours[0]:.2f} |" for name, (best, mid) in times.items()]
    return lines


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--weights", type=Path, required=True)
    parser.add_argument("--mapper", default="forward")
    parser.add_argument("--yolo", type=Path, help="YOLO's .pt file, to be run by ultralytics")
    parser.add_argument("--sessions", type=int, default=60)
    parser.add_argument("--update", type=Path)
    options = parser.parse_args()
    detector = Detector.load(options.weights, options.mapper)
    lines = [
        "| noise | F1 | position, mm | width, mm | OpenCV: F1 | position, mm | width, mm |",
        "|---|" + "---:|" * 6,
    ]
    for noise_std in NOISE:
        mapped = cases(options.mapper, noise_std, options.sessions)
        if noise_std == NOISE[1]:
            first = mapped[0]
        ours = quality(lambda grid: [detection.primitive for detection in detector.detect(grid).found], mapped)
        baseline = quality(classical.detect, mapped)
        cells = [f"{row[0]:.3f} | {row[1]:.1f} | {row[2]:.1f}" for row in (ours, baseline)]
        lines.append(f"| {1000 * noise_std:g} mm | {' | '.join(cells)} |")
    table = [*speed(detector, first, options.yolo), "", *lines]
    print("\n".join(table))
    if options.update:
        update(options.update, "detect", "\n".join(table))


if __name__ == "__main__":
    main()
