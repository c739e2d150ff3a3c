"""Read and draw scene.glb in NumPy by docs/format.md and the glTF texts alone.

It shares no code with forewarp: that its images are those of forewarp shows that the page says enough.
It is slow and checks little. Shapes: N Gaussians, M nodes, K coefficients of a curve.
"""

import json
import struct
from pathlib import Path

import numpy as np

DTYPES = {5120: np.int8, 5121: np.uint8, 5122: np.int16, 5123: np.uint16, 5126: np.float32}
COLUMNS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4}
SPLATS, MOTION, MESHOPT = "KHR_gaussian_splatting", "FOREWARP_gaussian_motion", "EXT_meshopt_compression"


# --------------------------------------------------------------------- container


def chunks(path):
    """Return the JSON document and the bytes of the binary chunk."""
    data = Path(path).read_bytes()
    magic, version, length = struct.unpack_from("<4sII", data)
    assert (magic, version, length) == (b"glTF", 2, len(data)), path
    size = struct.unpack_from("<I", data, 12)[0]
    return json.loads(data[20 : 20 + size]), data[20 + size + 8 :]


def array(document, blob, number):
    """Return an accessor's rows (count, columns) as floats."""
    accessor = document["accessors"][number]
    view = document["bufferViews"][accessor["bufferView"]]
    packed = view.get("extensions", {}).get(MESHOPT)
    where = packed or view
    data = blob[where.get("byteOffset", 0) :][: where["byteLength"]]
    if packed:
        data = unfiltered(attributes(data, packed["count"], packed["byteStride"]), packed.get("filter"))
    dtype, columns = np.dtype(DTYPES[accessor["componentType"]]), COLUMNS[accessor["type"]]
    stride = view.get("byteStride", columns * dtype.itemsize)
    shape, strides = (accessor["count"], columns), (stride, dtype.itemsize)
    values = np.ndarray(shape, dtype, bytes(data), accessor.get("byteOffset", 0), strides).astype(np.float64)
    if accessor.get("normalized"):
        values = np.maximum(values / np.iinfo(dtype).max, -1)
    return values


# ---------------------------------- EXT_meshopt_compression, appendices A and B


def attributes(data, count, stride):
    """Decode mode 0: the bytes (count, stride) of the elements, before any filter."""
    assert data[0] == 0xA0
    deltas, at = np.zeros((count + 15, stride), np.uint8), 1
    block = min(8192 // stride & ~15, 256)
    for first in range(0, count, block):
        groups = -(-min(block, count - first) // 16)
        for column in range(stride):
            header, at = data[at : at + -(-groups // 4)], at + -(-groups // 4)
            for group in range(groups):
                kind = header[group // 4] >> 2 * (group % 4) & 3
                row = first + 16 * group
                deltas[row : row + 16, column], at = sixteen(data, at, kind)
    deltas = np.where(deltas & 1, ~(deltas >> 1), deltas >> 1)[:count]  # from zigzag
    baseline = np.frombuffer(data[-stride:], np.uint8)
    return baseline + np.cumsum(deltas, 0, dtype=np.uint8)


def sixteen(data, at, kind):
    """Decode a group of 16 deltas of the kinds 0 to 3; return them and where the next group begins."""
    if kind == 0:
        return 0, at
    if kind == 3:
        return np.frombuffer(data, np.uint8, 16, at), at + 16
    bits = 2 * kind
    packed = np.frombuffer(data, np.uint8, 2 * bits, at)
    values = (packed[:, None] >> np.arange(8 - bits, -1, -bits) & (1 << bits) - 1).ravel()
    large = values == (1 << bits) - 1
    at += 2 * bits
    values[large] = np.frombuffer(data, np.uint8, large.sum(), at)
    return values, at + large.sum()


def unfiltered(elements, name):
    """Apply a view's filter to its decoded bytes."""
    if name == "EXPONENTIAL":
        whole = elements.view("<i4")
        return np.ldexp((whole << 8 >> 8).astype(np.float32), whole >> 24).tobytes()
    if name == "QUATERNION":
        whole = elements.view("<i2").astype(np.int64)
        three = whole[:, :3] / (whole[:, 3:] | 3) / np.sqrt(2)
        largest = np.sqrt(np.maximum(0, 1 - (three**2).sum(1, keepdims=True)))
        columns = (whole[:, 3:] + [1, 2, 3, 0]) % 4
        out = np.empty(whole.shape, "<i2")
        np.put_along_axis(out, columns, np.round(32767 * np.hstack([three, largest])).astype("<i2"), 1)
        return out.tobytes()
    assert name in (None, "NONE"), name
    return elements.tobytes()


# ------------------------------------------------------------------- mathematics


def rotations(q):
    """Return the matrices (N, 3, 3) of unit quaternions (N, 4), x y z w."""
    x, y, z, w = (q / np.linalg.norm(q, axis=1, keepdims=True)).T
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return np.moveaxis(np.array(rows), 2, 0)


def harmonics(direction):
    """Return the 16 real harmonics (N, 16) of unit directions (N, 3), degrees 0 to 3."""
    x, y, z = direction.T
    xx, yy, zz = x * x, y * y, z * z
    basis = [
        0.2820947917738781 + 0 * x,
        *(-0.4886025119029199 * y, 0.4886025119029199 * z, -0.4886025119029199 * x),
        *(1.092548430592079 * x * y, -1.092548430592079 * y * z),
        0.31539156525252 * (2 * zz - xx - yy),
        *(-1.092548430592079 * x * z, 0.5462742152960395 * (xx - yy)),
        *(-0.5900435899266435 * y * (3 * xx - yy), 2.890611442640554 * x * y * z),
        -0.4570457994644657 * y * (4 * zz - xx - yy),
        0.3731763325901154 * z * (2 * zz - 3 * xx - 3 * yy),
        -0.4570457994644657 * x * (4 * zz - xx - yy),
        *(1.445305721320277 * z * (xx - yy), -0.5900435899266435 * x * (xx - 3 * yy)),
    ]
    return np.stack(basis, 1)


def spline(time, count, natural):
    """Return the shares (K,) of a curve's coefficients at a time."""
    n = count + 2 if natural else count
    i = min(max(int(np.floor(time * (n - 3))), 0), n - 4)
    u = time * (n - 3) - i
    s = np.zeros(n)
    s[i : i + 4] = [(1 - u) ** 3, 3 * u**3 - 6 * u**2 + 4, -3 * u**3 + 3 * u**2 + 3 * u + 1, u**3]
    s /= 6
    if not natural:
        return s
    b = s[1:-1].copy()
    b[0] += 2 * s[0]
    b[1] -= s[0]
    b[-1] += 2 * s[-1]
    b[-2] -= s[-1]
    return b


def cosines(time, count, frames, padding):
    """Return ``g_k`` (K,) at a time."""
    place = 2 * (time + padding) / (1 + 2 * padding) * (frames - 1) + 1
    return np.sqrt(2 / frames) * np.cos(np.pi / (2 * frames) * place * np.arange(1, count + 1))


# ------------------------------------------------------------------------- scene


class PlainScene:
    """The moving Gaussians of a file; ``cameras`` are its views."""

    def __init__(self, path):
        document, blob = chunks(path)
        node = next(n for n in document["nodes"] if "mesh" in n)
        primitive = document["meshes"][node["mesh"]]["primitives"][0]
        about = primitive["extensions"][SPLATS]["extensions"][MOTION]
        assert about["version"].split(".")[0] == "1"
        assert {*about.get("features", [])} <= {"windows", "quaternions"}
        self.windows = [PlainWindow(document, blob, primitive, about)]
        self.limits, self.fade = [(0.0, 0.0, 1.0)], 0.0  # shown from; its own times 0 and 1
        if "windows" in about:
            windows, first = about["windows"]["list"], self.windows[0]
            self.fade = about["windows"].get("fade", 0.0)
            self.limits = [(window["from"], *window["span"]) for window in windows]
            for window in windows[1:]:
                part = document["meshes"][window["mesh"]]["primitives"][0]
                self.windows.append(PlainWindow(document, blob, part, about, first))
        children = (document["nodes"][i] for i in node.get("children", []))
        self.cameras = [view(document, child) for child in children if "camera" in child]
        self.background = self.windows[0].background

    def render(self, camera, time):
        """Return the image (H, W, 3) that a camera (an entry of ``cameras``) sees at a time."""
        number = max(n for n, (begin, _, _) in enumerate(self.limits) if begin <= time)
        shares = {number: 1.0}
        for seam in range(1, len(self.limits)):
            after = time - self.limits[seam][0]
            if abs(after) < self.fade:
                share = 0.5 + after / (2 * self.fade)
                shares = {seam - 1: 1 - share, seam: share}
        image = 0
        for number, share in shares.items():
            _, first, last = self.limits[number]
            image = image + share * self.windows[number].render(camera, (time - first) / (last - first))
        return image


class PlainWindow:
    """The Gaussians of a primitive, and those that it shares with the ``first`` one of ``setting``."""

    def __init__(self, document, blob, primitive, setting, first=None):
        own = primitive["extensions"][SPLATS]["extensions"][MOTION]
        self.about = about = setting | {"curve": None, "moving": 0} | own
        read = lambda number: array(document, blob, number)  # noqa: E731
        reads = lambda numbers: np.array([read(number) for number in numbers])  # noqa: E731
        named = primitive["attributes"]
        self.centers = read(named["POSITION"])
        self.axes = rotations(read(named[f"{SPLATS}:ROTATION"])) * read(named[f"{SPLATS}:SCALE"])[:, None]
        self.opacity = read(named[f"{SPLATS}:OPACITY"])[:, 0]
        names = [f"{SPLATS}:SH_DEGREE_{d}_COEF_{n}" for d in range(4) for n in range(2 * d + 1)]
        self.harmonics = reads(named[name] for name in names if name in named)
        if about["moving"]:
            self.nodes = {name: read(number) for name, number in about["nodes"].items()}
            self.links = np.hstack(reads(about["links"])).astype(int)
            weights = np.hstack(reads(about["weights"]))
            self.weights = weights / weights.sum(1, keepdims=True)
        self.offsets = {name: read(number)[:, 0] for name, number in own.get("timeOffsets", {}).items()}
        self.color_over_time = reads(own.get("colorOverTime", []))
        self.opacity_over_time = [read(number)[:, 0] for number in own.get("opacityOverTime", [])]
        self.logit = read(own["opacityLogits"])[:, 0] if "opacityLogits" in own else None
        self.background = np.array(setting.get("background", [1, 1, 1]))
        if first is not None and (many := setting["windows"]["shared"]):
            for name in ("centers", "axes", "opacity", "logit"):
                if getattr(self, name) is not None:
                    both = getattr(self, name), getattr(first, name)[-many:]
                    setattr(self, name, np.concatenate(both))
            for name in ("harmonics", "color_over_time"):
                if len(getattr(self, name)):
                    both = getattr(self, name), getattr(first, name)[:, -many:]
                    setattr(self, name, np.concatenate(both, 1))
            pairs = zip(self.opacity_over_time, first.opacity_over_time)
            self.opacity_over_time = [np.concatenate([a, b[-many:]]) for a, b in pairs]

    def maps(self, time):
        """Return ``D`` (M, 3, 3) and ``d`` (M, 3) of the nodes."""
        curve = self.about["curve"]
        count = curve["count"]
        time = time + (np.interp(time, self.offsets["times"], self.offsets["offsets"]) if self.offsets else 0)
        if curve["kind"] == "spline":
            basis = spline(time, count, curve.get("natural", False))
        else:
            numbers = (count, curve["frames"], curve.get("padding", 0.2))
            basis = cosines(time, *numbers) - cosines(self.about["canonicalTime"], *numbers)
        places = self.nodes["positions"]
        v = np.einsum("k,mkx->mx", basis, self.nodes["translations"].reshape(-1, count, 3))
        r, w = np.zeros_like(v), np.ones((len(v), 1, 1))
        if "rotations" in self.nodes:
            r = np.einsum("k,mkx->mx", basis, self.nodes["rotations"].reshape(len(v), count, -1))
            w, r = w + r[:, 3:].sum(1)[:, None, None], r[:, :3]
        square = (r**2).sum(1)[:, None, None]
        cross = np.stack([np.cross(r, axis) for axis in np.eye(3)], 2)
        turns = 2 * (r[:, :, None] * r[:, None] - square * np.eye(3) + w * cross) / (w**2 + square)
        return turns, v - np.einsum("mxy,my->mx", turns, places)

    def gaussians(self, time, eye):
        """Return centres (N, 3), covariances (N, 3, 3), colours (N, 3) seen from a place, opacities (N,)."""
        centers, axes, moving = self.centers.copy(), self.axes.copy(), self.about["moving"]
        if moving:
            turns, shifts = self.maps(time)
            maps = np.eye(3) + np.einsum("nl,nlxy->nxy", self.weights, turns[self.links])
            centers[:moving] = np.einsum("nxy,ny->nx", maps, centers[:moving])
            centers[:moving] += np.einsum("nl,nlx->nx", self.weights, shifts[self.links])
            axes[:moving] = maps @ axes[:moving]
        direction = centers - eye
        direction /= np.linalg.norm(direction, axis=1, keepdims=True)
        basis = harmonics(direction)[:, : len(self.harmonics)]
        colors = 0.5 + np.einsum("nk,knc->nc", basis, self.harmonics)
        for k, change in enumerate(self.color_over_time, 1):
            colors += self.wave(k, time) * change
        opacity = self.opacity
        if len(self.opacity_over_time):
            changes = [self.wave(k, time) * change for k, change in enumerate(self.opacity_over_time, 1)]
            opacity = 1 / (1 + np.exp(-(self.logit + sum(changes))))
        return centers, axes @ axes.transpose(0, 2, 1), np.maximum(colors, 0), opacity

    def wave(self, k, time):
        """Return ``f_k`` at a time."""
        return np.cos(np.pi * k * time) - np.cos(np.pi * k * self.about["canonicalTime"])

    def render(self, camera, time):
        """Return the image (H, W, 3) that a camera (an entry of ``cameras``) sees at a time."""
        centers, covariance, colors, opacity = self.gaussians(time, camera["eye"])
        width, height = camera["width"], camera["height"]
        cutoff = self.about.get("cutoff", 1 / 255)
        local = (centers - camera["eye"]) @ camera["axes"]
        with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
            places, slopes, seen = project(camera, local)
        beyond = np.maximum(-places, places - [width, height]).max(1)
        seen &= (local[:, 2] > camera["near"]) & (opacity >= cutoff)
        seen &= beyond <= self.about.get("margin", 0.125) * max(width, height)
        order = np.argsort(np.linalg.norm(local, axis=1), kind="stable")
        image, through = np.zeros((height, width, 3)), np.ones((height, width, 1))
        for i in order[seen[order]]:
            spread = slopes[i] @ camera["axes"].T
            spread = spread @ covariance[i] @ spread.T + self.about["blur"] * np.eye(2)
            reach = np.sqrt(2 * np.log(opacity[i] / cutoff) * np.diag(spread))  # nothing is drawn beyond it
            low = np.clip(np.floor(places[i] - reach - 0.5), 0, [width, height]).astype(int)
            high = np.clip(np.ceil(places[i] + reach + 0.5), 0, [width, height]).astype(int)
            x = np.arange(low[0], high[0]) + 0.5 - places[i, 0]
            y = np.arange(low[1], high[1])[:, None] + 0.5 - places[i, 1]
            (a, b), (_, c) = np.linalg.inv(spread)
            alpha = opacity[i] * np.exp(-0.5 * (a * x * x + 2 * b * x * y + c * y * y))
            alpha = np.where(alpha < cutoff, 0, alpha)[..., None]
            here = np.s_[low[1] : high[1], low[0] : high[0]]
            image[here] += through[here] * alpha * colors[i]
            through[here] *= 1 - alpha
        return np.clip(image + through * self.background, 0, 1)


# ----------------------------------------------------------------------- cameras


def view(document, node):
    """Return a camera: its ``extras``, ``near``, ``eye`` (3,), and ``axes`` (3, 3), right, down, forward."""
    camera = document["cameras"][node["camera"]]
    limits = camera["perspective"]
    turn = rotations(np.array([node.get("rotation", [0, 0, 0, 1])], float))[0]
    pose = {"eye": np.array(node.get("translation", [0, 0, 0]), float), "axes": turn * [1, -1, -1]}
    return camera["extras"] | pose | {"near": max(limits["znear"] / 10, limits["zfar"] / 50)}


def project(camera, local):
    """Return the pixels (N, 2) of points (N, 3) in camera axes, the Jacobian (N, 2, 3), and whether the lens
    may see them (N,).
    """
    z, plane = local[:, 2], local[:, :2] / local[:, 2:]
    bent, bend = distort(camera, plane)
    scale = np.array([[camera["fx"], camera.get("skew", 0)], [0, camera["fy"]]])
    center = [camera["cx"], camera["cy"]]
    flat = np.zeros((len(z), 2, 3))
    flat[:, 0, 0] = flat[:, 1, 1] = 1 / z
    flat[:, :, 2] = -plane / z[:, None]
    seen = np.ones(len(z), bool)
    if "lens" in camera:
        corners = np.array([[x, y] for x in (0, camera["width"]) for y in (0, camera["height"])])
        target = (corners - center) @ np.linalg.inv(scale).T
        at = target
        for _ in range(20):  # Newton's method
            there, slope = distort(camera, at)
            at = at - np.einsum("nxy,ny->nx", np.linalg.inv(slope), there - target)
        seen = (plane**2).sum(1) <= 1.3 * (at**2).sum(1).max()
    return bent @ scale.T + center, scale @ bend @ flat, seen


def distort(camera, plane):
    """Return where a lens sees points (N, 2) of the plane at distance 1, and the Jacobian (N, 2, 2)."""
    k1, k2, k3, p1, p2 = camera.get("lens", [0] * 5)
    x, y = plane.T
    q = x * x + y * y
    f, slope = 1 + k1 * q + k2 * q**2 + k3 * q**3, k1 + 2 * k2 * q + 3 * k3 * q**2
    bent_x = f * x + 2 * p1 * x * y + p2 * (q + 2 * x * x)
    bent_y = f * y + 2 * p2 * x * y + p1 * (q + 2 * y * y)
    mixed = 2 * (slope * x * y + p1 * x + p2 * y)
    bend = [
        [f + 2 * slope * x * x + 2 * p1 * y + 6 * p2 * x, mixed],
        [mixed, f + 2 * slope * y * y + 2 * p2 * x + 6 * p1 * y],
    ]
    return np.stack([bent_x, bent_y], 1), np.moveaxis(np.array(bend), 2, 0)
