"""Persistence of track ids over driven sessions, places of primitives that were pushed, and false tracks.

    python -m bench.tracks [--sessions 50] [--mapper forward] [--every 20] [--update docs/detect.md]

Sessions are driven for 40 s at 5 scans a second (seeds from 70000; with primitives that can be pushed from 90000)
with exact poses and a range noise of 50 mm; the detector runs every 20 scans. A primitive is pushed where its path is
longer than 20 mm. Its id persists where all confirmed detections of it (IoU of at least 0.5) have the id of the
first one. Its place is compared with the truth at the second look since it was pushed, and at the end; a
primitive that is not detected counts as infinitely far. A false track is one that is confirmed at the end and
overlaps no primitive with an IoU of 0.5.
"""

from __future__ import annotations

import argparse
import math
import os
import tempfile
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from bench.maps import update
from prim.metrics import match_primitives
from recorder.sensors import Lidar
from recorder.session import SessionOptions, record_session
from replay.detection.stage import DetectionResult, TrackIdentity
from replay.options import ReplayOptions
from replay.pipeline import Pipeline
from replay.viewing.protocol import NullViewer

FIRST_SEED = {False: 70_000, True: 90_000}
"""First seed of sessions without and with primitives that can be pushed."""

PUSHED = 0.02
"""m; primitives whose path is longer were pushed."""

SAME_IOU = 0.5
"""Outlines with this intersection over union are one primitive's."""

STILL = 1e-3
"""m; those that moved by less since the look before stand."""


class DetectionCollector(NullViewer):
    """A viewer that collects all detections."""

    def __init__(self) -> None:
        self.results: list[DetectionResult] = []

    def show_detections(self, mapper: str, position: int, stamp: int, result: DetectionResult) -> None:
        """See :meth:`.Viewer.show_detections`."""
        self.results.append(result)


@dataclass(frozen=True)
class Counted:
    """What became of some primitives.

    Attributes:
        persistent: For each that was ever confirmed whether its id persisted.
        settled: Distances (m) from the truth at the second look since a push.
        final: Distances (m) at the end.
    """

    persistent: list[bool]
    settled: list[float]
    final: list[float]


def overlapping(result: DetectionResult) -> dict[int, tuple[float, TrackIdentity | None, float]]:
    """Return by index of the true primitives what overlaps them most: its distance (m), its track, and the IoU."""
    detected = [detection.primitive for detection in result.detections.found]
    return {
        pair.truth: (pair.position, result.identities[pair.detection], pair.iou)
        for pair in match_primitives(detected, result.truth)
    }


def follow(results: Sequence[DetectionResult], k: int) -> tuple[bool, Counted]:
    """Follow one true primitive.

    Args:
        results: What was detected at each look.
        k: Index of the primitive.

    Returns:
        Whether it was pushed, and what became of it.
    """
    places = np.array([(result.truth[k].x, result.truth[k].y) for result in results])
    steps = np.hypot(*np.diff(places, axis=0).T)
    found = [overlapping(result).get(k, (math.inf, None, 0.0)) for result in results]
    ids = [identity.id for _, identity, iou in found if identity and identity.confirmed and iou >= SAME_IOU]
    settled = [found[i + 2][0] for i in range(len(steps) - 1) if steps[i] > STILL > steps[i + 1]]
    counted = Counted([len(set(ids)) == 1] if ids else [], settled, [found[-1][0]])
    return bool(steps.sum() > PUSHED), counted


def session(seed: int, mapper: str, every: int, movable: bool) -> tuple[list[tuple[bool, Counted]], int]:
    """Record and replay a session, and evaluate its tracks.

    Args:
        seed: The session's seed.
        mapper: Name of the mapper.
        every: The detector runs every so many scans.
        movable: Whether primitives can be pushed.

    Returns:
        For each primitive whether it was pushed and what became of it; and the number of false tracks at the end.
    """
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "driven.mcap"
        lidar = Lidar(noise_std=0.05)
        options = SessionOptions(seed=seed, motion="drive", duration=40.0, rate=5.0, lidar=lidar, movable=movable)
        record_session(path, options)
        collector = DetectionCollector()
        Pipeline(path, ReplayOptions(mapper=mapper, detect_every=every), collector).run()
    last = collector.results[-1]
    followed = [follow(collector.results, k) for k in range(len(last.truth))]
    detected = [detection.primitive for detection in last.detections.found]
    true = {pair.detection for pair in match_primitives(detected, last.truth) if pair.iou >= SAME_IOU}
    return followed, sum(identity.confirmed for k, identity in enumerate(last.identities) if k not in true)


def row(name: str, results: Sequence[tuple[list[tuple[bool, Counted]], int]], pushed: bool) -> str:
    """Format a row of the table.

    Args:
        name: What its primitives are.
        results: Of all sessions.
        pushed: Whether the primitives that were pushed are counted, or the others.

    Returns:
        The row, in Markdown.
    """
    counted = [one for followed, _ in results for was_pushed, one in followed if was_pushed == pushed]
    persistent, settled, final = (
        [value for one in counted for value in values(one)]
        for values in (lambda one: one.persistent, lambda one: one.settled, lambda one: one.final)
    )
    false = sum(number for _, number in results) / len(results)
    second = f"{1000 * np.median(settled):.1f}" if settled else ""
    return (
        f"| {name} | {len(results)} | {len(persistent)} | {np.mean(persistent):.1%} | {second} | "
        f"{1000 * np.median(final):.1f} | {np.mean(np.isinf(final)):.0%} | {false:.2f} |"
    )


def table(fixed: Sequence[Any], movable: Sequence[Any]) -> str:
    return "\n".join(
        [
            "| primitives | driven sessions | confirmed | id persistent | second look after a push: median, mm | "
            "at the end: median, mm | not found at the end | false tracks per session, at the end |",
            "|---|---:|---:|---:|---:|---:|---:|---:|",
            row("of a world that nothing moves", fixed, pushed=False),
            row("standing, beside others that are pushed", movable, pushed=False),
            row("pushed (by more than 20 mm)", movable, pushed=True),
        ]
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--sessions", type=int, default=50)
    parser.add_argument("--mapper", default="forward")
    parser.add_argument("--every", type=int, default=20)
    parser.add_argument("--workers", type=int, default=os.cpu_count())
    parser.add_argument("--update", type=Path)
    options = parser.parse_args()
    with ProcessPoolExecutor(options.workers) as pool:
        fixed, movable = (
            list(
                pool.map(
                    partial(session, mapper=options.mapper, every=options.every, movable=moves),
                    range(FIRST_SEED[moves], FIRST_SEED[moves] + options.sessions),
                )
            )
            for moves in (False, True)
        )
    text = table(fixed, movable)
    print(text)
    if options.update:
        update(options.update, "tracks", text)


if __name__ == "__main__":
    main()
