"""A binary glTF taken apart, and put together again."""

import json
import struct

SPLATS, MOTION = "KHR_gaussian_splatting", "FOREWARP_gaussian_motion"


def unpacked(data):
    """The description of a file, and its arrays."""
    size = struct.unpack_from("<I", data, 12)[0]
    return json.loads(data[20 : 20 + size]), data[28 + size :]


def packed(description, binary):
    """The file of a description, an object or its text, and of arrays."""
    text = description if isinstance(description, bytes) else json.dumps(description).encode()
    text += b" " * (-len(text) % 4)
    parts = ((b"JSON", text), (b"BIN\0", binary))
    body = b"".join(struct.pack("<I4s", len(part), kind) + part for kind, part in parts)
    return struct.pack("<4sII", b"glTF", 2, 12 + len(body)) + body


def attributes_of(description):
    """The attributes of the first Gaussians."""
    return description["meshes"][0]["primitives"][0]["attributes"]


def motion_of(description):
    """The extension that says how the first Gaussians move."""
    return description["meshes"][0]["primitives"][0]["extensions"][SPLATS]["extensions"][MOTION]
