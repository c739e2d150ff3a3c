"""``format=gltf``: moving points as one binary glTF 2.0 file with an animation."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from forewarp.export.source import Progress, Source, Tracks, tracks_of

# A tetrahedron about the origin, 1 from its middle to its corners; triangles counter-clockwise from outside.
_CORNERS = torch.tensor([[1.0, 1, 1], [1, -1, -1], [-1, 1, -1], [-1, -1, 1]]) / 3**0.5
_FACES = torch.tensor([[0, 1, 2], [0, 2, 3], [0, 3, 1], [1, 3, 2]])
_BESIDE, _ACROSS = 4, 0.8  # neighbours, and share of the distance to the last: from a middle to its corners
_SMALLEST = 1 / 255  # change of colour that is written
_FLOAT, _UINT = (5126, np.float32), (5125, np.uint32)  # numbers of the format's component types
_KINDS = {1: "SCALAR", 3: "VEC3"}
_GLB, _JSON, _BIN = 0x46546C67, 0x4E4F534A, 0x004E4942  # "glTF", "JSON" and "BIN" as little-endian integers


class _Buffer:
    """Collects arrays, with the accessors that describe them."""

    def __init__(self) -> None:
        self.parts: list[bytes] = []
        self.views: list[dict] = []
        self.accessors: list[dict] = []

    def add(self, values: Tensor | np.ndarray, component=_FLOAT, *, bounds: bool = False) -> int:
        """Add (N,) or (N, 3) values; return the number of their accessor."""
        number, dtype = component
        array = np.ascontiguousarray(np.asarray(values), dtype)  # little-endian on all machines torch runs on
        start = sum(map(len, self.parts))
        self.parts.append(array.tobytes())
        self.views.append({"buffer": 0, "byteOffset": start, "byteLength": array.nbytes})
        accessor = {"bufferView": len(self.views) - 1, "componentType": number, "count": len(array)}
        accessor["type"] = _KINDS[1 if array.ndim == 1 else array.shape[1]]
        if bounds:
            rows = array.reshape(len(array), -1)
            accessor |= {"min": rows.min(0).tolist(), "max": rows.max(0).tolist()}
        self.accessors.append(accessor)
        return len(self.accessors) - 1


def export_gltf(source: Source, folder: Path, progress: Progress, *, points: int, seconds: float) -> dict:
    """Write ``points.glb``.

    Args:
        source: the scene and its times.
        folder: to write into.
        progress: told after each time.
        points: most points.
        seconds: that the animation lasts from time 0 to time 1.

    Returns:
        what ``about.json`` says of it.

    Raises:
        ValueError: for a method whose points cannot be followed.
    """
    source.refuse_without_tracks("gltf")
    tracks = tracks_of(source, points, progress)
    radius = _ACROSS * apart(tracks.points, tracks.size)
    (folder / "points.glb").write_bytes(glb(tracks, radius, source.turn_to("y"), seconds))
    return {
        "points": len(tracks),
        "radius": radius,
        "seconds": seconds,
        "axes in the file": "y up, by the turn of its only node; places before it are the data's",
        "colors": "linear, as glTF asks; unlit",
    }


def apart(points: Tensor, otherwise: float) -> float:
    """Return the median distance of points (N, 3) to the fourth beside them; ``otherwise`` for few points."""
    from scipy.spatial import KDTree

    if len(points) <= _BESIDE:
        return otherwise
    away = KDTree(points.double().numpy()).query(points.double().numpy(), [_BESIDE + 1])[0]
    return float(np.median(away)) or otherwise


def linear(colors: Tensor) -> Tensor:
    """Turn sRGB values in [0, 1] into linear ones."""
    return torch.where(colors <= 0.04045, colors / 12.92, ((colors + 0.055) / 1.055) ** 2.4)


def glb(tracks: Tracks, radius: float, turn: Tensor, seconds: float) -> bytes:
    """Make a binary glTF: each point is a small tetrahedron, as mere points are drawn by few programs.

    Its corners at the first time are the mesh; every later time is a morph target. The animation lets weights
    rise and fall so that corners go straight from each time to the next. While a point is less opaque than at
    other times its tetrahedron is smaller; colours that change are in the targets too.
    """
    from scipy.spatial.transform import Rotation

    count, total = len(tracks), len(tracks.times)
    opacity = tracks.opacity / tracks.opacity.amax(0).clamp(min=1e-6)
    scale = radius * opacity.expand(total, -1)[..., None, None]
    corners = (tracks.positions[:, :, None] + scale * _CORNERS).reshape(total, -1, 3)
    colors = linear(tracks.colors).repeat_interleave(4, 1)  # (T or 1, 4 N, 3)
    changes = len(colors) > 1 and float((colors - colors[:1]).abs().max()) > _SMALLEST
    buffer = _Buffer()
    first = {"POSITION": buffer.add(corners[0], bounds=True), "COLOR_0": buffer.add(colors[0])}
    faces = (_FACES + 4 * torch.arange(count)[:, None, None]).flatten()
    primitive = {"attributes": first, "indices": buffer.add(faces, _UINT), "material": 0}
    mesh = {"primitives": [primitive]}
    animations = []
    if total > 1:
        primitive["targets"] = [
            {"POSITION": buffer.add(corners[k] - corners[0], bounds=True)}
            | ({"COLOR_0": buffer.add(colors[k] - colors[0])} if changes else {})
            for k in range(1, total)
        ]
        mesh["weights"] = [0.0] * (total - 1)
        mesh["extras"] = {"targetNames": [f"time {time:.4g}" for time in tracks.times[1:].tolist()]}
        clock = buffer.add((tracks.times - tracks.times[0]) * seconds, bounds=True)
        weights = buffer.add(torch.eye(total)[:, 1:].flatten())  # at each time its own target alone
        sampler = {"input": clock, "output": weights, "interpolation": "LINEAR"}
        channel = {"sampler": 0, "target": {"node": 0, "path": "weights"}}
        animations = [{"name": "time", "samplers": [sampler], "channels": [channel]}]
    rotation = Rotation.from_matrix(turn.numpy()).as_quat().tolist()  # x, y, z, w
    unlit = {"extensions": {"KHR_materials_unlit": {}}, "pbrMetallicRoughness": {"metallicFactor": 0}}
    content = {
        "asset": {"version": "2.0", "generator": "forewarp"},
        "extensionsUsed": ["KHR_materials_unlit"],
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0, "rotation": rotation, "name": "points"}],
        "meshes": [mesh],
        "materials": [unlit],
        "accessors": buffer.accessors,
        "bufferViews": buffer.views,
    } | ({"animations": animations} if animations else {})
    return _packed(content, b"".join(buffer.parts))


def _packed(content: dict, body: bytes) -> bytes:
    """Put the description and the one buffer of a glTF into its binary container."""
    content = content | {"buffers": [{"byteLength": len(body)}]}
    text = json.dumps(content, separators=(",", ":")).encode()
    text += b" " * (-len(text) % 4)
    body += b"\0" * (-len(body) % 4)
    parts = (text, _JSON), (body, _BIN)
    chunks = [np.array([len(part), kind], "<u4").tobytes() + part for part, kind in parts]
    length = 12 + sum(map(len, chunks))
    return np.array([_GLB, 2, length], "<u4").tobytes() + b"".join(chunks)
