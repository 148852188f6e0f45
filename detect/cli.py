"""Command lines of training and of evaluation: prim-train and prim-eval."""

from __future__ import annotations

import dataclasses
import math
import sys
from collections.abc import Sequence
from enum import StrEnum
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from detect.evaluation.modes import RecordingMode
from prim import __version__, console
from prim.choices import MapperName
from prim.errors import UsageError

if TYPE_CHECKING:
    from prim.shapes import Kind

ALL = "all"
"""Stands for all kinds."""

train = typer.Typer(add_completion=False, rich_markup_mode=None)


class ImageSource(StrEnum):
    """What YOLO is trained on: the maps of a mapper, or drawings."""

    DET = MapperName.DET.value
    PROB = MapperName.PROB.value
    FORWARD = MapperName.FORWARD.value
    DRAWINGS = "drawings"


class DatasetPreset(StrEnum):
    """Presets of data sets: keys of detect.training.dataset.DATASET_PRESETS."""

    PAPER = "paper"
    MIXED = "mixed"
    LARGE = "large"
    OPEN = "open"


class CnnPreset(StrEnum):
    """Presets of the parameter networks' training: keys of detect.training.train.CNN_PRESETS."""

    PRIM = "prim"
    PAPER = "paper"
    MORE = "more"
    OPEN = "open"


class YoloPreset(StrEnum):
    """Presets of YOLO's training: keys of detect.training.train.YOLO_PRESETS."""

    PRIM = "prim"
    PAPER = "paper"
    DRAWINGS = "drawings"
    MORE = "more"
    OPEN = "open"


def _show_version(wanted: bool) -> None:
    if wanted:
        typer.echo(f"prim-train {__version__}")
        raise typer.Exit


def _show_eval_version(wanted: bool) -> None:
    if wanted:
        typer.echo(f"prim-eval {__version__}")
        raise typer.Exit


@train.callback()
def _main(
    version: Annotated[
        bool, typer.Option("--version", callback=_show_version, is_eager=True, help="Print the version.")
    ] = False,
) -> None:
    """Make training sets and train the detector's networks on them."""


@train.command()
def dataset(
    folder: Annotated[
        Path, typer.Argument(metavar="FOLDER", help="The set's folder; an interrupted set is continued.")
    ],
    preset: Annotated[DatasetPreset, typer.Option(help="Defaults of all other options.")] = DatasetPreset.PAPER,
    maps: Annotated[
        tuple[int, int] | None, typer.Option(metavar="TRAIN VAL", help="Sessions to train on and to validate on.")
    ] = None,
    noise_std: Annotated[list[float] | None, typer.Option(metavar="M", help="Range noise, metres; repeat.")] = None,
    mapper: Annotated[list[MapperName] | None, typer.Option(help="A mapper; may be repeated. [default: all]")] = None,
    kind: Annotated[
        list[str] | None, typer.Option(metavar="KIND", help="A kind of primitive; may be repeated. [default: all]")
    ] = None,
    sizes: Annotated[
        tuple[float, float] | None,
        typer.Option(metavar="MIN MAX", help="Extents of primitives and clutter, metres, all scales alike."),
    ] = None,
    resolution: Annotated[
        list[float] | None, typer.Option(metavar="M", help="Side of a map's cells, metres; may be repeated.")
    ] = None,
    arena: Annotated[
        list[float] | None, typer.Option(metavar="M", help="Side of the square floor, metres; may be repeated.")
    ] = None,
    rays: Annotated[list[int] | None, typer.Option(metavar="N", help="Beams in a scan; may be repeated.")] = None,
    fov: Annotated[list[float] | None, typer.Option(metavar="DEG", help="Field of view; may be repeated.")] = None,
    range_max: Annotated[
        list[float] | None, typer.Option(metavar="M", help="Longest range, metres; may be repeated.")
    ] = None,
    clutter: Annotated[
        tuple[int, int] | None, typer.Option(metavar="FEWEST MOST", help="Things that are none of the kinds.")
    ] = None,
    room: Annotated[
        list[str] | None, typer.Option(metavar="NAME,...", help="As --room of prim-record; may be repeated.")
    ] = None,
    faulty: Annotated[
        float | None, typer.Option(metavar="SHARE", help="Share of the sessions whose scanner has faults.")
    ] = None,
    world: Annotated[
        list[Path] | None, typer.Option(metavar="WORLD.json", help="A world of your own; may be repeated.")
    ] = None,
    seed: Annotated[int | None, typer.Option(metavar="N", help="The first session's seed.")] = None,
    workers: Annotated[
        int | None, typer.Option(metavar="N", help="Worker processes. [default: one per core]", min=1)
    ] = None,
    quiet: Annotated[bool, typer.Option("--quiet", help="Print errors only.")] = False,
    debug: Annotated[bool, typer.Option("--debug", help="Show tracebacks.")] = False,
) -> int:
    """Record and map sessions to train on.

    Writes images of every mapper's maps, labels and exact primitives. An interrupted set is continued; the same
    options give the same set.
    """
    from detect.training.dataset import DATASET_PRESETS, make_dataset

    given: dict[str, Any] = {
        "sizes": maps,
        "noise_stds": tuple(noise_std) if noise_std else None,
        "mappers": tuple(name.value for name in mapper) if mapper else None,
        "kinds": tuple(chosen.value for chosen in parse_kinds(kind)) if kind else None,
        "seed": seed,
        "extents": sizes,
        "cells": tuple(resolution) if resolution else None,
        "floors": tuple(arena) if arena else None,
        "rays": tuple(rays) if rays else None,
        "fovs": tuple(math.radians(angle) for angle in fov) if fov else None,
        "range_maxes": tuple(range_max) if range_max else None,
        "clutter": clutter,
        "rooms": tuple(room) if room else None,
        "faulty": faulty,
        "worlds": tuple(str(path) for path in world) if world else None,
        "scales": (1.0,) if sizes or resolution or arena else None,
    }
    options = dataclasses.replace(
        DATASET_PRESETS[preset.value], **{name: value for name, value in given.items() if value is not None}
    )
    with console.progress_bar("sessions", quiet) as progress:
        made = make_dataset(folder, options, progress, workers)
    if not quiet:
        console.echo(
            f"made {made} of {sum(options.sizes)} sessions in {folder} ({sum(options.sizes) - made} were there)"
        )
    return 0


@train.command()
def drawings(
    folder: Annotated[
        Path, typer.Argument(metavar="FOLDER", help="The set's folder; an interrupted set is continued.")
    ],
    images: Annotated[
        tuple[int, int], typer.Option(metavar="TRAIN VAL", help="Drawings to train on and to validate on.")
    ] = (6000, 100),
    seed: Annotated[int, typer.Option(metavar="N", help="The first drawing's seed.")] = 900_000,
    quiet: Annotated[bool, typer.Option("--quiet", help="Print errors only.")] = False,
    debug: Annotated[bool, typer.Option("--debug", help="Show tracebacks.")] = False,
) -> int:
    """Draw synthetic outlines to pretrain on.

    They take the place of pretrained weights; no sensor is simulated.
    """
    from detect.training.drawings import DrawingOptions, make_drawings

    with console.progress_bar("drawings", quiet) as progress:
        made = make_drawings(folder, DrawingOptions(images, seed), progress)
    if not quiet:
        console.echo(f"made {made} of {sum(images)} drawings in {folder} ({sum(images) - made} were there)")
    return 0


@train.command()
def cnn(
    data: Annotated[Path, typer.Argument(metavar="SET", help="A set made by prim-train dataset.")],
    output: Annotated[
        Path, typer.Argument(metavar="FOLDER", help="The folder of checkpoints: cnn.MAPPER[.KIND].pt.")
    ],
    mapper: Annotated[MapperName, typer.Option(help="The mapper whose maps are trained on.")] = MapperName.FORWARD,
    kind: Annotated[str, typer.Option(metavar="KIND", help="The kind, or kinds, to train for.")] = ALL,
    preset: Annotated[
        CnnPreset, typer.Option(help="Settings: ours, the paper's, or further training of ours.")
    ] = CnnPreset.PRIM,
    epochs: Annotated[int | None, typer.Option(metavar="N", help="Training epochs. [default: the preset's]")] = None,
    start: Annotated[
        Path | None, typer.Option(metavar="W", help="Initial weights: a checkpoint, or an exported .onnx.")
    ] = None,
    seed: Annotated[int, typer.Option(metavar="N", help="Random seed of weights and augmentation.")] = 0,
    quiet: Annotated[bool, typer.Option("--quiet", help="Print errors only.")] = False,
    debug: Annotated[bool, typer.Option("--debug", help="Show tracebacks.")] = False,
) -> int:
    """Train the networks that estimate parameters.

    They estimate a primitive's position, angle and sizes from a crop of the map. An interrupted run is continued.
    Ours is one network for all kinds; the paper's are one for each kind.
    """
    require_training_extra()
    from detect.training.train import CNN_PRESETS, checkpoint_name, network_kinds, train_cnn
    from prim.shapes import Kind

    options = dataclasses.replace(CNN_PRESETS[preset.value], seed=seed, start=start)
    if epochs is not None:
        options = dataclasses.replace(options, epochs=epochs)
    groups = network_kinds(options.preset, parse_kinds([kind]))
    output.mkdir(parents=True, exist_ok=True)
    for kinds in groups:
        name = "cnn" if len(kinds) == len(Kind) else "-".join(kinds)

        def report_epoch(done: int, total: int, loss: float, validation: float, name: str = name) -> None:
            if not quiet:
                console.echo(f"{name}: epoch {done} of {total}, loss {loss:.5f}, validation {validation:.5f}")

        path = output / checkpoint_name(mapper.value, kinds)
        train_cnn(data, mapper.value, kinds, path, options, report_epoch)
    return 0


@train.command()
def yolo(
    data: Annotated[Path, typer.Argument(metavar="SET", help="A set made by prim-train dataset.")],
    output: Annotated[Path, typer.Argument(metavar="FOLDER", help="The output folder of ultralytics.")],
    mapper: Annotated[ImageSource, typer.Option(help="The mapper whose maps are trained on.")] = ImageSource.FORWARD,
    preset: Annotated[
        YoloPreset, typer.Option(help="Settings: ours, the paper's, those for drawings, or further training of ours.")
    ] = YoloPreset.PRIM,
    epochs: Annotated[int | None, typer.Option(metavar="N", help="Training epochs. [default: the preset's]")] = None,
    start: Annotated[
        Path | None, typer.Option(metavar="W", help="Initial weights: a .pt, or an exported .onnx.")
    ] = None,
    trust: Annotated[bool, typer.Option("--trust", help="Load a .pt, which is a pickle that can run code.")] = False,
    seed: Annotated[int, typer.Option(metavar="N", help="Random seed of weights and augmentation.")] = 0,
    debug: Annotated[bool, typer.Option("--debug", help="Show tracebacks.")] = False,
) -> int:
    """Train YOLOv5u to detect primitives.

    An interrupted run is continued with --trust: its checkpoint is a pickle.
    """
    require_training_extra()
    from detect.training.train import YOLO_PRESETS, train_yolo

    options = dataclasses.replace(YOLO_PRESETS[preset.value], seed=seed, start=start, trust=trust)
    if epochs is not None:
        options = dataclasses.replace(options, epochs=epochs)
    best = train_yolo(data, mapper.value, output, options)
    console.echo(f"wrote: {best}")
    return 0


class StageName(StrEnum):
    """Stages of the detector."""

    YOLO = "yolo"
    CNN = "cnn"


@train.command()
def export(
    weights: Annotated[
        Path, typer.Argument(metavar="W.pt", help="Weights trained by prim-train yolo or prim-train cnn.")
    ],
    output: Annotated[Path, typer.Argument(metavar="OUT.onnx", help="The file to write.")],
    stage: Annotated[StageName, typer.Option(help="The network that the weights are of.")],
    mapper: Annotated[
        MapperName, typer.Option(help="The mapper whose maps they were trained on.")
    ] = MapperName.FORWARD,
    data: Annotated[
        Path | None,
        typer.Option(
            "--set", metavar="SET", help="The set that YOLO was trained on, on which its thresholds are chosen."
        ),
    ] = None,
    trust: Annotated[
        bool, typer.Option("--trust", help="Load YOLO's .pt, which is a pickle that can run code.")
    ] = False,
    force: Annotated[bool, typer.Option("--force", help="Replace a file that is no network of prim-train.")] = False,
    debug: Annotated[bool, typer.Option("--debug", help="Show tracebacks.")] = False,
) -> int:
    """Export trained weights to ONNX, with a model card."""
    require_training_extra()
    from detect.training.export import export_cnn
    from detect.training.recipe import export_detector

    if stage is StageName.CNN:
        export_cnn(weights, mapper.value, output, force=force)
    else:
        if data is None:
            raise UsageError("YOLO's thresholds are chosen on the set it was trained on: name it with --set")
        export_detector(weights, mapper.value, data, output, trust, force=force)
    console.echo(f"wrote: {output}")
    return 0


@train.command(name="all")
def train_everything(
    work: Annotated[Path, typer.Argument(metavar="FOLDER", help="The folder of sets, training runs and weights.")],
    mapper: Annotated[list[MapperName] | None, typer.Option(help="A mapper; may be repeated. [default: all]")] = None,
    trust: Annotated[
        bool, typer.Option("--trust", help="Continue with the .pt in FOLDER, pickles that can run code.")
    ] = False,
    debug: Annotated[bool, typer.Option("--debug", help="Show tracebacks.")] = False,
) -> int:
    """Train weights like those that come with prim.

    Trains from scratch and writes FOLDER/weights/MAPPER. Takes hours and reports the duration of each part; an
    interrupted run is continued, with --trust where it holds checkpoints of YOLO, which are pickles.
    """
    require_training_extra()
    from detect.training.recipe import check_trusted, train_all

    check_trusted(work, trust)
    for folder in train_all(work, [name.value for name in mapper or list(MapperName)], console.echo):
        console.echo(f"made: {folder}")
    return 0


evaluation = typer.Typer(add_completion=False, rich_markup_mode=None)


class SuiteName(StrEnum):
    """Suites of the evaluation."""

    PAPER = "paper"
    SHIPPED = "shipped"


@evaluation.command()
def _evaluate(
    work: Annotated[Path, typer.Argument(metavar="FOLDER", help="The folder of sets, networks and results.")],
    suite: Annotated[SuiteName, typer.Option(help="What is evaluated.")] = SuiteName.PAPER,
    weights: Annotated[
        Path | None,
        typer.Option(
            metavar="FOLDER", help="Of --suite shipped: weights, one folder per mapper. [default: prim's own]"
        ),
    ] = None,
    so_far: Annotated[
        bool, typer.Option("--so-far", help="Report existing results; evaluate and train nothing.")
    ] = False,
    sessions: Annotated[int, typer.Option(metavar="N", help="Of --suite shipped: sessions per row.", min=1)] = 500,
    mapper: Annotated[
        list[MapperName] | None, typer.Option(help="Of --suite shipped: a mapper; may be repeated. [default: all]")
    ] = None,
    recorded: Annotated[
        list[RecordingMode] | None,
        typer.Option(help="Of --suite shipped: a recording mode; may be repeated. [default: all]"),
    ] = None,
    closed_world: Annotated[
        bool,
        typer.Option(
            "--closed-world",
            help="Of --suite shipped: take all to be one of the kinds, or a wall; in rows of its own.",
        ),
    ] = False,
    jobs: Annotated[
        int | None,
        typer.Option(metavar="N", help="Of --suite shipped: worker processes. [default: one per core]", min=1),
    ] = None,
    trust: Annotated[
        bool, typer.Option("--trust", help="Of --suite paper: continue with the .pt in FOLDER, which can run code.")
    ] = False,
    output: Annotated[
        Path | None, typer.Option(metavar="FOLDER", help="The report's folder. [default: report, in FOLDER]")
    ] = None,
    force: Annotated[
        bool, typer.Option("--force", help="Replace files in the report's folder that are no reports of prim-eval.")
    ] = False,
    quiet: Annotated[bool, typer.Option("--quiet", help="Print errors only.")] = False,
    debug: Annotated[bool, typer.Option("--debug", help="Show tracebacks.")] = False,
    version: Annotated[
        bool, typer.Option("--version", callback=_show_eval_version, is_eager=True, help="Print the version.")
    ] = False,
) -> int:
    """Evaluate the detector; the default suite takes hours.

    Missing sets are made, and an interrupted run is continued. paper: reproduces Tables I and II, with networks
    trained as in the paper, beside the paper's numbers; needs the extra [train], and --trust to continue a run;
    writes paper.md, paper.csv, paper.png. shipped: evaluates
    weights, without and with refinement, on fresh sessions (selected by --sessions, --mapper, --recorded and
    --closed-world; the report shows all existing results); writes shipped.md, shipped.csv.
    """

    def announce(text: str) -> None:
        if not quiet:
            console.echo(text)

    folder = output or work / "report"
    if suite is SuiteName.PAPER:
        given = {"--weights": weights, "--mapper": mapper, "--recorded": recorded, "--jobs": jobs}
        given["--closed-world"] = closed_world or None
        for name in (name for name, value in given.items() if value is not None):
            raise UsageError(f"{name} goes with --suite shipped")
        require_training_extra()
        from detect.evaluation.suites import PaperSuite
        from detect.evaluation.tables import PAPER_REPORT, check_report, write_paper_report
        from detect.training.recipe import check_trusted

        if not so_far:
            check_trusted(work, trust)
            check_report(folder, PAPER_REPORT, force)
        paper = PaperSuite(work, announce)
        written = write_paper_report(paper.results() if so_far else paper.run(), folder, force)
    else:
        from detect.evaluation.suites import ShippedSuite
        from detect.evaluation.tables import SHIPPED_REPORT, check_report, write_shipped_report
        from detect.networks.weights import SHIPPED

        if not so_far:
            check_report(folder, SHIPPED_REPORT, force)
        shipped = ShippedSuite(work, weights or SHIPPED, announce)
        mappers, modes = (
            [name.value for name in names] for names in (mapper or MapperName, recorded or RecordingMode)
        )
        results = shipped.results() if so_far else shipped.run(sessions, mappers, modes, jobs, closed_world)
        written = write_shipped_report(results, folder, force)
    for path in written:
        announce(f"wrote: {path}")
    return 0


def require_training_extra() -> None:
    """Check that the extra ``[train]`` is installed.

    Raises:
        UsageError: torch or ultralytics is missing.
    """
    missing = [name for name in ("torch", "ultralytics") if find_spec(name) is None]
    if missing:
        raise UsageError(f"training needs {' and '.join(missing)}: pip install -e '.[train]', where prim was cloned")


def parse_kinds(names: Sequence[str]) -> list[Kind]:
    """Return the named kinds in the table's order; all of them where one name is ``all``.

    Raises:
        UsageError: There is no kind of some name.
    """
    from prim.shapes import Kind

    known = [kind.value for kind in Kind]
    for name in names:
        if name not in (ALL, *known):
            raise UsageError(f"--kind {name}: there is no such kind; choose from {', '.join((ALL, *known))}")
    return [kind for kind in Kind if kind.value in names or ALL in names]


def main() -> None:
    """Run prim-train."""
    console.exit_process(console.run(train, "prim-train", sys.argv[1:]))


def main_eval() -> None:
    """Run prim-eval."""
    console.exit_process(console.run(evaluation, "prim-eval", sys.argv[1:]))
