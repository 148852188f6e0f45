"""Training: YOLOv5 through ultralytics, and the networks of detect.training.model; checkpoints, resumable.

Needs the extra ``[train]`` (torch, ultralytics). Nothing that replays imports this.
"""

from __future__ import annotations

import json
import os
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass, replace
from hashlib import sha256
from pathlib import Path
from typing import Any

import numpy as np
import torch

from detect.networks.parameters import PAPER, PRESETS, PRIM, targets
from detect.training.crops import Crops, gather
from detect.training.dataset import read_image, samples, style_of
from detect.training.export import reopen_cnn, reopen_yolo
from detect.training.model import ParameterNetwork
from prim.errors import UsageError
from prim.shapes import Kind, Primitive

HUBER = 0.1
LENGTH_WEIGHT = 10.0

FINISHED = "finished"
"""A file of this name says that a run of YOLO's training has come to its end."""

Progress = Callable[[int, int, float, float], None]
"""Told after each epoch: epochs done, epochs in all, loss on the training and on the validation split."""


@dataclass(frozen=True)
class CnnOptions:
    """How a network is trained: from nothing, or from another's checkpoint. Raises UsageError on what cannot be."""

    preset: str = PRIM.name
    epochs: int = 30
    batch: int = 128
    learning_rate: float = 0.001
    channels: int = 1
    vary: bool = True
    seed: int = 0
    start: Path | None = None

    def __post_init__(self) -> None:
        if self.preset not in PRESETS:
            raise UsageError(f"there is no preset {self.preset!r}: choose from {', '.join(PRESETS)}")
        if self.epochs < 1 or self.batch < 1 or not self.learning_rate > 0:
            raise UsageError("epochs, batch and learning rate must be above 0")
        if self.channels not in (1, 3):
            raise UsageError(f"{self.channels} channels: grey has 1, the paper's images 3")


CNN_PRESETS = {
    PRIM.name: CnnOptions(),
    "more": CnnOptions(epochs=10, learning_rate=0.0005),
    PAPER.name: CnnOptions(PAPER.name, epochs=20, vary=False),
}
"""Ours, from nothing and on from there with more sessions; the paper's (IV-B: 20 epochs, batch 128, Adam, learning
rate 0.001, the crops as they are)."""


def networks_of(preset: str, kinds: Sequence[Kind]) -> list[tuple[Kind, ...]]:
    """The kinds of each network that a preset trains: the paper's one each, ours one for all."""
    return [(kind,) for kind in kinds] if preset == PAPER.name else [tuple(kinds)]


def checkpoint_name(mapper: str, kinds: Sequence[Kind]) -> str:
    """What the checkpoint of a network for some kinds is called."""
    return ".".join(["cnn", mapper, *([] if len(kinds) == len(Kind) else ["-".join(kinds)]), "pt"])


def train_cnn(
    data: Path,
    mapper: str,
    kinds: Sequence[Kind],
    output: Path,
    options: CnnOptions,
    progress: Progress | None = None,
) -> ParameterNetwork:
    """Trains a network for some kinds on a set; keeps a checkpoint at ``output`` after each epoch, goes on from one.

    Raises UsageError where the set holds no primitive of these kinds, or the checkpoint is one of other options.
    """
    torch.manual_seed(options.seed)
    training, validation = (gather(samples(data, mapper, split), kinds) for split in ("train", "val"))
    if not len(training):
        raise UsageError(f"{data} holds no {' or '.join(kinds)} to learn from")
    network = ParameterNetwork(kinds, PRESETS[options.preset], options.channels)
    if options.start is not None and options.start.suffix == ".onnx":
        few = [training.exact(i, network.preset) for i in range(min(len(training), options.batch))]
        reopen_cnn(options.start, network, as_input(few, network.channels))
    elif options.start is not None:
        network.load_state_dict(_weights_of(options.start, network))
    network.to(
        "cuda" if torch.cuda.is_available() else "cpu",
        memory_format=torch.channels_last,  # what convolutions on a CPU are three times faster with
    )
    optimizer = torch.optim.Adam(network.parameters(), lr=options.learning_rate)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimizer, options.epochs)
    asked = {
        "options": _plain(asdict(options)),
        "kinds": [kind.value for kind in kinds],
        "mapper": mapper,
        "style": style_of(data, mapper),
        "set": json.dumps(_manifest(data)),
    }
    first = _resume(output, asked, network, optimizer, schedule)
    for epoch in range(first, options.epochs):
        rng = np.random.default_rng((options.seed, epoch))
        loss = _epoch(network, optimizer, training, options, rng)
        if options.vary:
            schedule.step()
        _keep(output, asked, network, optimizer, schedule, epoch + 1)
        if progress:
            progress(epoch + 1, options.epochs, loss, evaluate_cnn(network, validation))
    return network.eval().cpu()


def _weights_of(checkpoint: Path, network: ParameterNetwork) -> Any:
    """Another network's weights. Raises UsageError where it is not of the same make; nothing in the file is run."""
    try:
        state = torch.load(checkpoint, weights_only=True, map_location="cpu")
        same = state["kinds"] == [kind.value for kind in network.kinds]
        if same and state["options"]["preset"] == network.preset.name:
            return state["network"]
    except Exception as error:  # torch raises many kinds on files that are none of its own
        raise UsageError(f"{checkpoint} is no checkpoint of prim-train cnn") from error
    raise UsageError(f"{checkpoint} is of a network for other kinds, or of another preset")


def _epoch(
    network: ParameterNetwork,
    optimizer: torch.optim.Optimizer,
    crops: Crops,
    options: CnnOptions,
    rng: np.random.Generator,
) -> float:
    """One pass over all crops in random order; returns the mean loss."""
    network.train()
    preset = network.preset
    order, total = rng.permutation(len(crops)), 0.0
    for begin in range(0, len(order), options.batch):
        chosen = order[begin : begin + options.batch]
        if len(chosen) < 2:  # batch normalisation needs two
            continue
        pairs = [crops.varied(i, preset, rng) if options.vary else crops.exact(i, preset) for i in chosen.tolist()]
        with fast_arithmetic():
            outputs = network(as_input(pairs, network.channels).to(network.device))
        loss = _loss(network, outputs.float(), [primitive for _, primitive in pairs])
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        total += float(loss.detach()) * len(chosen)
    return total / len(order)


def evaluate_cnn(network: ParameterNetwork, crops: Crops, batch: int = 256) -> float:
    """The mean loss over all crops at their true boxes; 0 where there are none."""
    network.eval()
    total = 0.0
    with torch.no_grad():
        for begin in range(0, len(crops), batch):
            pairs = [crops.exact(i, network.preset) for i in range(begin, min(begin + batch, len(crops)))]
            outputs = network(as_input(pairs, network.channels).to(network.device))
            total += float(_loss(network, outputs, [primitive for _, primitive in pairs])) * len(pairs)
    return total / max(len(crops), 1)


def _loss(network: ParameterNetwork, outputs: torch.Tensor, primitives: Sequence[Primitive]) -> torch.Tensor:
    """How far outputs (N, M) are from the primitives' own, each at its kind's outputs alone.

    The paper's preset: the mean squared error. Ours: Huber's, quadratic up to HUBER; sizes and offsets, whose unit is
    as large as the largest primitive, count LENGTH_WEIGHT times.
    """
    preset = network.preset
    wanted = np.zeros(tuple(outputs.shape), np.float32)
    weight = np.zeros_like(wanted)
    for row, primitive in enumerate(primitives):
        span = preset.span(network.kinds, primitive.kind)
        wanted[row, span] = targets(primitive, preset)
        weight[row, span] = 1.0 / preset.outputs(primitive.kind)
        if preset.vector:
            weight[row, span.start + preset.lengths(primitive.kind) : span.stop] *= LENGTH_WEIGHT
    goal = torch.from_numpy(wanted).to(outputs.device)
    if preset.vector:
        errors = torch.nn.functional.huber_loss(outputs, goal, reduction="none", delta=HUBER)
    else:
        errors = torch.nn.functional.mse_loss(outputs, goal, reduction="none")
    return (errors * torch.from_numpy(weight).to(outputs.device)).sum() / len(primitives)


def as_input(pairs: Sequence[tuple[Any, Any]], channels: int) -> torch.Tensor:
    """Crops as the network takes them: (N, channels, pixels, pixels) in 0 to 1."""
    grey = torch.from_numpy(np.stack([made for made, _ in pairs])).float().div_(255).unsqueeze(1)
    return grey.expand(-1, channels, -1, -1).contiguous(memory_format=torch.channels_last)


def _keep(output: Path, asked: dict[str, Any], network: Any, optimizer: Any, schedule: Any, epochs: int) -> None:
    """Writes a checkpoint; whole, or not at all."""
    part = output.with_suffix(".part")
    state = asked | {
        "epochs": epochs,
        "network": network.state_dict(),
        "optimizer": optimizer.state_dict(),
        "schedule": schedule.state_dict(),
    }
    torch.save(state, part)
    part.replace(output)


def _resume(output: Path, asked: dict[str, Any], network: Any, optimizer: Any, schedule: Any) -> int:
    """Takes over a checkpoint where there is one; returns how many epochs it has seen."""
    if not output.exists():
        return 0
    state = torch.load(output, weights_only=True, map_location="cpu")
    if {name: state.get(name) for name in asked} != asked:
        raise UsageError(f"{output} was trained on another set or with other options: give another file")
    network.load_state_dict(state["network"])
    optimizer.load_state_dict(state["optimizer"])
    schedule.load_state_dict(state["schedule"])
    return int(state["epochs"])


@dataclass(frozen=True)
class YoloOptions:
    """How YOLOv5 is trained: from its yaml, or from a user's weights (which can run code: say so with ``trust``)."""

    model: str = "yolov5n.yaml"
    start: Path | None = None
    trust: bool = False
    epochs: int = 24
    batch: int = 32
    image_size: int = 224
    optimizer: str = "AdamW"
    learning_rate: float = 0.002
    mosaic: bool = True
    turn: bool = True
    seed: int = 0

    def __post_init__(self) -> None:
        if self.start is not None and self.start.suffix != ".onnx" and not self.trust:
            raise UsageError(
                f"{self.start} is a pickle, which can run code: add --trust if you know where it is from"
            )


YOLO_PRESETS = {
    "prim": YoloOptions(),
    "more": YoloOptions(epochs=24, learning_rate=0.001),
    "paper": YoloOptions(epochs=32, image_size=224, optimizer="SGD", learning_rate=0.01, turn=False),
    "drawings": YoloOptions(epochs=3, mosaic=False, turn=False),
}
"""Ours, from drawings and on from there with more sessions; the paper's (IV-B: 32 epochs, batch 32, SGD, learning
rate 0.01); and one for detect.training.drawings, which vary by themselves."""


def train_yolo(data: Path, mapper: str, output: Path, options: YoloOptions) -> Path:
    """Trains YOLOv5 on a set and leaves its best weights in ``output``; goes on from an interrupted run there.

    Images are moved, scaled and mirrored, and put together in fours (``mosaic``), as YOLOv5's own settings have it;
    with ``turn`` they are turned by any angle as well; they are never coloured: a map has no colours to vary.

    Raises UsageError where the set is missing, or ``output`` holds a run of another set or other options.
    """
    config = data / f"{mapper}.yaml"
    if not config.exists():
        raise UsageError(f"{data} holds no set for {mapper}: make one with prim-train dataset")
    os.environ["YOLO_AUTOINSTALL"] = "false"
    from ultralytics import YOLO, settings

    settings.update({"sync": False})
    _claim(output, {"mapper": mapper, "set": _manifest(data), "options": _plain(asdict(options))})
    best, last = (output / "weights" / name for name in ("best.pt", "last.pt"))
    if options.start is not None and options.start.suffix == ".onnx":
        options = replace(options, start=_reopened(options.start, data, mapper, output / "start.pt"), trust=True)
    if not (output / FINISHED).exists():
        with fast_arithmetic():
            if not last.exists():
                _fit_yolo(YOLO(options.model), config, output, options)
            elif not _is_stripped(last):
                YOLO(str(last)).train(resume=True, trainer=_trainer())
        (output / FINISHED).touch()
    return best


def _reopened(start: Path, data: Path, mapper: str, output: Path) -> Path:
    """An ONNX file as weights to train on, its normalisations settled on images of the set."""
    if output.exists():
        return output
    few = [read_image(sample) for sample in samples(data, mapper, "train")[: YoloOptions.batch]]
    images = torch.from_numpy(np.stack(few)).permute(0, 3, 1, 2).float() / 255
    return reopen_yolo(start, images, output)


def _claim(output: Path, asked: dict[str, Any]) -> None:
    """Writes what a run was asked for beside it. Raises UsageError where it was asked for something else before."""
    path = output / "asked.json"
    text = json.dumps(asked, indent=1) + "\n"
    if path.exists() and path.read_text(encoding="utf-8") != text:
        raise UsageError(f"{output} was trained on another set or with other options: give another folder")
    output.mkdir(parents=True, exist_ok=True)
    path.write_text(text, encoding="utf-8")


def _manifest(data: Path) -> Any:
    return json.loads((data / "manifest.json").read_text(encoding="utf-8"))


def _plain(options: dict[str, Any]) -> dict[str, Any]:
    """Options as JSON holds them; weights to begin from by their content, wherever they lie."""
    start = options["start"]
    return options | {"start": start and sha256(Path(start).read_bytes()).hexdigest()}


def _is_stripped(checkpoint: Path) -> bool:
    """Whether a run has come to its end and lost what it could go on with; our own file, read as ultralytics does."""
    return int(torch.load(checkpoint, weights_only=False, map_location="cpu")["epoch"]) < 0


def _fit_yolo(model: Any, config: Path, output: Path, options: YoloOptions) -> None:
    """Runs ultralytics' training from the beginning."""
    turns = {"degrees": 180.0, "flipud": 0.5} if options.turn else {}
    model.train(
        trainer=_trainer(),
        workers=max(2, len(os.sched_getaffinity(0)) - 1),
        cache="ram",
        amp=False,  # on a GPU, ultralytics tries it out on weights that it downloads
        data=str(config),
        epochs=options.epochs,
        batch=options.batch,
        imgsz=options.image_size,
        optimizer=options.optimizer,
        lr0=options.learning_rate,
        seed=options.seed,
        deterministic=True,
        project=str(output.parent.resolve()),
        name=output.name,
        exist_ok=True,
        pretrained=str(options.start) if options.start else False,
        plots=False,
        verbose=False,
        hsv_h=0.0,
        hsv_s=0.0,
        hsv_v=0.0,
        mosaic=float(options.mosaic),
        close_mosaic=min(10, options.epochs // 3),
        **turns,
    )


def _trainer() -> type:
    """Ultralytics' trainer, with images and filters laid out channels last: convolutions on a CPU are faster so."""
    from ultralytics.models.yolo.detect import DetectionTrainer

    threads = int(os.environ.get("OMP_NUM_THREADS", len(os.sched_getaffinity(0))))

    class ChannelsLast(DetectionTrainer):
        def get_model(self, *args: Any, **options: Any) -> Any:
            return super().get_model(*args, **options).to(memory_format=torch.channels_last)

        def preprocess_batch(self, batch: Any) -> Any:
            torch.set_num_threads(threads)  # ultralytics leaves one core idle
            batch = super().preprocess_batch(batch)
            batch["img"] = batch["img"].contiguous(memory_format=torch.channels_last)
            return batch

    return ChannelsLast


@contextmanager
def fast_arithmetic() -> Iterator[None]:
    """Where the processor multiplies bfloat16 matrices itself (AMX), lets torch use it: twice as fast, as good."""
    able = getattr(torch.cpu, "_is_amx_tile_supported", lambda: False)()
    with torch.autocast("cpu", dtype=torch.bfloat16, enabled=bool(able)):
        yield
