"""The paper's tables, measured again, as Markdown, CSV and plots."""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

from detect.evaluation.paper import ROWS, SHAPES, TABLE_1, TABLE_2, TESTED, Row
from detect.evaluation.suites import READINGS, Case, Measured, cases, write

Result = tuple[Case, dict[str, Any], dict[str, dict[str, Any]]]
"""A case, its evaluation, and its evaluations on maps with one kind alone."""

BOXES = {"f1": "F1", "map50": "mAP 0.5", "map50_95": "mAP 0.5–0.95", "auc": "AUC"}
"""Table I's measures."""

ERRORS = {"angle": "angle (°)", "width": "width (mm)", "height": "height (mm)"}
"""Table II's measures."""

MORE = ("median_angle", "clear_angle", "size")
"""What Table II does not have."""

UNITS = dict.fromkeys(("angle", "median_angle", "clear_angle"), math.degrees(1)) | dict.fromkeys(
    ("width", "height", "position"), 1e3
)

COLUMNS = (
    "reading", "mapper", "train_n", "test_n", "train_std_m", "test_std_m", "shape",
    *BOXES, "yolo_ms", *(f"true_box_{name}" for name in (*ERRORS, *MORE)), "parameters_ms",
    *(f"detected_{name}" for name in (*ERRORS, *MORE, "position")),
    *(f"paper_{name}" for name in (*BOXES, "yolo_ms", *ERRORS, "parameters_ms")),
)  # fmt: skip
"""The CSV's: angles in degrees, lengths in millimetres, sizes as shares."""


INTRODUCTION = f"""\
# The paper's tables, measured again

Made by `prim-eval --suite paper`; seeds and settings stand in `detect/evaluation/suites.py`. The paper's number
stands in brackets behind ours. 500 maps to train on, 125 others to test on, of 2 x 2 m with 0 to 2 of each shape.
YOLOv5n: 32 epochs, batch 32, SGD, learning rate 0.01; five CNNs: 20 epochs, batch 128, Adam, 0.001. The paper starts
YOLO from COCO's weights; these start from weights trained on drawings (`detect/training/drawings.py`). Maps of det
and prob are rounded to occupied, free and unknown, as the paper's; those of forward show their probabilities. F1 is
the largest over all confidences at box IoU 0.5; AUC is the area under precision and recall there; «all» is the mean
over the shapes. Errors are means over true boxes, angles modulo each shape's symmetry; «clear» are angles of shapes
whose sides differ by a tenth or more; widths and heights of «all» leave out circles, as the paper's means do. Times
are per image, one at a time (the paper's divided by its {TESTED} images)."""

ABSTRACT = """
The paper's abstract: 95 % of the shapes classified right at low noise, 85 % at high; sizes wrong by 5 to 12 %."""


def report(results: Sequence[Result], folder: Path) -> list[Path]:
    """Writes paper.md, paper.csv and paper.png; returns their paths. Raises OutputError where it cannot."""
    markdown, table, plot = (folder / f"paper.{ending}" for ending in ("md", "csv", "png"))
    folder.mkdir(parents=True, exist_ok=True)
    write(markdown, "\n".join(_markdown(results)) + "\n")
    write(table, _csv(results))
    _plot(results, plot)
    return [markdown, table, plot]


def _name(row: Row) -> str:
    return f"{row.mapper}, trained n = {row.train:g}, tested n = {row.test:g}"


def _paper(row: Row, shape: str) -> tuple[dict[str, float | None], dict[str, float | None]]:
    """The paper's own lines of both tables, times in ms an image; empty where it has none.

    A shape's time is its share of the whole, and means nothing here: it is left out.
    """
    if row not in ROWS:
        return {}, {}
    first, second = TABLE_1[row][SHAPES.index(shape)], TABLE_2[row][SHAPES.index(shape)]
    boxes: dict[str, float | None] = dict(
        zip((*BOXES, "yolo_ms"), (*first[:4], first[4] / TESTED * 1e3), strict=True)
    )
    time = second[3]
    assert time is not None
    errors = dict(zip((*ERRORS, "parameters_ms"), (*second[:3], time / TESTED * 1e3), strict=True))
    if shape != "all":
        del boxes["yolo_ms"], errors["parameters_ms"]
    return boxes, errors


def _shown(ours: float | None, paper: float | None, digits: int) -> str:
    """Ours, and the paper's in brackets."""
    text = "–" if ours is None else f"{ours:.{digits}f}"
    return text if paper is None else f"{text} ({paper:.{digits}f})"


def _in_units(errors: dict[str, Any] | None, name: str) -> float | None:
    value = None if errors is None else errors[name]
    return None if value is None else float(value) * UNITS.get(name, 1.0)


def _markdown(results: Sequence[Result]) -> Iterator[str]:
    """The report: what was done, the lines for all shapes, then each shape's."""
    yield from _introduction()
    missing = len(list(cases())) - len(results)
    if missing:
        yield f"\n**{missing} of {missing + len(results)} rows are not measured yet, and are left out.**"
    for reading in dict.fromkeys(case.reading for case, _, _ in results):
        own = [result for result in results if result[0].reading == reading]
        yield f"\n## Noise {reading}: n = 0.05 is {_std(own)} mm\n"
        yield from _boxes_table(own, ("all",))
        yield ""
        yield from _errors_table(own, ("all",))
        yield ""
        yield from _pipeline_table(own)
        yield f"\n### Each shape ({reading})\n"
        yield from _boxes_table(own, SHAPES[1:])
        yield ""
        yield from _errors_table(own, SHAPES[1:])
        if any(alone for _, _, alone in own):
            yield f"\n### Maps with one shape alone ({reading})\n"
            yield from _alone_table(own)


def _std(results: Sequence[Result]) -> int:
    """The standard deviation (mm) of n = 0.05 under a reading."""
    return round(50 * READINGS[results[0][0].reading])


def _introduction() -> Iterator[str]:
    yield INTRODUCTION


def _boxes_table(results: Sequence[Result], shapes: Sequence[str]) -> Iterator[str]:
    """Table I."""
    yield f"| Table I | shape | {' | '.join(BOXES.values())} | ms |"
    yield "|---|---|" + "---:|" * (len(BOXES) + 1)
    for case, found, _ in results:
        for shape in shapes:
            paper, _ = _paper(case.row, shape)
            ours = found["boxes"].get(shape, {})
            cells = [_shown(ours.get(name), paper.get(name), 3) for name in BOXES]
            time = _shown(found["yolo_time"] * 1e3, paper.get("yolo_ms"), 1) if shape == "all" else ""
            yield f"| {_name(case.row)} | {shape} | {' | '.join(cells)} | {time} |"


def _errors_table(results: Sequence[Result], shapes: Sequence[str]) -> Iterator[str]:
    """Table II, at true boxes."""
    yield f"| Table II | shape | {' | '.join(ERRORS.values())} | median angle (°) | clear angle (°) | ms |"
    yield "|---|---|" + "---:|" * (len(ERRORS) + 3)
    for case, found, _ in results:
        for shape in shapes:
            _, paper = _paper(case.row, shape)
            ours = found["true_boxes"].get(shape)
            cells = [_shown(_in_units(ours, name), paper.get(name), 1) for name in ERRORS]
            cells += [_shown(_in_units(ours, name), None, 1) for name in ("median_angle", "clear_angle")]
            time = _shown(found["parameters_time"] * 1e3, paper.get("parameters_ms"), 1) if shape == "all" else ""
            yield f"| {_name(case.row)} | {shape} | {' | '.join(cells)} | {time} |"


def _pipeline_table(results: Sequence[Result]) -> Iterator[str]:
    """The whole pipeline, and the abstract's claims."""
    yield "| whole pipeline | F1 (kind right, outline IoU 0.5) | kind right, of the boxes found | size error |" + (
        " angle (°) | width (mm) | height (mm) | position (mm) | ms |"
    )
    yield "|---|" + "---:|" * 8
    for case, found, _ in results:
        ours = found["detected"].get("all")
        size = "–" if ours is None else f"{100 * ours['size']:.0f} %"
        kind = "–" if found["kind_accuracy"] is None else f"{100 * found['kind_accuracy']:.0f} %"
        cells = [_shown(_in_units(ours, name), None, 1) for name in (*ERRORS, "position")]
        time = f"{found['whole_time'] * 1e3:.1f}"
        yield f"| {_name(case.row)} | {found['found'][2]:.3f} | {kind} | {size} | {' | '.join(cells)} | {time} |"
    yield ABSTRACT


def _alone_table(results: Sequence[Result]) -> Iterator[str]:
    """F1 and mAP on maps that hold one shape alone."""
    yield f"| F1 / mAP 0.5 | {' | '.join(SHAPES[1:])} |"
    yield "|---|" + "---:|" * len(SHAPES[1:])
    for case, _, alone in results:
        if alone:
            scores = [alone[shape]["boxes"][shape] for shape in SHAPES[1:]]
            cells = [f"{one['f1']:.3f} / {one['map50']:.3f}" for one in scores]
            yield f"| {_name(case.row)} | {' | '.join(cells)} |"


def _csv(results: Sequence[Result]) -> str:
    text = io.StringIO()
    writer = csv.DictWriter(text, COLUMNS, lineterminator="\n", extrasaction="raise")
    writer.writeheader()
    for case, found, _ in results:
        for shape in SHAPES:
            writer.writerow(_line(case, found, shape))
    return text.getvalue()


def _line(case: Case, found: dict[str, Any], shape: str) -> dict[str, object]:
    """A line of the CSV; what there is not is left out."""
    true, detected = found["true_boxes"].get(shape), found["detected"].get(shape)
    line: dict[str, object] = {
        "reading": case.reading, "mapper": case.row.mapper, "train_n": case.row.train, "test_n": case.row.test,
        "train_std_m": case.train_mm / 1e3, "test_std_m": case.test_mm / 1e3, "shape": shape,
    }  # fmt: skip
    if shape == "all":
        line |= {"yolo_ms": found["yolo_time"] * 1e3, "parameters_ms": found["parameters_time"] * 1e3}
    line |= {name: found["boxes"].get(shape, {}).get(name) for name in BOXES}
    line |= {f"true_box_{name}": _in_units(true, name) for name in (*ERRORS, *MORE)}
    line |= {f"detected_{name}": _in_units(detected, name) for name in (*ERRORS, *MORE, "position")}
    for paper in _paper(case.row, shape):
        line |= {
            f"paper_{name}": value for name, value in paper.items() if shape == "all" or not name.endswith("_ms")
        }
    return {name: f"{value:.5g}" if isinstance(value, float) else value for name, value in line.items()}


def _plot(results: Sequence[Result], path: Path) -> None:
    """MAP 0.5 and F1 over the tested noise, for each mapper and reading, with the paper's points."""
    from matplotlib.figure import Figure

    readings = list(dict.fromkeys(case.reading for case, _, _ in results))
    figure = Figure(figsize=(11, 3.4 * len(readings)), layout="constrained")
    axes = figure.subplots(len(readings), 2, squeeze=False, sharey=True)
    colours = {"det": "tab:orange", "prob": "tab:blue", "forward": "tab:green"}
    for line, reading in zip(axes, readings, strict=True):
        for axis, name in zip(line, ("map50", "f1"), strict=True):
            for mapper, colour in colours.items():
                own = [
                    (c, f) for c, f, _ in results if (c.reading, c.row.mapper, c.row.train) == (reading, mapper, 0.05)
                ]
                if not own:
                    continue
                at = [case.row.test for case, _ in own]
                axis.plot(at, [f["boxes"]["all"][name] for _, f in own], "o-", color=colour, label=mapper)
                paper = [_paper(case.row, "all")[0].get(name) for case, _ in own]
                if paper and None not in paper:
                    axis.plot(at, paper, "x:", color=colour, label=f"{mapper}, the paper's")
            axis.set(xlabel="noise n tested", ylabel=f"{BOXES[name]}, all shapes", ylim=(0, 1))
            axis.set_title(f"trained n = 0.05, noise {reading}", fontsize=10)
            axis.grid(alpha=0.3)
            if axis.get_legend_handles_labels()[0]:
                axis.legend(fontsize=7)
    figure.savefig(path, dpi=110)


SHIPPED = """\
# The shipped weights, measured

Made by `prim-eval --suite shipped`; seeds and ways of recording stand in `detect/evaluation/suites.py`: no
network was trained or chosen on these sessions. F1, mAP 0.5 and mAP 0.5–0.95 are of boxes, as in the paper's
tables: first of the networks alone (F1: the largest over all confidences), then of what a replay tells, refined
by the log's rays. There each primitive counts as every kind with the chance of that kind, what was fitted but
is not told with a tenth of it (of networks alone, too, mAP counts what scores below the thresholds), and F1 is
of what is told (kind right, outlines overlap by half). Errors are means over what is told and right, of angles
the median."""

SHIPPED_COLUMNS = (
    "networks_f1", "networks_map50", "networks_map50_95", "f1", "map50", "map50_95", "position_mm", "width_mm",
    "height_mm", "median_angle_deg",
)  # fmt: skip


def report_shipped(results: Sequence[Measured], folder: Path) -> list[Path]:
    """Writes shipped.md and shipped.csv; returns their paths. Raises OutputError where it cannot."""
    folder.mkdir(parents=True, exist_ok=True)
    markdown, table = folder / "shipped.md", folder / "shipped.csv"
    boxes = ("F1", "mAP 0.5", "0.5–0.95")
    names = [f"networks: {boxes[0]}", *boxes[1:], f"**refined**: {boxes[0]}", *boxes[1:]]
    names += ["place (mm)", "width (mm)", "height (mm)", "angle (°)"]
    lines = [SHIPPED, "", f"| recorded | noise (mm) | mapper | sessions | {' | '.join(names)} |"]
    lines.append("|---|---:|---|" + "---:|" * (1 + len(names)))
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(("recorded", "noise_std_m", "mapper", "sessions", *SHIPPED_COLUMNS))
    for condition, mapper, sessions, found in results:
        values = _shipped_values(found)
        cells = [_shown(value, None, 3 if k < 6 else 2) for k, value in enumerate(values)]
        lines.append(f"| {condition.name} | {condition.noise_mm} | {mapper} | {sessions} | {' | '.join(cells)} |")
        told = ("" if value is None else f"{value:.5g}" for value in values)
        writer.writerow((condition.name, condition.noise_mm / 1000, mapper, sessions, *told))
    write(markdown, "\n".join(lines) + "\n")
    write(table, text.getvalue())
    return [markdown, table]


def _shipped_values(found: dict[str, Any]) -> list[float | None]:
    """One row, in the order of SHIPPED_COLUMNS."""
    alone, refined = (found[name]["boxes"].get("all", {}) for name in ("networks", "refined"))
    errors = found["refined"]["errors"].get("all")
    told = [_in_units(errors, name) for name in ("position", "width", "height", "median_angle")]
    networks = [alone.get(name) for name in ("f1", "map50", "map50_95")]
    return [*networks, found["refined"]["found"][2], refined.get("map50"), refined.get("map50_95"), *told]
