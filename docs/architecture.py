"""The picture of architecture.md, the files on the way of a scan and of a detection: python -m docs.architecture.

Writes docs/architecture.svg. A test holds each file and name of the picture against the code.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from html import escape
from pathlib import Path

PICTURE = Path(__file__).with_suffix(".svg")

BOX, GUTTER, MARGIN = 404, 92, 12
TOP, HEAD, LINE, GAP = 40, 30, 19, 34
"""Sizes in pixels; the whole is as wide as a README's column."""

SANS = "Helvetica, Arial, sans-serif"
MONO = "Menlo, Consolas, DejaVu Sans Mono, monospace"
INK, FAINT, EDGE, PAPER = "#1f2328", "#59636e", "#8c959f", "#ffffff"
GRID_COLOUR, RAYS_COLOUR, DETECTIONS_COLOUR = "#0072b2", "#d55e00", "#007a5a"


@dataclass(frozen=True)
class Stage:
    """One stage.

    Attributes:
        title: What it does.
        code: Its files, each with the name in it that does so.
        result: What it passes on.
    """

    title: str
    code: tuple[tuple[str, str], ...]
    result: str


SCAN = (
    Stage(
        "Open the log",
        (("prim/log/__init__.py", "open_log"), ("prim/log/mcap/reader.py", "McapReader")),
        "LogSource",
    ),
    Stage(
        "Select and decode scans",
        (("replay/scans/scan_log.py", "ScanLog"), ("prim/log/decoding/ros.py", "decode_scan")),
        "Scan: every range classified",
    ),
    Stage(
        "Find the laser's poses",
        (("replay/localization.py", "localize"), ("replay/poses/pose_provider.py", "PoseProvider")),
        "LaserPoses: a pose, a covariance for each scan",
    ),
    Stage(
        "Pose each scan, cut long sweeps",
        (("replay/scans/posed_scans.py", "PosedScans"), ("prim/scan.py", "deskew")),
        "PosedScan",
    ),
    Stage(
        "Map it: a branch for each mapper",
        (("replay/mapping/stage.py", "MappingStage"), ("mapping/mapper.py", "Mapper")),
        "OccupancyGrid",
    ),
    Stage(
        "Compare with the true map",
        (("mapping/reference_map.py", "ReferenceMap"), ("replay/replay_evaluator.py", "ReplayEvaluator")),
        "MapScores",
    ),
    Stage(
        "Show",
        (("replay/viewing/protocol.py", "Viewer"), ("replay/viewer.py", "RerunViewer")),
        "LOG.MAPPER.rrd",
    ),
)
DETECTION = (
    Stage(
        "Detect where it is due: cut tiles",
        (("replay/detection/stage.py", "DetectionStage"), ("detect/networks/tiles.py", "tile_image")),
        "images of 224 × 224 cells",
    ),
    Stage(
        "Find boxes and kinds",
        (("detect/detector.py", "Detector"), ("detect/networks/yolo.py", "Yolo")),
        "Boxes, suppressed within and across tiles",
    ),
    Stage(
        "Estimate position, angle, size",
        (("detect/networks/cnn.py", "ParameterEstimator"), ("prim/shapes.py", "Primitive")),
        "Detections, and Rejections with the reason",
    ),
    Stage(
        "Fit them to the rays, compare the kinds",
        (("replay/detection/refiner.py", "DetectionRefiner"), ("detect/refinement/refine.py", "refine_detections")),
        "Detections with std and chances",
    ),
    Stage(
        "Follow them over time",
        (("detect/tracker.py", "Tracker"), ("replay/detection/stage.py", "TrackIdentity")),
        "persistent ids",
    ),
    Stage(
        "Compare with the true primitives",
        (("prim/metrics.py", "detection_errors"), ("replay/detection/stage.py", "DetectionResult")),
        "DetectionResult",
    ),
    Stage(
        "Report",
        (("replay/result.py", "ReplayResult"), ("replay/outputs/report.py", "report_json")),
        "LOG.MAPPER.report.json",
    ),
)
PITCH = HEAD + 2 * LINE + GAP
RIGHT = MARGIN + BOX + GUTTER


def text(x: float, y: float, content: str, **style: object) -> str:
    """Return a line of text.

    Args:
        x: Where it is anchored (pixels).
        y: Its base line (pixels).
        content: The text.
        style: Attributes in SVG's names, with underscores.

    Returns:
        The element.
    """
    given = {"font_family": SANS, "font_size": 14, "fill": INK} | style
    attributes = " ".join(f'{name.replace("_", "-")}="{value}"' for name, value in given.items())
    return f'<text x="{x:g}" y="{y:g}" {attributes}>{escape(content)}</text>'


def arrow(points: Sequence[tuple[float, float]], colour: str = EDGE) -> str:
    """Return a line through points (pixels) with a head at its end."""
    path = " ".join(f"{x:g},{y:g}" for x, y in points)
    head = f"head-{colour.strip('#')}"
    return f'<polyline points="{path}" fill="none" stroke="{colour}" stroke-width="2" marker-end="url(#{head})"/>'


def heads() -> Iterator[str]:
    """Yield the heads of arrows in all colours."""
    for colour in (EDGE, GRID_COLOUR, RAYS_COLOUR, DETECTIONS_COLOUR):
        yield (
            f'<marker id="head-{colour.strip("#")}" viewBox="0 0 8 8" refX="7" refY="4" markerWidth="9" '
            f'markerHeight="9" markerUnits="userSpaceOnUse" orient="auto"><path d="M0,0 L8,4 L0,8 z" '
            f'fill="{colour}"/></marker>'
        )


def row(number: int) -> float:
    """Return the middle (pixels) of a row of boxes."""
    return TOP + number * PITCH + (PITCH - GAP) / 2


def column(x: float, heading: str, stages: Sequence[Stage]) -> Iterator[str]:
    """Yield the elements of a column.

    Args:
        x: Its left edge (pixels).
        heading: Its heading.
        stages: The stages from top to bottom.

    Yields:
        The elements.
    """
    yield text(x, TOP - 14, heading, font_size=17, font_weight="bold")
    for number, stage in enumerate(stages):
        y = TOP + number * PITCH
        yield (f'<rect x="{x}" y="{y}" width="{BOX}" height="{PITCH - GAP}" rx="6" fill="#f6f8fa" stroke="{EDGE}"/>')
        yield text(x + 10, y + 20, stage.title, font_weight="bold")
        for line, (file, name) in enumerate(stage.code):
            base = y + HEAD + 13 + line * LINE
            yield text(x + 10, base, file, font_family=MONO, font_size=12.5)
            yield text(x + BOX - 10, base, name, font_family=MONO, font_size=12.5, fill=FAINT, text_anchor="end")
        bottom, middle = y + PITCH - GAP, x + 26
        yield arrow([(middle, bottom), (middle, bottom + GAP - 1)])
        yield text(middle + 12, bottom + 21, stage.result, font_size=13, fill=FAINT)


def links() -> Iterator[str]:
    """Yield the arrows between the columns: the map that is searched, the rays, and the detections to show."""
    left, middle = MARGIN + BOX, MARGIN + BOX + GUTTER / 2
    yield arrow([(left, row(4)), (middle, row(4)), (middle, row(0)), (RIGHT - 1, row(0))], GRID_COLOUR)
    yield text(middle + 8, row(1) + 4, "map", font_size=13, fill=GRID_COLOUR)
    yield arrow([(left, row(3)), (RIGHT - 1, row(3))], RAYS_COLOUR)
    yield text(middle - 7, row(3) - 8, "rays", font_size=13, fill=RAYS_COLOUR, text_anchor="end")
    yield arrow([(RIGHT, row(5)), (middle, row(5)), (middle, row(6)), (left + 1, row(6))], DETECTIONS_COLOUR)
    yield text(middle + 5, (row(5) + row(6)) / 2 + 4, "shown", font_size=13, fill=DETECTIONS_COLOUR)


def picture() -> str:
    """Return the picture as SVG."""
    width, height = RIGHT + BOX + MARGIN, TOP + len(SCAN) * PITCH + 8
    elements = [
        *heads(),
        f'<rect width="{width}" height="{height}" fill="{PAPER}"/>',
        *column(MARGIN, "One scan, from the log to the viewer", SCAN),
        *column(RIGHT, "One detection, from the map to the report", DETECTION),
        *links(),
    ]
    size = f'width="{width}" height="{height}" viewBox="0 0 {width} {height}"'
    return "\n".join([f'<svg xmlns="http://www.w3.org/2000/svg" {size}>', *elements, "</svg>", ""])


if __name__ == "__main__":
    PICTURE.write_text(picture(), encoding="utf-8")
