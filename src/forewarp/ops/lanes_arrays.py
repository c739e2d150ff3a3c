"""How vectors of Numba kernels are read from arrays and written to them; see ``lanes``."""

from __future__ import annotations

from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.extending import intrinsic

from forewarp.ops.lanes import FLAGS, FLOAT, INT, NARROW, ROW, SUMS, TILE, WIDE, constant, shuffled


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
