"""The figure of the paper's pipeline at four noise levels (Fig. 5): python -m docs.pipeline SUITE docs/pipeline.png.

SUITE is the folder of ``prim-eval --suite paper``. Rows are mappers, columns noise levels under the reading «as the
maps suggest»: n = 0 with the networks that were trained without noise, the others with those trained at n = 0.05. The
world and the poses are the same everywhere. Detections are in colour with kind and score, true outlines in grey.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np
from PIL import Image, ImageDraw

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


def draw(grid: OccupancyGrid, found: tuple[Detection, ...], truth: tuple[Primitive, ...]) -> Image.Image:
    """Draw a map with detections and true outlines.

    Args:
        grid: The map.
        found: The detections.
        truth: The true primitives.

    Returns:
        The picture, the largest y at the top.
    """
    grey = np.flipud(np.rint(255 * (1 - grid.probability)).astype(np.uint8))
    picture = Image.fromarray(np.repeat(np.repeat(grey, SCALE, 0), SCALE, 1)).convert("RGB")
    pen = ImageDraw.Draw(picture)

    def corners(primitive: Primitive) -> list[tuple[float, float]]:
        cells = primitive.outline() / grid.frame.resolution - (grid.frame.col, grid.frame.row)
        return [(SCALE * x, SCALE * (grid.frame.rows - y)) for x, y in cells.tolist()]

    for primitive in truth:
        ring = corners(primitive)
        for a, b in zip(ring, [*ring[1:], ring[0]], strict=True):
            pen.line((a, b), fill=TRUTH, width=1)
    for detection in found:
        ring, colour = corners(detection.primitive), detection.primitive.kind.row.color
        pen.line([*ring, ring[0]], fill=colour, width=2)
        x, y = min(x for x, _ in ring), min(y for _, y in ring)
        pen.text((x, y - 12), f"{detection.primitive.kind} {detection.score:.2f}", fill=colour)
    return picture


def pictures(suite: Path) -> Image.Image:
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
    width, height = rows[0][0].size
    sheet = Image.new("RGB", (len(NOISE) * (width + GAP) + GAP, len(rows) * (height + LABEL + GAP) + GAP), "white")
    pen = ImageDraw.Draw(sheet)
    for i, (mapper, row) in enumerate(zip(MAPPERS, rows, strict=True)):
        for j, (name, picture) in enumerate(zip(NOISE.values(), row, strict=True)):
            x, y = GAP + j * (width + GAP), GAP + i * (height + LABEL + GAP)
            pen.text((x, y + 4), f"{mapper}, {name}", fill="black")
            sheet.paste(picture, (x, y + LABEL))
    return sheet


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("suite", type=Path)
    parser.add_argument("picture", type=Path)
    options = parser.parse_args()
    pictures(options.suite).save(options.picture, optimize=True)
