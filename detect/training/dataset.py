"""Training data: recorded sessions, mapped by every mapper from the same rays, as images with exact primitives.

A set is a folder:

    manifest.json                 the options, so that the same set can be made again
    truth/train/000012_0.json     one tile: where it lies, its primitives, how it was recorded
    images/prob/train/000012_0.png    the tile as each mapper maps it (networks.tiles.cut, row 0 at the smallest y)
    labels/prob/train/000012_0.txt    the same tile's outlines as YOLO reads them
    prob.yaml                     what ultralytics trains from
    done/train/000012             says that all tiles of a session are there

Everything follows from a session's seed: sessions are made in parallel, one that is there already is not made again,
and a set that was interrupted goes on where it stopped. This is the one part of ``detect`` that uses ``recorder``.
"""

from __future__ import annotations

import json
import os
import tempfile
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from detect.networks.tiles import TILE, cut, tiles
from mapping.grid import GridFrame, OccupancyGrid
from mapping.mapper import MAPPERS, make_mapper
from prim.errors import OutputError, UsageError
from prim.log.mcap import LogReader
from prim.log.messages import POSE_TYPE, SCAN_TOPIC, TRUE_POSE_TOPIC, decode_poses, decode_scan, planar
from prim.scan import Scan
from prim.se2 import Pose2D, Trajectory
from prim.shapes import Kind, Primitive
from prim.world import Bounds, World
from recorder.sensors import Lidar
from recorder.session import SessionOptions, record
from recorder.world import WorldOptions

MARGIN = 0.1
"""A map reaches this far (m) beyond the floor."""

LEAST_INSIDE = 0.6
"""A primitive belongs to a tile that holds at least this share of its outline."""

KINDS = tuple(Kind)
"""The classes' order in labels."""

SPLITS = ("train", "val")

Progress = Callable[[int, int], None]


@dataclass(frozen=True)
class SetOptions:
    """What a set holds. Raises UsageError on what cannot be.

    ``sizes`` are the splits' sessions; each draws one of ``noise_stds`` (m), ``rays``, ``floors`` (side, m) and
    ``motions``, has walls with the chance ``walled``, and is mapped by each of ``mappers``.
    Images of the mappers that are ``rounded`` show cells as occupied, free or unknown only (networks.tiles.STYLES).
    """

    sizes: tuple[int, int] = (500, 125)
    seed: int = 100_000
    noise_stds: tuple[float, ...] = (0.0,)
    mappers: tuple[str, ...] = MAPPERS
    kinds: tuple[str, ...] = tuple(kind.value for kind in KINDS)
    rays: tuple[int, ...] = (500,)
    stops: tuple[int, ...] = (10,)
    floors: tuple[float, ...] = (2.0,)
    motions: tuple[str, ...] = ("warp",)
    walled: float = 1.0
    resolution: float = 0.01
    rounded: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        for name in ("noise_stds", "mappers", "kinds", "rays", "stops", "floors", "motions"):
            if not getattr(self, name):
                raise UsageError(f"a set needs at least one of {name}")
        unknown = [mapper for mapper in self.mappers if mapper not in MAPPERS]
        if unknown:
            raise UsageError(f"there is no mapper {unknown[0]!r}: choose from {', '.join(MAPPERS)}")
        if min(self.sizes) < 0 or not sum(self.sizes):
            raise UsageError("a set needs at least one session")
        if not 0 <= self.walled <= 1:
            raise UsageError(f"walled is {self.walled:g}: it is a share, from 0 to 1")


PRESETS = {
    "paper": SetOptions(rounded=("det", "prob")),
    "mixed": SetOptions(
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
PRESETS["large"] = replace(PRESETS["mixed"], sizes=(2400, 60), seed=210_000)
"""The paper's sets (III-B, IV-B: 500 and 125 maps, one noise level each, rounded), one that shipped networks begin
with, and a larger one that they go on with.
"""


def sessions(options: SetOptions) -> Iterator[tuple[str, int]]:
    """Split and seed of every session."""
    first = 0
    for split, size in zip(SPLITS, options.sizes, strict=True):
        yield from ((split, options.seed + first + k) for k in range(size))
        first += size


def session_options(options: SetOptions, seed: int) -> SessionOptions:
    """How the session of a seed is recorded; drawn from the seed alone."""
    rng = np.random.default_rng((seed, 1))
    floor = float(rng.choice(options.floors))
    most = max(2, round(2 * (floor / 2) ** 2))
    stops = max(2, round(int(rng.choice(options.stops)) * floor / 2))
    world = WorldOptions(
        size=(floor, floor),
        kinds=tuple(Kind(kind) for kind in options.kinds),
        per_kind=(0, most),
        walls=bool(rng.random() < options.walled),
    )
    lidar = Lidar(rays=int(rng.choice(options.rays)), noise_std=float(rng.choice(options.noise_stds)))
    motion = str(rng.choice(options.motions))
    return SessionOptions(
        seed=seed, world=world, motion=motion, stops=(stops, stops), duration=20.0 * floor, rate=5.0, lidar=lidar
    )


def make(folder: Path, options: SetOptions, progress: Progress | None = None, workers: int | None = None) -> int:
    """Makes a set, or what is missing of it; returns how many sessions were made now.

    Raises UsageError where the folder holds a set of other options, OutputError where it cannot be written.
    """
    _begin(folder, options)
    missing = [job for job in sessions(options) if not _done(folder, *job).exists()]
    with ProcessPoolExecutor(workers or len(os.sched_getaffinity(0))) as pool:
        futures = [pool.submit(_make_session, folder, options, split, seed) for split, seed in missing]
        for count, future in enumerate(as_completed(futures), start=1):
            future.result()
            if progress:
                progress(count, len(missing))
    for mapper in options.mappers:
        write_yaml(folder, mapper)
    return len(missing)


def _begin(folder: Path, options: SetOptions) -> None:
    """Makes the folders and the manifest, or checks that the manifest is this set's."""
    manifest = json.dumps({"version": 1, "tile": TILE} | asdict(options), indent=1) + "\n"
    path = folder / "manifest.json"
    try:
        if path.exists() and path.read_text(encoding="utf-8") != manifest:
            raise UsageError(f"{folder} holds a set that was made with other options: give another folder")
        for split in SPLITS:
            (folder / "truth" / split).mkdir(parents=True, exist_ok=True)
            (folder / "done" / split).mkdir(parents=True, exist_ok=True)
            for mapper in options.mappers:
                for kind in ("images", "labels"):
                    (folder / kind / mapper / split).mkdir(parents=True, exist_ok=True)
        path.write_text(manifest, encoding="utf-8")
    except OSError as error:
        raise OutputError(folder, error) from error


def _done(folder: Path, split: str, seed: int) -> Path:
    """The file that says that all tiles of a session are there."""
    return folder / "done" / split / f"{seed:06d}"


def _make_session(folder: Path, options: SetOptions, split: str, seed: int) -> None:
    """Records, maps and cuts one session."""
    session = session_options(options, seed)
    world, scans = recorded(session)
    x0, y0, x1, y1 = world.bounds
    bounds = (x0 - MARGIN, y0 - MARGIN, x1 + MARGIN, y1 + MARGIN)
    frame = GridFrame.covering(bounds, options.resolution)
    grids = {mapper: map_scans(mapper, scans, options.resolution, frame.bounds) for mapper in options.mappers}
    for number, tile in enumerate(tiles(frame)):
        held = held_in(tile, world.primitives)
        name = f"{seed:06d}_{number}"
        for mapper, grid in grids.items():
            style = "rounded" if mapper in options.rounded else "grey"
            write_image(folder / "images" / mapper / split / f"{name}.png", cut(grid, tile, style))
            label = "".join(yolo_line(primitive, tile) for primitive in held)
            (folder / "labels" / mapper / split / f"{name}.txt").write_text(label, encoding="utf-8")
        truth = {
            "frame": asdict(tile),
            "primitives": [primitive.to_json() for primitive in held],
            "noise_std": session.lidar.noise_std,
            "rays": session.lidar.rays,
            "motion": session.motion,
            "scans": len(scans),
        }
        (folder / "truth" / split / f"{name}.json").write_text(json.dumps(truth), encoding="utf-8")
    _done(folder, split, seed).touch()


def recorded(session: SessionOptions) -> tuple[World, list[tuple[Scan, Pose2D]]]:
    """A session that is recorded for the purpose: its world, and its scans with the true poses of their laser."""
    with tempfile.TemporaryDirectory() as scratch:
        path = Path(scratch) / "session.mcap"
        return record(path, session).world, read_scans(path)


def read_scans(path: Path) -> list[tuple[Scan, Pose2D]]:
    """A recorded log's scans with the true poses of their laser."""
    with LogReader(path) as log:
        topics = log.topics
        stamped = [
            pose
            for _, poses in log.decoded(topics[TRUE_POSE_TOPIC], lambda data: decode_poses(POSE_TYPE, data))
            for pose in poses
        ]
        planes = [planar(pose) for pose in stamped]
        truth = Trajectory.from_unsorted(
            [pose.stamp for pose in stamped], [(pose.x, pose.y, pose.theta) for pose in planes]
        )
        scans = [scan for _, scan in log.decoded(topics[SCAN_TOPIC], decode_scan)]
    at, _ = truth.at(np.array([scan.stamp for scan in scans], dtype=np.int64))
    return [(scan, Pose2D(*pose)) for scan, pose in zip(scans, at.tolist(), strict=True)]


def map_scans(mapper: str, scans: Sequence[tuple[Scan, Pose2D]], resolution: float, bounds: Bounds) -> OccupancyGrid:
    """The map that a mapper makes of scans."""
    made = make_mapper(mapper, resolution, bounds)
    for scan, pose in scans:
        made.update(scan, pose)
    return made.finish()


def held_in(tile: GridFrame, primitives: Sequence[Primitive]) -> tuple[Primitive, ...]:
    """The primitives that belong to a tile."""
    return tuple(one for one in primitives if share_inside(one, tile) >= LEAST_INSIDE)


def share_inside(primitive: Primitive, tile: GridFrame) -> float:
    """The share of a primitive's outline that lies within a tile."""
    import shapely

    outline = shapely.LinearRing(primitive.outline())
    return float(outline.intersection(shapely.box(*tile.bounds)).length / outline.length)


def yolo_line(primitive: Primitive, tile: GridFrame) -> str:
    """A primitive's label: class, and its outline's points as shares of the image, cut to the tile.

    Points and no box, since training turns images, and a turned box's box is larger than a turned outline's.
    """
    points = np.clip(primitive.outline() / tile.resolution - (tile.col, tile.row), 0, TILE) / TILE
    return " ".join([str(KINDS.index(primitive.kind)), *(f"{value:.6f}" for value in points.ravel())]) + "\n"


def box_of(primitive: Primitive, tile: GridFrame) -> tuple[float, float, float, float]:
    """The box (cells of the tile: left, top, right, bottom; row 0 at the top) around a primitive, cut to the tile."""
    cells = primitive.outline() / tile.resolution - (tile.col, tile.row)
    (left, top), (right, bottom) = np.clip(cells.min(axis=0), 0, TILE), np.clip(cells.max(axis=0), 0, TILE)
    return float(left), float(top), float(right), float(bottom)


def write_image(path: Path, image: NDArray[np.uint8]) -> None:
    """Writes a PNG; whole, or not at all."""
    from PIL import Image

    part = path.with_suffix(f".{os.getpid()}.part")
    Image.fromarray(image).save(part, format="PNG")
    part.replace(path)


def write_yaml(folder: Path, mapper: str) -> None:
    """What ultralytics trains from."""
    names = "".join(f"  {k}: {kind.value}\n" for k, kind in enumerate(KINDS))
    text = f"path: {folder.resolve()}\ntrain: images/{mapper}/train\nval: images/{mapper}/val\nnames:\n{names}"
    (folder / f"{mapper}.yaml").write_text(text, encoding="utf-8")


@dataclass(frozen=True)
class Sample:
    """One tile of a set: its image, where it lies, its primitives, and the noise (m) that it was recorded with."""

    image: Path
    frame: GridFrame
    primitives: tuple[Primitive, ...]
    noise_std: float


def samples(folder: Path, mapper: str, split: str) -> list[Sample]:
    """All tiles of one split, as one mapper maps them. Raises UsageError where the folder holds no such set."""
    paths = sorted((folder / "truth" / split).glob("*.json"))
    if not paths or not (folder / f"{mapper}.yaml").exists():
        raise UsageError(f"{folder} holds no {split} set for {mapper}: make one with prim-train dataset")
    return [_sample(folder, mapper, split, path) for path in paths]


def style_of(folder: Path, mapper: str) -> str:
    """How a set's images show a mapper's cells (networks.tiles.STYLES). Raises UsageError where there is no set."""
    try:
        manifest = json.loads((folder / "manifest.json").read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise UsageError(f"{folder} holds no set: make one with prim-train dataset") from error
    return "rounded" if mapper in manifest.get("rounded", ()) else "grey"


def _sample(folder: Path, mapper: str, split: str, path: Path) -> Sample:
    truth: dict[str, Any] = json.loads(path.read_text(encoding="utf-8"))
    primitives = tuple(Primitive.from_json(value) for value in truth["primitives"])
    image = folder / "images" / mapper / split / f"{path.stem}.png"
    return Sample(image, GridFrame(**truth["frame"]), primitives, truth["noise_std"])


def read_image(sample: Sample) -> NDArray[np.uint8]:
    """A sample's image (TILE, TILE, 3)."""
    from PIL import Image

    return np.asarray(Image.open(sample.image))
