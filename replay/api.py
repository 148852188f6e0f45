"""The functions that `import prim` offers for replays: a result in Python from one call."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from contextlib import AbstractContextManager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Unpack

import numpy as np
from numpy.typing import NDArray

from mapping.grid import OccupancyGrid
from mapping.map_metrics import MapScores
from prim.arrays import FloatArray, Stamps
from prim.errors import OutputError
from prim.log import open_log
from prim.metrics import DetectionErrors
from prim.parameters import errors_name_parameters, name_parameters
from prim.scan import Scan
from prim.se2 import Pose2D
from prim.shapes import Primitive
from prim.threads import cores
from replay.exports import log_stem, write_map, write_report, write_trajectory
from replay.found_primitives import FoundPrimitive, by_name, found_primitives
from replay.keywords import PARAMETERS, SWITCHES, ReplayKeywords, replay_options
from replay.localization import localize, pose_scans
from replay.pipeline import Pipeline
from replay.posed_scans import ScanLog
from replay.report import report_json
from replay.result import ReplayResult
from replay.timing import StageTimer
from replay.viewing.protocol import Viewer, ViewerOptions

if TYPE_CHECKING:
    import pyarrow as pa

    from replay.picture import Picture


@dataclass(frozen=True)
class LaserTrajectory:
    """The laser's poses at the scans of a replay that have one.

    Attributes:
        stamps: Their stamps (N,) in ns.
        poses: (N, 3) x, y (m), heading (rad) in the map frame.
        covariances: The poses' covariances (N, 3, 3; m, rad); None where they are not known.
        source: Where the poses come from: «truth», «tf», «odom», «fused» or «still».
        matched: Whether they were corrected by scan matching.
    """

    stamps: NDArray[np.int64]
    poses: FloatArray
    covariances: FloatArray | None
    source: str
    matched: bool


@dataclass(frozen=True)
class Result:
    """What a replay of a log found out by one mapper.

    Attributes:
        primitives: The primitives in the map, highest score first.
        grid: The map: ``grid.probability`` (rows, cols), 0.5 where unknown, row 0 at the smallest y; ``grid.frame``
            says where it lies.
        poses: Where the laser was.
        errors: How the primitives compare with the truth (``f1``, ``position`` in m …); None where the log has none.
        scores: How the map compares with the truth; None where the log has none.
        notes: What a user should know.
        report: The report, as ``prim-replay`` writes it (schema ``prim-replay/1``).
    """

    primitives: tuple[FoundPrimitive, ...]
    grid: OccupancyGrid
    poses: LaserTrajectory
    errors: DetectionErrors | None
    scores: MapScores | None
    notes: tuple[str, ...]
    report: dict[str, Any]
    _replayed: ReplayResult

    def table(self) -> pa.Table:
        """Return the primitives as a table, a row for each; see :func:`replay.tables.primitives_table`."""
        from replay.tables import primitives_table

        return primitives_table(self.primitives)

    def plot(self) -> Picture:
        """Draw the map, the primitives, and in grey the true ones, where they are known."""
        from replay.picture import draw_picture

        detections = self._replayed.detections
        return draw_picture(self.grid, self.primitives, detections.truth if detections else ())

    def save(self, directory: str | Path) -> list[Path]:
        """Write the report, the map for nav2, the poses in TUM's format and the picture into a folder.

        Args:
            directory: The folder; it is made where there is none.

        Returns:
            The files: LOG.MAPPER.report.json, .pgm, .yaml, .tum and .png.

        Raises:
            OutputError: A file cannot be written.
        """
        folder = Path(directory)
        try:
            folder.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise OutputError(folder, error) from error
        result = self._replayed
        name = f"{log_stem(result.path)}.{result.options.mapper}"
        files = [folder / f"{name}{suffix}" for suffix in (".report.json", ".pgm", ".yaml", ".tum", ".png")]
        write_report(files[0], result)
        write_map(files[1], result.grid)
        write_trajectory(files[3], result)
        self.plot().save(files[4])
        return files


def replay(log: str | Path, *, save: str | Path | None = None, **options: Unpack[ReplayKeywords]) -> Result:
    """Replay a log through a mapper and the detector.

    Args:
        log: An MCAP log, or the folder of a ROS 2 bag.
        save: Where rerun's recording is saved; None for no recording.
        **options: The options of ``prim-replay``, see :class:`replay.keywords.ReplayKeywords`; angles are radians.

    Returns:
        The map, the primitives, the poses, and their errors where the log has ground truth.

    Raises:
        UsageError: A parameter is impossible, or two exclude each other.
        LogReadError: The log cannot be read, or lacks what the replay needs.
        OutputError: The recording cannot be written.
    """
    with _errors():
        return _as_result(Pipeline(Path(log), replay_options(**options), _viewer(save)).run())


def replay_each(
    log: str | Path, *, save: str | Path | None = None, **options: Unpack[ReplayKeywords]
) -> dict[str, Result]:
    """Replay a log through several mappers side by side: ``mapper="det,prob,forward"``.

    Args:
        log: An MCAP log, or the folder of a ROS 2 bag.
        save: Where rerun's recording of all of them is saved; None for no recording.
        **options: As for :func:`replay`.

    Returns:
        The result of each mapper by its name.

    Raises:
        UsageError: A parameter is impossible, or two exclude each other.
        LogReadError: The log cannot be read, or lacks what the replay needs.
        OutputError: The recording cannot be written.
    """
    with _errors():
        results = Pipeline(Path(log), replay_options(**options), _viewer(save)).run_each()
        return {result.options.mapper: _as_result(result) for result in results}


def posed_scans(log: str | Path, **options: Unpack[ReplayKeywords]) -> Iterator[tuple[Scan, Pose2D]]:
    """Iterate over the scans of a log with the laser's poses.

    A scan during which the laser moves is cut into pieces with a pose each; ``deskew=False`` leaves all whole.

    Args:
        log: An MCAP log, or the folder of a ROS 2 bag.
        **options: As for :func:`replay`; those of the mapper and the detector have no effect.

    Yields:
        A scan or piece of one, and the laser's pose in the map frame, with its covariance where that is known.

    Raises:
        UsageError: A parameter is impossible, or two exclude each other.
        LogReadError: The log cannot be read, or has no poses.
    """
    with _errors():
        chosen, timer = replay_options(**options), StageTimer()
        with open_log(log, recover=chosen.recover) as source:
            scans = ScanLog(source, chosen.scan_topic, chosen.selection)
            poses = localize(source, scans, chosen, timer).poses
            for posed in pose_scans(scans, poses, chosen, timer):
                yield from posed.pieces


def refine(
    primitives: Iterable[Primitive | FoundPrimitive],
    scans: Iterable[tuple[Scan, Pose2D]],
    grid: OccupancyGrid,
    noise_std: float | None = None,
) -> list[FoundPrimitive | None]:
    """Fit primitives to the rays of scans by maximum likelihood: guesses of any detector become estimates.

    Args:
        primitives: The guesses, in the map frame.
        scans: The scans with the laser's poses, as :func:`posed_scans` yields them.
        grid: A map of these scans.
        noise_std: Standard deviation of the range noise (m); None to estimate it.

    Returns:
        For each guess, in their order, the likeliest primitive with its standard deviations, its id the guess's
        number from 1 on; None where the rays contradict it.
    """
    from detect.refinement.map_cells import MapCells
    from detect.refinement.options import DEFAULTS
    from detect.refinement.refine import Refinement, rejection_reason

    guesses = [guess.primitive if isinstance(guess, FoundPrimitive) else guess for guess in primitives]
    cells = MapCells.of(grid, DEFAULTS.map, DEFAULTS.lines)
    fits = Refinement(cells, noise_std, cores()).run(guesses, scans)
    return [
        None
        if fit is None or rejection_reason(fit)
        else FoundPrimitive(
            id=number,
            kind=fit.primitive.kind,
            x=fit.primitive.x,
            y=fit.primitive.y,
            theta=fit.primitive.theta,
            size=fit.primitive.sizes,
            score=fit.score,
            stage="refined",
            std=fit.std,
            chances=by_name(fit.kind_probabilities),
        )
        for number, fit in enumerate(fits, 1)
    ]


def _errors() -> AbstractContextManager[None]:
    return errors_name_parameters({*PARAMETERS, "save"}, SWITCHES)


def _viewer(save: str | Path | None) -> Viewer | None:
    """Make the viewer that saves a recording; None where none is wanted."""
    if save is None:
        return None
    from replay.viewer import RerunViewer

    return RerunViewer(ViewerOptions(save=Path(save)), announce=lambda line: None)


def _as_result(result: ReplayResult) -> Result:
    valid, poses = result.poses.valid, result.poses
    covariances = None if poses.covariances is None else poses.covariances[valid]
    stamps: Stamps = result.stamps[valid]
    notes = (*result.notes, *(f"detection skipped: {reason}" for reason in [result.detection_skipped] if reason))
    return Result(
        primitives=found_primitives(result.detections),
        grid=result.grid,
        poses=LaserTrajectory(stamps, poses.poses[valid], covariances, poses.source, poses.matched),
        errors=result.detections.errors if result.detections else None,
        scores=result.scores,
        notes=tuple(name_parameters(note, {*PARAMETERS, "save"}, SWITCHES) for note in notes),
        report=report_json(result),
        _replayed=result,
    )
