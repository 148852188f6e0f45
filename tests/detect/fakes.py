"""Fake networks with given outputs, in place of ONNX Runtime's sessions."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from detect.networks.weights import ModelCard, Weights
from detect.networks.yolo import KINDS

Answer = Callable[[NDArray[np.float32]], NDArray[np.float32]]


class FakeSession:
    """A session that computes its outputs by a function."""

    def __init__(self, answer: Answer) -> None:
        self.answer = answer
        self.batches: list[int] = []

    def get_inputs(self) -> Sequence[Any]:
        return [SimpleNamespace(name="images")]

    def run(self, wanted: object, feeds: dict[str, NDArray[np.float32]]) -> list[NDArray[np.float32]]:
        (batch,) = feeds.values()
        self.batches.append(len(batch))
        return [self.answer(batch)]


def weights(card: ModelCard, answer: Answer) -> Weights:
    """Weights of a network with these outputs."""
    return Weights(Path("fake.onnx"), card, FakeSession(answer))  # type: ignore[arg-type]


def blobs(batch: NDArray[np.float32]) -> NDArray[np.float32]:
    """Outputs of a YOLO that detects one solid blob an image: a box around it with score 0.9.

    Its grey is its kind: 1.0 is a square, 0.9 a rectangle, and so on. A second location has the same with score 0.4.
    """
    output = np.zeros((len(batch), 4 + len(KINDS), 2), np.float32)
    for i, image in enumerate(batch[:, 0]):
        rows, cols = np.nonzero(image > 0.55)
        if len(rows):
            x0, y0, x1, y1 = cols.min(), rows.min(), cols.max() + 1, rows.max() + 1
            box = ((x0 + x1) / 2, (y0 + y1) / 2, x1 - x0, y1 - y0)
            kind = round((1 - float(image[rows[0], cols[0]])) * 10)
            for location, score in enumerate((0.9, 0.4)):
                output[i, :4, location] = box
                output[i, 4 + kind, location] = score
    return output


def constant(preset: str, kinds: Sequence[str], outputs: Sequence[float]) -> Weights:
    """A parameter network with the same outputs for any crop."""
    return weights(
        ModelCard("cnn", "det", tuple(kinds), preset, 1), lambda batch: np.tile(np.float32(outputs), (len(batch), 1))
    )
