"""Eight numbers in one vector register, as a type that compiled code can do arithmetic with.

Numba's compiler does not find the vectors in loops over eight points inside loops over evidence:
spelled out, the innermost loop of queries measured four to five times faster.
"""

from __future__ import annotations

import operator
from collections.abc import Callable
from typing import Any, Final

from llvmlite import ir
from numba import types
from numba.extending import intrinsic, models, overload, register_model

LANES: Final = 8

_VECTOR = ir.VectorType(ir.DoubleType(), LANES)
_INDEX = ir.IntType(32)
_CONTRACT = ("contract",)  # as in `jit`: a product and a sum may become one instruction


class LanesType(types.Type):  # type: ignore[misc]  # numba ships no types
    """Of eight float64 in one register."""

    def __init__(self) -> None:
        super().__init__(name="Lanes")


_LANES = LanesType()


@register_model(LanesType)
class _LanesModel(models.PrimitiveModel):  # type: ignore[misc]
    def __init__(self, manager: Any, of: Any) -> None:
        super().__init__(manager, of, _VECTOR)


def _place(builder: Any, address: Any, index: Any) -> Any:
    start = builder.inttoptr(address, _VECTOR.as_pointer())
    return builder.gep(start, [index])


def _spread(builder: Any, number: Any) -> Any:
    nothing = ir.Constant(_VECTOR, ir.Undefined)
    first = builder.insert_element(nothing, number, ir.Constant(_INDEX, 0))
    zeros = ir.Constant(ir.VectorType(_INDEX, LANES), [0] * LANES)
    return builder.shuffle_vector(first, nothing, zeros)


@intrinsic
def load(typing_context: Any, address: Any, index: Any) -> Any:
    """The `index`-th eight numbers of an array that begins at `address`."""

    def generate(context: Any, builder: Any, _signature: Any, args: Any) -> Any:
        return builder.load(_place(builder, *args), align=8)

    return _LANES(types.int64, types.int64), generate


@intrinsic
def store(typing_context: Any, address: Any, index: Any, lanes: Any) -> Any:
    """Write eight numbers to where `load` would read them."""

    def generate(context: Any, builder: Any, _signature: Any, args: Any) -> Any:
        builder.store(args[2], _place(builder, args[0], args[1]), align=8)
        return context.get_dummy_value()

    return types.void(types.int64, types.int64, _LANES), generate


@intrinsic
def spread(typing_context: Any, number: Any) -> Any:
    """One number in all lanes."""

    def generate(context: Any, builder: Any, _signature: Any, args: Any) -> Any:
        return _spread(builder, args[0])

    return _LANES(types.float64), generate


@intrinsic
def above(typing_context: Any, lanes: Any, limit: Any) -> Any:
    """Lanes with what is not above the limit set to zero."""

    def generate(context: Any, builder: Any, _signature: Any, args: Any) -> Any:
        is_above = builder.fcmp_ordered(">", args[0], _spread(builder, args[1]))
        zeros = ir.Constant(_VECTOR, [0.0] * LANES)
        return builder.select(is_above, args[0], zeros)

    return _LANES(_LANES, types.float64), generate


@intrinsic
def any_above(typing_context: Any, lanes: Any, limit: Any) -> Any:
    """Whether any lane is above the limit."""

    def generate(context: Any, builder: Any, _signature: Any, args: Any) -> Any:
        is_above = builder.fcmp_ordered(">", args[0], _spread(builder, args[1]))
        bits = builder.bitcast(is_above, ir.IntType(LANES))
        return builder.icmp_unsigned("!=", bits, ir.Constant(ir.IntType(LANES), 0))

    return types.boolean(_LANES, types.float64), generate


def _arithmetic(name: str) -> Callable[..., Any]:
    @intrinsic
    def call(typing_context: Any, a: Any, b: Any) -> Any:
        def generate(context: Any, builder: Any, _signature: Any, args: Any) -> Any:
            return getattr(builder, name)(*args, flags=_CONTRACT)

        return _LANES(_LANES, _LANES), generate

    def typed(a: Any, b: Any) -> Any:
        if isinstance(a, LanesType) and isinstance(b, LanesType):
            return lambda a, b: call(a, b)  # noqa: PLW0108 - numba reads its source
        return None

    return typed


overload(operator.add, strict=False)(_arithmetic("fadd"))
overload(operator.sub, strict=False)(_arithmetic("fsub"))
overload(operator.mul, strict=False)(_arithmetic("fmul"))
