"""What a replay leaves behind: the JSON report, the nav2 map, the trajectory, the table."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np

from mapping.grid import OccupancyGrid
from prim.metrics import DetectionErrors
from prim.shapes import Kind
from replay.detection import Sighting
from replay.posed_scans import counted
from replay.poses.localize import COMPASS, GPS, ODOM, LaserPoses, Sensor
from replay.result import ReplayResult

UNITS = {ODOM: ("m", "rad"), GPS: ("m",), COMPASS: ("rad",)}
"""What the noise of each sensor is told in."""

SCHEMA = "prim-replay/1"

LEAST_RAY_NOISE = 0.002
"""Refinement tells no smaller noise (m)."""

CELLS_LIMIT = 1.5
"""Noise below this many cells cannot be told from the cells' own size."""


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
