"""All that is sent to rerun: the recording, and what is drawn on it."""

from __future__ import annotations

import math
import struct
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from detect.detection import OTHER
from mapping.grid import OccupancyGrid
from mapping.map_metrics import MapScores
from prim.arrays import FloatArray
from prim.environment import environment
from prim.errors import PrimError, UsageError
from prim.files import OutputFile, output_errors
from prim.metrics import DetectionErrors
from prim.scan import PosedScan
from prim.text import printable
from prim.world import World
from replay.detection.stage import DetectionResult
from replay.outputs.exports import APPLICATION, RECORDING
from replay.outputs.found_objects import OBJECT_COLOR, FoundObject, found_objects
from replay.result import ReplayResult
from replay.viewer_layout import (
    ANGLE_ERROR,
    DETECTION_SCORES,
    HEADING_ERROR,
    LENGTH_ERRORS,
    MAPPING_TIME,
    POSITION_ERROR,
    SCAN,
    SCENE,
    SCORES,
    STAMP,
    Color,
    blueprint,
    layers,
)
from replay.viewing.checks import check_display, check_viewer, local_address
from replay.viewing.drawing import (
    closed,
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
from replay.viewing.serving import RecordingServer

with environment(RUST_LOG="off"):  # see replay.viewer_layout
    import rerun as rr

if TYPE_CHECKING:
    from detect.detection import Detection

_FOOTER, _FOOTER_MARK = struct.Struct("<QQI8sI"), b"RRF2FOOT"
"""The end of a recording that is whole: where its footer begins, its length, a checksum, a mark, a version."""

TRAJECTORY_POINTS = 2000
"""The trajectory is drawn with about this many points at most."""

TRAJECTORY_HEIGHT, SCAN_HEIGHT, TRUTH_HEIGHT, DETECTION_HEIGHT = 0.0004, 0.0008, 0.0012, 0.0016
"""Heights above the map, as shares of its size: enough to keep what is drawn on it from flickering."""

SERVE_HOST = "127.0.0.1"
"""Where ``--serve`` listens by default: only this machine reaches it."""

FLUSH_SECONDS = 60.0
"""How long the rest of a recording may take to be written or sent (s)."""

LASER_LENGTH, MAX_SCALE = 0.06, 10.0
"""The laser's arrow is as long as this share of the map's size, and of this size (m) at most."""

SCAN_COLOR = (255, 80, 60)
TRAJECTORY_COLOR = (40, 110, 220)
LASER_COLOR = (40, 110, 220)
LOOP_COLOR = (20, 160, 90)
TRUTH_COLOR, TRUTH_OTHERS_COLOR = (150, 150, 150), (200, 200, 200)
LABEL_COLOR = (255, 255, 255)

BOUNDS_ALPHA = 130
"""Opacity (0 to 255) of the outlines at one standard deviation."""


class RecordingError(PrimError):
    """A recording could not be written or sent."""


class RerunViewer:
    """Draws a replay as a rerun recording, which is opened when the replay begins.

    Args:
        options: Where the recording goes.
        announce: Called with the addresses of a replay that is served.

    Raises:
        UsageError: A viewer is to be opened, and there is no display; or a URL is not one of a viewer; or a host is
            none of this machine; or rerun is switched off.
        ViewerUnreachableError: No viewer answers at the URL.
    """

    shows = True

    def __init__(self, options: ViewerOptions, announce: Callable[[str], None]) -> None:
        if options.spawn:
            check_display()
        if options.connect is not None:
            check_viewer(options.connect)
        self._serve_host = SERVE_HOST if options.serve_host is None else options.serve_host
        if options.serve:
            local_address(self._serve_host)
        self._options = options
        self._announce = announce
        self._output: OutputFile | None = None
        self._server: RecordingServer | None = None
        self._recording = rr.RecordingStream(APPLICATION)
        if not rr.is_enabled(self._recording):
            raise UsageError("rerun is switched off by the environment variable RERUN: unset it, or give --no-viewer")
        self._recording.set_log_time_enabled(False)
        self._batch = ScanBatch(options.live, options.watched)
        self._pose_errors: list[tuple[tuple[int, int], tuple[float, float], tuple[float, float]]] = []
        self._mapping_times: dict[str, list[tuple[int, int, float]]] = {}
        self._layers: dict[str, str] = {}
        self._trajectory: list[tuple[float, float]] = []
        self._world: World | None = None
        self._size = 1.0
        self._styled: set[str] = set()

    def begin(self, scene: Scene) -> None:
        """See :meth:`.Viewer.begin`."""
        self._open_sinks()
        x0, y0, x1, y1 = scene.bounds
        self._size = max(x1 - x0, y1 - y0)
        self._layers = layers(scene.mappers)
        self._recording.send_recording_name(printable(f"{scene.log} ({', '.join(scene.mappers)})"))
        self._recording.send_blueprint(blueprint(scene))
        self._name_series("pose_error/position", POSITION_ERROR)
        self._name_series("pose_error/heading", HEADING_ERROR)
        self._log_static(SCENE, rr.ViewCoordinates.RIGHT_HAND_Z_UP)
        for layer in self._layers.values():
            self._log_static(f"{layer}map", rr.ViewCoordinates.RIGHT_HAND_Z_UP)
            self._log_static(f"{layer}evidence", rr.ViewCoordinates.RIGHT_HAND_Z_UP)
            self._name_series(f"{layer}scores", SCORES.values())
            if scene.has_errors:
                self._name_series(f"{layer}errors/found", DETECTION_SCORES.values())
                self._name_series(f"{layer}errors/lengths", LENGTH_ERRORS.values())
                self._name_series(f"{layer}errors/angle", [ANGLE_ERROR])
            self._name_series(f"{layer}timing", [MAPPING_TIME])
        if scene.loops is not None and len(scene.loops):
            strips, radius = list(self._raised(scene.loops, TRAJECTORY_HEIGHT)), rr.Radius.ui_points(1.25)
            self._log_static(f"{SCENE}/loops", rr.LineStrips3D(strips, colors=[LOOP_COLOR], radii=radius))

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
                f"{SCENE}/truth/primitives",
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
            self._recording.log(f"{SCENE}/truth/walls", rr.LineStrips3D(strips, colors=[TRUTH_COLOR], radii=radius))
        if world.solids:
            self._recording.log(
                f"{SCENE}/truth/others",
                rr.LineStrips3D(
                    [self._raised(closed(solid.outline), TRUTH_HEIGHT) for solid in world.solids],
                    labels=[printable(solid.name) for solid in world.solids],
                    show_labels=False,
                    colors=[TRUTH_OTHERS_COLOR],
                    radii=radius,
                ),
            )

    def show_scan(self, posed: PosedScan) -> None:
        """See :meth:`.Viewer.show_scan`."""
        if posed.scanner == 0:
            self._trajectory.append((posed.pose.x, posed.pose.y))
        entry = ScanEntry(posed.position, posed.scan.stamp, posed.pose, posed.points, posed.scanner)
        if self._batch.add(entry):
            self._send_batch()

    def show_mapping_time(self, mapper: str, posed: PosedScan, seconds: float) -> None:
        """See :meth:`.Viewer.show_mapping_time`."""
        self._mapping_times.setdefault(mapper, []).append((posed.position, posed.scan.stamp, 1e3 * seconds))

    def show_map(self, mapper: str, position: int, stamp: int, grid: OccupancyGrid, scores: MapScores | None) -> None:
        """See :meth:`.Viewer.show_map`."""
        self._send_batch()
        self._set_time(position, stamp)
        layer = self._layers[mapper]
        self._recording.log(f"{layer}map/grid", _occupancy_map(grid))
        if grid.visits is not None:
            self._recording.log(f"{layer}evidence/grid", _visits_map(grid))
        if scores is not None:
            values = [value if (value := getattr(scores, name)) is not None else math.nan for name in SCORES]
            self._recording.log(f"{layer}scores", rr.Scalars(values))

    def show_pose_error(self, posed: PosedScan, position_error: float, heading_error: float) -> None:
        """See :meth:`.Viewer.show_pose_error`."""
        position_std, heading_std = pose_stds(posed.pose)
        lengths = 1000 * position_error, 1000 * position_std
        angles = math.degrees(heading_error), math.degrees(heading_std)
        self._pose_errors.append(((posed.position, posed.scan.stamp), lengths, angles))

    def show_detections(self, mapper: str, position: int, stamp: int, result: DetectionResult) -> None:
        """See :meth:`.Viewer.show_detections`."""
        self._send_batch()
        self._set_time(position, stamp)
        found, layer = result.detections.found, self._layers[mapper]
        objects = found_objects(result)
        table = rr.TextDocument(detections_markdown(result), media_type=rr.MediaType.MARKDOWN)
        self._recording.log(f"{layer}map/detections", self._outlines(found))
        self._recording.log(f"{layer}map/uncertainty", self._uncertainty_bounds(found))
        self._recording.log(f"{layer}map/labels", self._labels(result))
        self._recording.log(f"{layer}map/objects", self._object_outlines(objects))
        self._recording.log(f"{layer}map/objects/labels", self._object_labels(objects))
        self._recording.log(f"{layer}detections", table)
        self._recording.log(f"{layer}crops", rr.Image(crop_sheet(found)))
        errors = result.errors
        if errors is not None:
            self._recording.log(f"{layer}errors/found", rr.Scalars(_values(errors, DETECTION_SCORES, 1.0)))
            self._recording.log(f"{layer}errors/lengths", rr.Scalars(_values(errors, LENGTH_ERRORS, 1000.0)))
            angle = math.nan if errors.angle is None else math.degrees(errors.angle)
            self._recording.log(f"{layer}errors/angle", rr.Scalars([angle]))

    def event(self, position: int, stamp: int, text: str, warning: bool = False) -> None:
        """See :meth:`.Viewer.event`."""
        self._set_time(position, stamp)
        level = rr.TextLogLevel.WARN if warning else rr.TextLogLevel.INFO
        self._recording.log("events", rr.TextLog(printable(text), level=level))

    def finish(self, results: Sequence[ReplayResult]) -> None:
        """See :meth:`.Viewer.finish`.

        Raises:
            RecordingError: The recording could not be written or sent in full.
            OutputError: It cannot be put in its place.
        """
        self._send_batch()
        self._log_static("summary", rr.TextDocument(summary_markdown(results), media_type=rr.MediaType.MARKDOWN))
        error = self._close()
        if error and (self._options.connect is None or self._output is None):
            self.abandon()
            raise error
        if self._output is not None:
            _check_whole(self._output)
            self._output.commit()
        if error:  # that a viewer has gone costs the file nothing
            raise RecordingError(f"{error}; {self._options.save} is whole")

    def _close(self) -> RecordingError | None:
        """Close the recording; return the error if not all of it could be written or sent."""
        error = None
        try:
            self._recording.flush(timeout_sec=FLUSH_SECONDS)
        except Exception as cause:  # rerun raises plain RuntimeErrors
            sent = "written" if self._options.connect is None else "sent"
            error = RecordingError(f"the recording could not be {sent} in full: {printable(str(cause))}")
        self._recording.disconnect()  # a server keeps what it was sent
        return error

    def abandon(self) -> None:
        """Close the recording and remove its file; an earlier recording of that name stays as it was."""
        self._recording.disconnect()
        if self._server is not None:
            self._server.close()
        if self._output is not None:
            self._output.discard()

    # The recording: where it goes, times, names

    def _open_sinks(self) -> None:
        """Open the file and the viewers that the recording goes to."""
        options = self._options
        sinks: list[Any] = []
        if options.save is not None:
            self._output = OutputFile(options.save, RECORDING, options.force)
            sinks.append(rr.FileSink(self._output.part))
        if options.spawn:
            with environment(CI="true", RUST_LOG="off"):  # the viewer sends no usage data and logs nothing then
                rr.spawn(connect=False, recording=self._recording)
            sinks.append(rr.GrpcSink())
        if options.connect is not None:
            sinks.append(rr.GrpcSink(options.connect))
        if options.serve:
            sinks.append(rr.GrpcSink(self._serve()))
        if sinks:
            self._recording.set_sinks(*sinks)

    def _serve(self) -> str:
        """Start the server that browsers connect to, and return where the recording is sent."""
        self._server = RecordingServer(self._serve_host)
        page, url = self._server.addresses.announced
        self._announce(f"browse: {page}")
        self._announce(f"or:     rerun {url}")
        return self._server.addresses.recording

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

    def _object_outlines(self, objects: Sequence[FoundObject]) -> Any:
        """Draw the outlines of objects of no kind in grey."""
        return rr.LineStrips3D(
            [self._raised(closed(thing.outline), DETECTION_HEIGHT) for thing in objects],
            colors=[OBJECT_COLOR],
            radii=rr.Radius.ui_points(2.5),
        )

    def _object_labels(self, objects: Sequence[FoundObject]) -> Any:
        """Write id and score above each object of no kind."""
        labels = [f"{thing.id}: {OTHER} {thing.score:.2f}" for thing in objects]
        return self._texts(labels, [(thing.x, float(thing.outline[:, 1].max())) for thing in objects])

    def _labels(self, result: DetectionResult) -> Any:
        """Write id, kind and score above each detection; «?» while its track is tentative."""
        labels, tops = [], []
        for identity, detection in zip(result.identities, result.detections.found, strict=True):
            primitive, mark = detection.primitive, "" if identity.confirmed else "?"
            labels.append(f"{identity.id}{mark}: {primitive.kind} {detection.score:.2f}")
            tops.append((primitive.x, float(ring(primitive)[:, 1].max())))
        return self._texts(labels, tops)

    def _texts(self, labels: Sequence[str], places: Sequence[tuple[float, float]]) -> Any:
        """Write texts at places of the map (m)."""
        return rr.Points3D(
            self._raised(np.array(places).reshape(-1, 2), DETECTION_HEIGHT),
            labels=labels,
            colors=[LABEL_COLOR],
            radii=rr.Radius.ui_points(0.0),
            show_labels=True,
        )

    # Scans, which are sent in batches

    def _send_batch(self) -> None:
        """Send the gathered scans, pose errors and times as columns: one call for all instead of one for each."""
        entries = self._batch.take()
        if entries:
            for scanner in sorted({entry.scanner for entry in entries}):
                of_scanner = [entry for entry in entries if entry.scanner == scanner]
                index = _time_columns([(entry.position, entry.stamp) for entry in of_scanner])
                suffix = f"_{scanner + 1}" if scanner else ""
                self._send_scans(index, of_scanner, f"{SCENE}/scan{suffix}")
                self._send_lasers(index, of_scanner, f"{SCENE}/laser{suffix}")
            self._send_ellipses(entries)
            self._send_trajectory(entries[-1])
        errors, self._pose_errors = self._pose_errors, []
        if errors:
            times, lengths, angles = zip(*errors, strict=True)
            index = _time_columns(times)
            self._send_columns("pose_error/position", index, rr.Scalars.columns(scalars=lengths))
            self._send_columns("pose_error/heading", index, rr.Scalars.columns(scalars=angles))
        times_of, self._mapping_times = self._mapping_times, {}
        for mapper, mapped in times_of.items():
            positions, stamps, milliseconds = zip(*mapped, strict=True)
            index = _time_columns(list(zip(positions, stamps, strict=True)))
            self._send_columns(f"{self._layers[mapper]}timing", index, rr.Scalars.columns(scalars=milliseconds))

    def _send_scans(self, index: Sequence[Any], entries: list[ScanEntry], path: str) -> None:
        """Send the end points of scans of one scanner."""
        counts = [len(entry.points) for entry in entries]
        points = self._raised(np.concatenate([entry.points for entry in entries]), SCAN_HEIGHT)
        self._send_columns(path, index, rr.Points3D.columns(positions=points).partition(counts))
        self._set_style(path, rr.Points3D.from_fields(colors=[SCAN_COLOR], radii=rr.Radius.ui_points(1.75)))

    def _send_trajectory(self, last: ScanEntry) -> None:
        """Send the trajectory so far, as dots: a robot that is warped has no line to show."""
        points = self._raised(np.asarray(subsample(self._trajectory, TRAJECTORY_POINTS)), TRAJECTORY_HEIGHT)
        self._set_time(last.position, last.stamp)
        dots = rr.Points3D(points, colors=[TRAJECTORY_COLOR], radii=rr.Radius.ui_points(1.75))
        self._recording.log(f"{SCENE}/trajectory", dots)

    def _send_lasers(self, index: Sequence[Any], entries: list[ScanEntry], path: str) -> None:
        """Send the poses of one laser as arrows."""
        poses = [entry.pose for entry in entries]
        length = LASER_LENGTH * min(self._size, MAX_SCALE)
        origins = self._raised(np.array([(pose.x, pose.y) for pose in poses]), TRUTH_HEIGHT)
        vectors = [(length * math.cos(pose.theta), length * math.sin(pose.theta), 0.0) for pose in poses]
        self._send_columns(path, index, rr.Arrows3D.columns(vectors=vectors, origins=origins))
        self._set_style(path, rr.Arrows3D.from_fields(colors=[LASER_COLOR], radii=rr.Radius.ui_points(2.5)))

    def _send_ellipses(self, entries: list[ScanEntry]) -> None:
        """Send the laser's 95 % confidence ellipses, where its poses have covariances."""
        uncertain = [entry for entry in entries if entry.pose.covariance is not None]
        if uncertain:
            rings = [self._raised(confidence_ellipse(entry.pose), TRUTH_HEIGHT) for entry in uncertain]
            index = _time_columns([(entry.position, entry.stamp) for entry in uncertain])
            columns = rr.LineStrips3D.columns(strips=rings).partition([1] * len(rings))
            self._send_columns(f"{SCENE}/laser_95_percent", index, columns)
            style = rr.LineStrips3D.from_fields(colors=[LASER_COLOR], radii=rr.Radius.ui_points(1.0))
            self._set_style(f"{SCENE}/laser_95_percent", style)

    def _send_columns(self, path: str, index: Sequence[Any], columns: Any) -> None:
        self._recording.send_columns(path, indexes=index, columns=columns)


def _check_whole(output: OutputFile) -> None:
    """Check that a recording ends as it should: rerun says nothing where its footer found no place on the disk.

    Raises:
        RecordingError: It does not; it is removed then.
        OutputError: It is not there any more.
    """
    with output_errors(output.path):
        content = _end_of(output.part, _FOOTER.size)
    if len(content) == _FOOTER.size and _FOOTER.unpack(content)[3] == _FOOTER_MARK:
        return
    output.discard()
    raise RecordingError(f"{output.path}: the recording could not be written in full: is the disk full?")


def _end_of(path: Path, size: int) -> bytes:
    with path.open("rb") as stream:
        stream.seek(max(0, path.stat().st_size - size))
        return stream.read(size)


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
