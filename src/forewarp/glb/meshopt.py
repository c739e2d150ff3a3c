"""The attribute codec (version 0) and two filters of glTF's EXT_meshopt_compression, in NumPy.

Bytes of elements are stored plane by plane, as zigzag differences from the element before, in groups of 16
with 0, 2, 4 or 8 bits each: see the extension's text, "Mode 0: attributes" and "Appendix B".
"""

from __future__ import annotations

from array import array

import numpy as np

_HEADER, _TAIL = 0xA0, 32  # first byte; bytes of the tail, at least
_GROUP, _MOST_GROUPS, _BLOCK_BYTES = 16, 16, 8192
# A group has a mode from 0 to 3: no difference, or differences of 2, 4 or 8 bits each. Of 2 and 4 bits: the
# mode, the bits, and the code that says that the difference is a byte behind the group.
_PACKED = (1, 2, 3), (2, 4, 15)
_MOST_GROUP_BYTES = 24
# Exponents that the exponential filter takes.
LEAST_EXPONENT, MOST_EXPONENT = -100, 100


def _block_elements(stride: int) -> int:
    """Return how many elements of ``stride`` bytes a whole block has."""
    return min(_BLOCK_BYTES // stride & ~(_GROUP - 1), _MOST_GROUPS * _GROUP)


def encode(elements: np.ndarray) -> bytes:
    """Compress elements (N, stride) uint8; the stride is a multiple of 4, at most 256.

    Cost: about 20 operations a byte, and three times the memory of the elements.
    """
    count, stride = elements.shape
    baseline = elements[:1] if count else np.zeros((1, stride), np.uint8)
    differences = np.diff(elements, axis=0, prepend=baseline).view(np.int8)
    zigzag = ((differences << 1) ^ (differences >> 7)).view(np.uint8)
    size, parts = _block_elements(stride), [bytes([_HEADER])]
    whole = count // size * size
    for rows, elements_each in ((zigzag[:whole], size), (zigzag[whole:], count - whole)):
        if len(rows):
            groups = -(-elements_each // _GROUP)
            padded = np.zeros((len(rows) // elements_each, groups * _GROUP, stride), np.uint8)
            padded[:, :elements_each] = rows.reshape(-1, elements_each, stride)
            parts.append(_blocks(padded.transpose(0, 2, 1).reshape(-1, groups, _GROUP)))
    return b"".join([*parts, bytes(max(_TAIL - stride, 0)), baseline.tobytes()])


def _blocks(values: np.ndarray) -> bytes:
    """Pack data blocks: values (D, G, 16), G groups in each of D."""
    blocks, groups, _ = values.shape
    escapes = [values >= escape for _, _, escape in _PACKED]
    sizes = [np.where(values.any(-1), 255, 0)]
    sizes += [2 * bits + escaped.sum(-1) for (_, bits, _), escaped in zip(_PACKED, escapes)]
    sizes.append(np.full((blocks, groups), _GROUP))
    modes = np.argmin(np.stack(sizes), 0)  # the smallest, of equal ones that with fewer bits
    lengths = np.choose(modes, sizes)
    packed = np.zeros((blocks, groups, _MOST_GROUP_BYTES), np.uint8)  # each group in the first ``lengths``
    packed[modes == 3, :_GROUP] = values[modes == 3]
    for (mode, bits, escape), escaped in zip(_PACKED, escapes):
        chosen = modes == mode
        rows, escaped, head = values[chosen], escaped[chosen], 2 * bits
        codes = np.minimum(rows, escape).reshape(len(rows), head, 8 // bits)
        room = np.zeros((len(rows), _MOST_GROUP_BYTES), np.uint8)
        room[:, :head] = (codes << _shifts(bits)).sum(-1, dtype=np.uint8)
        row, column = np.nonzero(escaped)
        room[row, head + (np.cumsum(escaped, 1) - 1)[row, column]] = rows[row, column]
        packed[chosen] = room
    padded = np.pad(modes.astype(np.uint8), ((0, 0), (0, -groups % 4))).reshape(blocks, -1, 4)
    header = (padded << _shifts(2)[::-1]).sum(-1, dtype=np.uint8)
    all_bytes = np.concatenate([header, packed.reshape(blocks, -1)], 1)
    used = (np.arange(_MOST_GROUP_BYTES) < lengths[..., None]).reshape(blocks, -1)
    used = np.pad(used, ((0, 0), (header.shape[1], 0)), constant_values=True)
    return all_bytes[used].tobytes()


def _shifts(bits: int) -> np.ndarray:
    """Return by how much numbers of 2 or 4 bits in a byte are shifted, the upper first."""
    return np.arange(8 - bits, -1, -bits, dtype=np.uint8)


# By modes: how many codes of each byte say that the value follows as a byte of its own.
_ESCAPES = {
    mode: (np.arange(256)[:, None] >> _shifts(bits) & escape == escape).sum(1, dtype=np.uint8).tobytes()
    for mode, bits, escape in _PACKED
}


def least_bytes(count: int, stride: int) -> int:
    """Return the fewest bytes that ``count`` elements of ``stride`` bytes are ever compressed to."""
    size = _block_elements(stride)
    whole, rest = divmod(count, size)
    groups = whole * -(-size // (4 * _GROUP)) + -(-rest // (4 * _GROUP))
    return 1 + stride * groups + max(_TAIL, stride)


def decode(data: bytes, count: int, stride: int) -> np.ndarray:
    """Return the elements (count, stride) uint8 of compressed data.

    Raises:
        ValueError: where the data are not those of so many elements.

    Cost: a step of Python for each group of 16 bytes.
    """
    if stride % 4 or not 0 < stride <= 256:
        raise ValueError(f"expected a stride of 4, 8, ... 256, but got {stride}")
    wrong = ValueError(f"expected {count} elements by attribute codec 0, but got other bytes")
    if len(data) < least_bytes(count, stride) or data[0] != _HEADER:
        raise wrong
    size, begin, places, modes = _block_elements(stride), 1, array("q"), bytearray()
    end = len(data) - max(_TAIL, stride)
    for first in range(0, count, size):
        groups = -(-min(size, count - first) // _GROUP)
        for _ in range(stride):
            header, begin = begin, begin + -(-groups // 4)
            if begin > end:
                raise wrong
            for group in range(groups):
                mode = data[header + group // 4] >> 2 * (group % 4) & 3
                places.append(begin)
                modes.append(mode)
                if mode == 3:
                    begin += _GROUP
                elif mode:
                    head = 4 * mode
                    begin += head + sum(data[begin : begin + head].translate(_ESCAPES[mode]))
    if begin != end:
        raise wrong
    values = _groups(
        np.frombuffer(data, np.uint8), np.frombuffer(places, np.int64), np.frombuffer(modes, np.uint8)
    )
    signed = (values >> 1) ^ -(values & 1)  # wraps around, as bytes do
    elements, first = np.empty((count, stride), np.uint8), 0
    for start in range(0, count, size):
        rows = min(size, count - start)
        groups = -(-rows // _GROUP)
        block = signed[first : first + stride * groups].reshape(stride, -1)[:, :rows]
        elements[start : start + rows] = block.T
        first += stride * groups
    baseline = np.frombuffer(data[len(data) - stride :], np.uint8)
    return np.cumsum(elements, 0, dtype=np.uint8) + baseline


def _groups(data: np.ndarray, places: np.ndarray, modes: np.ndarray) -> np.ndarray:
    """Unpack groups that begin at places (G,) of data: values (G, 16)."""
    values = np.zeros((len(places), _GROUP), np.uint8)
    data = np.concatenate([data, np.zeros(_MOST_GROUP_BYTES, np.uint8)])
    values[modes == 3] = data[places[modes == 3, None] + np.arange(_GROUP)]
    for mode, bits, escape in _PACKED:
        chosen, head = modes == mode, 2 * bits
        begins = places[chosen, None]
        codes = data[begins + np.arange(head)]
        codes = (codes[..., None] >> _shifts(bits) & escape).reshape(-1, _GROUP)
        row, column = np.nonzero(codes == escape)
        extra = begins + head + np.cumsum(codes == escape, 1) - 1
        codes[row, column] = data[extra[row, column]]
        values[chosen] = codes
    return values


def exponential(values: np.ndarray, exponents: np.ndarray | int) -> np.ndarray:
    """Round values (N, C) to whole multiples of ``2^exponents``, as the filter EXPONENTIAL stores them.

    Multiples of one step that have up to 16 bits are moved to the upper bytes of the mantissa, where a change
    of sign changes no other byte.

    Returns:
        (N, 4 C) uint8.
    """
    most, shared = (1 << 23) - 1, np.ndim(exponents) == 0
    # Steps are as coarse as the largest multiple has room.
    sizes = np.abs(values).max(initial=0) if shared else np.abs(values)
    exponents = np.maximum(exponents, np.frexp(sizes)[1] - 23)
    exponents = np.clip(np.broadcast_to(exponents, values.shape), LEAST_EXPONENT, MOST_EXPONENT).astype(int)
    multiples = np.rint(np.ldexp(values.astype(np.float64), -exponents))
    mantissas = np.clip(multiples, -most, most).astype(np.int32)
    if mantissas.size and shared:
        widest = int(np.abs(mantissas).max())
        shift = 16 if widest < 1 << 7 else 8 if widest < 1 << 15 else 0
        shift = min(shift, int(exponents.flat[0]) - LEAST_EXPONENT)
        mantissas, exponents = mantissas << shift, exponents - shift
    words = (exponents.astype(np.int32) << 24) | (mantissas & 0xFFFFFF)
    return words.astype("<i4").view(np.uint8).reshape(len(values), -1)


def from_exponential(elements: np.ndarray) -> np.ndarray:
    """Return the values (N, C) float32 of elements (N, 4 C) uint8 by the filter EXPONENTIAL."""
    words = np.ascontiguousarray(elements).view("<i4").astype(np.int32)
    return np.ldexp((words << 8 >> 8).astype(np.float32), words >> 24)


def quaternion(values: np.ndarray, bits: int) -> np.ndarray:
    """Store unit quaternions (N, 4) with ``bits``, 4 to 16, a component, for the filter QUATERNION.

    Returns:
        (N, 8) uint8.
    """
    one = (1 << bits - 1) - 1
    largest = np.abs(values).argmax(1)
    rows = np.arange(len(values))
    values = np.where(values[rows, largest, None] < 0, -values, values)
    others = values[rows[:, None], (largest[:, None] + [1, 2, 3]) % 4]
    stored = np.empty((len(values), 4), "<i2")
    stored[:, :3] = np.clip(np.rint(others * (2**0.5 * one)), -one, one)
    stored[:, 3] = one & ~3 | largest
    return stored.view(np.uint8).reshape(-1, 8)


def from_quaternion(elements: np.ndarray) -> np.ndarray:
    """Return quaternions (N, 4) int16, 32767 times as long as 1, of elements (N, 8) uint8."""
    stored = np.ascontiguousarray(elements).view("<i2").astype(np.int32)
    one = stored[:, 3:] | 3
    others = stored[:, :3] / (one * 2**0.5)
    fourth = np.sqrt(np.maximum(0.0, 1 - np.square(others).sum(1, keepdims=True)))
    made = np.empty((len(stored), 4))
    places = (stored[:, 3:] + [1, 2, 3, 0]) % 4
    made[np.arange(len(stored))[:, None], places] = np.concatenate([others, fourth], 1)
    return np.clip(np.rint(made * 32767), -32767, 32767).astype(np.int16)


# What makes numbers of decoded elements, by the filter's name.
FILTERS = {"NONE": np.asarray, "EXPONENTIAL": from_exponential, "QUATERNION": from_quaternion}
