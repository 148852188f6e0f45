"""Choice of the detector's score thresholds on a data set."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from detect.detector import DetectorOptions
from detect.networks.yolo import KINDS, Yolo, non_maximum_suppression
from detect.training.dataset import Sample, read_image
from detect.training.matches import LabelledImage, ScoredBoxes, match_kind, peak_confidence

DEFAULTS = DetectorOptions()


def choose_thresholds(yolo: Yolo, samples: Sequence[Sample], options: DetectorOptions = DEFAULTS) -> dict[str, float]:
    """Choose for each kind the score threshold with the largest F1 among a detector's candidates.

    Args:
        yolo: The network.
        samples: Tiles that it was not trained on.
        options: The detector's parameters.

    Returns:
        Thresholds by the names of the kinds that occur.
    """
    images: list[ScoredBoxes] = []
    for begin in range(0, len(samples), options.batch_size):
        chosen = samples[begin : begin + options.batch_size]
        batch = [LabelledImage(sample, read_image(sample)) for sample in chosen]
        candidates = yolo(np.stack([labelled.image for labelled in batch]), options.score_floor)
        for labelled, boxes in zip(batch, candidates, strict=True):
            kept = non_maximum_suppression(boxes, options.nms_iou) == np.arange(len(boxes))
            images.append(labelled.with_candidates(boxes[kept]))
    return best_confidences(images)


def best_confidences(images: Sequence[ScoredBoxes]) -> dict[str, float]:
    """Return for each kind that occurs, by name, the score threshold with the largest F1 at a match IoU of 0.5."""
    chosen: dict[str, float] = {}
    for index, kind in enumerate(KINDS):
        matches = match_kind(images, index)
        if matches.truths:
            chosen[kind.value] = peak_confidence(matches.f1())
    return chosen
