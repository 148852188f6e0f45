"""The figure of all mappers' maps at four noise levels: python -m docs.pictures docs/maps.png [--seed 10].

Rows: det, prob, prob with the Gaussian sensor model and the true noise, forward. White is free, black occupied, grey
unknown. All columns have the same world and poses.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from bench.maps import probability, session_of
from mapping.mapper import make_mapper

NOISE = (0.0, 0.05, 0.25, 0.5)
ROWS = {"det": "det", "prob": "prob", "prob, Gaussian": "gaussian", "forward": "forward"}
GAP, LABEL = 6, 18


def maps(seed: int) -> list[list[NDArray[np.uint8]]]:
    """Return grey images, a row for each mapper and a column for each noise level; the largest y at the top."""
    sessions = [session_of(seed, noise_std) for noise_std in NOISE]
    rows = []
    for kind in ROWS.values():
        row = []
        for session, noise_std in zip(sessions, NOISE, strict=True):
            bounds = session.frame.bounds
            if kind == "gaussian":
                mapper = make_mapper("prob", 0.01, bounds, "gaussian", max(noise_std, 1e-3))
            else:
                mapper = make_mapper(kind, 0.01, bounds)
            row.append(np.flipud(np.rint(255 * (1 - probability(mapper, session))).astype(np.uint8)))
        rows.append(row)
    return rows


def draw(rows: list[list[NDArray[np.uint8]]]) -> NDArray[np.uint8]:
    """Arrange the maps side by side, with labels."""
    height, width = rows[0][0].shape
    shape = len(rows) * (height + LABEL + GAP) + GAP, len(NOISE) * (width + GAP) + GAP
    picture = np.full(shape, 215, np.uint8)
    for i, (name, row) in enumerate(zip(ROWS, rows, strict=True)):
        for j, (noise_std, image) in enumerate(zip(NOISE, row, strict=True)):
            x, y = GAP + j * (width + GAP), GAP + i * (height + LABEL + GAP)
            text = f"{name}, noise {noise_std * 1000:g} mm"
            cv2.putText(picture, text, (x, y + LABEL - 5), cv2.FONT_HERSHEY_SIMPLEX, 0.4, (0,), lineType=cv2.LINE_AA)
            picture[y + LABEL : y + LABEL + height, x : x + width] = image
    return picture


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("picture", type=Path)
    parser.add_argument("--seed", type=int, default=10)
    options = parser.parse_args()
    cv2.imwrite(str(options.picture), draw(maps(options.seed)), [cv2.IMWRITE_PNG_COMPRESSION, 9])
