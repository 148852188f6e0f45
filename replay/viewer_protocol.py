"""What a replay shows while it runs, and a viewer that shows nothing."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Protocol

from mapping.grid import OccupancyGrid
from mapping.map_metrics import MapScores
from prim.arrays import FloatArray
from prim.errors import UsageError
from prim.se2 import Pose2D
from prim.world import Bounds, World

if TYPE_CHECKING:
    from replay.detection import Sighting
    from replay.result import ReplayResult


@dataclass(frozen=True)
class ViewerOptions:
    """Where a recording goes: a file, a new viewer, a viewer that runs at a URL, or web browsers.

    ``live`` sends every scan at once, as a replay that is held to a rate wants it. Raises UsageError.
    """

    save: Path | None = None
    spawn: bool = False
    connect: str | None = None
    serve: bool = False
    live: bool = False

    def __post_init__(self) -> None:
        if self.serve and (self.save or self.spawn or self.connect):
            raise UsageError("--serve excludes --save, --spawn and --connect")
        if self.spawn and self.connect:
            raise UsageError("--spawn and --connect exclude each other")

    @property
    def watched(self) -> bool:
        """Whether somebody may look at the replay while it runs."""
        return self.spawn or self.serve or self.connect is not None


@dataclass(frozen=True)
class Scene:
    """What is known before the first scan.

    The log's name, the mapper, the map's bounds (m), whether the map and the poses are held against the truth, and
    whether the mapper says how much evidence each cell has; whether primitives are looked for, and held against the
    truth.
    """

    log: str
    mapper: str
    bounds: Bounds
    has_scores: bool
    has_pose_errors: bool
    has_evidence: bool = False
    has_detections: bool = False
    has_errors: bool = False


class Viewer(Protocol):
    """Shows a replay on a timeline; ``position`` counts the scans, ``stamp`` is in ns.

    ``shows`` is False for one that shows nothing, so that no map need be made for it on the way.
    """

    shows: bool

    def begin(self, scene: Scene) -> None:
        """Sets the scene."""

    def show_truth(self, position: int, stamp: int, world: World) -> None:
        """The true world from now on."""

    def show_scan(self, position: int, stamp: int, pose: Pose2D, points: FloatArray, seconds: float) -> None:
        """The laser's pose, a scan's end points (M, 2) in the map frame, and the mapper's seconds for it."""

    def show_map(self, position: int, stamp: int, grid: OccupancyGrid, scores: MapScores | None) -> None:
        """The map so far and its scores against the truth."""

    def show_pose_error(self, position: int, stamp: int, metres: float, radians: float, pose: Pose2D) -> None:
        """How far the pose in use is from the true one."""

    def show_sighting(self, position: int, stamp: int, sighting: Sighting) -> None:
        """The primitives found in the map so far."""

    def event(self, position: int, stamp: int, text: str, warning: bool = False) -> None:
        """A line for the log of events."""

    def finish(self, result: ReplayResult) -> None:
        """The result; nothing is shown after it."""

    def abandon(self) -> None:
        """The replay failed: what was shown of it is not kept."""


class NullViewer:
    """Shows nothing."""

    shows = False

    def begin(self, scene: Scene) -> None:
        """Nothing."""

    def show_truth(self, position: int, stamp: int, world: World) -> None:
        """Nothing."""

    def show_scan(self, position: int, stamp: int, pose: Pose2D, points: FloatArray, seconds: float) -> None:
        """Nothing."""

    def show_map(self, position: int, stamp: int, grid: OccupancyGrid, scores: MapScores | None) -> None:
        """Nothing."""

    def show_pose_error(self, position: int, stamp: int, metres: float, radians: float, pose: Pose2D) -> None:
        """Nothing."""

    def show_sighting(self, position: int, stamp: int, sighting: Sighting) -> None:
        """Nothing."""

    def event(self, position: int, stamp: int, text: str, warning: bool = False) -> None:
        """Nothing."""

    def finish(self, result: ReplayResult) -> None:
        """Nothing."""

    def abandon(self) -> None:
        """Nothing."""
