"""All that talks to rerun: the recording, its layout, and what is drawn on it."""

from __future__ import annotations

import math
import os
import time
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from urllib.parse import quote

import numpy as np
import rerun as rr
import rerun.blueprint as rrb

from mapping.grid import OccupancyGrid
from prim.errors import OutputError, PrimError, UsageError
from prim.frames import Pose2D
from prim.metrics import MapScores
from prim.shapes import FloatArray
from prim.world import World
from replay.pipeline import ReplayResult
from replay.report import table
from replay.show import Scene, ViewerOptions

APPLICATION = "prim"
STAMP, SCAN = "stamp", "scan"
"""The two timelines: the log's own time, and the number of the scan."""

BATCH_SCANS = 100
BATCH_SECONDS = 0.1
"""Scans are sent in batches, no larger and no older than this; a batch costs little more than one scan."""

TRAIL_POINTS = 2000
SCAN_Z, TRAIL_Z, TRUTH_Z = 0.02, 0.01, 0.03
"""Heights (m) that keep what is drawn on the map from flickering through it."""

WEB_PORT = 9090
"""Where ``--serve`` serves the viewer itself."""

FIELD_OF_VIEW = math.radians(55)
"""The viewer's vertical field of view."""

SCAN_COLOR = (255, 80, 60)
TRAIL_COLOR = (40, 110, 220)
LASER_COLOR = (40, 110, 220)
TRUTH_COLOR = (150, 150, 150)

SCORES = {
    "occupied_f1": "occupied F1",
    "occupied_precision": "occupied precision",
    "occupied_recall": "occupied recall",
    "free_accuracy": "free accuracy",
    "auc": "AUC",
}


class RerunViewer:
    """Draws a replay as a rerun recording. Raises OutputError or ConnectionFailed where it cannot be sent."""

    def __init__(self, options: ViewerOptions) -> None:
        self._options = options
        self._recording = rr.RecordingStream(APPLICATION)
        self._recording.set_log_time_enabled(False)
        self.url: str | None = None
        self.web_url: str | None = None
        self._open_sinks()
        self._batch: list[_ScanEntry] = []
        self._batch_started = 0.0
        self._pose_errors: list[tuple[int, int, float, float]] = []
        self._trail: list[tuple[float, float]] = []
        self._size = 1.0
        self._styled: set[str] = set()

    def begin(self, scene: Scene) -> None:
        """Sends the layout, the names and colours of the series, and the true world."""
        x0, y0, x1, y1 = scene.bounds
        self._size = max(x1 - x0, y1 - y0)
        self._recording.send_recording_name(f"{scene.log} ({scene.mapper})")
        self._recording.send_blueprint(_blueprint(scene))
        self._static("map", rr.ViewCoordinates.RIGHT_HAND_Z_UP)
        self._name_series("scores", SCORES.values())
        self._name_series("pose_error/position", ["position, mm"])
        self._name_series("pose_error/heading", ["heading, degrees"])
        self._name_series("timing", ["mapping, ms a scan"])
        if scene.world is not None:
            self._send_truth(scene.world)

    def show_scan(self, position: int, stamp: int, pose: Pose2D, points: FloatArray, seconds: float) -> None:
        """A scan's end points (N, 2) in the map frame, the laser's pose, and the mapper's seconds for it."""
        if not self._batch:
            self._batch_started = time.perf_counter()
        self._batch.append(_ScanEntry(position, stamp, pose, points, seconds))
        self._trail.append((pose.x, pose.y))
        old = time.perf_counter() - self._batch_started > BATCH_SECONDS
        if self._options.live or len(self._batch) >= BATCH_SCANS or (old and self._options.watched):
            self._send_batch()

    def show_map(self, position: int, stamp: int, grid: OccupancyGrid, scores: MapScores | None) -> None:
        """The map so far, the path so far, and the map's scores against the truth."""
        self._send_batch()
        self._at(position, stamp)
        self._recording.log("map/grid", _grid_map(grid))
        trail = np.asarray(_thin(self._trail, TRAIL_POINTS))
        if len(trail):
            strip = np.column_stack((trail, np.full(len(trail), TRAIL_Z)))
            radius = rr.Radius.ui_points(0.75)
            self._recording.log("map/trajectory", rr.LineStrips3D([strip], colors=[TRAIL_COLOR], radii=radius))
        if scores is not None:
            values = [value if (value := getattr(scores, name)) is not None else math.nan for name in SCORES]
            self._recording.log("scores", rr.Scalars(values))

    def show_pose_error(self, position: int, stamp: int, metres: float, radians: float) -> None:
        """How far the pose in use is from the true one."""
        self._pose_errors.append((position, stamp, metres, radians))

    def event(self, position: int, stamp: int, text: str, warning: bool = False) -> None:
        """A line for the log of events."""
        self._at(position, stamp)
        level = rr.TextLogLevel.WARN if warning else rr.TextLogLevel.INFO
        self._recording.log("events", rr.TextLog(text, level=level))

    def finish(self, result: ReplayResult) -> None:
        """Sends what is left and the table of results, and closes the recording."""
        self._send_batch()
        rows = "\n".join(f"| **{name}** | {value} |" for name, value in table(result))
        text = f"| | |\n|---|---|\n{rows}\n"
        self._static("summary", rr.TextDocument(text, media_type=rr.MediaType.MARKDOWN))
        self._recording.flush(timeout_sec=30.0)
        if not self._options.serve:
            self._recording.disconnect()

    def _open_sinks(self) -> None:
        options = self._options
        sinks: list[Any] = []
        if options.save is not None:
            sinks.append(_file_sink(options.save))
        if options.spawn:
            _check_display()
            rr.spawn(connect=False)
            sinks.append(rr.GrpcSink())
        if options.connect is not None:
            sinks.append(_grpc_sink(options.connect))
        if options.serve:
            self.url = self._recording.serve_grpc()
            rr.serve_web_viewer(web_port=WEB_PORT, open_browser=False, connect_to=self.url)
            self.web_url = f"http://localhost:{WEB_PORT}/?url={quote(self.url, safe='')}"
        elif sinks:
            self._recording.set_sinks(*sinks)

    def _at(self, position: int, stamp: int) -> None:
        self._recording.set_time(STAMP, timestamp=np.datetime64(stamp, "ns"))
        self._recording.set_time(SCAN, sequence=position)

    def _static(self, path: str, what: Any) -> None:
        self._recording.log(path, what, static=True)

    def _name_series(self, path: str, names: Iterable[str]) -> None:
        self._static(path, rr.SeriesLines(names=list(names)))

    def _send_truth(self, world: World) -> None:
        outlines = [_closed(primitive.outline(64)) for primitive in world.primitives]
        labels = [str(primitive.kind) for primitive in world.primitives]
        radius = rr.Radius.ui_points(1.0)
        if outlines:
            self._static(
                "map/truth/primitives",
                rr.LineStrips3D(
                    outlines, labels=labels, show_labels=False, colors=[TRUTH_COLOR], radii=radius
                ),
            )
        if world.walls:
            ends = np.asarray(world.walls).reshape(-1, 2, 2)
            strips = np.concatenate((ends, np.full((*ends.shape[:2], 1), TRUTH_Z)), axis=2)
            self._static("map/truth/walls", rr.LineStrips3D(strips, colors=[TRUTH_COLOR], radii=radius))

    def _send_batch(self) -> None:
        """Sends the gathered scans as columns: one call for all instead of one for each."""
        entries, self._batch = self._batch, []
        if entries:
            index = _index([(entry.position, entry.stamp) for entry in entries])
            self._send_scans(index, entries)
            self._send_lasers(index, entries)
            milliseconds = [entry.seconds * 1e3 for entry in entries]
            self._columns("timing", index, rr.Scalars.columns(scalars=milliseconds))
        errors, self._pose_errors = self._pose_errors, []
        if errors:
            index = _index([(position, stamp) for position, stamp, _, _ in errors])
            millimetres = [metres * 1000 for _, _, metres, _ in errors]
            degrees = [math.degrees(radians) for _, _, _, radians in errors]
            self._columns("pose_error/position", index, rr.Scalars.columns(scalars=millimetres))
            self._columns("pose_error/heading", index, rr.Scalars.columns(scalars=degrees))

    def _send_scans(self, index: Sequence[Any], entries: list[_ScanEntry]) -> None:
        counts = [len(entry.points) for entry in entries]
        flat = np.concatenate([entry.points for entry in entries])
        points = np.column_stack((flat, np.full(len(flat), SCAN_Z))).astype(np.float32)
        columns = rr.Points3D.columns(positions=points).partition(counts)
        self._columns("map/scan", index, columns)
        self._static_once("map/scan", rr.Points3D.from_fields(colors=[SCAN_COLOR], radii=rr.Radius.ui_points(1.75)))

    def _send_lasers(self, index: Sequence[Any], entries: list[_ScanEntry]) -> None:
        poses = [entry.pose for entry in entries]
        length = 0.06 * min(self._size, 10.0)
        origins = [(pose.x, pose.y, TRUTH_Z) for pose in poses]
        vectors = [(length * math.cos(pose.theta), length * math.sin(pose.theta), 0.0) for pose in poses]
        self._columns("map/laser", index, rr.Arrows3D.columns(vectors=vectors, origins=origins))
        self._static_once(
            "map/laser", rr.Arrows3D.from_fields(colors=[LASER_COLOR], radii=rr.Radius.ui_points(2.5))
        )

    def _static_once(self, path: str, what: Any) -> None:
        """Looks that stay the same are sent once."""
        if path not in self._styled:
            self._styled.add(path)
            self._static(path, what)

    def _columns(self, path: str, index: Sequence[Any], columns: Any) -> None:
        self._recording.send_columns(path, indexes=index, columns=columns)


@dataclass(frozen=True)
class _ScanEntry:
    position: int
    stamp: int
    pose: Pose2D
    points: FloatArray
    seconds: float


class ConnectionFailed(PrimError):
    """A viewer that does not answer."""


def _blueprint(scene: Scene) -> rrb.Blueprint:
    """The layout, saved with the recording: the map at the left, series and tables at the right."""
    x0, y0, x1, y1 = scene.bounds
    centre_x, centre_y = (x0 + x1) / 2, (y0 + y1) / 2
    height = 1.1 * max(y1 - y0, x1 - x0) / 2 / math.tan(FIELD_OF_VIEW / 2)
    top_down = rrb.EyeControls3D(
        kind=rrb.Eye3DKind.Orbital,
        position=(centre_x, centre_y - 1e-3 * height, height),
        look_target=(centre_x, centre_y, 0.0),
        eye_up=(0.0, 1.0, 0.0),
    )
    map_view = rrb.Spatial3DView(
        origin="map",
        name=f"Map ({scene.mapper}), from above",
        eye_controls=top_down,
        line_grid=rrb.LineGrid3D(visible=False),
        background=(235, 235, 235, 255),
    )
    right: list[Any] = [rrb.TextDocumentView(origin="summary", name="Result")]
    if scene.world is not None:
        unit = rrb.ScalarAxis(range=(0.0, 1.02), zoom_lock=True)
        right.append(rrb.TimeSeriesView(origin="scores", name="Map accuracy", axis_y=unit))
        errors = rrb.TimeSeriesView(origin="pose_error", name="Pose error")
        right.append(rrb.Tabs(errors, rrb.TimeSeriesView(origin="timing", name="Stage timings"), active_tab=0))
    else:
        right.append(rrb.TimeSeriesView(origin="timing", name="Stage timings"))
    right.append(rrb.TextLogView(origin="events", name="Events"))
    return rrb.Blueprint(
        rrb.Horizontal(map_view, rrb.Vertical(*right), column_shares=[3, 2]),
        rrb.TimePanel(timeline=STAMP, state="collapsed"),
        rrb.BlueprintPanel(state="collapsed"),
        rrb.SelectionPanel(state="collapsed"),
    )


def _grid_map(grid: OccupancyGrid) -> rr.GridMap:
    """A grid as nav_msgs values (0 free to 100 occupied, 255 unknown), flipped: rerun's first row is the top."""
    percent = np.rint(grid.probability * 100).astype(np.uint8)
    percent[grid.probability == 0.5] = 255
    rows, cols = grid.frame.shape
    x, y = grid.frame.origin
    return rr.GridMap(
        data=np.flipud(percent).tobytes(),
        format=rr.components.ImageFormat(
            width=cols, height=rows, color_model=rr.ColorModel.L, channel_datatype=rr.ChannelDatatype.U8
        ),
        cell_size=grid.frame.resolution,
        translation=(x, y, 0.0),
        colormap=rr.components.Colormap.RvizMap,
    )


def _index(times: Sequence[tuple[int, int]]) -> list[Any]:
    positions, stamps = zip(*times, strict=True)
    return [
        rr.TimeColumn(STAMP, timestamp=np.array(stamps, dtype="datetime64[ns]")),
        rr.TimeColumn(SCAN, sequence=positions),
    ]


def _closed(outline: FloatArray) -> FloatArray:
    ring = np.vstack((outline, outline[:1]))
    return np.column_stack((ring, np.full(len(ring), TRUTH_Z)))


def _thin(points: Sequence[tuple[float, float]], most: int) -> Sequence[tuple[float, float]]:
    """At most about ``most`` of the points, evenly spread, the last one among them."""
    step = max(1, -(-len(points) // most))
    return [*points[: len(points) - 1 : step], points[-1]] if points else []


def _file_sink(path: Path) -> Any:
    try:
        path.open("wb").close()
    except OSError as error:
        raise OutputError(path, error) from error
    return rr.FileSink(path)


def _grpc_sink(url: str) -> Any:
    try:
        return rr.GrpcSink(url)
    except Exception as error:
        raise UsageError(f"--connect {url}: not an address of a viewer: {error}") from error


def _check_display() -> None:
    if os.name == "posix" and not (os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")):
        raise UsageError("--spawn needs a display, and there is none: save with --save OUT.rrd, or --serve")

