"""How fast and how good the detector is, beside what else one could use; one run, in turns, seeds in the code.

    python -m bench.detect --weights WEIGHTS [--mapper forward] [--yolo W.pt] [--update docs/detect.md]

Peers: OpenCV's contours (bench/classical.py) and, with ``--yolo``, YOLO's weights through ultralytics' ``predict``.
Maps are 2 x 2 m with cells of 10 mm. Needs the extra [train].
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
"""Sessions that no network was trained on."""

NOISE = (0.0, 0.05, 0.1, 0.25, 0.5)
ROUNDS = 30


@dataclass(frozen=True)
class Case:
    """A map, and what is in it."""

    grid: OccupancyGrid
    primitives: tuple[Primitive, ...]


def cases(mapper: str, noise_std: float, sessions: int) -> list[Case]:
    """Maps of recorded sessions."""
    made = []
    for seed in range(FIRST_SEED, FIRST_SEED + sessions):
        session = session_of(seed, noise_std)
        one = make_mapper(mapper, 0.01, session.frame.bounds)
        for scan, pose in session.scans:
            one.update(scan, pose)
        made.append(Case(one.finish(), session.primitives))
    return made


def quality(detect: Callable[[OccupancyGrid], Sequence[Primitive]], of: Sequence[Case]) -> tuple[float, ...]:
    """F1 (kind right, outline IoU 0.5), and mean errors of place and width (mm) over what is found."""
    hits = found = there = 0
    place, width = [0.0], [0.0]
    for case in of:
        seen = detect(case.grid)
        pairs = [pair for pair in match_primitives(seen, case.primitives) if pair.found]
        hits, found, there = hits + len(pairs), found + len(seen), there + len(case.primitives)
        place += [1000 * pair.position for pair in pairs]
        width += [1000 * pair.width for pair in pairs]
    return 2 * hits / max(found + there, 1), sum(place) / max(hits, 1), sum(width) / max(hits, 1)


def timed(calls: dict[str, Callable[[], Any]], rounds: int = ROUNDS) -> dict[str, tuple[float, float]]:
    """Best and median time (ms) of each call, all in turns."""
    times: dict[str, list[float]] = {name: [] for name in calls}
    for _ in range(rounds + 2):
        for name, call in calls.items():
            began = time.perf_counter()
            call()
            times[name].append(1000 * (time.perf_counter() - began))
    return {name: (min(all_[2:]), statistics.median(all_[2:])) for name, all_ in times.items()}


def speed(detector: Detector, case: Case, yolo: Path | None) -> list[str]:
    """The table of times for one map."""
    tile = next(tile_frames(case.grid.frame))
    image = tile_image(case.grid, tile, detector.card.style)
    calls: dict[str, Callable[[], Any]] = {
        "**prim**: map to primitives, all networks": lambda: detector.detect(case.grid),
        "prim: YOLO alone": lambda: detector.yolo(image[None], 0.05),
        "OpenCV contours": lambda: classical.detect(case.grid),
    }
    if yolo is not None:
        from ultralytics import YOLO

        model = YOLO(str(yolo))
        calls["ultralytics predict: YOLO alone"] = lambda: model.predict(image, imgsz=224, verbose=False)
    found = timed(calls)
    ours = found["**prim**: map to primitives, all networks"]
    lines = ["| one map of 2 x 2 m | best, ms | median, ms | times prim's |", "|---|---:|---:|---:|"]
    lines += [f"| {name} | {best:.1f} | {mid:.1f} | {best / ours[0]:.2f} |" for name, (best, mid) in found.items()]
    return lines


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--weights", type=Path, required=True)
    parser.add_argument("--mapper", default="forward")
    parser.add_argument("--yolo", type=Path, help="YOLO's .pt, for ultralytics' predict")
    parser.add_argument("--sessions", type=int, default=60)
    parser.add_argument("--update", type=Path)
    options = parser.parse_args()
    detector = Detector.load(options.weights, options.mapper)
    lines = ["| noise | F1 | place, mm | width, mm | OpenCV: F1 | place, mm | width, mm |", "|---|" + "---:|" * 6]
    for noise_std in NOISE:
        of = cases(options.mapper, noise_std, options.sessions)
        if noise_std == NOISE[1]:
            first = of[0]
        ours = quality(lambda grid: [one.primitive for one in detector.detect(grid).found], of)
        peer = quality(classical.detect, of)
        cells = [f"{row[0]:.3f} | {row[1]:.1f} | {row[2]:.1f}" for row in (ours, peer)]
        lines.append(f"| {1000 * noise_std:g} mm | {' | '.join(cells)} |")
    table = [*speed(detector, first, options.yolo), "", *lines]
    print("\n".join(table))
    if options.update:
        update(options.update, "detect", "\n".join(table))


if __name__ == "__main__":
    main()
