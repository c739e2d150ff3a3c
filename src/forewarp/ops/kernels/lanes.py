"""Vectors of float32 for Numba kernels: the 64 pixels of a tile at once, or 16 numbers.

Numba does not make vectors of a loop that has branches. Here a vector is a value of its own: LLVM gives each
operation the widest registers that the CPU has, and splits it where they are narrower. ``+ - * /`` work
between vectors, and between a vector and a number.

Functions that take ``builder`` write LLVM code: those ``_of_vectors`` are called from kernels without it, the
others are their parts. All other functions are called from kernels, too.
"""

from __future__ import annotations

import inspect
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
# Polynomials, fitted for the least relative error: of exp(a / 8), for alphas alone;
_EXP_DOWN = (1.0, 0.124999082, 0.00781045913, 0.00032400775, 9.66979279e-06, 1.75144516e-07)
# of exp(a); and of (log(1 + f) - f + f^2 / 2) / f^3.
_EXP = (1.0, 1.000000036, 0.4999999208, 0.1666642017, 0.04166822565, 0.008374816022, 0.001383684225)
_LOG = (
    0.3333331673, -0.2500080904, 0.2000228585, -0.1662459485, 0.141812165, -0.1312841966, 0.1288139234,
    -0.0786014978,
)  # fmt: skip
_LOW, _HIGH = -87.0, 88.0  # between these float32 holds the exponential
_LN2 = (0.693359375, -2.12194440e-4)  # in two parts, the first exact
_MANTISSA, _BIAS = 23, 127
_ROOT_HALF = 0x3F3504F3  # the bits of sqrt(1/2)


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


def _constant(width: int, values):
    """A vector of known numbers, or of one throughout."""
    values = [values] * width if isinstance(values, float) else list(values)
    return ir.Constant(ir.VectorType(FLOAT, width), values)


def _whole(width: int, value: int):
    """A vector of one int32 throughout."""
    return ir.Constant(ir.VectorType(INT, width), [value] * width)


def _shuffled(builder, a, b, order):
    """Code of a vector of some lanes of ``a``, then ``b``."""
    return builder.shuffle_vector(a, b, ir.Constant(ir.VectorType(INT, len(order)), list(order)))


def _repeated(builder, value, width: int):
    """Code of a vector that holds one scalar throughout."""
    undefined = ir.Constant(ir.VectorType(value.type, width), ir.Undefined)
    first = builder.insert_element(undefined, value, ir.Constant(INT, 0))
    return _shuffled(builder, first, undefined, [0] * width)


def _as_lanes(builder, value, kind, width: int):
    """Code of a vector: ``value`` itself, or a number throughout."""
    if isinstance(kind, LanesType):
        return value
    if isinstance(kind, types.Integer):
        value = builder.sitofp(value, FLOAT)
    return _repeated(builder, builder.fptrunc(value, FLOAT) if kind == types.float64 else value, width)


def _llvm(builder, name: str, *vectors):
    """Call an intrinsic function of LLVM."""
    kind = vectors[0].type
    of = ir.FunctionType(kind, [kind] * len(vectors))
    name = f"llvm.{name}.v{kind.count}f32"
    return builder.call(cgutils.get_or_insert_function(builder.module, of, name), vectors)


def _polynomial(builder, x, factors):
    value = _constant(x.type.count, factors[-1])
    for factor in factors[-2::-1]:
        value = _llvm(builder, "fmuladd", value, x, _constant(x.type.count, factor))
    return value


def _width(kinds) -> int | None:
    """The one width of all vectors among ``kinds``; None where they do not go together."""
    widths = {k.width for k in kinds if isinstance(k, LanesType)}
    fits = all(isinstance(k, LanesType | types.Float | types.Integer) for k in kinds)
    return widths.pop() if fits and len(widths) == 1 else None


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

    lower_builtin(function, LanesType, LanesType)(lower)
    for number in (types.Float, types.Integer):
        lower_builtin(function, LanesType, number)(lower)
        lower_builtin(function, number, LanesType)(lower)


_operator(operator.add, "fadd")
_operator(operator.sub, "fsub")
_operator(operator.mul, "fmul")
_operator(operator.truediv, "fdiv")


# Values ----------------------------------------------------------------------------------------------------


def _of_vectors(result=None):
    """Make an intrinsic of a function that writes code: it gets the builder, and vectors, to which numbers
    among its arguments are widened. ``result``: the type of what it gives; None: a vector as wide.
    """

    def make(write):
        def define(typing, *kinds):
            width = _width(kinds)

            def code(context, builder, sig, args):
                return write(builder, *(_as_lanes(builder, *pair, width) for pair in zip(args, sig.args)))

            if width is None:
                return None
            given = LanesType(width) if result is None else result
            return given(*kinds), code

        define.__name__, define.__doc__ = write.__name__, write.__doc__
        define.__signature__ = inspect.signature(write)  # by which Numba counts arguments
        return intrinsic(define)

    return make


@intrinsic
def lanes(typing, value):
    """A number on all pixels of a tile."""
    return TILE(value), lambda _, builder, sig, args: _as_lanes(builder, args[0], sig.args[0], WIDE)


@intrinsic
def sixteen(typing, value):
    """A number on 16 lanes."""
    return SUMS(value), lambda _, builder, sig, args: _as_lanes(builder, args[0], sig.args[0], NARROW)


@intrinsic
def rows(typing):
    """Row 0 to 7 of each of a tile's pixels, at its centre."""
    return TILE(), lambda *_: _constant(WIDE, ((i // ROW) + 0.5 for i in range(WIDE)))


@intrinsic
def narrow_columns(typing):
    """Columns of the pixels whose sums ``fold`` gives."""
    return SUMS(), lambda *_: _constant(NARROW, ((i % ROW) + 0.5 for i in range(NARROW)))


@_of_vectors(TILE)
def widened(builder, a):
    """The 64 pixels of a tile whose rows come in four pairs alike: ``a`` is one pair, 2 rows of 8."""
    return _shuffled(builder, a, a, [*range(NARROW)] * (WIDE // NARROW))


@_of_vectors()
def fma(builder, a, b, c):
    """``a b + c``, in one instruction where the CPU has it."""
    return _llvm(builder, "fmuladd", a, b, c)


@_of_vectors()
def root(builder, a):
    """The square root."""
    return _llvm(builder, "sqrt", a)


@_of_vectors()
def where_above(builder, a, least, value):
    """``value`` where ``a > least``, 0 elsewhere, also where ``a`` is NaN."""
    return builder.select(builder.fcmp_ordered(">", a, least), value, _constant(a.type.count, 0.0))


@_of_vectors(types.boolean)
def any_above(builder, a, least):
    """Whether ``a > least`` anywhere."""
    bits = builder.bitcast(builder.fcmp_ordered(">", a, least), ir.IntType(a.type.count))
    return builder.icmp_unsigned("!=", bits, ir.Constant(bits.type, 0))


@_of_vectors()
def maximum(builder, a, b):
    """The larger of two vectors, or of one and a number; ``b`` where either is NaN."""
    return builder.select(builder.fcmp_ordered(">", a, b), a, b)


@_of_vectors()
def minimum(builder, a, b):
    """The smaller of two vectors, or of one and a number; ``b`` where either is NaN."""
    return builder.select(builder.fcmp_ordered("<", a, b), a, b)


@_of_vectors(types.uint64)
def not_zero(builder, a):
    """Which of 16 numbers are not 0, NaN among them: as bits of a uint64, the first the lowest."""
    marks = builder.fcmp_unordered("!=", a, _constant(NARROW, 0.0))
    return builder.zext(builder.bitcast(marks, ir.IntType(NARROW)), ir.IntType(64))


@intrinsic
def where_bits(typing, bits, a, b):
    """``a`` where a bit of the lowest 16 of ``bits`` is set, else ``b``; see ``not_zero``."""

    def code(context, builder, sig, args):
        low = builder.trunc(args[0], ir.IntType(NARROW))
        return builder.select(builder.bitcast(low, ir.VectorType(ir.IntType(1), NARROW)), args[1], args[2])

    return SUMS(types.uint64, SUMS, SUMS), code


@_of_vectors()
def exp_down(builder, a):
    """``exp(a)`` of ``-6 <= a <= 0`` to 1e-6; of other numbers it is anything.

    The polynomial is of ``exp(a / 8)``, whose eighth power is taken by squaring thrice.
    """
    value = _polynomial(builder, a, _EXP_DOWN)
    for _ in range(3):
        value = builder.fmul(value, value, flags=FLAGS)
    return value


@_of_vectors()
def exp(builder, x):
    """``exp(x)`` to 1e-7, of ``x`` between -87 and 88; beyond, of those. NaN stays NaN."""
    width = x.type.count
    for sign, limit in (("<", _LOW), (">", _HIGH)):
        mark = _constant(width, limit)
        x = builder.select(builder.fcmp_ordered(sign, x, mark), mark, x)
    times = _llvm(builder, "rint", builder.fmul(x, _constant(width, 1 / math.log(2))))
    for part in _LN2:
        x = _llvm(builder, "fmuladd", times, _constant(width, -part), x)
    power = builder.add(builder.fptosi(times, ir.VectorType(INT, width)), _whole(width, _BIAS))
    power = builder.bitcast(builder.shl(power, _whole(width, _MANTISSA)), x.type)
    return builder.fmul(_polynomial(builder, x, _EXP), power, flags=FLAGS)


@_of_vectors()
def log(builder, a):
    """``log(a)`` to 1e-7, of ``a`` not below 1e-37."""
    width, kind = a.type.count, a.type
    bits = builder.bitcast(a, ir.VectorType(INT, width))
    # What is added makes the mantissa lie between the roots of 1/2 and of 2.
    bits = builder.add(bits, _whole(width, 0x3F800000 - _ROOT_HALF))
    power = builder.sub(builder.ashr(bits, _whole(width, _MANTISSA)), _whole(width, _BIAS))
    rest = builder.and_(bits, _whole(width, (1 << _MANTISSA) - 1))
    rest = builder.bitcast(builder.add(rest, _whole(width, _ROOT_HALF)), kind)
    f = builder.fsub(rest, _constant(width, 1.0))
    value = builder.fmul(_polynomial(builder, f, _LOG), f)
    value = builder.fmul(builder.fadd(value, _constant(width, -0.5)), builder.fmul(f, f))
    times = builder.sitofp(power, kind)
    value = builder.fadd(_llvm(builder, "fmuladd", times, _constant(width, _LN2[1]), value), f)
    return _llvm(builder, "fmuladd", times, _constant(width, _LN2[0]), value)


@_of_vectors(SUMS)
def fold(builder, a):
    """The sum of a tile's four pairs of rows: 16 numbers, 2 rows of 8."""
    parts = [_shuffled(builder, a, a, range(i, i + NARROW)) for i in range(0, WIDE, NARROW)]
    first, second = (builder.fadd(*pair, flags=FLAGS) for pair in (parts[:2], parts[2:]))
    return builder.fadd(first, second, flags=FLAGS)


@_of_vectors(types.float32)
def total(builder, value):
    """The sum of all, float32."""
    width = value.type.count
    while width > 1:
        width //= 2
        low, high = (_shuffled(builder, value, value, range(i, i + width)) for i in (0, width))
        value = builder.fadd(low, high, flags=FLAGS)
    return builder.extract_element(value, ir.Constant(INT, 0))


# Memory ----------------------------------------------------------------------------------------------------


def _at(context, builder, kind, array, row, *column, width: int, element=FLOAT):
    """Pointer to a vector that begins at ``array[row, column]``, or column 0; also from a pointer on."""
    if isinstance(kind, types.CPointer):
        pointer = builder.gep(array, [row])
    else:
        index = [row, *column] + [context.get_constant(types.intp, 0)] * (kind.ndim - 1 - len(column))
        record = cgutils.create_struct_proxy(kind)(context, builder, value=array)
        pointer = cgutils.get_item_pointer(context, builder, kind, record, index, wraparound=False)
    return builder.bitcast(pointer, ir.VectorType(element, width).as_pointer())


def _read(kind, array):
    """Read a vector from ``array[row]``."""

    def code(context, builder, sig, args):
        return builder.load(_at(context, builder, sig.args[0], *args, width=kind.width), align=4)

    return kind(array, types.intp), code


@intrinsic
def get(typing, array, row):
    """Read 64 numbers from ``array[row, :64]``."""
    return _read(TILE, array)


@intrinsic
def get_row(typing, array, row):
    """Read ``array[row, :16]``, or ``array[row : row + 16]``, also of ``floats_at``."""
    return _read(SUMS, array)


@intrinsic
def put_row(typing, array, row, value):
    """Write a vector to ``array[row, :width]``, or ``array[row : row + width]``, also of ``floats_at``."""

    def code(context, builder, sig, args):
        pointer = _at(context, builder, sig.args[0], *args[:2], width=value.width)
        builder.store(args[2], pointer, align=4)
        return context.get_dummy_value()

    return types.none(array, types.intp, value), code


def _combined(builder, a, b, size: int):
    """Add neighbouring blocks of ``size`` lanes of ``a``, then of ``b``."""
    if a is None:
        return None
    b = _constant(NARROW, 0.0) if b is None else b
    blocks = [list(range(i, i + size)) for i in range(0, 2 * NARROW, size)]
    even, odd = (sum(blocks[first::2], []) for first in (0, 1))
    return builder.fadd(_shuffled(builder, a, b, even), _shuffled(builder, a, b, odd), flags=FLAGS)


@intrinsic
def add_sums(typing, array, row, values):
    """``array[row, k] += sum of values[k]`` of a tuple of at most 16 vectors; the row has 16 places."""

    def code(context, builder, sig, args):
        sums = [*cgutils.unpack_tuple(builder, args[2])]
        sums += [None] * (NARROW - len(sums))
        size = NARROW // 2
        while len(sums) > 1:
            sums = [_combined(builder, a, b, size) for a, b in zip(sums[::2], sums[1::2])]
            size //= 2
        pointer = _at(context, builder, sig.args[0], *args[:2], width=NARROW)
        builder.store(builder.fadd(builder.load(pointer, align=4), sums[0], flags=FLAGS), pointer, align=4)
        return context.get_dummy_value()

    return types.none(array, types.intp, values), code


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
    kind = types.CPointer(types.float32)(types.int64)
    return kind, lambda _, builder, sig, args: builder.inttoptr(args[0], FLOAT.as_pointer())


def _row(builder, place, index):
    """Pointer to a row of a ``room``, as a vector."""
    return builder.gep(builder.bitcast(place, ir.VectorType(FLOAT, NARROW).as_pointer()), [index])


@intrinsic
def row_of(typing, place, index):
    """Read row ``index`` of a ``room``."""
    kind = SUMS(place, types.intp)
    return kind, lambda _, builder, sig, args: builder.load(_row(builder, *args), align=4)


@intrinsic(prefer_literal=True)
def rows_of(typing, place, first, count):
    """Read ``count`` (a literal) rows of a ``room`` from row ``first`` on: a tuple."""
    if not isinstance(count, types.IntegerLiteral):
        return None
    kind = types.UniTuple(SUMS, count.literal_value)

    def code(context, builder, sig, args):
        index = (builder.add(args[1], ir.Constant(args[1].type, i)) for i in range(kind.count))
        loaded = [builder.load(_row(builder, args[0], i), align=4) for i in index]
        return context.make_tuple(builder, kind, loaded)

    return kind(place, types.intp, count), code


@intrinsic
def set_row(typing, place, index, value):
    """Write row ``index`` of a ``room``."""

    def code(context, builder, sig, args):
        builder.store(args[2], _row(builder, *args[:2]), align=4)
        return context.get_dummy_value()

    return types.none(place, types.intp, value), code


@intrinsic
def set_rows(typing, place, first, values):
    """Write a tuple of vectors to the rows of a ``room`` from row ``first`` on."""

    def code(context, builder, sig, args):
        for i, value in enumerate(cgutils.unpack_tuple(builder, args[2])):
            index = builder.add(args[1], ir.Constant(args[1].type, i))
            builder.store(value, _row(builder, args[0], index), align=4)
        return context.get_dummy_value()

    return types.none(place, types.intp, values), code


@intrinsic
def transpose(typing, place):
    """Exchange rows and columns of the first 16 rows of a ``room``."""

    def code(context, builder, sig, args):
        pointers = [_row(builder, args[0], ir.Constant(ir.IntType(64), i)) for i in range(NARROW)]
        rows = [builder.load(pointer, align=4) for pointer in pointers]
        size = 1
        while size < NARROW:
            low = [i if not i & size else NARROW + i - size for i in range(NARROW)]
            high = [i + size if not i & size else NARROW + i for i in range(NARROW)]
            for i in (i for i in range(NARROW) if not i & size):
                a, b = rows[i], rows[i + size]
                rows[i], rows[i + size] = _shuffled(builder, a, b, low), _shuffled(builder, a, b, high)
            size *= 2
        for pointer, row in zip(pointers, rows):
            builder.store(row, pointer, align=4)
        return context.get_dummy_value()

    return types.none(place), code


def _tile_rows(context, builder, kind, array, row, column, element):
    """Pointers to the 8 rows of a tile of ``array`` (H, W), its top left pixel at row and column."""
    for i in range(ROW):
        below = builder.add(row, ir.Constant(row.type, i))
        yield _at(context, builder, kind, array, below, column, width=ROW, element=element)


def _get_tile(context, builder, kind, array, row, column, element):
    """Code of a tile's pixels, read and joined row by row."""
    pointers = _tile_rows(context, builder, kind, array, row, column, element)
    parts = [builder.load(pointer, align=4) for pointer in pointers]
    while len(parts) > 1:
        size = 2 * parts[0].type.count
        parts = [_shuffled(builder, a, b, range(size)) for a, b in zip(parts[::2], parts[1::2])]
    return parts[0]


@intrinsic
def get_tile(typing, plane, row, column):
    """The tile of a plane (H, W) float32 whose top left pixel is at row and column."""
    kind = TILE(plane, types.intp, types.intp)
    return kind, lambda context, builder, sig, args: _get_tile(context, builder, sig.args[0], *args, FLOAT)


@intrinsic
def put_tile(typing, plane, row, column, value):
    """Write a tile into a plane (H, W) float32."""

    def code(context, builder, sig, args):
        for i, pointer in enumerate(_tile_rows(context, builder, sig.args[0], *args[:3], FLOAT)):
            part = _shuffled(builder, args[3], args[3], range(ROW * i, ROW * (i + 1)))
            builder.store(part, pointer, align=4)
        return context.get_dummy_value()

    return types.none(plane, types.intp, types.intp, value), code


@intrinsic
def get_channel(typing, pixels, row, column, number):
    """Channel ``number`` (0 to 3) in [0, 1] of a tile of pixels (H, W) uint32, four bytes each."""

    def code(context, builder, sig, args):
        packed = _get_tile(context, builder, sig.args[0], *args[:3], INT)
        shift = builder.mul(builder.trunc(args[3], INT), ir.Constant(INT, 8))
        byte = builder.and_(builder.lshr(packed, _repeated(builder, shift, WIDE)), _whole(WIDE, 255))
        value = builder.uitofp(byte, ir.VectorType(FLOAT, WIDE))
        return builder.fmul(value, _constant(WIDE, 1 / 255), flags=FLAGS)

    return TILE(pixels, types.intp, types.intp, types.intp), code
