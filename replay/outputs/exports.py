"""The result of a replay as files: the report, the map, the trajectory."""

from __future__ import annotations

import errno
import os
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

import numpy as np

from mapping.grid import OccupancyGrid
from prim import strict_json
from prim.errors import OutputError, UsageError
from replay.outputs.report import report_json
from replay.result import ReplayResult

FREE_THRESHOLD, OCCUPIED_THRESHOLD = 0.196, 0.65
OCCUPIED_VALUE, UNKNOWN_VALUE, FREE_VALUE = 0, 205, 254
"""nav2's map_server takes cells whose 1 - value / 255 is below the first threshold for free, and above the second for
occupied; 205 is 0.19608, between them.
"""


def check_writable(path: Path) -> None:
    """Raise OutputError where a file cannot be written, before the work that would be lost."""
    with _writing(path):
        if path.is_dir():
            raise IsADirectoryError(errno.EISDIR, os.strerror(errno.EISDIR))
        if not path.parent.is_dir():
            raise FileNotFoundError(errno.ENOENT, os.strerror(errno.ENOENT))
        if not os.access(path if path.exists() else path.parent, os.W_OK):
            raise PermissionError(errno.EACCES, os.strerror(errno.EACCES))


def check_distinct(logs: Sequence[Path], outputs: Sequence[Path]) -> None:
    """Check that no file would be written twice, or over a log.

    Args:
        logs: The logs.
        outputs: The files that would be written.

    Raises:
        UsageError: One would, or a log is named twice.
    """
    files = [path.resolve() for path in outputs]
    inputs = {log.resolve() for log in logs}
    if len(inputs) < len(logs):
        raise UsageError("a log is named twice")
    for path in files:
        if path in inputs:
            raise UsageError(f"{path} is a log: it cannot be an output as well")
        if files.count(path) > 1:
            raise UsageError(f"{path} would be written twice: name the outputs, or replay the logs one by one")


def write_map(stem: Path, grid: OccupancyGrid) -> None:
    """Write a map as nav2's map_server reads it: an image in PGM, and its description in YAML.

    The image's first row is at the map's largest y. Occupied cells are black, free ones white, and unknown ones have
    the value that map_server's mode «trinary» reads back as unknown.

    Args:
        stem: The path of both files, with or without either's suffix.
        grid: The map.

    Raises:
        OutputError: A file cannot be written.
    """
    image = np.full(grid.frame.shape, UNKNOWN_VALUE, dtype=np.uint8)
    image[grid.free] = FREE_VALUE
    image[grid.occupied] = OCCUPIED_VALUE
    rows, cols = grid.frame.shape
    pgm, yaml = map_files(stem)
    x, y = grid.frame.origin
    with _writing(pgm):
        pgm.write_bytes(f"P5\n{cols} {rows}\n255\n".encode() + np.flipud(image).tobytes())
    with _writing(yaml):
        yaml.write_text(
            f"image: {pgm.name}\nmode: trinary\nresolution: {grid.frame.resolution:g}\n"
            f"origin: [{x:.9g}, {y:.9g}, 0]\nnegate: 0\n"
            f"occupied_thresh: {OCCUPIED_THRESHOLD}\nfree_thresh: {FREE_THRESHOLD}\n",
            encoding="utf-8",
        )


def write_trajectory(path: Path, result: ReplayResult) -> None:
    """Write the laser's poses in TUM's format (stamp x y z qx qy qz qw; s, m).

    Args:
        path: The file.
        result: The replay whose poses are written.

    Raises:
        OutputError: The file cannot be written.
    """
    lines = []
    for stamp, pose, valid in zip(result.stamps.tolist(), result.poses.poses, result.poses.valid, strict=True):
        if valid:
            x, y, half = pose[0], pose[1], pose[2] / 2
            seconds = f"{stamp // 10**9}.{stamp % 10**9:09d}"
            lines.append(f"{seconds} {x:.9f} {y:.9f} 0 0 0 {np.sin(half):.9f} {np.cos(half):.9f}\n")
    with _writing(path):
        path.write_text("".join(lines), encoding="utf-8")


def log_stem(path: Path) -> str:
    """Return the name that a log's outputs begin with: its own without its suffix."""
    return path.resolve().name.removesuffix(".part").removesuffix(".mcap")


def map_files(stem: Path) -> tuple[Path, Path]:
    """Return the paths of a map's image and its description; ``stem`` may have either's suffix."""
    name = map_stem(stem)
    return stem.with_name(f"{name}.pgm"), stem.with_name(f"{name}.yaml")


def map_stem(path: Path) -> str:
    """Return the name of a map's files without their suffixes."""
    return path.name.removesuffix(".yaml").removesuffix(".pgm")


@contextmanager
def _writing(path: Path) -> Iterator[None]:
    try:
        yield
    except OSError as error:
        raise OutputError(path, error) from error


def write_report(path: Path, result: ReplayResult) -> None:
    """Write the report as JSON.

    Args:
        path: The file.
        result: The replay to report on.

    Raises:
        OutputError: The file cannot be written.
    """
    with _writing(path):
        path.write_text(strict_json.dumps(report_json(result), indent=2) + "\n", encoding="utf-8")
