"""Matching of candidate boxes to the ground truth, and precision and recall over the score threshold."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from detect.networks.cnn import ClassifiedRegion
from detect.networks.tiles import BoxArray
from detect.networks.yolo import KINDS, Boxes, box_iou
from detect.training.dataset import Sample, bounding_box
from prim.arrays import FloatArray

MATCH_IOUS = np.round(np.arange(0.5, 1.0, 0.05), 2)
"""Intersections over union that a match needs, for mAP 0.5-0.95 (COCO); the first alone for mAP 0.5."""

CONFIDENCES = np.linspace(0, 1, 1001)
"""Score thresholds that F1 is computed at."""


@dataclass(frozen=True)
class ScoredBoxes:
    """Candidates of one image with its ground truth.

    Attributes:
        boxes: The candidates.
        true_box: (N, 4) true boxes, in the unit of the candidates'.
        true_kind: (N,) their class indices (of KINDS).
    """

    boxes: Boxes
    true_box: BoxArray
    true_kind: NDArray[np.intp]


@dataclass(frozen=True)
class LabelledImage:
    """A tile's image with its ground truth.

    Attributes:
        sample: The tile and its primitives.
        image: (TILE_SIZE, TILE_SIZE, 3).
    """

    sample: Sample
    image: NDArray[np.uint8]

    @property
    def true_boxes(self) -> list[ClassifiedRegion]:
        """The true boxes as the parameter estimator takes them."""
        grey = np.ascontiguousarray(self.image[..., 0])
        frame = self.sample.frame
        return [
            ClassifiedRegion(grey, frame, bounding_box(primitive, frame), primitive.kind)
            for primitive in self.sample.primitives
        ]

    def with_candidates(self, boxes: Boxes) -> ScoredBoxes:
        """Return candidates (cells of the tile) with the image's true boxes."""
        true = [bounding_box(primitive, self.sample.frame) for primitive in self.sample.primitives]
        kinds = [KINDS.index(primitive.kind) for primitive in self.sample.primitives]
        return ScoredBoxes(boxes, np.array(true, np.float32).reshape(-1, 4), np.array(kinds, dtype=np.intp))


@dataclass(frozen=True)
class KindMatches:
    """One kind's candidates over all images, in descending order of score.

    Attributes:
        score: (N,) their scores.
        hit: (N, len(MATCH_IOUS)) whether they are true positives.
        truths: Number of true boxes of the kind.
    """

    score: NDArray[np.float32]
    hit: NDArray[np.bool_]
    truths: int

    def f1(self) -> FloatArray:
        """Return F1 at a match IoU of 0.5 for each score threshold of CONFIDENCES."""
        accepted = np.searchsorted(-self.score, -CONFIDENCES, side="right")
        hits = np.concatenate(([0], np.cumsum(self.hit[:, 0])))[accepted]
        return np.asarray(2 * hits / np.maximum(accepted + self.truths, 1), dtype=np.float64)

    def precision_recall(self, column: int) -> tuple[FloatArray, FloatArray]:
        """Return precision and recall (N,) after each candidate, for one of MATCH_IOUS by its index."""
        hits = np.cumsum(self.hit[:, column])
        return hits / np.arange(1, len(hits) + 1), hits / max(self.truths, 1)


def match_kind(images: Sequence[ScoredBoxes], index: int) -> KindMatches:
    """Match one kind's candidates to true boxes, image by image.

    In descending order of score, a candidate is matched to the true box of its kind that it overlaps most among those
    not matched yet; it is a true positive where the intersection over union is large enough.

    Args:
        images: Candidates and true boxes.
        index: Class index of the kind (of KINDS).

    Returns:
        The candidates of all images with their matches.
    """
    score, hit = [np.empty(0, np.float32)], [np.empty((0, len(MATCH_IOUS)), bool)]
    truths = 0
    for image in images:
        true_box = image.true_box[image.true_kind == index]
        truths += len(true_box)
        own = image.boxes[np.flatnonzero(image.boxes.kind == index)]
        own = own[np.argsort(-own.score, kind="stable")]
        score.append(own.score)
        hit.append(_match_boxes(own.box, true_box))
    scores = np.concatenate(score)
    order = np.argsort(-scores, kind="stable")
    return KindMatches(scores[order], np.concatenate(hit)[order], truths)


def _match_boxes(box: BoxArray, true_box: BoxArray) -> NDArray[np.bool_]:
    """Return which candidates (N, 4), best first, are true positives at each of MATCH_IOUS: (N, len(MATCH_IOUS))."""
    hit = np.zeros((len(box), len(MATCH_IOUS)), bool)
    if not len(true_box):
        return hit
    iou = np.array([box_iou(candidate, true_box) for candidate in box]).reshape(len(box), len(true_box))
    for column, min_iou in enumerate(MATCH_IOUS):
        unmatched = np.ones(len(true_box), bool)
        for i, row in enumerate(iou):
            best = int(np.argmax(np.where(unmatched, row, -1.0)))
            if unmatched[best] and row[best] >= min_iou:
                hit[i, column], unmatched[best] = True, False
    return hit


def peak_confidence(f1: FloatArray) -> float:
    """Return the score threshold of the largest F1, the median of several; ``f1`` has one for each of CONFIDENCES."""
    return float(np.median(CONFIDENCES[f1 >= f1.max() - 1e-9]))
