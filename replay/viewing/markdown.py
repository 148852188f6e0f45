"""The viewer's tables as Markdown text."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence

from detect.detection import OTHER
from prim.text import printable
from replay.detection.stage import DetectionResult
from replay.outputs.found_objects import found_objects
from replay.outputs.report import comparison_table, shared_rows, summary_rows
from replay.result import ReplayResult


def summary_markdown(results: Sequence[ReplayResult]) -> str:
    """Return the table that ends a replay; of several mappers, what they share and how they compare."""
    shared = summary_rows(results[0]) if len(results) == 1 else shared_rows(results)
    rows = "\n".join(f"| **{name}** | {printable(value)} |" for name, value in shared)
    text = f"| | |\n|---|---|\n{rows}\n"
    if len(results) == 1:
        return text
    names, units, *rows_of_mappers = comparison_table(results)
    header = [f"{name}, {unit}" if unit else name for name, unit in zip(names, units, strict=True)]
    lines = [header, ["---"] * len(header), *rows_of_mappers]
    return text + "\n" + "".join(f"| {' | '.join(line)} |\n" for line in lines)


def detections_markdown(result: DetectionResult) -> str:
    """Return a table of the detected primitives, and of the objects of no kind: millimetres and degrees."""
    lines = ["| id | kind | score | x, mm | y, mm | angle | size, mm | ± 1σ: mm, ° |", "|" + "---|" * 8]
    for identity, detection in zip(result.identities, result.detections.found, strict=True):
        primitive = detection.primitive
        cells = (
            str(identity.id),
            str(primitive.kind),
            f"{detection.score:.2f}",
            f"{1000 * primitive.x:.1f}",
            f"{1000 * primitive.y:.1f}",
            "" if primitive.theta is None else f"{math.degrees(primitive.theta):.1f}°",
            ", ".join(f"{_words(name)} {1000 * value:.1f}" for name, value in primitive.sizes.items()),
            _standard_deviations(detection.std or identity.std),
        )
        lines.append(f"| {' | '.join(cells)} |")
    return "\n".join([*lines, *_object_lines(result)]) + "\n"


def _object_lines(result: DetectionResult) -> Iterator[str]:
    """Yield the lines of a table of the objects of no kind, after an empty one; none where there are none."""
    objects = found_objects(result)
    if objects:
        yield ""
        yield "| id | kind | score | x, mm | y, mm | extent, mm | ± 1σ, mm | reason |"
        yield "|" + "---|" * 8
    for thing in objects:
        cells = (
            str(thing.id),
            OTHER,
            f"{thing.score:.2f}",
            f"{1000 * thing.x:.1f}",
            f"{1000 * thing.y:.1f}",
            " x ".join(f"{1000 * length:.0f}" for length in thing.extent),
            f"{1000 * thing.std:.2f}",
            printable(thing.reason),
        )
        yield f"| {' | '.join(cells)} |"


def _standard_deviations(std: Mapping[str, float] | None) -> str:
    """List standard deviations by name; empty where they are not known."""
    if std is None:
        return ""
    return ", ".join(
        f"angle {math.degrees(value):.2f}°" if name == "theta" else f"{_words(name)} {1000 * value:.2f}"
        for name, value in std.items()
    )


def _words(name: str) -> str:
    return name.replace("_", " ")
