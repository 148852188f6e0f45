"""Error metrics of detections and poses: one definition for replay, evaluation and benchmarks."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import SupportsInt

import numpy as np

from prim import linear_algebra
from prim.arrays import FloatArray
from prim.se2 import wrap_angles
from prim.shapes import Primitive, angle_error

FOUND_IOU = 0.5
"""A pair counts as a true positive when the kinds agree and the polygons' IoU is at least this."""

OVERLAY_GRID = 1e-9
"""Vertices are rounded to this (m) before polygons are intersected: else some that nearly coincide share nothing."""


@dataclass(frozen=True, slots=True)
class Pair:
    """A detection and the true primitive that it is matched with.

    Attributes:
        detection: Index of the detection.
        truth: Index of the true primitive.
        same_kind: Whether the kinds agree.
        position: Distance of the centroids (m).
        angle: Error of theta modulo the symmetry (rad); None where the kinds differ or where
            :func:`prim.shapes.angle_error` has none: for circles, and true ellipses that are nearly circles.
        width: Absolute error of the width (m): the full extent of shapes with corners, but half the extent of round
            ones (:attr:`prim.shapes.Primitive.width_height`).
        height: The same of the height (m).
        iou: Intersection over union of the outlines' polygons.
    """

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
        """Whether the pair counts as a true positive."""
        return self.same_kind and self.iou >= FOUND_IOU


@dataclass(frozen=True, slots=True)
class DetectionErrors:
    """Detection rates, and mean absolute errors over the true positives.

    A mean is None where there is no true positive (for the angle: none with an error in angle). Those of width and
    height mix full extents of shapes with corners and half extents of round ones.

    Attributes:
        precision: True positives over all detections; without detections 1 if there is no true primitive, else 0.
        recall: True positives over all true primitives; without those 1 if there is no detection, else 0.
        f1: Harmonic mean of precision and recall.
        position: Mean distance of the centroids (m).
        angle: Mean error of theta (rad).
        width: Mean error of the width (m).
        height: Mean error of the height (m).
        iou: Mean intersection over union.
        pairs: All matched pairs, true positives first.
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
    """Compute the intersection over union of two outlines' polygons.

    Args:
        a: One primitive.
        b: The other.

    Returns:
        From 0 to 1.
    """
    return outline_iou(a.outline(), b.outline())


def outline_iou(a: FloatArray, b: FloatArray) -> float:
    """Compute the intersection over union of two closed outlines, which may be any polygons.

    Args:
        a: Vertices (V, 2) of one (m).
        b: Vertices (W, 2) of the other.

    Returns:
        From 0 to 1; 0 where neither has an area.
    """
    first, second, shared = outline_areas(a, b)
    union = first + second - shared
    return shared / union if union > 0 else 0.0


def overlap_coefficient(a: Primitive, b: Primitive) -> float:
    """Compute the overlap coefficient of two outlines' polygons: their intersection over the smaller one's area.

    Args:
        a: One primitive.
        b: The other.

    Returns:
        From 0 to 1.
    """
    if math.hypot(a.x - b.x, a.y - b.y) > a.bounding_radius + b.bounding_radius:
        return 0.0
    return outline_overlap(a.outline(), b.outline())


def outline_overlap(a: FloatArray, b: FloatArray) -> float:
    """Compute the overlap coefficient of two outlines: their intersection over the smaller one's area.

    Args:
        a: Vertices (N, 2) of one in m, convex or not.
        b: Those (M, 2) of the other.

    Returns:
        From 0 to 1.
    """
    first, second, shared = outline_areas(a, b)
    smaller = min(first, second)
    return shared / smaller if smaller > 0 else 0.0


def outline_areas(a: FloatArray, b: FloatArray) -> tuple[float, float, float]:
    """Compute the areas of two outlines and of their intersection.

    Args:
        a: Vertices (N, 2) of one in m, convex or not; one that crosses itself counts by the even-odd rule.
        b: Those (M, 2) of the other.

    Returns:
        Area of ``a``, of ``b``, of the intersection (m^2).
    """
    import shapely  # here, so that a replay without detections starts faster

    first, second = (
        polygon if polygon.is_valid else shapely.make_valid(polygon) for polygon in map(shapely.Polygon, (a, b))
    )
    shared = shapely.intersection(first, second, grid_size=OVERLAY_GRID)
    return float(first.area), float(second.area), float(shared.area)


def match_primitives(detections: Sequence[Primitive], truth: Sequence[Primitive]) -> list[Pair]:
    """Match detections with true primitives that they overlap, one to one and greedily.

    True positives go before other pairs, larger IoU before smaller. True primitives do not overlap, so that no
    detection has an IoU of FOUND_IOU with two of them, and no other order has more true positives.

    Args:
        detections: What was detected.
        truth: The true primitives.

    Returns:
        The pairs in the order in which they were matched.
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
    """Compute detection rates and mean errors (those of the paper's Table II).

    Args:
        detections: What was detected.
        truth: The true primitives.

    Returns:
        The errors.
    """
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
    """Compute the root mean square errors of poses, without any alignment.

    Args:
        estimate: (N, 3) as x, y (m), theta (rad).
        truth: (N, 3).

    Returns:
        The errors of position (m) and heading (rad).
    """
    delta = estimate - truth
    turn = wrap_angles(delta[:, 2])
    return float(np.sqrt((delta[:, :2] ** 2).sum(axis=1).mean())), float(np.sqrt((turn**2).mean()))


def pose_nees(estimate: FloatArray, truth: FloatArray, covariances: FloatArray) -> float | None:
    """Compute the mean normalised estimation error squared (NEES; Bar-Shalom, Li and Kirubarajan, 2001, 5.4).

    Args:
        estimate: (N, 3) as x, y (m), theta (rad).
        truth: (N, 3).
        covariances: (N, 3, 3) of the estimates.

    Returns:
        The mean; 3 is expected of consistent covariances. None where a covariance is singular or not finite.
    """
    delta = estimate - truth
    delta[:, 2] = wrap_angles(delta[:, 2])
    whitened = linear_algebra.solve(covariances, delta[..., None])
    if whitened is None:
        return None
    return float(np.einsum("ni,ni->n", delta, whitened[..., 0]).mean())


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
    """Compute the harmonic mean of precision and recall.

    Args:
        precision: From 0 to 1.
        recall: From 0 to 1.

    Returns:
        F1; 0 where both are 0.
    """
    return 2 * precision * recall / (precision + recall) if precision + recall else 0.0


def ratio(part: SupportsInt, whole: SupportsInt) -> float | None:
    """Divide a count by another.

    Args:
        part: The count of some.
        whole: The count of all.

    Returns:
        The ratio; None where ``whole`` is 0.
    """
    return int(part) / int(whole) if int(whole) else None


def _mean(values: Iterable[float]) -> float | None:
    listed = list(values)
    return sum(listed) / len(listed) if listed else None
