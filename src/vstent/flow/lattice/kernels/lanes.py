"""Eight or sixteen single-precision numbers at once, as a type of numba's: what a processor's vector register holds.

A loop that the compiler turns into vector instructions itself pays for the cells that no whole vector holds, at both
ends of every run of them; a few dozen cells long, they are most of the time. Whole vectors are named here instead.
Arithmetic is numba's fast one: sums may be reordered, products and sums fused.
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
"""Numbers in one."""
_FLOAT: Final = ir.FloatType()
_WHOLE: Final = ir.IntType(32)
_VECTOR: Final = ir.VectorType(_FLOAT, COUNT)
_FAST: Final = ("fast",)


class Lanes(types.Type):
    """So many numbers."""

    def __init__(self) -> None:
        super().__init__(name="Lanes")


LANES: Final = Lanes()


@register_model(Lanes)
class _LanesModel(models.PrimitiveModel):
    def __init__(self, manager: Any, kind: Any) -> None:
        super().__init__(manager, kind, _VECTOR)


def _everywhere(builder: Any, number: Any) -> Any:
    """Vector of the same number in every place."""
    undefined = ir.Constant(ir.VectorType(number.type, COUNT), ir.Undefined)
    first = builder.insert_element(undefined, number, _WHOLE(0))
    return builder.shuffle_vector(first, undefined, ir.Constant(ir.VectorType(_WHOLE, COUNT), [0] * COUNT))


def _widened(builder: Any, kind: Any, value: Any) -> Any:
    """The same number in every place, unless it is Lanes already."""
    return value if kind == LANES else _everywhere(builder, value)


def _is_pair(a: Any, b: Any) -> bool:
    return LANES in (a, b) and {a, b} <= {LANES, types.float32}


def _arithmetic(operation: Callable[..., Any], instruction: str) -> None:
    """Let numba apply an operator to two Lanes, or to one and a number."""

    @intrinsic
    def apply(_: Any, a: Any, b: Any) -> Any:
        def generate(_: Any, builder: Any, signature: Any, arguments: Any) -> Any:
            pair = [_widened(builder, *one) for one in zip(signature.args, arguments, strict=True)]
            return getattr(builder, instruction)(*pair, flags=_FAST)

        return LANES(a, b), generate

    @overload(operation)
    def chosen(a: Any, b: Any) -> Any:
        def on_lanes(a: Any, b: Any) -> Any:
            return apply(a, b)

        return on_lanes if _is_pair(a, b) else None


for _operation, _instruction in (
    (operator.add, "fadd"),
    (operator.sub, "fsub"),
    (operator.mul, "fmul"),
    (operator.truediv, "fdiv"),
):
    _arithmetic(_operation, _instruction)


@intrinsic
def _larger(_: Any, a: Any, b: Any) -> Any:
    def generate(_: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        x, y = (_widened(builder, *one) for one in zip(signature.args, arguments, strict=True))
        return builder.select(builder.fcmp_ordered(">", x, y), x, y)

    return LANES(a, b), generate


@intrinsic
def _root(_: Any, a: Any) -> Any:
    def generate(_: Any, builder: Any, __: Any, arguments: Any) -> Any:
        kind = ir.FunctionType(_VECTOR, [_VECTOR])
        return builder.call(cgutils.get_or_insert_function(builder.module, kind, f"llvm.sqrt.v{COUNT}f32"), arguments)

    return LANES(a), generate


def larger(a: Any, b: Any) -> Any:
    """Return the larger of two, number by number; numbers may be Lanes or float32."""
    return np.maximum(a, b)


@overload(larger)
def _larger_chosen(a: Any, b: Any) -> Any:
    def of_lanes(a: Any, b: Any) -> Any:
        return _larger(a, b)

    def of_numbers(a: Any, b: Any) -> Any:
        return max(a, b)

    return of_lanes if _is_pair(a, b) else of_numbers


def root(a: Any) -> Any:
    """Return the square root, number by number, of Lanes or float32."""
    return np.sqrt(a)


@overload(root)
def _root_chosen(a: Any) -> Any:
    def of_lanes(a: Any) -> Any:
        return _root(a)

    def of_number(a: Any) -> Any:
        return math.sqrt(a)  # unlike numpy's it is there on a GPU too

    return of_lanes if a == LANES else of_number


@intrinsic
def upto(_: Any, count: Any, a: Any, b: Any) -> Any:
    """Return Lanes that are a in the first `count` places and b in the others."""

    def generate(_: Any, builder: Any, __: Any, arguments: Any) -> Any:
        places = ir.Constant(ir.VectorType(_WHOLE, COUNT), list(range(COUNT)))
        counts = _everywhere(builder, builder.trunc(arguments[0], _WHOLE))
        return builder.select(builder.icmp_signed("<", places, counts), arguments[1], arguments[2])

    return LANES(types.intp, a, b), generate


def _at(context: Any, builder: Any, array: Any, value: Any, place: Any) -> Any:
    """Pointer to the numbers of an array from a place on."""
    data = context.make_array(array)(context, builder, value).data
    return builder.bitcast(builder.gep(data, [place]), _VECTOR.as_pointer())


def _runs(context: Any, builder: Any, signature: Any, arguments: Any) -> list[Any]:
    """Pointers to the numbers of an array (n,) from each start + offset on, `starts` being a tuple."""
    array, starts, offset = arguments[:3]
    places = [builder.add(start, offset) for start in cgutils.unpack_tuple(builder, starts)]
    return [_at(context, builder, signature.args[0], array, place) for place in places]


@intrinsic
def starts(_: Any, address: Any, row: Any) -> Any:
    """Return a row (19,) of addresses as a tuple, which stores to other arrays cannot change: it is read once.

    Rows must be contiguous.
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
    """Return the numbers of a float32 array (n,) from a place on."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        return builder.load(_at(context, builder, signature.args[0], *arguments), align=4)

    return LANES(array, types.intp), generate


@intrinsic
def gather(_: Any, array: Any, starts: Any, offset: Any) -> Any:
    """Return Lanes of a float32 array (n,) from each start + offset on, as a tuple."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        runs = _runs(context, builder, signature, arguments)
        return cgutils.pack_array(builder, [builder.load(run, align=4) for run in runs])

    return types.containers.UniTuple(LANES, len(starts))(array, starts, types.intp), generate


@intrinsic
def store(_: Any, array: Any, place: Any, lanes: Any) -> Any:
    """Write Lanes to a float32 array (n,) from a place on."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        builder.store(arguments[2], _at(context, builder, signature.args[0], *arguments[:2]), align=4)
        return context.get_dummy_value()

    return types.void(array, types.intp, lanes), generate
