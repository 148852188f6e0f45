"""What a replay shows while it runs: the viewer's protocol, and a viewer that shows nothing."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Protocol

from mapping.grid import OccupancyGrid
from mapping.map_metrics import MapScores
from prim.arrays import FloatArray
from prim.errors import UsageError
from prim.scan import PosedScan
from prim.world import Bounds, World

if TYPE_CHECKING:
    from replay.detection.stage import DetectionResult
    from replay.result import ReplayResult


@dataclass(frozen=True)
class ViewerOptions:
    """Where a recording goes.

    Attributes:
        save: A file.
        spawn: A new viewer.
        connect: The URL of a viewer that runs.
        serve: Web browsers.
        force: The file may replace one that is no earlier recording of prim.
        live: Every scan is sent at once, as a replay that is held to a rate wants it.
        serve_host: The address or the name of this machine that browsers are served on; None for 127.0.0.1, which
            only this machine reaches.

    Raises:
        UsageError: Two of them exclude each other, or one needs another.
    """

    save: Path | None = None
    spawn: bool = False
    connect: str | None = None
    serve: bool = False
    live: bool = False
    force: bool = False
    serve_host: str | None = None

    def __post_init__(self) -> None:
        if self.serve and (self.save or self.spawn or self.connect):
            raise UsageError("--serve excludes --save, --spawn and --connect")
        if self.serve_host is not None and not self.serve:
            raise UsageError("--serve-host goes with --serve")
        if self.spawn and self.connect:
            raise UsageError("--spawn and --connect exclude each other")

    @property
    def watched(self) -> bool:
        """Whether somebody may be watching the replay while it runs."""
        return self.spawn or self.serve or self.connect is not None


@dataclass(frozen=True)
class Scene:
    """What is known before the first scan.

    Attributes:
        log: The log's name.
        mappers: The mappers.
        bounds: The map's bounds (m): x0, y0, x1, y1.
        has_scores: Whether maps are scored against ground truth.
        has_pose_errors: Whether the poses are compared with the true ones.
        counting: The mappers that count the rays of each cell.
        detecting: The mappers in whose maps primitives are detected.
        has_errors: Whether detections are evaluated against ground truth.
        loops: (L, 2, 2) for each loop where the laser was (m): when the place was seen first, and when it was
            recognised.
    """

    log: str
    mappers: tuple[str, ...]
    bounds: Bounds
    has_scores: bool
    has_pose_errors: bool
    counting: tuple[str, ...] = ()
    detecting: tuple[str, ...] = ()
    has_errors: bool = False
    loops: FloatArray | None = None


class Viewer(Protocol):
    """Shows a replay on a timeline.

    Attributes:
        shows: False for a viewer that shows nothing, so that no snapshots of the map need be made for it.
    """

    shows: bool

    def begin(self, scene: Scene) -> None:
        """Prepare for what is described by ``scene``."""

    def show_truth(self, position: int, stamp: int, world: World) -> None:
        """Show the true world; called with every scan, and of effect where the world has changed.

        Args:
            position: The scan's position in the selection.
            stamp: Its stamp (ns).
            world: The world at that time.
        """

    def show_scan(self, posed: PosedScan) -> None:
        """Show a scan and the laser's pose.

        Args:
            posed: The scan with its pose.
        """

    def show_mapping_time(self, mapper: str, posed: PosedScan, seconds: float) -> None:
        """Show the time that it took to map a scan.

        Args:
            mapper: The mapper.
            posed: The scan.
            seconds: The time (s).
        """

    def show_map(self, mapper: str, position: int, stamp: int, grid: OccupancyGrid, scores: MapScores | None) -> None:
        """Show a mapper's map so far.

        Args:
            mapper: The mapper.
            position: The latest scan's position in the selection.
            stamp: Its stamp (ns).
            grid: The map.
            scores: Its scores; None without ground truth.
        """

    def show_pose_error(self, posed: PosedScan, position_error: float, heading_error: float) -> None:
        """Show how far the pose of a scan is from the true one.

        Args:
            posed: The scan with its pose.
            position_error: Distance between the positions (m).
            heading_error: Difference of the headings (rad).
        """

    def show_detections(self, mapper: str, position: int, stamp: int, result: DetectionResult) -> None:
        """Show the primitives in a mapper's map so far.

        Args:
            mapper: The mapper.
            position: The latest scan's position in the selection.
            stamp: Its stamp (ns).
            result: The detections.
        """

    def event(self, position: int, stamp: int, text: str, warning: bool = False) -> None:
        """Add a line to the log of events.

        Args:
            position: The latest scan's position in the selection.
            stamp: Its stamp (ns).
            text: The line.
            warning: Whether it is a warning.
        """

    def finish(self, results: Sequence[ReplayResult]) -> None:
        """Show the results, one for each mapper, and close; nothing is shown after it."""

    def abandon(self) -> None:
        """Discard what was shown: the replay failed."""


class NullViewer:
    """A viewer that shows nothing."""

    shows = False

    def begin(self, scene: Scene) -> None:
        """See :meth:`Viewer.begin`."""

    def show_truth(self, position: int, stamp: int, world: World) -> None:
        """See :meth:`Viewer.show_truth`."""

    def show_scan(self, posed: PosedScan) -> None:
        """See :meth:`Viewer.show_scan`."""

    def show_mapping_time(self, mapper: str, posed: PosedScan, seconds: float) -> None:
        """See :meth:`Viewer.show_mapping_time`."""

    def show_map(self, mapper: str, position: int, stamp: int, grid: OccupancyGrid, scores: MapScores | None) -> None:
        """See :meth:`Viewer.show_map`."""

    def show_pose_error(self, posed: PosedScan, position_error: float, heading_error: float) -> None:
        """See :meth:`Viewer.show_pose_error`."""

    def show_detections(self, mapper: str, position: int, stamp: int, result: DetectionResult) -> None:
        """See :meth:`Viewer.show_detections`."""

    def event(self, position: int, stamp: int, text: str, warning: bool = False) -> None:
        """See :meth:`Viewer.event`."""

    def finish(self, results: Sequence[ReplayResult]) -> None:
        """See :meth:`Viewer.finish`."""

    def abandon(self) -> None:
        """See :meth:`Viewer.abandon`."""
