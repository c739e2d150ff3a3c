"""Files of tensors: written whole or not at all, read where they hold no more than they are long."""

from __future__ import annotations

import io
import zipfile
from collections.abc import Iterator
from pathlib import Path

import torch
from torch import Tensor

from forewarp.files import replace_file


def write_archive(path: Path, content: dict) -> None:
    """Write a whole file.

    Raises:
        OSError: naming the file, where it cannot be written; nothing is then left beside.
    """
    packed = io.BytesIO()
    torch.save(content, packed)  # into a file it would hide why the system refused
    replace_file(path, packed.getbuffer())


def read_archive(path: Path) -> dict:
    """What ``torch.save`` wrote; nothing in the file is executed, and no tensor is larger than the file.

    Raises:
        OSError: where it cannot be opened.
        ValueError: saying of what kind the fault is, where it is no such file, harmed, or packed.

    Cost: reads the file twice, as torch does not look at the checksums.
    """
    try:
        with zipfile.ZipFile(path) as archive:
            parts = archive.infolist()
            # What is stored as it is cannot be longer than the file; what is packed, a thousand times.
            packed = any(part.compress_type != zipfile.ZIP_STORED for part in parts)
            if packed or sum(part.file_size for part in parts) > path.stat().st_size:
                raise zipfile.BadZipFile
            if archive.testzip() is not None:
                raise zipfile.BadZipFile
        content = torch.load(path, map_location="cpu", weights_only=True)
        if not isinstance(content, dict) or not all(map(_is_whole, _tensors(content))):
            raise TypeError
        return content
    except OSError:
        raise
    except Exception as error:  # of unpickling alone there are half a dozen kinds
        raise ValueError(type(error).__name__) from None


def _is_whole(tensor: Tensor) -> bool:
    """Whether every entry has a place of its own in the file: a copy is then no larger."""
    if tensor.layout != torch.strided or tensor.device.type != "cpu":
        return False
    return tensor.numel() * tensor.element_size() <= tensor.untyped_storage().nbytes()


def _tensors(content: object) -> Iterator[Tensor]:
    left, seen = [content], set()
    while left:
        node = left.pop()
        if torch.is_tensor(node):
            yield node
        elif isinstance(node, dict | list | tuple | set) and id(node) not in seen:
            seen.add(id(node))  # a container may hold itself
            left += [*node, *node.values()] if isinstance(node, dict) else node
