"""The result of a replay for machines (the JSON report) and for people (the table)."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np

from mapping.grid import OccupancyGrid
from mapping.map_metrics import MapScores
from prim import strict_json
from prim.metrics import DetectionErrors
from prim.shapes import Kind
from prim.text import printable
from replay.detection.stage import DetectionResult
from replay.notes import pluralize
from replay.outputs.found_objects import found_objects
from replay.outputs.found_primitives import found_primitives
from replay.poses.fusion_options import COMPASS, GPS, IMU, ODOM
from replay.poses.laser_poses import FusedSensor, LaserPoses
from replay.result import ReplayResult

UNITS = {ODOM: ("m", "rad"), GPS: ("m",), COMPASS: ("rad",), IMU: ("rad",)}
"""The units of each sensor's noise."""

SCHEMA = "prim-replay/1"

MIN_REFINED_NOISE = 0.002
"""The lower bound of the range noise (m) that refinement estimates, which the table shows beside the mapper's."""

COMPARED = (
    ("mapper", ""),
    ("noise", "mm"),
    ("map F1", "%"),
    ("AUC", ""),
    ("found", ""),
    ("objects", ""),
    ("F1", "%"),
    ("position", "mm"),
    ("size", "mm"),
    ("angle", "deg"),
    ("mapping", "s"),
)
"""What is compared of several mappers, and its unit: range noise; F1 of occupied cells and AUC of the map; numbers of
primitives and of objects of no kind; F1 and mean errors of the primitives; the time of mapping."""

MIN_NOISE_CELLS = 1.5
"""The mapper's range noise, which the table calls «range noise», cannot be distinguished from the size of the cells
where it is below this many; set by hand."""


def report_json(result: ReplayResult) -> dict[str, Any]:
    """Return the report of a replay as JSON values (schema ``prim-replay/1``, docs/formats.md).

    A number that is not finite is None, as RFC 8259 has no other way to write it.
    """
    report: dict[str, Any] = strict_json.finite(_report(result))
    return report


def _report(result: ReplayResult) -> dict[str, Any]:
    """Return the report; its numbers may be of any kind."""
    frame = result.grid.frame
    seconds = result.seconds
    rmse = result.pose_rmse or (None, None)
    return {
        "schema": SCHEMA,
        "log": {
            "path": printable(str(result.path)),
            "format": result.format,
            "duration_s": result.duration,
            "scans": result.scans,
            "scans_used": result.scans_used,
            "rays": result.rays,
            "messages_lost": result.messages_lost,
            "recovered": bool(result.lost),
        },
        "pose": {"source": result.poses.source, "rmse_m": rmse[0], "rmse_rad": rmse[1]} | _pose_uncertainty(result),
        "interrupted": result.interrupted is not None,
        "map": {
            "mapper": result.options.mapper,
            "resolution_m": frame.resolution,
            "origin_m": list(frame.origin),
            "cells": [frame.rows, frame.cols],
            "noise_std_m": result.noise_std,
            "evidence": _visits(result.grid),
            "scores": result.scores.to_json() if result.scores else None,
        },
        "primitives": [primitive.to_json() for primitive in found_primitives(result.detections)],
        "objects": [thing.to_json() for thing in found_objects(result.detections)],
        "refine": {"noise_std_m": result.detections.noise_std if result.detections else None},
        "sensor": _sensor_errors(result.detections),
        "errors": _errors(result.detections),
        "timing": {f"{name}_s": value for name, value in seconds.items()}
        | {
            "rays_per_s": result.rays / seconds["map"] if seconds["map"] else None,
            "x_realtime": result.duration / seconds["total"] if seconds["total"] else None,
        },
    }


def _sensor_errors(detections: DetectionResult | None) -> dict[str, Any] | None:
    """Return the scanner's errors that refinement corrected; None where there are none."""
    errors = detections.detections.sensor if detections else None
    if errors is None:
        return None
    return {
        "range_bias_m": errors.range_bias,
        "range_bias_std_m": errors.range_bias_std,
        "nearest_within_rad": errors.nearest_within,
        "mixed_within_rad": errors.mixed_within,
    }


def _pose_uncertainty(result: ReplayResult) -> dict[str, Any]:
    """Return the poses' standard deviations, NEES, loops, and the sensors they were fused from; None if not known."""
    std, loops = pose_std(result.poses), result.poses.loops
    return {
        "std_m": std and std[0],
        "std_rad": std and std[1],
        "nees": result.pose_nees,
        "matched": result.poses.matched,
        "loops": loops and {"closed": loops.closed, "rejected": dict(loops.rejected)},
        "sensors": {
            sensor.name: {
                "topic": sensor.topic,
                "used": sensor.used,
                "rejected": sensor.rejected,
                **{f"std_{unit}": sensor.std.get(unit) for unit in UNITS[sensor.name]},
                **({"bias_rad": sensor.bias} if sensor.name in (COMPASS, IMU) else {}),
                **_sensor_oddities(sensor),
            }
            for sensor in result.poses.sensors
        }
        or None,
    }


def _sensor_oddities(sensor: FusedSensor) -> dict[str, Any]:
    """Return the scales of an odometry, and how the errors of another sensor wander."""
    if sensor.name == ODOM:
        return {"distance_scale": sensor.scales[0], "turn_scale": sensor.scales[1]}
    unit = UNITS[sensor.name][0]
    return {
        f"wander_std_{unit}": sensor.wander and sensor.wander.std,
        "wander_time_s": sensor.wander and sensor.wander.time,
    }


def pose_std(poses: LaserPoses) -> tuple[float, float] | None:
    """Return the root mean square standard deviations of position (m, both axes together) and heading (rad).

    None where the poses have no covariances, or none that can be.
    """
    if poses.covariances is None or not poses.valid.any():
        return None
    variances = poses.covariances[poses.valid].diagonal(axis1=1, axis2=2).mean(axis=0)
    position, heading = float(variances[:2].sum()), float(variances[2])
    if not (0 <= position < math.inf and 0 <= heading < math.inf):
        return None
    return math.sqrt(position), math.sqrt(heading)


def _errors(result: DetectionResult | None) -> dict[str, Any] | None:
    """Compare the detections with the truth (m, rad); None without ground truth."""
    if result is None or result.errors is None:
        return None
    errors, found = result.errors, result.detections.found
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
                "id": result.identities[pair.detection].id,
                "truth": pair.truth,
                "kind": str(found[pair.detection].primitive.kind),
                "truth_kind": str(result.truth[pair.truth].kind),
                "position_m": pair.position,
                "angle_rad": pair.angle,
                "width_m": pair.width,
                "height_m": pair.height,
                "iou": pair.iou,
            }
            for pair in errors.pairs
        ],
    }


def _visits(grid: OccupancyGrid) -> dict[str, Any] | None:
    """Summarize how many rays the known cells are based on; None for a mapper that does not count them."""
    if grid.visits is None:
        return None
    known = grid.visits[grid.occupied | grid.free]
    quartiles = np.percentile(known, (25, 50, 75)).tolist() if len(known) else [None, None, None]
    return {"cells_known": len(known), "rays_per_cell_quartiles": quartiles}


def summary_rows(result: ReplayResult) -> list[tuple[str, str]]:
    """Return the rows of the table that ends a replay: name, and value with its unit."""
    return [
        *_log_rows(result),
        *_map_rows(result),
        *_pose_rows(result),
        *_score_rows(result.scores),
        *_detection_rows(result),
        _time_row(result),
    ]


def shared_rows(results: Sequence[ReplayResult]) -> list[tuple[str, str]]:
    """Return the rows that hold for all mappers of a replay: name, and value with its unit."""
    rows = [*_log_rows(results[0]), *_pose_rows(results[0]), *_skipped_rows(results)]
    return [*rows, ("time", f"{results[0].elapsed:.2f} s")]


def comparison_table(results: Sequence[ReplayResult]) -> list[list[str]]:
    """Compare the mappers of a replay.

    Args:
        results: A result for each mapper.

    Returns:
        Names of columns, their units, and a row for each mapper, all of the same length; columns without any value
        are left out.
    """
    cells = zip(*map(_comparison_row, results), strict=True)
    columns = [(*head, *values) for head, values in zip(COMPARED, cells, strict=True) if any(values)]
    return [list(row) for row in zip(*columns, strict=True)]


def _comparison_row(result: ReplayResult) -> list[str]:
    """Return what is compared of a mapper's result, in the order of COMPARED; empty for what it does not have."""
    scores, detections = result.scores, result.detections
    errors = detections.errors if detections else None
    size = mean_size_error(errors) if errors else None
    return [
        result.options.mapper,
        _scaled(result.noise_std, 1000),
        _scaled(scores.occupied_f1 if scores else None, 100),
        _scaled(scores.auc if scores else None, 1, 4),
        str(len(detections.detections.found)) if detections else "",
        str(len(detections.object_ids) or "") if detections else "",
        _scaled(errors.f1 if errors else None, 100),
        _scaled(errors.position if errors else None, 1000, 2),
        _scaled(size, 1000, 2),
        _scaled(errors.angle if errors else None, math.degrees(1), 2),
        f"{result.seconds['map']:.2f}",
    ]


def _scaled(value: float | None, factor: float, digits: int = 1) -> str:
    return "" if value is None or not math.isfinite(value) else f"{factor * value:.{digits}f}"


def _log_rows(result: ReplayResult) -> Iterator[tuple[str, str]]:
    """Yield what was replayed."""
    used = f"{result.scans_used} of {result.scans}" if result.scans_used != result.scans else f"{result.scans}"
    yield "log", f"{result.path.name}, {result.duration:.1f} s, {used} scans, {result.rays:,} rays"
    yield "poses", f"{result.poses.source} ({result.poses.origin}){', matched scans' * result.poses.matched}"


def _map_rows(result: ReplayResult) -> Iterator[tuple[str, str]]:
    """Yield what was mapped, and how."""
    frame = result.grid.frame
    x0, y0, x1, y1 = frame.bounds
    yield "map", f"{result.options.mapper}, {frame.cols} x {frame.rows} cells of {frame.resolution:g} m"
    yield "bounds", f"x {x0:.2f} to {x1:.2f} m, y {y0:.2f} to {y1:.2f} m"
    if result.noise_std is not None:
        yield "range noise", _range_noise(result.noise_std, result.options.noise_std is not None, frame.resolution)


def _pose_rows(result: ReplayResult) -> Iterator[tuple[str, str]]:
    """Yield the noise of the sensors that were fused, and how far off the poses are."""
    if result.poses.sensors:
        yield "pose noise", "; ".join(_sensor_noise(sensor) for sensor in result.poses.sensors)
    std = pose_std(result.poses)
    if result.pose_rmse is not None:
        expected = f", expected {_position_and_heading(*std)}" if std else ""
        yield "pose error", f"{_position_and_heading(*result.pose_rmse)} (RMS){expected}"
    elif std:
        yield "pose std", f"{_position_and_heading(*std)} (RMS)"


def _score_rows(scores: MapScores | None) -> Iterator[tuple[str, str]]:
    """Yield how the map compares with the true world."""
    if scores is not None:
        precision, recall = _percent(scores.occupied_precision), _percent(scores.occupied_recall)
        f1 = _percent(scores.occupied_f1)
        yield "occupied", f"precision {precision}, recall {recall}, F1 {f1} (within one cell)"
        yield "free", f"{_percent(scores.free_accuracy)} right"
        yield "AUC", "-" if scores.auc is None else f"{scores.auc:.4f}"


def _detection_rows(result: ReplayResult) -> Iterator[tuple[str, str]]:
    """Yield what was detected, and how it compares with the truth; or why detection was skipped.

    The range noise here is estimated by refinement, from the rays that meet primitives.
    """
    if result.detections is not None:
        yield "primitives", _kind_counts(result.detections)
        if result.detections.object_ids:
            yield "objects", f"{len(result.detections.object_ids)} of no kind"
        noise_std = result.detections.noise_std
        if noise_std is not None and result.options.noise_std is None:
            bound = "at most " if noise_std <= MIN_REFINED_NOISE else ""
            yield "range noise", f"{bound}{noise_std * 1000:.1f} mm (estimated by refinement)"
        if result.detections.errors is not None:
            yield from _error_rows(result.detections.errors)
    yield from _skipped_rows([result])


def _skipped_rows(results: Sequence[ReplayResult]) -> Iterator[tuple[str, str]]:
    """Yield why detection was skipped, where it was."""
    for reason in dict.fromkeys(result.detection_skipped for result in results):
        if reason is not None:
            yield "primitives", f"detection skipped: {reason}"


def _time_row(result: ReplayResult) -> tuple[str, str]:
    """Return the time that the replay took, and the rate of mapping."""
    seconds = result.seconds
    rate = result.rays / seconds["map"] / 1e6 if seconds["map"] else 0.0
    return "time", f"{seconds['total']:.2f} s, mapping {seconds['map']:.3f} s ({rate:.2f} M rays/s)"


def _position_and_heading(metres: float, radians: float) -> str:
    return f"{metres * 1000:.1f} mm, {np.degrees(radians):.2f} deg"


def _sensor_noise(sensor: FusedSensor) -> str:
    """Describe the noise of a sensor, and how many of its readings were rejected."""
    values = [f"{1000 * sensor.std['m']:.0f} mm"] if "m" in sensor.std else []
    values += [f"{np.degrees(sensor.std['rad']):.1f} deg"] if "rad" in sensor.std else []
    what = f"{sensor.name} {', '.join(values) or 'unknown'}"
    if sensor.wander:
        size = (
            f"{1000 * sensor.wander.std:.0f} mm" if sensor.name == GPS else f"{np.degrees(sensor.wander.std):.1f} deg"
        )
        what += f" and {size} that wander"
    if sensor.name == ODOM:
        return f"{what} after 1 m" if values else what
    return f"{what} ({sensor.rejected} of {sensor.used + sensor.rejected} not used)" if sensor.rejected else what


def _kind_counts(result: DetectionResult) -> str:
    """Count the detections of each kind."""
    kinds = [detection.primitive.kind for detection in result.detections.found]
    each = [pluralize(kinds.count(kind), kind) for kind in Kind if kind in kinds]
    return ", ".join(each) or "none found"


def _error_rows(errors: DetectionErrors) -> Iterator[tuple[str, str]]:
    """Yield precision and recall of the detections, and their mean errors."""
    found = f"precision {errors.precision:.1%}, recall {errors.recall:.1%}, F1 {errors.f1:.1%}"
    yield "detection", f"{found} (kind, IoU 0.5)"
    size = mean_size_error(errors)
    if errors.position is not None and size is not None:
        turn = "" if errors.angle is None else f", angle {np.degrees(errors.angle):.1f} deg"
        yield "errors", f"position {1000 * errors.position:.1f} mm, size {1000 * size:.1f} mm{turn} (means)"


def mean_size_error(errors: DetectionErrors) -> float | None:
    """Return the mean error (m) of width and height; None where nothing was found."""
    if errors.width is None or errors.height is None:
        return None
    return (errors.width + errors.height) / 2


def _range_noise(std: float, given: bool, resolution: float) -> str:
    """Describe the mapper's range noise; an estimate no larger than a cell is mostly the size of the cell."""
    if given:
        return f"{std * 1000:.1f} mm (as given)"
    if std < MIN_NOISE_CELLS * resolution:
        return f"at most {std * 1000:.1f} mm (cells of {resolution * 1000:g} mm show no less)"
    return f"{std * 1000:.1f} mm (estimated by the mapper)"


def _percent(share: float | None) -> str:
    return "-" if share is None else f"{share:.1%}"
