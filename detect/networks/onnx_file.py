"""ONNX files: the part of the format that detectors need, read within bounds, and written anew.

ONNX Runtime would parse all of a file, with functions, subgraphs, sparse and external arrays, whatever it takes. Here
the fields of onnx.proto (protobuf's wire format) that a detector has are read, others are left out or refused, and
ONNX Runtime is given the network as it is written anew: nothing that has not been checked.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from detect.networks.limits import DEFAULTS, GraphError, NetworkLimits
from prim.strict_json import shown

Array = NDArray[Any]
DType = np.dtype[Any]

Attribute = int | float | bytes | tuple[int, ...] | tuple[float, ...] | Array
"""An attribute of a node: a number, a text, numbers or an array."""

DTYPES: Mapping[int, DType] = {
    1: np.dtype("<f4"), 6: np.dtype("<i4"), 7: np.dtype("<i8"), 9: np.dtype("?"), 10: np.dtype("<f2"),
    11: np.dtype("<f8"),
}  # fmt: skip
"""Types of elements by their numbers in TensorProto.DataType; a network that has others is refused."""

DTYPE_NUMBERS = {dtype: number for number, dtype in DTYPES.items()}

MIN_IR_VERSION = 4
"""From this version of the format on, constants need not be inputs of the graph: it is written with at least this."""

VARINT, FIXED64, BYTES, FIXED32 = 0, 1, 2, 5
"""Types of fields on the wire."""

FLOAT, INT, STRING, TENSOR, FLOATS, INTS = 1, 2, 3, 4, 6, 7
"""Types of attributes: AttributeProto.AttributeType."""

REFUSED_ATTRIBUTES = {5: "a subgraph", 10: "subgraphs", 11: "a sparse array", 12: "sparse arrays", 8: "texts"}
"""What attributes of other types hold."""

EXTERNAL = 1
"""TensorProto.DataLocation of arrays in other files."""


@dataclass(frozen=True)
class Node:
    """A node of a graph.

    Attributes:
        operator: Its operator, of ONNX's own set.
        inputs: Names of the tensors that it takes; an empty name: none in this place.
        outputs: Names of the tensors that it gives.
        attributes: Its attributes by name.
    """

    operator: str
    inputs: tuple[str, ...]
    outputs: tuple[str, ...]
    attributes: Mapping[str, Attribute]


@dataclass(frozen=True)
class Port:
    """A graph's input or output.

    Attributes:
        name: Its name.
        dtype: Type of its elements.
        shape: Its dimensions, an int or a name where they are free; None where the file does not say.
    """

    name: str
    dtype: DType
    shape: tuple[int | str, ...] | None


@dataclass(frozen=True)
class Network:
    """A network as an ONNX file holds it.

    Attributes:
        ir_version: Version of the file's format.
        opset: Version of ONNX's set of operators.
        nodes: The nodes, each after those whose outputs it takes.
        constants: The arrays (initializers) by name.
        input: The one input.
        output: The first output: the only one that is used.
        metadata: Texts by key.
    """

    ir_version: int
    opset: int
    nodes: tuple[Node, ...]
    constants: Mapping[str, Array]
    input: Port
    output: Port
    metadata: Mapping[str, str]


def read_network(content: bytes, limits: NetworkLimits = DEFAULTS) -> Network:
    """Read a network.

    Args:
        content: The ONNX file.
        limits: Bounds of its size and its number of fields.

    Returns:
        The network; its arrays share the memory of ``content``.

    Raises:
        GraphError: The file is too large, no ONNX file or a damaged one, or holds what no detector needs: functions,
            subgraphs, operators of other sets, sparse arrays, arrays in other files.
    """
    if len(content) > limits.max_file_bytes:
        raise GraphError(f"it has {len(content)} bytes, more than {limits.max_file_bytes}")
    model = _Message(memoryview(content), _Budget(limits.max_fields))
    if model.has(25):
        raise GraphError("it has functions of its own")
    opset, graph = _opset(model), model.message(7)
    if graph.has(15):
        raise GraphError("it has sparse arrays")
    constants = dict(_named_array(message) for message in graph.messages(5))
    inputs = [port for port in map(_port, graph.messages(11)) if port.name not in constants]
    outputs = graph.messages(12)
    if len(inputs) != 1 or not outputs:
        raise GraphError(f"it has {len(inputs)} inputs and {len(outputs)} outputs, not one of each")
    return Network(
        ir_version=model.integer(1),
        opset=opset,
        nodes=tuple(map(_node, graph.messages(1))),
        constants=constants,
        input=inputs[0],
        output=_port(outputs[0]),
        metadata={message.text(1): message.text(2) for message in model.messages(14)},
    )


class _Budget:
    """How many fields and numbers may still be read."""

    def __init__(self, left: int) -> None:
        self.left = left

    def spend(self) -> None:
        self.left -= 1
        if self.left < 0:
            raise GraphError("it has too many parts")


class _Message:
    """A message: its fields by number, as they are on the wire; of one that is not repeated the last one counts."""

    def __init__(self, data: memoryview, budget: _Budget) -> None:
        self._budget = budget
        self._fields: dict[int, list[int | memoryview]] = {}
        for number, value in _fields(data):
            budget.spend()
            self._fields.setdefault(number, []).append(value)

    def has(self, number: int) -> bool:
        return number in self._fields

    def pieces(self, number: int) -> list[memoryview]:
        values = self._fields.get(number, [])
        pieces = [value for value in values if isinstance(value, memoryview)]
        if len(pieces) < len(values):
            raise GraphError("it is damaged: a number in place of bytes")
        return pieces

    def messages(self, number: int) -> list[_Message]:
        return [_Message(piece, self._budget) for piece in self.pieces(number)]

    def message(self, number: int) -> _Message:
        pieces = self.pieces(number)
        if len(pieces) > 1:
            raise GraphError("it is damaged: a part that there must be one of comes twice")
        return _Message(pieces[0] if pieces else memoryview(b""), self._budget)

    def texts(self, number: int) -> list[str]:
        try:
            return [str(piece, "utf-8") for piece in self.pieces(number)]
        except UnicodeDecodeError:
            raise GraphError("it is damaged: a name that is no text") from None

    def text(self, number: int) -> str:
        return (self.texts(number) or [""])[-1]

    def integers(self, number: int) -> tuple[int, ...]:
        """Return signed integers, packed or not."""
        integers: list[int] = []
        for value in self._fields.get(number, []):
            if isinstance(value, int):
                integers.append(_signed(value))
                continue
            at = 0
            while at < len(value):
                self._budget.spend()
                item, at = _varint(value, at)
                integers.append(_signed(item))
        return tuple(integers)

    def integer(self, number: int) -> int:
        return (self.integers(number) or (0,))[-1]

    def floats(self, number: int, code: str = "<f4") -> Array:
        data = b"".join(self.pieces(number))
        if len(data) % np.dtype(code).itemsize:
            raise GraphError("it is damaged: an array is cut off")
        return np.frombuffer(data, code)


def _fields(data: memoryview) -> Iterator[tuple[int, int | memoryview]]:
    """Yield numbers and values of a message's fields: ints, or the bytes of what has another form."""
    at = 0
    while at < len(data):
        key, at = _varint(data, at)
        number, wire = key >> 3, key & 7
        if wire == VARINT:
            value, at = _varint(data, at)
            yield number, value
            continue
        if wire == BYTES:
            size, at = _varint(data, at)
        elif wire in (FIXED32, FIXED64):
            size = 4 if wire == FIXED32 else 8
        else:
            raise GraphError("it is no ONNX network, or a damaged one")
        if size > len(data) - at:
            raise GraphError("it is no ONNX network, or it is cut off")
        yield number, data[at : at + size]
        at += size


def _varint(data: memoryview, at: int) -> tuple[int, int]:
    """Return an integer of 64 bits, and where the next one begins."""
    value = shift = 0
    while at < len(data) and shift < 64:
        byte = data[at]
        at += 1
        value |= (byte & 127) << shift
        shift += 7
        if byte < 128:
            return value & (1 << 64) - 1, at
    raise GraphError("it is no ONNX network, or it is cut off")


def _signed(value: int) -> int:
    return value - (1 << 64) if value >> 63 else value


def _opset(model: _Message) -> int:
    """Return the version of ONNX's own operators; other sets may be named, but none of their operators is taken."""
    versions = [message.integer(2) for message in model.messages(8) if message.text(1) in ("", "ai.onnx")]
    if len(versions) != 1:
        raise GraphError("it is no ONNX network, or does not say of which version its operators are")
    return versions[0]


def _port(message: _Message) -> Port:
    tensor = message.message(2).message(1)
    dtype = _dtype(tensor.integer(1))
    shape = None
    if tensor.has(2):
        shape = tuple(dim.integer(1) if dim.has(1) else dim.text(2) for dim in tensor.message(2).messages(1))
    return Port(message.text(1), dtype, shape)


def _dtype(number: int) -> DType:
    if number not in DTYPES:
        raise GraphError(f"it has elements of type {number} of ONNX, which detectors have no use for")
    return DTYPES[number]


def _node(message: _Message) -> Node:
    operator, domain = message.text(4), message.text(7)
    if domain not in ("", "ai.onnx"):
        raise GraphError(f"it has the operator {shown(operator)} of {shown(domain)}: only ONNX's own are run")
    attributes = dict(_attribute(operator, part) for part in message.messages(5))
    return Node(operator, tuple(message.texts(1)), tuple(message.texts(2)), attributes)


def _attribute(operator: str, message: _Message) -> tuple[str, Attribute]:
    name, kind = message.text(1), message.integer(20)
    if kind in REFUSED_ATTRIBUTES or message.has(6) or message.has(11):
        what = REFUSED_ATTRIBUTES.get(kind, "a subgraph")
        raise GraphError(f"the operator {shown(operator)} has {what}: such are not run")
    if kind == FLOAT:
        pieces = message.pieces(2)
        return name, struct.unpack("<f", pieces[-1])[0] if pieces and len(pieces[-1]) == 4 else 0.0
    if kind == INT:
        return name, message.integer(3)
    if kind == STRING:
        return name, bytes((message.pieces(4) or [memoryview(b"")])[-1])
    if kind == TENSOR:
        return name, _named_array(message.message(5))[1].copy()
    if kind == FLOATS:
        return name, tuple(message.floats(7).tolist())
    if kind == INTS:
        return name, message.integers(8)
    raise GraphError(f"the operator {shown(operator)} has an attribute of type {kind}, which none needs")


def _named_array(message: _Message) -> tuple[str, Array]:
    name = message.text(8)
    if message.integer(14) == EXTERNAL or message.has(13):
        raise GraphError(f"its array {shown(name)} is in another file: store all in one")
    dtype, shape = _dtype(message.integer(2)), message.integers(1)
    values = _elements(message, dtype)
    error = GraphError(f"its array {shown(name)} of shape {shown(shape)} has {len(values)} elements")
    if any(size < 0 for size in shape) or math.prod(shape) != len(values):
        raise error
    try:
        return name, values.reshape(shape)
    except ValueError:  # more dimensions than an array can have, or larger ones
        raise error from None


def _elements(message: _Message, dtype: DType) -> Array:
    """Return an array's elements, which are in one of several fields."""
    if message.has(9):
        raw = message.pieces(9)[-1]
        if len(raw) % dtype.itemsize:
            raise GraphError("it is damaged: an array is cut off")
        return np.frombuffer(raw, np.uint8).astype(bool) if dtype.kind == "b" else np.frombuffer(raw, dtype)
    if dtype.kind == "f" and dtype.itemsize > 2:
        return message.floats(4 if dtype.itemsize == 4 else 10, dtype.str)
    numbers = np.array(message.integers(7 if dtype.itemsize == 8 else 5), np.int64)
    return numbers.astype(np.uint16).view(dtype) if dtype.kind == "f" else numbers.astype(dtype)


def write_network(network: Network) -> bytes:
    """Write a network as an ONNX file.

    Args:
        network: The network.

    Returns:
        The file: without names of nodes, documentation, declared shapes of tensors within, and other outputs.
    """
    graph = [
        *(bytes_field(1, write_node(node)) for node in network.nodes),
        bytes_field(2, b"prim"),
        *(bytes_field(5, write_array(name, array)) for name, array in network.constants.items()),
        bytes_field(11, write_port(network.input)),
        bytes_field(12, write_port(network.output)),
    ]
    return b"".join(
        [
            integer_field(1, max(network.ir_version, MIN_IR_VERSION)),
            bytes_field(8, integer_field(2, network.opset)),
            *(bytes_field(14, text_field(1, key) + text_field(2, value)) for key, value in network.metadata.items()),
            bytes_field(7, b"".join(graph)),
        ]
    )


def _write_varint(value: int) -> bytes:
    value &= (1 << 64) - 1
    parts = bytearray()
    while value > 127:
        parts.append(value & 127 | 128)
        value >>= 7
    return bytes([*parts, value])


def integer_field(number: int, value: int) -> bytes:
    """Write a field of a message.

    Args:
        number: Its number.
        value: An integer of up to 64 bits.

    Returns:
        The field.
    """
    return _write_varint(number << 3 | VARINT) + _write_varint(value)


def bytes_field(number: int, data: bytes) -> bytes:
    """Write a field of a message.

    Args:
        number: Its number.
        data: Bytes, among them those of another message.

    Returns:
        The field.
    """
    return _write_varint(number << 3 | BYTES) + _write_varint(len(data)) + data


def text_field(number: int, text: str) -> bytes:
    """See :func:`bytes_field`."""
    return bytes_field(number, text.encode())


def _texts(number: int, texts: Sequence[str]) -> bytes:
    return b"".join(text_field(number, text) for text in texts)


def write_node(node: Node) -> bytes:
    """Return a node as a message (NodeProto)."""
    attributes = [bytes_field(5, _write_attribute(name, value)) for name, value in node.attributes.items()]
    return _texts(1, node.inputs) + _texts(2, node.outputs) + text_field(4, node.operator) + b"".join(attributes)


def _write_attribute(name: str, value: Attribute) -> bytes:
    """Return an AttributeProto; an empty tuple is one of integers."""
    if isinstance(value, int):
        kind, content = INT, integer_field(3, value)
    elif isinstance(value, float):
        kind, content = FLOAT, _write_varint(2 << 3 | FIXED32) + struct.pack("<f", value)
    elif isinstance(value, bytes):
        kind, content = STRING, bytes_field(4, value)
    elif isinstance(value, np.ndarray):
        kind, content = TENSOR, bytes_field(5, write_array("", value))
    elif value and isinstance(value[0], float):
        kind, content = FLOATS, bytes_field(7, np.array(value, "<f4").tobytes())
    else:
        kind, content = INTS, b"".join(integer_field(8, int(item)) for item in value)
    return text_field(1, name) + content + integer_field(20, kind)


def write_array(name: str, array: Array) -> bytes:
    """Write an array as a message (TensorProto).

    Args:
        name: Its name.
        array: Its elements, of one of DTYPES.

    Returns:
        The message.
    """
    sizes = b"".join(integer_field(1, size) for size in array.shape)
    return (
        sizes + integer_field(2, DTYPE_NUMBERS[array.dtype]) + text_field(8, name) + bytes_field(9, array.tobytes())
    )


def write_port(port: Port) -> bytes:
    """Return an input or output of a graph as a message (ValueInfoProto)."""
    tensor = integer_field(1, DTYPE_NUMBERS[port.dtype])
    if port.shape is not None:
        sizes = [integer_field(1, size) if isinstance(size, int) else text_field(2, size) for size in port.shape]
        tensor += bytes_field(2, b"".join(bytes_field(1, size) for size in sizes))
    return text_field(1, port.name) + bytes_field(2, bytes_field(1, tensor))
