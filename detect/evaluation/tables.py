"""Reports of the suites as Markdown, CSV and plots: the paper's tables reproduced, and the shipped weights'."""

from __future__ import annotations

import csv
import io
import math
import re
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from detect.evaluation.paper import ROWS, SHAPES, TABLE_1, TABLE_2, TEST_IMAGES, PaperRow
from detect.evaluation.suites import READINGS, Case, PaperResult, ShippedResult, cases
from detect.training.offline import use_temporary_folders
from prim.choices import MapperName
from prim.files import ResultFormat, check_output, output_errors, write_file

PAPER_REPORT = {
    "paper.md": ResultFormat("a report of prim-eval", re.compile(b"# The paper's tables, reproduced\n")),
    "paper.csv": ResultFormat("a table of prim-eval", re.compile(b"reading,mapper,train_n,")),
    "paper.png": ResultFormat("a plot of prim-eval", re.compile(rb"\x89PNG.{33}tEXtSoftware\0prim-eval", re.DOTALL)),
}
SHIPPED_REPORT = {
    "shipped.md": ResultFormat("a report of prim-eval", re.compile(b"# Evaluation of the shipped weights\n")),
    "shipped.csv": ResultFormat("a table of prim-eval", re.compile(b"recorded,noise_std_m,mapper,")),
}
"""Files of the reports, and what earlier ones are recognised by."""

BOX_METRICS = {"f1": "F1", "map50": "mAP 0.5", "map50_95": "mAP 0.5–0.95", "auc": "AUC"}
"""Columns of Table I: the fields of BoxMetrics and their titles."""

ERROR_METRICS = {"angle": "angle (°)", "width": "width (mm)", "height": "height (mm)"}
"""Columns of Table II: the fields of ParameterErrors and their titles."""

FURTHER_ERRORS = ("median_angle", "clear_angle", "size")
"""Fields of ParameterErrors that Table II does not have."""

UNITS = dict.fromkeys(("angle", "median_angle", "clear_angle"), math.degrees(1)) | dict.fromkeys(
    ("width", "height", "position"), 1e3
)
"""Factors from radians to degrees and from metres to millimetres."""

COLUMNS = (
    "reading", "mapper", "train_n", "test_n", "train_std_m", "test_std_m", "shape",
    *BOX_METRICS, "yolo_ms", *(f"true_box_{name}" for name in (*ERROR_METRICS, *FURTHER_ERRORS)), "parameters_ms",
    *(f"detected_{name}" for name in (*ERROR_METRICS, *FURTHER_ERRORS, "position")),
    *(f"paper_{name}" for name in (*BOX_METRICS, "yolo_ms", *ERROR_METRICS, "parameters_ms")),
)  # fmt: skip
"""Columns of paper.csv: angles in degrees, lengths in millimetres, sizes as shares."""

INTRODUCTION = f"""\
# The paper's tables, reproduced

Written by `prim-eval --suite paper`; seeds and settings are in `detect/evaluation/suites.py`. The paper's values are
in brackets after ours. Training set: 500 maps; test set: 125 others; each of 2 x 2 m with 0 to 2 primitives of each
shape. YOLOv5n as ultralytics builds it (YOLOv5u): 32 epochs, batch size 32, SGD, learning rate 0.01; five CNNs: 20
epochs, batch size 128, Adam, learning rate 0.001. The paper initialises YOLO with weights trained on COCO, these
networks with weights trained on synthetic drawings (`detect/training/drawings.py`). Maps of det and prob are rounded
to occupied, free and unknown, as in the paper; maps of forward keep their probabilities.

Table I: F1 is the maximum over all score thresholds, at a box IoU of 0.5; AUC is the area under the precision-recall
curve at that IoU; «all» is the mean over the shapes. Table II: mean absolute errors of the parameters estimated at
the true boxes; angles modulo each shape's symmetry; «clear angle» is the mean over shapes whose sides differ by 10 %
or more; width and height of «all» leave out circles, as in the paper. Times are per image, with batches of one (the
paper's are its totals over {TEST_IMAGES})."""

ABSTRACT = """
The paper's abstract: 95 % of the shapes correctly classified at low noise, 85 % at high noise; size errors of 5 to
12 %."""


def check_report(folder: Path, report: Mapping[str, ResultFormat], force: bool = False) -> None:
    """Make a report's folder where it is missing, and check that all of the report can be written there.

    Args:
        folder: The folder.
        report: PAPER_REPORT or SHIPPED_REPORT.
        force: Whether files may be replaced that are no earlier report.

    Raises:
        OutputError: A file cannot be written.
        UsageError: There is another file in the place of one.
    """
    with output_errors(folder):
        folder.mkdir(parents=True, exist_ok=True)
    for name, result in report.items():
        check_output(folder / name, result, force)


def _write_report(
    folder: Path, report: Mapping[str, ResultFormat], contents: Sequence[bytes], force: bool
) -> list[Path]:
    """Write the files of a report and return their paths."""
    check_report(folder, report, force)
    for (name, result), content in zip(report.items(), contents, strict=True):
        write_file(folder / name, content, result, force)
    return [folder / name for name in report]


def write_paper_report(results: Sequence[PaperResult], folder: Path, force: bool = False) -> list[Path]:
    """Write paper.md, paper.csv and paper.png.

    Args:
        results: Results of the paper's suite.
        folder: Where they go.
        force: Whether files may be replaced that are no earlier report.

    Returns:
        Their paths.

    Raises:
        OutputError: A file cannot be written.
        UsageError: There is another file in the place of one.
    """
    text = "\n".join(_markdown(results)) + "\n"
    return _write_report(folder, PAPER_REPORT, [text.encode(), _csv(results).encode(), _plot(results)], force)


def _row_title(row: PaperRow) -> str:
    return f"{row.mapper}, trained n = {row.train:g}, tested n = {row.test:g}"


def _paper_values(row: PaperRow, shape: str) -> tuple[dict[str, float | None], dict[str, float | None]]:
    """Return the paper's values in both tables, times in ms for one image; empty where it has none.

    The times of single shapes are shares of the whole and are left out.
    """
    if row not in ROWS:
        return {}, {}
    first, second = TABLE_1[row][SHAPES.index(shape)], TABLE_2[row][SHAPES.index(shape)]
    boxes: dict[str, float | None] = dict(
        zip((*BOX_METRICS, "yolo_ms"), (*first[:4], first[4] / TEST_IMAGES * 1e3), strict=True)
    )
    time = second[3]
    assert time is not None
    errors = dict(zip((*ERROR_METRICS, "parameters_ms"), (*second[:3], time / TEST_IMAGES * 1e3), strict=True))
    if shape != "all":
        del boxes["yolo_ms"], errors["parameters_ms"]
    return boxes, errors


def _cell(ours: float | None, paper: float | None, digits: int) -> str:
    """Return our value, with the paper's in brackets where there is one."""
    text = "–" if ours is None else f"{ours:.{digits}f}"
    return text if paper is None else f"{text} ({paper:.{digits}f})"


def _in_units(errors: dict[str, Any] | None, name: str) -> float | None:
    """Return an error in the unit of the tables; None where there is none."""
    value = None if errors is None else errors[name]
    return None if value is None else float(value) * UNITS.get(name, 1.0)


def _markdown(results: Sequence[PaperResult]) -> Iterator[str]:
    """Yield the lines of paper.md: introduction, rows over all shapes, rows of each shape."""
    yield INTRODUCTION
    missing = len(list(cases())) - len(results)
    if missing:
        yield f"\n**{missing} of {missing + len(results)} rows are not measured yet, and are left out.**"
    for reading in dict.fromkeys(case.reading for case, _, _ in results):
        own = [result for result in results if result[0].reading == reading]
        yield f"\n## Noise {reading}: n = 0.05 is {_noise_mm(own)} mm\n"
        yield from _boxes_table(own, ("all",))
        yield ""
        yield from _errors_table(own, ("all",))
        yield ""
        yield from _pipeline_table(own)
        yield f"\n### Each shape ({reading})\n"
        yield from _boxes_table(own, SHAPES[1:])
        yield ""
        yield from _errors_table(own, SHAPES[1:])
        if any(single for _, _, single in own):
            yield f"\n### Maps with one shape alone ({reading})\n"
            yield from _single_kind_table(own)


def _noise_mm(results: Sequence[PaperResult]) -> int:
    """Return the standard deviation (mm) of n = 0.05 under the results' reading."""
    return round(50 * READINGS[results[0][0].reading])


def _boxes_table(results: Sequence[PaperResult], shapes: Sequence[str]) -> Iterator[str]:
    """Yield Table I."""
    yield f"| Table I | shape | {' | '.join(BOX_METRICS.values())} | ms |"
    yield "|---|---|" + "---:|" * (len(BOX_METRICS) + 1)
    for case, found, _ in results:
        for shape in shapes:
            paper, _ = _paper_values(case.row, shape)
            ours = found["boxes"].get(shape, {})
            cells = [_cell(ours.get(name), paper.get(name), 3) for name in BOX_METRICS]
            time = _cell(found["yolo_time"] * 1e3, paper.get("yolo_ms"), 1) if shape == "all" else ""
            yield f"| {_row_title(case.row)} | {shape} | {' | '.join(cells)} | {time} |"


def _errors_table(results: Sequence[PaperResult], shapes: Sequence[str]) -> Iterator[str]:
    """Yield Table II, of parameters estimated at true boxes."""
    yield f"| Table II | shape | {' | '.join(ERROR_METRICS.values())} | median angle (°) | clear angle (°) | ms |"
    yield "|---|---|" + "---:|" * (len(ERROR_METRICS) + 3)
    for case, found, _ in results:
        for shape in shapes:
            _, paper = _paper_values(case.row, shape)
            ours = found["true_boxes"].get(shape)
            cells = [_cell(_in_units(ours, name), paper.get(name), 1) for name in ERROR_METRICS]
            cells += [_cell(_in_units(ours, name), None, 1) for name in ("median_angle", "clear_angle")]
            time = _cell(found["parameters_time"] * 1e3, paper.get("parameters_ms"), 1) if shape == "all" else ""
            yield f"| {_row_title(case.row)} | {shape} | {' | '.join(cells)} | {time} |"


def _pipeline_table(results: Sequence[PaperResult]) -> Iterator[str]:
    """Yield the results of the whole pipeline, with the claims of the paper's abstract."""
    yield "| whole pipeline | F1 (kind right, outline IoU 0.5) | kind right, of the boxes found | size error |" + (
        " angle (°) | width (mm) | height (mm) | position (mm) | ms |"
    )
    yield "|---|" + "---:|" * 8
    for case, found, _ in results:
        ours = found["detected"].get("all")
        size = "–" if ours is None else f"{100 * ours['size']:.0f} %"
        kind = "–" if found["kind_accuracy"] is None else f"{100 * found['kind_accuracy']:.0f} %"
        cells = [_cell(_in_units(ours, name), None, 1) for name in (*ERROR_METRICS, "position")]
        time = f"{found['whole_time'] * 1e3:.1f}"
        yield f"| {_row_title(case.row)} | {found['found'][2]:.3f} | {kind} | {size} | {' | '.join(cells)} | {time} |"
    yield ABSTRACT


def _single_kind_table(results: Sequence[PaperResult]) -> Iterator[str]:
    """Yield F1 and mAP on maps with one shape."""
    yield f"| F1 / mAP 0.5 | {' | '.join(SHAPES[1:])} |"
    yield "|---|" + "---:|" * len(SHAPES[1:])
    for case, _, single in results:
        if single:
            scores = [single[shape]["boxes"][shape] for shape in SHAPES[1:]]
            cells = [f"{row['f1']:.3f} / {row['map50']:.3f}" for row in scores]
            yield f"| {_row_title(case.row)} | {' | '.join(cells)} |"


def _csv(results: Sequence[PaperResult]) -> str:
    text = io.StringIO()
    writer = csv.DictWriter(text, COLUMNS, lineterminator="\n", extrasaction="raise")
    writer.writeheader()
    for case, found, _ in results:
        for shape in SHAPES:
            writer.writerow(_csv_row(case, found, shape))
    return text.getvalue()


def _csv_row(case: Case, found: dict[str, Any], shape: str) -> dict[str, object]:
    """Return a row of paper.csv; missing values are left out."""
    true, detected = found["true_boxes"].get(shape), found["detected"].get(shape)
    line: dict[str, object] = {
        "reading": case.reading, "mapper": case.row.mapper, "train_n": case.row.train, "test_n": case.row.test,
        "train_std_m": case.train_mm / 1e3, "test_std_m": case.test_mm / 1e3, "shape": shape,
    }  # fmt: skip
    if shape == "all":
        line |= {"yolo_ms": found["yolo_time"] * 1e3, "parameters_ms": found["parameters_time"] * 1e3}
    line |= {name: found["boxes"].get(shape, {}).get(name) for name in BOX_METRICS}
    line |= {f"true_box_{name}": _in_units(true, name) for name in (*ERROR_METRICS, *FURTHER_ERRORS)}
    line |= {f"detected_{name}": _in_units(detected, name) for name in (*ERROR_METRICS, *FURTHER_ERRORS, "position")}
    for paper in _paper_values(case.row, shape):
        line |= {
            f"paper_{name}": value for name, value in paper.items() if shape == "all" or not name.endswith("_ms")
        }
    return {name: f"{value:.5g}" if isinstance(value, float) else value for name, value in line.items()}


def _plot(results: Sequence[PaperResult]) -> bytes:
    """Plot mAP 0.5 and F1 over the noise of the tests, for each mapper and reading, with the paper's values (PNG)."""
    use_temporary_folders()
    from matplotlib.figure import Figure

    readings = list(dict.fromkeys(case.reading for case, _, _ in results))
    figure = Figure(figsize=(11, 3.4 * len(readings)), layout="constrained")
    axes = figure.subplots(len(readings), 2, squeeze=False, sharey=True)
    colours = dict(zip(MapperName, ("tab:orange", "tab:blue", "tab:green"), strict=True))
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
                paper = [_paper_values(case.row, "all")[0].get(name) for case, _ in own]
                if paper and None not in paper:
                    axis.plot(at, paper, "x:", color=colour, label=f"{mapper}, the paper's")
            axis.set(xlabel="noise n tested", ylabel=f"{BOX_METRICS[name]}, all shapes", ylim=(0, 1))
            axis.set_title(f"trained n = 0.05, noise {reading}", fontsize=10)
            axis.grid(alpha=0.3)
            if axis.get_legend_handles_labels()[0]:
                axis.legend(fontsize=7)
    content = io.BytesIO()
    figure.savefig(content, dpi=110, metadata={"Software": "prim-eval"})
    return content.getvalue()


SHIPPED_INTRODUCTION = """\
# Evaluation of the shipped weights

Written by `prim-eval --suite shipped`; seeds and modes of recording are those of `detect/evaluation/suites.py`: no
network was trained or selected on these sessions. F1, mAP 0.5 and mAP 0.5–0.95 of the networks alone are those of
boxes, as in the paper's tables (F1: the maximum over all score thresholds; mAP counts candidates below the detector's
thresholds too, by the protocol of YOLOv5's validation).

The columns after «refined» evaluate the primitives of a replay, refined with the log's rays. F1 is that of the
reported primitives (correct kind, polygon IoU of at least 0.5). mAP is the field's (COCO: precision interpolated at
101 recalls, mean over the kinds): the boxes around the outlines of the reported primitives, each with its kind and
score. Position (the distance of the centroids), width and height are mean errors over the true positives, the
angle's error is the median. A primitive that is reported as an object of no kind counts as not found. Rows of a
«closed world» (`--closed-world`) do without such objects: all that stands there is taken to be one of the kinds, or a
wall. «–»: not measured, or no true positive.

¹ Weighted mAP is a rule of our own, not to be compared with mAP elsewhere: each primitive counts as every kind with
that kind's posterior probability, and one that was fitted but rejected counts too, with a tenth of it."""

SHIPPED_COLUMNS = {
    "networks_f1": "networks: F1", "networks_map50": "mAP 0.5", "networks_map50_95": "0.5–0.95",
    "f1": "**refined**: F1", "map50": "mAP 0.5", "map50_95": "0.5–0.95",
    "weighted_map50": "weighted¹ 0.5", "weighted_map50_95": "0.5–0.95",
    "position_mm": "position (mm)", "width_mm": "width (mm)", "height_mm": "height (mm)",
    "median_angle_deg": "angle (°)",
}  # fmt: skip
"""Columns of shipped.csv, and their titles in shipped.md."""

SHIPPED_ERRORS = ("position_mm", "width_mm", "height_mm", "median_angle_deg")
"""Those that are errors; the others are shares."""


def write_shipped_report(results: Sequence[ShippedResult], folder: Path, force: bool = False) -> list[Path]:
    """Write shipped.md and shipped.csv.

    Args:
        results: Results of the shipped weights' suite.
        folder: Where they go.
        force: Whether files may be replaced that are no earlier report.

    Returns:
        Their paths.

    Raises:
        OutputError: A file cannot be written.
        UsageError: There is another file in the place of one.
    """
    titles = SHIPPED_COLUMNS.values()
    lines = [SHIPPED_INTRODUCTION, "", f"| recorded | noise (mm) | mapper | sessions | {' | '.join(titles)} |"]
    lines.append("|---|---:|---|" + "---:|" * (1 + len(titles)))
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(("recorded", "noise_std_m", "mapper", "sessions", *SHIPPED_COLUMNS))
    for condition, mapper, sessions, result in results:
        values = _shipped_values(result)
        cells = [_cell(value, None, 2 if name in SHIPPED_ERRORS else 3) for name, value in values.items()]
        lines.append(f"| {condition.title} | {condition.noise_mm} | {mapper} | {sessions} | {' | '.join(cells)} |")
        texts = ("" if value is None else f"{value:.5g}" for value in values.values())
        writer.writerow((condition.title, condition.noise_mm / 1000, mapper, sessions, *texts))
    markdown = "\n".join(lines) + "\n"
    return _write_report(folder, SHIPPED_REPORT, [markdown.encode(), text.getvalue().encode()], force)


def shipped_summary(results: Sequence[ShippedResult], mode: str, mapper: str) -> str:
    """Return a short table of one mode of recording and one mapper.

    Args:
        results: Results of the shipped weights' suite.
        mode: One of RecordingMode.
        mapper: Name of the mapper.

    Returns:
        A Markdown table with a row for each noise, of an open world; F1 of the networks is that of what they report,
        as of refinement.
    """
    chosen = ("map50", "map50_95", *SHIPPED_ERRORS)
    titles = ("noise", "sessions", "F1: networks", "**refined**", *(SHIPPED_COLUMNS[name] for name in chosen))
    lines = [f"| {' | '.join(titles)} |", "|---|" + "---:|" * (len(titles) - 1)]
    for condition, name, sessions, result in results:
        if (condition.title, name) == (mode, mapper):
            values = _shipped_values(result)
            cells = [f"{result[part]['found'][2]:.3f}" for part in ("networks", "refined")]
            cells += [_cell(values[key], None, 2 if key in SHIPPED_ERRORS else 3) for key in chosen]
            lines.append(f"| {condition.noise_mm} mm | {sessions} | {' | '.join(cells)} |")
    return "\n".join(lines)


def _shipped_values(result: dict[str, Any]) -> dict[str, float | None]:
    """Return the values of one row by the names of SHIPPED_COLUMNS; None: not measured, or no true positive."""
    networks, refined = result["networks"], result["refined"]
    errors = refined["errors"].get("all")
    alone, weighted = (part["boxes"].get("all", {}) for part in (networks, refined))
    reported = refined.get("reported", {}).get("all", {})
    return {
        "networks_f1": alone.get("f1"),
        "networks_map50": alone.get("map50"),
        "networks_map50_95": alone.get("map50_95"),
        "f1": refined["found"][2],
        "map50": reported.get("map50"),
        "map50_95": reported.get("map50_95"),
        "weighted_map50": weighted.get("map50"),
        "weighted_map50_95": weighted.get("map50_95"),
        "position_mm": _in_units(errors, "position"),
        "width_mm": _in_units(errors, "width"),
        "height_mm": _in_units(errors, "height"),
        "median_angle_deg": _in_units(errors, "median_angle"),
    }
