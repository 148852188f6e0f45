"""Speed and accuracy of YOLO in half precision, in int8, and on OpenVINO.

    python -m bench.precision WEIGHTS SET

WEIGHTS is a folder of weights, SET a data set of ``prim-train dataset``: int8 is calibrated on its training split,
accuracy is measured on its validation split. Run times are those of one tile on all cores, measured in turns.
OpenVINO is included where it is installed. Needs the extra [train].
"""

from __future__ import annotations

import argparse
import tempfile
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bench.detect import timed
from detect.evaluation.box_metrics import score_boxes
from detect.evaluation.evaluate import scored_candidates
from detect.networks.weights import DETECTOR_FILE, Weights, load_weights
from detect.networks.yolo import Yolo
from detect.training.dataset import Sample, load_samples, read_image
from detect.training.matches import LabelledImage

CALIBRATION = 100
"""Number of images that int8's ranges are calibrated on."""

BATCH = 8

Run = Callable[[NDArray[np.float32]], NDArray[np.float32]]


def images_of(chosen: Sequence[Sample]) -> NDArray[np.float32]:
    """Return images (N, 3, TILE_SIZE, TILE_SIZE), the network's input."""
    stacked = np.stack([read_image(sample) for sample in chosen]).transpose(0, 3, 1, 2)
    return np.ascontiguousarray(stacked, np.float32) / np.float32(255)


def half(weights: Path, folder: Path) -> Path:
    """Convert a network to half-precision arithmetic.

    Args:
        weights: The network's file.
        folder: Where the converted one goes.

    Returns:
        Its file.
    """
    import onnx
    from onnxruntime.transformers.float16 import convert_float_to_float16

    path = folder / "half.onnx"
    onnx.save(convert_float_to_float16(widened(weights), keep_io_types=True), str(path))
    return path


def widened(weights: Path) -> Any:
    """Load a network with its weights in single precision, as they were before export."""
    import onnx
    from onnx import TensorProto, numpy_helper

    model = onnx.load(str(weights))
    initializers = {tensor.name: tensor for tensor in model.graph.initializer}
    for node in [node for node in model.graph.node if node.op_type == "Cast" and node.input[0].endswith(".half")]:
        tensor = initializers[node.input[0]]
        model.graph.initializer.append(
            numpy_helper.from_array(numpy_helper.to_array(tensor).astype(np.float32), node.output[0])
        )
        model.graph.initializer.remove(tensor)
        model.graph.node.remove(node)
    assert all(tensor.data_type != TensorProto.FLOAT16 for tensor in model.graph.initializer)
    return model


def int8(weights: Path, folder: Path, chosen: Sequence[Sample]) -> Path:
    """Quantise a network's convolutions to eight bits; the other operators stay in single precision.

    Args:
        weights: The network's file.
        folder: Where the quantised one goes.
        chosen: The images that ranges are calibrated on.

    Returns:
        Its file.
    """
    import onnx
    from onnxruntime.quantization import CalibrationDataReader, QuantFormat, QuantType, quantize_static

    class Reader(CalibrationDataReader):  # type: ignore[misc]
        def __init__(self) -> None:
            self._images = iter(images_of(chosen))

        def get_next(self) -> dict[str, NDArray[np.float32]] | None:
            image = next(self._images, None)
            return None if image is None else {"images": image[None]}

    whole, path = folder / "whole.onnx", folder / "int8.onnx"
    onnx.save(widened(weights), str(whole))
    quantize_static(
        str(whole),
        str(path),
        Reader(),
        quant_format=QuantFormat.QDQ,
        activation_type=QuantType.QUInt8,
        weight_type=QuantType.QInt8,
        per_channel=True,
        op_types_to_quantize=["Conv"],
    )
    return path


def onnx_run(path: Path) -> Run:
    import onnxruntime

    session = onnxruntime.InferenceSession(path, providers=["CPUExecutionProvider"])
    return lambda images: np.asarray(session.run(None, {"images": images})[0])


def openvino_run(weights: Path, folder: Path, precision: str) -> Run:
    import onnx
    import openvino

    path = folder / "openvino.onnx"
    onnx.save(widened(weights), str(path))
    core = openvino.Core()
    hints = {"PERFORMANCE_HINT": "LATENCY", "INFERENCE_PRECISION_HINT": precision}
    compiled = core.compile_model(str(path), "CPU", hints)
    return lambda images: np.asarray(compiled(images)[0])


class _Session:
    """Any runtime behind the interface of ONNX Runtime's session."""

    def __init__(self, run: Run, like: Weights) -> None:
        self._run, self._like = run, like

    def get_inputs(self) -> Any:
        return self._like.session.get_inputs()

    def run(self, wanted: object, feeds: dict[str, NDArray[np.float32]]) -> list[NDArray[np.float32]]:
        return [self._run(next(iter(feeds.values())))]


def accuracy(run: Run, like: Weights, chosen: Sequence[Sample]) -> tuple[float, float, float]:
    """Evaluate a network.

    Args:
        run: Runs it.
        like: The weights whose model card it has.
        chosen: The images.

    Returns:
        F1, mAP 0.5 and mAP 0.5-0.95 of the boxes.
    """
    yolo = Yolo(replace(like, session=_Session(run, like)))
    scored = []
    for begin in range(0, len(chosen), BATCH):
        batch = [LabelledImage(sample, read_image(sample)) for sample in chosen[begin : begin + BATCH]]
        scored += scored_candidates(yolo, batch)
    row = score_boxes(scored)["all"]
    return row.f1, row.map50, row.map50_95


def runs(weights: Path, folder: Path, training: Sequence[Sample]) -> dict[str, Run]:
    """Make each variant of the network that this machine can run.

    Args:
        weights: The network's file.
        folder: Where converted networks go.
        training: Images that int8 is calibrated on.

    Returns:
        The variants by name.
    """
    variants = {
        "**ONNX Runtime, single precision** (shipped; weights stored in half precision)": onnx_run(weights),
        "ONNX Runtime, half precision": onnx_run(half(weights, folder)),
        "ONNX Runtime, int8": onnx_run(int8(weights, folder, training[:CALIBRATION])),
    }
    try:
        variants["OpenVINO, single precision"] = openvino_run(weights, folder, "f32")
        variants["OpenVINO, bfloat16"] = openvino_run(weights, folder, "bf16")
    except ImportError:
        print("OpenVINO is not installed: left out")
    return variants


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("weights", type=Path)
    parser.add_argument("set", type=Path)
    options = parser.parse_args()
    like = load_weights(options.weights / DETECTOR_FILE, "yolo")
    training, chosen = (load_samples(options.set, like.card.mapper, split) for split in ("train", "val"))
    lines = ["| YOLO, one tile | best, ms | median, ms | F1 | mAP 0.5 | mAP 0.5–0.95 |", "|---|" + "---:|" * 5]
    with tempfile.TemporaryDirectory() as folder:
        variants = runs(options.weights / DETECTOR_FILE, Path(folder), training)
        tile = images_of(chosen[:1])
        times = timed({name: lambda run=run: run(tile) for name, run in variants.items()})  # type: ignore[misc]
        for name, run in variants.items():
            scores = " | ".join(f"{value:.3f}" for value in accuracy(run, like, chosen))
            lines.append(f"| {name} | {times[name][0]:.1f} | {times[name][1]:.1f} | {scores} |")
    print("\n".join(lines))


if __name__ == "__main__":
    main()
