"""From a set to a folder of weights: the steps that the paper's suite and the shipped weights share.

FOLDER/yolo/  FOLDER/cnn.MAPPER[.KIND].pt     training, which an interrupted run goes on with
FOLDER/yolo.onnx  FOLDER/cnn*.onnx            what it ends with: see detect.networks.weights.load_set
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

from detect.evaluation.evaluate import choose_thresholds
from detect.networks.weights import DETECTOR, load_weights
from detect.networks.yolo import Yolo
from detect.training.dataset import PRESETS, SetOptions, make, samples, style_of
from detect.training.drawings import NAME, DrawingOptions, make_drawings
from prim.shapes import Kind

MIXED, LARGE = PRESETS["mixed"], PRESETS["large"]
"""What the first mapper's networks are trained on; and what each mapper's go on with from there."""

WORTH_SAYING = 5.0
"""What takes no longer than this (s) was there already."""

FIRST = "forward"
"""The mapper whose networks are trained first: its maps show most."""

Say = Callable[[str], None]


@contextmanager
def timed(what: str, say: Say) -> Iterator[None]:
    """Says how long a part took, where it took a while."""
    began = time.monotonic()
    yield
    took = time.monotonic() - began
    if took > WORTH_SAYING:
        say(f"{what}: {took / 60:.1f} min")


def make_start(work: Path, say: Say) -> Path:
    """YOLO's weights after some epochs on drawings, where COCO's would stand: ``work/start``."""
    from detect.training.train import YOLO_PRESETS, train_yolo

    with timed("drawings", say):
        make_drawings(work / NAME, DrawingOptions())
    with timed("YOLO on drawings", say):
        return train_yolo(work / NAME, NAME, work / "start", YOLO_PRESETS[NAME])


def make_set(folder: Path, options: SetOptions, say: Say) -> Path:
    """A set in a folder of its own."""
    with timed(f"{folder.name}: {sum(options.sizes)} sessions", say):
        make(folder, options)
    return folder


def make_weights(
    data: Path,
    mapper: str,
    folder: Path,
    preset: str,
    start: Path,
    say: Say,
    about: Mapping[str, Any] | None = None,
    cnn_start: Path | None = None,
) -> Path:
    """Trains all networks on a set, with thresholds from its validation split; what is there is not made again.

    ``start`` is what YOLO begins from, ``cnn_start`` the checkpoint that our one CNN begins from, or None.
    """
    if (folder / DETECTOR).exists():
        return folder
    from detect.training.export import export_cnn, export_yolo
    from detect.training.train import CNN_PRESETS, YOLO_PRESETS, checkpoint_name, networks_of, train_cnn, train_yolo

    folder.mkdir(parents=True, exist_ok=True)
    style = style_of(data, mapper)
    with timed(f"{folder.name}: YOLO", say):
        options = replace(YOLO_PRESETS[preset], start=start, trust=True)
        best = train_yolo(data, mapper, folder / "yolo", options)
    for kinds in networks_of(preset, list(Kind)):
        name = "cnn" if len(kinds) == len(Kind) else f"cnn.{'-'.join(kinds)}"
        checkpoint = folder / checkpoint_name(mapper, kinds)
        with timed(f"{folder.name}: {name}", say):
            train_cnn(data, mapper, kinds, checkpoint, replace(CNN_PRESETS[preset], start=cnn_start))
        export_cnn(checkpoint, mapper, folder / f"{name}.onnx", about)
    part = folder / "yolo.part"
    export_yolo(best, mapper, part, True, style, about)
    put_thresholds(part, data)
    part.replace(folder / DETECTOR)
    return folder


def put_thresholds(yolo: Path, data: Path) -> None:
    """Chooses a YOLO's thresholds on a set's validation split and puts them into its card."""
    from detect.training.export import write_card

    weights = load_weights(yolo, "yolo")
    chosen = choose_thresholds(Yolo(weights), samples(data, weights.card.mapper, "val"))
    write_card(yolo, replace(weights.card, thresholds=chosen))


def make_all(work: Path, mappers: Sequence[str], say: Say) -> Iterator[Path]:
    """The weights that come with prim, each mapper's in a folder of its own.

    FIRST's networks begin from drawings; each mapper's go on from these with more sessions, as all maps look alike.
    """
    start, mixed = make_start(work, say), make_set(work / "mixed", MIXED, say)
    first = make_weights(mixed, FIRST, work / "first", "prim", start, say, origin(MIXED))
    yolo, cnn = first / "yolo" / "weights" / "best.pt", first / f"cnn.{FIRST}.pt"
    large = make_set(work / "large", LARGE, say)
    for mapper in mappers:
        yield make_weights(large, mapper, work / "weights" / mapper, "more", yolo, say, origin(LARGE), cnn)


def origin(options: SetOptions) -> dict[str, Any]:
    """What a card tells of the set that a network was trained on."""
    return {"sessions": options.sizes[0], "seed": options.seed, "noise_std_m": options.noise_stds}
