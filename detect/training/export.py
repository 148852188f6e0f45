"""Trained networks as ONNX files with a model card, and back: such a file can be trained on. Needs ``[train]``.

An ONNX file holds each convolution with its normalisation folded in. To go on from one, the normalisations are put
back: from what they see of some images they get the mean and the deviation that leave the network as it is.
"""

from __future__ import annotations

import os
import shutil
import tempfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch

from detect.networks.parameters import PRESETS
from detect.networks.tiles import TILE
from detect.networks.weights import CARD_KEY, Card
from detect.training.model import ParameterNetwork
from prim.errors import UsageError
from prim.shapes import Kind

OPSET = 17

FIXED = ".dfl.conv"
"""The one convolution of YOLO that is never trained: it adds up what a box's sides may be."""

WORTH_HALVING = 256
"""Arrays of fewer numbers stay as they are: biases, and constants of the arithmetic."""


def export_cnn(checkpoint: Path, mapper: str, output: Path, about: Mapping[str, Any] | None = None) -> Card:
    """Makes an ONNX file of a checkpoint of ``prim-train cnn``; crops (N, channels, pixels, pixels), outputs (N, M).

    Raises UsageError on a file that is no such checkpoint, or one for another mapper's maps; nothing in it is run.
    """
    network, state = _read_checkpoint(checkpoint)
    if state["mapper"] != mapper:
        raise UsageError(f"{checkpoint} was trained on maps of {state['mapper']}, not of {mapper}")
    network.eval()
    pixels = network.preset.pixels
    kinds = tuple(kind.value for kind in network.kinds)
    told = {"options": state["options"]} | dict(about or {})
    card = Card("cnn", mapper, kinds, network.preset.name, network.channels, state["style"], about=told)
    torch.onnx.export(
        network,
        (torch.zeros(2, network.channels, pixels, pixels),),
        str(output),
        input_names=["crops"],
        output_names=["outputs"],
        dynamic_axes={"crops": {0: "n"}, "outputs": {0: "n"}},
        opset_version=OPSET,
        dynamo=False,
    )
    halve(output)
    write_card(output, card)
    return card


def _read_checkpoint(path: Path) -> tuple[ParameterNetwork, dict[str, Any]]:
    try:
        state: dict[str, Any] = torch.load(path, weights_only=True, map_location="cpu")
        options = state["options"]
        kinds = [Kind(kind) for kind in state["kinds"]]
        network = ParameterNetwork(kinds, PRESETS[options["preset"]], options["channels"])
        network.load_state_dict(state["network"])
        told = {name: state[name] for name in ("options", "mapper", "style")}
    except Exception as error:  # torch raises many kinds on files that are none of its own
        raise UsageError(f"{path} is no checkpoint of prim-train cnn") from error
    return network, told


def export_yolo(
    weights: Path,
    mapper: str,
    output: Path,
    trust: bool,
    style: str = "grey",
    about: Mapping[str, Any] | None = None,
) -> Card:
    """Makes an ONNX file of YOLO weights: images (N, 3, rows, cols), boxes and scores (N, 4 + kinds, anchors).

    The weights are a pickle, which can run code when it is read: raises UsageError unless told to ``trust`` them.
    """
    if not trust:
        raise UsageError(f"{weights} is a pickle, which can run code: add --trust if you know where it is from")
    if not weights.is_file():
        raise UsageError(f"{weights} is not there")
    os.environ["YOLO_AUTOINSTALL"] = "false"
    from ultralytics import YOLO

    with tempfile.TemporaryDirectory() as folder:
        copy = Path(folder) / weights.name
        shutil.copy(weights, copy)
        made = YOLO(str(copy)).export(format="onnx", imgsz=TILE, dynamic=True, opset=OPSET, verbose=False)
        shutil.move(made, output)
    halve(output)
    card = Card("yolo", mapper, style=style, about=dict(about or {}))
    write_card(output, card)
    return card


def reopen_yolo(path: Path, images: torch.Tensor, output: Path) -> Path:
    """Makes weights that ultralytics can train on of a YOLO's ONNX file; ``images`` (N, 3, rows, cols) in 0 to 1.

    Nothing in the file is run. Raises UsageError on a file that is no such network.
    """
    from ultralytics.nn.tasks import DetectionModel

    folded = _folded(path)
    model = DetectionModel("yolov5n.yaml", nc=len(Kind), verbose=False)
    try:
        for name, module in model.named_modules():
            if isinstance(module, torch.nn.Conv2d) and not name.endswith(FIXED):
                _fill(module, _normalisation(model, name), folded[f"{name}.weight"], folded[f"{name}.bias"])
    except (KeyError, RuntimeError) as error:
        raise UsageError(f"{path} is no YOLOv5n of {len(Kind)} kinds") from error
    _settle(model, images)
    torch.save({"model": model, "epoch": -1, "train_args": {}}, output)
    return output


def reopen_cnn(path: Path, network: ParameterNetwork, crops: torch.Tensor) -> None:
    """Fills a network with the weights of an ONNX file of its like; ``crops`` (N, channels, pixels, pixels).

    Raises UsageError on a file that is no such network.
    """
    folded = _folded(path)
    unnamed = [name for name in folded if name.startswith("onnx::Conv")]
    arrays = [folded[name] for name in sorted(unnamed, key=lambda name: int(name.rpartition("_")[2]))]
    convolutions = [module for module in network.features if isinstance(module, torch.nn.Conv2d)]
    normalisations = [module for module in network.features if isinstance(module, torch.nn.BatchNorm2d)]
    try:
        pairs = zip(arrays[::2], arrays[1::2], strict=True)
        for module, normalisation, (weight, bias) in zip(convolutions, normalisations, pairs, strict=True):
            _fill(module, normalisation, weight, bias)
        network.head.load_state_dict(
            {name.removeprefix("head."): array for name, array in folded.items() if name.startswith("head.")}
        )
    except (RuntimeError, ValueError) as error:
        raise UsageError(f"{path} is no network of this preset and these kinds") from error
    _settle(network, crops)


def _folded(path: Path) -> dict[str, torch.Tensor]:
    """An ONNX file's arrays by name, in single precision. Raises UsageError on what is no ONNX file."""
    import onnx
    from onnx import numpy_helper

    try:
        tensors = onnx.load(str(path)).graph.initializer
    except Exception as error:  # protobuf and onnx raise many kinds
        raise UsageError(f"{path} is no ONNX network") from error
    return {
        one.name.removesuffix(".half"): torch.from_numpy(numpy_helper.to_array(one).astype(np.float32).copy())
        for one in tensors
        if numpy_helper.to_array(one).dtype in (np.float16, np.float32)
    }


def _normalisation(model: torch.nn.Module, name: str) -> torch.nn.BatchNorm2d | None:
    """The normalisation that stands beside a convolution; None where there is none."""
    return getattr(model.get_submodule(name.rpartition(".")[0]), "bn", None) if name.endswith(".conv") else None


def _fill(
    module: torch.nn.Conv2d, normalisation: torch.nn.BatchNorm2d | None, weight: torch.Tensor, bias: torch.Tensor
) -> None:
    """Puts folded weights into a convolution; its normalisation then adds the bias, and changes nothing else."""
    module.weight.data.copy_(weight)
    if normalisation is None:
        assert module.bias is not None
        module.bias.data.copy_(bias)
        return
    if module.bias is not None:
        module.bias.data.zero_()
    normalisation.weight.data.fill_(1.0)
    normalisation.bias.data.copy_(bias)
    normalisation.running_mean.zero_()
    normalisation.running_var.fill_(1.0 - normalisation.eps)


def _settle(model: torch.nn.Module, images: torch.Tensor) -> None:
    """Gives normalisations that only add a bias the mean and deviation of what they see: outputs stay the same."""

    def settle(module: torch.nn.BatchNorm2d, inputs: tuple[torch.Tensor]) -> None:
        seen = inputs[0].detach()
        mean, variance = seen.mean(dim=(0, 2, 3)), seen.var(dim=(0, 2, 3))
        module.running_mean.copy_(mean)
        module.running_var.copy_(variance)
        module.weight.data.copy_(torch.sqrt(variance + module.eps))
        module.bias.data.add_(mean)

    hooks = [
        module.register_forward_pre_hook(settle)
        for module in model.modules()
        if isinstance(module, torch.nn.BatchNorm2d)
    ]
    model.eval()
    with torch.no_grad():
        model(images)
    for hook in hooks:
        hook.remove()


def halve(path: Path) -> None:
    """Keeps a network's weights in half precision: half the file, and as fast, since loading it widens them.

    (A network that also computes in half precision is slower on a CPU: see docs/detect.md.)
    """
    import onnx
    from onnx import TensorProto, helper, numpy_helper

    model = onnx.load(str(path))
    graph = model.graph
    widened = []
    for tensor in list(graph.initializer):
        values = numpy_helper.to_array(tensor)
        if tensor.data_type == TensorProto.FLOAT and values.size >= WORTH_HALVING:
            graph.initializer.remove(tensor)
            graph.initializer.append(numpy_helper.from_array(values.astype(np.float16), tensor.name + ".half"))
            widened.append(helper.make_node("Cast", [tensor.name + ".half"], [tensor.name], to=TensorProto.FLOAT))
    nodes = [*widened, *graph.node]
    del graph.node[:]
    graph.node.extend(nodes)
    onnx.save(model, str(path))


def write_card(path: Path, card: Card) -> None:
    """Puts a card into an ONNX file's metadata, in the place of all that an exporter says of its machine."""
    import onnx

    model = onnx.load(str(path))
    del model.metadata_props[:]
    model.metadata_props.add(key=CARD_KEY, value=card.to_json())
    model.doc_string = model.graph.doc_string = ""
    for node in model.graph.node:
        node.doc_string = ""
        del node.metadata_props[:]
    onnx.save(model, str(path))
