"""Read and write tensors as ``torch.save`` does; a file that anyone may have made is looked through first.

``torch.load(weights_only=True)`` runs no code, but makes what a file of a kilobyte asks for: structures that
hold themselves, and memory beyond the file's size.
"""

from __future__ import annotations

import io
import pickletools
import re
import zipfile
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO

import torch

from forewarp.files import MOST_ARCHIVE, check_size, replace_file

_MOST_PICKLE = 1 << 22  # bytes of the structure around the tensors; ours have ten thousand
_MOST_NODES, _MOST_DEPTH = 1_000_000, 100
_BYTES = {"Float": 4, "Double": 8, "Half": 2, "BFloat16": 2, "Long": 8, "Int": 4, "Short": 2, "Char": 1}
_BYTES |= {"Byte": 1, "Bool": 1, "ComplexFloat": 8, "ComplexDouble": 16, "Untyped": 1}
_STORAGE = re.compile(r"torch(?:\.storage)? (\w+)Storage")
_KNOWN = re.compile(
    r"collections OrderedDict|torch\._utils _rebuild_(tensor_v2|parameter)|torch (Size|device|bool)|"
    r"torch (u?int|b?float|complex)\d+|" + _STORAGE.pattern
)
_LEGACY = 5  # pickles in a row at the beginning of what torch wrote before 1.6; the raw numbers follow


class RefusedArchive(ValueError):
    """A file holds what no archive of tensors does."""


def write_archive(path: Path, content: dict) -> None:
    """Write tensors and plain values as a whole file.

    Raises:
        OSError: naming the file, if it cannot be written; nothing is then left beside it.
    """
    packed = io.BytesIO()
    torch.save(content, packed)  # into a file it would hide why the system refused
    replace_file(path, packed.getbuffer())


def read_archive(path: Path, *, legacy: bool = False) -> dict:
    """Read a dict that ``torch.save`` wrote; execute nothing, and allow nothing larger than the file.

    Args:
        path: of the file.
        legacy: take what torch wrote before 1.6 too.

    Raises:
        OSError: if the file cannot be opened.
        ValueError: with the kind of the fault, if it is no such file, damaged, or compressed.

    Cost: reads the file twice, as torch does not verify the checksums.
    """
    check_size(path, MOST_ARCHIVE)
    try:
        if legacy and not zipfile.is_zipfile(path):
            with path.open("rb") as stream:
                for _ in range(_LEGACY):
                    _check_pickle(stream, path.stat().st_size)
        else:
            _check_zip(path)
        content = torch.load(path, map_location="cpu", weights_only=True)
        if not isinstance(content, dict):
            raise TypeError
        _check_stored(content)
        return content
    except OSError:
        raise
    except Exception as error:  # unpickling alone raises half a dozen kinds
        raise ValueError(type(error).__name__) from None


def _check_zip(path: Path) -> None:
    """Refuse an archive that is packed, harmed or ambiguous, or asks for more than it holds."""
    with zipfile.ZipFile(path) as archive:
        members = archive.infolist()
        # A stored member is no longer than the file; a compressed one may be, a thousand times.
        packed = any(member.compress_type != zipfile.ZIP_STORED for member in members)
        larger = sum(member.file_size for member in members) > path.stat().st_size
        if packed or larger or archive.testzip() is not None:
            raise zipfile.BadZipFile
        names = [member.filename for member in members]
        if len({*names}) < len(names) or len({name.partition("/")[0] for name in names}) != 1:
            raise RefusedArchive("files of one name")
        sizes = {name.partition("/")[2]: member.file_size for name, member in zip(names, members)}
        if sizes.get("data.pkl", _MOST_PICKLE + 1) > _MOST_PICKLE:
            raise RefusedArchive(f"no structure of at most {_MOST_PICKLE} bytes")
        stored = {name[5:]: size for name, size in sizes.items() if name.startswith("data/")}
        _check_pickle(io.BytesIO(archive.read(f"{names[0].partition('/')[0]}/data.pkl")), stored)


@dataclass(eq=False)
class _Node:
    """What a pickle makes: how many values there are in it, how deep it is, and itself where it is plain."""

    count: int = 1
    depth: int = 0
    value: Any = None
    is_open: bool = False  # a container that may still grow

    def take(self, *parts: _Node) -> None:
        """Grow by these parts, which grow no more."""
        for part in parts:
            part.is_open = False
            self.count, self.depth = self.count + part.count, max(self.depth, part.depth + 1)
        if self.count > _MOST_NODES or self.depth > _MOST_DEPTH:
            raise RefusedArchive("a structure that holds itself or too much")


def _check_pickle(stream: BinaryIO, stored: int | dict[str, int]) -> None:
    """Refuse a pickle of anything but tensors and plain values in dicts, lists and tuples.

    It is not run but followed, each value counted wherever it occurs.

    Args:
        stream: stands behind the pickle afterwards.
        stored: bytes of each storage by its name, or of all the file.

    Raises:
        RefusedArchive: saying what is wrong.
    """
    stack: list[_Node | None] = []  # None is a mark
    memo: dict[int, _Node] = {}

    def popped() -> list[_Node]:
        """Take what lies above the last mark, and the mark."""
        parts = []
        while (part := stack.pop()) is not None:
            parts.append(part)
        return parts[::-1]

    def grow(*parts: _Node) -> None:
        if not stack[-1].is_open:
            raise RefusedArchive("a structure that holds itself")
        stack[-1].take(*parts)

    def tuple_of(*parts: _Node) -> None:
        made = _Node(value=tuple(part.value for part in parts))
        made.take(*parts)
        stack.append(made)

    for code, given, _ in pickletools.genops(stream):
        name = code.name
        if name == "MARK":
            stack.append(None)
        elif name in ("BINPUT", "LONG_BINPUT", "MEMOIZE"):
            memo[len(memo) if name == "MEMOIZE" else given] = stack[-1]
        elif name in ("BINGET", "LONG_BINGET"):
            kept = memo[given]
            if kept.is_open:
                raise RefusedArchive("a structure that holds itself")
            stack.append(_Node(kept.count, kept.depth, kept.value))
        elif name in ("EMPTY_DICT", "EMPTY_LIST"):
            stack.append(_Node(is_open=True))
        elif name == "EMPTY_TUPLE":
            tuple_of()
        elif name in ("TUPLE1", "TUPLE2", "TUPLE3"):
            parts = [stack.pop() for _ in range(int(name[-1]))]
            tuple_of(*parts[::-1])
        elif name == "TUPLE":
            tuple_of(*popped())
        elif name in ("APPEND", "BUILD"):
            part = stack.pop()
            grow(part)
        elif name == "APPENDS":
            grow(*popped())
        elif name in ("SETITEM", "SETITEMS"):
            pairs = popped() if name == "SETITEMS" else [stack.pop(), stack.pop()][::-1]
            if any(not isinstance(key.value, str | int | float) for key in pairs[::2]):
                raise RefusedArchive("names that are no texts or numbers")
            grow(*pairs)
        elif name == "GLOBAL":
            if not _KNOWN.fullmatch(given):
                raise RefusedArchive(f"{given[:80]}, which is no tensor")
            stack.append(_Node(value=given))
        elif name == "REDUCE":
            given, made = stack.pop(), stack.pop()
            if made.value == "collections OrderedDict" and given.count > 1:
                raise RefusedArchive("names that are no texts or numbers")
            stack.append(_Node(is_open=True))
            grow(given)
        elif name == "BINPERSID":
            _check_storage(stack.pop().value, stored)
            stack.append(_Node())
        elif name == "STOP":
            return
        elif name not in ("PROTO", "FRAME"):
            if code.stack_before or len(code.stack_after) != 1:
                raise RefusedArchive(f"{name}, which tensors do not need")
            plain = {"NONE": None, "NEWTRUE": True, "NEWFALSE": False}
            stack.append(_Node(value=plain.get(name, given)))


def _check_storage(key: Any, stored: int | dict[str, int]) -> None:
    """Refuse a storage that asks for more bytes than the file has of it."""
    kind = _STORAGE.fullmatch(key[1]) if isinstance(key, tuple) and len(key) > 4 else None
    count = key[4] if kind else None
    most = stored.get(key[2], 0) if kind and isinstance(stored, dict) else stored
    if type(count) is not int or not 0 <= count * _BYTES.get(kind[1], most + 1) <= most:
        raise RefusedArchive("more numbers than it stores")


def _check_stored(content: dict) -> None:
    """Refuse tensors of which the file does not store every entry: a copy would be larger than the file."""
    left, seen = [content], set()
    while left:
        node = left.pop()
        if torch.is_tensor(node):
            plain = node.layout == torch.strided and node.device.type == "cpu"
            if not plain or node.numel() * node.element_size() > node.untyped_storage().nbytes():
                raise TypeError
        elif isinstance(node, dict | list | tuple | set) and id(node) not in seen:
            seen.add(id(node))  # tuples and lists may stand in several places
            left += [*node, *node.values()] if isinstance(node, dict) else node
