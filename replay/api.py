"""The functions that `import prim` offers for replays: a result in Python from one call."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import AbstractContextManager
from dataclasses import dataclass, replace
from numbers import Real
from pathlib import Path
from typing import TYPE_CHECKING, Any, Unpack

import numpy as np
from numpy.typing import NDArray

import mapping.mapper
import prim.log
from mapping.grid import OccupancyGrid
from mapping.map_metrics import MapScores
from mapping.mapper import Mapper
from mapping.range_noise import check_noise
from prim.arrays import FloatArray, Stamps
from prim.errors import OutputError, UsageError
from prim.files import check_no_input
from prim.log.source import LogSource
from prim.metrics import DetectionErrors, overlap_coefficient
from prim.parameters import checked_keywords, checked_path, errors_name_parameters, name_parameters
from prim.scan import Scan
from prim.se2 import Pose2D
from prim.shapes import Primitive
from prim.threads import cores
from prim.world import Bounds
from replay.keywords import PARAMETERS, SWITCHES, ReplayKeywords, replay_options
from replay.localization import localize, pose_scans
from replay.mapping.stage import blames_log_for_size
from replay.notes import pluralize
from replay.options import ReplayOptions
from replay.outputs.exports import log_stem, write_map, write_report, write_trajectory
from replay.outputs.found_objects import FoundObject, found_objects
from replay.outputs.found_primitives import FoundPrimitive, found_primitives
from replay.outputs.report import report_json
from replay.pipeline import Pipeline
from replay.result import ReplayResult
from replay.scans.scan_log import ScanLog
from replay.timing import StageTimer
from replay.viewing.protocol import Viewer, ViewerOptions

if TYPE_CHECKING:
    import pyarrow as pa

    from replay.outputs.picture import Picture


@dataclass(frozen=True)
class LaserTrajectory:
    """The laser's poses at the scans of a replay that have one.

    Attributes:
        stamps: Their stamps (N,) in ns.
        poses: (N, 3) x, y (m), heading (rad) in the map frame.
        covariances: The poses' covariances (N, 3, 3; m, rad); None where they are not known.
        source: Where the poses come from: «truth», «tf», «odom», «fused», «scans» or «still».
        matched: Whether they were corrected by scan matching.
    """

    stamps: NDArray[np.int64]
    poses: FloatArray
    covariances: FloatArray | None
    source: str
    matched: bool


@dataclass(frozen=True, repr=False)
class Result:
    """What a replay of a log found out by one mapper.

    Attributes:
        primitives: The primitives in the map, highest score first.
        objects: What is likeliest none of the kinds, highest score first; never counted among the primitives.
        grid: The map: ``grid.probability`` (rows, cols), 0.5 where unknown, row 0 at the smallest y; ``grid.frame``
            says where it lies.
        poses: Where the laser was.
        truth: The true primitives at the end; empty where the log has no truth, or nothing was detected.
        errors: How the primitives compare with the truth (``f1``, ``position`` in m …); None without ``truth``.
        scores: How the map compares with the truth; None where the log has none.
        notes: What a user should know.
        report: The report, as ``prim-replay`` writes it (schema ``prim-replay/1``).
    """

    primitives: tuple[FoundPrimitive, ...]
    objects: tuple[FoundObject, ...]
    grid: OccupancyGrid
    poses: LaserTrajectory
    truth: tuple[Primitive, ...]
    errors: DetectionErrors | None
    scores: MapScores | None
    notes: tuple[str, ...]
    report: dict[str, Any]
    _replayed: ReplayResult

    def __repr__(self) -> str:
        rows, cols = self.grid.frame.shape
        found, scans = pluralize(len(self.primitives), "primitive"), pluralize(len(self.poses.stamps), "scan")
        if self.objects:
            found += f" and {pluralize(len(self.objects), 'object')} of no kind"
        mapper, source = self._replayed.options.mapper, self.poses.source
        return f"Result({found} in {cols} x {rows} cells of {mapper}, {scans}, poses: {source})"

    def table(self) -> pa.Table:
        """Return the primitives as a table, a row for each; see :func:`replay.outputs.tables.primitives_table`."""
        from replay.outputs.tables import primitives_table

        return primitives_table(self.primitives)

    def plot(self) -> Picture:
        """Draw the map, the primitives, and in greys the objects of no kind and the true primitives, where known."""
        from replay.outputs.picture import draw_picture

        return draw_picture(self.grid, self.primitives, self.truth, self.objects)

    def save(self, directory: str | Path, force: bool = False) -> list[Path]:
        """Write the report, the map for nav2, the poses in TUM's format and the picture into a folder.

        Args:
            directory: The folder; it is made where there is none.
            force: Whether files in their places may be replaced that are no earlier results.

        Returns:
            The files: LOG.MAPPER.report.json, .pgm, .yaml, .tum and .png.

        Raises:
            OutputError: A file cannot be written.
            UsageError: There is another file in its place.
        """
        folder = checked_path("directory", directory)
        try:
            folder.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise OutputError(folder, error) from error
        result = self._replayed
        name = f"{log_stem(result.path)}.{result.options.mapper}"
        files = [folder / f"{name}{suffix}" for suffix in (".report.json", ".pgm", ".yaml", ".tum", ".png")]
        with _errors():
            write_report(files[0], result, force)
            write_map(files[1], result.grid, force)
            write_trajectory(files[3], result, force)
        self.plot().save(files[4], force)
        return files


def replay(
    log: str | Path,
    *,
    save: str | Path | None = None,
    force: bool = False,
    progress: Callable[[int, int], None] | None = None,
    **options: Unpack[ReplayKeywords],
) -> Result:
    """Replay a log through a mapper and the detector.

    Args:
        log: A log of any format that :func:`prim.log.open_log` reads.
        save: Where rerun's recording is saved; None for no recording.
        force: Whether a file in its place may be replaced that is no earlier recording of prim.
        progress: Called after each scan with the number of scans so far and in all.
        **options: The options of ``prim-replay``, see :class:`replay.keywords.ReplayKeywords`; angles are radians.

    Returns:
        The map, the primitives, the poses, and their errors where the log has ground truth.

    Raises:
        UsageError: A parameter is impossible, two exclude each other, or there is another file in the recording's
            place.
        LogReadError: The log cannot be read, or lacks what the replay needs.
        OutputError: The recording cannot be written.
    """
    with _errors():
        pipeline = _pipeline(log, save, force, progress, options)
        if len(pipeline.options.mappers) > 1:
            raise UsageError(f"mapper is {pipeline.options.mapper}: replay_each has a result for each of several")
        return _as_result(_run(pipeline)[0])


def replay_each(
    log: str | Path,
    *,
    save: str | Path | None = None,
    force: bool = False,
    progress: Callable[[int, int], None] | None = None,
    **options: Unpack[ReplayKeywords],
) -> dict[str, Result]:
    """Replay a log through several mappers side by side: ``mapper=["det", "prob", "forward"]``.

    Args:
        log: A log of any format that :func:`prim.log.open_log` reads.
        save: Where rerun's recording of all of them is saved; None for no recording.
        force: Whether a file in its place may be replaced that is no earlier recording of prim.
        progress: Called after each scan with the number of scans so far and in all.
        **options: As for :func:`replay`.

    Returns:
        The result of each mapper by its name.

    Raises:
        UsageError: A parameter is impossible, two exclude each other, or there is another file in the recording's
            place.
        LogReadError: The log cannot be read, or lacks what the replay needs.
        OutputError: The recording cannot be written.
    """
    with _errors():
        results = _run(_pipeline(log, save, force, progress, options))
        return {result.options.mapper: _as_result(result) for result in results}


def posed_scans(log: str | Path, **options: Unpack[ReplayKeywords]) -> Iterator[tuple[Scan, Pose2D]]:
    """Iterate over the scans of a log with the laser's poses.

    A scan during which the laser moves is cut into pieces with a pose each; ``deskew=False`` leaves all whole.

    Args:
        log: A log of any format that :func:`prim.log.open_log` reads.
        **options: As for :func:`replay`; those of the mapper and the detector have no effect.

    Returns:
        Yields a scan or piece of one, and the laser's pose in the map frame, with its covariance where that is known.

    Raises:
        UsageError: A parameter is impossible, or two exclude each other.
        LogReadError: The log cannot be read, or has no poses; when the first scan is asked for.
    """
    with _errors():
        path = checked_path("log", log)
        chosen = replay_options(**checked_keywords(ReplayKeywords, options))
    return _posed_scans(path, chosen)


def _posed_scans(path: Path, options: ReplayOptions) -> Iterator[tuple[Scan, Pose2D]]:
    timer = StageTimer()
    with (
        _errors(),
        blames_log_for_size(path, options),
        prim.log.open_log(path, recover=options.recover) as source,
    ):
        scans = ScanLog(source, options.selection, options.scan_log)
        found = localize(scans, options, timer)
        for posed in pose_scans(found.scans, found.poses, options, timer):
            yield from posed.pieces


def open_log(log: str | Path, recover: bool = False) -> LogSource:
    """Open a log: its topics, messages, metadata and attachments, as :class:`prim.log.source.LogSource` has them.

    Args:
        log: A log of any format that :func:`prim.log.open_log` reads.
        recover: Read what is left of a damaged log.

    Returns:
        The log, to be used as a context manager.

    Raises:
        LogReadError: The log cannot be read.
    """
    with _errors():
        return prim.log.open_log(checked_path("log", log), recover)


def make_mapper(
    name: str,
    resolution: float = 0.01,
    bounds: Bounds | None = None,
    sensor_model: str = "eq4",
    noise_std: float | None = None,
) -> Mapper:
    """Make a mapper, to be fed scan by scan: ``update(scan, pose)``, then ``grid()`` at any time, ``finish()`` last.

    Args:
        name: «det», «prob» or «forward».
        resolution: Side of a cell (m).
        bounds: (x0, y0, x1, y1) (m) of the map; None: it grows with the scans.
        sensor_model: The inverse sensor model of «prob»: «eq4» or «gaussian».
        noise_std: Standard deviation of the range noise (m); ``forward`` estimates it where it is not given.

    Returns:
        The mapper.

    Raises:
        UsageError: The arguments do not fit together.
    """
    given = {"resolution": resolution, "bounds": bounds, "sensor_model": sensor_model, "noise_std": noise_std}
    with _errors():
        return mapping.mapper.make_mapper(name, **checked_keywords(ReplayKeywords, given))


def refine(
    primitives: Iterable[Primitive | FoundPrimitive],
    scans: Iterable[tuple[Scan, Pose2D]],
    grid: OccupancyGrid,
    noise_std: float | None = None,
    closed_world: bool = False,
) -> list[FoundPrimitive | None]:
    """Fit primitives to the rays of scans by maximum likelihood: guesses of any detector become estimates.

    Of guesses whose outlines overlap the first is fitted, and the others are None: give the best ones first.

    Args:
        primitives: The guesses, in the map frame.
        scans: The scans with the laser's poses, as :func:`posed_scans` yields them.
        grid: A map of these scans.
        noise_std: Standard deviation of the range noise (m); None to estimate it.
        closed_world: Whether every guess is taken to be one of the kinds, if anything.

    Returns:
        For each guess, in their order, the likeliest primitive with its standard deviations, its id the guess's
        number from 1 on; None where the rays contradict it, where what stands there is likeliest none of the kinds,
        or where it overlaps one before it.

    Raises:
        UsageError: An argument is of another kind, or the noise is not above 0.
    """
    from detect.refinement.options import DEFAULTS
    from detect.refinement.refine import Refinement, detection_of, rejection_reason
    from detect.refinement.surroundings.levels import MapLevels

    guesses, noise_std = _checked_guesses(primitives), _checked_noise(noise_std)
    if not isinstance(closed_world, bool):
        raise UsageError(f"closed_world is {closed_world!r}: it must be True or False")
    if not isinstance(grid, OccupancyGrid):
        raise UsageError(f"grid is {type(grid).__name__}: give a map, such as result.grid")
    fitted = [
        k for k, guess in enumerate(guesses) if not _overlaps(guess, guesses[:k], DEFAULTS.acceptance.max_shared)
    ]
    levels = MapLevels.of(grid, replace(DEFAULTS, closed_world=closed_world))
    refinement = Refinement(levels, noise_std, cores())
    fits = refinement.run([guesses[k] for k in fitted], _checked_pairs(scans))
    found: list[FoundPrimitive | None] = [None] * len(guesses)
    for k, fit in zip(fitted, fits, strict=True):
        if fit is not None and not rejection_reason(fit) and not fit.is_other:
            found[k] = FoundPrimitive.of(detection_of(fit), k + 1)
    return found


def _overlaps(guess: Primitive, others: Iterable[Primitive], limit: float) -> bool:
    return any(overlap_coefficient(guess, other) > limit for other in others)


def _checked_guesses(primitives: object) -> list[Primitive]:
    """Return primitives; raise UsageError where there is something else."""
    if not isinstance(primitives, Iterable):
        raise UsageError(f"primitives is {type(primitives).__name__}: give a list, such as result.primitives")
    guesses = [guess.primitive if isinstance(guess, FoundPrimitive) else guess for guess in primitives]
    for guess in guesses:
        if not isinstance(guess, Primitive):
            raise UsageError(f"primitives holds {type(guess).__name__}: give prim.Primitive or what a replay found")
    return guesses


def _checked_noise(noise_std: Any) -> float | None:
    """Return a standard deviation; raise UsageError where it is none."""
    if noise_std is None:
        return None
    if not isinstance(noise_std, Real | np.floating):
        raise UsageError(f"noise_std is {noise_std!r}: it must be a number above 0")
    with _errors():
        check_noise(float(noise_std))
    return float(noise_std)


def _checked_pairs(scans: Iterable[object]) -> Iterator[tuple[Scan, Pose2D]]:
    """Yield scans with their poses; raise UsageError where there is something else."""
    for pair in scans:
        scan, pose = pair if isinstance(pair, tuple) and len(pair) == 2 else (pair, None)
        if not isinstance(scan, Scan) or not isinstance(pose, Pose2D):
            raise UsageError("scans holds other things than pairs of a prim.Scan and a prim.Pose2D")
        yield scan, pose


def _errors() -> AbstractContextManager[None]:
    return errors_name_parameters({*PARAMETERS, "save"}, {*SWITCHES, "force"})


def _run(pipeline: Pipeline) -> tuple[ReplayResult, ...]:
    """Replay a log and close its recording."""
    results = pipeline.run_each()
    pipeline.viewer.finish(results)
    return results


def _pipeline(
    log: str | Path,
    save: str | Path | None,
    force: bool,
    progress: Callable[[int, int], None] | None,
    options: Mapping[str, Any],
) -> Pipeline:
    """Make the pipeline of a replay, its arguments checked. Raises UsageError."""
    path = checked_path("log", log)
    chosen = replay_options(**checked_keywords(ReplayKeywords, options, ("save", "force", "progress")))
    if progress is not None and not callable(progress):
        raise UsageError(f"progress is {progress!r}: give a function of two numbers")
    recording = None if save is None else checked_path("save", save)
    if recording:
        check_no_input([path, *([chosen.weights] if chosen.weights else [])], [recording])

    def after_scan(stage: str, done: int, total: int) -> None:
        """Tell the caller of the scans alone."""
        if progress is not None and stage == "scans":
            progress(done, total)

    return Pipeline(path, chosen, _viewer(recording, force), after_scan)


def _viewer(save: Path | None, force: bool) -> Viewer | None:
    """Make the viewer that saves a recording; None where none is wanted."""
    if save is None:
        return None
    from replay.viewer import RerunViewer

    return RerunViewer(ViewerOptions(save=save, force=force), announce=lambda line: None)


def _as_result(result: ReplayResult) -> Result:
    valid, poses = result.poses.valid, result.poses
    covariances = None if poses.covariances is None else poses.covariances[valid]
    stamps: Stamps = result.stamps[valid]
    notes = (*result.notes, *(f"detection skipped: {reason}" for reason in [result.detection_skipped] if reason))
    return Result(
        primitives=found_primitives(result.detections),
        objects=found_objects(result.detections),
        grid=result.grid,
        poses=LaserTrajectory(stamps, poses.poses[valid], covariances, poses.source, poses.matched),
        truth=result.detections.truth if result.detections else (),
        errors=result.detections.errors if result.detections else None,
        scores=result.scores,
        notes=tuple(name_parameters(note, {*PARAMETERS, "save"}, SWITCHES) for note in notes),
        report=report_json(result),
        _replayed=result,
    )
