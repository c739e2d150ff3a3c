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
_ROW = 8  # pixels of a tile's row
_FLOAT, _INT = ir.FloatType(), ir.IntType(32)
_FLAGS = ("contract", "nsz")  # a product and a sum may become one instruction
_EXP = (1.0, 0.124999082, 0.00781045913, 0.00032400775, 9.66979279e-06, 1.75144516e-07)


class LanesType(types.Type):
    """A vector of ``width`` float32."""

    def __init__(self, width: int) -> None:
        self.width = width
        super().__init__(name=f"Lanes{width}")


@register_model(LanesType)
class _LanesModel(models.PrimitiveModel):
    def __init__(self, manager, kind) -> None:
        super().__init__(manager, kind, ir.VectorType(_FLOAT, kind.width))


TILE, SUMS = LanesType(WIDE), LanesType(NARROW)


def _number(builder, value, kind):
    """A scalar as float32."""
    if isinstance(kind, types.Integer):
        return builder.sitofp(value, _FLOAT)
    return builder.fptrunc(value, _FLOAT) if kind == types.float64 else value


def _repeated(builder, value, width: int):
    vector = ir.VectorType(_FLOAT, width)
    first = builder.insert_element(ir.Constant(vector, ir.Undefined), value, ir.Constant(_INT, 0))
    return builder.shuffle_vector(
        first, ir.Constant(vector, ir.Undefined), ir.Constant(ir.VectorType(_INT, width), [0] * width)
    )


def _as_lanes(builder, value, kind, width: int):
    return value if isinstance(kind, LanesType) else _repeated(builder, _number(builder, value, kind), width)


def _width(kinds) -> int | None:
    """The one width of all vectors among ``kinds``; None where they do not go together."""
    widths = {k.width for k in kinds if isinstance(k, LanesType)}
    fits = all(isinstance(k, LanesType | types.Float | types.Integer) for k in kinds)
    return widths.pop() if fits and len(widths) == 1 else None


def _constant(width: int, values):
    return ir.Constant(ir.VectorType(_FLOAT, width), list(values))


def _shuffled(builder, a, b, order):
    return builder.shuffle_vector(a, b, ir.Constant(ir.VectorType(_INT, len(order)), list(order)))


def _operator(function, instruction: str) -> None:
    @infer_global(function)
    class _Lanes(AbstractTemplate):
        def generic(self, args, kws):
            width = _width(args) if len(args) == 2 else None
            return None if width is None else signature(LanesType(width), *args)

    def lower(context, builder, sig, args):
        width = sig.return_type.width
        a, b = (_as_lanes(builder, value, kind, width) for value, kind in zip(args, sig.args))
        return getattr(builder, instruction)(a, b, flags=_FLAGS)

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
        return _repeated(builder, _number(builder, args[0], sig.args[0]), WIDE)

    return TILE(value), code


@intrinsic
def columns(typing):
    """Column 0 to 7 of each of a tile's pixels, at its centre."""
    return TILE(), lambda context, builder, sig, args: _constant(
        WIDE, ((i % _ROW) + 0.5 for i in range(WIDE))
    )


@intrinsic
def rows(typing):
    """Row 0 to 7 of each of a tile's pixels, at its centre."""
    return TILE(), lambda context, builder, sig, args: _constant(
        WIDE, ((i // _ROW) + 0.5 for i in range(WIDE))
    )


@intrinsic
def narrow_columns(typing):
    """Columns of the pixels whose sums ``fold`` gives."""
    return SUMS(), lambda context, builder, sig, args: _constant(
        NARROW, ((i % _ROW) + 0.5 for i in range(NARROW))
    )


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
        mark = _repeated(builder, _number(builder, args[1], sig.args[1]), a.width)
        above = builder.fcmp_ordered(">", args[0], mark)
        return builder.select(above, args[2], _constant(a.width, [0.0] * a.width))

    return value(a, least, value), code


@intrinsic
def any_above(typing, a, least):
    """Whether ``a > least`` anywhere."""

    def code(context, builder, sig, args):
        mark = _repeated(builder, _number(builder, args[1], sig.args[1]), a.width)
        bits = builder.bitcast(builder.fcmp_ordered(">", args[0], mark), ir.IntType(a.width))
        return builder.icmp_unsigned("!=", bits, ir.Constant(bits.type, 0))

    return types.boolean(a, least), code


@intrinsic
def exp_down(typing, a):
    """``exp(a)`` of ``-6 <= a <= 0`` to 1e-6; of less it is ``exp(-6)``.

    The polynomial is of ``exp(a / 8)``, whose eighth power is taken by squaring thrice.
    """

    def code(context, builder, sig, args):
        width, kind = a.width, args[0].type
        least = _constant(width, [-6.0] * width)
        x = builder.select(builder.fcmp_ordered(">", args[0], least), args[0], least)
        function = cgutils.get_or_insert_function(
            builder.module, ir.FunctionType(kind, [kind] * 3), f"llvm.fmuladd.v{width}f32"
        )
        value = _constant(width, [_EXP[-1]] * width)
        for factor in _EXP[-2::-1]:
            value = builder.call(function, [value, x, _constant(width, [factor] * width)])
        for _ in range(3):
            value = builder.fmul(value, value, flags=_FLAGS)
        return value

    return a(a), code


@intrinsic
def fold(typing, a):
    """The sum of a tile's four pairs of rows: 16 numbers, 2 rows of 8."""

    def code(context, builder, sig, args):
        parts = [_shuffled(builder, args[0], args[0], range(i, i + NARROW)) for i in range(0, WIDE, NARROW)]
        one, other = (builder.fadd(*pair, flags=_FLAGS) for pair in (parts[:2], parts[2:]))
        return builder.fadd(one, other, flags=_FLAGS)

    return SUMS(a), code


def _combined(builder, a, b, size: int):
    """Add neighbouring blocks of ``size`` lanes of ``a``, then of ``b``."""
    zero = _constant(NARROW, [0.0] * NARROW)
    if a is None:
        return None
    b = zero if b is None else b
    blocks = [list(range(i, i + size)) for i in range(0, 2 * NARROW, size)]
    even, odd = (sum(blocks[first::2], []) for first in (0, 1))
    return builder.fadd(_shuffled(builder, a, b, even), _shuffled(builder, a, b, odd), flags=_FLAGS)


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
        pointer = builder.bitcast(pointer, ir.VectorType(_FLOAT, NARROW).as_pointer())
        total = builder.fadd(builder.load(pointer, align=4), places[0], flags=_FLAGS)
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


@intrinsic
def room(typing, count):
    """Place for 16 float32 of a function's own: a pointer to index, which becomes registers where it can.

    ``count`` says how many are used, for a reader.
    """

    def code(context, builder, sig, args):
        place = cgutils.alloca_once(builder, ir.VectorType(_FLOAT, NARROW))
        return builder.bitcast(place, _FLOAT.as_pointer())

    return types.CPointer(types.float32)(count), code


@intrinsic
def add_row(typing, array, row, factor, numbers):
    """``array[row, :16] += factor numbers``, 16 numbers of a ``room``."""

    def code(context, builder, sig, args):
        at, kind = [args[1], context.get_constant(types.intp, 0)], ir.VectorType(_FLOAT, NARROW).as_pointer()
        pointer = builder.bitcast(_address(context, builder, sig.args[0], args[0], at), kind)
        factor = _repeated(builder, args[2], NARROW)
        value = builder.fmul(factor, builder.load(builder.bitcast(args[3], kind), align=4), flags=_FLAGS)
        builder.store(builder.fadd(builder.load(pointer, align=4), value, flags=_FLAGS), pointer, align=4)
        return context.get_dummy_value()

    return types.none(array, types.intp, types.float32, numbers), code


@intrinsic
def take_row(typing, array, row, factor, numbers):
    """``numbers += factor array[row, :16]``, 16 numbers of a ``room``."""

    def code(context, builder, sig, args):
        at, kind = [args[1], context.get_constant(types.intp, 0)], ir.VectorType(_FLOAT, NARROW).as_pointer()
        pointer = builder.bitcast(_address(context, builder, sig.args[0], args[0], at), kind)
        own, factor = builder.bitcast(args[3], kind), _repeated(builder, args[2], NARROW)
        value = builder.fmul(factor, builder.load(pointer, align=4), flags=_FLAGS)
        builder.store(builder.fadd(builder.load(own, align=4), value, flags=_FLAGS), own, align=4)
        return context.get_dummy_value()

    return types.none(array, types.intp, types.float32, numbers), code


@intrinsic
def get(typing, array, row):
    """Read 64 numbers from ``array[row, :64]``."""

    def code(context, builder, sig, args):
        at = [args[1], context.get_constant(types.intp, 0)]
        pointer = _address(context, builder, sig.args[0], args[0], at)
        return builder.load(builder.bitcast(pointer, ir.VectorType(_FLOAT, WIDE).as_pointer()), align=4)

    return TILE(array, types.intp), code


def _tile_rows(context, builder, kind, array, row, column, element):
    """Pointers to the 8 rows of a tile of ``array`` (H, W), its top left pixel at row and column."""
    for i in range(_ROW):
        at = [builder.add(row, ir.Constant(row.type, i)), column]
        pointer = _address(context, builder, kind, array, at)
        yield builder.bitcast(pointer, ir.VectorType(element, _ROW).as_pointer())


def _joined(builder, parts):
    while len(parts) > 1:
        size = 2 * parts[0].type.count
        parts = [_shuffled(builder, a, b, range(size)) for a, b in zip(parts[::2], parts[1::2])]
    return parts[0]


@intrinsic
def get_tile(typing, plane, row, column):
    """The tile of a plane (H, W) float32 whose top left pixel is at row and column."""

    def code(context, builder, sig, args):
        at = _tile_rows(context, builder, sig.args[0], *args, _FLOAT)
        return _joined(builder, [builder.load(pointer, align=4) for pointer in at])

    return TILE(plane, types.intp, types.intp), code


@intrinsic
def put_tile(typing, plane, row, column, value):
    """Write a tile into a plane (H, W) float32."""

    def code(context, builder, sig, args):
        at = _tile_rows(context, builder, sig.args[0], *args[:3], _FLOAT)
        for i, pointer in enumerate(at):
            part = _shuffled(builder, args[3], args[3], range(_ROW * i, _ROW * (i + 1)))
            builder.store(part, pointer, align=4)
        return context.get_dummy_value()

    return types.none(plane, types.intp, types.intp, value), code


@intrinsic
def get_channel(typing, pixels, row, column, number):
    """Channel ``number`` (0 to 3) in [0, 1] of a tile of pixels (H, W) uint32, four bytes each."""

    def code(context, builder, sig, args):
        at = _tile_rows(context, builder, sig.args[0], *args[:3], _INT)
        packed = _joined(builder, [builder.load(pointer, align=4) for pointer in at])
        shift = builder.mul(builder.trunc(args[3], _INT), ir.Constant(_INT, 8))
        vector = ir.VectorType(_INT, WIDE)
        first = builder.insert_element(ir.Constant(vector, ir.Undefined), shift, ir.Constant(_INT, 0))
        shift = _shuffled(builder, first, first, [0] * WIDE)
        byte = builder.and_(builder.lshr(packed, shift), ir.Constant(vector, [255] * WIDE))
        value = builder.uitofp(byte, ir.VectorType(_FLOAT, WIDE))
        return builder.fmul(value, _constant(WIDE, [1 / 255] * WIDE), flags=_FLAGS)

    return TILE(pixels, types.intp, types.intp, types.intp), code


@intrinsic
def total(typing, a):
    """The sum of all 64, float32."""

    def code(context, builder, sig, args):
        value, width = args[0], WIDE
        while width > 1:
            width //= 2
            low, high = (_shuffled(builder, value, value, range(i, i + width)) for i in (0, width))
            value = builder.fadd(low, high, flags=_FLAGS)
        return builder.extract_element(value, ir.Constant(_INT, 0))

    return types.float32(a), code
