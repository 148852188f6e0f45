"""Training of YOLOv5u with ultralytics and of the parameter networks (detect.training.model), with checkpoints.

Needs the extra ``[train]`` (torch, ultralytics); a replay does not import this.
"""

from __future__ import annotations

import io
import os
import re
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass, replace
from hashlib import sha256
from pathlib import Path
from typing import Any

import numpy as np
import torch

from detect.networks.parameters import PAPER, PRESETS, PRIM, encode_parameters
from detect.training.crops import CropSamples, collect_crops
from detect.training.dataset import data_description, hint_to_make_set, image_style, load_samples, read_image
from detect.training.export import import_cnn, import_yolo
from detect.training.model import ParameterNetwork
from detect.training.offline import load_ultralytics
from prim import strict_json
from prim.errors import UsageError
from prim.files import ResultFormat, output_errors, write_file
from prim.shapes import Kind, Primitive

HUBER_DELTA = 0.1
"""Huber's loss is quadratic up to this residual (units of the outputs); set by hand."""

LENGTH_WEIGHT = 10.0
"""Weight of sizes and offsets in the loss: their unit is as large as the largest primitive; set by hand."""

FINISHED_MARKER = "finished"
"""Name of the file that marks a finished run of YOLO's training."""

CHECKPOINT = ResultFormat("a checkpoint of prim-train", re.compile(rb"PK"))
"""torch writes archives; another training's checkpoint was refused before this one began."""

OF_THE_RUN = ResultFormat("a file of prim-train", re.compile(b""))
"""What lies in the folder of a run is its own: the folder is claimed first."""

TrainingProgress = Callable[[int, int, float, float], None]
"""Called after each epoch with the epochs done, all epochs, and the loss on the training and the validation split."""


@dataclass(frozen=True)
class CnnOptions:
    """Training of a parameter network; the fields are keys of checkpoints and model cards.

    Attributes:
        preset: Name of the encoding (networks.parameters.PRESETS).
        epochs: Passes over the data set.
        batch: Crops of one step.
        learning_rate: Of Adam, at first; decays by a cosine where crops are augmented.
        channels: Channels of the crops: 1, or 3 that are the same.
        vary: Whether crops are augmented.
        seed: Seed of the initial weights and of the augmentation.
        start: Checkpoint or exported network that training starts from; None: at random.

    Raises:
        UsageError: The options are impossible.
    """

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
    "open": CnnOptions(epochs=10, learning_rate=0.0003),
    PAPER.name: CnnOptions(PAPER.name, epochs=20, vary=False),
}
"""``prim`` trains from random weights (set by hand), ``more`` continues on more sessions, ``open`` on real
places; ``paper``: IV-B, 20 epochs, batch 128, Adam, learning rate 0.001, without augmentation."""


def network_kinds(preset: str, kinds: Sequence[Kind]) -> list[tuple[Kind, ...]]:
    """Return the kinds of each network of a preset: one for each in the paper's, one for all in the others.

    Args:
        preset: Name of the encoding (networks.parameters.PRESETS).
        kinds: All kinds.

    Returns:
        The kinds of each network.
    """
    return [(kind,) for kind in kinds] if preset == PAPER.name else [tuple(kinds)]


def checkpoint_name(mapper: str, kinds: Sequence[Kind]) -> str:
    """Return the file name of a network's checkpoint.

    Args:
        mapper: Name of the mapper whose maps it is trained on.
        kinds: Its kinds; they are part of the name where they are not all.

    Returns:
        The file name.
    """
    return ".".join(["cnn", mapper, *([] if len(kinds) == len(Kind) else ["-".join(kinds)]), "pt"])


def train_cnn(
    data: Path,
    mapper: str,
    kinds: Sequence[Kind],
    output: Path,
    options: CnnOptions,
    progress: TrainingProgress | None = None,
) -> ParameterNetwork:
    """Train a network, with a checkpoint after each epoch, or continue from the checkpoint of an interrupted run.

    Args:
        data: Folder of the data set.
        mapper: Name of the mapper whose images are used.
        kinds: The kinds, in the order of the outputs.
        output: The checkpoint's file.
        options: How it is trained.
        progress: Called after each epoch.

    Returns:
        The network, on the CPU, in evaluation mode.

    Raises:
        UsageError: The data set holds no primitive of these kinds, or the checkpoint has other options.
    """
    torch.manual_seed(options.seed)
    training, validation = (collect_crops(load_samples(data, mapper, split), kinds) for split in ("train", "val"))
    if not len(training):
        raise UsageError(f"{data} holds no {' or '.join(kinds)} to learn from")
    network = ParameterNetwork(kinds, PRESETS[options.preset], options.channels)
    if options.start is not None and options.start.suffix == ".onnx":
        first_batch = [training.plain(i, network.preset) for i in range(min(len(training), options.batch))]
        import_cnn(options.start, network, stack_crops(first_batch, network.channels))
    elif options.start is not None:
        network.load_state_dict(_checkpoint_weights(options.start, network))
    network.to(
        "cuda" if torch.cuda.is_available() else "cpu",
        memory_format=torch.channels_last,  # convolutions on a CPU are three times faster so
    )
    optimizer = torch.optim.Adam(network.parameters(), lr=options.learning_rate)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimizer, options.epochs)
    settings = {
        "options": _plain(asdict(options)),
        "kinds": [kind.value for kind in kinds],
        "mapper": mapper,
        "style": image_style(data, mapper),
        "set": strict_json.dumps(_manifest(data)),
    }
    first = _resume(output, settings, network, optimizer, schedule)
    for epoch in range(first, options.epochs):
        rng = np.random.default_rng((options.seed, epoch))
        loss = _train_epoch(network, optimizer, training, options, rng)
        if options.vary:
            schedule.step()
        _save_checkpoint(output, settings, network, optimizer, schedule, epoch + 1)
        if progress:
            progress(epoch + 1, options.epochs, loss, validation_loss(network, validation))
    return network.eval().cpu()


def _checkpoint_weights(checkpoint: Path, network: ParameterNetwork) -> Any:
    """Return another network's weights; raise UsageError where kinds or preset differ. Nothing in it is executed."""
    try:
        state = torch.load(checkpoint, weights_only=True, map_location="cpu")
        same = state["kinds"] == [kind.value for kind in network.kinds]
        if same and state["options"]["preset"] == network.preset.name:
            return state["network"]
    except Exception as error:  # torch raises exceptions of many types on foreign files
        raise UsageError(f"{checkpoint} is no checkpoint of prim-train cnn") from error
    raise UsageError(f"{checkpoint} is of a network for other kinds, or of another preset")


def _train_epoch(
    network: ParameterNetwork,
    optimizer: torch.optim.Optimizer,
    crops: CropSamples,
    options: CnnOptions,
    rng: np.random.Generator,
) -> float:
    """Train on all crops once, in random order; return the mean loss."""
    network.train()
    preset = network.preset
    order, total = rng.permutation(len(crops)), 0.0
    for begin in range(0, len(order), options.batch):
        chosen = order[begin : begin + options.batch]
        if len(chosen) < 2:  # batch normalisation needs at least two
            continue
        pairs = [crops.augmented(i, preset, rng) if options.vary else crops.plain(i, preset) for i in chosen.tolist()]
        with bfloat16_autocast():
            outputs = network(stack_crops(pairs, network.channels).to(network.device))
        loss = _loss(network, outputs.float(), [primitive for _, primitive in pairs])
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        total += float(loss.detach()) * len(chosen)
    return total / len(order)


def validation_loss(network: ParameterNetwork, crops: CropSamples, batch: int = 256) -> float:
    """Compute the mean loss over crops at their true boxes.

    Args:
        network: The network, which is set to evaluation mode.
        crops: The crops.
        batch: Crops of one step.

    Returns:
        The mean loss; 0 where there are no crops.
    """
    network.eval()
    total = 0.0
    with torch.no_grad():
        for begin in range(0, len(crops), batch):
            pairs = [crops.plain(i, network.preset) for i in range(begin, min(begin + batch, len(crops)))]
            outputs = network(stack_crops(pairs, network.channels).to(network.device))
            total += float(_loss(network, outputs, [primitive for _, primitive in pairs])) * len(pairs)
    return total / max(len(crops), 1)


def _loss(network: ParameterNetwork, outputs: torch.Tensor, primitives: Sequence[Primitive]) -> torch.Tensor:
    """Compute the loss of outputs (N, M), each primitive's at the outputs of its kind alone.

    The mean squared error with the paper's preset; else Huber's loss, with lengths weighted by LENGTH_WEIGHT.
    """
    preset = network.preset
    target = np.zeros(tuple(outputs.shape), np.float32)
    weight = np.zeros_like(target)
    for row, primitive in enumerate(primitives):
        own = preset.output_slice(network.kinds, primitive.kind)
        target[row, own] = encode_parameters(primitive, preset)
        weight[row, own] = 1.0 / preset.output_count(primitive.kind)
        if preset.angle_as_vector:
            weight[row, own.start + preset.first_length(primitive.kind) : own.stop] *= LENGTH_WEIGHT
    goal = torch.from_numpy(target).to(outputs.device)
    if preset.angle_as_vector:
        errors = torch.nn.functional.huber_loss(outputs, goal, reduction="none", delta=HUBER_DELTA)
    else:
        errors = torch.nn.functional.mse_loss(outputs, goal, reduction="none")
    return (errors * torch.from_numpy(weight).to(outputs.device)).sum() / len(primitives)


def stack_crops(samples: Sequence[tuple[Any, Any]], channels: int) -> torch.Tensor:
    """Stack crops into a network's input.

    Args:
        samples: Crops (pixels, pixels) with their primitives, which are not used.
        channels: How often each crop is repeated.

    Returns:
        (N, channels, pixels, pixels) in 0 to 1.
    """
    grey = torch.from_numpy(np.stack([crop for crop, _ in samples])).float().div_(255).unsqueeze(1)
    return grey.expand(-1, channels, -1, -1).contiguous(memory_format=torch.channels_last)


def _save_checkpoint(
    output: Path, settings: dict[str, Any], network: Any, optimizer: Any, schedule: Any, epochs: int
) -> None:
    """Write a checkpoint atomically."""
    state = settings | {
        "epochs": epochs,
        "network": network.state_dict(),
        "optimizer": optimizer.state_dict(),
        "schedule": schedule.state_dict(),
    }
    content = io.BytesIO()
    torch.save(state, content)
    write_file(output, content.getvalue(), CHECKPOINT)


def _resume(output: Path, settings: dict[str, Any], network: Any, optimizer: Any, schedule: Any) -> int:
    """Load a checkpoint where there is one; return how many epochs were trained."""
    if not output.exists():
        return 0
    try:
        state = torch.load(output, weights_only=True, map_location="cpu")
        same = {name: state.get(name) for name in settings} == settings
        if same:
            network.load_state_dict(state["network"])
            optimizer.load_state_dict(state["optimizer"])
            schedule.load_state_dict(state["schedule"])
            return int(state["epochs"])
    except Exception as error:  # torch raises exceptions of many types on foreign files
        raise UsageError(f"{output} is no checkpoint of prim-train cnn, or damaged: give another file") from error
    raise UsageError(f"{output} was trained on another set or with other options: give another file")


@dataclass(frozen=True)
class YoloOptions:
    """Training of YOLOv5u with ultralytics; the fields are keys of the run's ``asked.json``.

    Attributes:
        model: Architecture, a yaml of ultralytics.
        start: Weights or exported network that training starts from; None: at random.
        trust: Whether ``start`` and the checkpoint of an interrupted run may be loaded, which are pickles and can run
            code.
        epochs: Passes over the data set.
        batch: Images of one step.
        image_size: Side of the images (pixels).
        optimizer: Name of the optimiser.
        learning_rate: Its first learning rate.
        mosaic: Whether images are put together in fours.
        turn: Whether images are rotated by any angle and flipped upside down.
        seed: Seed of weights and augmentation.

    Raises:
        UsageError: ``start`` is a pickle that is not trusted.
    """

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
    "open": YoloOptions(epochs=10, learning_rate=0.0005),
    "paper": YoloOptions(epochs=32, image_size=224, optimizer="SGD", learning_rate=0.01, turn=False),
    "drawings": YoloOptions(epochs=3, mosaic=False, turn=False),
}
"""``prim`` trains from drawings (set by hand), ``more`` continues on more sessions, ``open`` on real
places; ``paper``: IV-B, 32 epochs, batch 32, SGD, learning rate 0.01; ``drawings`` is for detect.training.drawings,
which vary enough without augmentation."""


def train_yolo(data: Path, mapper: str, output: Path, options: YoloOptions) -> Path:
    """Train YOLOv5u, or continue an interrupted run.

    Images are translated, scaled and flipped by ultralytics' defaults, with ``mosaic`` and ``turn`` on request;
    colours are not augmented, since a map's channels are no colours.

    Args:
        data: Folder of the data set.
        mapper: Name of the mapper whose images are used.
        output: Folder of the run.
        options: How it is trained.

    Returns:
        The best weights, in ``output``.

    Raises:
        UsageError: The data set is missing, ``output`` holds a run with other data or options, or one that was
            interrupted and is not trusted.
    """
    if not (data / f"{mapper}.yaml").exists():
        raise UsageError(f"{data} holds no set for {mapper}: {hint_to_make_set(data, mapper)}")
    _claim_folder(output, {"mapper": mapper, "set": _manifest(data), "options": _plain(asdict(options))})
    best, last = (output / "weights" / name for name in ("best.pt", "last.pt"))
    if (output / FINISHED_MARKER).exists():
        return best
    if last.exists() and not options.trust:
        raise UsageError(
            f"{last} is a pickle, which can run code: add --trust to continue this run if you know where it is from"
        )
    with bfloat16_autocast():
        if not last.exists():
            _start_training(data, mapper, output, options)
        elif not _is_stripped(last):
            load_ultralytics().YOLO(str(last)).train(resume=True, trainer=_trainer())
    (output / FINISHED_MARKER).touch()
    return best


def _imported(start: Path, data: Path, mapper: str, output: Path) -> Path:
    """Convert an exported network to weights to train, with statistics of normalisations from the data set.

    What an interrupted run left in ``output`` is made again, since it would be unpickled.
    """
    first_batch = [read_image(sample) for sample in load_samples(data, mapper, "train")[: YoloOptions.batch]]
    images = torch.from_numpy(np.stack(first_batch)).permute(0, 3, 1, 2).float() / 255
    return import_yolo(start, images, output)


def _claim_folder(output: Path, settings: dict[str, Any]) -> None:
    """Write a run's settings into its folder; raise UsageError where it holds a run with others."""
    path = output / "asked.json"
    del settings["options"]["trust"]
    text = strict_json.dumps(settings, indent=1) + "\n"
    if path.exists():
        earlier = _read_json(path)
        if isinstance(earlier, dict) and isinstance(earlier.get("options"), dict):
            earlier["options"].pop("trust", None)
        if earlier != strict_json.loads(text):
            raise UsageError(f"{output} was trained on another set or with other options: give another folder")
    with output_errors(output):
        output.mkdir(parents=True, exist_ok=True)
    write_file(path, text.encode(), OF_THE_RUN)


def _manifest(data: Path) -> Any:
    return _read_json(data / "manifest.json")


def _read_json(path: Path) -> Any:
    """Read a file of a data set or of a run; raise UsageError where it cannot be read."""
    try:
        return strict_json.loads(path.read_bytes())
    except (OSError, ValueError) as error:
        raise UsageError(f"{path} is damaged or cannot be read: give another folder") from error


def _plain(options: dict[str, Any]) -> dict[str, Any]:
    """Return options as JSON values; the weights to start from as a hash of their content."""
    start = options["start"]
    return options | {"start": start and sha256(Path(start).read_bytes()).hexdigest()}


def _is_stripped(checkpoint: Path) -> bool:
    """Return whether a run ended and its checkpoint was stripped of the optimiser; the file is trusted."""
    load_ultralytics()  # whose classes the pickle holds
    try:
        return int(torch.load(checkpoint, weights_only=False, map_location="cpu")["epoch"]) < 0
    except Exception as error:  # torch raises exceptions of many types on foreign files
        raise UsageError(f"{checkpoint} is no checkpoint of prim-train yolo: give another folder") from error


def _start_training(data: Path, mapper: str, output: Path, options: YoloOptions) -> None:
    """Start ultralytics' training.

    It gets a data description of the run's own: that of a data set may hold a script, which ultralytics would run.
    """
    if options.start is not None and options.start.suffix == ".onnx":
        options = replace(options, start=_imported(options.start, data, mapper, output / "start.pt"), trust=True)
    description = output / "data.yaml"
    write_file(description, data_description(data, mapper).encode(), OF_THE_RUN)
    turns = {"degrees": 180.0, "flipud": 0.5} if options.turn else {}
    load_ultralytics().YOLO(options.model).train(
        trainer=_trainer(),
        workers=max(2, len(os.sched_getaffinity(0)) - 1),
        cache="ram",
        amp=False,  # on a GPU, ultralytics checks it with weights that it downloads
        data=str(description),
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
    """Return ultralytics' trainer with tensors in channels-last layout: convolutions on a CPU are faster so."""
    load_ultralytics()
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
def bfloat16_autocast() -> Iterator[None]:
    """Let torch compute in bfloat16 where the processor has AMX: twice as fast, no less accurate.

    Nothing is kept of weights that were converted: the context holds a whole training, in which they change.
    """
    supported = getattr(torch.cpu, "_is_amx_tile_supported", lambda: False)()
    with torch.autocast("cpu", dtype=torch.bfloat16, enabled=bool(supported), cache_enabled=False):
        yield
