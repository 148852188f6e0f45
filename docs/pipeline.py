"""The figure of the paper's pipeline at four noise levels (Fig. 5): python -m docs.pipeline SUITE docs/pipeline.png.

SUITE is the folder of ``prim-eval --suite paper``. Rows are mappers, columns noise levels under the reading «as the
maps suggest»: n = 0 with the networks that were trained without noise, the others with those trained at n = 0.05. The
world and the poses are the same everywhere. Detections are in colour with kind and score, true outlines in grey.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from bench.maps import session_of
from detect.detection import Detection
from detect.detector import Detector
from mapping.grid import OccupancyGrid
from mapping.mapper import MAPPERS, make_mapper
from prim.choices import MapperName
from prim.shapes import Primitive

NOISE = {0.0: "n = 0", 0.05: "n = 0.05", 0.075: "n = 0.075", 0.1: "n = 0.1"}
SCALE, GAP, LABEL = 2, 8, 20
TRUTH = (140, 140, 140)
SEED = 40_002

Picture = NDArray[np.uint8]
"""(rows, cols, 3), red first."""


def networks(suite: Path, mapper: str, noise_std: float) -> Detector:
    """Load the networks for a noise level; prob has none that were trained without noise.

    Args:
        suite: The suite's folder.
        mapper: Name of the mapper.
        noise_std: Standard deviation of the range noise (m).

    Returns:
        The detector.
    """
    trained = 0 if noise_std == 0 and mapper != MapperName.PROB else 50
    return Detector.load(suite / "networks" / f"{mapper}-{trained}", mapper)


def draw(grid: OccupancyGrid, found: tuple[Detection, ...], truth: tuple[Primitive, ...]) -> Picture:
    """Draw a map with detections and true outlines.

    Args:
        grid: The map.
        found: The detections.
        truth: The true primitives.

    Returns:
        The picture, the largest y at the top.
    """
    grey = np.flipud(np.rint(255 * (1 - grid.probability)).astype(np.uint8))
    enlarged = cv2.resize(grey, None, fx=SCALE, fy=SCALE, interpolation=cv2.INTER_NEAREST)
    picture = cv2.cvtColor(enlarged, cv2.COLOR_GRAY2RGB)

    def corners(primitive: Primitive) -> NDArray[np.int32]:
        cells = primitive.outline() / grid.frame.resolution - (grid.frame.col, grid.frame.row)
        return np.rint(SCALE * (cells * (1, -1) + (0, grid.frame.rows))).astype(np.int32)

    cv2.polylines(picture, [corners(primitive) for primitive in truth], True, TRUTH)
    for detection in found:
        ring, colour = corners(detection.primitive), detection.primitive.kind.row.color
        cv2.polylines(picture, [ring], True, colour, 2, cv2.LINE_AA)
        x, y = ring.min(axis=0).tolist()
        write(picture, f"{detection.primitive.kind} {detection.score:.2f}", (x, y - 4), colour)
    return picture


def write(picture: Picture, text: str, place: tuple[int, int], colour: tuple[int, int, int]) -> None:
    """Write into a picture.

    Args:
        picture: It is changed.
        text: What is written.
        place: Where it begins, on its base line: column and row.
        colour: Red, green, blue.
    """
    cv2.putText(picture, text, place, cv2.FONT_HERSHEY_SIMPLEX, 0.4, colour, lineType=cv2.LINE_AA)


def pictures(suite: Path) -> Picture:
    """Arrange the pictures of all mappers and noise levels side by side."""
    rows = []
    for mapper in MAPPERS:
        row = []
        for noise_std in NOISE:
            session = session_of(SEED, noise_std)
            session_mapper = make_mapper(mapper, 0.01, session.frame.bounds)
            for scan, pose in session.scans:
                session_mapper.update(scan, pose)
            grid = session_mapper.finish()
            found = networks(suite, mapper, noise_std).detect(grid).found
            row.append(draw(grid, found, session.primitives))
        rows.append(row)
    height, width = rows[0][0].shape[:2]
    shape = len(rows) * (height + LABEL + GAP) + GAP, len(NOISE) * (width + GAP) + GAP, 3
    sheet = np.full(shape, 255, np.uint8)
    for i, (mapper, row) in enumerate(zip(MAPPERS, rows, strict=True)):
        for j, (name, picture) in enumerate(zip(NOISE.values(), row, strict=True)):
            x, y = GAP + j * (width + GAP), GAP + i * (height + LABEL + GAP)
            write(sheet, f"{mapper}, {name}", (x, y + LABEL - 6), (0, 0, 0))
            sheet[y + LABEL : y + LABEL + height, x : x + width] = picture
    return sheet


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("suite", type=Path)
    parser.add_argument("picture", type=Path)
    options = parser.parse_args()
    sheet = cv2.cvtColor(pictures(options.suite), cv2.COLOR_RGB2BGR)
    cv2.imwrite(str(options.picture), sheet, [cv2.IMWRITE_PNG_COMPRESSION, 9])
