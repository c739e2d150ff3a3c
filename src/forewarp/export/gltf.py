"""``format=gltf``: moving points as one binary glTF 2.0 file with an animation."""

from __future__ import annotations

import json
import struct
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from forewarp.export.tracks import Progress, Source, Tracks, tracks_of

# A tetrahedron about the origin, 1 from its centre to its corners; triangles counter-clockwise from outside.
_CORNERS = torch.tensor([[1.0, 1, 1], [1, -1, -1], [-1, 1, -1], [-1, -1, 1]]) / 3**0.5
_FACES = torch.tensor([[0, 1, 2], [0, 2, 3], [0, 3, 1], [1, 3, 2]])
# A tetrahedron's radius is this share of the median distance of points to their fourth neighbour.
_NEIGHBOUR, _RADIUS = 4, 0.8
_MIN_COLOR_CHANGE = 1 / 255
_FLOAT, _UINT = (5126, np.float32), (5125, np.uint32)  # glTF's component types
_ELEMENTS = {1: "SCALAR", 3: "VEC3"}


class Buffer:
    """The one buffer of a glTF, with the accessors that describe the arrays in it."""

    def __init__(self) -> None:
        self.content, self.views, self.accessors = bytearray(), [], []

    def add(self, values: Tensor | np.ndarray, component=_FLOAT, *, bounds: bool = False) -> int:
        """Add (N,) or (N, 3) values; return the number of their accessor."""
        number, dtype = component
        array = np.ascontiguousarray(np.asarray(values), dtype)  # little-endian on all machines torch runs on
        rows = array.reshape(len(array), -1)
        accessor = {"bufferView": len(self.views), "componentType": number, "count": len(array)}
        accessor["type"] = _ELEMENTS[rows.shape[1]]
        if bounds:
            accessor |= {"min": rows.min(0).tolist(), "max": rows.max(0).tolist()}
        self.accessors.append(accessor)
        self.views.append({"buffer": 0, "byteOffset": len(self.content), "byteLength": array.nbytes})
        self.content += array.tobytes()
        return len(self.accessors) - 1

    def packed(self, description: dict) -> bytes:
        """Return the binary container of a description and this buffer."""
        content = description | {"buffers": [{"byteLength": len(self.content)}]}
        text, binary = json.dumps(content, separators=(",", ":")).encode(), bytes(self.content)
        text, binary = text + b" " * (-len(text) % 4), binary + b"\0" * (-len(binary) % 4)
        chunks = (b"JSON", text), (b"BIN\0", binary)
        body = b"".join(struct.pack("<I4s", len(chunk), kind) + chunk for kind, chunk in chunks)
        return struct.pack("<4sII", b"glTF", 2, 12 + len(body)) + body


def export_gltf(source: Source, folder: Path, progress: Progress, *, points: int, seconds: float) -> dict:
    """Write ``points.glb``.

    Args:
        source: the scene and its times.
        folder: to write into.
        progress: called after each time.
        points: most points.
        seconds: duration of the animation from time 0 to time 1.

    Returns:
        the facts for ``about.json``.

    Raises:
        ValueError: for a method whose points cannot be followed.
    """
    source.refuse_without_tracks("gltf")
    tracks = tracks_of(source, points, progress)
    radius = _RADIUS * neighbour_distance(tracks.points, tracks.size)
    (folder / "points.glb").write_bytes(glb(tracks, radius, source.rotation_to("y"), seconds))
    return {
        "points": len(tracks),
        "radius": radius,
        "seconds": seconds,
        "axes in the file": "y up, by the turn of its only node; places before it are the data's",
        "colors": "linear, as glTF asks; unlit",
    }


def neighbour_distance(points: Tensor, default: float) -> float:
    """Return the median distance of points (N, 3) to their fourth neighbour; ``default`` for few points."""
    from scipy.spatial import KDTree

    if len(points) <= _NEIGHBOUR:
        return default
    places = points.double().numpy()
    return float(np.median(KDTree(places).query(places, [_NEIGHBOUR + 1])[0])) or default


def linear(colors: Tensor) -> Tensor:
    """Turn sRGB values in [0, 1] into linear ones."""
    return torch.where(colors <= 0.04045, colors / 12.92, ((colors + 0.055) / 1.055) ** 2.4)


def glb(tracks: Tracks, radius: float, rotation: Tensor, seconds: float) -> bytes:
    """Make a binary glTF: each point is a small tetrahedron, as few programs draw mere points.

    Its corners at the first time are the mesh; every later time is a morph target. The animation lets weights
    rise and fall so that corners go straight from each time to the next. While a point is less opaque than at
    other times its tetrahedron is smaller; colours that change are in the targets too.

    Args:
        tracks: the points.
        radius: of a tetrahedron, world units.
        rotation: (3, 3) of the scene's only node.
        seconds: duration of the animation from time 0 to time 1.
    """
    from scipy.spatial.transform import Rotation

    total = len(tracks.times)
    opacity = tracks.opacity / tracks.opacity.amax(0).clamp(min=1e-6)
    scale = radius * opacity.expand(total, -1)[..., None, None]
    corners = (tracks.positions[:, :, None] + scale * _CORNERS).reshape(total, -1, 3)
    colors = linear(tracks.colors).repeat_interleave(4, 1)  # (T or 1, 4 N, 3)
    has_color_change = len(colors) > 1 and float((colors - colors[:1]).abs().max()) > _MIN_COLOR_CHANGE
    buffer = Buffer()
    attributes = {"POSITION": buffer.add(corners[0], bounds=True), "COLOR_0": buffer.add(colors[0])}
    faces = (_FACES + 4 * torch.arange(len(tracks))[:, None, None]).flatten()
    primitive = {"attributes": attributes, "indices": buffer.add(faces, _UINT), "material": 0}
    mesh, animation = {"primitives": [primitive]}, {}
    if total > 1:
        primitive["targets"] = targets = []
        for k in range(1, total):
            targets.append({"POSITION": buffer.add(corners[k] - corners[0], bounds=True)})
            if has_color_change:
                targets[-1]["COLOR_0"] = buffer.add(colors[k] - colors[0])
        mesh["weights"] = [0.0] * (total - 1)
        mesh["extras"] = {"targetNames": [f"time {time:.4g}" for time in tracks.times[1:].tolist()]}
        clock = buffer.add((tracks.times - tracks.times[0]) * seconds, bounds=True)
        weights = buffer.add(torch.eye(total)[:, 1:].flatten())  # at each time its own target alone
        sampler = {"input": clock, "output": weights, "interpolation": "LINEAR"}
        channel = {"sampler": 0, "target": {"node": 0, "path": "weights"}}
        animation = {"animations": [{"name": "time", "samplers": [sampler], "channels": [channel]}]}
    quaternion = Rotation.from_matrix(rotation.numpy()).as_quat().tolist()  # x, y, z, w
    unlit = {"extensions": {"KHR_materials_unlit": {}}, "pbrMetallicRoughness": {"metallicFactor": 0}}
    description = {
        "asset": {"version": "2.0", "generator": "forewarp"},
        "extensionsUsed": ["KHR_materials_unlit"],
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0, "rotation": quaternion, "name": "points"}],
        "meshes": [mesh],
        "materials": [unlit],
        "accessors": buffer.accessors,
        "bufferViews": buffer.views,
    }
    return buffer.packed(description | animation)
