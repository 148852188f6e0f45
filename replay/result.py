"""What a replay comes to."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from mapping.grid import OccupancyGrid
from mapping.map_metrics import MapScores
from replay.detection import Sighting
from replay.options import ReplayOptions
from replay.poses.localize import LaserPoses


@dataclass(frozen=True)
class ReplayResult:
    """All that a replay found out; ``blind`` says why primitives were not looked for, where they should have been."""

    path: Path
    options: ReplayOptions
    duration: float
    scans: int
    scans_used: int
    rays: int
    lost: tuple[str, ...]
    notes: tuple[str, ...]
    messages_lost: int | None
    poses: LaserPoses
    stamps: NDArray[np.int64]
    pose_rmse: tuple[float, float] | None
    pose_nees: float | None
    grid: OccupancyGrid
    noise_std: float | None
    scores: MapScores | None
    sighting: Sighting | None
    blind: str | None
    seconds: dict[str, float]
