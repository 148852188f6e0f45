"""Persistence of track ids over driven sessions, and false tracks.

    python -m bench.tracks [--sessions 50] [--mapper forward] [--every 20] [--update docs/detect.md]

Sessions are driven for 40 s (seeds from 70000) with exact poses and a range noise of 50 mm; the detector runs every
20 scans. A primitive's id persists where all confirmed detections of it (outline IoU of at least 0.5) have the id of
the first one. A false track is one that is confirmed at the end and overlaps no primitive with an IoU of 0.5.
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
from replay.detection_stage import DetectionResult
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
    """Return by index of the true primitives the ids of confirmed tracks that overlap them (IoU of 0.5 or more)."""
    detected = [detection.primitive for detection in result.detections.found]
    pairs = match_primitives(detected, result.truth)
    identities = {pair.truth: result.identities[pair.detection] for pair in pairs if pair.iou >= 0.5}
    return {truth: identity.id for truth, identity in identities.items() if identity.confirmed}


def session(seed: int, mapper: str, every: int) -> tuple[int, int, int]:
    """Record and replay a session, and evaluate its tracks.

    Args:
        seed: The session's seed.
        mapper: Name of the mapper.
        every: The detector runs every so many scans.

    Returns:
        Number of primitives whose id persisted, of those that were ever confirmed, and of false tracks at the end.
    """
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "driven.mcap"
        options = SessionOptions(seed=seed, motion="drive", duration=40.0, rate=5.0, lidar=Lidar(noise_std=0.05))
        record_session(path, options)
        collector = DetectionCollector()
        Pipeline(path, ReplayOptions(mapper=mapper, detect_every=every), collector).run()
    first: dict[int, int] = {}
    persistent: dict[int, bool] = {}
    for result in collector.results:
        for truth, identity in confirmed_ids(result).items():
            persistent[truth] = persistent.get(truth, True) and first.setdefault(truth, identity) == identity
    last = collector.results[-1]
    detected = [detection.primitive for detection in last.detections.found]
    true = {pair.detection for pair in match_primitives(detected, last.truth) if pair.iou >= 0.5}
    false = sum(identity.confirmed for k, identity in enumerate(last.identities) if k not in true)
    return sum(persistent.values()), len(persistent), false


def table(results: Sequence[tuple[int, int, int]]) -> str:
    persistent, confirmed, false = (sum(column) for column in zip(*results, strict=True))
    return (
        "| driven sessions | primitives confirmed | id persistent | false tracks per session, at the end |\n"
        "|---:|---:|---:|---:|\n"
        f"| {len(results)} | {confirmed} | {persistent / max(confirmed, 1):.1%} | {false / len(results):.2f} |"
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
        results = list(pool.map(partial(session, mapper=options.mapper, every=options.every), seeds))
    print(table(results))
    if options.update:
        update(options.update, "tracks", table(results))


if __name__ == "__main__":
    main()
