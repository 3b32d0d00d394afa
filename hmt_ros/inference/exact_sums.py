"""Scalar products for compiled functions, in vector registers and in an order that is fixed.

A compiler that may reassociate a sum arranges it to suit the surrounding code, so the last bits
depend on earlier compilations. Without that freedom numba adds one product after the other.
Here the partial sums are laid out by hand: every cache of compiled functions and every machine give
the same bits, and smoothing takes two thirds of the time that it takes with loops over the same
partial sums (the products do not fill vector registers there).
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, cast

from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.core.errors import TypingError
from numba.extending import intrinsic

_LANES = 4
_VECTOR = ir.VectorType(ir.DoubleType(), _LANES)
_INDEX = ir.IntType(64)


@intrinsic
def _dot(_typing: Any, x: Any, y: Any, start: Any, count: Any) -> Any:
    """Sum of x[i] y[start + i] over i < count, of contiguous vectors of floats.

    Eight partial sums s[i % 8] of fused products; ((s0 + s4) + (s2 + s6)) + ((s1 + s5) + (s3 + s7))
    and then, one after the other, the products that are left beyond a multiple of eight.
    """
    for kind in (x, y):
        if (kind.ndim, kind.layout, kind.dtype) != (1, 'C', types.float64):
            raise TypingError(f'dot: wanted contiguous vectors of float64, saw {kind}')

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        x_data, y_data = (
            context.make_array(kind)(context, builder, value).data
            for kind, value in zip(signature.args[:2], arguments[:2], strict=True)
        )
        start, count = arguments[2:]
        fused = cgutils.get_or_insert_function(
            builder.module, ir.FunctionType(_VECTOR, [_VECTOR] * 3), f'llvm.fma.v{_LANES}f64'
        )

        def four(data: Any, index: Any) -> Any:
            place = builder.bitcast(builder.gep(data, [index]), _VECTOR.as_pointer())
            return builder.load(place, align=8)

        def one(data: Any, index: Any) -> Any:
            return builder.load(builder.gep(data, [index]))

        zeros = ir.Constant(_VECTOR, [0.0] * _LANES)
        sums = [cgutils.alloca_once_value(builder, zeros) for _ in range(2)]
        whole = builder.sub(count, builder.and_(count, _INDEX(2 * _LANES - 1)))
        with cgutils.for_range_slice(builder, _INDEX(0), whole, _INDEX(2 * _LANES)) as (i, _):
            for half, partial in enumerate(sums):
                at = builder.add(i, _INDEX(half * _LANES))
                new = builder.call(
                    fused,
                    [four(x_data, at), four(y_data, builder.add(start, at)), builder.load(partial)],
                )
                builder.store(new, partial)
        both = builder.fadd(*(builder.load(partial) for partial in sums))
        lanes = [builder.extract_element(both, ir.IntType(32)(k)) for k in range(_LANES)]
        even, odd = builder.fadd(lanes[0], lanes[2]), builder.fadd(lanes[1], lanes[3])
        total = cgutils.alloca_once_value(builder, builder.fadd(even, odd))
        with cgutils.for_range_slice(builder, whole, count, _INDEX(1)) as (i, _):
            value = builder.fma(
                one(x_data, i), one(y_data, builder.add(start, i)), builder.load(total)
            )
            builder.store(value, total)
        return builder.load(total)

    return types.float64(x, y, types.intp, types.intp), generate


# As compiled functions call it: they do not see the first argument.
dot: Callable[[Any, Any, Any, Any], Any] = cast(Any, _dot)
