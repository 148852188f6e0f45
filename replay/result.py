"""The result of a replay."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from mapping.grid import OccupancyGrid
from mapping.map_metrics import MapScores
from replay.detection.stage import DetectionResult
from replay.options import ReplayOptions
from replay.poses.laser_poses import LaserPoses


@dataclass(frozen=True)
class ReplayResult:
    """All that a replay found out by one mapper.

    Attributes:
        path: The log's path.
        format: The log's format, for people.
        options: The options of the replay, with this mapper alone.
        duration: The time from the earliest selected scan to the latest (s).
        scans: The number of scans on the topic.
        scans_used: The number of scans that were mapped.
        rays: The number of their rays.
        lost: Parts of the log that could not be read.
        interrupted: What interrupted the replay, so that its results are those until then; None where nothing did.
        notes: What a user should know.
        messages_lost: The number of messages that could not be read; None where it is not known.
        poses: The laser's poses at the selected scans.
        stamps: Stamps (N,) of the selected scans (ns).
        scanner: By which scanner each of them (N,) was taken.
        pose_rmse: Root mean square position (m) and heading (rad) errors; None where poses are not compared.
        pose_nees: Mean normalized estimation error squared of the poses; None without covariances or truth.
        grid: The map.
        noise_std: The range noise that the mapper assumes (m); None for a mapper without one.
        scores: Scores of the map; None without ground truth.
        detections: The primitives in the map; None where detection was skipped.
        detection_skipped: Why detection was not possible, where it was wanted; None otherwise.
        seconds: Wall time of each stage, and ``total``, by name (s); without the time of other mappers.
        elapsed: Wall time (s) of the whole replay, by all mappers.
    """

    path: Path
    format: str
    options: ReplayOptions
    duration: float
    scans: int
    scans_used: int
    rays: int
    lost: tuple[str, ...]
    interrupted: KeyboardInterrupt | None
    notes: tuple[str, ...]
    messages_lost: int | None
    poses: LaserPoses
    stamps: NDArray[np.int64]
    scanner: NDArray[np.intp]
    pose_rmse: tuple[float, float] | None
    pose_nees: float | None
    grid: OccupancyGrid
    noise_std: float | None
    scores: MapScores | None
    detections: DetectionResult | None
    detection_skipped: str | None
    seconds: dict[str, float]
    elapsed: float


def distinct_notes(results: Sequence[ReplayResult]) -> list[str]:
    """Return the notes of results of one log, each once."""
    return list(dict.fromkeys(note for result in results for note in result.notes))
