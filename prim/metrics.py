"""How good detections and maps are: one definition for replay, evaluation and benchmarks."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import SupportsInt

import numpy as np

from prim.arrays import FloatArray
from prim.shapes import Primitive, angle_error

FOUND_IOU = 0.5
"""A primitive counts as found when the kind agrees and the polygons' IoU is at least this."""

OVERLAY_GRID = 1e-9
"""Vertices are rounded to this (m) before polygons meet: without it, some that all but agree share nothing."""


@dataclass(frozen=True, slots=True)
class Pair:
    """A detection and the true primitive it overlaps most, by their indices, with the errors (m, rad)."""

    detection: int
    truth: int
    same_kind: bool
    position: float
    angle: float | None
    width: float
    height: float
    iou: float

    @property
    def found(self) -> bool:
        """Whether the pair counts as a find."""
        return self.same_kind and self.iou >= FOUND_IOU


@dataclass(frozen=True, slots=True)
class DetectionErrors:
    """Finds over all detections and all true primitives; mean absolute errors (m, rad) over the finds.

    A mean is None where nothing was found (the angle's: nothing with an angle).
    """

    precision: float
    recall: float
    f1: float
    position: float | None
    angle: float | None
    width: float | None
    height: float | None
    iou: float | None
    pairs: tuple[Pair, ...]


def polygon_iou(a: Primitive, b: Primitive) -> float:
    """Intersection over union of two outlines' polygons."""
    first, second, shared = polygon_areas(a, b)
    return shared / (first + second - shared)


def polygon_areas(a: Primitive, b: Primitive) -> tuple[float, float, float]:
    """The areas (m^2) of two outlines' polygons, and the area that they share."""
    import shapely  # when it is needed: a replay without detections starts faster

    first, second = shapely.Polygon(a.outline()), shapely.Polygon(b.outline())
    shared = shapely.intersection(first, second, grid_size=OVERLAY_GRID)
    return float(first.area), float(second.area), float(shared.area)


def match_primitives(detections: Sequence[Primitive], truth: Sequence[Primitive]) -> list[Pair]:
    """Pairs of overlapping detections and true primitives, each used once, best first.

    Finds go before other pairs, and larger IoU before smaller. True primitives do
    not overlap, so that no detection overlaps two of them by half and this greedy order finds as many as any.
    """
    candidates = [
        pair
        for i, detection in enumerate(detections)
        for j, true in enumerate(truth)
        if (pair := _pair(i, j, detection, true)).iou > 0
    ]
    candidates.sort(key=lambda pair: (pair.found, pair.iou), reverse=True)
    pairs: list[Pair] = []
    for pair in candidates:
        if all(pair.detection != other.detection and pair.truth != other.truth for other in pairs):
            pairs.append(pair)
    return pairs


def detection_errors(detections: Sequence[Primitive], truth: Sequence[Primitive]) -> DetectionErrors:
    """Precision, recall, F1 and mean errors of detections against the truth (the paper's Table II averages)."""
    pairs = match_primitives(detections, truth)
    found = [pair for pair in pairs if pair.found]
    precision = len(found) / len(detections) if detections else float(not truth)
    recall = len(found) / len(truth) if truth else float(not detections)
    return DetectionErrors(
        precision=precision,
        recall=recall,
        f1=f1_score(precision, recall),
        position=_mean(pair.position for pair in found),
        angle=_mean(pair.angle for pair in found if pair.angle is not None),
        width=_mean(pair.width for pair in found),
        height=_mean(pair.height for pair in found),
        iou=_mean(pair.iou for pair in found),
        pairs=tuple(pairs),
    )


def pose_rmse(estimate: FloatArray, truth: FloatArray) -> tuple[float, float]:
    """Root mean square errors of position (m) and heading (rad) of poses (N, 3), without any alignment."""
    delta = estimate - truth
    turn = (delta[:, 2] + np.pi) % (2 * np.pi) - np.pi
    return float(np.sqrt((delta[:, :2] ** 2).sum(axis=1).mean())), float(np.sqrt((turn**2).mean()))


def pose_nees(estimate: FloatArray, truth: FloatArray, covariances: FloatArray) -> float:
    """The mean normalised error squared of poses (N, 3) with covariances (N, 3, 3): 3 where those are right."""
    delta = estimate - truth
    delta[:, 2] = (delta[:, 2] + np.pi) % (2 * np.pi) - np.pi
    return float(np.einsum("ni,ni->n", delta, np.linalg.solve(covariances, delta[..., None])[..., 0]).mean())


def _pair(i: int, j: int, detection: Primitive, truth: Primitive) -> Pair:
    width, height = detection.width_height
    true_width, true_height = truth.width_height
    same_kind = detection.kind is truth.kind
    return Pair(
        detection=i,
        truth=j,
        same_kind=same_kind,
        position=math.hypot(detection.x - truth.x, detection.y - truth.y),
        angle=angle_error(detection, truth) if same_kind else None,
        width=abs(width - true_width),
        height=abs(height - true_height),
        iou=polygon_iou(detection, truth),
    )


def f1_score(precision: float, recall: float) -> float:
    """The harmonic mean of precision and recall; 0 where both are."""
    return 2 * precision * recall / (precision + recall) if precision + recall else 0.0


def share_of_all(part: SupportsInt, whole: SupportsInt) -> float | None:
    """The share of a count in another; None of nothing."""
    return int(part) / int(whole) if int(whole) else None


def _mean(values: Iterable[float]) -> float | None:
    listed = list(values)
    return sum(listed) / len(listed) if listed else None
