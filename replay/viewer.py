"""All that talks to rerun: the recording, its layout, and what is drawn on it."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import TYPE_CHECKING, Any
from urllib.parse import quote

import numpy as np
import rerun as rr
import rerun.blueprint as rrb
from numpy.typing import NDArray

from mapping.grid import OccupancyGrid
from mapping.map_metrics import MapScores
from prim.arrays import FloatArray
from prim.errors import PrimError
from prim.metrics import DetectionErrors
from prim.scan import PosedScan
from prim.world import World
from replay.detection_stage import DetectionResult
from replay.result import ReplayResult
from replay.viewing.checks import check_display, check_viewer, create_partial, find_free_port, partial_path
from replay.viewing.drawing import (
    confidence_ellipse,
    crop_sheet,
    occupancy_percent,
    pose_stds,
    ring,
    subsample,
    uncertainty_bounds,
)
from replay.viewing.markdown import detections_markdown, summary_markdown
from replay.viewing.protocol import Scene, ViewerOptions
from replay.viewing.scan_batch import ScanBatch, ScanEntry

if TYPE_CHECKING:
    from detect.detection import Detection

APPLICATION = "prim"
STAMP, SCAN = "stamp", "scan"
"""The two timelines: the log's own time, and the number of the scan."""

TRAJECTORY_POINTS = 2000
"""The trajectory is drawn with about this many points at most."""

TRAJECTORY_HEIGHT, SCAN_HEIGHT, TRUTH_HEIGHT, DETECTION_HEIGHT = 0.0004, 0.0008, 0.0012, 0.0016
"""Heights above the map, as shares of its size: enough to keep what is drawn on it from flickering."""

GRPC_PORT, WEB_PORT = 9876, 9090
"""Where ``--serve`` serves the recording and the viewer, or at the next ports that are free."""

FLUSH_SECONDS = 60.0
"""How long the rest of a recording may take to be written or sent (s)."""

FIELD_OF_VIEW = math.radians(55)
"""The viewer's vertical field of view (rad)."""

LASER_LENGTH, MAX_SCALE = 0.06, 10.0
"""The laser's arrow is as long as this share of the map's size, and of this size (m) at most."""

Color = tuple[int, int, int]

SCAN_COLOR = (255, 80, 60)
TRAJECTORY_COLOR = (40, 110, 220)
LASER_COLOR = (40, 110, 220)
TRUTH_COLOR = (150, 150, 150)
LABEL_COLOR = (255, 255, 255)

BOUNDS_ALPHA = 130
"""Opacity (0 to 255) of the outlines at one standard deviation."""

SCORES = {
    "occupied_f1": ("occupied F1", (255, 255, 255)),
    "occupied_precision": ("occupied precision", (86, 180, 233)),
    "occupied_recall": ("occupied recall", (230, 159, 0)),
    "free_accuracy": ("free accuracy", (0, 158, 115)),
    "auc": ("AUC", (204, 121, 167)),
}
"""The map's scores over time: label and colour of each line."""

DETECTION_SCORES = {
    "f1": ("F1", (255, 255, 255)),
    "precision": ("precision", (86, 180, 233)),
    "recall": ("recall", (230, 159, 0)),
    "iou": ("mean IoU", (0, 158, 115)),
}
"""Scores of the detections over time."""

LENGTH_ERRORS = {
    "position": ("position, mm", (86, 180, 233)),
    "width": ("width, mm", (230, 159, 0)),
    "height": ("height, mm", (0, 158, 115)),
}
"""Mean errors of the detections over time; that of the angle has a plot of its own."""

ANGLE_ERROR = ("angle, degrees", (204, 121, 167))

POSITION_ERROR = (("position, mm", (86, 180, 233)), ("expected (1σ), mm", (40, 90, 130)))
HEADING_ERROR = (("heading, degrees", (230, 159, 0)), ("expected (1σ), degrees", (130, 90, 0)))
"""Errors of the poses over time, each with its expected standard deviation, where there is one."""

MAPPING_TIME = ("mapping, ms a scan", (86, 180, 233))


class RecordingError(PrimError):
    """A recording could not be written or sent."""


class RerunViewer:
    """Draws a replay as a rerun recording, which is opened when the replay begins.

    Args:
        options: Where the recording goes.
        announce: Called with the addresses of a replay that is served.

    Raises:
        UsageError: A viewer is to be opened, and there is no display; or a URL is not one of a viewer.
        ViewerUnreachableError: No viewer answers at the URL.
    """

    shows = True

    def __init__(self, options: ViewerOptions, announce: Callable[[str], None]) -> None:
        if options.spawn:
            check_display()
        if options.connect is not None:
            check_viewer(options.connect)
        self._options = options
        self._announce = announce
        self._recording = rr.RecordingStream(APPLICATION)
        self._recording.set_log_time_enabled(False)
        self._batch = ScanBatch(options.live, options.watched)
        self._pose_errors: list[tuple[tuple[int, int], tuple[float, float], tuple[float, float]]] = []
        self._trajectory: list[tuple[float, float]] = []
        self._world: World | None = None
        self._size = 1.0
        self._styled: set[str] = set()

    def begin(self, scene: Scene) -> None:
        """See :meth:`.Viewer.begin`."""
        self._open_sinks()
        x0, y0, x1, y1 = scene.bounds
        self._size = max(x1 - x0, y1 - y0)
        self._recording.send_recording_name(f"{scene.log} ({scene.mapper})")
        self._recording.send_blueprint(_blueprint(scene))
        self._log_static("map", rr.ViewCoordinates.RIGHT_HAND_Z_UP)
        self._log_static("evidence", rr.ViewCoordinates.RIGHT_HAND_Z_UP)
        self._name_series("scores", SCORES.values())
        self._name_series("pose_error/position", POSITION_ERROR)
        self._name_series("pose_error/heading", HEADING_ERROR)
        if scene.has_errors:
            self._name_series("errors/found", DETECTION_SCORES.values())
            self._name_series("errors/lengths", LENGTH_ERRORS.values())
            self._name_series("errors/angle", [ANGLE_ERROR])
        self._name_series("timing", [MAPPING_TIME])

    def show_truth(self, position: int, stamp: int, world: World) -> None:
        """See :meth:`.Viewer.show_truth`."""
        if world is self._world:
            return
        self._world = world
        self._send_batch()
        self._set_time(position, stamp)
        radius = rr.Radius.ui_points(1.0)
        if world.primitives:
            self._recording.log(
                "map/truth/primitives",
                rr.LineStrips3D(
                    [self._raised(ring(primitive), TRUTH_HEIGHT) for primitive in world.primitives],
                    labels=[str(primitive.kind) for primitive in world.primitives],
                    show_labels=False,
                    colors=[TRUTH_COLOR],
                    radii=radius,
                ),
            )
        if world.walls:
            strips = list(self._raised(np.asarray(world.walls).reshape(-1, 2, 2), TRUTH_HEIGHT))
            self._recording.log("map/truth/walls", rr.LineStrips3D(strips, colors=[TRUTH_COLOR], radii=radius))

    def show_scan(self, posed: PosedScan, seconds: float) -> None:
        """See :meth:`.Viewer.show_scan`."""
        self._trajectory.append((posed.pose.x, posed.pose.y))
        entry = ScanEntry(posed.position, posed.scan.stamp, posed.pose, posed.points, seconds)
        if self._batch.add(entry):
            self._send_batch()

    def show_map(self, position: int, stamp: int, grid: OccupancyGrid, scores: MapScores | None) -> None:
        """See :meth:`.Viewer.show_map`."""
        self._send_batch()
        self._set_time(position, stamp)
        self._recording.log("map/grid", _occupancy_map(grid))
        if grid.visits is not None:
            self._recording.log("evidence/grid", _visits_map(grid))
        if scores is not None:
            values = [value if (value := getattr(scores, name)) is not None else math.nan for name in SCORES]
            self._recording.log("scores", rr.Scalars(values))

    def show_pose_error(self, posed: PosedScan, position_error: float, heading_error: float) -> None:
        """See :meth:`.Viewer.show_pose_error`."""
        position_std, heading_std = pose_stds(posed.pose)
        lengths = 1000 * position_error, 1000 * position_std
        angles = math.degrees(heading_error), math.degrees(heading_std)
        self._pose_errors.append(((posed.position, posed.scan.stamp), lengths, angles))

    def show_detections(self, position: int, stamp: int, result: DetectionResult) -> None:
        """See :meth:`.Viewer.show_detections`."""
        self._send_batch()
        self._set_time(position, stamp)
        found = result.detections.found
        self._recording.log("map/detections", self._outlines(found))
        self._recording.log("map/uncertainty", self._uncertainty_bounds(found))
        self._recording.log("map/labels", self._labels(result))
        self._recording.log("detections", rr.TextDocument(detections_markdown(result), media_type="text/markdown"))
        self._recording.log("crops", rr.Image(crop_sheet(found)))
        errors = result.errors
        if errors is not None:
            self._recording.log("errors/found", rr.Scalars(_values(errors, DETECTION_SCORES, 1.0)))
            self._recording.log("errors/lengths", rr.Scalars(_values(errors, LENGTH_ERRORS, 1000.0)))
            angle = math.nan if errors.angle is None else math.degrees(errors.angle)
            self._recording.log("errors/angle", rr.Scalars([angle]))

    def event(self, position: int, stamp: int, text: str, warning: bool = False) -> None:
        """See :meth:`.Viewer.event`."""
        self._set_time(position, stamp)
        level = rr.TextLogLevel.WARN if warning else rr.TextLogLevel.INFO
        self._recording.log("events", rr.TextLog(text, level=level))

    def finish(self, result: ReplayResult) -> None:
        """See :meth:`.Viewer.finish`. Raises RecordingError where the recording cannot be written in full."""
        self._send_batch()
        self._log_static("summary", rr.TextDocument(summary_markdown(result), media_type=rr.MediaType.MARKDOWN))
        try:
            self._recording.flush(timeout_sec=FLUSH_SECONDS)
        except Exception as error:  # rerun raises plain RuntimeErrors
            raise RecordingError(f"the recording could not be written in full: {error}") from error
        if not self._options.serve:
            self._recording.disconnect()
        if self._options.save is not None:
            partial_path(self._options.save).replace(self._options.save)

    def abandon(self) -> None:
        """Close the recording and remove its file; an earlier recording of that name stays as it was."""
        self._recording.disconnect()
        if self._options.save is not None:
            partial_path(self._options.save).unlink(missing_ok=True)

    # The recording: where it goes, times, names

    def _open_sinks(self) -> None:
        """Open the file and the viewers that the recording goes to."""
        options = self._options
        sinks: list[Any] = []
        if options.save is not None:
            sinks.append(rr.FileSink(create_partial(options.save)))
        if options.spawn:
            rr.spawn(connect=False)
            sinks.append(rr.GrpcSink())
        if options.connect is not None:
            sinks.append(rr.GrpcSink(options.connect))
        if options.serve:
            url = self._recording.serve_grpc(grpc_port=find_free_port(GRPC_PORT))
            port = find_free_port(WEB_PORT)
            rr.serve_web_viewer(web_port=port, open_browser=False, connect_to=url)
            self._announce(f"browse: http://localhost:{port}/?url={quote(url, safe='')}")
            self._announce(f"or:     rerun {url}")
        elif sinks:
            self._recording.set_sinks(*sinks)

    def _set_time(self, position: int, stamp: int) -> None:
        self._recording.set_time(STAMP, timestamp=np.datetime64(stamp, "ns"))
        self._recording.set_time(SCAN, sequence=position)

    def _log_static(self, path: str, archetype: Any) -> None:
        self._recording.log(path, archetype, static=True)

    def _name_series(self, path: str, series: Iterable[tuple[str, Color]]) -> None:
        """Send the labels and colours of a plot's lines."""
        names, colors = zip(*series, strict=True)
        self._log_static(path, rr.SeriesLines(names=names, colors=colors))

    def _set_style(self, path: str, style: Any) -> None:
        """Send colours and radii that stay the same, once."""
        if path not in self._styled:
            self._styled.add(path)
            self._log_static(path, style)

    # Detections

    def _raised(self, points: FloatArray, height: float) -> FloatArray:
        """Place points (..., 2) of the map above it, by a share of its size."""
        z = np.full((*points.shape[:-1], 1), height * self._size)
        return np.concatenate((points, z), axis=-1)

    def _outlines(self, found: Sequence[Detection]) -> Any:
        """Draw the outlines of detections in the colour of their kind."""
        return rr.LineStrips3D(
            [self._raised(ring(detection.primitive), DETECTION_HEIGHT) for detection in found],
            colors=[detection.primitive.kind.row.color for detection in found],
            radii=rr.Radius.ui_points(2.0),
        )

    def _uncertainty_bounds(self, found: Sequence[Detection]) -> Any:
        """Draw outlines one standard deviation inside and outside those of refined detections."""
        bounds = [
            bound
            for detection in found
            if detection.std
            for bound in uncertainty_bounds(detection.primitive, detection.std)
        ]
        return rr.LineStrips3D(
            [self._raised(ring(bound), DETECTION_HEIGHT) for bound in bounds],
            colors=[(*bound.kind.row.color, BOUNDS_ALPHA) for bound in bounds],
            radii=rr.Radius.ui_points(0.8),
        )

    def _labels(self, result: DetectionResult) -> Any:
        """Write id, kind and score above each detection; «?» while its track is tentative."""
        labels, tops = [], []
        for identity, detection in zip(result.identities, result.detections.found, strict=True):
            primitive, mark = detection.primitive, "" if identity.confirmed else "?"
            labels.append(f"{identity.id}{mark}: {primitive.kind} {detection.score:.2f}")
            tops.append((primitive.x, float(ring(primitive)[:, 1].max())))
        return rr.Points3D(
            self._raised(np.array(tops).reshape(-1, 2), DETECTION_HEIGHT),
            labels=labels,
            colors=[LABEL_COLOR],
            radii=rr.Radius.ui_points(0.0),
            show_labels=True,
        )

    # Scans, which are sent in batches

    def _send_batch(self) -> None:
        """Send the gathered scans and pose errors as columns: one call for all instead of one for each."""
        entries = self._batch.take()
        if entries:
            index = _time_columns([(entry.position, entry.stamp) for entry in entries])
            self._send_scans(index, entries)
            self._send_lasers(index, entries)
            self._send_ellipses(entries)
            milliseconds = [entry.seconds * 1e3 for entry in entries]
            self._send_columns("timing", index, rr.Scalars.columns(scalars=milliseconds))
            self._send_trajectory(entries[-1])
        errors, self._pose_errors = self._pose_errors, []
        if errors:
            times, lengths, angles = zip(*errors, strict=True)
            index = _time_columns(times)
            self._send_columns("pose_error/position", index, rr.Scalars.columns(scalars=lengths))
            self._send_columns("pose_error/heading", index, rr.Scalars.columns(scalars=angles))

    def _send_scans(self, index: Sequence[Any], entries: list[ScanEntry]) -> None:
        """Send the end points of scans."""
        counts = [len(entry.points) for entry in entries]
        points = self._raised(np.concatenate([entry.points for entry in entries]), SCAN_HEIGHT)
        self._send_columns("map/scan", index, rr.Points3D.columns(positions=points).partition(counts))
        self._set_style("map/scan", rr.Points3D.from_fields(colors=[SCAN_COLOR], radii=rr.Radius.ui_points(1.75)))

    def _send_trajectory(self, last: ScanEntry) -> None:
        """Send the trajectory so far, as dots: a robot that is warped has no line to show."""
        points = self._raised(np.asarray(subsample(self._trajectory, TRAJECTORY_POINTS)), TRAJECTORY_HEIGHT)
        self._set_time(last.position, last.stamp)
        dots = rr.Points3D(points, colors=[TRAJECTORY_COLOR], radii=rr.Radius.ui_points(1.75))
        self._recording.log("map/trajectory", dots)

    def _send_lasers(self, index: Sequence[Any], entries: list[ScanEntry]) -> None:
        """Send the laser's poses as arrows."""
        poses = [entry.pose for entry in entries]
        length = LASER_LENGTH * min(self._size, MAX_SCALE)
        origins = self._raised(np.array([(pose.x, pose.y) for pose in poses]), TRUTH_HEIGHT)
        vectors = [(length * math.cos(pose.theta), length * math.sin(pose.theta), 0.0) for pose in poses]
        self._send_columns("map/laser", index, rr.Arrows3D.columns(vectors=vectors, origins=origins))
        self._set_style("map/laser", rr.Arrows3D.from_fields(colors=[LASER_COLOR], radii=rr.Radius.ui_points(2.5)))

    def _send_ellipses(self, entries: list[ScanEntry]) -> None:
        """Send the laser's 95 % confidence ellipses, where its poses have covariances."""
        uncertain = [entry for entry in entries if entry.pose.covariance is not None]
        if uncertain:
            rings = [self._raised(confidence_ellipse(entry.pose), TRUTH_HEIGHT) for entry in uncertain]
            index = _time_columns([(entry.position, entry.stamp) for entry in uncertain])
            columns = rr.LineStrips3D.columns(strips=rings).partition([1] * len(rings))
            self._send_columns("map/laser_95_percent", index, columns)
            style = rr.LineStrips3D.from_fields(colors=[LASER_COLOR], radii=rr.Radius.ui_points(1.0))
            self._set_style("map/laser_95_percent", style)

    def _send_columns(self, path: str, index: Sequence[Any], columns: Any) -> None:
        self._recording.send_columns(path, indexes=index, columns=columns)


def _blueprint(scene: Scene) -> rrb.Blueprint:
    """Lay out the views, which is saved with the recording: maps at the left, tables and plots at the right."""
    right = [_result_view(scene), *_plots(scene), rrb.TextLogView(origin="events", name="Events")]
    shares = [2.0, *[2.0] * (len(right) - 2), 1.2]
    return rrb.Blueprint(
        rrb.Horizontal(_map_view(scene), rrb.Vertical(*right, row_shares=shares), column_shares=[3, 2]),
        rrb.TimePanel(timeline=STAMP, state="collapsed"),
        rrb.BlueprintPanel(state="collapsed"),
        rrb.SelectionPanel(state="collapsed"),
    )


def _map_view(scene: Scene) -> Any:
    """Lay out the map from above; beside it the visits, where the mapper has it."""
    x0, y0, x1, y1 = scene.bounds
    centre_x, centre_y = (x0 + x1) / 2, (y0 + y1) / 2
    height = 1.1 * max(y1 - y0, x1 - x0) / 2 / math.tan(FIELD_OF_VIEW / 2)
    top_down = rrb.EyeControls3D(
        kind=rrb.Eye3DKind.Orbital,
        position=(centre_x, centre_y - 1e-3 * height, height),
        look_target=(centre_x, centre_y, 0.0),
        eye_up=(0.0, 1.0, 0.0),
    )

    def from_above(origin: str, name: str) -> rrb.Spatial3DView:
        return rrb.Spatial3DView(
            origin=origin,
            name=name,
            eye_controls=top_down,
            line_grid=rrb.LineGrid3D(visible=False),
            background=(235, 235, 235, 255),
        )

    view = from_above("map", f"Map ({scene.mapper}), from above")
    if not scene.has_visits:
        return view
    return rrb.Tabs(view, from_above("evidence", "Visits: rays per cell"), active_tab=0)


def _result_view(scene: Scene) -> Any:
    """Lay out the summary; beside it the table and the crops of detections, where there are any."""
    summary = rrb.TextDocumentView(origin="summary", name="Result")
    if not scene.has_detections:
        return summary
    table = rrb.TextDocumentView(origin="detections", name="Detections")
    crops = rrb.Spatial2DView(origin="crops", name="Crops, as the networks see them")
    return rrb.Tabs(summary, table, crops, active_tab=0)


def _plots(scene: Scene) -> list[Any]:
    """Lay out the time series: errors of detections, accuracy of the map, errors of poses, timings."""
    plots: list[Any] = []
    unit = rrb.ScalarAxis(range=(0.0, 1.02), zoom_lock=True)
    if scene.has_errors:
        found = _plot("errors/found", "Primitives found", axis_y=unit)
        lengths, angle = _plot("errors/lengths", "Errors: lengths"), _plot("errors/angle", "Errors: angle")
        plots.append(rrb.Tabs(found, lengths, angle, active_tab=0))
    if scene.has_scores:
        plots.append(_plot("scores", "Map accuracy", axis_y=unit))
    if scene.has_pose_errors:
        position, heading = _plot("pose_error/position", "Pose error"), _plot("pose_error/heading", "Heading error")
        plots.append(rrb.Tabs(position, heading, active_tab=0))
    return [*plots, _plot("timing", "Stage timings")]


def _plot(origin: str, name: str, **properties: Any) -> rrb.TimeSeriesView:
    legend = rrb.PlotLegend(rrb.Corner2D.RightBottom)
    return rrb.TimeSeriesView(origin=origin, name=name, plot_legend=legend, **properties)


def _values(errors: DetectionErrors, series: Mapping[str, object], unit: float) -> list[float]:
    """Return some of the errors in a plot's units; those that are not defined leave a gap."""
    return [math.nan if (value := getattr(errors, name)) is None else unit * value for name in series]


def _occupancy_map(grid: OccupancyGrid) -> rr.GridMap:
    """Draw a grid in the colours of RViz."""
    return _grid_map(grid, occupancy_percent(grid), rr.components.Colormap.RvizMap)


def _visits_map(grid: OccupancyGrid) -> rr.GridMap:
    """Draw how many rays came to each cell, on a logarithmic scale."""
    return _grid_map(grid, grid.image()[..., 1], None)


def _grid_map(grid: OccupancyGrid, values: NDArray[np.uint8], colormap: Any) -> rr.GridMap:
    """Draw values (rows, cols) of a grid's cells; flipped, since rerun's first row is at the top."""
    rows, cols = grid.frame.shape
    x, y = grid.frame.origin
    return rr.GridMap(
        data=np.flipud(values).tobytes(),
        format=rr.components.ImageFormat(
            width=cols, height=rows, color_model=rr.ColorModel.L, channel_datatype=rr.ChannelDatatype.U8
        ),
        cell_size=grid.frame.resolution,
        translation=(x, y, 0.0),
        colormap=colormap,
    )


def _time_columns(times: Sequence[tuple[int, int]]) -> list[Any]:
    """Return both timelines' columns for positions and stamps (ns)."""
    positions, stamps = zip(*times, strict=True)
    return [
        rr.TimeColumn(STAMP, timestamp=np.array(stamps, dtype="datetime64[ns]")),
        rr.TimeColumn(SCAN, sequence=positions),
    ]
