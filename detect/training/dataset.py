"""Training data: recorded sessions, mapped by every mapper from the same rays, as images with exact primitives.

A data set is a folder:

    manifest.json                 the options, which make the same data set again
    truth/train/000012_0.json     one tile: its frame, its primitives, how it was recorded
    images/prob/train/000012_0.png    the tile of each mapper's map (tiles.tile_image, row 0 at the smallest y)
    labels/prob/train/000012_0.txt    the outlines in the tile, as YOLO's labels
    prob.yaml                     data description for ultralytics
    done/train/000012             marks a session all of whose tiles are written

Everything follows from the session's seed: sessions are made in parallel, finished ones are skipped, so that an
interrupted run can be continued. In ``detect`` only training and evaluation use ``recorder``.
"""

from __future__ import annotations

import math
import re
import shlex
import tempfile
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import as_completed
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from detect.networks.tiles import TILE_SIZE, Box, tile_frames, tile_image
from detect.networks.weights import KIND_NAMES
from detect.networks.yolo import KINDS
from mapping.grid import GridFrame, OccupancyGrid
from mapping.mapper import MAPPERS, check_cells, make_mapper
from prim import strict_json
from prim.errors import OutputError, UsageError
from prim.files import ResultFormat, output_errors, write_file
from prim.log import open_log
from prim.log.decoding.values import planar_pose
from prim.log.messages import SCAN_TOPIC, TRUE_POSE_TOPIC
from prim.processes import process_pool
from prim.scan import Scan
from prim.se2 import Pose2D, Trajectory
from prim.shapes import Kind, Primitive
from prim.world import Bounds, World
from recorder.faults import NO_FAULTS, ScannerFaults
from recorder.keywords import BOX_ROOM, LARGEST
from recorder.sensors import Lidar
from recorder.session import SessionOptions, record_session
from recorder.world import WorldOptions

MAP_MARGIN = 0.1
"""Margin (m) of a map around the floor."""

MIN_INSIDE_SHARE = 0.6
"""A primitive belongs to a tile that holds at least this share of its outline; set by hand."""

SPLITS = ("train", "val")

OF_THE_SET = ResultFormat("a file of prim-train dataset", re.compile(b""))
"""What lies in the folder of a data set is its own: its manifest is checked first."""

Progress = Callable[[int, int], None]
"""Called with what is done and what there is in all."""


@dataclass(frozen=True)
class DatasetOptions:
    """Contents of a data set; the fields are the keys of its manifest.

    Attributes:
        sizes: Sessions of each of SPLITS.
        seed: Seed of the first session; the others' follow.
        noise_stds: Standard deviations of the range noise (m); each session draws one.
        mappers: Names of the mappers that map each session.
        kinds: Names of the kinds that sessions hold.
        rays: Rays of a scan; each session draws one.
        stops: Stops along each axis of a warped session on a floor of 2 m, more on larger ones; each draws one.
        floors: Sides (m) of the square floor; each session draws one.
        motions: ``warp`` or ``drive``; each session draws one.
        walled: Share of the sessions with walls.
        resolution: Side of a cell (m) as the networks know it.
        cells: Sides of the cells (m) that sessions are mapped with; each draws one, and is written as if it had those
            of ``resolution``: networks see shapes in cells. Empty: ``resolution``.
        scales: Floor, primitives, clutter, cells and the scanner's reach are so many times as large; each session
            draws one.
        extents: The smallest and the largest extent of primitives and clutter (m) at a scale of 1; None: the paper's.
        fovs: Fields of view (rad); each session draws one.
        range_maxes: The scanner's longest ranges (m) at a scale of 1; each session draws one.
        clutter: Fewest and most things that are none of the kinds.
        rooms: What rooms are or have, names of recorder.rooms separated by commas, or «box»; each walled session
            draws one.
        faulty: Share of the sessions whose scanner has faults.
        worlds: Files of worlds in place of drawn ones; each session draws one.
        rounded: Mappers whose images are in the style ``rounded`` (networks.tiles.STYLES).

    Raises:
        UsageError: The options are impossible.
    """

    sizes: tuple[int, int] = (500, 125)
    seed: int = 100_000
    noise_stds: tuple[float, ...] = (0.0,)
    mappers: tuple[str, ...] = MAPPERS
    kinds: tuple[str, ...] = KIND_NAMES
    rays: tuple[int, ...] = (500,)
    stops: tuple[int, ...] = (10,)
    floors: tuple[float, ...] = (2.0,)
    motions: tuple[str, ...] = ("warp",)
    walled: float = 1.0
    resolution: float = 0.01
    rounded: tuple[str, ...] = ()
    cells: tuple[float, ...] = ()
    scales: tuple[float, ...] = (1.0,)
    extents: tuple[float, float] | None = None
    fovs: tuple[float, ...] = (Lidar.fov,)
    range_maxes: tuple[float, ...] = (Lidar.range_max,)
    clutter: tuple[int, int] = (0, 0)
    rooms: tuple[str, ...] = (BOX_ROOM,)
    faulty: float = 0.0
    worlds: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        lists = ("noise_stds", "mappers", "kinds", "rays", "stops", "floors", "motions", "scales", "fovs", "rooms")
        for name in (*lists, "range_maxes"):
            if not getattr(self, name):
                raise UsageError(f"a set needs at least one of {name}")
        unknown = [mapper for mapper in self.mappers if mapper not in MAPPERS]
        if unknown:
            raise UsageError(f"there is no mapper {unknown[0]!r}: choose from {', '.join(MAPPERS)}")
        if min(self.sizes) < 0 or not sum(self.sizes):
            raise UsageError("a set needs at least one session")
        if self.seed < 0:
            raise UsageError(f"--seed is {self.seed}: it must not be below 0")
        if not all(0 <= std <= LARGEST["noise_std"] for std in self.noise_stds):
            stds = ", ".join(f"{std:g}" for std in self.noise_stds)
            raise UsageError(f"--noise-std is {stds}: it must be from 0 to {LARGEST['noise_std']:g} m")
        for share in ("walled", "faulty"):
            if not 0 <= getattr(self, share) <= 1:
                raise UsageError(f"{share} is {getattr(self, share):g}: it is a share, from 0 to 1")
        for cell in self.cells:
            check_cells(cell, None)


DATASET_PRESETS = {
    "paper": DatasetOptions(rounded=("det", "prob")),
    "mixed": DatasetOptions(
        sizes=(600, 60),
        seed=200_000,
        noise_stds=(0.0, 0.02, 0.05, 0.075, 0.1, 0.25, 0.375, 0.5),
        rays=(180, 360, 500, 1000),
        stops=(6, 8, 10),
        floors=(2.0, 2.0, 2.0, 3.0),
        motions=("warp", "warp", "drive"),
        walled=0.7,
    ),
}
DATASET_PRESETS["large"] = replace(DATASET_PRESETS["mixed"], sizes=(2400, 60), seed=210_000)
DATASET_PRESETS["open"] = replace(
    DATASET_PRESETS["mixed"],
    sizes=(800, 60),
    seed=220_000,
    noise_stds=(0.0, 0.01, 0.02, 0.03, 0.05, 0.075, 0.1, 0.25, 0.375, 0.5),
    rays=(180, 360, 500, 1000),
    floors=(2.0, 3.0, 3.0),
    scales=(1.0, 1.0, 2.0, 5.0),
    extents=(0.05, 0.5),
    fovs=(Lidar.fov, Lidar.fov, 1.5 * math.pi, math.pi),
    clutter=(0, 4),
    rooms=("box", "box", "doorways", "pilasters", "furniture", "round", "corridor", "L"),
    faulty=0.3,
)
"""The paper's data sets (III-B, IV-B: 500 and 125 maps, one noise level each, rounded); the one that the shipped
networks were first trained on; the larger one that their training was continued on; and one of real places: clutter,
rooms, faulty scanners, things of any size in cells that go with them."""

FAULTS = (
    ScannerFaults(range_bias=0.02),
    ScannerFaults(beam_width=math.radians(0.5)),
    ScannerFaults(beam_width=math.radians(1.0), quantum=0.01),
    ScannerFaults(dropouts=0.1, dropout_as="nan"),
    ScannerFaults(dropouts=0.1, outliers=0.01),
    ScannerFaults(noise_growth=0.01, quantum=0.001),
)
"""Of which a session with a faulty scanner draws one."""


def session_seeds(options: DatasetOptions) -> Iterator[tuple[str, int]]:
    """Yield split and seed of every session."""
    first = 0
    for split, size in zip(SPLITS, options.sizes, strict=True):
        yield from ((split, options.seed + first + k) for k in range(size))
        first += size


def session_options(options: DatasetOptions, seed: int) -> SessionOptions:
    """Draw how a session is recorded.

    Args:
        options: What is drawn from.
        seed: Seed of the session, the only source of randomness.

    Returns:
        The session's options.
    """
    rng, more = np.random.default_rng((seed, 1)), np.random.default_rng((seed, 2))
    floor = float(rng.choice(options.floors))
    most = 2 if options.extents is None else 1  # of larger things fewer find places
    max_per_kind = max(most, round(most * (floor / 2) ** 2))
    stops = max(2, round(int(rng.choice(options.stops)) * floor / 2))
    scale = session_scale(options, seed)
    walled = bool(rng.random() < options.walled)
    room = str(more.choice(options.rooms))
    world = WorldOptions(
        size=(scale * floor, scale * floor),
        kinds=tuple(Kind(kind) for kind in options.kinds),
        per_kind=(0, max_per_kind),
        walls=walled,
        clutter=options.clutter,
        room=tuple(room.split(",")) if walled and room != BOX_ROOM else (),
        sizes=None if options.extents is None else (scale * options.extents[0], scale * options.extents[1]),
    )
    faults = FAULTS[more.integers(len(FAULTS))] if more.random() < options.faulty else NO_FAULTS
    lidar = Lidar(
        rays=int(rng.choice(options.rays)),
        noise_std=float(rng.choice(options.noise_stds)),
        fov=float(more.choice(options.fovs)),
        range_max=scale * float(more.choice(options.range_maxes)),
        faults=faults,
    )
    motion = str(rng.choice(options.motions))
    return SessionOptions(
        seed=seed,
        world=world,
        world_file=Path(str(more.choice(options.worlds))) if options.worlds else None,
        motion=motion,
        stops=(stops, stops),
        duration=20.0 * floor,
        rate=5.0,
        lidar=lidar,
    )


def session_scale(options: DatasetOptions, seed: int) -> float:
    """Draw how large a session is.

    Args:
        options: What is drawn from.
        seed: Seed of the session.

    Returns:
        How many times as large as at a scale of 1.
    """
    return float(np.random.default_rng((seed, 3)).choice(options.scales))


def session_cell(options: DatasetOptions, seed: int) -> float:
    """Draw the cells that a session is mapped with.

    Args:
        options: What is drawn from.
        seed: Seed of the session.

    Returns:
        Their side (m).
    """
    cells = options.cells or (options.resolution,)
    return session_scale(options, seed) * float(np.random.default_rng((seed, 4)).choice(cells))


def make_dataset(
    folder: Path, options: DatasetOptions, progress: Progress | None = None, workers: int | None = None
) -> int:
    """Make a data set, or what is missing of it.

    Args:
        folder: Its folder.
        options: Its contents.
        progress: Called after each session.
        workers: Processes; None: one for each core.

    Returns:
        How many sessions were made now.

    Raises:
        UsageError: The folder holds a data set with other options.
        OutputError: The folder cannot be written.
    """
    _prepare_folder(folder, options)
    missing = [job for job in session_seeds(options) if not _done(folder, *job).exists()]
    with process_pool(workers) as pool:
        futures = [pool.submit(_make_session, folder, options, split, seed) for split, seed in missing]
        for count, future in enumerate(as_completed(futures), start=1):
            if failed := future.result():
                raise OutputError(*failed)
            if progress:
                progress(count, len(missing))
    for mapper in options.mappers:
        write_data_yaml(folder, mapper)
    return len(missing)


def _prepare_folder(folder: Path, options: DatasetOptions) -> None:
    """Make the folders and the manifest, or check that the manifest is that of these options."""
    manifest = strict_json.dumps({"version": 1, "tile": TILE_SIZE} | asdict(options), indent=1) + "\n"
    parts = [f"{kind}/{mapper}" for kind in ("images", "labels") for mapper in options.mappers]
    prepare_folder(folder, manifest, ["truth", "done", *parts])


def prepare_folder(folder: Path, manifest: str, parts: Iterable[str]) -> None:
    """Make the folders and the manifest of a set, or check that the manifest is that of a set to be continued.

    Args:
        folder: The set's folder.
        manifest: What the manifest holds.
        parts: The folders in it that hold a folder for each split.

    Raises:
        UsageError: The folder holds a set with other options, or files that are none of a set.
        OutputError: It cannot be written.
    """
    path = folder / "manifest.json"
    with output_errors(folder):
        folder.mkdir(parents=True, exist_ok=True)
        other = None if path.exists() else _other_file(folder)
        if other and not path.exists():  # else another process has just begun the same set
            raise UsageError(f"{folder} holds {other}, which is of no set: give another folder")
        if path.exists() and path.read_bytes() != manifest.encode():
            raise UsageError(f"{folder} holds a set that was made with other options: give another folder")
    write_file(path, manifest.encode(), OF_THE_SET)
    with output_errors(folder):
        for part in parts:
            for split in SPLITS:
                (folder / part / split).mkdir(parents=True, exist_ok=True)


def _other_file(folder: Path) -> Path | None:
    """Return a file, relative to the folder that it lies in at some depth; None where there is none."""
    found = (path for path in folder.rglob("*") if path.suffix != ".part" and not path.is_dir())
    return next((path.relative_to(folder) for path in found), None)


def _done(folder: Path, split: str, seed: int) -> Path:
    """Return the file that marks a finished session."""
    return folder / "done" / split / f"{seed:06d}"


def _make_session(folder: Path, options: DatasetOptions, split: str, seed: int) -> tuple[str, OSError] | None:
    """Make one session in a process of its own; return the file that cannot be written, and why."""
    return output_failure(partial(_write_session, folder, options, split, seed))


def output_failure(write: Callable[[], None]) -> tuple[str, OSError] | None:
    """Write files in a worker process, whose errors cannot be sent as they are.

    Args:
        write: Writes them.

    Returns:
        The arguments of the OutputError that was raised; None where there was none.
    """
    try:
        write()
    except OutputError as error:
        cause = error.__cause__
        return error.path, cause if isinstance(cause, OSError) else OSError(str(error))
    return None


def _write_session(folder: Path, options: DatasetOptions, split: str, seed: int) -> None:
    """Record and map one session, and write its tiles, with cells as the networks know them."""
    session, cell = session_options(options, seed), session_cell(options, seed)
    try:
        world, scans = simulate_session(session)
    except UsageError:  # such a room, or so much clutter, finds no place among the primitives
        world, scans = simulate_session(replace(session, world=replace(session.world, room=(), clutter=(0, 0))))
    frame = map_frame(world, cell)
    known = replace(frame, resolution=options.resolution)
    grids = {
        mapper: replace(map_scans(mapper, scans, cell, frame.bounds, threads=1), frame=known)
        for mapper in options.mappers
    }
    seen = [primitive.scaled(options.resolution / cell) for primitive in world.primitives]
    for number, tile in enumerate(tile_frames(known)):
        primitives = primitives_in_tile(seen, tile)
        name = f"{seed:06d}_{number}"
        for mapper, grid in grids.items():
            style = "rounded" if mapper in options.rounded else "grey"
            write_image(folder / "images" / mapper / split / f"{name}.png", tile_image(grid, tile, style))
            label = "".join(yolo_label(primitive, tile) for primitive in primitives)
            write_file(folder / "labels" / mapper / split / f"{name}.txt", label.encode(), OF_THE_SET)
        truth = {
            "frame": asdict(tile),
            "primitives": [primitive.to_json() for primitive in primitives],
            "noise_std": session.lidar.noise_std,
            "rays": session.lidar.rays,
            "motion": session.motion,
            "scans": len(scans),
        }
        write_file(folder / "truth" / split / f"{name}.json", strict_json.dumps(truth).encode(), OF_THE_SET)
    write_file(_done(folder, split, seed), b"", OF_THE_SET)


def map_frame(world: World, resolution: float) -> GridFrame:
    """Return the frame of a world's map.

    Args:
        world: The world.
        resolution: Side of a cell (m).

    Returns:
        A frame that covers the floor and MAP_MARGIN around it.
    """
    x0, y0, x1, y1 = world.bounds
    bounds = (x0 - MAP_MARGIN, y0 - MAP_MARGIN, x1 + MAP_MARGIN, y1 + MAP_MARGIN)
    return GridFrame.covering(bounds, resolution)


def simulate_session(session: SessionOptions) -> tuple[World, list[tuple[Scan, Pose2D]]]:
    """Record a session into a temporary log; return its world, and its scans with the laser's true poses."""
    with tempfile.TemporaryDirectory() as scratch:
        path = Path(scratch) / "session.mcap"
        return record_session(path, session).world, read_scans(path)


def read_scans(path: Path) -> list[tuple[Scan, Pose2D]]:
    """Read a recorded log's scans with the laser's true poses (map frame), interpolated to their stamps."""
    with open_log(path) as log:
        topics = log.topics
        stamped = [pose for _, poses in log.decoded(topics[TRUE_POSE_TOPIC]) for pose in poses]
        planes = [planar_pose(pose) for pose in stamped]
        truth = Trajectory.from_unsorted(
            [pose.stamp for pose in stamped], [(pose.x, pose.y, pose.theta) for pose in planes]
        )
        scans = [scan for _, scan in log.decoded(topics[SCAN_TOPIC])]
    at, _ = truth.at(np.array([scan.stamp for scan in scans], dtype=np.int64))
    return [(scan, Pose2D(*pose)) for scan, pose in zip(scans, at.tolist(), strict=True)]


def map_scans(
    mapper: str,
    scans: Sequence[tuple[Scan, Pose2D]],
    resolution: float,
    bounds: Bounds,
    threads: int | None = None,
) -> OccupancyGrid:
    """Map scans with known poses.

    Args:
        mapper: Name of the mapper.
        scans: Scans and the laser's poses, map frame.
        resolution: Side of a cell (m).
        bounds: Bounds of the map (m).
        threads: Number of threads; None: one for each available core. It does not change the map.

    Returns:
        The finished map.
    """
    made = make_mapper(mapper, resolution, bounds, threads=threads)
    for scan, pose in scans:
        made.accumulate(scan, pose)
    return made.finish()


def primitives_in_tile(primitives: Sequence[Primitive], tile: GridFrame) -> tuple[Primitive, ...]:
    """Return the primitives that belong to a tile.

    Args:
        primitives: Primitives, map frame.
        tile: The tile's frame.

    Returns:
        Those with at least MIN_INSIDE_SHARE of their outlines within it.
    """
    return tuple(primitive for primitive in primitives if share_inside(primitive, tile) >= MIN_INSIDE_SHARE)


def share_inside(primitive: Primitive, tile: GridFrame) -> float:
    """Compute the share of an outline within a tile.

    Args:
        primitive: The primitive, map frame.
        tile: The tile's frame.

    Returns:
        The share of the outline's length, 0 to 1.
    """
    import shapely

    outline = shapely.LinearRing(primitive.outline())
    return float(outline.intersection(shapely.box(*tile.bounds)).length / outline.length)


def yolo_label(primitive: Primitive, tile: GridFrame) -> str:
    """Return a primitive's label for ultralytics: a polygon, not a box.

    Training rotates images, and the box around a rotated box is larger than that around the rotated outline.

    Args:
        primitive: The primitive, map frame.
        tile: The tile's frame.

    Returns:
        A line: class index, then x and y of each vertex as shares of the image, clipped to the tile.
    """
    points = np.clip(primitive.outline() / tile.resolution - (tile.col, tile.row), 0, TILE_SIZE) / TILE_SIZE
    return " ".join([str(KINDS.index(primitive.kind)), *(f"{value:.6f}" for value in points.ravel())]) + "\n"


def bounding_box(primitive: Primitive, tile: GridFrame) -> Box:
    """Return the axis-aligned bounding box of a primitive, clipped to a tile.

    Args:
        primitive: The primitive, map frame.
        tile: The tile's frame.

    Returns:
        The box, in cells of the tile.
    """
    cells = primitive.outline() / tile.resolution - (tile.col, tile.row)
    (x0, y0), (x1, y1) = np.clip(cells.min(axis=0), 0, TILE_SIZE), np.clip(cells.max(axis=0), 0, TILE_SIZE)
    return float(x0), float(y0), float(x1), float(y1)


def write_image(path: Path, image: NDArray[np.uint8]) -> None:
    """Write a PNG image of a data set.

    Args:
        path: Its file.
        image: (rows, cols, 3).

    Raises:
        OutputError: It cannot be written.
    """
    write_file(path, cv2.imencode(".png", cv2.cvtColor(image, cv2.COLOR_RGB2BGR))[1].tobytes(), OF_THE_SET)


def data_description(folder: Path, mapper: str) -> str:
    """Return the data description that ultralytics trains from.

    Args:
        folder: Folder of the data set.
        mapper: Name of the mapper, or of what made the images.

    Returns:
        The text of a YAML file.
    """
    names = "".join(f"  {k}: {kind.value}\n" for k, kind in enumerate(KINDS))
    path = strict_json.dumps(str(folder.resolve()))  # quoted as YAML has it
    return f"path: {path}\ntrain: images/{mapper}/train\nval: images/{mapper}/val\nnames:\n{names}"


def write_data_yaml(folder: Path, mapper: str) -> None:
    """Write the data description, which marks a complete set.

    Args:
        folder: Folder of the data set.
        mapper: Name of the mapper, or of what made the images.
    """
    write_file(folder / f"{mapper}.yaml", data_description(folder, mapper).encode(), OF_THE_SET)


@dataclass(frozen=True)
class Sample:
    """One tile of a data set.

    Attributes:
        image: File of its image.
        frame: Its frame.
        primitives: The primitives that belong to it, map frame.
        noise_std: Standard deviation of the range noise (m) that it was recorded with.
    """

    image: Path
    frame: GridFrame
    primitives: tuple[Primitive, ...]
    noise_std: float


def load_samples(folder: Path, mapper: str, split: str) -> list[Sample]:
    """List the tiles of a data set.

    Args:
        folder: Folder of the data set.
        mapper: Name of the mapper whose images are wanted.
        split: One of SPLITS.

    Returns:
        The tiles in the order of their names.

    Raises:
        UsageError: The folder holds no such data set.
    """
    paths = sorted((folder / "truth" / split).glob("*.json"))
    if not paths or not (folder / f"{mapper}.yaml").exists():
        raise UsageError(f"{folder} holds no {split} set for {mapper}: {hint_to_make_set(folder, mapper)}")
    return [_read_sample(folder, mapper, split, path) for path in paths]


def hint_to_make_set(folder: Path, mapper: str) -> str:
    """Return the command that makes a set for a mapper.

    Args:
        folder: The folder that lacks it; where it holds another set, one beside it is named.
        mapper: Name of the mapper, or «drawings».

    Returns:
        The hint.
    """
    place = folder.with_name(f"{folder.name}-{mapper}") if (folder / "manifest.json").exists() else folder
    command = f"dataset {shlex.quote(str(place))} --mapper {mapper}"
    if mapper not in MAPPERS:
        command = f"{mapper} {shlex.quote(str(place))}"
    return f"make one with: prim-train {command}"


def image_style(folder: Path, mapper: str) -> str:
    """Return the style of a data set's images.

    Args:
        folder: Folder of the data set.
        mapper: Name of the mapper.

    Returns:
        One of networks.tiles.STYLES.

    Raises:
        UsageError: The folder holds no data set.
    """
    try:
        manifest = strict_json.loads((folder / "manifest.json").read_bytes())
        return "rounded" if mapper in manifest.get("rounded", ()) else "grey"
    except (OSError, ValueError, TypeError, AttributeError) as error:
        raise UsageError(f"{folder} holds no set: {hint_to_make_set(folder, mapper)}") from error


def _read_sample(folder: Path, mapper: str, split: str, path: Path) -> Sample:
    image = folder / "images" / mapper / split / f"{path.stem}.png"
    try:
        truth: dict[str, Any] = strict_json.loads(path.read_bytes())
        primitives = tuple(Primitive.from_json(value) for value in truth["primitives"])
        return Sample(image, GridFrame(**truth["frame"]), primitives, truth["noise_std"])
    except (OSError, ValueError, TypeError, KeyError, AttributeError) as error:
        raise UsageError(f"{path} is damaged: make the set in an empty folder with prim-train dataset") from error


def read_image(sample: Sample) -> NDArray[np.uint8]:
    """Read a sample's image (TILE_SIZE, TILE_SIZE, 3).

    Raises:
        UsageError: The file is missing or damaged.
    """
    try:
        image = cv2.imdecode(np.fromfile(sample.image, np.uint8), cv2.IMREAD_COLOR_RGB)
    except (OSError, cv2.error):  # the latter where the file is empty
        image = None
    if image is None:
        raise UsageError(
            f"{sample.image} is missing or damaged: make the set in an empty folder with prim-train dataset"
        )
    return np.asarray(image, dtype=np.uint8)
