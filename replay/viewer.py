"""All that talks to rerun: the recording, its layout, and what is drawn on it."""

from __future__ import annotations

import math
import os
import socket
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any
from urllib.parse import quote, urlsplit

import numpy as np
import rerun as rr
import rerun.blueprint as rrb
from numpy.typing import NDArray

from mapping.grid import OccupancyGrid
from mapping.map_metrics import MapScores
from prim.arrays import FloatArray
from prim.errors import OutputError, PrimError, UsageError
from prim.metrics import DetectionErrors
from prim.se2 import Pose2D
from prim.shapes import Primitive
from prim.world import World
from replay.detection import Sighting
from replay.report import table
from replay.result import ReplayResult
from replay.viewer_protocol import Scene, ViewerOptions

if TYPE_CHECKING:
    from detect.detection import Detection

APPLICATION = "prim"
STAMP, SCAN = "stamp", "scan"
"""The two timelines: the log's own time, and the number of the scan."""

BATCH_SCANS = 100
BATCH_SECONDS = 0.1
"""Scans are sent in batches, no larger and no older than this; a batch costs little more than one scan."""

TRAIL_POINTS = 2000
TRAIL_LIFT, SCAN_LIFT, TRUTH_LIFT, FOUND_LIFT = 0.0004, 0.0008, 0.0012, 0.0016
"""Heights above the map, as shares of its size: enough to keep what is drawn on it from flickering."""

GRPC_PORT, WEB_PORT = 9876, 9090
"""Where ``--serve`` serves the recording and the viewer, or at the next ports that are free."""

FLUSH_SECONDS = 60.0
"""How long the rest of a recording may take to be written or sent."""

CONNECT_SECONDS = 3.0
"""How long a viewer may take to answer."""

FIELD_OF_VIEW = math.radians(55)
"""The viewer's vertical field of view."""

Color = tuple[int, int, int]

SCAN_COLOR = (255, 80, 60)
TRAIL_COLOR = (40, 110, 220)
LASER_COLOR = (40, 110, 220)
TRUTH_COLOR = (150, 150, 150)
LABEL_COLOR = (255, 255, 255)

SCORES = {
    "occupied_f1": ("occupied F1", (255, 255, 255)),
    "occupied_precision": ("occupied precision", (86, 180, 233)),
    "occupied_recall": ("occupied recall", (230, 159, 0)),
    "free_accuracy": ("free accuracy", (0, 158, 115)),
    "auc": ("AUC", (204, 121, 167)),
}
"""The map's scores over time: name and colour of each line."""

BAND_ALPHA = 130
"""How opaque the outlines of one standard deviation are."""

SHARES = {
    "f1": ("F1", (255, 255, 255)),
    "precision": ("precision", (86, 180, 233)),
    "recall": ("recall", (230, 159, 0)),
    "iou": ("mean IoU", (0, 158, 115)),
}
"""How much of what is there was found, over time."""

LENGTHS = {
    "position": ("position, mm", (86, 180, 233)),
    "width": ("width, mm", (230, 159, 0)),
    "height": ("height, mm", (0, 158, 115)),
}
"""Mean errors of what was found, over time; the angle's has a plot of its own scale."""

POSE_LENGTHS = (("position, mm", (86, 180, 233)), ("1σ told, mm", (40, 90, 130)))
POSE_TURNS = (("heading, degrees", (230, 159, 0)), ("1σ told, degrees", (130, 90, 0)))
"""Errors of poses over time, each with the standard deviation that was told, where one was."""

CROPS_IN_A_ROW = 6

CHI_SQUARED = 5.991
"""Two normal numbers' squares add up to less with 95 % chance."""


class RerunViewer:
    """Draws a replay as a rerun recording, which is opened when the replay begins.

    ``announce`` is told where a served replay can be looked at. Raises UsageError, OutputError or
    ViewerUnreachableError where the recording cannot be sent.
    """

    shows = True

    def __init__(self, options: ViewerOptions, announce: Callable[[str], None]) -> None:
        if options.spawn:
            _check_display()
        if options.connect is not None:
            _check_answers(options.connect)
        self._options = options
        self._announce = announce
        self._recording = rr.RecordingStream(APPLICATION)
        self._recording.set_log_time_enabled(False)
        self._batch: list[_ScanEntry] = []
        self._batch_started = 0.0
        self._pose_errors: list[tuple[tuple[int, int], tuple[float, float], tuple[float, float]]] = []
        self._trail: list[tuple[float, float]] = []
        self._size = 1.0
        self._styled: set[str] = set()

    def begin(self, scene: Scene) -> None:
        """Opens the recording; sends the layout, and the names and colours of the series."""
        self._open_sinks()
        x0, y0, x1, y1 = scene.bounds
        self._size = max(x1 - x0, y1 - y0)
        self._recording.send_recording_name(f"{scene.log} ({scene.mapper})")
        self._recording.send_blueprint(_blueprint(scene))
        self._static("map", rr.ViewCoordinates.RIGHT_HAND_Z_UP)
        self._static("evidence", rr.ViewCoordinates.RIGHT_HAND_Z_UP)
        self._name_series("scores", SCORES.values())
        self._name_series("pose_error/position", POSE_LENGTHS)
        self._name_series("pose_error/heading", POSE_TURNS)
        if scene.has_errors:
            self._name_series("errors/found", SHARES.values())
            self._name_series("errors/lengths", LENGTHS.values())
            self._name_series("errors/angle", [("angle, degrees", (204, 121, 167))])
        self._name_series("timing", [("mapping, ms a scan", (86, 180, 233))])

    def show_truth(self, position: int, stamp: int, world: World) -> None:
        """The outlines of the true world from now on."""
        self._send_batch()
        self._at(position, stamp)
        rings = [np.vstack((ring := primitive.outline(64), ring[:1])) for primitive in world.primitives]
        outlines = [self._lifted(ring, TRUTH_LIFT) for ring in rings]
        labels = [str(primitive.kind) for primitive in world.primitives]
        radius = rr.Radius.ui_points(1.0)
        if outlines:
            self._recording.log(
                "map/truth/primitives",
                rr.LineStrips3D(outlines, labels=labels, show_labels=False, colors=[TRUTH_COLOR], radii=radius),
            )
        if world.walls:
            strips = list(self._lifted(np.asarray(world.walls).reshape(-1, 2, 2), TRUTH_LIFT))
            self._recording.log("map/truth/walls", rr.LineStrips3D(strips, colors=[TRUTH_COLOR], radii=radius))

    def show_scan(self, position: int, stamp: int, pose: Pose2D, points: FloatArray, seconds: float) -> None:
        """The laser's pose, a scan's end points (M, 2) in the map frame, and the mapper's seconds for it."""
        if not self._batch:
            self._batch_started = time.perf_counter()
        self._batch.append(_ScanEntry(position, stamp, pose, points, seconds))
        self._trail.append((pose.x, pose.y))
        old = time.perf_counter() - self._batch_started > BATCH_SECONDS
        if self._options.live or len(self._batch) >= BATCH_SCANS or (old and self._options.watched):
            self._send_batch()

    def show_map(self, position: int, stamp: int, grid: OccupancyGrid, scores: MapScores | None) -> None:
        """The map so far and its scores against the truth."""
        self._send_batch()
        self._at(position, stamp)
        self._recording.log("map/grid", _grid_map(grid))
        if grid.evidence is not None:
            self._recording.log("evidence/grid", _evidence_map(grid))
        if scores is not None:
            values = [value if (value := getattr(scores, name)) is not None else math.nan for name in SCORES]
            self._recording.log("scores", rr.Scalars(values))

    def show_sighting(self, position: int, stamp: int, sighting: Sighting) -> None:
        """The primitives found in the map so far: outlines, table, crops, errors."""
        self._send_batch()
        self._at(position, stamp)
        found = sighting.detections.found
        self._recording.log("map/detections", self._outlines(found))
        self._recording.log("map/uncertainty", self._bands(found))
        self._recording.log("map/labels", self._labels(sighting))
        self._recording.log("detections", rr.TextDocument(_detections_table(sighting), media_type="text/markdown"))
        self._recording.log("crops", rr.Image(_crops(found)))
        errors = sighting.errors
        if errors is not None:
            self._recording.log("errors/found", rr.Scalars(_values(errors, SHARES, 1.0)))
            self._recording.log("errors/lengths", rr.Scalars(_values(errors, LENGTHS, 1000.0)))
            angle = math.nan if errors.angle is None else math.degrees(errors.angle)
            self._recording.log("errors/angle", rr.Scalars([angle]))

    def _outlines(self, found: Sequence[Detection]) -> Any:
        """Found primitives as outlines in their kind's colour."""
        rings = [np.vstack((ring := one.primitive.outline(64), ring[:1])) for one in found]
        return rr.LineStrips3D(
            [self._lifted(ring, FOUND_LIFT) for ring in rings],
            colors=[one.primitive.kind.row.color for one in found],
            radii=rr.Radius.ui_points(2.0),
        )

    def _bands(self, found: Sequence[Detection]) -> Any:
        """Outlines one standard deviation within and without those of found primitives that were refined."""
        edges = [(one.primitive.kind, edge) for one in found if one.std for edge in band(one.primitive, one.std)]
        rings = [np.vstack((ring := edge.outline(64), ring[:1])) for _, edge in edges]
        return rr.LineStrips3D(
            [self._lifted(ring, FOUND_LIFT) for ring in rings],
            colors=[(*kind.row.color, BAND_ALPHA) for kind, _ in edges],
            radii=rr.Radius.ui_points(0.8),
        )

    def _labels(self, sighting: Sighting) -> Any:
        """Id, kind and score above each found primitive; «?» while its track is tentative."""
        found = sighting.detections.found
        names = [f"{one.id}{'' if one.confirmed else '?'}" for one in sighting.identities]
        tops = [(one.primitive.x, float(one.primitive.outline(64)[:, 1].max())) for one in found]
        return rr.Points3D(
            self._lifted(np.array(tops).reshape(-1, 2), FOUND_LIFT),
            labels=[f"{name}: {one.primitive.kind} {one.score:.2f}" for name, one in zip(names, found, strict=True)],
            colors=[LABEL_COLOR],
            radii=rr.Radius.ui_points(0.0),
            show_labels=True,
        )

    def show_pose_error(self, position: int, stamp: int, metres: float, radians: float, pose: Pose2D) -> None:
        """How far the pose in use is from the true one, and how far it is told to be."""
        told_metres, told_radians = told_std(pose)
        lengths, turns = (1000 * metres, 1000 * told_metres), (math.degrees(radians), math.degrees(told_radians))
        self._pose_errors.append(((position, stamp), lengths, turns))

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
        try:
            self._recording.flush(timeout_sec=FLUSH_SECONDS)
        except Exception as error:  # rerun raises plain RuntimeErrors
            raise RecordingError(f"the recording could not be written in full: {error}") from error
        if not self._options.serve:
            self._recording.disconnect()
        if self._options.save is not None:
            _part(self._options.save).replace(self._options.save)

    def abandon(self) -> None:
        """Closes the recording; the file it was written to is removed, and an earlier one stays as it was."""
        self._recording.disconnect()
        if self._options.save is not None:
            _part(self._options.save).unlink(missing_ok=True)

    def _open_sinks(self) -> None:
        options = self._options
        sinks: list[Any] = []
        if options.save is not None:
            sinks.append(_file_sink(options.save))
        if options.spawn:
            rr.spawn(connect=False)
            sinks.append(rr.GrpcSink())
        if options.connect is not None:
            sinks.append(rr.GrpcSink(options.connect))
        if options.serve:
            url = self._recording.serve_grpc(grpc_port=_free_port(GRPC_PORT))
            port = _free_port(WEB_PORT)
            rr.serve_web_viewer(web_port=port, open_browser=False, connect_to=url)
            self._announce(f"browse: http://localhost:{port}/?url={quote(url, safe='')}")
            self._announce(f"or:     rerun {url}")
        elif sinks:
            self._recording.set_sinks(*sinks)

    def _at(self, position: int, stamp: int) -> None:
        self._recording.set_time(STAMP, timestamp=np.datetime64(stamp, "ns"))
        self._recording.set_time(SCAN, sequence=position)

    def _static(self, path: str, what: Any) -> None:
        self._recording.log(path, what, static=True)

    def _name_series(self, path: str, series: Iterable[tuple[str, Color]]) -> None:
        names, colors = zip(*series, strict=True)
        self._static(path, rr.SeriesLines(names=names, colors=colors))

    def _lifted(self, points: FloatArray, lift: float) -> FloatArray:
        """Points (..., 2) of the map at a height above it."""
        height = np.full((*points.shape[:-1], 1), lift * self._size)
        return np.concatenate((points, height), axis=-1)

    def _send_batch(self) -> None:
        """Sends the gathered scans as columns: one call for all instead of one for each."""
        entries, self._batch = self._batch, []
        if entries:
            index = _index([(entry.position, entry.stamp) for entry in entries])
            self._send_scans(index, entries)
            self._send_lasers(index, entries)
            self._send_ellipses(entries)
            milliseconds = [entry.seconds * 1e3 for entry in entries]
            self._columns("timing", index, rr.Scalars.columns(scalars=milliseconds))
            self._send_trail(entries[-1])
        errors, self._pose_errors = self._pose_errors, []
        if errors:
            times, lengths, turns = zip(*errors, strict=True)
            index = _index(times)
            self._columns("pose_error/position", index, rr.Scalars.columns(scalars=lengths))
            self._columns("pose_error/heading", index, rr.Scalars.columns(scalars=turns))

    def _send_scans(self, index: Sequence[Any], entries: list[_ScanEntry]) -> None:
        counts = [len(entry.points) for entry in entries]
        points = self._lifted(np.concatenate([entry.points for entry in entries]), SCAN_LIFT)
        columns = rr.Points3D.columns(positions=points).partition(counts)
        self._columns("map/scan", index, columns)
        self._static_once("map/scan", rr.Points3D.from_fields(colors=[SCAN_COLOR], radii=rr.Radius.ui_points(1.75)))

    def _send_trail(self, last: _ScanEntry) -> None:
        """The path so far, as dots: a robot that is warped has no line to show."""
        trail = self._lifted(np.asarray(_thin(self._trail, TRAIL_POINTS)), TRAIL_LIFT)
        self._at(last.position, last.stamp)
        dots = rr.Points3D(trail, colors=[TRAIL_COLOR], radii=rr.Radius.ui_points(1.75))
        self._recording.log("map/trajectory", dots)

    def _send_lasers(self, index: Sequence[Any], entries: list[_ScanEntry]) -> None:
        poses = [entry.pose for entry in entries]
        length = 0.06 * min(self._size, 10.0)
        origins = self._lifted(np.array([(pose.x, pose.y) for pose in poses]), TRUTH_LIFT)
        vectors = [(length * math.cos(pose.theta), length * math.sin(pose.theta), 0.0) for pose in poses]
        self._columns("map/laser", index, rr.Arrows3D.columns(vectors=vectors, origins=origins))
        self._static_once("map/laser", rr.Arrows3D.from_fields(colors=[LASER_COLOR], radii=rr.Radius.ui_points(2.5)))

    def _send_ellipses(self, entries: list[_ScanEntry]) -> None:
        """Where the laser is with 95 % chance, where its pose has a covariance."""
        sure = [entry for entry in entries if entry.pose.covariance is not None]
        if sure:
            rings = [self._lifted(confidence_ellipse(entry.pose), TRUTH_LIFT) for entry in sure]
            index = _index([(entry.position, entry.stamp) for entry in sure])
            columns = rr.LineStrips3D.columns(strips=rings).partition([1] * len(rings))
            self._columns("map/laser_95_percent", index, columns)
            look = rr.LineStrips3D.from_fields(colors=[LASER_COLOR], radii=rr.Radius.ui_points(1.0))
            self._static_once("map/laser_95_percent", look)

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

    def from_above(origin: str, name: str) -> rrb.Spatial3DView:
        return rrb.Spatial3DView(
            origin=origin,
            name=name,
            eye_controls=top_down,
            line_grid=rrb.LineGrid3D(visible=False),
            background=(235, 235, 235, 255),
        )

    left: Any = from_above("map", f"Map ({scene.mapper}), from above")
    if scene.has_evidence:
        left = rrb.Tabs(left, from_above("evidence", "Evidence: rays per cell"), active_tab=0)
    result: Any = rrb.TextDocumentView(origin="summary", name="Result")
    if scene.has_detections:
        table = rrb.TextDocumentView(origin="detections", name="Detections")
        crops = rrb.Spatial2DView(origin="crops", name="Crops, as the networks see them")
        result = rrb.Tabs(result, table, crops, active_tab=0)
    right: list[Any] = [result]
    if scene.has_errors:
        found = _series("errors/found", "Primitives found", axis_y=rrb.ScalarAxis(range=(0.0, 1.02), zoom_lock=True))
        lengths, angle = _series("errors/lengths", "Errors: lengths"), _series("errors/angle", "Errors: angle")
        right.append(rrb.Tabs(found, lengths, angle, active_tab=0))
    if scene.has_scores:
        unit = rrb.ScalarAxis(range=(0.0, 1.02), zoom_lock=True)
        right.append(_series("scores", "Map accuracy", axis_y=unit))
    if scene.has_pose_errors:
        place, turn = _series("pose_error/position", "Pose error"), _series("pose_error/heading", "Heading error")
        right.append(rrb.Tabs(place, turn, active_tab=0))
    right += [_series("timing", "Stage timings"), rrb.TextLogView(origin="events", name="Events")]
    shares = [2.0, *[2.0] * (len(right) - 2), 1.2]
    return rrb.Blueprint(
        rrb.Horizontal(left, rrb.Vertical(*right, row_shares=shares), column_shares=[3, 2]),
        rrb.TimePanel(timeline=STAMP, state="collapsed"),
        rrb.BlueprintPanel(state="collapsed"),
        rrb.SelectionPanel(state="collapsed"),
    )


def _series(origin: str, name: str, **properties: Any) -> rrb.TimeSeriesView:
    legend = rrb.PlotLegend(rrb.Corner2D.RightBottom)
    return rrb.TimeSeriesView(origin=origin, name=name, plot_legend=legend, **properties)


def _values(errors: DetectionErrors, series: Iterable[str], unit: float) -> list[float]:
    """Some of the errors, in a plot's units; what there is not leaves a gap."""
    return [math.nan if (value := getattr(errors, name)) is None else unit * value for name in series]


def told_std(pose: Pose2D) -> tuple[float, float]:
    """How unsure a pose's place (m, both axes together) and heading (rad) are told to be; NaN where nobody knows."""
    if pose.covariance is None:
        return math.nan, math.nan
    xx, yy, tt = np.diag(pose.covariance).tolist()
    return math.sqrt(xx + yy), math.sqrt(tt)


def confidence_ellipse(pose: Pose2D) -> FloatArray:
    """The ring (33, 2) around a pose's place that holds the true one with 95 % chance."""
    assert pose.covariance is not None
    spread, axes = np.linalg.eigh(pose.covariance[:2, :2])
    angle = np.linspace(0, 2 * np.pi, 33)
    radii = np.sqrt(CHI_SQUARED * np.maximum(spread, 0.0))
    ring: FloatArray = np.column_stack((radii[0] * np.cos(angle), radii[1] * np.sin(angle))) @ axes.T
    ring += pose.x, pose.y
    return ring


def _detections_table(sighting: Sighting) -> str:
    """Found primitives as a Markdown table: lengths in millimetres, angles in degrees."""
    lines = ["| id | kind | score | x, mm | y, mm | angle | size, mm | ± 1σ: mm, ° |", "|" + "---|" * 8]
    for identity, one in zip(sighting.identities, sighting.detections.found, strict=True):
        primitive = one.primitive
        angle = "" if primitive.theta is None else f"{math.degrees(primitive.theta):.1f}°"
        size = ", ".join(f"{key.replace('_', ' ')} {1000 * value:.1f}" for key, value in primitive.sizes.items())
        place = f"{1000 * primitive.x:.1f} | {1000 * primitive.y:.1f}"
        cells = (
            identity.id,
            primitive.kind,
            f"{one.score:.2f}",
            place,
            angle,
            size,
            _spread(one.std or identity.std),
        )
        lines.append(f"| {' | '.join(str(cell) for cell in cells)} |")
    return "\n".join(lines) + "\n"


def _spread(std: Mapping[str, float] | None) -> str:
    """Standard deviations in words; nothing where they are not known."""
    if std is None:
        return ""
    return ", ".join(
        f"angle {math.degrees(value):.2f}°" if name == "theta" else f"{name.replace('_', ' ')} {1000 * value:.2f}"
        for name, value in std.items()
    )


def band(primitive: Primitive, std: Mapping[str, float]) -> Iterator[Primitive]:
    """A primitive made smaller and larger by one standard deviation (m, by name) of its place and sizes together."""
    place = math.sqrt((std["x"] ** 2 + std["y"] ** 2) / 2)
    half = 1.0 if primitive.is_round else 0.5
    for sign in (-1, 1):
        sizes = tuple(
            max(size + sign * math.hypot(half * std[name], place) / half, 1e-3)
            for name, size in primitive.sizes.items()
        )
        yield replace(primitive, size=sizes)


def _crops(found: Sequence[Detection]) -> NDArray[np.uint8]:
    """The crops as the networks see them, in rows, black where occupied; the largest y at the top."""
    found = [one for one in found if one.crop.size]
    side = max((len(one.crop) for one in found), default=1)
    rows = max(1, -(-len(found) // CROPS_IN_A_ROW))
    sheet = np.full((rows * (side + 2), CROPS_IN_A_ROW * (side + 2)), 215, np.uint8)
    for k, one in enumerate(found):
        row, col = k // CROPS_IN_A_ROW * (side + 2), k % CROPS_IN_A_ROW * (side + 2)
        height, width = one.crop.shape
        sheet[row : row + height, col : col + width] = 255 - np.flipud(one.crop)
    return sheet


def _grid_map(grid: OccupancyGrid) -> rr.GridMap:
    """A grid as nav_msgs values (0 free to 100 occupied, 255 unknown), flipped: rerun's first row is the top."""
    percent = np.rint(grid.probability * 100).astype(np.uint8)
    percent[grid.probability == 0.5] = 255
    return _as_grid_map(grid, percent, rr.components.Colormap.RvizMap)


def _as_grid_map(grid: OccupancyGrid, values: NDArray[np.uint8], colormap: Any) -> rr.GridMap:
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


def _evidence_map(grid: OccupancyGrid) -> rr.GridMap:
    """How many rays came to each cell, on a logarithmic scale."""
    return _as_grid_map(grid, grid.image()[..., 1], None)


def _index(times: Sequence[tuple[int, int]]) -> list[Any]:
    positions, stamps = zip(*times, strict=True)
    return [
        rr.TimeColumn(STAMP, timestamp=np.array(stamps, dtype="datetime64[ns]")),
        rr.TimeColumn(SCAN, sequence=positions),
    ]


def _thin(points: Sequence[tuple[float, float]], most: int) -> Sequence[tuple[float, float]]:
    """At most about ``most`` of the points, evenly spread, the last one among them."""
    step = max(1, -(-len(points) // most))
    return [*points[: len(points) - 1 : step], points[-1]] if points else []


def _file_sink(path: Path) -> Any:
    try:
        _part(path).open("wb").close()
    except OSError as error:
        raise OutputError(path, error) from error
    return rr.FileSink(_part(path))


def _part(path: Path) -> Path:
    """Where a recording lies until it is whole."""
    return path.with_name(path.name + ".part")


def _free_port(first: int) -> int:
    """The first port from ``first`` on that nothing listens on."""
    for port in range(first, first + 100):
        with socket.socket() as probe:
            probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            try:
                probe.bind(("", port))
            except OSError:
                continue
            return port
    raise UsageError(f"--serve finds no free port from {first} to {first + 99}")


class RecordingError(PrimError):
    """A recording that could not be written or sent."""


class ViewerUnreachableError(PrimError):
    """No viewer where one should be."""


def _check_answers(url: str) -> None:
    """Raises unless something listens at ``url``: rerun itself would wait, lose everything, and say nothing."""
    try:
        parts = urlsplit(url)
        host, port = parts.hostname, parts.port
    except ValueError:
        parts, host, port = urlsplit(""), None, None
    if not parts.scheme.startswith("rerun") or host is None or port is None:
        raise UsageError(f"--connect {url}: give an address such as rerun+http://127.0.0.1:9876/proxy")
    try:
        socket.create_connection((host, port), timeout=CONNECT_SECONDS).close()
    except OSError as error:
        raise ViewerUnreachableError(f"no viewer answers at {url}: {error}; start one there with: rerun") from error


def _check_display() -> None:
    if os.name == "posix" and not (os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")):
        raise UsageError("--spawn needs a display, and there is none: save with --save OUT.rrd, or --serve")
