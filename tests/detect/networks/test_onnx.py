"""Networks as files: what is run gives what ONNX Runtime gives, within bounds; what is hostile is refused."""

from __future__ import annotations

import random
import struct
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import onnxruntime
import pytest
from numpy.typing import NDArray

from bench.fuzzing.networks import (
    CARD,
    KINDS,
    detector,
    floats,
    hostile_networks,
    integers,
    network,
    node,
    parameters,
    raw_network,
)
from detect.detector import Detector
from detect.networks.cnn import MAX_OUTPUT
from detect.networks.limits import GraphError, NetworkLimits
from detect.networks.onnx_check import check_network
from detect.networks.onnx_file import Node, Port, bytes_field, integer_field, read_network, write_network, write_node
from detect.networks.onnx_operators import OPERATORS
from detect.networks.weights import SHIPPED, WeightsError, load_weights
from mapping.grid import GridFrame, OccupancyGrid
from prim.text import printable

SHIPPED_FILES = sorted(SHIPPED.rglob("*.onnx"))
TILES = (1, 3, 224, 224)


def named(path: Path) -> str:
    return f"{path.parent.name}/{path.name}"


def run(content: bytes, images: NDArray[np.float32]) -> NDArray[np.float32]:
    """Run a network by ONNX Runtime alone."""
    options = onnxruntime.SessionOptions()
    options.log_severity_level = 4
    session = onnxruntime.InferenceSession(content, options, providers=["CPUExecutionProvider"])
    return np.asarray(session.run(None, {session.get_inputs()[0].name: images})[0])


@pytest.mark.parametrize("path", SHIPPED_FILES, ids=named)
def test_shipped_networks_give_the_same_to_the_last_bit_when_they_are_written_anew(path: Path) -> None:
    content = path.read_bytes()
    weights = load_weights(path, "yolo" if path.name == "yolo.onnx" else "cnn")
    images = np.random.default_rng(0).random(weights.card.input_shape(3), dtype=np.float32)
    assert weights.run(images).tobytes() == run(content, images).tobytes()
    again = read_network(write_network(read_network(content)))
    assert again.nodes == read_network(content).nodes and len(write_network(again)) < len(content)


@pytest.mark.parametrize("path", SHIPPED_FILES, ids=named)
def test_shipped_networks_take_a_small_part_of_what_is_allowed(path: Path) -> None:
    weights = load_weights(path, "yolo" if path.name == "yolo.onnx" else "cnn")
    limits = NetworkLimits()
    assert weights.check is not None
    costs = weights.check(weights.card.input_shape(8))
    assert costs.multiply_adds < limits.max_multiply_adds / 4
    assert costs.activation_bytes < limits.max_activation_bytes / 4
    assert costs.live_bytes < limits.max_live_bytes / 4
    assert costs.constant_bytes < limits.max_constant_bytes / 4


def test_shapes_of_all_tensors_are_those_of_onnx_runtime() -> None:
    """The shipped YOLO, whose head computes sizes: every fifth tensor, made the output."""
    whole = read_network((SHIPPED / "prob" / "yolo.onnx").read_bytes())
    shapes = check_network(whole, (2, 3, 224, 224)).shapes
    images = np.zeros((2, 3, 224, 224), np.float32)
    last = [one for one in whole.nodes if one.operator not in ("Cast", "Conv", "Sigmoid", "Mul")][3::5]
    assert len(last) > 20
    for one in last:
        end = Node("Cast", one.outputs[:1], ("end",), {"to": 1})
        nodes = whole.nodes[: whole.nodes.index(one) + 1]
        part = replace(whole, nodes=(*nodes, end), output=Port("end", np.dtype(np.float32), None))
        assert run(write_network(part), images).shape == shapes[one.outputs[0]], one.operator


WEIGHT = np.ones((4, 3, 3, 3), np.float32)
UNARY = (
    "Abs Ceil Clip Elu Erf Exp Flatten Floor GlobalAveragePool GlobalMaxPool HardSigmoid HardSwish Identity "
    "LeakyRelu Log Mish Neg Reciprocal Relu Round Selu Sigmoid Sign Softmax Softplus Softsign Sqrt Tanh Transpose"
)
BINARY = ["Add", "Sub", "Mul", "Div", "Pow", "Max", "Min"]
COMPARISONS = ["Equal", "Greater", "GreaterOrEqual", "Less", "LessOrEqual"]
REDUCTIONS = ["ReduceL2", "ReduceMax", "ReduceMean", "ReduceMin"]

Case = tuple[Node | Sequence[Node], dict[str, NDArray[np.generic]]]

CASES: list[Case] = [
    *((node(name, "images"), {}) for name in UNARY.split()),
    *((node(name, "images images"), {}) for name in BINARY),
    *(([node(name, "images images", "c"), node("Cast", "c", to=1)], {}) for name in COMPARISONS),
    *((node(name, "images", axes=(-1, 1), keepdims=i % 2), {}) for i, name in enumerate(REDUCTIONS)),
    ([node("Greater", "images one", "c"), node("Not", "c", "d"), node("And", "c d", "e"), node("Or", "c e", "f"),
      node("Where", "f seen images")], {"one": floats(1)}),
    (node("Add", "images other"), {"other": np.ones((5, 1, 3, 1, 224), np.float32)}),
    (node("PRelu", "images slope"), {"slope": np.ones((3, 1, 1), np.float32)}),
    (node("BatchNormalization", "images v v v v"), {"v": floats(1, 1, 1)}),
    (node("Conv", "images w b", strides=(2, 3), pads=(1, 0, 2, 1), dilations=(2, 1)),
     {"w": WEIGHT, "b": floats(1, 2, 3, 4)}),
    (node("Conv", "images w", group=3), {"w": np.ones((6, 1, 5, 2), np.float32)}),
    (node("MaxPool", "images", kernel_shape=(5, 4), strides=(3, 2), pads=(2, 1, 2, 1), dilations=(2, 1)), {}),
    (node("AveragePool", "images", kernel_shape=(5, 4), strides=(3, 2), pads=(2, 1, 2, 1), count_include_pad=1), {}),
    (node("MatMul", "images w"), {"w": np.ones((2, 1, 224, 7), np.float32)}),
    (node("MatMul", "images w"), {"w": np.ones(224, np.float32)}),
    (node("MatMul", "w images"), {"w": np.ones(224, np.float32)}),
    ([node("Flatten", "images", "a"), node("Gemm", "w a c", transA=1, transB=1)],
     {"w": np.ones((3 * 224 * 224, 2), np.float32), "c": floats(1)}),
    (node("ReduceSum", "images axes", keepdims=0), {"axes": integers(0, 2)}),
    (node("ReduceSum", "images -"), {}),
    ([node("Squeeze", "images none", "a"), node("ReduceSum", "a none", keepdims=0)], {"none": integers()}),
    (node("Constant", "", value=np.ones((3, 2), np.float32)), {}),
    (node("ConstantOfShape", "s"), {"s": integers(3, 5)}),
    ([node("Shape", "images", "s", start=1, end=-1), node("Cast", "s", to=1)], {}),
    (node("Range", "a b c"), {"a": np.full((), 7, np.float32), "b": np.array(-1, "f4"), "c": np.array(-3, "f4")}),
    (node("Range", "a b c"), {"a": np.full((), 3, np.float32), "b": np.array(17, "f4"), "c": np.array(2, "f4")}),
    (node("Range", "a b c"), {"a": np.full((), 0, np.float32), "b": np.array(3, "f4"), "c": np.array(1, "f4")}),
    ([node("Range", "a b c", "r"), node("Cast", "r", to=1)], {"a": np.array(-3), "b": np.array(8), "c": np.array(3)}),
    (node("Reshape", "images s"), {"s": integers(0, -1, 7, 4)}),
    ([node("Unsqueeze", "images a", "u"), node("Squeeze", "u b")], {"a": integers(0, -1), "b": integers(0)}),
    ([node("Slice", "images a b c d", "u"), node("Squeeze", "u")],
     {"a": integers(-1, 5, 1), "b": integers(-(1 << 62), 1 << 62, 2), "c": integers(-1, 2, 1),
      "d": integers(-3, 7, 1)}),
    (node("Transpose", "images", perm=(2, 0, 3, 1)), {}),
    (node("Concat", "images w images", axis=-2), {"w": np.ones((1, 3, 9, 224), np.float32)}),
    (node("Split", "images sizes", "more out", axis=2), {"sizes": integers(100, 124)}),
    (node("Split", "images", "out more", axis=3), {}),
    (node("Gather", "images i", axis=2), {"i": np.array([[0, -1, 5], [7, 7, 7]])}),
    (node("Expand", "images s"), {"s": integers(2, 1, 3, 1, 1)}),
    (node("Tile", "images s"), {"s": integers(2, 1, 3, 1)}),
    (node("Pad", "images s", mode=b"reflect"), {"s": integers(0, 0, 5, 6, 0, 1, 0, 7)}),
    (node("Resize", "images - s", mode=b"nearest"), {"s": floats(1, 1, 0.3, 1.7)}),
    (node("Resize", "images - - s", mode=b"linear"), {"s": integers(1, 3, 100, 300)}),
    ([node("Shape", "images", "s"), node("Gather", "s i", "g"), node("Div", "g two", "h"), node("Mul", "h two", "k"),
      node("Add", "k two", "l"), node("Sub", "l one", "m"), node("Max", "m one", "n"), node("Min", "n two m", "o"),
      node("Equal", "o one", "p"), node("Where", "p two h", "q"), node("Concat", "q h", "r", axis=0),
      node("Slice", "r zero one", "t"), node("Unsqueeze", "t zero", "u"), node("Squeeze", "u zero", "v"),
      node("Concat", "v v", "x", axis=0), node("ConstantOfShape", "x", "y"), node("Expand", "y x", "z"),
      node("Add", "z z")],
     {"i": integers(-1), "two": integers(2), "one": integers(1), "zero": integers(0)}),
]  # fmt: skip


@pytest.mark.parametrize("case", CASES, ids=lambda case: case[0].operator if isinstance(case[0], Node) else "chain")
def test_operators_give_the_shapes_of_onnx_runtime(case: Case) -> None:
    nodes, constants = case
    made = network([nodes] if isinstance(nodes, Node) else nodes, **constants)
    made = replace(made, opset=18 if isinstance(nodes, Node) and nodes.operator == "Mish" else made.opset)
    if made.opset == 18:
        made = replace(made, nodes=made.nodes[2:])
    assert check_network(made, TILES).shapes["out"] == run(write_network(made), np.ones(TILES, np.float32)).shape


def test_every_operator_is_compared() -> None:
    compared = {one.operator for nodes, _ in CASES for one in ([nodes] if isinstance(nodes, Node) else nodes)}
    assert compared == OPERATORS.keys()


def test_operators_of_older_sets_take_axes_as_attributes() -> None:
    old = (node("Unsqueeze", "images", "a", axes=(0,)), node("ReduceSum", "a", axes=(2,), keepdims=0))
    made = replace(network(old), opset=12, nodes=old)
    assert check_network(made, TILES).shapes["out"] == run(write_network(made), np.ones(TILES, np.float32)).shape
    with pytest.raises(GraphError, match="Unsqueeze lacks its input 1"):
        check_network(replace(made, opset=13), TILES)
    for opset in (6, 99):
        with pytest.raises(GraphError, match=f"operators of version {opset}"):
            check_network(replace(made, opset=opset), TILES)


@pytest.mark.parametrize(
    ("nodes", "constants", "said"),
    [
        ([node("NonZero", "seen")], {}, 'the operator "NonZero"'),
        ([node("\x1b[31m", "seen")], {}, r'the operator "\\u001b\[31m"'),
        ([node("Add", "seen later"), node("Relu", "seen", "later")], {}, 'takes "later", which no node before'),
        ([node("Relu", "seen", "seen")], {}, 'two tensors the name "seen"'),
        ([node("Relu", "seen", "other")], {}, "its output is not in single precision, or not there"),
        ([node("Relu", "seen seen")], {}, "its Relu has 2 inputs"),
        ([node("Relu", "seen", axis=1)], {}, 'an attribute "axis", which is not known'),
        ([node("Softmax", "seen", axis=7)], {}, "its Softmax has an axis 7 of 3 dimensions"),
        ([node("Conv", "images w", group=0)], {"w": WEIGHT}, "its Conv has weights of shape"),
        ([node("Conv", "images w", strides=(0, 1))], {"w": WEIGHT}, "steps or margins"),
        ([node("Conv", "images w", pads=(1, 1, 1, -1))], {"w": WEIGHT}, "steps or margins"),
        ([node("Conv", "images w", pads=(1 << 50,) * 4)], {"w": WEIGHT}, "multiply-adds: .* more than"),
        ([node("MaxPool", "images", kernel_shape=(3, 3), ceil_mode=1)], {}, "attribute ceil_mode of a value"),
        ([node("Resize", "images - s")], {"s": floats(1, 1, 1e6, 1e6)}, "more than"),
        ([node("Resize", "images - s")], {"s": floats(1, 1, np.nan, 1)}, "scales without meaning"),
        ([node("Range", "a b c")], {"a": floats(0), "b": floats(1e30), "c": floats(0)}, "without meaning"),
        ([node("Range", "a b c")], {"a": floats(0.3), "b": floats(17), "c": floats(0.1)}, "counts in fractions"),
        ([node("ConstantOfShape", "s")], {"s": integers(1 << 20, 1 << 20)}, "more than"),
        ([node("ConstantOfShape", "s")], {"s": integers(1, -1)}, "a tensor of shape"),
        ([node("Expand", "seen s")], {"s": integers(1 << 62, 1 << 62)}, "more than"),
        ([node("Reshape", "images s")], {"s": integers(0, 0, 0, 0, 0)}, "Reshape has an axis 4"),
        ([node("Reshape", "images s")], {"s": integers(-1, -1)}, "a tensor of shape"),
        ([node("Cast", "seen", "w", to=7), node("Div", "w z", "q"), node("Cast", "q", to=1)], {"z": integers(0)},
         "divides by an integer that is not positive"),
        ([node("Cast", "seen", "w", to=7), node("Div", "w w", "q"), node("Cast", "q", to=1)], {},
         "its Div has a size that depends on the image"),
        ([node("Cast", "seen", "w", to=7), node("Reshape", "w m", "s"), node("Expand", "seen s")],
         {"m": integers(-1)}, "its Expand has a size that depends on the image"),
        ([node("Gather", "images i", axis=1)], {"i": integers(3)}, "its Gather has an axis 3 of 3"),
        ([node("Slice", "images a a a a")], {"a": integers(0)}, "bounds that do not fit"),
        ([node("Cast", "seen", to=8)], {}, "casts to type 8"),
        ([node("Constant", "", "s", value=np.ones(5000, np.int64)), node("Expand", "seen s")], {},
         "too many numbers"),
        ([node("Expand", "seen s")], {"s": np.ones(5000, np.int64)}, "too many numbers"),
        ([node("Gemm", "i i", "q"), node("Cast", "q", to=1)], {"i": np.ones((2, 2), np.int64)},
         "matrices of integers"),
        ([node("ReduceMean", "images", keepdims=2)], {}, "attribute keepdims of a value"),
    ],
)  # fmt: skip
def test_what_is_not_run_is_named(
    nodes: Sequence[Node], constants: dict[str, NDArray[np.generic]], said: str
) -> None:
    with pytest.raises(GraphError, match=said):
        check_network(network(nodes, **constants), TILES)


def test_each_bound_holds() -> None:
    """A network that is within all bounds is beyond each when that alone is lowered."""
    made = network([node("ConstantOfShape", "s", "c"), node("Add", "images c")], s=integers(3, 224, 224))
    costs = check_network(made, TILES)
    image = 3 * 224 * 224
    assert costs.constant_bytes == 4 * image + 8 + 24  # and the constants that the network holds
    assert costs.activation_bytes == pytest.approx(2 * 4 * image, abs=16)
    assert costs.live_bytes == pytest.approx(2 * 4 * image, abs=16)
    for name, value in {
        "max_elements": image, "max_nodes": 4, "max_rank": 4, "max_constant_bytes": costs.constant_bytes,
        "max_activation_bytes": costs.activation_bytes, "max_live_bytes": costs.live_bytes,
        "max_multiply_adds": costs.multiply_adds,
    }.items():  # fmt: skip
        limits = NetworkLimits(**{name: value})
        check_network(made, TILES, limits)
        with pytest.raises(GraphError, match="more than"):
            check_network(made, TILES, replace(limits, **{name: value - 1}))
    content = write_network(made)
    for name in ("max_file_bytes", "max_fields"):
        with pytest.raises(GraphError, match=r"more than|too many parts"):
            read_network(content, NetworkLimits(**{name: 50}))


def test_a_batch_of_another_size_is_checked_too(tmp_path: Path) -> None:
    """Sizes that shrink or grow with the batch: no size of a batch that is run goes unchecked."""
    nodes = [
        node("Shape", "images", "n", end=1), node("Sub", "n three", "d"), node("Mul", "d d", "e"),
        node("Mul", "e e", "f"), node("Mul", "f million", "g"), node("Sub", "allowed g", "sizes"),
        node("Max", "sizes one", "whole"), node("ConstantOfShape", "whole", "c"), node("ReduceMean", "c", "m"),
        node("Mul", "m zero", "nothing"), node("Add", "nothing boxes"),
    ]  # fmt: skip
    arrays = {
        "three": integers(3), "million": integers(1 << 30), "allowed": integers(1 << 27), "one": integers(1),
        "zero": floats(0), "boxes": np.zeros((1, 9, 4), np.float32),
    }  # fmt: skip
    (tmp_path / "yolo.onnx").write_bytes(write_network(network(nodes, **arrays)))
    weights = load_weights(tmp_path / "yolo.onnx", "yolo")
    weights.run(np.zeros((8, 3, 224, 224), np.float32))
    with pytest.raises(WeightsError, match="more than"):
        weights.run(np.zeros((3, 3, 224, 224), np.float32))


def test_subgraphs_functions_and_other_sets_of_operators_are_refused() -> None:
    inner = bytes_field(1, write_node(node("Relu", "a", "b")))
    for kind, field in ((5, 6), (10, 11), (0, 6)):
        attribute = bytes_field(1, b"body") + bytes_field(field, inner) + integer_field(20, kind)
        with pytest.raises(GraphError, match=r'"Loop" has .*subgraph'):
            read_network(raw_network([write_node(node("Loop", "seen")) + bytes_field(5, attribute)]))
    with pytest.raises(GraphError, match="functions"):
        read_network(raw_network([], model=bytes_field(25, b"")))
    with pytest.raises(GraphError, match=r'"Relu" of "com.x"'):
        read_network(raw_network([write_node(node("Relu", "seen")) + bytes_field(7, b"com.x")]))
    with pytest.raises(GraphError, match="sparse"):
        read_network(raw_network([], graph=bytes_field(15, b"")))
    external = integer_field(1, 1) + integer_field(2, 1) + bytes_field(8, b"w") + integer_field(14, 1)
    with pytest.raises(GraphError, match='"w" is in another file'):
        read_network(raw_network([], graph=bytes_field(5, external)))


def test_arrays_are_read_from_all_their_fields() -> None:
    packed = struct.pack("<2f", 1.5, -2.0)
    for dtype, field, expected in (
        (1, bytes_field(4, packed), [1.5, -2.0]),
        (11, bytes_field(10, struct.pack("<2d", 1.5, -2.0)), [1.5, -2.0]),
        (10, bytes_field(5, b"\x80\x78\x80\x80\x02"), [1.0, -0.0]),  # 0x3c00, 0x8000
        (7, integer_field(7, -3) + integer_field(7, 4), [-3, 4]),
        (6, bytes_field(5, b"\x05\x06"), [5, 6]),
        (9, bytes_field(9, b"\x07\x00"), [True, False]),
    ):
        array = integer_field(1, 2) + integer_field(2, dtype) + bytes_field(8, b"w") + field
        found = read_network(raw_network([], graph=bytes_field(5, array))).constants["w"]
        assert found.tolist() == expected, dtype


def folder_with(folder: Path, **contents: bytes) -> Path:
    """A folder of weights: the shipped ones but for those given."""
    for name in ("yolo", "cnn"):
        path = folder / f"{name}.onnx"
        path.unlink(missing_ok=True)
        path.write_bytes(contents.get(name) or (SHIPPED / "prob" / path.name).read_bytes())
    return folder


def a_map(rows: int = 220, cols: int = 220) -> OccupancyGrid:
    probability = np.full((rows, cols), 0.1, np.float32)
    probability[60:90, 100:130] = probability[150:165, 40:80] = 0.9
    return OccupancyGrid(GridFrame(0.01, 0, 0, rows, cols), probability)


def box_output(*columns: tuple[float, float, float, float, float]) -> NDArray[np.float32]:
    """Outputs (9, N) of boxes (centre, size, score) of squares."""
    found = np.zeros((9, len(columns)), np.float32)
    found[:5] = np.array(columns, np.float32).T
    return found


GOOD = (100.0, 100.0, 30.0, 30.0, 0.9)

SMALL = (0.05, 0.3)
"""m; sizes that are searched for in cells of one size."""


@pytest.mark.parametrize("at", range(9))
@pytest.mark.parametrize("value", [np.inf, -np.inf, np.nan])
def test_outputs_that_are_not_finite_are_refused(tmp_path: Path, at: int, value: float) -> None:
    output = box_output(GOOD, GOOD)
    output[at, 1] = value
    with pytest.raises(WeightsError, match=r"yolo\.onnx gives outputs that are not finite"):
        Detector.load(folder_with(tmp_path, yolo=write_network(detector(output)))).detect(a_map())


@pytest.mark.parametrize(
    "bad",
    [
        (1e30, 100, 30, 30), (100, -1e30, 30, 30), (100, 100, 1e30, 30), (100, 100, 3e38, 3e38), (100, 100, -30, 30),
        (100, 100, 0, 30), (700, 100, 30, 30), (-400, 100, 30, 30), (100, 100, 3000, 30), (3e38, 3e38, 3e38, 3e38),
    ],
)  # fmt: skip
@pytest.mark.filterwarnings("error")
def test_boxes_that_no_tile_holds_are_dropped(tmp_path: Path, bad: tuple[float, ...]) -> None:
    content = write_network(detector(box_output((*bad, 0.95), GOOD)))
    found = Detector.load(folder_with(tmp_path, yolo=content)).detect(a_map(), SMALL)
    alone = Detector.load(folder_with(tmp_path, yolo=write_network(detector(box_output(GOOD))))).detect(
        a_map(), SMALL
    )
    assert len(found.found) == 1
    assert found.found[0].primitive == alone.found[0].primitive and not found.rejected


def test_scores_above_one_and_outputs_of_another_shape_are_refused(tmp_path: Path) -> None:
    for output in (
        box_output((100, 100, 30, 30, 1.5)),
        np.zeros((84, 9), np.float32),
        np.zeros((9, 9999), np.float32),
    ):
        with pytest.raises(WeightsError, match="it is no detector"):
            Detector.load(folder_with(tmp_path, yolo=write_network(detector(output))))


def test_outputs_whose_shape_does_not_follow_the_batch_are_refused(tmp_path: Path) -> None:
    constant = write_network(network([node("Identity", "boxes")], boxes=box_output(GOOD)[None]))
    wide = a_map(220, 700)
    wide.probability[100:120] = 0.9
    with pytest.raises(WeightsError, match=r"gives \(1, 9, 1\), not boxes"):
        Detector.load(folder_with(tmp_path, yolo=constant)).detect(wide)


@pytest.mark.parametrize("value", [1e30, -3e38, MAX_OUTPUT * 1.01, 99.0])
@pytest.mark.filterwarnings("error")
def test_primitives_that_no_tile_holds_are_rejected(tmp_path: Path, value: float) -> None:
    files = {"yolo": write_network(detector(box_output(GOOD))), "cnn": write_network(parameters(floats(value)))}
    found = Detector.load(folder_with(tmp_path, **files)).detect(a_map(), SMALL)
    assert not found.found and [rejection.reason for rejection in found.rejected] == [
        "its tile holds no such primitive, or its size is searched for in other cells"
    ]


def test_parameters_that_are_not_finite_are_refused(tmp_path: Path) -> None:
    for value in (np.inf, np.nan):
        with pytest.raises(WeightsError, match=r"cnn\.onnx gives outputs that are not finite"):
            Detector.load(folder_with(tmp_path, cnn=write_network(parameters(floats(value)))))


def test_the_best_detections_of_a_tile_are_kept(tmp_path: Path) -> None:
    centres = [(8.0 + 14 * (i % 15), 8.0 + 14 * (i // 15), 3.0, 3.0, 0.5 + i / 1000) for i in range(225)]
    small = parameters(floats(1, 0, 0, 0, *[0.02] * 22))
    files = {"yolo": write_network(detector(box_output(*centres))), "cnn": write_network(small)}
    detector_of_many = Detector.load(folder_with(tmp_path, **files))
    found = detector_of_many.detect(a_map(), SMALL)
    assert len(found.found) == detector_of_many.options.max_per_tile
    assert min(detection.score for detection in found.found) > max(rejection.score for rejection in found.rejected)


@pytest.mark.filterwarnings("error")
def test_hostile_networks_are_refused_or_run(tmp_path: Path) -> None:
    """Every kind a few times: no other error, no warning, one line of printable text."""
    rng, grid = random.Random(22), a_map()
    made = hostile_networks(rng)
    outcomes = set()
    for _ in range(4 * len(KINDS)):
        name, content = next(made)
        folder_with(tmp_path, **{name.split()[0]: content})
        try:
            Detector.load(tmp_path, threads=1).detect(grid)
            outcomes.add("run")
        except WeightsError as error:
            assert str(error) == printable(str(error)) and len(str(error)) < 800, name
            outcomes.add("refused")
    assert outcomes == {"run", "refused"}


def test_truncated_and_changed_files_run_or_are_refused(tmp_path: Path) -> None:
    whole = (SHIPPED / "prob" / "cnn.onnx").read_bytes()
    rng, crops = np.random.default_rng(3), np.zeros((2, 1, 72, 72), np.float32)
    path = tmp_path / "cnn.onnx"
    runs = 0
    for k in range(300):
        content = bytearray(whole)
        if k < 60:
            content = content[: int(rng.integers(len(whole)))]
        else:
            content[rng.choice([-1, 1]) * int(rng.integers(2500))] ^= 1 << int(rng.integers(8))
        path.write_bytes(content)
        try:
            load_weights(path, "cnn", threads=1).run(crops)
            runs += 1
        except WeightsError:
            pass
    assert 30 < runs < 240


def test_a_card_of_another_network_is_no_card(tmp_path: Path) -> None:
    content = raw_network([write_node(node("Identity", "seen"))], card=CARD.to_json() + " " * (1 << 21))
    (tmp_path / "a.onnx").write_bytes(content)
    with pytest.raises(WeightsError, match="more than 1048576 characters"):
        load_weights(tmp_path / "a.onnx", "yolo")
