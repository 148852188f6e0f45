"""From a data set to a folder of weights: the steps shared by the paper's suite and the shipped weights.

FOLDER/yolo/  FOLDER/cnn.MAPPER[.KIND].pt     training, which an interrupted run continues
FOLDER/yolo.onnx  FOLDER/cnn*.onnx            the result: see detect.networks.weights.load_weight_set
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

from detect.networks.weights import DETECTOR_FILE, load_weights
from detect.networks.yolo import Yolo
from detect.training.dataset import DATASET_PRESETS, DatasetOptions, image_style, load_samples, make_dataset
from detect.training.drawings import DRAWINGS, DrawingOptions, make_drawings
from detect.training.thresholds import choose_thresholds
from prim.errors import UsageError
from prim.shapes import Kind

MIXED, LARGE, OPEN = (DATASET_PRESETS[name] for name in ("mixed", "large", "open"))
"""The data set that the first mapper's networks are trained on; and the two that each mapper's training is continued
on, one after the other."""

MIN_REPORTED_TIME = 5.0
"""Steps that take no longer (s) found their results there already and are not reported."""

FIRST_MAPPER = "forward"
"""The mapper whose networks are trained first: its maps hold most information."""

Announce = Callable[[str], None]
"""Called with lines of progress."""


@contextmanager
def announce_duration(step: str, announce: Announce) -> Iterator[None]:
    """Report how long a step took, unless it took no longer than MIN_REPORTED_TIME.

    Args:
        step: Name of the step.
        announce: Called with the report.

    Yields:
        Once, for the step to run.
    """
    began = time.monotonic()
    yield
    duration = time.monotonic() - began
    if duration > MIN_REPORTED_TIME:
        announce(f"{step}: {duration / 60:.1f} min")


def check_trusted(work: Path, trust: bool) -> None:
    """Check that a folder may be trained in: weights of YOLO that it holds from before would be loaded.

    Args:
        work: The folder.
        trust: Whether it is trusted.

    Raises:
        UsageError: It is not, and holds such weights.
    """
    found = next(work.glob("**/weights/*.pt"), None)
    if found is not None and not trust:
        raise UsageError(
            f"{found} is a pickle, which can run code: add --trust to continue in {work} if you know where it is from"
        )


def pretrain_yolo(work: Path, announce: Announce) -> Path:
    """Train YOLO on drawings, in place of COCO's weights.

    Args:
        work: Folder of the whole training; drawings and run are kept in it.
        announce: Called with lines of progress.

    Returns:
        The weights.
    """
    from detect.training.train import YOLO_PRESETS, train_yolo

    with announce_duration("drawings", announce):
        make_drawings(work / DRAWINGS, DrawingOptions())
    with announce_duration("YOLO on drawings", announce):
        options = replace(YOLO_PRESETS[DRAWINGS], trust=True)
        return train_yolo(work / DRAWINGS, DRAWINGS, work / "start", options)


def ensure_dataset(folder: Path, options: DatasetOptions, announce: Announce) -> Path:
    """Make what is missing of a data set.

    Args:
        folder: Its folder.
        options: Its contents.
        announce: Called with lines of progress.

    Returns:
        ``folder``.
    """
    with announce_duration(f"{folder.name}: {sum(options.sizes)} sessions", announce):
        make_dataset(folder, options)
    return folder


def train_weights(
    data: Path,
    mapper: str,
    folder: Path,
    preset: str,
    start: Path,
    announce: Announce,
    about: Mapping[str, Any] | None = None,
    cnn_start: Path | None = None,
) -> Path:
    """Train all networks on a data set and export them, with thresholds from its validation split.

    Args:
        data: Folder of the data set.
        mapper: Name of the mapper whose images are used.
        folder: Where the weights go; if they are there, nothing is done.
        preset: Name of the training presets (train.YOLO_PRESETS, train.CNN_PRESETS).
        start: Weights that YOLO's training starts from.
        announce: Called with lines of progress.
        about: Entries of the model cards' ``about``.
        cnn_start: Checkpoint that the training of the one parameter network starts from; None: at random.

    Returns:
        ``folder``.
    """
    if (folder / DETECTOR_FILE).exists():
        return folder
    from detect.training.export import export_cnn
    from detect.training.train import CNN_PRESETS, YOLO_PRESETS, checkpoint_name, network_kinds, train_cnn, train_yolo

    folder.mkdir(parents=True, exist_ok=True)
    with announce_duration(f"{folder.name}: YOLO", announce):
        options = replace(YOLO_PRESETS[preset], start=start, trust=True)
        best = train_yolo(data, mapper, folder / "yolo", options)
    for kinds in network_kinds(preset, list(Kind)):
        name = "cnn" if len(kinds) == len(Kind) else f"cnn.{'-'.join(kinds)}"
        checkpoint = folder / checkpoint_name(mapper, kinds)
        with announce_duration(f"{folder.name}: {name}", announce):
            train_cnn(data, mapper, kinds, checkpoint, replace(CNN_PRESETS[preset], start=cnn_start))
        export_cnn(checkpoint, mapper, folder / f"{name}.onnx", about)
    export_detector(best, mapper, data, folder / DETECTOR_FILE, True, about)
    return folder


def export_detector(
    weights: Path,
    mapper: str,
    data: Path,
    output: Path,
    trust: bool,
    about: Mapping[str, Any] | None = None,
    force: bool = False,
) -> None:
    """Export YOLO's weights with score thresholds, see :func:`detect.training.export.export_yolo`.

    Args:
        weights: Weights of ultralytics.
        mapper: Name of the mapper whose maps they were trained on.
        data: Folder of the data set that they were trained on; thresholds are chosen on its validation split.
        output: The ONNX file to write.
        trust: Whether ``weights``, a pickle, may be loaded.
        about: The model card's ``about``.
        force: Whether a file may be replaced that is no network of prim-train.

    Raises:
        OutputError: The file cannot be written.
        UsageError: ``weights`` are not trusted or not there; or another file is in the place of ``output``.
    """
    from detect.training.export import export_yolo, network_in_the_making

    with network_in_the_making(weights, output, force) as made:
        export_yolo(weights, mapper, made, trust, image_style(data, mapper), about)
        store_thresholds(made, data)


def store_thresholds(yolo: Path, data: Path) -> None:
    """Choose a YOLO's score thresholds and store them in its model card.

    Args:
        yolo: The network's ONNX file.
        data: Folder of a data set; its validation split is used.
    """
    from detect.training.export import write_card

    weights = load_weights(yolo, "yolo")
    chosen = choose_thresholds(Yolo(weights), load_samples(data, weights.card.mapper, "val"))
    write_card(yolo, replace(weights.card, thresholds=chosen))


def train_all(work: Path, mappers: Sequence[str], announce: Announce) -> Iterator[Path]:
    """Train the weights that come with prim.

    The networks of FIRST_MAPPER are trained from drawings; those of each mapper continue from these on more sessions,
    since all maps look alike, and then on real places.

    Args:
        work: Folder of data sets, training and weights.
        mappers: Names of the mappers.
        announce: Called with lines of progress.

    Yields:
        The folder of each mapper's weights.
    """
    start, mixed = pretrain_yolo(work, announce), ensure_dataset(work / "mixed", MIXED, announce)
    first = train_weights(mixed, FIRST_MAPPER, work / "first", "prim", start, announce, provenance(MIXED))
    yolo, cnn = first / "yolo" / "weights" / "best.pt", first / f"cnn.{FIRST_MAPPER}.pt"
    large = ensure_dataset(work / "large", LARGE, announce)
    places = ensure_dataset(work / "open", OPEN, announce)
    for mapper in mappers:
        more = train_weights(large, mapper, work / "more" / mapper, "more", yolo, announce, provenance(LARGE), cnn)
        best, checkpoint = more / "yolo" / "weights" / "best.pt", more / f"cnn.{mapper}.pt"
        folder = work / "weights" / mapper
        yield train_weights(places, mapper, folder, "open", best, announce, provenance(OPEN), checkpoint)


def provenance(options: DatasetOptions) -> dict[str, Any]:
    """Return a model card's entries about the data set that a network was trained on."""
    return {"sessions": options.sizes[0], "seed": options.seed, "noise_std_m": options.noise_stds}
