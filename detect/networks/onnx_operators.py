"""The operators of ONNX that detectors need: for each the shapes of what it gives, and the work that it takes.

Other operators are not run: those with loops, branches, sequences and texts, and those whose outputs' sizes depend on
what an image shows. The semantics are those of ONNX's operator sets 11 to 22.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import reduce

import numpy as np

from detect.networks.limits import GraphError
from detect.networks.onnx_file import DTYPES, Array, Attribute, DType
from prim.strict_json import shown

Shape = tuple[int, ...]

MIN_OPSET, MAX_OPSET = 11, 22
"""Versions of ONNX's operator set whose operators are as they are here."""

AXES_AS_INPUT = {"Squeeze": 13, "Unsqueeze": 13, "ReduceSum": 13}
"""Versions from which on an operator takes its axes as an input, before as an attribute."""

REDUCTION_AXES_AS_INPUT, SPLIT_AS_INPUT = 18, 13
"""The same for the other reductions, and for the sizes of Split's parts."""

FIXED: Mapping[str, tuple[Attribute, ...]] = {
    "auto_pad": (b"NOTSET",),
    "ceil_mode": (0,),
    "storage_order": (0,),
    "allowzero": (0,),
    "antialias": (0,),
    "exclude_outside": (0,),
    "training_mode": (0,),
    "noop_with_empty_axes": (0,),
    "keepdims": (0, 1),
    "transA": (0, 1),
    "transB": (0, 1),
    "count_include_pad": (0, 1),
    "mode": (b"nearest", b"linear", b"constant", b"reflect", b"edge"),
    "coordinate_transformation_mode": (b"half_pixel", b"asymmetric", b"align_corners", b"pytorch_half_pixel"),
    "keep_aspect_ratio_policy": (b"stretch",),
}
"""The values that attributes may have where others would change shapes, or are not needed."""


FAR = 2.0**31
"""Range's bounds are nearer to zero than this, so that numbers of all types are exact in double precision."""

NARROW_FILTERS, NARROW_WORK = 8, 4
"""A multiply-add of a convolution with fewer filters in a group than this takes as long as this many others."""

CALL_WORK = 2000
"""A convolution of one image in one group, or a product of two matrices, takes this many multiply-adds more."""

POOLING_WORK = 4
"""So does a comparison or an addition of pooling."""

PLAIN_WORK, COSTLY, SOFTMAX_WORK = 16.0, 32.0, 128.0
"""Work for each element that goes in or out: of most operators, of functions that take many steps, of Softmax."""


@dataclass(frozen=True)
class Value:
    """What is known of a tensor.

    Attributes:
        shape: Its shape.
        dtype: Type of its elements.
        data: Its elements, where it is small and depends on sizes and constants alone; else None.
        is_constant: Whether it depends on constants alone.
    """

    shape: Shape
    dtype: DType
    data: Array | None = None
    is_constant: bool = False

    @property
    def elements(self) -> int:
        """Number of elements."""
        return math.prod(self.shape)

    @property
    def nbytes(self) -> int:
        """Size (bytes)."""
        return self.elements * self.dtype.itemsize


@dataclass(frozen=True)
class Call:
    """A node with what is known of its inputs.

    Attributes:
        operator: Its operator.
        opset: Version of the operator set.
        inputs: Its inputs; None where an optional one is left out.
        attributes: Its attributes.
        outputs: How many outputs it has.
    """

    operator: str
    opset: int
    inputs: tuple[Value | None, ...]
    attributes: Mapping[str, Attribute]
    outputs: int

    def fail(self, why: str) -> GraphError:
        """Return an error that names the operator."""
        return GraphError(f"its {self.operator} {why}")

    def value(self, i: int) -> Value:
        """Return an input that must be there."""
        found = self.optional(i)
        if found is None:
            raise self.fail(f"lacks its input {i}")
        return found

    def optional(self, i: int) -> Value | None:
        """Return an input, or None."""
        return self.inputs[i] if i < len(self.inputs) else None

    def known(self, i: int) -> Array:
        """Return the elements of an input that sizes depend on."""
        data = self.value(i).data
        if data is None:
            raise self.fail("has a size that depends on the image, or on too many numbers")
        return data

    def known_integers(self, i: int) -> Shape:
        """Return the elements of an input of integers that sizes depend on."""
        data = self.known(i)
        if data.dtype.kind != "i" or data.ndim > 1:
            raise self.fail(f"has an input {i} that is no list of integers")
        return tuple(int(item) for item in data.ravel().tolist())

    def integer(self, name: str, default: int) -> int:
        """Return an attribute.

        Args:
            name: Its name.
            default: Its value where the node does not have it.

        Returns:
            Its value.
        """
        found = self.attributes.get(name, default)
        if not isinstance(found, int):
            raise self.fail(f"has an attribute {name} that is no integer")
        return found

    def integers(self, name: str, default: Sequence[int]) -> Shape:
        """Return an attribute.

        Args:
            name: Its name.
            default: Its value where the node does not have it.

        Returns:
            Its value.
        """
        found = self.attributes.get(name, tuple(default))
        if not isinstance(found, tuple):
            raise self.fail(f"has an attribute {name} that is no list of integers")
        integers = tuple(item for item in found if isinstance(item, int))
        if len(integers) < len(found):
            raise self.fail(f"has an attribute {name} that is no list of integers")
        return integers

    def axis(self, axis: int, rank: int) -> int:
        """Return an axis counted from the front.

        Args:
            axis: The axis; a negative one is counted from the back.
            rank: Number of dimensions.

        Returns:
            The axis, 0 to ``rank`` - 1.
        """
        if not -rank <= axis < rank:
            raise self.fail(f"has an axis {axis} of {rank} dimensions")
        return axis % rank

    def axes(self, rank: int, as_input: bool, position: int = 1) -> tuple[int, ...] | None:
        """Return the axes that are an input or an attribute.

        Args:
            rank: Number of dimensions.
            as_input: Whether they are an input.
            position: Which input.

        Returns:
            The axes in ascending order; None where there are none.
        """
        if as_input:
            given = None if self.optional(position) is None else self.known_integers(position)
        else:
            given = self.integers("axes", ()) if "axes" in self.attributes else None
        if given is None:
            return None
        axes = sorted(self.axis(axis, rank) for axis in given)
        if len(set(axes)) < len(axes):
            raise self.fail("has an axis twice")
        return tuple(axes) or None


@dataclass(frozen=True)
class Inferred:
    """What a node gives and takes.

    Attributes:
        values: Shapes and types of its outputs.
        work: Multiply-adds, or as much other work, beside a fixed share for each element that goes in and out.
    """

    values: tuple[Value, ...]
    work: float = 0.0


Infer = Callable[[Call], Inferred]
Compute = Callable[[Call, Sequence[Array]], Array]


@dataclass(frozen=True)
class Operator:
    """An operator.

    Attributes:
        infer: Gives the shapes of its outputs, and its work.
        inputs: The least and the largest number of inputs.
        attributes: The names of the attributes that it may have.
        compute: Computes its first output from small arrays; None: it is never needed for sizes.
        element_work: Work for each element that goes in or out, as multiply-adds.
        max_outputs: The largest number of outputs.
    """

    infer: Infer
    inputs: tuple[int, int]
    attributes: frozenset[str] = frozenset()
    compute: Compute | None = None
    element_work: float = PLAIN_WORK
    max_outputs: int = 1


def infer(call: Call, max_known: int) -> Inferred:
    """Infer what a node gives.

    Args:
        call: The node.
        max_known: The elements of outputs of at most this many are computed where all inputs are known.

    Returns:
        Its outputs and its work.

    Raises:
        GraphError: The operator is not one of those that are run, or is not used as it must be.
    """
    operator = OPERATORS.get(call.operator)
    if operator is None:
        raise GraphError(f"it has the operator {shown(call.operator)}, which is not run: detectors do without it")
    _check_form(call, operator)
    inferred = operator.infer(call)
    given = [value for value in call.inputs if value is not None]
    is_constant = all(value.is_constant for value in given)
    values = [
        replace(value, data=value.data if value.elements <= max_known else None, is_constant=is_constant)
        for value in inferred.values
    ]
    known = [value.data for value in given if value.data is not None]
    is_small = values[0].elements <= max_known and values[0].data is None
    if operator.compute and is_small and len(known) == len(given):
        values[0] = _computed(call, operator.compute, known, values[0])
    elements = sum(value.elements for value in (*given, *values))
    return Inferred(tuple(values), inferred.work + operator.element_work * elements)


def _check_form(call: Call, operator: Operator) -> None:
    """Check numbers of inputs and outputs, and attributes."""
    least, most = operator.inputs
    if not least <= len(call.inputs) <= most:
        raise call.fail(f"has {len(call.inputs)} inputs")
    if not 1 <= call.outputs <= operator.max_outputs:
        raise call.fail(f"has {call.outputs} outputs")
    for name, value in call.attributes.items():
        if name not in operator.attributes:
            raise call.fail(f"has an attribute {shown(name)}, which is not known")
        allowed = FIXED.get(name)
        if allowed is not None and not any(type(value) is type(one) and value == one for one in allowed):
            raise call.fail(f"has an attribute {name} of a value that is not run")


def _computed(call: Call, compute: Compute, arrays: Sequence[Array], value: Value) -> Value:
    with np.errstate(all="ignore"):
        data = np.asarray(compute(call, arrays)).astype(value.dtype, copy=False)
    if data.shape != value.shape:
        raise call.fail("has inputs that do not fit together")
    return Value(value.shape, value.dtype, data, value.is_constant)


def broadcast(call: Call, *shapes: Shape) -> Shape:
    """Return the shape that shapes are broadcast to.

    Args:
        call: The node, for the error.
        shapes: The shapes.

    Returns:
        Their common shape.
    """
    rank = max(len(shape) for shape in shapes)
    padded = [(1,) * (rank - len(shape)) + shape for shape in shapes]
    result = []
    for sizes in zip(*padded, strict=True):
        wide = {size for size in sizes if size != 1}
        if len(wide) > 1:
            raise call.fail(f"has inputs of shapes that do not fit together: {shown(shapes)}")
        result.append(wide.pop() if wide else 1)
    return tuple(result)


def _same(call: Call) -> Inferred:
    """Give the shape and the type of the first input; the others are broadcast to it."""
    first = call.value(0)
    shapes = [value.shape for value in call.inputs if value is not None]
    if broadcast(call, *shapes) != first.shape:
        raise call.fail(f"has inputs of shapes that do not fit together: {shown(shapes)}")
    return Inferred((Value(first.shape, first.dtype),))


def _axis_checked(call: Call) -> Inferred:
    first = call.value(0)
    call.axis(call.integer("axis", -1 if call.opset >= 13 else 1), len(first.shape))
    return Inferred((Value(first.shape, first.dtype),))


def _clip(call: Call) -> Inferred:
    if any(value is not None and value.elements != 1 for value in call.inputs[1:]):
        raise call.fail("has bounds that are no single numbers")
    first = call.value(0)
    return Inferred((Value(first.shape, first.dtype),))


def _broadcasting(dtype: DType | None = None) -> Infer:
    def infer_broadcast(call: Call) -> Inferred:
        values = [call.value(i) for i in range(len(call.inputs))]
        chosen = values[1].dtype if call.operator == "Where" else values[0].dtype
        return Inferred((Value(broadcast(call, *(value.shape for value in values)), dtype or chosen),))

    return infer_broadcast


def _division(call: Call) -> Inferred:
    """Divide: integers by known positive ones alone, as others end a process or depend on the image."""
    if call.value(1).dtype.kind != "f" and not (call.known(1) > 0).all():
        raise call.fail("divides by an integer that is not positive")
    return _broadcasting()(call)


def _cast(call: Call) -> Inferred:
    number = call.integer("to", 0)
    if number not in DTYPES:
        raise call.fail(f"casts to type {number} of ONNX, which is not run")
    return Inferred((Value(call.value(0).shape, DTYPES[number]),))


def _constant(call: Call) -> Inferred:
    data = call.attributes.get("value")
    if not isinstance(data, np.ndarray):
        raise call.fail("has no array")
    return Inferred((Value(data.shape, data.dtype, data),))


def _constant_of_shape(call: Call) -> Inferred:
    fill = call.attributes.get("value", np.zeros(1, np.float32))
    if not isinstance(fill, np.ndarray) or fill.size != 1:
        raise call.fail("has a value that is no single number")
    return Inferred((Value(_sizes(call, call.known_integers(0)), fill.dtype),))


def _sizes(call: Call, sizes: Sequence[int]) -> Shape:
    if any(size < 1 for size in sizes):
        raise call.fail(f"gives a tensor of shape {shown(tuple(sizes))}")
    return tuple(sizes)


def _shape(call: Call) -> Inferred:
    shape = call.value(0).shape
    part = shape[slice(call.integer("start", 0), call.integer("end", len(shape)))]
    return Inferred((Value((len(part),), np.dtype(np.int64), np.array(part, np.int64)),))


def _range(call: Call) -> Inferred:
    start, limit, delta = (call.known(i) for i in range(3))
    if any(part.size != 1 or part.dtype != start.dtype for part in (start, limit, delta)):
        raise call.fail("has bounds that are no single numbers")
    if not all(float(part.item()).is_integer() for part in (start, limit, delta) if np.isfinite(part).all()):
        raise call.fail("counts in fractions, which versions of ONNX Runtime round in different ways")
    steps = _steps(start, limit, delta)
    if not math.isfinite(steps):
        raise call.fail("has bounds or a step without meaning")
    return Inferred((Value(_sizes(call, [math.ceil(steps)]), start.dtype),))


def _steps(*bounds: Array) -> float:
    """Return how many steps lead from start to limit, in double precision as ONNX Runtime does; NaN: too many."""
    start, limit, delta = (float(bound.item()) for bound in bounds)
    if delta == 0 or not max(abs(start), abs(limit)) < FAR:
        return math.nan
    return (limit - start) / delta


def _reshape(call: Call) -> Inferred:
    value, wanted = call.value(0), list(call.known_integers(1))
    for i, size in enumerate(wanted):
        if size == 0:
            wanted[i] = value.shape[call.axis(i, len(value.shape))]
    if wanted.count(-1) == 1:
        rest = -math.prod(wanted)
        wanted[wanted.index(-1)] = value.elements // rest if rest > 0 else 0
    if math.prod(_sizes(call, wanted)) != value.elements:
        raise call.fail(f"makes {shown(tuple(wanted))} of {shown(value.shape)}")
    return Inferred((Value(tuple(wanted), value.dtype),))


def _flatten(call: Call) -> Inferred:
    value = call.value(0)
    rank = len(value.shape)
    axis = call.integer("axis", 1)
    axis = rank if axis == rank else call.axis(axis, rank)
    return Inferred((Value((math.prod(value.shape[:axis]), math.prod(value.shape[axis:])), value.dtype),))


def _squeeze(call: Call) -> Inferred:
    value = call.value(0)
    axes = call.axes(len(value.shape), call.opset >= AXES_AS_INPUT["Squeeze"])
    if axes is None:
        axes = tuple(i for i, size in enumerate(value.shape) if size == 1)
    if any(value.shape[axis] != 1 for axis in axes):
        raise call.fail(f"squeezes {shown(value.shape)} along {shown(axes)}")
    return Inferred((Value(tuple(size for i, size in enumerate(value.shape) if i not in axes), value.dtype),))


def _unsqueeze(call: Call) -> Inferred:
    value = call.value(0)
    as_input = call.opset >= AXES_AS_INPUT["Unsqueeze"]
    count = len(call.known_integers(1) if as_input else call.integers("axes", ()))
    axes = call.axes(len(value.shape) + count, as_input) or ()
    sizes = list(value.shape)
    for axis in axes:
        sizes.insert(axis, 1)
    return Inferred((Value(tuple(sizes), value.dtype),))


def _transpose(call: Call) -> Inferred:
    value = call.value(0)
    order = call.integers("perm", range(len(value.shape))[::-1])
    if sorted(order) != list(range(len(value.shape))):
        raise call.fail(f"orders the axes of {shown(value.shape)} as {shown(order)}")
    return Inferred((Value(tuple(value.shape[axis] for axis in order), value.dtype),))


def _concat(call: Call) -> Inferred:
    values = [call.value(i) for i in range(len(call.inputs))]
    first = values[0].shape
    axis = call.axis(call.integer("axis", 0), len(first))
    rests = {value.shape[:axis] + value.shape[axis + 1 :] for value in values if len(value.shape) == len(first)}
    if len(rests) > 1 or any(len(value.shape) != len(first) for value in values):
        raise call.fail("has inputs of shapes that do not fit together")
    size = sum(value.shape[axis] for value in values)
    return Inferred((Value((*first[:axis], size, *first[axis + 1 :]), values[0].dtype),))


def _split(call: Call) -> Inferred:
    value = call.value(0)
    axis = call.axis(call.integer("axis", 0), len(value.shape))
    size, parts = value.shape[axis], call.outputs
    as_input = call.opset >= SPLIT_AS_INPUT
    if as_input and call.optional(1) is not None:
        sizes = call.known_integers(1)
    elif not as_input and "split" in call.attributes:
        sizes = call.integers("split", ())
    else:
        largest = -(-size // parts)
        sizes = (*(largest,) * (parts - 1), size - largest * (parts - 1))
    if len(sizes) != parts or call.integer("num_outputs", parts) != parts or sum(_sizes(call, sizes)) != size:
        raise call.fail(f"makes parts of {shown(sizes)} of {size}")
    return Inferred(
        tuple(Value((*value.shape[:axis], part, *value.shape[axis + 1 :]), value.dtype) for part in sizes)
    )


def _slices(call: Call) -> tuple[slice, ...]:
    rank = len(call.value(0).shape)
    starts, ends = call.known_integers(1), call.known_integers(2)
    axes = call.known_integers(3) if call.optional(3) else tuple(range(len(starts)))
    steps = call.known_integers(4) if call.optional(4) else (1,) * len(starts)
    if not len(starts) == len(ends) == len(axes) == len(steps) or 0 in steps:
        raise call.fail("has bounds that do not fit together")
    found = [slice(None)] * rank
    for start, end, axis, step in zip(starts, ends, axes, steps, strict=True):
        found[call.axis(axis, rank)] = slice(start, end, step)
    if len({axis % rank for axis in axes}) < len(axes):
        raise call.fail("has an axis twice")
    return tuple(found)


def _slice(call: Call) -> Inferred:
    value = call.value(0)
    sizes = [len(range(*part.indices(size))) for part, size in zip(_slices(call), value.shape, strict=True)]
    return Inferred((Value(tuple(sizes), value.dtype),))


def _gather(call: Call) -> Inferred:
    value, indices = call.value(0), call.value(1)
    axis = call.axis(call.integer("axis", 0), len(value.shape))
    if indices.dtype.kind != "i":
        raise call.fail("has indices that are no integers")
    if indices.data is not None:
        for index in indices.data.ravel().tolist():
            call.axis(index, value.shape[axis])
    return Inferred((Value((*value.shape[:axis], *indices.shape, *value.shape[axis + 1 :]), value.dtype),))


def _expand(call: Call) -> Inferred:
    value = call.value(0)
    return Inferred((Value(broadcast(call, value.shape, _sizes(call, call.known_integers(1))), value.dtype),))


def _tile(call: Call) -> Inferred:
    value, repeats = call.value(0), _sizes(call, call.known_integers(1))
    if len(repeats) != len(value.shape):
        raise call.fail(f"repeats {shown(value.shape)} by {shown(repeats)}")
    return Inferred((Value(tuple(a * b for a, b in zip(value.shape, repeats, strict=True)), value.dtype),))


def _pad(call: Call) -> Inferred:
    value, pads = call.value(0), call.known_integers(1)
    rank = len(value.shape)
    is_reflected = call.attributes.get("mode") == b"reflect"
    if len(pads) != 2 * rank or min(pads, default=0) < 0:
        raise call.fail(f"pads {shown(value.shape)} by {shown(pads)}")
    if is_reflected and any(pad >= value.shape[i % rank] for i, pad in enumerate(pads)):
        raise call.fail(f"reflects {shown(value.shape)} by {shown(pads)}")
    return Inferred((Value(tuple(s + pads[i] + pads[i + rank] for i, s in enumerate(value.shape)), value.dtype),))


def _resize(call: Call) -> Inferred:
    value, scales, sizes = call.value(0), call.optional(2), call.optional(3)
    if scales is not None and scales.elements:
        factors = call.known(2).astype(np.float32)
        if factors.shape != (len(value.shape),) or not np.isfinite(factors).all() or not (factors > 0).all():
            raise call.fail("has scales without meaning")
        with np.errstate(all="ignore"):
            wanted = np.floor(factors * np.array(value.shape, np.float32)).tolist()
        if not all(math.isfinite(size) for size in wanted):
            raise call.fail("has scales without meaning")
        resized = [int(size) for size in wanted]
    else:
        resized = [] if sizes is None else list(call.known_integers(3))
    if len(resized) != len(value.shape):
        raise call.fail("does not say to which size")
    shape = _sizes(call, resized)
    return Inferred((Value(shape, value.dtype),), 8.0 * math.prod(shape))


@dataclass(frozen=True)
class _Window:
    """A window that is moved over an image: its size, steps, spread and margins along each axis."""

    kernel: Shape
    strides: Shape
    dilations: Shape
    pads: Shape

    @classmethod
    def of(cls, call: Call, kernel: Shape) -> _Window:
        rank = len(kernel)
        strides, dilations = (call.integers(name, (1,) * rank) for name in ("strides", "dilations"))
        pads = call.integers("pads", (0,) * 2 * rank)
        if call.integers("kernel_shape", kernel) != kernel or not 1 <= rank <= 2:
            raise call.fail(f"has a window of {shown(kernel)}")
        whole = len(strides) == len(dilations) == rank and len(pads) == 2 * rank
        if not whole or min(*kernel, *strides, *dilations) < 1 or min(pads) < 0:
            raise call.fail("has steps or margins that do not fit its window")
        return cls(kernel, strides, dilations, pads)

    def reach(self, axis: int) -> int:
        return self.dilations[axis] * (self.kernel[axis] - 1) + 1

    def outputs(self, call: Call, sizes: Shape) -> Shape:
        if len(sizes) != len(self.kernel):
            raise call.fail(f"moves a window of {shown(self.kernel)} over {shown(sizes)}")
        rank = len(sizes)
        padded = [size + self.pads[i] + self.pads[i + rank] for i, size in enumerate(sizes)]
        if any(size < self.reach(i) for i, size in enumerate(padded)):
            raise call.fail(f"moves a window of {shown(self.kernel)} over {shown(sizes)}")
        return tuple((size - self.reach(i)) // self.strides[i] + 1 for i, size in enumerate(padded))


def _check_bias(call: Call, filters: int) -> None:
    bias = call.optional(2)
    if bias is not None and bias.shape != (filters,):
        raise call.fail(f"has a bias of shape {shown(bias.shape)} for {filters} filters")


def _conv(call: Call) -> Inferred:
    value, weight = call.value(0), call.value(1)
    group = call.integer("group", 1)
    if len(value.shape) < 3 or len(weight.shape) != len(value.shape) or group < 1:
        raise call.fail(f"has weights of shape {shown(weight.shape)} for {shown(value.shape)}")
    filters, depth = weight.shape[:2]
    if value.shape[1] != depth * group or filters % group:
        raise call.fail(f"has weights of shape {shown(weight.shape)} for {shown(value.shape)}")
    _check_bias(call, filters)
    window = _Window.of(call, weight.shape[2:])
    shape = (value.shape[0], filters, *window.outputs(call, value.shape[2:]))
    size = depth * math.prod(window.kernel)
    narrow = filters // group < NARROW_FILTERS
    work = math.prod(shape) * size * (NARROW_WORK if narrow else 1) + value.shape[0] * group * CALL_WORK
    return Inferred((Value(shape, value.dtype),), work)


def _pool(call: Call) -> Inferred:
    value = call.value(0)
    if len(value.shape) < 3:
        raise call.fail(f"takes an image of shape {shown(value.shape)}")
    window = _Window.of(call, call.integers("kernel_shape", ()))
    shape = (*value.shape[:2], *window.outputs(call, value.shape[2:]))
    return Inferred((Value(shape, value.dtype),), POOLING_WORK * math.prod(shape) * math.prod(window.kernel))


def _global_pool(call: Call) -> Inferred:
    value = call.value(0)
    return Inferred((Value((*value.shape[:2], *(1 for _ in value.shape[2:])), value.dtype),))


def _check_floats(call: Call, *values: Value) -> None:
    if any(value.dtype.kind != "f" for value in values):
        raise call.fail("multiplies matrices of integers, which takes long")


def _matmul(call: Call) -> Inferred:
    value, other = call.value(0), call.value(1)
    _check_floats(call, value, other)
    if not value.shape or not other.shape:
        raise call.fail("has a factor without dimensions")
    left = value.shape if len(value.shape) > 1 else (1, *value.shape)
    right = other.shape if len(other.shape) > 1 else (*other.shape, 1)
    if left[-1] != right[-2]:
        raise call.fail(f"multiplies {shown(value.shape)} by {shown(other.shape)}")
    batch = broadcast(call, left[:-2], right[:-2])
    rows = left[-2:-1] if len(value.shape) > 1 else ()
    cols = right[-1:] if len(other.shape) > 1 else ()
    shape = (*batch, *rows, *cols)
    return Inferred((Value(shape, value.dtype),), _product_work(math.prod(batch), left[-2], left[-1], right[-1]))


def _gemm(call: Call) -> Inferred:
    value, other, added = call.value(0), call.value(1), call.optional(2)
    _check_floats(call, value, other)
    if len(value.shape) != 2 or len(other.shape) != 2:
        raise call.fail(f"multiplies {shown(value.shape)} by {shown(other.shape)}")
    left = value.shape[::-1] if call.integer("transA", 0) else value.shape
    right = other.shape[::-1] if call.integer("transB", 0) else other.shape
    shape = (left[0], right[1])
    if left[1] != right[0] or (added is not None and broadcast(call, added.shape, shape) != shape):
        raise call.fail(f"multiplies {shown(value.shape)} by {shown(other.shape)}")
    return Inferred((Value(shape, value.dtype),), _product_work(1, left[0], left[1], right[1]))


def _product_work(batch: int, rows: int, inner: int, cols: int) -> float:
    """Return the work of products of matrices: as multiply-adds, with each product a few of them more."""
    return batch * (rows * inner * cols + CALL_WORK)


def _reduce(call: Call) -> Inferred:
    value = call.value(0)
    rank = len(value.shape)
    as_input = call.opset >= AXES_AS_INPUT.get(call.operator, REDUCTION_AXES_AS_INPUT)
    axes = call.axes(rank, as_input) or tuple(range(rank))
    kept = call.integer("keepdims", 1)
    sizes = [1 if i in axes else size for i, size in enumerate(value.shape) if kept or i not in axes]
    return Inferred((Value(tuple(sizes), value.dtype),))


def _quotient(call: Call, arrays: Sequence[Array]) -> Array:
    a, b = arrays
    if a.dtype.kind != "f":
        return np.asarray(np.sign(a) * (np.abs(a) // b))
    return np.asarray(a / b)


def _reshaped(call: Call, arrays: Sequence[Array]) -> Array:
    return arrays[0].reshape(OPERATORS[call.operator].infer(call).values[0].shape)


def _expanded(call: Call, arrays: Sequence[Array]) -> Array:
    return np.broadcast_to(arrays[0], _expand(call).values[0].shape)


def _filled(call: Call, arrays: Sequence[Array]) -> Array:
    fill = call.attributes.get("value", np.zeros(1, np.float32))
    return np.full(call.known_integers(0), np.asarray(fill).ravel()[0])


def _counted(start: Array, limit: Array, delta: Array) -> Array:
    count = math.ceil(_steps(start, limit, delta))
    return np.asarray(start.ravel()[0] + np.arange(count, dtype=start.dtype) * delta.ravel()[0])


def _concatenated(call: Call, arrays: Sequence[Array]) -> Array:
    return np.concatenate(arrays, axis=call.integer("axis", 0))


def _taken(call: Call, arrays: Sequence[Array]) -> Array:
    return np.asarray(np.take(arrays[0], arrays[1].astype(np.int64), axis=call.integer("axis", 0)))


def _elementwise(function: Callable[..., Array]) -> Compute:
    return lambda call, arrays: function(*arrays)


def _vectors(call: Call) -> Inferred:
    """Give the shape of the first input; the others have a number for each channel."""
    first = call.value(0)
    if any(value is None or value.shape != first.shape[1:2] for value in call.inputs[1:]):
        raise call.fail("has inputs of shapes that do not fit together")
    return Inferred((Value(first.shape, first.dtype),))


def _of(
    infer: Infer,
    inputs: tuple[int, int],
    attributes: str = "",
    compute: Compute | None = None,
    element_work: float = PLAIN_WORK,
    max_outputs: int = 1,
) -> Operator:
    return Operator(infer, inputs, frozenset(attributes.split()), compute, element_work, max_outputs)


def _each(names: str, operator: Operator) -> dict[str, Operator]:
    return dict.fromkeys(names.split(), operator)


BOOL = np.dtype(np.bool_)
MANY = 256
"""Largest number of inputs or outputs of operators that take any number; set by hand."""

WINDOW = "auto_pad dilations group kernel_shape pads strides"
POOL = "auto_pad ceil_mode count_include_pad dilations kernel_shape pads storage_order strides"

OPERATORS: Mapping[str, Operator] = {
    # of each element
    **_each("Erf Exp Log Sigmoid Softsign Sqrt Tanh", _of(_same, (1, 1), element_work=COSTLY)),
    **_each("Mish Softplus", _of(_same, (1, 1), element_work=2 * COSTLY)),
    **_each("Elu HardSigmoid LeakyRelu Selu", _of(_same, (1, 1), "alpha beta gamma", element_work=COSTLY)),
    **_each("Abs HardSwish Neg Not Reciprocal Relu Round Sign", _of(_same, (1, 1))),
    "Ceil": _of(_same, (1, 1), compute=_elementwise(np.ceil)),
    "Floor": _of(_same, (1, 1), compute=_elementwise(np.floor)),
    "Identity": _of(_same, (1, 1), compute=_elementwise(np.asarray)),
    "Cast": _of(_cast, (1, 1), "to", _elementwise(np.asarray)),
    "Clip": _of(_clip, (1, 3)),
    "PRelu": _of(_same, (2, 2)),
    # of elements at the same place
    "Add": _of(_broadcasting(), (2, 2), compute=_elementwise(np.add)),
    "Sub": _of(_broadcasting(), (2, 2), compute=_elementwise(np.subtract)),
    "Mul": _of(_broadcasting(), (2, 2), compute=_elementwise(np.multiply)),
    "Div": _of(_division, (2, 2), compute=_quotient),
    "Pow": _of(_broadcasting(), (2, 2), element_work=2 * COSTLY),
    "Max": _of(_broadcasting(), (1, MANY), compute=lambda call, arrays: reduce(np.maximum, arrays)),
    "Min": _of(_broadcasting(), (1, MANY), compute=lambda call, arrays: reduce(np.minimum, arrays)),
    "Equal": _of(_broadcasting(BOOL), (2, 2), compute=_elementwise(np.equal)),
    **_each("And Greater GreaterOrEqual Less LessOrEqual Or", _of(_broadcasting(BOOL), (2, 2))),
    "Where": _of(_broadcasting(), (3, 3), compute=_elementwise(np.where), element_work=COSTLY),
    # along an axis
    "Softmax": _of(_axis_checked, (1, 1), "axis", element_work=SOFTMAX_WORK),
    "BatchNormalization": _of(_vectors, (5, 5), "epsilon momentum training_mode"),
    **_each(
        "ReduceL2 ReduceMax ReduceMean ReduceMin ReduceSum",
        _of(_reduce, (1, 2), "axes keepdims noop_with_empty_axes"),
    ),
    # of windows, and of matrices
    "Conv": _of(_conv, (2, 3), WINDOW),
    **_each("AveragePool MaxPool", _of(_pool, (1, 1), POOL)),
    **_each("GlobalAveragePool GlobalMaxPool", _of(_global_pool, (1, 1))),
    "MatMul": _of(_matmul, (2, 2)),
    "Gemm": _of(_gemm, (2, 3), "alpha beta transA transB"),
    # of shapes
    "Constant": _of(_constant, (0, 0), "value"),
    "ConstantOfShape": _of(_constant_of_shape, (1, 1), "value", _filled),
    "Shape": _of(_shape, (1, 1), "start end"),
    "Range": _of(_range, (3, 3), compute=lambda call, arrays: _counted(*arrays)),
    "Reshape": _of(_reshape, (2, 2), "allowzero", _reshaped),
    "Flatten": _of(_flatten, (1, 1), "axis", _reshaped),
    "Squeeze": _of(_squeeze, (1, 2), "axes", _reshaped),
    "Unsqueeze": _of(_unsqueeze, (1, 2), "axes", _reshaped),
    "Transpose": _of(_transpose, (1, 1), "perm"),
    "Concat": _of(_concat, (1, MANY), "axis", _concatenated),
    "Split": _of(_split, (1, 2), "axis split num_outputs", max_outputs=MANY),
    "Slice": _of(_slice, (3, 5), compute=lambda call, arrays: arrays[0][_slices(call)]),
    "Gather": _of(_gather, (2, 2), "axis", _taken),
    "Expand": _of(_expand, (2, 2), compute=_expanded),
    "Tile": _of(_tile, (2, 2)),
    "Pad": _of(_pad, (2, 3), "mode"),
    "Resize": _of(
        _resize,
        (1, 4),
        "antialias axes coordinate_transformation_mode cubic_coeff_a exclude_outside extrapolation_value "
        "keep_aspect_ratio_policy mode nearest_mode",
    ),
}  # fmt: skip
"""The operators that are run, by name."""
