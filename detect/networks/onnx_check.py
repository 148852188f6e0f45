"""Checks of a network before it is run: by the shapes of all tensors, what a run takes."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np

from detect.networks.limits import DEFAULTS, GraphError, NetworkLimits
from detect.networks.onnx_file import Array, Network, Node, Port
from detect.networks.onnx_operators import MAX_OPSET, MIN_OPSET, Call, Shape, Value, infer
from prim.strict_json import shown

FLOAT = np.dtype(np.float32)


@dataclass
class Costs:
    """What a run of a network takes.

    Attributes:
        multiply_adds: Multiply-adds, or as much other work.
        constant_bytes: Size (bytes) of all tensors that depend on constants alone.
        activation_bytes: Size (bytes) of all others.
        live_bytes: Largest size (bytes) of those that are needed at a time, in the order of the nodes.
        shapes: Shapes of all tensors by name.
    """

    multiply_adds: float = 0.0
    constant_bytes: int = 0
    activation_bytes: int = 0
    live_bytes: int = 0
    shapes: dict[str, Shape] = field(default_factory=dict)


def check_network(network: Network, input_shape: Shape, limits: NetworkLimits = DEFAULTS) -> Costs:
    """Check what a run of a network takes: a network that is too large is found before anything is computed.

    Args:
        network: The network.
        input_shape: Shape of what it is run on, of single precision.
        limits: The bounds.

    Returns:
        The costs, which are within the bounds.

    Raises:
        GraphError: The network has operators that are not run, does not take such an input, has shapes that do not
            fit together or depend on what an image shows, or exceeds a bound.
    """
    if not MIN_OPSET <= network.opset <= MAX_OPSET:
        raise GraphError(f"it has operators of version {network.opset}, not of {MIN_OPSET} to {MAX_OPSET}")
    if len(network.nodes) > limits.max_nodes:
        raise GraphError(f"it has {len(network.nodes)} nodes, more than {limits.max_nodes}")
    return _Inference(network, limits).run(input_shape)


class NetworkCheck:
    """The checks of one network, done once for each shape of its input.

    Args:
        network: The network.
        limits: The bounds.
    """

    def __init__(self, network: Network, limits: NetworkLimits = DEFAULTS) -> None:
        constants = {name: _sizes_of(array, limits.max_known) for name, array in network.constants.items()}
        self._network, self._limits = replace(network, constants=constants), limits
        self._costs: dict[Shape, Costs] = {}

    def __call__(self, input_shape: Shape) -> Costs:
        """See :func:`check_network`."""
        if input_shape not in self._costs:
            self._costs[input_shape] = check_network(self._network, input_shape, self._limits)
        return self._costs[input_shape]


class _Inference:
    """The shapes of one network's tensors, node by node."""

    def __init__(self, network: Network, limits: NetworkLimits) -> None:
        self._network, self._limits = network, limits
        self._values: dict[str, Value] = {}
        self._costs = Costs()
        self._last_use = {name: i for i, node in enumerate(network.nodes) for name in node.inputs}
        self._last_use[network.output.name] = len(network.nodes)
        self._live = 0

    def run(self, input_shape: Shape) -> Costs:
        _check_input(self._network.input, input_shape)
        self._keep(self._network.input.name, Value(input_shape, FLOAT))
        for name, array in self._network.constants.items():
            self._keep(name, _constant(array, self._limits.max_known))
        for i, node in enumerate(self._network.nodes):
            self._add(i, node)
        output = self._values.get(self._network.output.name)
        if output is None or output.dtype != FLOAT:
            raise GraphError("its output is not in single precision, or not there")
        self._costs.shapes = {name: value.shape for name, value in self._values.items()}
        return self._costs

    def _add(self, i: int, node: Node) -> None:
        inputs = tuple(self._values.get(name) for name in node.inputs)
        for name, value in zip(node.inputs, inputs, strict=True):
            if name and value is None:
                raise GraphError(f"its {shown(node.operator)} takes {shown(name)}, which no node before it gives")
        call = Call(node.operator, self._network.opset, inputs, node.attributes, len(node.outputs))
        inferred = infer(call, self._limits.max_known)
        costs, limits = self._costs, self._limits
        costs.multiply_adds += inferred.work
        _check("multiply-adds", costs.multiply_adds, limits.max_multiply_adds)
        for name, value in zip(node.outputs, inferred.values, strict=True):
            self._keep(name, value)
        costs.live_bytes = max(costs.live_bytes, self._live)
        _check("bytes in use at a time", costs.live_bytes, limits.max_live_bytes)
        for name in {*node.inputs, *node.outputs}:
            if self._last_use.get(name, -1) <= i and name in self._values and not self._values[name].is_constant:
                self._live -= self._values[name].nbytes

    def _keep(self, name: str, value: Value) -> None:
        """Add a tensor to those that are known."""
        costs, limits = self._costs, self._limits
        if name in self._values or not name:
            raise GraphError(f"it gives two tensors the name {shown(name)}")
        if len(value.shape) > limits.max_rank:
            raise GraphError(f"its {shown(name)} has {len(value.shape)} dimensions, more than {limits.max_rank}")
        _check(f"elements in {shown(name)} of shape {shown(value.shape)}", value.elements, limits.max_elements)
        if value.elements == 0 and value.data is None:
            raise GraphError(f"its {shown(name)} of shape {shown(value.shape)} has no elements")
        self._values[name] = value
        if value.is_constant:
            costs.constant_bytes += value.nbytes
            _check("bytes of constants", costs.constant_bytes, limits.max_constant_bytes)
            return
        self._live += value.nbytes
        costs.activation_bytes += value.nbytes
        _check("bytes of all tensors", costs.activation_bytes, limits.max_activation_bytes)


def _check(what: str, size: float, limit: float) -> None:
    if size > limit:
        raise GraphError(f"it takes {what}: {size:.4g}, more than {limit:.4g}")


def _sizes_of(array: Array, max_known: int) -> Array:
    """Return a copy of a small array, and zeros that take no memory in place of a large one."""
    return array.copy() if array.size <= max_known else np.broadcast_to(array.dtype.type(0), array.shape)


def _constant(array: Array, max_known: int) -> Value:
    return Value(array.shape, array.dtype, array if array.size <= max_known else None, True)


def _check_input(port: Port, shape: Shape) -> None:
    """Check that a network takes an input of a shape."""
    declared = (None,) * len(shape) if port.shape is None else port.shape
    fits = len(declared) == len(shape) and all(
        not isinstance(size, int) or size == actual for size, actual in zip(declared, shape, strict=False)
    )
    if not fits or port.dtype != FLOAT:
        raise GraphError(f"it takes {shown(declared)} of {port.dtype}, not {shown(shape)} of {FLOAT}")
