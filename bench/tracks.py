"""Ids over driven sessions: does each primitive keep one from its first confirmed detection on?

    python -m bench.tracks [--sessions 50] [--mapper forward] [--every 20] [--update docs/detect.md]

Sessions are driven for 40 s (seeds from 70000), poses are exact, noise is 50 mm; the detector looks every 20 scans.
A primitive is kept where all confirmed detections of it (outlines overlap by half) have the id of the first; false
are tracks that are confirmed in the last look and overlap no primitive by half.
"""

from __future__ import annotations

import argparse
import os
import tempfile
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from functools import partial
from pathlib import Path

from bench.maps import update
from prim.metrics import match_primitives
from recorder.sensors import Lidar
from recorder.session import SessionOptions, record_session
from replay.detection import DetectionResult
from replay.options import ReplayOptions
from replay.pipeline import Pipeline
from replay.viewing.protocol import NullViewer

FIRST_SEED = 70_000


class DetectionCollector(NullViewer):
    """A viewer that collects all detections."""

    def __init__(self) -> None:
        self.results: list[DetectionResult] = []

    def show_detections(self, position: int, stamp: int, result: DetectionResult) -> None:
        """See :meth:`.Viewer.show_detections`."""
        self.results.append(result)


def confirmed_ids(result: DetectionResult) -> dict[int, int]:
    """Return the id of each true primitive whose track is confirmed and which it overlaps by half."""
    found = [detection.primitive for detection in result.detections.found]
    pairs = match_primitives(found, result.truth)
    identities = {pair.truth: result.identities[pair.detection] for pair in pairs if pair.iou >= 0.5}
    return {truth: identity.id for truth, identity in identities.items() if identity.confirmed}


def session(seed: int, mapper: str, every: int) -> tuple[int, int, int]:
    """How many primitives kept their id, how many were ever confirmed, how many false tracks there are in the end."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "driven.mcap"
        options = SessionOptions(seed=seed, motion="drive", duration=40.0, rate=5.0, lidar=Lidar(noise_std=0.05))
        record_session(path, options)
        collector = DetectionCollector()
        Pipeline(path, ReplayOptions(mapper=mapper, detect_every=every), collector).run()
    first: dict[int, int] = {}
    kept: dict[int, bool] = {}
    for result in collector.results:
        for truth, identity in confirmed_ids(result).items():
            kept[truth] = kept.get(truth, True) and first.setdefault(truth, identity) == identity
    last = collector.results[-1]
    there = {pair.detection for pair in match_primitives([one.primitive for one in last.detections.found], last.truth)
             if pair.iou >= 0.5}  # fmt: skip
    false = sum(one.confirmed for k, one in enumerate(last.identities) if k not in there)
    return sum(kept.values()), len(kept), false


def table(of: Sequence[tuple[int, int, int]]) -> str:
    kept, seen, false = (sum(column) for column in zip(*of, strict=True))
    return (
        "| driven sessions | primitives confirmed | kept one id | false tracks a session, in the end |\n"
        "|---:|---:|---:|---:|\n"
        f"| {len(of)} | {seen} | {kept / max(seen, 1):.1%} | {false / len(of):.2f} |"
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--sessions", type=int, default=50)
    parser.add_argument("--mapper", default="forward")
    parser.add_argument("--every", type=int, default=20)
    parser.add_argument("--workers", type=int, default=os.cpu_count())
    parser.add_argument("--update", type=Path)
    options = parser.parse_args()
    seeds = range(FIRST_SEED, FIRST_SEED + options.sessions)
    with ProcessPoolExecutor(options.workers) as pool:
        found = list(pool.map(partial(session, mapper=options.mapper, every=options.every), seeds))
    print(table(found))
    if options.update:
        update(options.update, "tracks", table(found))


if __name__ == "__main__":
    main()
