"""The result of a replay as files: the report, the map, the trajectory."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np

from mapping.grid import OccupancyGrid
from prim import strict_json
from prim.files import ResultFormat, write_file, write_files
from replay.outputs.report import report_json
from replay.result import ReplayResult

APPLICATION = "prim"
"""What recordings are called in rerun: the name stands in their first record, in plain text."""

RECORDING = ResultFormat(
    "a recording of prim", re.compile(rb"RRF2.{0,200}\x1a\x06\x0a\x04" + APPLICATION.encode(), re.DOTALL)
)
REPORT = ResultFormat("a report of prim-replay", re.compile(rb'\s*{\s*"schema": "prim-replay/'))
MAP_IMAGE = ResultFormat("a map of prim-replay", re.compile(rb"P5\n\d+  \d+\n255\n"))
"""Other programs write one blank between the sides of the image; a comment would trip simple readers."""
MAP_DESCRIPTION = ResultFormat(
    "a map of prim-replay",
    re.compile(
        rb"image: [^\n]*\nmode: trinary\nresolution: [^\n]*\norigin: [^\n]*\nnegate: 0\n"
        rb"occupied_thresh: 0\.65\nfree_thresh: 0\.196\n\Z"
    ),
)
TRAJECTORY = ResultFormat(
    "a trajectory of prim-replay", re.compile(rb"\d+\.\d{9}( -?\d+\.\d{9}){2} 0 0 0( -?\d\.\d{9}){2}\n")
)

_LOG_SUFFIX = re.compile(r"(\.mcap)?(\.[0-9a-f]{8})?\.part$|\.(mcap|db3|bag|log)(\.(zst|zstd|gz))?$")
"""The suffix of a log, compressed or not, or of one that its recorder was killed at."""

FREE_THRESHOLD, OCCUPIED_THRESHOLD = 0.196, 0.65
OCCUPIED_VALUE, UNKNOWN_VALUE, FREE_VALUE = 0, 205, 254
"""nav2's map_server takes cells whose 1 - value / 255 is below the first threshold for free, and above the second for
occupied; 205 is 0.19608, between them.
"""


def write_map(stem: Path, grid: OccupancyGrid, force: bool = False) -> None:
    """Write a map as nav2's map_server reads it: an image in PGM, and its description in YAML.

    The image's first row is at the map's largest y. Occupied cells are black, free ones white, and unknown ones have
    the value that map_server's mode «trinary» reads back as unknown.

    Args:
        stem: The path of both files, with or without either's suffix.
        grid: The map.
        force: Whether files in their places may be replaced that are no earlier maps of prim-replay.

    Raises:
        OutputError: A file cannot be written.
        UsageError: There is another file in its place.
    """
    image = np.full(grid.frame.shape, UNKNOWN_VALUE, dtype=np.uint8)
    image[grid.free] = FREE_VALUE
    image[grid.occupied] = OCCUPIED_VALUE
    frame = grid.frame
    rows, cols = frame.shape
    pgm, yaml = map_files(stem)
    x, y = frame.origin
    name = pgm.name if re.fullmatch(r"[\w.-]+", pgm.name) else strict_json.dumps(pgm.name)  # quoted as YAML has it
    description = (
        f"image: {name}\nmode: trinary\n"
        f"resolution: {frame.resolution:g}\norigin: [{x:.9g}, {y:.9g}, 0]\nnegate: 0\n"
        f"occupied_thresh: {OCCUPIED_THRESHOLD}\nfree_thresh: {FREE_THRESHOLD}\n"
    )
    pixels = f"P5\n{cols}  {rows}\n255\n".encode() + np.flipud(image).tobytes()
    write_files([(pgm, pixels, MAP_IMAGE), (yaml, description.encode(), MAP_DESCRIPTION)], force)


def write_trajectory(path: Path, result: ReplayResult, force: bool = False) -> None:
    """Write the poses of the laser, of several of the first, in TUM's format (stamp x y z qx qy qz qw; s, m).

    Args:
        path: The file.
        result: The replay whose poses are written.
        force: Whether a file in its place may be replaced that is no earlier trajectory of prim-replay.

    Raises:
        OutputError: The file cannot be written.
        UsageError: There is another file in its place.
    """
    lines = []
    written = result.poses.valid & (result.scanner == 0)
    for stamp, pose, is_written in zip(result.stamps.tolist(), result.poses.poses, written, strict=True):
        if is_written:
            x, y, half = pose[0], pose[1], pose[2] / 2
            seconds = f"{stamp // 10**9}.{stamp % 10**9:09d}"
            lines.append(f"{seconds} {x:.9f} {y:.9f} 0 0 0 {np.sin(half):.9f} {np.cos(half):.9f}\n")
    write_file(path, "".join(lines).encode(), TRAJECTORY, force)


def log_stem(path: Path) -> str:
    """Return the name that a log's outputs begin with: its own without its suffix."""
    return _LOG_SUFFIX.sub("", path.resolve().name)


def map_files(stem: Path) -> tuple[Path, Path]:
    """Return the paths of a map's image and its description; ``stem`` may have either's suffix."""
    name = map_stem(stem)
    return stem.with_name(f"{name}.pgm"), stem.with_name(f"{name}.yaml")


def map_stem(path: Path) -> str:
    """Return the name of a map's files without their suffixes."""
    return path.name.removesuffix(".yaml").removesuffix(".pgm")


def write_report(path: Path, result: ReplayResult, force: bool = False) -> None:
    """Write the report as JSON.

    Args:
        path: The file.
        result: The replay to report on.
        force: Whether a file in its place may be replaced that is no earlier report.

    Raises:
        OutputError: The file cannot be written.
        UsageError: There is another file in its place.
    """
    write_file(path, (strict_json.dumps(report_json(result), indent=2) + "\n").encode(), REPORT, force)
