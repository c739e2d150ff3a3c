"""Exponentials and logarithms of vectors; see ``lanes``.

Coefficients are fitted for the least relative error.
"""

from __future__ import annotations

import math

from llvmlite import ir
from numba.core import cgutils
from numba.extending import intrinsic

from forewarp.ops.lanes import FLAGS, INT, constant

_EXP = (1.0, 1.000000036, 0.4999999208, 0.1666642017, 0.04166822565, 0.008374816022, 0.001383684225)
# of (log(1 + f) - f + f^2 / 2) / f^3
_LOG = (
    0.3333331673, -0.2500080904, 0.2000228585, -0.1662459485, 0.141812165, -0.1312841966, 0.1288139234,
    -0.0786014978,
)  # fmt: skip
_LOW, _HIGH = -87.0, 88.0  # what float32 can say the exponential of
_LN2 = (0.693359375, -2.12194440e-4)  # in two parts, the first exact
_MANTISSA, _BIAS = 23, 127


def _function(builder, name: str, kind, count: int = 1):
    return cgutils.get_or_insert_function(
        builder.module, ir.FunctionType(kind, [kind] * count), f"llvm.{name}.v{kind.count}f32"
    )


def _polynomial(builder, x, factors):
    width = x.type.count
    fused = _function(builder, "fmuladd", x.type, 3)
    value = constant(width, [factors[-1]] * width)
    for factor in factors[-2::-1]:
        value = builder.call(fused, [value, x, constant(width, [factor] * width)])
    return value


def _whole(width: int, value: int):
    return ir.Constant(ir.VectorType(INT, width), [value] * width)


@intrinsic
def exp(typing, a):
    """``exp(a)`` to 1e-7, of ``a`` between -87 and 88; beyond, of those. NaN stays NaN."""

    def code(context, builder, sig, args):
        width, kind, x = a.width, args[0].type, args[0]
        for sign, limit in (("<", _LOW), (">", _HIGH)):
            mark = constant(width, [limit] * width)
            x = builder.select(builder.fcmp_ordered(sign, x, mark), mark, x)
        scaled = builder.fmul(x, constant(width, [1 / math.log(2)] * width))
        times = builder.call(_function(builder, "rint", kind), [scaled])
        fused = _function(builder, "fmuladd", kind, 3)
        for part in _LN2:
            x = builder.call(fused, [times, constant(width, [-part] * width), x])
        whole = builder.fptosi(times, ir.VectorType(INT, width))
        bits = builder.shl(builder.add(whole, _whole(width, _BIAS)), _whole(width, _MANTISSA))
        return builder.fmul(_polynomial(builder, x, _EXP), builder.bitcast(bits, kind), flags=FLAGS)

    return a(a), code


@intrinsic
def log(typing, a):
    """``log(a)`` to 1e-7, of ``a`` not below 1e-37."""

    def code(context, builder, sig, args):
        width, kind = a.width, args[0].type
        bits = builder.bitcast(args[0], ir.VectorType(INT, width))
        # What is added makes the mantissa lie between the roots of 1/2 and of 2.
        bits = builder.add(bits, _whole(width, 0x3F800000 - 0x3F3504F3))
        power = builder.sub(builder.ashr(bits, _whole(width, _MANTISSA)), _whole(width, _BIAS))
        rest = builder.and_(bits, _whole(width, (1 << _MANTISSA) - 1))
        rest = builder.bitcast(builder.add(rest, _whole(width, 0x3F3504F3)), kind)
        f = builder.fsub(rest, constant(width, [1.0] * width))
        square = builder.fmul(f, f)
        fused = _function(builder, "fmuladd", kind, 3)
        value = builder.fmul(_polynomial(builder, f, _LOG), f)
        value = builder.fmul(builder.fadd(value, constant(width, [-0.5] * width)), square)
        times = builder.sitofp(power, kind)
        value = builder.call(fused, [times, constant(width, [_LN2[1]] * width), value])
        value = builder.fadd(value, f)
        return builder.call(fused, [times, constant(width, [_LN2[0]] * width), value])

    return a(a), code
