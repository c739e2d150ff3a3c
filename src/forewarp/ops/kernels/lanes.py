"""Vectors of float32 for Numba kernels: the 64 pixels of a tile at once, or 16 numbers.

Numba does not make vectors of a loop that has branches. Here a vector is a value of its own: LLVM gives each
operation the widest registers that the CPU has, and splits it where they are narrower. ``+ - *`` work between
vectors, and between a vector and a number.
"""

from __future__ import annotations

import math
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
_EXP_DOWN = (1.0, 0.124999082, 0.00781045913, 0.00032400775, 9.66979279e-06, 1.75144516e-07)


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
        value = constant(width, [_EXP_DOWN[-1]] * width)
        for factor in _EXP_DOWN[-2::-1]:
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


def _combined(builder, a, b, size: int):
    """Add neighbouring blocks of ``size`` lanes of ``a``, then of ``b``."""
    zero = constant(NARROW, [0.0] * NARROW)
    if a is None:
        return None
    b = zero if b is None else b
    blocks = [list(range(i, i + size)) for i in range(0, 2 * NARROW, size)]
    even, odd = (sum(blocks[first::2], []) for first in (0, 1))
    return builder.fadd(shuffled(builder, a, b, even), shuffled(builder, a, b, odd), flags=FLAGS)


def _address(context, builder, kind, array, index):
    """Pointer to an array's element; ``index`` are its coordinates."""
    record = cgutils.create_struct_proxy(kind)(context, builder, value=array)
    return cgutils.get_item_pointer(context, builder, kind, record, index, wraparound=False)


@intrinsic
def add_sums(typing, array, row, values):
    """``array[row, k] += sum of values[k]`` of a tuple of at most 16 vectors; the row has 16 places."""

    def code(context, builder, sig, args):
        places = [*cgutils.unpack_tuple(builder, args[2])]
        places += [None] * (NARROW - len(places))
        size = NARROW // 2
        while len(places) > 1:
            places = [_combined(builder, a, b, size) for a, b in zip(places[::2], places[1::2])]
            size //= 2
        at = [args[1], context.get_constant(types.intp, 0)]
        pointer = _address(context, builder, sig.args[0], args[0], at)
        pointer = builder.bitcast(pointer, ir.VectorType(FLOAT, NARROW).as_pointer())
        total = builder.fadd(builder.load(pointer, align=4), places[0], flags=FLAGS)
        builder.store(total, pointer, align=4)
        return context.get_dummy_value()

    return types.none(array, types.intp, values), code


@intrinsic
def put(typing, array, row, value):
    """Write 64 numbers to ``array[row, :64]``."""

    def code(context, builder, sig, args):
        at = [args[1], context.get_constant(types.intp, 0)]
        pointer = _address(context, builder, sig.args[0], args[0], at)
        builder.store(args[2], builder.bitcast(pointer, args[2].type.as_pointer()), align=4)
        return context.get_dummy_value()

    return types.none(array, types.intp, value), code


@intrinsic(prefer_literal=True)
def room(typing, count):
    """Place for ``count`` (a literal) rows of 16 float32 of a function's own: a pointer to index."""
    if not isinstance(count, types.IntegerLiteral):
        return None

    def code(context, builder, sig, args):
        place = cgutils.alloca_once(builder, ir.ArrayType(ir.VectorType(FLOAT, NARROW), count.literal_value))
        return builder.bitcast(place, FLOAT.as_pointer())

    return types.CPointer(types.float32)(count), code


@intrinsic
def floats_at(typing, address):
    """The float32 at an address, an int64: a pointer to index, as of ``room``."""

    def code(context, builder, sig, args):
        return builder.inttoptr(args[0], FLOAT.as_pointer())

    return types.CPointer(types.float32)(types.int64), code


def _row(builder, place, index):
    """Pointer to a row of a ``room``, as a vector."""
    kind = ir.VectorType(FLOAT, NARROW).as_pointer()
    return builder.gep(builder.bitcast(place, kind), [index])


@intrinsic
def row_of(typing, place, index):
    """Read row ``index`` of a ``room``."""

    def code(context, builder, sig, args):
        return builder.load(_row(builder, *args), align=4)

    return SUMS(place, types.intp), code


@intrinsic
def set_row(typing, place, index, value):
    """Write row ``index`` of a ``room``."""

    def code(context, builder, sig, args):
        builder.store(args[2], _row(builder, *args[:2]), align=4)
        return context.get_dummy_value()

    return types.none(place, types.intp, value), code


@intrinsic
def get_row(typing, array, row):
    """Read ``array[row, :16]``, or ``array[row : row + 16]``, also of ``floats_at``."""

    def code(context, builder, sig, args):
        return builder.load(_array_row(context, builder, sig.args[0], *args), align=4)

    return SUMS(array, types.intp), code


@intrinsic
def put_row(typing, array, row, value):
    """Write 16 numbers to ``array[row, :16]``, or ``array[row : row + 16]``, also of ``floats_at``."""

    def code(context, builder, sig, args):
        builder.store(args[2], _array_row(context, builder, sig.args[0], *args[:2]), align=4)
        return context.get_dummy_value()

    return types.none(array, types.intp, value), code


def _array_row(context, builder, kind, array, row):
    if isinstance(kind, types.CPointer):
        return builder.bitcast(builder.gep(array, [row]), ir.VectorType(FLOAT, NARROW).as_pointer())
    zeros = [context.get_constant(types.intp, 0)] * (kind.ndim - 1)
    pointer = _address(context, builder, kind, array, [row, *zeros])
    return builder.bitcast(pointer, ir.VectorType(FLOAT, NARROW).as_pointer())


@intrinsic
def transpose(typing, place):
    """Exchange rows and columns of the first 16 rows of a ``room``."""

    def code(context, builder, sig, args):
        index = [_row(builder, args[0], ir.Constant(ir.IntType(64), i)) for i in range(NARROW)]
        rows = [builder.load(pointer, align=4) for pointer in index]
        size = 1
        while size < NARROW:
            low = [i if not i & size else NARROW + i - size for i in range(NARROW)]
            high = [i + size if not i & size else NARROW + i for i in range(NARROW)]
            for i in (i for i in range(NARROW) if not i & size):
                a, b = rows[i], rows[i + size]
                rows[i], rows[i + size] = shuffled(builder, a, b, low), shuffled(builder, a, b, high)
            size *= 2
        for pointer, row in zip(index, rows):
            builder.store(row, pointer, align=4)
        return context.get_dummy_value()

    return types.none(place), code


@intrinsic
def get(typing, array, row):
    """Read 64 numbers from ``array[row, :64]``."""

    def code(context, builder, sig, args):
        at = [args[1], context.get_constant(types.intp, 0)]
        pointer = _address(context, builder, sig.args[0], args[0], at)
        return builder.load(builder.bitcast(pointer, ir.VectorType(FLOAT, WIDE).as_pointer()), align=4)

    return TILE(array, types.intp), code


def _tile_rows(context, builder, kind, array, row, column, element):
    """Pointers to the 8 rows of a tile of ``array`` (H, W), its top left pixel at row and column."""
    for i in range(ROW):
        at = [builder.add(row, ir.Constant(row.type, i)), column]
        pointer = _address(context, builder, kind, array, at)
        yield builder.bitcast(pointer, ir.VectorType(element, ROW).as_pointer())


def _joined(builder, parts):
    while len(parts) > 1:
        size = 2 * parts[0].type.count
        parts = [shuffled(builder, a, b, range(size)) for a, b in zip(parts[::2], parts[1::2])]
    return parts[0]


@intrinsic
def get_tile(typing, plane, row, column):
    """The tile of a plane (H, W) float32 whose top left pixel is at row and column."""

    def code(context, builder, sig, args):
        at = _tile_rows(context, builder, sig.args[0], *args, FLOAT)
        return _joined(builder, [builder.load(pointer, align=4) for pointer in at])

    return TILE(plane, types.intp, types.intp), code


@intrinsic
def put_tile(typing, plane, row, column, value):
    """Write a tile into a plane (H, W) float32."""

    def code(context, builder, sig, args):
        at = _tile_rows(context, builder, sig.args[0], *args[:3], FLOAT)
        for i, pointer in enumerate(at):
            part = shuffled(builder, args[3], args[3], range(ROW * i, ROW * (i + 1)))
            builder.store(part, pointer, align=4)
        return context.get_dummy_value()

    return types.none(plane, types.intp, types.intp, value), code


@intrinsic
def get_channel(typing, pixels, row, column, number):
    """Channel ``number`` (0 to 3) in [0, 1] of a tile of pixels (H, W) uint32, four bytes each."""

    def code(context, builder, sig, args):
        at = _tile_rows(context, builder, sig.args[0], *args[:3], INT)
        packed = _joined(builder, [builder.load(pointer, align=4) for pointer in at])
        shift = builder.mul(builder.trunc(args[3], INT), ir.Constant(INT, 8))
        vector = ir.VectorType(INT, WIDE)
        first = builder.insert_element(ir.Constant(vector, ir.Undefined), shift, ir.Constant(INT, 0))
        shift = shuffled(builder, first, first, [0] * WIDE)
        byte = builder.and_(builder.lshr(packed, shift), ir.Constant(vector, [255] * WIDE))
        value = builder.uitofp(byte, ir.VectorType(FLOAT, WIDE))
        return builder.fmul(value, constant(WIDE, [1 / 255] * WIDE), flags=FLAGS)

    return TILE(pixels, types.intp, types.intp, types.intp), code
