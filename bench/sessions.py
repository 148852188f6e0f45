"""Recorded sessions and real logs as the benchmarks want them: scans with poses in memory, and the true cells."""

from __future__ import annotations

import tempfile
from dataclasses import dataclass
from pathlib import Path

from mapping.grid import GridFrame
from mapping.reference_map import TruthMap
from prim.log.mcap import LogReader
from prim.scan import Scan
from prim.se2 import Pose2D
from prim.shapes import Primitive
from recorder.session import SessionOptions, record
from replay.ground_truth import Truth
from replay.pipeline import WORLD_MARGIN
from replay.posed_scans import ScanLog
from replay.poses.localize import Localizer
from replay.selection import Selection


@dataclass(frozen=True)
class Session:
    """Scans with the poses of their laser, the frame of their map; for recorded ones, true cells and primitives."""

    scans: list[tuple[Scan, Pose2D]]
    frame: GridFrame
    truth: TruthMap | None
    primitives: tuple[Primitive, ...] = ()


def recorded(options: SessionOptions, resolution: float = 0.01) -> Session:
    """A session that is recorded for the purpose, on the frame that a replay gives it."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "session.mcap"
        record(path, options)
        with LogReader(path) as log:
            truth = Truth.read(log)
            assert truth is not None
            scans = posed_scans(log, "truth")
    x0, y0, x1, y1 = truth.world.bounds
    m = WORLD_MARGIN
    frame = GridFrame.covering((x0 - m, y0 - m, x1 + m, y1 + m), resolution)
    cells = TruthMap(frame)
    for scan, pose in scans:
        cells.update(scan, pose, truth.at(scan.stamp))
    return Session(scans, frame, cells, truth.world.primitives)


def posed_scans(log: LogReader, source: str = "auto") -> list[tuple[Scan, Pose2D]]:
    """All scans of a log that have a pose, with the poses of their laser."""
    scan_log = ScanLog(log, None, Selection())
    poses = Localizer(log, None, None).locate(scan_log.times, source)
    return [(scan, Pose2D(*poses.poses[at].tolist())) for at, scan in scan_log if poses.valid[at]]
