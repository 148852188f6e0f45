"""Primitives in real logs: how many, whether half of the scans tell the same as the other, time, memory, pictures.

    python -m bench.real FOLDER [--mapper prob] [--resolution 0.05] [--match intel_raw.mcap …] [--only NAME …]
        [--pictures DIR] [--update docs/real.md]

Each log of a folder is replayed as ``prim-replay`` does, with all its scans and without detection, and by its even
and its odd scans alone. A primitive is confident where its score is 0.9 at least. It stands free where most cells
around it are; it agrees where the other half has one of its kind whose place and sizes are the same within 3 standard
deviations of the difference. A file NAME.labels.json beside a log, a list of primitives as reports have them, gives
the recall.
"""

from __future__ import annotations

import argparse
import math
import os
import subprocess
import sys
import tempfile
from collections.abc import Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, field, replace
from pathlib import Path

import cv2
import numpy as np
import shapely

from bench.maps import update
from detect.detection import Detection, Detections
from mapping.grid import OccupancyGrid
from prim import strict_json
from prim.arrays import FloatArray
from prim.errors import PrimError
from prim.metrics import FOUND_IOU, match_primitives
from prim.shapes import Primitive
from replay.api import posed_scans
from replay.options import ReplayOptions
from replay.pipeline import Pipeline
from replay.scans.selection import Selection

CONFIDENT = 0.9
FREE_SHARE = 0.65
DEVIATIONS = 3.0
RING_CELLS = 2.5

ROOT = Path(__file__).parents[1]

SIDE = 300
"""Pixels of a close-up's side."""

COLUMNS = 6
"""Close-ups in a row of a picture."""


@dataclass
class Found:
    """What a replay comes to.

    Attributes:
        detections: The primitives and objects.
        grid: The map.
        stamps: The stamps of the first two scans (ns).
    """

    detections: Detections
    grid: OccupancyGrid
    stamps: tuple[int, int] = (0, 0)

    @property
    def confident(self) -> list[Detection]:
        """The primitives whose score is high."""
        return [detection for detection in self.detections.found if detection.score >= CONFIDENT]


def replayed(log: Path, options: ReplayOptions) -> Found:
    """Replay a log in a process of its own."""
    with ProcessPoolExecutor(1) as pool:
        return pool.submit(_replay, log, options).result()


def _replay(log: Path, options: ReplayOptions) -> Found:
    result = Pipeline(log, options).run()
    detections = result.detections.detections if result.detections else Detections((), ())
    first, second = (int(stamp) for stamp in result.stamps[:2])
    return Found(detections, result.grid, (first, second))


@dataclass(frozen=True)
class Cost:
    """What the command takes as a user gives it, with a recording; kernels are compiled before.

    Attributes:
        cpu: Processor time (s).
        memory: The most memory (MB).
    """

    cpu: float
    memory: float

    @classmethod
    def of(cls, log: Path, options: ReplayOptions, *more: str) -> Cost:
        """Run prim-replay in a folder of its own."""
        given = ["--mapper", options.mapper, "--resolution", str(options.resolution), *more]
        given += ["--match-scans"] * options.match_scans
        with tempfile.TemporaryDirectory() as folder:
            command = [sys.executable, "-m", "replay", str(log.resolve()), "--quiet", *given]
            process = subprocess.Popen(command, cwd=folder, env=os.environ | {"PYTHONPATH": str(ROOT)})
            _, _, used = os.wait4(process.pid, 0)
        return cls(used.ru_utime + used.ru_stime, used.ru_maxrss / 1000)


def stands_free(detection: Detection, grid: OccupancyGrid) -> bool:
    """Return whether most cells around a primitive are free."""
    frame, outline = grid.frame, shapely.Polygon(detection.primitive.outline())
    ring = outline.buffer(RING_CELLS * frame.resolution).difference(outline.buffer(frame.resolution))
    low, high = np.array(ring.bounds[:2]), np.array(ring.bounds[2:])
    cols = np.arange(math.floor(low[0] / frame.resolution), math.ceil(high[0] / frame.resolution))
    rows = np.arange(math.floor(low[1] / frame.resolution), math.ceil(high[1] / frame.resolution))
    x, y = np.meshgrid((cols + 0.5) * frame.resolution, (rows + 0.5) * frame.resolution)
    within = shapely.contains_xy(ring, x, y)
    at_rows, at_cols = np.nonzero(within)
    at_rows, at_cols = rows[at_rows] - frame.row, cols[at_cols] - frame.col
    inside = (at_rows >= 0) & (at_rows < frame.rows) & (at_cols >= 0) & (at_cols < frame.cols)
    return bool(grid.free[at_rows[inside], at_cols[inside]].sum() >= FREE_SHARE * max(len(at_rows), 1))


def agree(one: Detection, other: Detection) -> bool:
    """Return whether two fits of independent rays are of one primitive: kind, place and sizes."""
    a, b = one.primitive, other.primitive
    if a.kind is not b.kind or one.std is None or other.std is None:
        return False
    differences = {"x": a.x - b.x, "y": a.y - b.y} | {name: a.sizes[name] - b.sizes[name] for name in a.sizes}
    return all(
        abs(difference) <= DEVIATIONS * math.hypot(one.std[name], other.std[name])
        for name, difference in differences.items()
    )


def agreeing(confident: Sequence[Detection], others: Sequence[Detection]) -> int:
    """Count the primitives of one half that the other has too."""
    return sum(any(agree(detection, other) for other in others) for detection in confident)


@dataclass
class Row:
    """A log's row of the table.

    Attributes:
        log: Its name.
        whole: By all scans.
        cost: What that takes.
        plain: What it takes without detection.
        confident: Confident primitives of either half.
        alike: How many of these the other half has.
        labels: How many labels there are; None where the log has none.
        recalled: How many of these were found.
    """

    log: str
    whole: Found
    cost: Cost
    plain: Cost
    confident: int
    alike: int
    labels: int | None = None
    recalled: int = 0
    free: int = field(init=False)

    def __post_init__(self) -> None:
        self.free = sum(stands_free(detection, self.whole.grid) for detection in self.whole.confident)

    def cells(self) -> list[str]:
        """Return the cells of the row."""
        confident = len(self.whole.confident)
        recall = "" if self.labels is None else f"{self.recalled} of {self.labels}"
        return [
            self.log, str(len(self.whole.detections.found)), str(len(self.whole.detections.objects)), str(confident),
            f"{self.free} of {confident}", f"{self.alike} of {self.confident}", recall,
            f"{self.cost.cpu:.1f}", f"{self.cost.cpu / self.plain.cpu:.1f}", f"{self.cost.memory:.0f}",
        ]  # fmt: skip


HEADING = (
    "log", "primitives", "objects", "score ≥ 0.9", "of these free-standing", "≥ 0.9 by a half: the other agrees",
    "labels found", "CPU with a recording, s", "× without detection", "memory, MB",
)  # fmt: skip


def measured(log: Path, options: ReplayOptions) -> Row:
    """Replay a log whole, without detection, and by halves."""
    whole = replayed(log, options)
    cost, plain = Cost.of(log, options), Cost.of(log, options, "--no-detect")
    apart = (whole.stamps[1] - whole.stamps[0]) / 1e9
    halves = [
        replayed(log, replace(options, selection=selection))
        for selection in (Selection(stride=2), Selection(start=apart / 2, stride=2))
    ]
    confident = sum(len(half.confident) for half in halves)
    alike = sum(agreeing(a.confident, b.detections.found) for a, b in (halves, halves[::-1]))
    row = Row(log.name, whole, cost, plain, confident, alike)
    beside = log.with_name(f"{log.name.split('.')[0]}.labels.json")
    if beside.exists():
        labels = [Primitive.from_json(value) for value in strict_json.loads(beside.read_bytes())]
        found = [detection.primitive for detection in whole.detections.found]
        row.labels = len(labels)
        row.recalled = sum(pair.same_kind and pair.iou >= FOUND_IOU for pair in match_primitives(found, labels))
    return row


def end_points(log: Path, options: ReplayOptions) -> FloatArray:
    """Return where the rays of a log end (N, 2) in m."""
    parts = []
    for scan, pose in posed_scans(log, pose=options.pose, match_scans=options.match_scans):
        ranges = scan.ranges[scan.measured].astype(float)
        angles = pose.theta + scan.angle_min + scan.angle_increment * np.flatnonzero(scan.measured)
        parts.append(np.column_stack((pose.x + ranges * np.cos(angles), pose.y + ranges * np.sin(angles))))
    return np.concatenate(parts)


def close_ups(found: Found, points: FloatArray) -> Iterator[np.ndarray]:
    """Draw each primitive and object with the map and the rays' end points around it."""
    for detection in found.detections.found:
        sizes = " ".join(f"{value:.2f}" for value in detection.primitive.size)
        text = f"{detection.primitive.kind} {sizes}: {detection.score:.2f}"
        yield close_up(found.grid, points, detection.primitive.outline(), text, (0, 130, 0))
    for thing in found.detections.objects:
        yield close_up(found.grid, points, thing.outline, f"object: {thing.score:.2f}", (110, 110, 110))


def close_up(
    grid: OccupancyGrid, points: FloatArray, outline: FloatArray, text: str, color: tuple[int, int, int]
) -> np.ndarray:
    """Draw an outline with the map and the rays' end points around it (SIDE, SIDE, 3)."""
    centre = (outline.min(axis=0) + outline.max(axis=0)) / 2
    width = max(2.0 * float(np.ptp(outline, axis=0).max()), 1.5)
    scale, corner, frame = SIDE / width, centre - width / 2, grid.frame
    steps = (np.arange(SIDE) + 0.5) / scale
    cols = np.floor((corner[0] + steps) / frame.resolution).astype(int) - frame.col
    rows = np.floor((corner[1] + steps) / frame.resolution).astype(int) - frame.row
    inside = ((rows >= 0) & (rows < frame.rows))[:, None] & ((cols >= 0) & (cols < frame.cols))
    known = grid.probability[np.clip(rows, 0, frame.rows - 1)[:, None], np.clip(cols, 0, frame.cols - 1)]
    grey = 255 - 130 * np.where(inside, known, np.float32(0.5))
    image = np.repeat(grey.astype(np.uint8)[..., None], 3, axis=2)

    def pixels(places: FloatArray) -> np.ndarray:
        return np.rint((places - corner) * scale).astype(np.int32)

    near = points[(np.abs(points - centre) < width / 2).all(axis=1)]
    at = np.clip(pixels(near), 0, SIDE - 1)
    image[at[:, 1], at[:, 0]] = (40, 40, 200)
    cv2.polylines(image, [pixels(outline)], True, color, 2)
    image = np.ascontiguousarray(image[::-1])
    place = f"({centre[0]:.1f}, {centre[1]:.1f}) m, {width:.1f} m wide"
    for line, row in ((text, 14), (place, SIDE - 6)):
        cv2.putText(image, line, (4, row), cv2.FONT_HERSHEY_SIMPLEX, 0.42, (0, 0, 0), 1, cv2.LINE_AA)
    return image


def write_picture(path: Path, images: Sequence[np.ndarray]) -> None:
    """Write close-ups side by side."""
    if not images:
        return
    rows = -(-len(images) // COLUMNS)
    canvas = np.full((rows * (SIDE + 4), COLUMNS * (SIDE + 4), 3), 255, np.uint8)
    for number, image in enumerate(images):
        row, col = divmod(number, COLUMNS)
        canvas[row * (SIDE + 4) :][:SIDE, col * (SIDE + 4) :][:, :SIDE] = image
    path.parent.mkdir(parents=True, exist_ok=True)
    cv2.imwrite(str(path), canvas)


def table(rows: Sequence[Row]) -> str:
    """Return the table of all logs."""
    lines = [HEADING, ["---", *(len(HEADING) - 1) * ["---:"]], *(row.cells() for row in rows)]
    return "\n".join("| " + " | ".join(line) + " |" for line in lines)


def main() -> None:
    """Parse the options, measure, print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--mapper", default="prob")
    parser.add_argument("--resolution", type=float, default=0.05)
    parser.add_argument("--match", nargs="*", default=[], help="logs whose scans are matched")
    parser.add_argument("--only", nargs="*", help="these logs alone")
    parser.add_argument("--pictures", type=Path, help="a folder for close-ups")
    parser.add_argument("--update", type=Path, help="a document whose table is replaced")
    options = parser.parse_args()
    rows = []
    for log in sorted(path for path in options.folder.iterdir() if path.name.endswith((".mcap", ".bag", ".log.gz"))):
        if options.only and log.name not in options.only:
            continue
        chosen = ReplayOptions(
            mapper=options.mapper, resolution=options.resolution, match_scans=log.name in options.match
        )
        try:
            row = measured(log, chosen)
        except PrimError as error:
            print(f"{log.name}: {error}")
            continue
        rows.append(row)
        print("| " + " | ".join(row.cells()) + " |", flush=True)
        if options.pictures:
            images = list(close_ups(row.whole, end_points(log, chosen)))
            write_picture(options.pictures / f"{log.name.split('.')[0]}.png", images)
    print(table(rows))
    if options.update:
        update(options.update, "real", table(rows))


if __name__ == "__main__":
    main()
