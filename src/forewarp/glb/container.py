"""The binary container of glTF 2.0: a description in JSON, and a buffer of arrays."""

from __future__ import annotations

import json
import struct
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from forewarp.glb import meshopt

COMPRESSION = "EXT_meshopt_compression"
MAGIC, VERSION = b"glTF", 2
CHUNKS = b"JSON", b"BIN\0"
ELEMENTS = {1: "SCALAR", 3: "VEC3", 4: "VEC4"}
_VERTICES = 34962  # glTF's target of views of vertex attributes
CAMERA_AXES = torch.tensor([1.0, -1.0, -1.0], dtype=torch.float64)  # ours by glTF's, and the other way round


def quaternion_of(rotation: Tensor) -> list[float]:
    """Return a rotation (3, 3) float64 as a node of glTF has it: x, y, z, w."""
    from scipy.spatial.transform import Rotation  # late, as its import takes time

    return Rotation.from_matrix(rotation.numpy()).as_quat().tolist()


class Component(NamedTuple):
    """A component type of glTF: its ``number`` there, its ``dtype``, and the value that ``normalized`` makes
    1; 0: it stands for itself.
    """

    number: int
    dtype: str
    one: int = 0


FLOAT, UINT = Component(5126, "<f4"), Component(5125, "<u4")
BYTE, SHORT = Component(5121, "<u1"), Component(5123, "<u2")  # both unsigned
UNIT_BYTE, SIGNED_SHORT = BYTE._replace(one=255), Component(5122, "<i2", 32767)
COMPONENTS = {c.number: c for c in (FLOAT, UINT, BYTE, SHORT, Component(5120, "<i1"), SIGNED_SHORT)}


class Buffer:
    """The buffer of a glTF, with the views and accessors that describe the arrays in it.

    Args:
        compressed: whether arrays are compressed by EXT_meshopt_compression.
    """

    def __init__(self, *, compressed: bool = False) -> None:
        self.content, self.views, self.accessors = bytearray(), [], []
        self.compressed, self.decoded = compressed, 0  # bytes of all views when decoded

    def add(
        self,
        values: Tensor | np.ndarray | Sequence[float] | None,
        component: Component = FLOAT,
        *,
        bounds: bool = False,
        vertices: bool = False,
        filtered: tuple[str, np.ndarray] | None = None,
    ) -> int:
        """Add an array (N,), (N, 3) or (N, 4); return the number of its accessor.

        Args:
            values: the numbers that are stored: of a normalised component, whole ones; None beside
                ``filtered``, whose filter makes them.
            component: how they are stored.
            bounds: whether the accessor says the least and the greatest values.
            vertices: whether it is an attribute of vertices, whose rows begin at multiples of 4 bytes.
            filtered: of a compressed buffer, a filter's name and the elements (N, stride) uint8 that it makes
                the values of; None: the values themselves are compressed.
        """
        values = np.asarray(values) if filtered is None else meshopt.FILTERS[filtered[0]](filtered[1])
        array = np.ascontiguousarray(values, component.dtype)
        rows = array.reshape(len(array), -1)
        accessor = {"bufferView": len(self.views), "componentType": component.number, "count": len(array)}
        accessor |= {"type": ELEMENTS[rows.shape[1]]} | ({"normalized": True} if component.one else {})
        if bounds:
            accessor |= {"min": rows.min(0).tolist(), "max": rows.max(0).tolist()}
        elements = rows.view(np.uint8)
        if self.compressed or vertices:
            elements = np.pad(elements, ((0, 0), (0, -elements.shape[1] % 4)))
        layout = {"byteStride": elements.shape[1], "target": _VERTICES} if vertices else {}
        self.accessors.append(accessor)
        self.views.append(self._view(elements, filtered) | layout)
        return len(self.accessors) - 1

    def _view(self, elements: np.ndarray, filtered: tuple[str, np.ndarray] | None) -> dict:
        self.content += bytes(-len(self.content) % 4)
        view = {"buffer": 0, "byteOffset": len(self.content), "byteLength": elements.size}
        if not self.compressed:
            self.content += elements.tobytes()
            return view
        name, elements = filtered or ("NONE", elements)
        data, (count, stride) = meshopt.encode(elements), elements.shape
        layout = {"byteLength": len(data), "byteStride": stride, "count": count, "mode": "ATTRIBUTES"}
        layout |= {} if name == "NONE" else {"filter": name}
        view = {"buffer": 1, "byteOffset": self.decoded, "byteLength": elements.size}
        view["extensions"] = {COMPRESSION: {"buffer": 0, "byteOffset": len(self.content), **layout}}
        self.content += data
        self.decoded += elements.size
        return view

    def packed(self, description: dict) -> bytes:
        """Return the binary container of a description, whose first node holds all, and this buffer.

        Args:
            description: has ``extensionsUsed``, those beside the buffer's own.
        """
        buffers = [{"byteLength": len(self.content)}]
        if self.compressed:
            buffers.append({"byteLength": self.decoded, "extensions": {COMPRESSION: {"fallback": True}}})
            used = {"extensionsUsed": [*description["extensionsUsed"], COMPRESSION]}
            description = description | used | {"extensionsRequired": [COMPRESSION]}
        parts = {"asset": {"version": "2.0", "generator": "forewarp"}, "scene": 0, "scenes": [{"nodes": [0]}]}
        parts |= {"buffers": buffers, "bufferViews": self.views, "accessors": self.accessors}
        text = json.dumps(description | parts, separators=(",", ":")).encode()
        text, binary = text + b" " * (-len(text) % 4), bytes(self.content) + bytes(-len(self.content) % 4)
        chunks = zip(CHUNKS, (text, binary))
        body = b"".join(struct.pack("<I4s", len(chunk), kind) + chunk for kind, chunk in chunks)
        return struct.pack("<4sII", MAGIC, VERSION, 12 + len(body)) + body
