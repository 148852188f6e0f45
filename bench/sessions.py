"""Recorded sessions and real logs for the benchmarks: scans with poses in memory, and the true cells."""

from __future__ import annotations

import tempfile
from dataclasses import dataclass
from pathlib import Path

from mapping.grid import GridFrame
from mapping.reference_map import ReferenceMap
from prim.log import open_log
from prim.log.source import LogSource
from prim.scan import Scan
from prim.se2 import Pose2D
from prim.shapes import Primitive
from recorder.session import SessionOptions, record_session
from replay.ground_truth import GroundTruth
from replay.mapping.bounds import grid_frame_of_world
from replay.poses.pose_provider import PoseProvider
from replay.scans.posed_scans import PosedScans
from replay.scans.scan_log import ScanLog
from replay.scans.selection import Selection


@dataclass(frozen=True)
class Session:
    """A session in memory.

    Attributes:
        scans: The scans with the laser's poses.
        frame: The frame of their map.
        truth: The true cells; None where they are not known.
        primitives: The true primitives.
    """

    scans: list[tuple[Scan, Pose2D]]
    frame: GridFrame
    truth: ReferenceMap | None
    primitives: tuple[Primitive, ...] = ()


def recorded(options: SessionOptions, resolution: float = 0.01) -> Session:
    """Record a session, and read its scans, true poses and true cells.

    Args:
        options: The session.
        resolution: Side of a cell (m).

    Returns:
        The session, in the frame that a replay gives it.
    """
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "session.mcap"
        record_session(path, options)
        with open_log(path) as log:
            truth = GroundTruth.read(log)
            assert truth is not None
            scans = scans_with_poses(log, "truth")
    frame = grid_frame_of_world(truth.world, resolution)
    cells = ReferenceMap(frame)
    for scan, pose in scans:
        cells.update(scan, pose, truth.at(scan.stamp))
    return Session(scans, frame, cells, truth.world.primitives)


def scans_with_poses(log: LogSource, source: str = "auto") -> list[tuple[Scan, Pose2D]]:
    """Read all scans of a log that have a pose.

    Args:
        log: The log.
        source: The source of poses.

    Returns:
        The scans, each as a whole, with the laser's pose at its first beam.
    """
    scan_log = ScanLog(log, Selection())
    poses = PoseProvider(log, None, None).laser_poses(scan_log.times, source)
    return [(posed.scan, posed.pose) for posed in PosedScans(scan_log, poses)]
