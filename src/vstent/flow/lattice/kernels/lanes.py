"""Vectors of eight or sixteen float32 numbers as a numba type: the content of one vector register of the processor.

Loops that the compiler vectorises itself are slow at both ends of every run of cells, where the cells do not fill a
vector. Runs are a few dozen cells long, so that this is most of the time. Here whole vectors are named explicitly.
Arithmetic uses fast-math: sums may be reordered, products and sums fused.
"""

import math
import operator
from collections.abc import Callable
from typing import Any, Final

import numpy as np
from llvmlite import ir
from llvmlite.binding import get_host_cpu_features
from numba.core import cgutils, types
from numba.extending import intrinsic, models, overload, register_model

COUNT: Final = 16 if get_host_cpu_features().get("avx512f") else 8
"""Number of values in one Lanes."""
_FLOAT: Final = ir.FloatType()
_WHOLE: Final = ir.IntType(32)
_FLAG: Final = ir.IntType(1)
_BYTES: Final = ir.IntType(8).as_pointer()
_VECTOR: Final = ir.VectorType(_FLOAT, COUNT)
_FAST: Final = ("fast",)


class Lanes(types.Type):
    """The numba type of a vector of `COUNT` float32 numbers."""

    def __init__(self) -> None:
        super().__init__(name="Lanes")


LANES: Final = Lanes()
"""The type's only instance."""


@register_model(Lanes)
class _LanesModel(models.PrimitiveModel):
    """Memory layout of Lanes: an LLVM vector."""

    def __init__(self, manager: Any, kind: Any) -> None:
        super().__init__(manager, kind, _VECTOR)


def _everywhere(builder: Any, number: Any) -> Any:
    """Return a vector with the same number in every place."""
    undefined = ir.Constant(ir.VectorType(number.type, COUNT), ir.Undefined)
    first = builder.insert_element(undefined, number, _WHOLE(0))
    return builder.shuffle_vector(first, undefined, ir.Constant(ir.VectorType(_WHOLE, COUNT), [0] * COUNT))


def _on_pairs(function: Callable[..., Any], of_vectors: Callable[..., Any], of_numbers: Any = None) -> None:
    """Make numba apply a function to two Lanes, or to Lanes and a number: what `of_vectors` builds from two vectors."""

    @intrinsic
    def apply(_: Any, a: Any, b: Any) -> Any:
        def generate(_: Any, builder: Any, signature: Any, arguments: Any) -> Any:
            pairs = zip(signature.args, arguments, strict=True)
            return of_vectors(builder, *(x if kind == LANES else _everywhere(builder, x) for kind, x in pairs))

        return LANES(a, b), generate

    @overload(function)
    def chosen(a: Any, b: Any) -> Any:
        def on_lanes(a: Any, b: Any) -> Any:
            return apply(a, b)

        return on_lanes if LANES in (a, b) and {a, b} <= {LANES, types.float32} else of_numbers


def larger(a: Any, b: Any) -> Any:
    """Return the larger of two values element by element; values may be Lanes or float32."""
    return np.maximum(a, b)


def _larger_number(a: Any, b: Any) -> Any:
    """Return the larger of two numbers."""
    return max(a, b)


_on_pairs(operator.add, lambda builder, x, y: builder.fadd(x, y, flags=_FAST))
_on_pairs(operator.sub, lambda builder, x, y: builder.fsub(x, y, flags=_FAST))
_on_pairs(operator.mul, lambda builder, x, y: builder.fmul(x, y, flags=_FAST))
_on_pairs(operator.truediv, lambda builder, x, y: builder.fdiv(x, y, flags=_FAST))
_on_pairs(larger, lambda builder, x, y: builder.select(builder.fcmp_ordered(">", x, y), x, y), _larger_number)


def _on_one(function: Callable[..., Any], of_lanes: Callable[..., Any], of_number: Callable[..., Any]) -> None:
    """Make numba apply a function to Lanes or to a number."""

    @overload(function)
    def chosen(a: Any) -> Any:
        def on_lanes(a: Any) -> Any:
            return of_lanes(a)

        return on_lanes if a == LANES else of_number


@intrinsic
def _root(_: Any, a: Any) -> Any:
    """Return the square root of Lanes, element by element."""

    def generate(_: Any, builder: Any, __: Any, arguments: Any) -> Any:
        kind = ir.FunctionType(_VECTOR, [_VECTOR])
        return builder.call(cgutils.get_or_insert_function(builder.module, kind, f"llvm.sqrt.v{COUNT}f32"), arguments)

    return LANES(a), generate


def root(a: Any) -> Any:
    """Return the square root of Lanes, element by element, or of a float32."""
    return np.sqrt(a)


def _root_of_number(a: Any) -> Any:
    """Return the square root of a number; numpy's is not available on a GPU."""
    return math.sqrt(a)


_on_one(root, _root, _root_of_number)


@intrinsic
def _any_positive(_: Any, a: Any) -> Any:
    """Return whether any of the Lanes is positive."""

    def generate(_: Any, builder: Any, __: Any, arguments: Any) -> Any:
        flags = builder.fcmp_ordered(">", arguments[0], ir.Constant(_VECTOR, [0.0] * COUNT))
        found = builder.icmp_unsigned("!=", builder.bitcast(flags, ir.IntType(COUNT)), ir.IntType(COUNT)(0))
        kind = ir.FunctionType(_FLAG, [_FLAG, _FLAG])
        expect = cgutils.get_or_insert_function(builder.module, kind, "llvm.expect.i1")
        return builder.call(expect, [found, _FLAG(0)])

    return types.boolean(a), generate


def any_positive(a: Any) -> Any:
    """Return whether any of the Lanes is positive, or whether a float32 is; machine code expects that none is."""
    return a > 0


_on_one(any_positive, _any_positive, any_positive)


def _at(context: Any, builder: Any, array: Any, value: Any, place: Any) -> Any:
    """Return a pointer to the values of an array from a place on."""
    data = context.make_array(array)(context, builder, value).data
    return builder.bitcast(builder.gep(data, [place]), _VECTOR.as_pointer())


def _runs(context: Any, builder: Any, signature: Any, arguments: Any) -> list[Any]:
    """Return pointers to the values of an array (n,) from each start + offset on; `starts` is a tuple."""
    array, starts, offset = arguments[:3]
    places = [builder.add(start, offset) for start in cgutils.unpack_tuple(builder, starts)]
    return [_at(context, builder, signature.args[0], array, place) for place in places]


@intrinsic
def starts(_: Any, address: Any, row: Any) -> Any:
    """Return a row (19,) of addresses as a tuple, so that it is read once even where other arrays are written.

    The array must be C-contiguous.
    """

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        held = context.make_array(signature.args[0])(context, builder, arguments[0])
        entry = builder.gep(held.data, [builder.mul(arguments[1], builder.extract_value(held.shape, 1))])
        numbers = [builder.load(builder.gep(entry, [cgutils.intp_t(q)])) for q in range(19)]
        return cgutils.pack_array(builder, [builder.sext(number, cgutils.intp_t) for number in numbers])

    if address.layout != "C":
        return None
    return types.containers.UniTuple(types.intp, 19)(address, types.intp), generate


@intrinsic
def load(_: Any, array: Any, place: Any) -> Any:
    """Return Lanes with the values of a float32 array (n,) from a place on."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        return builder.load(_at(context, builder, signature.args[0], *arguments), align=4)

    return LANES(array, types.intp), generate


@intrinsic
def gather(_: Any, array: Any, starts: Any, offset: Any) -> Any:
    """Return a tuple of Lanes: the values of a float32 array (n,) from each start + offset on."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        runs = _runs(context, builder, signature, arguments)
        return cgutils.pack_array(builder, [builder.load(run, align=4) for run in runs])

    return types.containers.UniTuple(LANES, len(starts))(array, starts, types.intp), generate


@intrinsic
def fetch(_: Any, array: Any, starts: Any, offset: Any) -> Any:
    """Ask the processor to load what `gather` will read at this offset; it may lie outside the array."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        kind = ir.FunctionType(ir.VoidType(), [_BYTES, _WHOLE, _WHOLE, _WHOLE])
        prefetch = cgutils.get_or_insert_function(builder.module, kind, "llvm.prefetch.p0i8")
        for run in _runs(context, builder, signature, arguments):
            builder.call(prefetch, [builder.bitcast(run, _BYTES), _WHOLE(0), _WHOLE(3), _WHOLE(1)])
        return context.get_dummy_value()

    return types.void(array, starts, types.intp), generate


@intrinsic
def scatter(_: Any, array: Any, starts: Any, offset: Any, lanes: Any, count: Any) -> Any:
    """Write the first `count` values of each Lanes of a tuple to a float32 array (n,) from its start + offset on.

    At most `COUNT` are written.
    """

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        places = ir.Constant(ir.VectorType(_WHOLE, COUNT), list(range(COUNT)))
        written = builder.icmp_signed("<", places, _everywhere(builder, builder.trunc(arguments[4], _WHOLE)))
        kind = ir.FunctionType(ir.VoidType(), [_VECTOR, _VECTOR.as_pointer(), _WHOLE, written.type])
        name = f"llvm.masked.store.v{COUNT}f32.p0v{COUNT}f32"
        masked = cgutils.get_or_insert_function(builder.module, kind, name)
        runs = _runs(context, builder, signature, arguments)
        for run, vector in zip(runs, cgutils.unpack_tuple(builder, arguments[3]), strict=True):
            builder.call(masked, [vector, run, _WHOLE(4), written])
        return context.get_dummy_value()

    return types.void(array, starts, types.intp, lanes, types.intp), generate
