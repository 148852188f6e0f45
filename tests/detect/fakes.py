"""Networks that give what a test wants, in the place of ONNX Runtime's."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from detect.networks.weights import Card, Weights
from detect.networks.yolo import KINDS

Answer = Callable[[NDArray[np.float32]], NDArray[np.float32]]


class Session:
    """Answers every batch with a function's arrays."""

    def __init__(self, answer: Answer) -> None:
        self.answer = answer
        self.batches: list[int] = []

    def get_inputs(self) -> Sequence[Any]:
        return [SimpleNamespace(name="images")]

    def run(self, wanted: object, feeds: dict[str, NDArray[np.float32]]) -> list[NDArray[np.float32]]:
        (batch,) = feeds.values()
        self.batches.append(len(batch))
        return [self.answer(batch)]


def weights(card: Card, answer: Answer) -> Weights:
    """Weights whose network answers so."""
    return Weights(Path("fake.onnx"), card, Session(answer))  # type: ignore[arg-type]


def blobs(batch: NDArray[np.float32]) -> NDArray[np.float32]:
    """A YOLO that knows only solid blobs: one anchor around what is white, of the kind its grey tells; score 0.9.

    A blob of grey 1.0 is a square, of 0.9 a rectangle, and so on. A second anchor is the same, scored 0.4.
    """
    output = np.zeros((len(batch), 4 + len(KINDS), 2), np.float32)
    for i, image in enumerate(batch[:, 0]):
        rows, cols = np.nonzero(image > 0.55)
        if len(rows):
            left, top, right, bottom = cols.min(), rows.min(), cols.max() + 1, rows.max() + 1
            box = ((left + right) / 2, (top + bottom) / 2, right - left, bottom - top)
            kind = round((1 - float(image[rows[0], cols[0]])) * 10)
            for anchor, score in enumerate((0.9, 0.4)):
                output[i, :4, anchor] = box
                output[i, 4 + kind, anchor] = score
    return output


def constant(preset: str, kinds: Sequence[str], outputs: Sequence[float]) -> Weights:
    """A network that reads the same outputs from any crop."""
    return weights(
        Card("cnn", "det", tuple(kinds), preset, 1), lambda batch: np.tile(np.float32(outputs), (len(batch), 1))
    )
