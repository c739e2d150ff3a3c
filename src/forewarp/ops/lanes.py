"""Vectors of float32 for Numba kernels: the 64 pixels of a tile at once, or 16 numbers.

Numba does not make vectors of a loop that has branches. Here a vector is a value of its own: LLVM gives each
operation the widest registers that the CPU has, and splits it where they are narrower. ``+ - *`` work between
vectors, and between a vector and a number.
"""

from __future__ import annotations

import operator

from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.core.typing.templates import AbstractTemplate, infer_global, signature
from numba.extending import intrinsic, lower_builtin, models, register_model

WIDE, NARROW = 64, 16
ROW = 8  # pixels of a tile's row
FLOAT, INT = ir.FloatType(), ir.IntType(32)
FLAGS = ("contract", "nsz")  # a product and a sum may become one instruction
_EXP = (1.0, 0.124999082, 0.00781045913, 0.00032400775, 9.66979279e-06, 1.75144516e-07)


class LanesType(types.Type):
    """A vector of ``width`` float32."""

    def __init__(self, width: int) -> None:
        self.width = width
        super().__init__(name=f"Lanes{width}")


@register_model(LanesType)
class _LanesModel(models.PrimitiveModel):
    def __init__(self, manager, kind) -> None:
        super().__init__(manager, kind, ir.VectorType(FLOAT, kind.width))


TILE, SUMS = LanesType(WIDE), LanesType(NARROW)


def number(builder, value, kind):
    """A scalar as float32."""
    if isinstance(kind, types.Integer):
        return builder.sitofp(value, FLOAT)
    return builder.fptrunc(value, FLOAT) if kind == types.float64 else value


def repeated(builder, value, width: int):
    """Code of a vector that holds one number throughout."""
    vector = ir.VectorType(FLOAT, width)
    first = builder.insert_element(ir.Constant(vector, ir.Undefined), value, ir.Constant(INT, 0))
    return builder.shuffle_vector(
        first, ir.Constant(vector, ir.Undefined), ir.Constant(ir.VectorType(INT, width), [0] * width)
    )


def _as_lanes(builder, value, kind, width: int):
    return value if isinstance(kind, LanesType) else repeated(builder, number(builder, value, kind), width)


def _width(kinds) -> int | None:
    """The one width of all vectors among ``kinds``; None where they do not go together."""
    widths = {k.width for k in kinds if isinstance(k, LanesType)}
    fits = all(isinstance(k, LanesType | types.Float | types.Integer) for k in kinds)
    return widths.pop() if fits and len(widths) == 1 else None


def constant(width: int, values):
    """A vector of known numbers."""
    return ir.Constant(ir.VectorType(FLOAT, width), list(values))


def shuffled(builder, a, b, order):
    """Code of a vector of some lanes of ``a``, then ``b``."""
    return builder.shuffle_vector(a, b, ir.Constant(ir.VectorType(INT, len(order)), list(order)))


def _operator(function, instruction: str) -> None:
    @infer_global(function)
    class _Lanes(AbstractTemplate):
        def generic(self, args, kws):
            width = _width(args) if len(args) == 2 else None
            return None if width is None else signature(LanesType(width), *args)

    def lower(context, builder, sig, args):
        width = sig.return_type.width
        a, b = (_as_lanes(builder, value, kind, width) for value, kind in zip(args, sig.args))
        return getattr(builder, instruction)(a, b, flags=FLAGS)

    for kinds in (
        (LanesType, LanesType),
        (LanesType, types.Float),
        (types.Float, LanesType),
        (LanesType, types.Integer),
        (types.Integer, LanesType),
    ):
        lower_builtin(function, *kinds)(lower)


for _function, _instruction in (
    (operator.add, "fadd"),
    (operator.sub, "fsub"),
    (operator.mul, "fmul"),
    (operator.truediv, "fdiv"),
):
    _operator(_function, _instruction)


@intrinsic
def lanes(typing, value):
    """A number on all pixels of a tile."""

    def code(context, builder, sig, args):
        return repeated(builder, number(builder, args[0], sig.args[0]), WIDE)

    return TILE(value), code


@intrinsic
def sixteen(typing, value):
    """A number on 16 lanes."""

    def code(context, builder, sig, args):
        return repeated(builder, number(builder, args[0], sig.args[0]), NARROW)

    return SUMS(value), code


@intrinsic
def rows(typing):
    """Row 0 to 7 of each of a tile's pixels, at its centre."""
    return TILE(), lambda context, builder, sig, args: constant(WIDE, ((i // ROW) + 0.5 for i in range(WIDE)))


@intrinsic
def narrow_columns(typing):
    """Columns of the pixels whose sums ``fold`` gives."""
    return SUMS(), lambda context, builder, sig, args: constant(
        NARROW, ((i % ROW) + 0.5 for i in range(NARROW))
    )


@intrinsic
def widened(typing, a):
    """The 64 pixels of a tile whose rows come in four pairs alike: ``a`` is one pair, 2 rows of 8."""

    def code(context, builder, sig, args):
        return shuffled(builder, args[0], args[0], [*range(NARROW)] * (WIDE // NARROW))

    return TILE(a), code


@intrinsic
def fma(typing, a, b, c):
    """``a b + c``, in one instruction where the CPU has it."""
    width = _width((a, b, c))

    def code(context, builder, sig, args):
        vectors = [_as_lanes(builder, value, kind, width) for value, kind in zip(args, sig.args)]
        kind = vectors[0].type
        function = cgutils.get_or_insert_function(
            builder.module, ir.FunctionType(kind, [kind] * 3), f"llvm.fmuladd.v{width}f32"
        )
        return builder.call(function, vectors)

    return LanesType(width)(a, b, c), code


@intrinsic
def root(typing, a):
    """The square root."""

    def code(context, builder, sig, args):
        function = cgutils.get_or_insert_function(
            builder.module, ir.FunctionType(args[0].type, [args[0].type]), f"llvm.sqrt.v{a.width}f32"
        )
        return builder.call(function, args)

    return a(a), code


@intrinsic
def where_above(typing, a, least, value):
    """``value`` where ``a > least``, 0 elsewhere, also where ``a`` is NaN."""

    def code(context, builder, sig, args):
        mark = repeated(builder, number(builder, args[1], sig.args[1]), a.width)
        above = builder.fcmp_ordered(">", args[0], mark)
        return builder.select(above, args[2], constant(a.width, [0.0] * a.width))

    return value(a, least, value), code


@intrinsic
def at_least(typing, a, least):
    """The larger of ``a`` and ``least``; NaN stays NaN."""

    def code(context, builder, sig, args):
        mark = repeated(builder, number(builder, args[1], sig.args[1]), a.width)
        return builder.select(builder.fcmp_ordered("<", args[0], mark), mark, args[0])

    return a(a, least), code


def _chosen(a, b, sign: str):
    """Code that takes ``a`` where it compares so with ``b``, else ``b``; a number is put beside itself."""

    def code(context, builder, sig, args):
        x, y = (_as_lanes(builder, v, k, sig.return_type.width) for v, k in zip(args, sig.args))
        return builder.select(builder.fcmp_ordered(sign, x, y), x, y)

    return SUMS(a, b), code


@intrinsic
def maximum(typing, a, b):
    """The larger of two vectors of 16 numbers, or of one and a number; ``b`` where either is NaN."""
    return _chosen(a, b, ">")


@intrinsic
def minimum(typing, a, b):
    """The smaller of two vectors of 16 numbers, or of one and a number; ``b`` where either is NaN."""
    return _chosen(a, b, "<")


@intrinsic
def any_above(typing, a, least):
    """Whether ``a > least`` anywhere."""

    def code(context, builder, sig, args):
        mark = repeated(builder, number(builder, args[1], sig.args[1]), a.width)
        bits = builder.bitcast(builder.fcmp_ordered(">", args[0], mark), ir.IntType(a.width))
        return builder.icmp_unsigned("!=", bits, ir.Constant(bits.type, 0))

    return types.boolean(a, least), code


@intrinsic
def not_zero(typing, a):
    """Which of 16 numbers are not 0, NaN among them: as bits of a uint64, the first the lowest."""

    def code(context, builder, sig, args):
        marks = builder.fcmp_unordered("!=", args[0], constant(NARROW, [0.0] * NARROW))
        return builder.zext(builder.bitcast(marks, ir.IntType(NARROW)), ir.IntType(64))

    return types.uint64(SUMS), code


@intrinsic
def where_bits(typing, bits, a, b):
    """``a`` where a bit of the lowest 16 of ``bits`` is set, else ``b``; see ``not_zero``."""

    def code(context, builder, sig, args):
        marks = builder.bitcast(
            builder.trunc(args[0], ir.IntType(NARROW)), ir.VectorType(ir.IntType(1), NARROW)
        )
        return builder.select(marks, args[1], args[2])

    return SUMS(types.uint64, SUMS, SUMS), code


@intrinsic
def exp_down(typing, a):
    """``exp(a)`` of ``-6 <= a <= 0`` to 1e-6; of other numbers it is anything.

    The polynomial is of ``exp(a / 8)``, whose eighth power is taken by squaring thrice.
    """

    def code(context, builder, sig, args):
        width, kind, x = a.width, args[0].type, args[0]
        function = cgutils.get_or_insert_function(
            builder.module, ir.FunctionType(kind, [kind] * 3), f"llvm.fmuladd.v{width}f32"
        )
        value = constant(width, [_EXP[-1]] * width)
        for factor in _EXP[-2::-1]:
            value = builder.call(function, [value, x, constant(width, [factor] * width)])
        for _ in range(3):
            value = builder.fmul(value, value, flags=FLAGS)
        return value

    return a(a), code


@intrinsic
def fold(typing, a):
    """The sum of a tile's four pairs of rows: 16 numbers, 2 rows of 8."""

    def code(context, builder, sig, args):
        parts = [shuffled(builder, args[0], args[0], range(i, i + NARROW)) for i in range(0, WIDE, NARROW)]
        one, other = (builder.fadd(*pair, flags=FLAGS) for pair in (parts[:2], parts[2:]))
        return builder.fadd(one, other, flags=FLAGS)

    return SUMS(a), code


@intrinsic
def total(typing, a):
    """The sum of all, float32."""

    def code(context, builder, sig, args):
        value, width = args[0], a.width
        while width > 1:
            width //= 2
            low, high = (shuffled(builder, value, value, range(i, i + width)) for i in (0, width))
            value = builder.fadd(low, high, flags=FLAGS)
        return builder.extract_element(value, ir.Constant(INT, 0))

    return types.float32(a), code
