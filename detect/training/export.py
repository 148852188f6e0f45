"""Export of trained networks to ONNX with a model card, and import to continue their training. Needs ``[train]``.

Exporting folds each batch normalisation into its convolution. Importing unfolds them again: each normalisation gets
the mean and variance of its inputs on some images as its running statistics, and the scale and shift that leave the
network's outputs unchanged.
"""

from __future__ import annotations

import io
import re
import shutil
import tempfile
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import torch

from detect.networks.parameters import PRESETS
from detect.networks.tiles import TILE_SIZE
from detect.networks.weights import CARD_KEY, DETECTOR_FILE, SCHEMA, ModelCard
from detect.training.model import ParameterNetwork
from detect.training.offline import load_ultralytics
from prim.errors import UsageError
from prim.files import ResultFormat, check_no_input, check_output, write_file
from prim.shapes import Kind

NETWORK = ResultFormat("a network of prim-train", re.compile(re.escape(SCHEMA.encode())), at_end=True)
"""Networks are known by their model cards, which follow the weights."""

TRAINED = ResultFormat("weights of a run", re.compile(b""))
"""They lie in the folder of a run, which is claimed first."""

OPSET = 17
"""Version of ONNX's operator set."""

FIXED_CONVOLUTION = ".dfl.conv"
"""Suffix of YOLO's one convolution that is not trained: the expectation over the distribution of a box's sides."""

MIN_HALVED_SIZE = 256
"""Arrays with fewer numbers (biases, arithmetic constants) stay in single precision; set by hand."""


@contextmanager
def network_in_the_making(weights: Path, output: Path, force: bool = False) -> Iterator[Path]:
    """Make an ONNX file in a temporary folder, and put it in its place when it is complete.

    Args:
        weights: What it is made of.
        output: Its place.
        force: Whether a file in its place may be replaced that is no network of prim-train.

    Yields:
        Where it is to be made.

    Raises:
        OutputError: It cannot be written.
        UsageError: There is another file in its place, or ``weights`` itself.
    """
    check_no_input([weights], [output])
    check_output(output, NETWORK, force)
    with tempfile.TemporaryDirectory() as folder:
        made = Path(folder) / DETECTOR_FILE
        yield made
        write_file(output, made.read_bytes(), NETWORK, force)


def export_cnn(
    checkpoint: Path, mapper: str, output: Path, about: Mapping[str, Any] | None = None, force: bool = False
) -> ModelCard:
    """Export a checkpoint of ``prim-train cnn``: crops (N, channels, pixels, pixels) to outputs (N, M).

    Args:
        checkpoint: The checkpoint; nothing in it is executed.
        mapper: Name of the mapper whose maps it was trained on.
        output: The ONNX file to write.
        about: Further entries of the model card's ``about``.
        force: Whether a file may be replaced that is no network of prim-train.

    Returns:
        The model card.

    Raises:
        OutputError: The file cannot be written.
        UsageError: The file is no such checkpoint, or is for another mapper's maps; or another file is in the place
            of ``output``.
    """
    network, state = _read_checkpoint(checkpoint)
    if state["mapper"] != mapper:
        raise UsageError(f"{checkpoint} was trained on maps of {state['mapper']}, not of {mapper}")
    network.eval()
    pixels = network.preset.pixels
    kinds = tuple(kind.value for kind in network.kinds)
    entries = {"options": state["options"]} | dict(about or {})
    card = ModelCard("cnn", mapper, kinds, network.preset.name, network.channels, state["style"], about=entries)
    with network_in_the_making(checkpoint, output, force) as made:
        torch.onnx.export(
            network,
            (torch.zeros(2, network.channels, pixels, pixels),),
            str(made),
            input_names=["crops"],
            output_names=["outputs"],
            dynamic_axes={"crops": {0: "n"}, "outputs": {0: "n"}},
            opset_version=OPSET,
            dynamo=False,
        )
        store_half_precision(made)
        write_card(made, card)
    return card


def _read_checkpoint(path: Path) -> tuple[ParameterNetwork, dict[str, Any]]:
    try:
        state: dict[str, Any] = torch.load(path, weights_only=True, map_location="cpu")
        options = state["options"]
        kinds = [Kind(kind) for kind in state["kinds"]]
        network = ParameterNetwork(kinds, PRESETS[options["preset"]], options["channels"])
        network.load_state_dict(state["network"])
        facts = {name: state[name] for name in ("options", "mapper", "style")}
    except Exception as error:  # torch raises exceptions of many types on foreign files
        raise UsageError(f"{path} is no checkpoint of prim-train cnn") from error
    return network, facts


def export_yolo(
    weights: Path,
    mapper: str,
    output: Path,
    trust: bool,
    style: str = "grey",
    about: Mapping[str, Any] | None = None,
) -> ModelCard:
    """Export YOLO's weights: images (N, 3, rows, cols) to boxes and scores (N, 4 + kinds, locations).

    Args:
        weights: Weights of ultralytics: a pickle, which can run code when it is loaded.
        mapper: Name of the mapper whose maps they were trained on.
        output: The ONNX file to write, see :func:`network_in_the_making`.
        trust: Whether the pickle may be loaded.
        style: Style of the images (networks.tiles.STYLES).
        about: The model card's ``about``.

    Returns:
        The model card, without thresholds.

    Raises:
        UsageError: The file is not trusted, or not there.
    """
    if not trust:
        raise UsageError(f"{weights} is a pickle, which can run code: add --trust if you know where it is from")
    if not weights.is_file():
        raise UsageError(f"{weights} is not there")
    ultralytics = load_ultralytics()
    with tempfile.TemporaryDirectory() as folder:
        copy = Path(folder) / weights.name
        shutil.copy(weights, copy)
        model = ultralytics.YOLO(str(copy))
        made = model.export(format="onnx", imgsz=TILE_SIZE, dynamic=True, opset=OPSET, verbose=False)
        shutil.move(made, output)
    store_half_precision(output)
    card = ModelCard("yolo", mapper, style=style, about=dict(about or {}))
    write_card(output, card)
    return card


def import_yolo(path: Path, images: torch.Tensor, output: Path) -> Path:
    """Convert an exported YOLO to weights that ultralytics can train; nothing in the file is executed.

    Args:
        path: The ONNX file.
        images: (N, 3, rows, cols) in 0 to 1, for the statistics of the normalisations.
        output: The weights to write.

    Returns:
        ``output``.

    Raises:
        UsageError: The file is no such network.
    """
    load_ultralytics()
    from ultralytics.nn.tasks import DetectionModel

    folded = _read_arrays(path)
    model = DetectionModel("yolov5n.yaml", nc=len(Kind), verbose=False)
    try:
        for name, module in model.named_modules():
            if isinstance(module, torch.nn.Conv2d) and not name.endswith(FIXED_CONVOLUTION):
                _load_folded(module, _normalisation(model, name), folded[f"{name}.weight"], folded[f"{name}.bias"])
    except (KeyError, RuntimeError) as error:
        raise UsageError(f"{path} is no YOLOv5n of {len(Kind)} kinds") from error
    _set_statistics(model, images)
    content = io.BytesIO()
    torch.save({"model": model, "epoch": -1, "train_args": {}}, content)
    write_file(output, content.getvalue(), TRAINED)
    return output


def import_cnn(path: Path, network: ParameterNetwork, crops: torch.Tensor) -> None:
    """Load the weights of an exported network; nothing in the file is executed.

    Args:
        path: The ONNX file.
        network: A network of the same preset and kinds, which gets the weights.
        crops: (N, channels, pixels, pixels) in 0 to 1, for the statistics of the normalisations.

    Raises:
        UsageError: The file is no such network.
    """
    folded = _read_arrays(path)
    unnamed = [name for name in folded if name.startswith("onnx::Conv")]
    arrays = [folded[name] for name in sorted(unnamed, key=lambda name: int(name.rpartition("_")[2]))]
    convolutions = [module for module in network.features if isinstance(module, torch.nn.Conv2d)]
    normalisations = [module for module in network.features if isinstance(module, torch.nn.BatchNorm2d)]
    try:
        pairs = zip(arrays[::2], arrays[1::2], strict=True)
        for module, normalisation, (weight, bias) in zip(convolutions, normalisations, pairs, strict=True):
            _load_folded(module, normalisation, weight, bias)
        network.head.load_state_dict(
            {name.removeprefix("head."): array for name, array in folded.items() if name.startswith("head.")}
        )
    except (RuntimeError, ValueError) as error:
        raise UsageError(f"{path} is no network of this preset and these kinds") from error
    _set_statistics(network, crops)


def _read_arrays(path: Path) -> dict[str, torch.Tensor]:
    """Return an ONNX file's arrays by name, in single precision; raise UsageError where it is none."""
    import onnx
    from onnx import numpy_helper

    try:
        tensors = onnx.load(str(path)).graph.initializer
    except Exception as error:  # protobuf and onnx raise exceptions of many types
        raise UsageError(f"{path} is no ONNX network") from error
    return {
        tensor.name.removesuffix(".half"): torch.from_numpy(numpy_helper.to_array(tensor).astype(np.float32).copy())
        for tensor in tensors
        if numpy_helper.to_array(tensor).dtype in (np.float16, np.float32)
    }


def _normalisation(model: torch.nn.Module, name: str) -> torch.nn.BatchNorm2d | None:
    """Return the batch normalisation after a convolution; None where there is none."""
    return getattr(model.get_submodule(name.rpartition(".")[0]), "bn", None) if name.endswith(".conv") else None


def _load_folded(
    module: torch.nn.Conv2d, normalisation: torch.nn.BatchNorm2d | None, weight: torch.Tensor, bias: torch.Tensor
) -> None:
    """Load folded weights into a convolution; its normalisation adds the bias and is else the identity."""
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


def _set_statistics(model: torch.nn.Module, images: torch.Tensor) -> None:
    """Set running statistics of normalisations that only add a bias to those of their inputs; keep the outputs."""

    def set_statistics(module: torch.nn.BatchNorm2d, inputs: tuple[torch.Tensor]) -> None:
        features = inputs[0].detach()
        mean, variance = features.mean(dim=(0, 2, 3)), features.var(dim=(0, 2, 3))
        module.running_mean.copy_(mean)
        module.running_var.copy_(variance)
        module.weight.data.copy_(torch.sqrt(variance + module.eps))
        module.bias.data.add_(mean)

    hooks = [
        module.register_forward_pre_hook(set_statistics)
        for module in model.modules()
        if isinstance(module, torch.nn.BatchNorm2d)
    ]
    model.eval()
    with torch.no_grad():
        model(images)
    for hook in hooks:
        hook.remove()


def store_half_precision(path: Path) -> None:
    """Store a network's weights in half precision, which halves the file; they are cast to single when it is loaded.

    Arithmetic in half precision is hardly faster on a CPU: see docs/detect.md.
    """
    import onnx
    from onnx import TensorProto, helper, numpy_helper

    model = onnx.load(str(path))
    graph = model.graph
    casts = []
    for tensor in list(graph.initializer):
        values = numpy_helper.to_array(tensor)
        if tensor.data_type == TensorProto.FLOAT and values.size >= MIN_HALVED_SIZE:
            graph.initializer.remove(tensor)
            graph.initializer.append(numpy_helper.from_array(values.astype(np.float16), tensor.name + ".half"))
            casts.append(helper.make_node("Cast", [tensor.name + ".half"], [tensor.name], to=TensorProto.FLOAT))
    nodes = [*casts, *graph.node]
    del graph.node[:]
    graph.node.extend(nodes)
    onnx.save(model, str(path))


def write_card(path: Path, card: ModelCard) -> None:
    """Store a model card in an ONNX file's metadata, and remove what the exporter wrote about its environment.

    Args:
        path: The file.
        card: The model card.
    """
    import onnx

    model = onnx.load(str(path))
    del model.metadata_props[:]
    model.metadata_props.add(key=CARD_KEY, value=card.to_json())
    model.doc_string = model.graph.doc_string = ""
    for node in model.graph.node:
        node.doc_string = ""
        del node.metadata_props[:]
    onnx.save(model, str(path))
