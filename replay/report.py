"""What a replay leaves behind: the JSON report, the nav2 map, the trajectory, the table."""

from __future__ import annotations

import errno
import json
import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from mapping.grid import OccupancyGrid
from prim.errors import OutputError
from prim.metrics import DetectionErrors
from prim.shapes import Kind
from replay.localize import COMPASS, GPS, ODOM, LaserPoses, Sensor
from replay.lookout import Sighting
from replay.pipeline import ReplayResult
from replay.scans import counted

UNITS = {ODOM: ("m", "rad"), GPS: ("m",), COMPASS: ("rad",)}
"""What the noise of each sensor is told in."""

SCHEMA = "prim-replay/1"

LEAST_RAY_NOISE = 0.002
"""Refinement tells no smaller noise (m)."""

CELLS_LIMIT = 1.5
"""Noise below this many cells cannot be told from the cells' own size."""

FREE_THRESHOLD, OCCUPIED_THRESHOLD = 0.196, 0.65
"""nav2's map_server calls cells below the one free and above the other occupied; 205 is 0.19608, unknown."""


def report(result: ReplayResult) -> dict[str, Any]:
    """The report as DESIGN section 7 has it (schema ``prim-replay/1``)."""
    frame = result.grid.frame
    seconds = result.seconds
    rmse = result.pose_rmse or (None, None)
    return {
        "schema": SCHEMA,
        "log": {
            "path": str(result.path),
            "duration_s": result.duration,
            "scans": result.scans,
            "scans_used": result.scans_used,
            "rays": result.rays,
            "messages_lost": result.messages_lost,
            "recovered": bool(result.lost),
        },
        "pose": {"source": result.poses.source, "rmse_m": rmse[0], "rmse_rad": rmse[1]} | _pose_spread(result),
        "map": {
            "mapper": result.options.mapper,
            "resolution_m": frame.resolution,
            "origin_m": list(frame.origin),
            "cells": [frame.rows, frame.cols],
            "noise_std_m": result.noise_std,
            "evidence": _evidence(result.grid),
            "scores": result.scores.to_json() if result.scores else None,
        },
        "primitives": _primitives(result.sighting),
        "refine": {"noise_std_m": result.sighting.noise_std if result.sighting else None},
        "errors": _errors(result.sighting),
        "timing": {f"{name}_s": value for name, value in seconds.items()}
        | {
            "rays_per_s": result.rays / seconds["map"] if seconds["map"] else None,
            "x_realtime": result.duration / seconds["total"] if seconds["total"] else None,
        },
    }


def _pose_spread(result: ReplayResult) -> dict[str, Any]:
    """How sure the poses are (root mean squares), and what they were fused from; nulls where nobody knows.

    ``nees`` is the mean normalised error squared, 3 where the covariances are right.
    """
    std = pose_std(result.poses)
    return {
        "std_m": std and std[0],
        "std_rad": std and std[1],
        "nees": result.pose_nees,
        "matched": result.poses.matched,
        "sensors": {
            sensor.name: {
                "topic": sensor.topic,
                "used": sensor.used,
                "rejected": sensor.rejected,
                **{f"std_{unit}": sensor.std.get(unit) for unit in UNITS[sensor.name]},
                **({"bias_rad": sensor.bias} if sensor.name == COMPASS else {}),
            }
            for sensor in result.poses.sensors
        }
        or None,
    }


def pose_std(poses: LaserPoses) -> tuple[float, float] | None:
    """Root mean squares of the poses' standard deviations: of places (m, both axes together) and headings (rad)."""
    if poses.covariances is None or not poses.valid.any():
        return None
    variances = poses.covariances[poses.valid].diagonal(axis1=1, axis2=2).mean(axis=0)
    return float(np.sqrt(variances[:2].sum())), float(np.sqrt(variances[2]))


def _primitives(sighting: Sighting | None) -> list[dict[str, Any]]:
    """What was found, best first."""
    if sighting is None:
        return []
    return [
        {"id": identity.id}
        | one.primitive.to_json()
        | {
            "score": one.score,
            "stage": "detected" if one.std is None else "refined",
            "std": None if one.std is None else dict(one.std),
            "chances": None if one.chances is None else {str(kind): chance for kind, chance in one.chances.items()},
        }
        for identity, one in zip(sighting.identities, sighting.detections.found, strict=True)
    ]


def _errors(sighting: Sighting | None) -> dict[str, Any] | None:
    """How what was found compares with the truth; lengths in metres, angles in radians."""
    if sighting is None or sighting.errors is None:
        return None
    errors, found = sighting.errors, sighting.detections.found
    return {
        "precision": errors.precision,
        "recall": errors.recall,
        "f1": errors.f1,
        "position_m": errors.position,
        "angle_rad": errors.angle,
        "width_m": errors.width,
        "height_m": errors.height,
        "iou": errors.iou,
        "pairs": [
            {
                "id": sighting.identities[pair.detection].id,
                "truth": pair.truth,
                "kind": str(found[pair.detection].primitive.kind),
                "truth_kind": str(sighting.truth[pair.truth].kind),
                "position_m": pair.position,
                "angle_rad": pair.angle,
                "width_m": pair.width,
                "height_m": pair.height,
                "iou": pair.iou,
            }
            for pair in errors.pairs
        ],
    }


def _evidence(grid: OccupancyGrid) -> dict[str, Any] | None:
    """How many rays are expected to have come to the cells that are known; None where the mapper does not say."""
    if grid.evidence is None:
        return None
    known = grid.evidence[grid.occupied | grid.free]
    quartiles = np.percentile(known, (25, 50, 75)).tolist() if len(known) else [None, None, None]
    return {"cells_known": len(known), "rays_per_cell_quartiles": quartiles}


def check_writable(path: Path) -> None:
    """Raises OutputError where a file could not be written, before the work that would be lost."""
    with _writing(path):
        if path.is_dir():
            raise IsADirectoryError(errno.EISDIR, os.strerror(errno.EISDIR))
        if not path.parent.is_dir():
            raise FileNotFoundError(errno.ENOENT, os.strerror(errno.ENOENT))
        if not os.access(path if path.exists() else path.parent, os.W_OK):
            raise PermissionError(errno.EACCES, os.strerror(errno.EACCES))


def write_report(path: Path, result: ReplayResult) -> None:
    """Writes the report as JSON. Raises OutputError."""
    with _writing(path):
        path.write_text(json.dumps(report(result), indent=2) + "\n", encoding="utf-8")


def write_map(stem: Path, grid: OccupancyGrid) -> None:
    """Writes ``stem.pgm`` and ``stem.yaml`` as nav2's map_server reads them. Raises OutputError.

    An image's first row is the map's largest y. Cells called occupied are black, free ones white, unknown
    ones 205, which its ``trinary`` mode reads back as they were.
    """
    image = np.full(grid.frame.shape, 205, dtype=np.uint8)
    image[grid.free] = 254
    image[grid.occupied] = 0
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
    """Writes the laser's poses in TUM's format (stamp x y z qx qy qz qw). Raises OutputError."""
    lines = []
    for stamp, pose, valid in zip(result.stamps.tolist(), result.poses.poses, result.poses.valid, strict=True):
        if valid:
            x, y, half = pose[0], pose[1], pose[2] / 2
            seconds = f"{stamp // 10**9}.{stamp % 10**9:09d}"
            lines.append(f"{seconds} {x:.9f} {y:.9f} 0 0 0 {np.sin(half):.9f} {np.cos(half):.9f}\n")
    with _writing(path):
        path.write_text("".join(lines), encoding="utf-8")


def table(result: ReplayResult) -> list[tuple[str, str]]:
    """The rows of the short table at the end: name, value with its unit."""
    frame, seconds, scores = result.grid.frame, result.seconds, result.scores
    x0, y0, x1, y1 = frame.bounds
    used = f"{result.scans_used} of {result.scans}" if result.scans_used != result.scans else f"{result.scans}"
    rows = [
        ("log", f"{result.path.name}, {result.duration:.1f} s, {used} scans, {result.rays:,} rays"),
        ("poses", f"{result.poses.source} ({result.poses.origin}){', matched scans' * result.poses.matched}"),
        ("map", f"{result.options.mapper}, {frame.cols} x {frame.rows} cells of {frame.resolution:g} m"),
        ("bounds", f"x {x0:.2f} to {x1:.2f} m, y {y0:.2f} to {y1:.2f} m"),
    ]
    if result.noise_std is not None:
        rows.append(("range noise", _noise(result.noise_std, result.options.noise_std is not None, frame.resolution)))
    if result.poses.sensors:
        rows.append(("pose noise", "; ".join(_sensor_noise(sensor) for sensor in result.poses.sensors)))
    std = pose_std(result.poses)
    expected = f", expected {_length_and_turn(*std)}" if std else ""
    if result.pose_rmse is not None:
        rows.append(("pose error", f"{_length_and_turn(*result.pose_rmse)} (RMS){expected}"))
    elif std:
        rows.append(("pose std", f"{_length_and_turn(*std)} (RMS)"))
    if scores is not None:
        rows += [
            ("occupied", f"precision {_percent(scores.occupied_precision)}, recall "
             f"{_percent(scores.occupied_recall)}, F1 {_percent(scores.occupied_f1)} (within one cell)"),
            ("free", f"{_percent(scores.free_accuracy)} right"),
            ("AUC", "-" if scores.auc is None else f"{scores.auc:.4f}"),
        ]  # fmt: skip
    if result.sighting is not None:
        rows.append(("primitives", _counted(result.sighting)))
        if result.sighting.noise_std is not None and result.options.noise_std is None:
            least = "at most " if result.sighting.noise_std <= LEAST_RAY_NOISE else ""
            rows.append(("ray noise", f"{least}{result.sighting.noise_std * 1000:.1f} mm (found on the primitives)"))
        if result.sighting.errors is not None:
            rows += _quality(result.sighting.errors)
    if result.blind is not None:
        rows.append(("primitives", f"not looked for: {result.blind}"))
    rate = result.rays / seconds["map"] / 1e6 if seconds["map"] else 0.0
    rows.append(("time", f"{seconds['total']:.2f} s, mapping {seconds['map']:.3f} s ({rate:.2f} M rays/s)"))
    return rows


def _length_and_turn(metres: float, radians: float) -> str:
    return f"{metres * 1000:.1f} mm, {np.degrees(radians):.2f} deg"


def _sensor_noise(sensor: Sensor) -> str:
    """A sensor's noise in words."""
    values = [f"{1000 * sensor.std['m']:.0f} mm"] if "m" in sensor.std else []
    values += [f"{np.degrees(sensor.std['rad']):.1f} deg"] if "rad" in sensor.std else []
    what = f"{sensor.name} {', '.join(values) or 'unknown'}"
    if sensor.name == ODOM:
        return f"{what} after 1 m" if values else what
    return f"{what} ({sensor.rejected} of {sensor.used + sensor.rejected} not used)" if sensor.rejected else what


def _counted(sighting: Sighting) -> str:
    """How many of each kind were found."""
    kinds = [one.primitive.kind for one in sighting.detections.found]
    each = [counted(kinds.count(kind), kind) for kind in Kind if kind in kinds]
    return ", ".join(each) or "none found"


def _quality(errors: DetectionErrors) -> Iterator[tuple[str, str]]:
    """How much was found of what is there, and how far off it is on average."""
    found = f"precision {errors.precision:.1%}, recall {errors.recall:.1%}, F1 {errors.f1:.1%}"
    yield "detection", f"{found} (kind, IoU 0.5)"
    if errors.position is not None and errors.width is not None and errors.height is not None:
        size = 500 * (errors.width + errors.height)
        turn = "" if errors.angle is None else f", angle {np.degrees(errors.angle):.1f} deg"
        yield "errors", f"position {1000 * errors.position:.1f} mm, size {size:.1f} mm{turn} (means)"


def _noise(std: float, given: bool, resolution: float) -> str:
    """The noise in words: what is found of noise that is no larger than a cell is mostly the cell."""
    if given:
        return f"{std * 1000:.1f} mm (as given)"
    if std < CELLS_LIMIT * resolution:
        return f"at most {std * 1000:.1f} mm (cells of {resolution * 1000:g} mm show no less)"
    return f"{std * 1000:.1f} mm (standard deviation)"


def _percent(share: float | None) -> str:
    return "-" if share is None else f"{share:.1%}"


def map_files(stem: Path) -> tuple[Path, Path]:
    """The image and the description of a map that is called ``stem``, with or without either's suffix."""
    name = stem.name.removesuffix(".yaml").removesuffix(".pgm")
    return stem.with_name(f"{name}.pgm"), stem.with_name(f"{name}.yaml")


@contextmanager
def _writing(path: Path) -> Iterator[None]:
    try:
        yield
    except OSError as error:
        raise OutputError(path, error) from error
