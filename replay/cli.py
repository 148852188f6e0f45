"""prim-replay: the command line of the replay."""

from __future__ import annotations

import dataclasses
import math
import shlex
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from itertools import takewhile
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer

from prim import __version__, console
from prim.choices import DEFAULT_SIZES, ClockName, MapperName, PoseSourceName, SensorModelName, SweepName
from prim.errors import InterruptedRunError, PrimError, UsageError
from prim.interrupts import interrupted_run

if TYPE_CHECKING:
    from prim.files import ResultFormat
    from prim.interrupts import Interrupts
    from prim.world import Bounds
    from replay.options import ReplayOptions
    from replay.result import ReplayResult
    from replay.viewing.protocol import Viewer, ViewerOptions

PARTLY_LOST = 3
"""The exit code when part of a log could not be read."""

REPORT_SUFFIX = ".report.json"

app = typer.Typer(add_completion=False, rich_markup_mode=None)


def _show_version(wanted: bool) -> None:
    if wanted:
        typer.echo(f"prim-replay {__version__}")
        raise typer.Exit


@app.command()
def replay(
    context: typer.Context,
    logs: Annotated[
        list[Path],
        typer.Argument(metavar="LOG...", help="MCAP logs, ROS 1 or ROS 2 bags, CARMEN logs."),
    ],
    mapper: Annotated[
        str,
        typer.Option(
            metavar="det|prob|forward[,...]",
            help="Deterministic, probabilistic (log-odds), or forward (maximum likelihood); several side by side.",
        ),
    ] = MapperName.PROB.value,
    pose: Annotated[PoseSourceName, typer.Option(help="The source of poses.")] = PoseSourceName.AUTO,
    resolution: Annotated[float, typer.Option(metavar="M", help="Side of a cell, metres.")] = 0.01,
    bounds: Annotated[str, typer.Option(metavar="auto or X0 Y0 X1 Y1", help="The map's bounds, metres.")] = "auto",
    scan_topic: Annotated[
        list[str] | None,
        typer.Option(metavar="T", help="The topic of scans; give it again for scanners that are mapped together."),
    ] = None,
    height_slice: Annotated[
        tuple[float, float] | None,
        typer.Option("--slice", metavar="ZMIN ZMAX", help="Make scans of a 3D lidar's points at these heights."),
    ] = None,
    clock: Annotated[
        ClockName,
        typer.Option(
            help="What messages are stamped by: their headers, or when they were logged. auto: the headers, moved "
            "onto one clock where they are not."
        ),
    ] = ClockName.AUTO,
    odom_topic: Annotated[str | None, typer.Option(metavar="T", help="The topic of odometry or poses.")] = None,
    fuse: Annotated[
        str | None,
        typer.Option(metavar="odom,gps,compass,imu", help="The sensors to fuse. [default: all available]"),
    ] = None,
    gps_topic: Annotated[str | None, typer.Option(metavar="T", help="The topic of position fixes.")] = None,
    compass_topic: Annotated[
        str | None, typer.Option(metavar="T", help="The topic of vectors that point north.")
    ] = None,
    imu_topic: Annotated[
        str | None,
        typer.Option(metavar="TOPIC", help="Topic of an IMU's orientations. [default: found by type]"),
    ] = None,
    pose_noise: Annotated[
        tuple[float, float] | None,
        typer.Option(
            metavar="M DEG",
            help="Noise (std) of GPS positions and compass headings. [default: estimated from the log]",
        ),
    ] = None,
    odom_noise: Annotated[
        tuple[float, float] | None,
        typer.Option(
            metavar="M DEG", help="Noise (std) of odometry after one metre. [default: estimated from the log]"
        ),
    ] = None,
    match_scans: Annotated[
        bool, typer.Option("--match-scans", help="Correct the poses by matching the scans with each other.")
    ] = False,
    no_deskew: Annotated[
        bool, typer.Option("--no-deskew", help="Treat all beams of a scan as measured at its stamp.")
    ] = False,
    sweep: Annotated[
        SweepName,
        typer.Option(
            help="Whose time a scan's stamp is: the first beam's, or the last one's; reversed: beams run against "
            "time. auto: as the log says, unless scans clearly fit each other better otherwise."
        ),
    ] = SweepName.AUTO,
    start: Annotated[float | None, typer.Option(metavar="S", help="Begin S seconds into the log.")] = None,
    end: Annotated[float | None, typer.Option(metavar="S", help="End S seconds into the log.")] = None,
    duration: Annotated[float | None, typer.Option(metavar="S", help="Replay S seconds.")] = None,
    n_scans: Annotated[int | None, typer.Option(metavar="N", help="Replay N scans.")] = None,
    stride: Annotated[int, typer.Option(metavar="N", help="Replay every N-th scan.")] = 1,
    rate: Annotated[float | None, typer.Option(metavar="R", help="Limit the replay to R times real time.")] = None,
    laser_offset: Annotated[
        tuple[float, float, float] | None,
        typer.Option(metavar="X Y DEG", help="Mounting pose of the laser on the robot, metres and degrees."),
    ] = None,
    max_range: Annotated[
        float | None,
        typer.Option(
            metavar="M", help="Trace beams no further than this, metres. [default: the scanner's range_max]"
        ),
    ] = None,
    sensor_model: Annotated[
        SensorModelName, typer.Option(help="Inverse sensor model of prob: the paper's Eq. 4, or a Gaussian.")
    ] = SensorModelName.EQ4,
    noise_std: Annotated[
        float | None,
        typer.Option(
            metavar="M",
            help="Standard deviation of the range noise, metres. [default: estimated from the log, where needed]",
        ),
    ] = None,
    standing_still: Annotated[
        bool, typer.Option("--standing-still", help="Assume that the robot does not move: map without poses.")
    ] = False,
    map_every: Annotated[
        int | None, typer.Option(metavar="N", help="Show the map every N scans. [default: about 50 times]")
    ] = None,
    no_detect: Annotated[bool, typer.Option("--no-detect", help="Skip the detection of primitives.")] = False,
    detect_every: Annotated[
        str | None,
        typer.Option(
            metavar="N|end",
            help="Detect primitives after the first scan, every N scans and at the end; or at the end only. "
            "[default: 8 times; without a viewer, end]",
        ),
    ] = None,
    no_refine: Annotated[
        bool, typer.Option("--no-refine", help="Keep the networks' estimates: no fit to the rays.")
    ] = False,
    sizes: Annotated[
        tuple[float, float],
        typer.Option(metavar="MIN MAX", help="Objects to look for, by their longest side or diameter, metres."),
    ] = DEFAULT_SIZES,
    closed_world: Annotated[
        bool,
        typer.Option("--closed-world", help="Take all that stands there to be one of the kinds, or a wall."),
    ] = False,
    weights: Annotated[
        Path | None,
        typer.Option(metavar="W.onnx", help="The detector's YOLO network, or its folder. [default: prim's own]"),
    ] = None,
    save: Annotated[Path | None, typer.Option(metavar="OUT.rrd", help="Save the rerun recording here.")] = None,
    spawn: Annotated[bool, typer.Option("--spawn", help="Open a rerun viewer and show the replay.")] = False,
    connect: Annotated[
        str | None, typer.Option(metavar="URL", help="Show the replay in a viewer that runs at URL.")
    ] = None,
    serve: Annotated[
        bool,
        typer.Option(
            "--serve", help="Serve the replay to web browsers on this machine, at port 9090 or the next that is free."
        ),
    ] = False,
    serve_host: Annotated[
        str | None,
        typer.Option(
            metavar="HOST",
            help="With --serve: listen on this address of this machine; 0.0.0.0 lets every machine of the network "
            "watch. [default: 127.0.0.1]",
        ),
    ] = None,
    no_viewer: Annotated[
        bool, typer.Option("--no-viewer", help="Make no rerun recording, and detect primitives at the end only.")
    ] = False,
    report: Annotated[
        Path | None,
        typer.Option(metavar="OUT.json", help="Write the report here; of several mappers, to OUT.MAPPER.json."),
    ] = None,
    map_output: Annotated[
        Path | None,
        typer.Option(
            "--map", metavar="OUT", help="Write OUT.pgm and OUT.yaml for nav2; of several mappers, OUT.MAPPER.pgm."
        ),
    ] = None,
    trajectory: Annotated[
        Path | None, typer.Option(metavar="OUT.tum", help="Write the laser's poses in TUM's format.")
    ] = None,
    force: Annotated[
        bool, typer.Option("--force", help="Replace files that are no earlier results of prim-replay.")
    ] = False,
    max_memory: Annotated[
        float | None,
        typer.Option(
            metavar="GB", help="Refuse a replay that would take more memory. [default: half of the machine's]"
        ),
    ] = None,
    recover: Annotated[bool, typer.Option("--recover", help="Read what is intact of a damaged log.")] = False,
    list_topics: Annotated[
        bool,
        typer.Option("--list", help="Show what logs hold, and what would be used of it; replay nothing."),
    ] = False,
    as_json: Annotated[bool, typer.Option("--json", help="With --list: as JSON, an object for each log.")] = False,
    quiet: Annotated[bool, typer.Option("--quiet", help="Print errors only, and the addresses of --serve.")] = False,
    verbose: Annotated[
        bool,
        typer.Option(
            "--verbose",
            help="Report stage timings, and rejected candidates and objects of no kind with the reasons.",
        ),
    ] = False,
    debug: Annotated[bool, typer.Option("--debug", help="Show tracebacks.")] = False,
    version: Annotated[
        bool, typer.Option("--version", callback=_show_version, is_eager=True, help="Print the version.")
    ] = False,
) -> int:
    """Replay logs of a 2D LiDAR through an occupancy mapper and show the result in rerun.

    Each log leaves a recording and a report in this folder: LOG.MAPPER.rrd and LOG.MAPPER.report.json. Several
    mappers share a recording, and each has a report.
    """
    from replay.keywords import replay_options
    from replay.viewing.protocol import ViewerOptions

    viewer = ViewerOptions(save, spawn, connect, serve, live=rate is not None, force=force, serve_host=serve_host)
    if no_viewer and (viewer != ViewerOptions(live=viewer.live, force=force) or map_every):
        raise UsageError("--no-viewer excludes --save, --spawn, --connect, --serve and --map-every")
    options = replay_options(
        mapper=mapper,
        sensor_model=sensor_model.value,
        noise_std=noise_std,
        pose=pose.value,
        resolution=resolution,
        bounds=_parse_bounds(bounds),
        scan_topic=scan_topic or None,
        height_slice=height_slice,
        clock=clock.value,
        odom_topic=odom_topic,
        laser_offset=_in_radians(laser_offset),
        max_range=max_range,
        max_memory=max_memory,
        standing_still=standing_still,
        fuse=fuse,
        gps_topic=gps_topic,
        compass_topic=compass_topic,
        imu_topic=imu_topic,
        pose_noise=_in_radians(pose_noise),
        odom_noise=_in_radians(odom_noise),
        deskew=not no_deskew,
        sweep=sweep.value,
        match_scans=match_scans,
        start=start,
        end=end,
        duration=duration,
        n_scans=n_scans,
        stride=stride,
        rate=rate,
        map_every=map_every,
        detect=not no_detect,
        detect_every=_parse_interval(detect_every),
        refine=not no_refine,
        sizes=sizes,
        closed_world=closed_world,
        weights=weights,
        recover=recover,
    )
    files = OutputFiles(save, report, map_output, trajectory, force)
    if as_json and not list_topics:
        raise UsageError("--json goes with --list")
    if list_topics:
        if files != OutputFiles(None, None, None, None, force) or viewer.watched:
            raise UsageError("--list replays nothing: it excludes --save, --report, --map, --trajectory and viewers")
        return _list_logs(logs, options, as_json, debug)
    run = Run(options, None if no_viewer else viewer, context.obj, Verbosity(quiet, verbose, debug))
    return _replay_logs(logs, files, run)


@dataclass(frozen=True)
class OutputFiles:
    """The files that a replay leaves; None for those that are not wanted or not named yet.

    Attributes:
        recording: Of rerun.
        report: The report.
        map: The map, which has two files.
        trajectory: The laser's poses.
        force: Whether files in their places may be replaced that are no earlier results.

    Raises:
        UsageError: One has a name that only a folder can have.
    """

    recording: Path | None
    report: Path | None
    map: Path | None
    trajectory: Path | None
    force: bool

    def __post_init__(self) -> None:
        for option, path in (
            ("--save", self.recording),
            ("--report", self.report),
            ("--map", self.map),
            ("--trajectory", self.trajectory),
        ):
            if path is not None and path.name in ("", ".."):
                raise UsageError(f"{option} {path}: it names a folder, and not what is to be written there")

    def named_after(self, log: Path, mappers: Sequence[str], with_recording: bool) -> OutputFiles:
        """Name the recording and the report, where they have no name yet, after a log, in the current folder.

        Args:
            log: The log.
            mappers: The mappers.
            with_recording: Whether a recording is wanted.

        Returns:
            The files of this log.
        """
        from replay.outputs.exports import log_stem

        stem = log_stem(log)
        name = f"{stem}.{'-'.join(mappers)}.rrd"
        recording = self.recording or (Path(name) if with_recording else None)
        report = self.report or Path(
            f"{stem}.{mappers[0]}.report.json" if len(mappers) == 1 else f"{stem}.report.json"
        )
        return dataclasses.replace(self, recording=recording, report=report)

    def of_mapper(self, mapper: str, mappers: Sequence[str]) -> OutputFiles:
        """Return the files of one mapper: of several, the names of its report and its map hold its own.

        Args:
            mapper: The mapper.
            mappers: All mappers of the replay.

        Returns:
            The files, of which all mappers share the recording and the trajectory.
        """
        from replay.outputs.exports import map_stem

        if len(mappers) == 1:
            return self
        report = self.report and _with_name_of(mapper, self.report)
        stem = self.map and self.map.with_name(f"{map_stem(self.map)}.{mapper}")
        return dataclasses.replace(self, report=report, map=stem)

    def formats(self, mappers: Sequence[str]) -> Iterator[tuple[Path, ResultFormat]]:
        """Yield the paths of all files of some mappers, and their formats."""
        from replay.outputs.exports import MAP_DESCRIPTION, MAP_IMAGE, RECORDING, REPORT, TRAJECTORY, map_files

        of_each = [self.of_mapper(mapper, mappers) for mapper in mappers]
        if self.recording:
            yield self.recording, RECORDING
        yield from ((files.report, REPORT) for files in of_each if files.report)
        for files in of_each:
            if files.map:
                yield from zip(map_files(files.map), (MAP_IMAGE, MAP_DESCRIPTION), strict=True)
        if self.trajectory:
            yield self.trajectory, TRAJECTORY

    def paths(self, mappers: Sequence[str]) -> list[Path]:
        """Return the paths of all files of some mappers."""
        return [path for path, _ in self.formats(mappers)]

    def check(self, mappers: Sequence[str]) -> list[Path]:
        """Check that the files can and may be written; return those that replace earlier ones.

        Args:
            mappers: The mappers.

        Returns:
            The paths of files that are there already.

        Raises:
            OutputError: A file cannot be written.
            UsageError: It would replace a file that is no earlier result.
        """
        from prim.files import check_output

        return [path for path, result in self.formats(mappers) if check_output(path, result, self.force)]


@dataclass(frozen=True)
class Verbosity:
    """How much is printed."""

    quiet: bool
    verbose: bool
    debug: bool


@dataclass(frozen=True)
class Run:
    """What holds for all logs of a command.

    Attributes:
        options: How they are replayed.
        viewer: Where their recordings go; None for no recordings.
        interrupts: Holds interruptions back.
        verbosity: How much is printed.
    """

    options: ReplayOptions
    viewer: ViewerOptions | None
    interrupts: Interrupts
    verbosity: Verbosity


def _with_name_of(mapper: str, path: Path) -> Path:
    """Return a path with a mapper's name before its suffix, as in OUT.det.json or LOG.det.report.json."""
    suffix = REPORT_SUFFIX if path.name.endswith(REPORT_SUFFIX) else path.suffix
    return path.with_name(f"{path.name.removesuffix(suffix)}.{mapper}{suffix}")


def _list_logs(logs: Sequence[Path], options: ReplayOptions, as_json: bool, debug: bool) -> int:
    """Print what logs hold, and what a replay would use of it; return the exit code of the worst."""
    from prim import strict_json
    from replay.listing import summarize_log, summary_rows, topic_table

    codes = []
    for log in logs:
        try:
            summary = summarize_log(log, options)
        except PrimError as error:
            if len(logs) == 1:
                raise
            codes.append(console.print_error("prim-replay", error, debug))
            continue
        codes.append(PARTLY_LOST if summary.lost else 0)
        if as_json:
            console.echo(strict_json.dumps(summary.to_json()))
            continue
        console.print_table(summary_rows(summary))
        head, *rows = topic_table(summary)
        console.print_table(rows, head)
        for note in (*summary.notes, *(f"lost: {lost}" for lost in summary.lost)):
            console.echo(f"note: {note}")
    return _worst(codes)


def _worst(codes: Sequence[int]) -> int:
    return next((code for code in (console.FAILED, console.USAGE, PARTLY_LOST) if code in codes), 0)


def _replay_logs(logs: Sequence[Path], files: OutputFiles, run: Run) -> int:
    """Replay logs one after the other; return the exit code of the worst."""
    from prim.files import check_distinct, check_no_input

    mappers = run.options.mappers
    with_recording = run.viewer is not None and not run.viewer.watched
    jobs = {log: files.named_after(log, mappers, with_recording) for log in logs}
    if len({log.resolve() for log in logs}) < len(logs):
        raise UsageError("a log is named twice")
    outputs = [path for job in jobs.values() for path in job.paths(mappers)]
    check_no_input([*logs, *([run.options.weights] if run.options.weights else [])], outputs)
    check_distinct(outputs)
    codes = []
    for log, job in jobs.items():
        try:
            codes.append(_replay_log(log, job, run))
        except InterruptedRunError:
            raise
        except PrimError as error:
            if len(jobs) == 1:
                raise
            codes.append(console.print_error("prim-replay", error, run.verbosity.debug))
    return _worst(codes)


def _replay_log(log: Path, outputs: OutputFiles, run: Run) -> int:
    """Replay one log, write its outputs and print its table; return the exit code.

    Raises:
        InterruptedRunError: The replay was interrupted; its results until then are written, unless there are earlier
            ones in their places.
    """
    from replay.pipeline import Pipeline

    replaced = outputs.check(run.options.mappers)
    viewer = _make_viewer(run.viewer, outputs.recording)
    with console.stage_bars(run.verbosity.quiet) as progress:
        results = Pipeline(log, run.options, viewer, progress, run.interrupts).run_each()
    interruption = results[0].interrupted
    if interruption is not None and replaced and not outputs.force:
        viewer.abandon()
        names = ", ".join(map(str, replaced))
        what = f"nothing is written, since earlier results stay as they are ({names}); --force replaces them"
        raise interrupted_run(interruption, what)
    with run.interrupts.held():
        written, errors = _write_outputs(results, viewer, outputs)
        if not run.verbosity.quiet:
            _print_results(results, written, replaced, run.verbosity.verbose)
        for error in errors[1:]:
            console.print_error("prim-replay", error, run.verbosity.debug)
        if errors:
            raise errors[0]
    if interruption is not None:
        raise interrupted_run(interruption, "what was made until then is written")
    if run.viewer is not None and run.viewer.serve:
        _keep_serving()
    return PARTLY_LOST if results[0].lost else 0


def _make_viewer(shown: ViewerOptions | None, recording: Path | None) -> Viewer:
    """Make the viewer; one that shows nothing where none is wanted."""
    from replay.viewing.protocol import NullViewer

    if shown is None:
        return NullViewer()
    from replay.viewer import RerunViewer

    options = dataclasses.replace(shown, save=recording)
    return RerunViewer(options, announce=lambda line: console.echo(line, err=True))


def _write_outputs(
    results: Sequence[ReplayResult], viewer: Viewer, outputs: OutputFiles
) -> tuple[list[Path], list[PrimError]]:
    """Write the recording, the reports, the maps and the trajectory, where they are wanted.

    Returns:
        The files that were written, and the errors of those that could not be: none of them costs the others.
    """
    from replay.outputs.exports import map_files, write_map, write_report, write_trajectory

    force, mappers = outputs.force, [result.options.mapper for result in results]
    jobs: list[tuple[list[Path], Callable[[], None]]] = []
    for result in results:
        own = outputs.of_mapper(result.options.mapper, mappers)
        if own.report:
            jobs.append(([own.report], partial(write_report, own.report, result, force)))
        if own.map:
            jobs.append(([*map_files(own.map)], partial(write_map, own.map, result.grid, force)))
    if outputs.trajectory:
        jobs.append(([outputs.trajectory], partial(write_trajectory, outputs.trajectory, results[0], force)))
    jobs.insert(0, ([outputs.recording] if outputs.recording else [], partial(viewer.finish, results)))
    written: list[Path] = []
    errors: list[PrimError] = []
    for paths, write in jobs:
        try:
            write()
        except PrimError as error:
            errors.append(error)
        else:
            written += paths
    return written, errors


def _print_results(
    results: Sequence[ReplayResult], written: Sequence[Path], replaced: Sequence[Path], verbose: bool
) -> None:
    """Print notes, the table, where the outputs are, and which were replaced; if ``verbose`` what is no primitive."""
    from replay.result import distinct_notes

    for note in distinct_notes(results):
        console.echo(f"note: {note}", err=True)
    if verbose:
        for result in results:
            _print_rejected(result)
            _print_objects(result)
    _print_tables(results, verbose)
    for name, paths in (("wrote", written), ("replaced", [path for path in replaced if path in written])):
        if paths:
            console.echo(f"{name}: " + ", ".join(map(str, paths)))
    for path in written:
        if path.suffix == ".rrd":
            console.echo(f"open:  rerun {shlex.quote(str(path))}")


def _print_rejected(result: ReplayResult) -> None:
    """Print the candidates that were rejected, and why."""
    rejections = result.detections.detections.rejected if result.detections else ()
    for rejection in rejections:
        what = f"{rejection.kind} at ({rejection.x:.2f}, {rejection.y:.2f}) m, score {rejection.score:.2f}"
        console.echo(f"rejected: {what}: {rejection.reason}", err=True)


def _print_objects(result: ReplayResult) -> None:
    """Print the objects that are none of the kinds, and why."""
    from replay.outputs.found_objects import found_objects

    for thing in found_objects(result.detections):
        what = f"object {thing.id} at ({thing.x:.2f}, {thing.y:.2f}) m, score {thing.score:.2f}"
        console.echo(f"no kind: {what}: {thing.reason}", err=True)


def _print_tables(results: Sequence[ReplayResult], verbose: bool) -> None:
    """Print the table of one mapper's result, or how several compare; with the time of each stage if verbose."""
    from replay.outputs.report import comparison_table, shared_rows, summary_rows

    several = len(results) > 1
    console.print_table(shared_rows(results) if several else summary_rows(results[0]))
    if several:
        names, units, *rows = comparison_table(results)
        console.print_table(rows, [f"{name}\n{unit}" for name, unit in zip(names, units, strict=True)])
    if verbose:
        for result in results:
            name = f"{result.options.mapper}: " if several else "  "
            console.print_table([(f"{name}{stage}", f"{s:.3f} s") for stage, s in result.seconds.items() if s])


def _keep_serving() -> None:
    """Wait until the user ends a replay that is served."""
    console.echo("the replay is done and still served: Ctrl-C ends it", err=True)
    with suppress(KeyboardInterrupt):
        while True:
            time.sleep(3600)


def _in_radians(values: tuple[float, ...] | None) -> Any:
    """Convert the last of some values from degrees to radians; None stays None."""
    return None if values is None else (*values[:-1], math.radians(values[-1]))


def join_bounds(arguments: Sequence[str]) -> list[str]:
    """Join the numbers after ``--bounds`` to one argument, since an option takes a fixed number of them."""
    joined = list(arguments)
    if "--bounds" in joined:
        at = joined.index("--bounds") + 1
        numbers = list(takewhile(_is_number, joined[at : at + 4]))
        joined[at : at + len(numbers)] = [" ".join(numbers)] if numbers else []
    return joined


def _parse_bounds(text: str) -> Bounds | None:
    """Parse «auto» (None), or four numbers (m). Raises UsageError."""
    if text == "auto":
        return None
    numbers = text.split()
    if len(numbers) != 4 or not all(_is_number(number) for number in numbers):
        raise UsageError(f"--bounds {text}: give auto, or four numbers X0 Y0 X1 Y1")
    x0, y0, x1, y1 = (float(number) for number in numbers)
    return x0, y0, x1, y1


def _parse_interval(text: str | None) -> int | Literal["end"] | None:
    """Parse a number of scans or «end»; None stays None. Raises UsageError."""
    if text is None or text == "end":
        return text  # type: ignore[return-value]
    try:
        return int(text)
    except ValueError:
        raise UsageError(f"--detect-every {text}: give a number of scans, or end") from None


def _is_number(text: str) -> bool:
    try:
        return math.isfinite(float(text))
    except ValueError:
        return False


def main() -> None:
    """The entry point."""
    console.exit_process(console.run(app, "prim-replay", join_bounds(sys.argv[1:])))
