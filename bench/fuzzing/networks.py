"""Hostile networks: what a file from a stranger may hold in the place of weights.

Each is refused, or runs within the bounds; none may crash, hang, take much memory, or give in silence what is no
result. A name begins with ``yolo`` or ``cnn``: the file of a folder of weights whose place the network takes.
"""

from __future__ import annotations

import json
import random
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace

import numpy as np

from detect.networks.onnx_file import (
    Array,
    Network,
    Node,
    Port,
    bytes_field,
    integer_field,
    read_network,
    text_field,
    write_array,
    write_network,
    write_node,
    write_port,
)
from detect.networks.weights import CARD_KEY, SHIPPED, ModelCard

MAPPER = "prob"
"""The mapper whose maps the networks claim to read."""

FLOAT, INT = np.dtype(np.float32), np.dtype(np.int64)
IMAGES = Port("images", FLOAT, ("n", 3, 224, 224))
OUTPUT = Port("out", FLOAT, None)
CARD = ModelCard("yolo", MAPPER)
OPSET = 17

SMALL = (
    Node("ReduceMean", ("images",), ("mean",), {"axes": (1, 2, 3), "keepdims": 1}),
    Node("Squeeze", ("mean", "last"), ("seen",), {}),
)
"""Nodes that make a number (n, 1, 1) of each image."""


def integers(*values: int) -> Array:
    """Return integers as an array."""
    return np.array(values, np.int64)


def floats(*values: float) -> Array:
    """Return numbers as an array of single precision."""
    return np.array(values, np.float32)


def node(operator: str, inputs: str, outputs: str = "out", **attributes: object) -> Node:
    """Return a node.

    Args:
        operator: Its operator.
        inputs: Names of its inputs, with blanks between them; «-»: none in this place.
        outputs: Names of its outputs, with blanks between them.
        attributes: Its attributes.

    Returns:
        The node.
    """
    given = tuple("" if name == "-" else name for name in inputs.split())
    return Node(operator, given, tuple(outputs.split()), attributes)  # type: ignore[arg-type]


def network(nodes: Sequence[Node], card: ModelCard | str = CARD, **constants: Array) -> Network:
    """Return a network that takes tiles.

    Args:
        nodes: Its nodes, of which one gives ``out``; ``seen`` is a number (n, 1, 1) of each image.
        card: Its model card.
        constants: Its arrays.

    Returns:
        The network.
    """
    text = card if isinstance(card, str) else card.to_json()
    arrays = {"last": integers(3), **constants}
    return Network(8, OPSET, (*SMALL, *nodes), arrays, IMAGES, OUTPUT, {CARD_KEY: text})


def detector(boxes: Array, card: ModelCard | str = CARD) -> Network:
    """Return a network that gives the same boxes (4 + kinds, N) for each image.

    Args:
        boxes: Centre, size (cells) and scores.
        card: Its model card.

    Returns:
        The network.
    """
    nodes = (node("Mul", "seen zero", "nothing"), node("Add", "nothing boxes"))
    return network(nodes, card, zero=floats(0.0), boxes=boxes[None].astype(np.float32))


def parameters(values: Array, kinds: int = 26) -> Network:
    """Return a parameter network that gives the same outputs for each crop.

    Args:
        values: The outputs, or one for all.
        kinds: How many there are.

    Returns:
        The network.
    """
    nodes = (
        node("ReduceMean", "crops", "mean", axes=(1, 2, 3), keepdims=0),
        node("Unsqueeze", "mean last", "seen"),
        node("Mul", "seen zero", "nothing"),
        node("Add", "nothing values"),
    )
    arrays = {"last": integers(1), "zero": floats(0.0), "values": np.resize(values, kinds).astype(np.float32)}
    card = ModelCard("cnn", MAPPER, preset="prim", channels=1)
    crops = Port("crops", FLOAT, ("n", 1, 72, 72))
    return Network(8, OPSET, nodes, arrays, crops, OUTPUT, {CARD_KEY: card.to_json()})


def raw_network(nodes: Sequence[bytes], graph: bytes = b"", model: bytes = b"", card: str | None = None) -> bytes:
    """Return a file of messages that :func:`detect.networks.onnx_file.write_network` does not write.

    Args:
        nodes: The nodes (NodeProto) after those that make ``seen``.
        graph: Further fields of the graph.
        model: Further fields of the model.
        card: The model card; None: a right one.

    Returns:
        The file.
    """
    parts = [bytes_field(1, one) for one in (*map(write_node, SMALL), *nodes)]
    parts += [bytes_field(2, b"raw"), bytes_field(5, write_array("last", integers(3)))]
    parts += [bytes_field(11, write_port(IMAGES)), bytes_field(12, write_port(OUTPUT)), graph]
    entry = text_field(1, CARD_KEY) + text_field(2, CARD.to_json() if card is None else card)
    head = integer_field(1, 8) + bytes_field(8, integer_field(2, OPSET)) + bytes_field(14, entry)
    return head + bytes_field(7, b"".join(parts)) + model


def attribute(name: str, kind: int, content: bytes) -> bytes:
    """Return a field of a node that holds an attribute.

    Args:
        name: Its name.
        kind: Its type: AttributeProto.AttributeType.
        content: The field with its value.

    Returns:
        The field.
    """
    return bytes_field(5, text_field(1, name) + content + integer_field(20, kind))


def subgraph(depth: int = 1) -> bytes:
    """Return a graph (GraphProto) whose node holds a graph, and so on."""
    inner = bytes_field(1, write_node(node("Identity", "seen", "inner"))) + bytes_field(12, write_port(OUTPUT))
    for _ in range(depth - 1):
        holder = write_node(node("If", "seen", "inner")) + attribute("then_branch", 5, bytes_field(6, inner))
        inner = bytes_field(1, holder) + bytes_field(2, b"g")
    return inner


# Each of the kinds below is a function from a source of random numbers to a file.


def loop(rng: random.Random) -> bytes:
    operator = rng.choice(["Loop", "Scan", "If", "SequenceMap", "Relu"])
    holder = write_node(node(operator, "seen seen seen")) + attribute("body", 5, bytes_field(6, subgraph()))
    return raw_network([holder])


def subgraphs_without_end(rng: random.Random) -> bytes:
    depth = rng.choice([2, 50, 99, 101, 1000, 5000])
    holder = write_node(node("If", "seen")) + attribute("else_branch", 5, bytes_field(6, subgraph(depth)))
    return raw_network([holder])


def functions(rng: random.Random) -> bytes:
    body = (
        text_field(1, "Relu")
        + text_field(4, "a")
        + text_field(5, "b")
        + bytes_field(7, write_node(node("Relu", "a", "b")))
    )
    domain = rng.choice(["", "ai.onnx", "own"])
    call = write_node(node("Relu", "seen")) + text_field(7, domain)
    return raw_network([call], model=bytes_field(25, body + text_field(10, domain)))


def foreign_domain(rng: random.Random) -> bytes:
    domain = rng.choice(["com.microsoft", "ai.onnx.ml", "ai.onnx.training", "\x1b[31m", "x" * 5000])
    operator = rng.choice(["FusedConv", "QAttention", "StringSplit", "Relu", "\x1b]0;x\x07", "y" * 5000])
    declared = bytes_field(8, text_field(1, domain) + integer_field(2, 1))
    return raw_network([write_node(node(operator, "seen")) + text_field(7, domain)], model=declared)


def external_data(rng: random.Random) -> bytes:
    place = rng.choice(["/etc/passwd", "../cnn.onnx", "yolo.onnx", "/dev/zero", "*/_ORT_MEM_ADDR_/*"])
    entry = bytes_field(13, text_field(1, "location") + text_field(2, place))
    array = integer_field(1, 9) + integer_field(2, 1) + text_field(8, "w") + entry + integer_field(14, 1)
    return raw_network([write_node(node("Add", "seen w"))], graph=bytes_field(5, array))


def sparse_array(rng: random.Random) -> bytes:
    dense = integer_field(2, 1 << rng.randint(20, 62))
    values = bytes_field(1, write_array("w", floats(1.0))) + bytes_field(2, write_array("", integers(3))) + dense
    return raw_network([write_node(node("Add", "seen w"))], graph=bytes_field(15, values))


def texts(rng: random.Random) -> bytes:
    array = integer_field(1, 1) + integer_field(2, 8) + bytes_field(6, b"text") + text_field(8, "w")
    operator = rng.choice(["StringNormalizer", "StringConcat", "RegexFullMatch", "Identity"])
    return raw_network([write_node(node(operator, "w"))], graph=bytes_field(5, array))


def other_operator(rng: random.Random) -> bytes:
    names = "NonZero Unique TopK NonMaxSuppression RandomNormal Multinomial Compress OneHot EyeLike CumSum Einsum"
    names += " SequenceConstruct Optional LSTM GRU Upsample Hardmax Det BitShift STFT DFT GridSample RoiAlign"
    return write_network(network([node(rng.choice(names.split()), "seen")]))


def by_content(rng: random.Random) -> bytes:
    """A size that depends on what an image shows."""
    cast = node("Cast", "seen", "whole", to=7)
    flat = node("Reshape", "whole minus", "sizes")
    use = rng.choice([
        node("ConstantOfShape", "sizes"), node("Expand", "seen sizes"), node("Tile", "seen sizes"),
        node("Reshape", "seen sizes"), node("Range", "zero sizes one"), node("Slice", "seen sizes sizes"),
        node("Resize", "seen - - sizes"), node("Split", "seen sizes", "out more"), node("Pad", "seen sizes"),
    ])  # fmt: skip
    nodes = [cast, flat, use]
    return write_network(network(nodes, minus=integers(-1), zero=integers(0), one=integers(1)))


def bomb(rng: random.Random) -> bytes:
    """A size that is known, and far too large."""
    huge = 1 << rng.choice([24, 26, 31, 32, 40, 62])
    side = 1 << rng.choice([13, 16, 31, 40])
    sizes = integers(*rng.choice([(huge,), (side, side), (1 << 16,) * 4, (-1, huge), (huge, 0), (1 << 62, 4)]))
    node_of = rng.choice([
        node("ConstantOfShape", "sizes"), node("Expand", "seen sizes"), node("Tile", "seen three"),
        node("Range", "zero huge one"), node("Reshape", "seen sizes"), node("Pad", "seen pads"),
        node("Resize", "mean - scales", mode=b"nearest"), node("Resize", "mean - scales", mode=b"linear"),
        node("Resize", "mean - - four"), node("Gather", "seen indices"), node("Unsqueeze", "seen many"),
        node("Range", "fzero fhuge ftiny"),
    ])  # fmt: skip
    arrays = {
        "sizes": sizes, "three": integers(huge, 1, 1), "zero": integers(0), "huge": integers(huge),
        "one": integers(1), "pads": integers(0, 0, 0, 0, 0, huge),
        "scales": floats(1, 1, rng.choice([1e6, 1e18, 1e38]), 1e6),
        "four": integers(1, 1, side, side), "indices": np.zeros((1, 1), np.int64), "many": np.arange(64),
        "fzero": floats(0), "fhuge": floats(1e30), "ftiny": floats(1e-30),
    }  # fmt: skip
    return write_network(network([node_of], **{name: np.asarray(array) for name, array in arrays.items()}))


def constant_bomb(rng: random.Random) -> bytes:
    """Constants that multiply while the network is loaded."""
    count, each = rng.choice([(40, 23), (300, 20), (4000, 12), (8, 26)])
    nodes = [node("ConstantOfShape", "size", f"c{i}") for i in range(count)]
    nodes += [
        node("Concat", " ".join(f"c{i}" for i in range(min(count, 200))), "all", axis=0),
        node("Add", "seen all"),
    ]
    return write_network(network(nodes, size=integers(1 << each)))


def doubling(rng: random.Random) -> bytes:
    """A chain of which each tensor is twice as large as the one before."""
    steps = rng.choice([20, 30, 40, 64, 2000])
    operator = rng.choice(["Concat", "Tile", "Resize", "Expand"])
    nodes = [node("Identity", "mean", "t0")]
    for i in range(steps):
        end = "out" if i == steps - 1 else f"t{i + 1}"
        nodes.append({
            "Concat": node("Concat", f"t{i} t{i}", end, axis=rng.randrange(4)),
            "Tile": node("Tile", f"t{i} repeats", end),
            "Resize": node("Resize", f"t{i} - scales", end, mode=b"nearest"),
            "Expand": node("Expand", f"t{i} repeats", end),
        }[operator])  # fmt: skip
    return write_network(network(nodes, repeats=integers(1, 1, 1, 2), scales=floats(1, 1, 1, 2)))


def long_chain(rng: random.Random) -> bytes:
    """Many nodes, each of which takes its time."""
    steps, side = rng.choice([(5000, 1), (100_000, 1), (1000, 3000), (100, 4000), (300, 2000)])
    operator = rng.choice(["MatMul", "Add", "Pow", "Softmax", "Transpose", "Erf"])
    nodes = [node("Expand", "seen sizes", "t0")]
    for i in range(steps):
        given = f"t{i} t{i}" if operator in ("MatMul", "Add", "Pow") else f"t{i}"
        nodes.append(node(operator, given, "out" if i == steps - 1 else f"t{i + 1}"))
    return write_network(network(nodes, sizes=integers(1, side, side)))


def slow_convolution(rng: random.Random) -> bytes:
    channels, filters, side, kernel = rng.choice([
        (64, 4096, 224, 15), (1024, 1024, 224, 3), (1, 1, 2000, 501), (4096, 4096, 64, 1), (512, 512, 100, 31)
    ])  # fmt: skip
    pads = (rng.choice([0, 1 << 20, 1 << 40]),) * 4
    nodes = [
        node("Expand", "mean sizes", "x"), node("Expand", "one weights", "w"),
        node("Conv", "x w", pads=pads, group=rng.choice([1, channels])),
    ]  # fmt: skip
    arrays = {"sizes": integers(1, channels, side, side), "weights": integers(filters, channels, kernel, kernel)}
    return write_network(network(nodes, one=floats(1.0), **arrays))


def slow_pooling(rng: random.Random) -> bytes:
    side, kernel = rng.choice([(1000, 999), (2000, 501), (224, 223)])
    operator = rng.choice(["MaxPool", "AveragePool"])
    nodes = [node("Expand", "mean sizes", "x"), node(operator, "x", kernel_shape=(kernel, kernel), strides=(1, 1))]
    return write_network(network(nodes, sizes=integers(1, 4, side, side)))


def outer_products(rng: random.Random) -> bytes:
    size = rng.choice([4000, 10_000, 1 << 20])
    product = node(rng.choice(["MatMul", "Mul"]), "a b")
    nodes = [node("Expand", "seen column", "a"), node("Expand", "seen row", "b"), product]
    return write_network(network(nodes, column=integers(1, size, 1), row=integers(1, 1, size)))


def many_parts(rng: random.Random) -> bytes:
    """Millions of fields of two bytes, each of which may take a hundred when it is read."""
    field = bytes_field(rng.choice([1, 5, 11, 12, 13, 14, 15, 16]), b"") * rng.choice([300_000, 2_000_000])
    return rng.choice([raw_network([], graph=field), raw_network([], model=field)])


def broken_wire(rng: random.Random) -> bytes:
    """Fields that are no fields."""
    whole = raw_network([write_node(node("Relu", "seen"))])
    return rng.choice([
        whole + b"\xff" * 20, whole + b"\x3b\x3c", whole + b"\x3a\xff\xff\xff\xff\x7f", whole + whole, b"\x0a" * 1000,
        bytes_field(7, bytes_field(7, b"\x08" * 100)), whole[: rng.randrange(len(whole))], rng.randbytes(1000),
    ])  # fmt: skip


def impossible_array(rng: random.Random) -> bytes:
    """An array whose shape, type and bytes contradict each other."""
    sizes = rng.choice([(1 << 32, 1 << 32), (-1,), (1 << 62, 1 << 62, 0), (9,), (0,), (1,) * 5000])
    dtype = rng.choice([0, 1, 6, 7, 9, 10, 11, 8, 16, 17, 22, -5, 1 << 40])
    data = rng.choice([
        bytes_field(9, rng.randbytes(rng.randint(0, 64))), bytes_field(4, rng.randbytes(9)),
        bytes_field(7, b"\xff" * 9), bytes_field(5, b"\x01" * 9), integer_field(9, 5), b"",
    ])  # fmt: skip
    array = b"".join(integer_field(1, size) for size in sizes) + integer_field(2, dtype) + text_field(8, "w") + data
    return raw_network([write_node(node("Add", "seen w"))], graph=bytes_field(5, array))


def impossible_attribute(rng: random.Random) -> bytes:
    """Steps of zero, no groups, axes that are not there, values of another type."""
    value = rng.choice([(0, 0), (-1, -1), (1,), (1 << 40, 1), (), 0, -1, 1 << 62, 1.5, b"x", floats(1.0)])
    attributes: dict[str, object] = {
        "kernel_shape": (3, 3),
        "pads": (1, 1, 1, 1),
        "strides": (1, 1),
        "dilations": (1, 1),
    }
    attributes |= {"group": 1}
    operator, given = rng.choice([
        ("Conv", "images weights"), ("MaxPool", "images"), ("AveragePool", "images"), ("Transpose", "images"),
        ("Concat", "images images"), ("Split", "images"), ("Softmax", "images"), ("Gather", "images last"),
        ("Flatten", "images"), ("ReduceMean", "images"), ("Cast", "images"), ("Gemm", "seen seen"),
    ])  # fmt: skip
    if operator != "Conv":
        del attributes["group"]
    if "Pool" not in operator and operator != "Conv":
        attributes = {}
    name = rng.choice([*attributes, "axis", "perm", "axes", "to", "keepdims", "auto_pad", "ceil_mode", "alpha"])
    attributes[name] = value
    return write_network(network([node(operator, given, **attributes)], weights=np.ones((4, 3, 3, 3), np.float32)))


def integer_division(rng: random.Random) -> bytes:
    """A division that ends a process: by zero, or of the least integer by -1."""
    nodes = [
        node("Cast", "seen", "whole", to=7),
        node(rng.choice(["Div", "Mod"]), "whole by", "q"),
        node("Cast", "q", to=1),
    ]
    if rng.random() < 0.5:
        nodes = [node("Div", "least by", "q"), node("Cast", "q", "f", to=1), node("Add", "seen f")]
    return write_network(network(nodes, by=integers(rng.choice([0, -1])), least=integers(-(1 << 63))))


def boxes(rng: random.Random) -> bytes:
    """Boxes that are none, or that lie anywhere."""
    wild = [np.inf, -np.inf, np.nan, 1e30, -1e30, 3e38, 0.0, -5.0, 1e-30, 1e9, 700.0, 100.0]
    found = np.full((9, rng.choice([1, 50, 1029])), 100.0, np.float32)
    found[4:] = 0.9
    for _ in range(rng.randint(1, 4)):
        found[rng.randrange(9), rng.choice([0, slice(None)])] = rng.choice(wild)
    return write_network(detector(found))


def many_boxes(rng: random.Random) -> bytes:
    count = rng.choice([300, 1029, 4000, 20_000, 200_000])
    made = np.random.default_rng(rng.randrange(1 << 30))
    centre, size = made.uniform(0, 224, (2, count)), np.full((2, count), rng.choice([1e-3, 2.0, 30.0]))
    return write_network(detector(np.concatenate((centre, size, made.uniform(0, 1, (5, count))))))


def other_outputs(rng: random.Random) -> bytes:
    """Outputs of another shape or type than a detector's."""
    shape = rng.choice([(9,), (1, 9), (1, 9, 0), (9, 1, 10), (1, 10, 9), (1, 9, 10, 1), (), (3, 9, 10), (1,) * 12])
    nodes = [node("Add", "seen w")] if len(shape) != 3 else [node("Identity", "w")]
    to = rng.choice([1, 7, 9, 10, 11])
    if to != 1:
        nodes = [replace(nodes[0], outputs=("f",)), node("Cast", "f", to=to)]
    return write_network(network(nodes, w=np.zeros(shape, np.float32)))


def outputs_of_parameters(rng: random.Random) -> bytes:
    wild = [np.inf, np.nan, 1e30, -1e30, 3e38, 0.0, 1e-38, 1e4, 999.0, -999.0, 5.0, -5.0]
    values = np.array([rng.choice(wild[2:]) for _ in range(26)]) if rng.random() < 0.5 else np.array(rng.choice(wild))
    return write_network(parameters(values, rng.choice([26, 26, 26, 1, 25, 27])))


def card(rng: random.Random) -> bytes:
    """A model card that is none."""
    fields = json.loads(CARD.to_json())
    wild = [
        None, True, 3, -1, 10**30, 1e-300, 1e300, "", "x" * 100_000, "\x1b]0;x\x07", [], {}, [[]], [["square"]],
        {"a": {}}, ["square", "square"], {"square": 7}, {"square": None}, {"\x1b[31m": 0.5},
        float("nan"), "square",
    ]  # fmt: skip
    name = rng.choice([*fields, "magic", "\x1b[1m", "about"])
    text = json.dumps(fields | {name: rng.choice(wild)})
    nested = "[" * rng.choice([100, 900, 5000, 200_000])
    others = [
        nested, f'{{"schema": "prim-weights/1", "about": {nested}', "1" * 10_000, "NaN",
        text[: rng.randrange(len(text))], text.replace("0.01", "9" * 400), "\x00",
    ]  # fmt: skip
    return raw_network([write_node(node("Identity", "seen"))], card=rng.choice([text] * 7 + others))


def damaged(rng: random.Random) -> bytes:
    """The shipped YOLO with bytes changed or cut."""
    content = bytearray((SHIPPED / MAPPER / "yolo.onnx").read_bytes())
    ends = 60_000  # the nodes lie at the front, names and card at the back
    for _ in range(rng.choice([1, 1, 3, 30])):
        places = (rng.randrange(len(content)), rng.randrange(ends), len(content) - 1 - rng.randrange(ends))
        content[rng.choice(places)] = rng.randrange(256)
    return bytes(content if rng.random() < 0.8 else content[: rng.randrange(len(content))])


def damaged_parameters(rng: random.Random) -> bytes:
    """The shipped parameter network with bytes changed."""
    content = bytearray((SHIPPED / MAPPER / "cnn.onnx").read_bytes())
    for _ in range(rng.choice([1, 3, 30])):
        content[rng.choice([rng.randrange(len(content)), rng.randrange(3000), -1 - rng.randrange(3000)])] ^= (
            1 << rng.randrange(8)
        )
    return bytes(content)


def changed(rng: random.Random) -> bytes:
    """The shipped YOLO with nodes, attributes or constants changed."""
    whole = read_network((SHIPPED / MAPPER / "yolo.onnx").read_bytes())
    nodes, constants = list(whole.nodes), dict(whole.constants)
    names = [name for one in nodes for name in one.outputs]
    plain = [i for i, one in enumerate(nodes) if one.operator != "Cast"]
    for _ in range(rng.choice([1, 1, 2, 5])):
        i = rng.choice(plain)
        nodes[i] = _changed_node(rng, nodes[i], names, [one.operator for one in nodes])
        small = [name for name, array in constants.items() if array.size < 10]
        name = rng.choice(small)
        if rng.random() < 0.5:
            array = constants[name].copy()
            array.ravel()[...] = np.array(rng.choice([0, -1, 1, 2, 7, 1000, 1 << 31])).astype(array.dtype)
            constants[name] = array
    return write_network(replace(whole, nodes=tuple(nodes), constants=constants))


def _changed_node(rng: random.Random, one: Node, names: Sequence[str], operators: Sequence[str]) -> Node:
    choice = rng.randrange(4)
    if choice == 0:
        return replace(one, operator=rng.choice(operators))
    if choice == 1 and one.attributes:
        name = rng.choice(list(one.attributes))
        value = one.attributes[name]
        wild = tuple(rng.choice([0, 1, -1, 3, 100, 1 << 33]) for _ in value) if isinstance(value, tuple) else -7
        return replace(one, attributes={**one.attributes, name: wild})
    inputs = list(one.inputs)
    if choice == 2 and inputs:
        inputs[rng.randrange(len(inputs))] = rng.choice(names)
        return replace(one, inputs=tuple(inputs))
    return replace(one, inputs=tuple(inputs[: rng.randrange(len(inputs) + 1)]))


YOLO_KINDS: tuple[Callable[[random.Random], bytes], ...] = (
    loop, subgraphs_without_end, functions, foreign_domain, external_data, sparse_array, texts, other_operator,
    by_content, bomb, constant_bomb, doubling, long_chain, slow_convolution, slow_pooling, outer_products, many_parts,
    broken_wire, impossible_array, impossible_attribute, integer_division, boxes, many_boxes, other_outputs, card,
    damaged, changed,
)  # fmt: skip
CNN_KINDS: tuple[Callable[[random.Random], bytes], ...] = (outputs_of_parameters, damaged_parameters)

KINDS: Mapping[str, Callable[[random.Random], bytes]] = {
    **{f"yolo {kind.__name__}": kind for kind in YOLO_KINDS},
    **{f"cnn {kind.__name__}": kind for kind in CNN_KINDS},
}
"""The kinds of hostile networks by their names."""


def hostile_networks(rng: random.Random) -> Iterator[tuple[str, bytes]]:
    """Make hostile networks without end: all kinds in turn.

    Args:
        rng: The source of random numbers.

    Yields:
        A name, which begins with the stage (``yolo`` or ``cnn``), and the ONNX file.
    """
    while True:
        for name, kind in KINDS.items():
            with np.errstate(all="ignore"):
                content = kind(rng)
            yield name, content
