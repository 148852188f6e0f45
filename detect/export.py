"""Trained networks as ONNX files with a model card. Needs the extra ``[train]``."""

from __future__ import annotations

import os
import shutil
import tempfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch

from detect.networks import ParameterNetwork
from detect.parameters import PRESETS
from detect.tiles import TILE
from detect.weights import CARD_KEY, Card
from prim.errors import UsageError
from prim.shapes import Kind

OPSET = 17

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
        state: dict[str, Any] = torch.load(path, weights_only=True)
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
