"""Objects of any size, in rooms of any size: F1, errors, time; and the paper's worlds beside them.

    python -m bench.any_size [--sessions 20] [--mapper forward] [--rows …] [--update docs/detect.md]

Sessions on which nothing was trained or chosen (seeds from 95000), recorded and replayed as the commands do, without
a viewer. A primitive is found where kind agrees and the IoU is 0.5 at least. F1's interval is that of 1000 draws of
the sessions with replacement (95 %). Time is that of a replay from the prompt, loading left out, in cells of 1 cm, or
of 5 cm in the warehouse.
"""

from __future__ import annotations

import argparse
import tempfile
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from bench.maps import update
from prim.arrays import FloatArray
from prim.metrics import FOUND_IOU, match_primitives
from recorder.sensors import Lidar
from recorder.session import SessionOptions, record_session
from recorder.world import WorldOptions
from replay.options import ReplayOptions
from replay.pipeline import Pipeline

FIRST_SEED = 95_000
DRAWS = 1000


@dataclass(frozen=True)
class Setting:
    """What a row's sessions are like.

    Attributes:
        world: The world.
        noise_std: Standard deviation of the range noise (m).
        stops: Columns and rows of the places of scans.
        resolution: Side of a cell (m).
        sizes: The sizes that are wanted (m).
        lidar: The scanner, but for its noise.
    """

    world: WorldOptions
    noise_std: float
    stops: tuple[int, int] = (10, 10)
    resolution: float = 0.01
    sizes: tuple[float, float] = ReplayOptions.sizes
    lidar: Lidar = field(default_factory=Lidar)


HALL = WorldOptions(size=(30, 20), per_kind=(1, 3), clutter=(6, 6), room=("doorways",), sizes=(0.5, 2.0))
SAFETY = Lidar(rays=1081, fov=4.712, range_max=30.0)

ROWS: Mapping[str, Setting] = {
    "0.4 to 1.5 m in 6 m": Setting(WorldOptions(size=(6, 6), per_kind=(1, 2), sizes=(0.4, 1.5)), 0.03),
    "0.05 to 1.5 m in 8 m": Setting(WorldOptions(size=(8, 8), per_kind=(1, 3), sizes=(0.05, 1.5)), 0.03, (12, 12)),
    "15 of the paper's sizes in 10 m": Setting(WorldOptions(size=(10, 10), per_kind=(3, 3)), 0.05, (16, 16)),
    "a warehouse: 0.5 to 2 m, six other things": Setting(HALL, 0.02, (12, 8), 0.05, (0.5, 2.0), SAFETY),
    "the paper's worlds, 50 mm": Setting(WorldOptions(), 0.05),
    "the paper's worlds, 250 mm": Setting(WorldOptions(), 0.25),
}


@dataclass(frozen=True)
class Outcome:
    """The evaluation of one session.

    Attributes:
        found: How many true primitives were found.
        reported: How many were reported.
        true: How many there are.
        objects: How many objects of no kind were reported.
        size_errors: Of those that were found (m).
        seconds: The replay's time.
    """

    found: int
    reported: int
    true: int
    objects: int
    size_errors: tuple[float, ...]
    seconds: float


def outcome(setting: Setting, seed: int, mapper: str) -> Outcome:
    """Record a session, replay it, compare."""
    lidar = replace(setting.lidar, noise_std=setting.noise_std)
    options = ReplayOptions(mapper=mapper, resolution=setting.resolution, sizes=setting.sizes)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "session.mcap"
        record_session(path, SessionOptions(seed=seed, world=setting.world, stops=setting.stops, lidar=lidar))
        began = time.perf_counter()
        result = Pipeline(path, options).run()
        seconds = time.perf_counter() - began
    assert result.detections is not None
    reported = [detection.primitive for detection in result.detections.detections.found]
    truth = result.detections.truth
    right = [pair for pair in match_primitives(reported, truth) if pair.same_kind and pair.iou >= FOUND_IOU]
    errors = tuple(
        abs(a - b)
        for pair in right
        for a, b in zip(reported[pair.detection].size, truth[pair.truth].size, strict=True)
    )
    objects = len(result.detections.detections.objects)
    return Outcome(len(right), len(reported), len(truth), objects, errors, seconds)


def f1(outcomes: Sequence[Outcome]) -> float:
    """Return the F1 of sessions together."""
    found, reported, true = (sum(getattr(one, name) for one in outcomes) for name in ("found", "reported", "true"))
    return 2 * found / max(reported + true, 1)


def interval(outcomes: Sequence[Outcome]) -> FloatArray:
    """Return the 95 % interval of F1 by the bootstrap."""
    rng = np.random.default_rng(0)
    draws = [f1([outcomes[k] for k in rng.integers(0, len(outcomes), len(outcomes))]) for _ in range(DRAWS)]
    return np.quantile(draws, (0.025, 0.975))


def row(name: str, outcomes: Sequence[Outcome]) -> str:
    """Return a row of the table."""
    low, high = interval(outcomes)
    errors = np.concatenate([one.size_errors for one in outcomes] or [[]]) * 1000
    seconds = np.median([one.seconds for one in outcomes])
    objects = np.mean([one.objects for one in outcomes])
    middle = f"{np.median(errors):.2f}" if len(errors) else "–"
    return (
        f"| {name} | {len(outcomes)} | {sum(one.true for one in outcomes)} | {f1(outcomes):.3f} "
        f"({low:.3f} to {high:.3f}) | {middle} | {objects:.1f} | {seconds:.1f} |"
    )


HEADING = (
    "| objects, noise of 20 to 50 mm or as named | sessions | primitives | F1 (95 %) | size error, mm (median) | "
    "objects of no kind a session | time of a replay, s |\n|---|---:|---:|---:|---:|---:|---:|"
)


def main() -> None:
    """Parse the options, measure, print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--sessions", type=int, default=20)
    parser.add_argument("--mapper", default="forward")
    parser.add_argument("--rows", nargs="*", choices=ROWS, default=[*ROWS])
    parser.add_argument("--update", type=Path, help="a document whose table is replaced")
    options = parser.parse_args()
    lines = []
    for name in options.rows:
        seeds = range(FIRST_SEED, FIRST_SEED + options.sessions)
        lines.append(row(name, [outcome(ROWS[name], seed, options.mapper) for seed in seeds]))
        print(lines[-1], flush=True)
    if options.update:
        update(options.update, "any size", "\n".join([HEADING, *lines]))


if __name__ == "__main__":
    main()
