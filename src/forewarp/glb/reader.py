"""Read a ``scene.glb``, from anywhere: nothing of it is trusted, and what is wrong is named in one line."""

from __future__ import annotations

import json
import math
import struct
from pathlib import Path
from reprlib import repr as short
from typing import Any, NamedTuple

import numpy as np
import torch

from forewarp.fields.curves import KINDS, PADDING, Curve
from forewarp.fields.moving import MARGIN, MovingGaussians, NodeMotion
from forewarp.fields.windows import MovingWindows, Window, check_windows, taken, with_shared
from forewarp.files import MOST_CONFIG, read_bytes
from forewarp.glb import meshopt
from forewarp.glb.container import CAMERA_AXES, CHUNKS, COMPONENTS, COMPRESSION, ELEMENTS, MAGIC, VERSION
from forewarp.glb.writer import FORMAT, MOTION, QUATERNIONS, SPLATS, TRUST, WINDOWS, Setting
from forewarp.ops.backend import is_number
from forewarp.ops.layout import LOG_MIN_ALPHA
from forewarp.scene.camera import Camera, Lens

_EXTENSIONS = COMPRESSION, SPLATS, MOTION  # that a file may require
_FEATURES = (WINDOWS, QUATERNIONS)  # names that a file may list of what a reader must know
# At most: degree of the harmonics, cosines over time, accessors of links.
_MOST = 1 << 28  # bytes of the file, and of all its arrays: some 200,000 particles of degree 3
_DEGREES, _COSINES, _LINKS = 3, 64, 16
_WINDOWS = 1000  # at most
_FARTHEST = 0.2  # of all time: no image's time is off by more


class Fields:
    """A part of the description: reads its properties, and refuses one that is missing or of another kind.

    Args:
        content: of the part.
        place: where it is, for errors.
    """

    def __init__(self, content: Any, place: str) -> None:
        if not isinstance(content, dict):
            raise ValueError(f"{place}: expected an object, but got {short(content)}")
        self.content, self.place = content, place

    def __contains__(self, key: str) -> bool:
        return key in self.content

    def _get(self, key: str, expected: str, good, default=None):
        value = self.content.get(key, default)
        if value is None or not good(value):
            got = short(value) if key in self.content else "none"
            raise ValueError(f"{self.place}.{key}: expected {expected}, but got {got}")
        return value

    def whole(self, key: str, least: int, most: int, default: int | None = None) -> int:
        """Return a whole number from ``least`` to ``most``."""
        expected = f"a whole number from {least} to {most}"
        return self._get(key, expected, lambda n: type(n) is int and least <= n <= most, default)

    def number(self, key: str, least: float, most: float, default: float | None = None) -> float:
        """Return a number from ``least`` to ``most``."""
        expected = f"a number from {least:g} to {most:g}"
        return float(self._get(key, expected, lambda x: is_number(x) and least <= x <= most, default))

    def fixed(self, key: str, value: float) -> None:
        """Refuse a number, if there is one, that is not the only one that version 1 has."""
        if not math.isclose(given := self.number(key, -1e30, 1e30, value), value, rel_tol=1e-6):
            raise ValueError(f"{self.place}.{key}: expected {value:.6g}, but got {given:.6g}")

    def numbers(self, key: str, count: int, default: list[float] | None = None) -> list[float]:
        """Return ``count`` finite numbers."""

        def good(values) -> bool:
            some = isinstance(values, list) and len(values) == count
            return some and all(is_number(x) and abs(x) < 1e30 for x in values)

        return list(map(float, self._get(key, f"{count} numbers", good, default)))

    def text(self, key: str, default: str | None = None) -> str:
        """Return a text."""
        return self._get(key, "a text", lambda value: isinstance(value, str), default)

    def flag(self, key: str) -> bool:
        """Return true or false, which it is if it is missing."""
        return self._get(key, "true or false", lambda value: isinstance(value, bool), default=False)

    def items(self, key: str, most: int = MOST_CONFIG) -> list:
        """Return a list of at most so many; an empty one if it is missing."""
        good = lambda value: isinstance(value, list) and len(value) <= most  # noqa: E731
        return self._get(key, f"a list of at most {most}", good, [])

    def check_known(self, key: str, known: tuple[str, ...]) -> None:
        """Refuse a list with other names than those that are known here."""
        if others := [name for name in self.items(key) if name not in known]:
            got = short(others[0])
            raise ValueError(f"{self.place}: expected {key} known here, but got {got}; update forewarp")

    def parts(self, key: str) -> list[Fields]:
        """Return a list of parts; none if it is missing."""
        return [Fields(part, f"{self.place}.{key}[{n}]") for n, part in enumerate(self.items(key))]

    def part(self, key: str, default: dict | None = None) -> Fields:
        """Return a part."""
        return Fields(self.content.get(key, default), f"{self.place}.{key}")


class Container:
    """A binary glTF: its ``description``, and the arrays that its accessors describe.

    Args:
        data: the whole file.

    Raises:
        ValueError: naming what is wrong.
    """

    def __init__(self, data: bytes) -> None:
        if len(data) < 12 or data[:4] != MAGIC:
            raise ValueError("expected a binary glTF, but got another file")
        version, length = struct.unpack_from("<II", data, 4)
        if version != VERSION:
            raise ValueError(f"expected version {VERSION} of glTF, but got {version}")
        if length != len(data):
            raise ValueError(f"expected {length} bytes, as its header says, but got {len(data)}")
        chunks, begin = [], 12
        for wanted in CHUNKS:
            size, kind = struct.unpack_from("<I4s", data, begin) if begin + 8 <= length else (0, b"")
            if kind != wanted or begin + 8 + size > length:
                raise ValueError("expected a whole chunk of JSON and one of arrays, but got others")
            chunks.append(memoryview(data)[begin + 8 : begin + 8 + size])
            begin += 8 + size
        text, binary = chunks
        if len(text) > MOST_CONFIG:
            raise ValueError(f"expected at most {MOST_CONFIG} bytes of JSON, but got {len(text)}")
        self.description, self.binary = Fields(_parsed(bytes(text)), "glTF"), binary
        self.accessors, self.views = (self.description.parts(key) for key in ("accessors", "bufferViews"))
        self._decoded: dict[int, np.ndarray] = {}
        self._room = _MOST

    def array(self, part: Fields, key: str, kind: str, count: int | None = None) -> np.ndarray:
        """Return the rows (N, 1), (N, 3) or (N, 4) of an accessor: whole numbers, or float32 that are finite.

        Args:
            part: of the description.
            key: of its property that has the accessor's number.
            kind: ``SCALAR``, ``VEC3`` or ``VEC4``; or several of them, with `` or `` between.
            count: of its rows; None: as it says.
        """
        return self._rows(part.content.get(key), kind, count, f"{part.place}.{key}")

    def arrays(self, part: Fields, key: str, kind: str, count: int, most: int) -> list[np.ndarray]:
        """Return the rows of each of at most so many accessors; see ``array``."""
        return [self._rows(n, kind, count, f"{part.place}.{key}") for n in part.items(key, most)]

    def _rows(self, number: Any, kind: str, count: int | None, place: str) -> np.ndarray:
        if type(number) is not int or not 0 <= number < len(self.accessors):
            got = short(number)
            raise ValueError(f"{place}: expected one of {len(self.accessors)} accessors, but got {got}")
        accessor = self.accessors[number]
        rows, came = accessor.whole("count", 1, _MOST), accessor.text("type")
        if came not in kind.split(" or ") or (count is not None and rows != count):
            wanted = f"{'rows' if count is None else count} of {kind}"
            raise ValueError(f"{place}: expected {wanted}, but got {rows} of {came}")
        width = {name: n for n, name in ELEMENTS.items()}[came]
        component = COMPONENTS.get(accessor.whole("componentType", 0, 2**16))
        if component is None or "sparse" in accessor:
            raise ValueError(f"{accessor.place}: expected plain numbers of 8, 16 or 32 bits, but got others")
        elements, stride = self._view(accessor.whole("bufferView", 0, len(self.views) - 1))
        dtype = np.dtype(component.dtype)
        stride, offset = stride or width * dtype.itemsize, accessor.whole("byteOffset", 0, 2**31, 0)
        end = offset + (rows - 1) * stride + width * dtype.itemsize
        if stride < width * dtype.itemsize or end > len(elements):
            raise ValueError(f"{accessor.place}: expected {end} bytes, but got {len(elements)}")
        self._take(rows * width * np.dtype(np.float32).itemsize, place)  # many accessors may read one view
        strides = (stride, dtype.itemsize)
        values = np.ndarray((rows, width), dtype, elements.data, offset, strides).copy()
        if accessor.flag("normalized"):
            one = np.iinfo(dtype).max if dtype.kind != "f" else 1
            values = np.maximum(values / np.float32(one), -1).astype(np.float32)
        if values.dtype.kind == "f" and not np.isfinite(values).all():
            raise ValueError(f"{place}: expected finite numbers, but got others")
        return values

    def _view(self, number: int) -> tuple[np.ndarray, int]:
        """Return the bytes (B,) uint8 of a view, decoded, and its stride; 0: none is said."""
        view = self.views[number]
        stride = view.whole("byteStride", 4, 252, 0) if "byteStride" in view else 0
        if number not in self._decoded:
            extensions = view.part("extensions", {})
            if COMPRESSION not in extensions:
                self._decoded[number] = np.frombuffer(self._bytes(view), np.uint8)
            else:
                self._decoded[number] = self._uncompressed(extensions.part(COMPRESSION))
        return self._decoded[number], stride

    def _take(self, size: int, place: str) -> None:
        """Count the bytes of an array before there is one."""
        self._room -= size
        if self._room < 0:
            raise ValueError(f"{place}: expected at most {_MOST} bytes in all, but got more")

    def _bytes(self, part: Fields) -> memoryview:
        part.whole("buffer", 0, 0)
        begin, length = part.whole("byteOffset", 0, 2**31, 0), part.whole("byteLength", 1, 2**31)
        if begin + length > len(self.binary):
            raise ValueError(f"{part.place}: expected {begin + length} bytes, but got {len(self.binary)}")
        return self.binary[begin : begin + length]

    def _uncompressed(self, part: Fields) -> np.ndarray:
        data, stride = bytes(self._bytes(part)), part.whole("byteStride", 4, 256)
        count, mode, name = part.whole("count", 1, _MOST), part.text("mode"), part.text("filter", "NONE")
        if mode != "ATTRIBUTES" or name not in meshopt.FILTERS or (name == "QUATERNION" and stride != 8):
            raise ValueError(f"{part.place}: expected attributes, but got {mode} by {name} of {stride} bytes")
        self._take(count * stride, part.place)
        try:
            elements = meshopt.decode(data, count, stride)
        except ValueError as error:
            raise ValueError(f"{part.place}: {error}") from None
        return meshopt.FILTERS[name](elements).view(np.uint8).reshape(-1)


def _parsed(text: bytes) -> Any:
    def refuse(word: str):
        raise ValueError(f"the number {word}")

    try:
        return json.loads(text, parse_constant=refuse)
    except (ValueError, RecursionError) as error:
        raise ValueError(f"expected JSON, but got {short(str(error))}") from None


class Contents(NamedTuple):
    """What a file holds: ``gaussians``, in its order, and their ``setting``."""

    gaussians: MovingGaussians | MovingWindows
    setting: Setting


def read(path: Path) -> Contents:
    """Read a file.

    Raises:
        ValueError: naming the file and what is wrong with it.
        OSError: where there is none.

    Cost: about a microsecond for each 16 bytes of compressed arrays.
    """
    data = read_bytes(path, _MOST)
    try:
        return _scene(Container(data))
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from None


def _scene(container: Container) -> Contents:
    description = container.description
    description.check_known("extensionsRequired", _EXTENSIONS)
    number, attributes, motion = _moving_node(description)
    version = motion.text("version")
    if version.split(".")[0] != FORMAT.split(".")[0]:
        raise ValueError(f"expected version {FORMAT}, but got {short(version)}; update forewarp")
    motion.check_known("features", _FEATURES)
    gaussians = _gaussians(container, attributes, motion)
    if WINDOWS in motion:
        gaussians = _windows(container, gaussians, motion)
    extras = description.parts("nodes")[number].part("extras", {})
    setting = Setting(
        *_cameras(description, number),
        torch.tensor(motion.numbers("focus", 3, [0, 0, 0]), dtype=torch.float64),
        motion.number("seconds", 1e-3, 1e6, 4),
        tuple(motion.numbers("background", 3, [1, 1, 1])),
        shift=tuple(extras.numbers("shift", 3, [0, 0, 0])),
        trust=extras.number(TRUST, 0, 180) if TRUST in extras else None,
    )
    return Contents(gaussians, setting)


def _windows(container: Container, first: MovingGaussians, motion: Fields) -> MovingWindows:
    """Read the windows of a film; the last rows of the first one are shown in all."""
    about, description = motion.part(WINDOWS), container.description
    parts, meshes = about.parts("list"), description.parts("meshes")
    if not 2 <= len(parts) <= _WINDOWS:
        raise ValueError(f"{about.place}.list: expected 2 to {_WINDOWS} windows, but got {len(parts)}")
    shared = taken(first, slice(len(first.means) - about.whole("shared", 0, len(first.means), 0), None))
    spans = [tuple(part.numbers("span", 2)) for part in parts]
    begins = [part.number("from", 0, 1) for part in parts]
    if not all(0 <= begin < end <= 1 for begin, end in spans):
        raise ValueError(f"{about.place}.list: expected spans in [0, 1], but got {short(spans)}")
    fade = about.number("fade", 0, 0.5, 0)
    check_windows(begins, spans, fade)
    gaussians = [first]
    for part in parts[1:]:
        if (held := _held(meshes, part)) is None:
            raise ValueError(f"{part.place}.mesh: expected Gaussians with {MOTION}, but got none")
        own = _gaussians(container, *held)
        if _coefficients(own) != _coefficients(shared):
            raise ValueError(f"{part.place}: expected as many coefficients as the first window has")
        gaussians.append(with_shared(own, shared))
    return MovingWindows(tuple(map(Window, gaussians, spans, begins)), fade)


def _coefficients(gaussians: MovingGaussians) -> list[tuple | None]:
    """Return the shapes of what is added to colour and opacity, without the number of Gaussians."""
    parts = gaussians.harmonics, gaussians.color_over_time, gaussians.opacity_over_time
    return [None if part is None else tuple(part.shape[1:]) for part in parts]


def _moving_node(description: Fields) -> tuple[int, Fields, Fields]:
    """Return the number of the node that holds the moving Gaussians, and what ``_held`` returns of it."""
    meshes = description.parts("meshes")
    for number, node in enumerate(description.parts("nodes")):
        if "mesh" in node and (held := _held(meshes, node)) is not None:
            return number, *held
    raise ValueError(f"expected Gaussians with {MOTION}, but got a glTF without them")


def _held(meshes: list[Fields], user: Fields) -> tuple[Fields, Fields] | None:
    """Return the attributes and the motion of the Gaussians in a part's mesh; None: there are none."""
    for primitive in meshes[user.whole("mesh", 0, len(meshes) - 1)].parts("primitives"):
        inner = primitive.part("extensions", {}).part(SPLATS, {}).part("extensions", {})
        if MOTION in inner:
            return primitive.part("attributes"), Fields(inner.content[MOTION], MOTION)
    return None


def _gaussians(container: Container, attributes: Fields, motion: Fields) -> MovingGaussians:
    """Read the canonical state and what is added to it."""
    place = attributes.place

    count = None

    def array(key: str, kind: str) -> torch.Tensor:
        values = container.array(attributes, key, kind, count)
        if values.dtype.kind != "f":
            raise ValueError(f"{place}.{key}: expected floats or normalised numbers, but got whole ones")
        return torch.from_numpy(values)

    means = array("POSITION", "VEC3")
    count = len(means)
    kinds = {"ROTATION": "VEC4", "SCALE": "VEC3", "OPACITY": "SCALAR"}
    quaternions, scales, opacity = (array(f"{SPLATS}:{key}", kind) for key, kind in kinds.items())
    for key, good in (("SCALE", scales >= 0), ("OPACITY", (opacity >= 0) & (opacity <= 1))):
        if not bool(good.all()):
            raise ValueError(f"{place}.{SPLATS}:{key}: expected numbers in its range, but got others")
    degree, harmonics = 0, []
    while degree <= _DEGREES and f"{SPLATS}:SH_DEGREE_{degree}_COEF_0" in attributes or not degree:
        names = [f"{SPLATS}:SH_DEGREE_{degree}_COEF_{n}" for n in range(2 * degree + 1)]
        harmonics += [array(name, "VEC3") for name in names]
        degree += 1

    def over_time(key: str, kind: str) -> torch.Tensor | None:
        parts = container.arrays(motion, key, kind, count, _COSINES)
        return _floats(np.stack(parts, 1)) if parts else None

    colors, opacities = over_time("colorOverTime", "VEC3"), over_time("opacityOverTime", "SCALAR")
    logits = torch.logit(opacity.double())[:, 0].float()
    if opacities is not None:
        opacities = opacities[..., 0]
        logits = _floats(container.array(motion, "opacityLogits", "SCALAR", count))[:, 0]
    canonical_time = motion.number("canonicalTime", 0, 1)
    motion.fixed("cutoff", math.exp(LOG_MIN_ALPHA))
    motion.fixed("margin", MARGIN)
    return MovingGaussians(
        means, scales.log(), quaternions.roll(1, -1), logits, torch.stack(harmonics, 1), colors, opacities,
        canonical_time, motion.number("blur", 0, 1e3), _motion(container, motion, canonical_time, count),
    )  # fmt: skip


def _floats(values: np.ndarray) -> torch.Tensor:
    return torch.from_numpy(values.astype(np.float32, copy=False))


def _motion(container: Container, motion: Fields, canonical_time: float, count: int) -> NodeMotion | None:
    """Read nodes and links; None where nothing moves."""
    moving = motion.whole("moving", 0, count)
    motion.whole("inMotion", 0, moving, moving)
    if not moving:
        return None
    nodes, about = motion.part("nodes"), motion.part("curve")
    positions = _floats(container.array(nodes, "positions", "VEC3"))
    kind, frames = about.text("kind"), about.whole("frames", 2, 10**9)
    natural = kind == "spline" and about.flag("natural")
    if kind not in KINDS:
        raise ValueError(f"{about.place}.kind: expected {' or '.join(KINDS)}, but got {short(kind)}")
    least = 1 if kind == "cosines" else 2 if natural else 4
    number = about.whole("count", least, frames - 1 if kind == "cosines" else 10**6)
    if kind == "cosines":
        about.fixed("padding", PADDING)

    def curves(key: str, kind: str = "VEC3") -> torch.Tensor:
        values = container.array(nodes, key, kind, len(positions) * number)
        return _floats(values).reshape(len(positions), number, -1)

    translations, rotations = curves("translations"), None
    if "rotations" in nodes:
        rotations = curves("rotations", "VEC3 or VEC4")
    links, weights = _links(container, motion, moving, len(positions))
    padded = torch.zeros(2, count, links.shape[1])
    padded[0, :moving], padded[1, :moving] = links, weights
    curve = Curve(kind, number, frames, canonical_time, straight=natural, exactly=True)
    times, offsets = _offsets(container, motion)
    if kind == "cosines" and times:
        raise ValueError(f"{about.place}.kind: expected spline, as there are timeOffsets, but got 'cosines'")
    return NodeMotion(positions, translations, rotations, curve, padded[0].int(), padded[1], times, offsets)


def _links(
    container: Container, motion: Fields, moving: int, nodes: int
) -> tuple[torch.Tensor, torch.Tensor]:
    """Read the nodes (N, L) that those that move follow, and their shares, which sum to 1."""
    tables = []
    for key in ("links", "weights"):
        if not (parts := container.arrays(motion, key, "VEC4", moving, _LINKS)):
            raise ValueError(f"{MOTION}.{key}: expected accessors, but got none")
        tables.append(np.concatenate(parts, 1))
    links, weights = tables
    if links.shape != weights.shape or links.dtype.kind not in "ui" or int(links.max()) >= nodes:
        raise ValueError(f"{MOTION}.links: expected numbers below {nodes} with weights, but got others")
    total = weights.sum(1, keepdims=True, dtype=np.float64)
    if weights.min() < 0 or not (total > 0).all():
        raise ValueError(f"{MOTION}.weights: expected numbers >= 0, and one above, but got others")
    return torch.from_numpy(links.astype(np.int32)), _floats(weights / total)


def _offsets(container: Container, motion: Fields) -> tuple[list[float], list[float]]:
    """Read the offsets of times; none if there are none."""
    if "timeOffsets" not in motion:
        return [], []
    part = motion.part("timeOffsets")
    columns = (container.array(part, key, "SCALAR")[:, 0] for key in ("times", "offsets"))
    times, offsets = (column.astype(float) for column in columns)
    good = len(times) == len(offsets) and bool((np.diff(times) > 0).all()) and 0 <= times[0] <= times[-1] <= 1
    if not good or float(np.abs(offsets).max()) > _FARTHEST + 1e-6:
        expected = f"ascending times in [0, 1] with offsets of at most {_FARTHEST}"
        raise ValueError(f"{part.place}: expected {expected}, but got others")
    return times.tolist(), offsets.tolist()


def _cameras(description: Fields, scene: int) -> tuple[list[Camera], torch.Tensor]:
    """Return the cameras below the scene's node, and the rotation of that node."""
    nodes, cameras = description.parts("nodes"), description.parts("cameras")
    for key in ("matrix", "translation", "scale"):
        if key in nodes[scene]:
            raise ValueError(f"{nodes[scene].place}.{key}: expected a rotation alone, but got this, too")
    found = []
    for number in nodes[scene].items("children"):
        if type(number) is not int or not 0 <= number < len(nodes):
            raise ValueError(f"{nodes[scene].place}.children: expected nodes, but got {short(number)}")
        if "camera" in (node := nodes[number]):
            camera = cameras[node.whole("camera", 0, len(cameras) - 1)]
            found.append(_camera(node, camera.part("extras"), camera.part("perspective")))
    return found, _rotation(nodes[scene])


def _rotation(node: Fields) -> torch.Tensor:
    from scipy.spatial.transform import Rotation  # late, as its import takes time

    quaternion = node.numbers("rotation", 4, [0, 0, 0, 1])
    if math.hypot(*quaternion) < 0.5:
        raise ValueError(f"{node.place}.rotation: expected a unit quaternion, but got {short(quaternion)}")
    return torch.from_numpy(Rotation.from_quat(quaternion).as_matrix())


def _camera(node: Fields, extras: Fields, perspective: Fields) -> Camera:
    pose = torch.eye(4, dtype=torch.float64)
    pose[:3, :3] = _rotation(node) * CAMERA_AXES
    pose[:3, 3] = torch.tensor(node.numbers("translation", 3, [0, 0, 0]), dtype=torch.float64)
    lens = extras.numbers("lens", 5) if "lens" in extras else None
    return Camera(
        *(extras.whole(key, 1, 2**16) for key in ("width", "height")),
        *(extras.number(key, 1e-6, 1e9) for key in ("fx", "fy")),
        *(extras.number(key, -1e9, 1e9) for key in ("cx", "cy")),
        pose,
        *(perspective.number(key, 0, 1e30) for key in ("znear", "zfar")),
        skew=extras.number("skew", -1e9, 1e9, 0),
        lens=None if lens is None else Lens(tuple(lens[:3]), tuple(lens[3:])),
    )
