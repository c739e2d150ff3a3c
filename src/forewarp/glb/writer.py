"""Write moving Gaussians as a binary glTF: ``docs/format.md`` specifies what the reader beside this reads."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from forewarp.fields.curves import PADDING
from forewarp.fields.moving import MARGIN, MovingGaussians, NodeMotion
from forewarp.fields.windows import Window, longest_fade
from forewarp.glb import meshopt
from forewarp.glb.container import BYTE, CAMERA_AXES, SHORT, SIGNED_SHORT, UNIT_BYTE, Buffer, quaternion_of
from forewarp.ops.layout import LOG_MIN_ALPHA
from forewarp.scene.camera import Camera

SPLATS, MOTION = "KHR_gaussian_splatting", "FOREWARP_gaussian_motion"
FORMAT = "1.1"
WINDOWS = "windows"  # a feature, and the property that describes it
TRUST = "trust_degrees"  # in the extras of the node
QUATERNIONS = "quaternions"  # a feature: rotations of nodes have four numbers
COMPACT, LOSSLESS = "compact", "lossless"
_LEAST_NEAR = 1e-6  # of a camera's far plane: glTF's near plane lies in front of the camera
_SLOTS = 4  # links in an accessor
_TIMES = 64  # at which opacity over time is looked at


@dataclass(frozen=True)
class Setting:
    """What a page needs besides the Gaussians: ``cameras`` that have seen them, the first one to begin at;
    the ``rotation`` (3, 3) that makes y point upwards; the ``focus`` (3,) to turn about, world units; how
    many ``seconds`` time lasts from 0 to 1; the ``background`` (3,), sRGB; ``times``, when each camera took
    its image, where that is known; the ``shift`` (3,) that was left out of all places, world units; and
    ``trust``, degrees from the filmed path up to which images are good, where that was measured.
    """

    cameras: Sequence[Camera]
    rotation: Tensor
    focus: Tensor
    seconds: float
    background: tuple[float, float, float]
    times: Sequence[float] = ()
    shift: tuple[float, float, float] = (0.0, 0.0, 0.0)
    trust: float | None = None


def write(windows: Sequence[tuple[Window, Rows]], setting: Setting, quality: str, shared: int = 0) -> bytes:
    """Return the file.

    Args:
        windows: of the film, or the only one: Gaussians on the CPU, and which of their rows are written; of
            windows after the first one without those that all share.
        setting: what else is in the file.
        quality: ``compact``: rounded to what an eye can tell; ``lossless``: float32.
        shared: how many of the last rows of the first window all show.
    """
    store = _Store(compressed=quality == COMPACT)
    primitives = [_primitive(store, setting.cameras, window.gaussians, rows) for window, rows in windows]
    motion = primitives[0]["extensions"][SPLATS]["extensions"][MOTION]
    motion |= {"seconds": setting.seconds, "background": list(setting.background)}
    motion |= {"focus": setting.focus.tolist(), "cutoff": math.exp(LOG_MIN_ALPHA), "margin": MARGIN}
    if len(windows) > 1:
        begins, spans = zip(*((window.begin, window.span) for window, _ in windows))
        about = [{"span": list(span), "from": begin} for begin, span in zip(begins, spans)]
        for number, window in enumerate(about[1:], 1):
            window["mesh"] = number
        needed = [p["extensions"][SPLATS]["extensions"][MOTION]["features"] for p in primitives]
        motion["features"] = sorted({*sum(needed, []), WINDOWS})
        motion[WINDOWS] = {"shared": shared, "fade": longest_fade(begins, spans), "list": about}
    cameras = [_camera(camera) for camera in setting.cameras]
    for camera, time in zip(cameras, setting.times):
        camera["extras"]["time"] = time
    node = {"name": "scene", "rotation": quaternion_of(setting.rotation), "mesh": 0}
    extras = {"shift": list(setting.shift)} if any(setting.shift) else {}
    extras |= {} if setting.trust is None else {TRUST: setting.trust}
    node |= {"extras": extras} if extras else {}
    nodes = [node | {"children": list(range(1, len(cameras) + 1))}]
    for number, camera in enumerate(setting.cameras):
        pose = camera.camera_to_world[:3, :3].double() * CAMERA_AXES
        place = {"rotation": quaternion_of(pose), "translation": camera.center.tolist()}
        nodes.append({"name": f"camera {number}" if number else "start", "camera": number} | place)
    meshes = [{"primitives": [primitive]} for primitive in primitives]
    description = {"extensionsUsed": [SPLATS, MOTION], "nodes": nodes, "cameras": cameras, "meshes": meshes}
    return store.packed(description)


def _primitive(store: _Store, cameras: Sequence[Camera], gaussians: MovingGaussians, rows: Rows) -> dict:
    """Store Gaussians and their motion as a primitive of points."""
    order, moving, in_motion = rows
    pixel = _pixel(gaussians, cameras)
    attributes = _attributes(store, pixel, gaussians, order)
    motion = {"version": FORMAT, "features": [], "canonicalTime": gaussians.canonical_time}
    motion |= {"blur": gaussians.blur} | _over_time(store, gaussians, order)
    motion |= {"moving": moving, "inMotion": in_motion}
    if moving:
        motion |= _motion(store, pixel, gaussians.motion, order[:moving], motion["features"])
    splats = {"kernel": "ellipse", "colorSpace": "srgb_rec709_display", "projection": "perspective"}
    splats |= {"sortingMethod": "cameraDistance", "extensions": {MOTION: motion}}
    return {"mode": 0, "attributes": attributes, "extensions": {SPLATS: splats}}


def _camera(camera: Camera) -> dict:
    """Describe a camera as glTF does, and exactly in its extras."""
    perspective = {
        "yfov": 2 * math.atan(0.5 * camera.height / camera.fy),
        "aspectRatio": camera.width * camera.fy / (camera.height * camera.fx),
        "znear": max(camera.near, _LEAST_NEAR * camera.far),
        "zfar": camera.far,
    }
    extras = {name: getattr(camera, name) for name in ("width", "height", "fx", "fy", "cx", "cy")}
    if camera.skew:
        extras["skew"] = camera.skew
    if camera.lens is not None:
        extras["lens"] = [*camera.lens.k, *camera.lens.p]
    return {"type": "perspective", "perspective": perspective, "extras": extras}


class Rows(NamedTuple):
    """Which rows of Gaussians are written: ``order`` (N',) of them; the first ``moving`` follow nodes, and of
    these the first ``in_motion`` are seen to move.
    """

    order: np.ndarray
    moving: int
    in_motion: int


def rows_in_file(
    gaussians: MovingGaussians,
    shown: Tensor | None = None,
    in_motion: Tensor | None = None,
    last: Tensor | None = None,
) -> Rows:
    """Choose the rows that are written; those near each other come near each other.

    Args:
        gaussians: those that are never more opaque than the cutoff are left out,
        shown: (N,) bool, as are those that are not shown; None: all are.
        in_motion: (N,) bool, which are seen to move; None: all that follow nodes.
        last: (N,) bool, which come after all others, and follow no nodes; None: none.
    """
    logits = gaussians.opacity
    if gaussians.opacity_over_time is not None:
        bases = torch.stack([gaussians.bases(i / _TIMES)[1] for i in range(_TIMES + 1)])
        logits = (logits + bases @ gaussians.opacity_over_time.T).amax(0)
    seen = torch.nn.functional.logsigmoid(logits) > LOG_MIN_ALPHA
    seen = (seen if shown is None else seen & shown).numpy()
    rests = np.ones(len(seen), bool)
    if gaussians.motion is not None:
        rests = ~(gaussians.motion.weights > 0).any(-1).numpy()
    still = rests if in_motion is None else rests | ~in_motion.numpy()
    ends = np.zeros(len(seen), bool) if last is None else last.numpy()
    order = np.lexsort((morton(gaussians.means.numpy()), still, rests, ends))
    order = order[seen[order]]
    return Rows(order, int((~rests[order]).sum()), int((~still[order]).sum()))


def morton(points: np.ndarray) -> np.ndarray:
    """Return numbers (N,) in whose order points (N, 3) near each other lie near each other."""
    low, high = points.min(0, initial=np.inf), points.max(0, initial=-np.inf)
    side = max(float((high - low).max(initial=0)), 1e-30)
    cells = ((points - low) / side * (2**21 - 1)).astype(np.uint64)
    codes = np.zeros(len(points), np.uint64)
    for bit in range(21):
        for axis in range(3):
            codes |= (cells[:, axis] >> np.uint64(bit) & np.uint64(1)) << np.uint64(3 * bit + axis)
    return codes


class _Store(Buffer):
    """A buffer of arrays, in a compressed one rounded."""

    def stepped(self, values: np.ndarray, step: float, **options) -> int:
        """Store numbers in steps of the power of two at or below ``step``."""
        return self._exponential(values, math.floor(math.log2(step)), **options)

    def scaled(self, values: np.ndarray, bits: int, step: float, **options) -> int:
        """Store numbers >= 0 with ``bits`` of their own mantissa each, or by ``step`` if that is coarser."""
        exponents = np.frexp(np.maximum(values, 2.0**meshopt.LEAST_EXPONENT))[1] - bits
        exponents = np.maximum(exponents, math.floor(math.log2(step)))
        return self._exponential(values, exponents, **options)

    def _exponential(self, values: np.ndarray, exponents: np.ndarray | int, **options) -> int:
        if self.compressed:
            elements = meshopt.exponential(values.reshape(len(values), -1), exponents)
            return self.add(None, filtered=("EXPONENTIAL", elements), **options)
        return self.add(values, **options)

    def quaternions(self, values: np.ndarray, bits: int, **options) -> int:
        """Store unit quaternions (N, 4) x, y, z, w with ``bits`` a component."""
        if not self.compressed:
            return self.add(values, **options)
        return self.add(
            None, SIGNED_SHORT, filtered=("QUATERNION", meshopt.quaternion(values, bits)), **options
        )

    def shares(self, values: np.ndarray, **options) -> int:
        """Store numbers in [0, 1]."""
        if not self.compressed:
            return self.add(values, **options)
        return self.add(np.rint(values * UNIT_BYTE.one), UNIT_BYTE, **options)


# How finely compact files store (docs/exports.md says what that costs). As shares of what a pixel of cameras
# spans: positions and standard deviations; translations of nodes. By bits: standard deviations, of their own,
# where that is coarser; rotations.
_LENGTH, _CURVE = 1 / 16, 1 / 32
_SCALE_BITS, _ROTATION_BITS = 6, 8
# Coefficients of the constant harmonic and of others, colours over time, opacity over time as logits, and the
# rotations of nodes.
_COLOR, _HARMONIC, _TINT, _LOGIT, _GIBBS = 2**-7, 2**-6, 2**-7, 2**-5, 2**-11


def _pixel(gaussians: MovingGaussians, cameras: Sequence[Camera]) -> float:
    """Return how many world units a pixel spans, at the particles that cameras are nearest to."""
    spans = []
    for camera in cameras:
        away = (gaussians.means.double() - camera.center).norm(dim=-1)
        spans.append(float(away.quantile(0.05)) / max(camera.fx, camera.fy))
    return max(min(spans), 1e-6 * cameras[0].far)


def _attributes(store: _Store, pixel: float, gaussians: MovingGaussians, order: np.ndarray) -> dict:
    """Store the canonical state as KHR_gaussian_splatting has it."""
    rows = torch.from_numpy(order)
    quaternions = _unit(gaussians.quaternions[rows].double())
    scales = gaussians.log_scales[rows].exp().numpy()
    if store.compressed:
        quaternions, scales = _sorted_axes(quaternions, scales)
    opacity = torch.sigmoid(gaussians.opacity[rows].double()).numpy()
    vertices, length = {"vertices": True}, _LENGTH * pixel
    attributes = {
        "POSITION": store.stepped(gaussians.means[rows].numpy(), length, bounds=True, **vertices),
        f"{SPLATS}:ROTATION": store.quaternions(quaternions, _ROTATION_BITS, **vertices),
        f"{SPLATS}:SCALE": store.scaled(scales, _SCALE_BITS, length, **vertices),
        f"{SPLATS}:OPACITY": store.shares(opacity, **vertices),
    }
    for number, harmonic in enumerate(gaussians.harmonics[rows].unbind(1)):
        degree = math.isqrt(number)
        name = f"{SPLATS}:SH_DEGREE_{degree}_COEF_{number - degree**2}"
        attributes[name] = store.stepped(harmonic.numpy(), _HARMONIC if number else _COLOR, **vertices)
    return attributes


def _unit(quaternions: Tensor) -> np.ndarray:
    """Turn quaternions w, x, y, z (N, 4) of any length into unit ones x, y, z, w; of length 0: identity."""
    length = quaternions.norm(dim=-1, keepdim=True)
    identity = quaternions.new_tensor([1.0, 0.0, 0.0, 0.0])
    return torch.where(length > 1e-12, quaternions / length.clamp(min=1e-12), identity).roll(-1, -1).numpy()


def _sorted_axes(quaternions: np.ndarray, scales: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Name the axes of Gaussians anew: the longest first, turned by less than half a turn.

    Half turns about an axis change nothing; of the four rotations that differ by these the one whose w is the
    largest component is taken. Neighbours in the file are then more alike.
    """
    from scipy.spatial.transform import Rotation

    order = np.argsort(-scales, 1, kind="stable")
    axes = np.take_along_axis(Rotation.from_quat(quaternions).as_matrix(), order[:, None], 2)
    axes[:, :, 2] *= np.linalg.det(axes)[:, None]
    rotations = Rotation.from_matrix(axes)
    largest = np.abs(rotations.as_quat()).argmax(1)  # x, y, z: half a turn about that axis brings it to w
    turned = rotations * Rotation.from_quat(np.eye(4)[largest])
    return turned.as_quat(canonical=True), np.take_along_axis(scales, order, 1)


def _over_time(store: _Store, gaussians: MovingGaussians, order: np.ndarray) -> dict:
    """Store what time adds to colours and opacity, and the logits it adds to, which 8 bits do not tell."""
    parts = {}
    if gaussians.color_over_time is not None:
        colors = gaussians.color_over_time[order].unbind(1)
        parts["colorOverTime"] = [store.stepped(color.numpy(), _TINT) for color in colors]
    if gaussians.opacity_over_time is not None:
        logits = gaussians.opacity_over_time[order].unbind(1)
        parts["opacityLogits"] = store.stepped(gaussians.opacity[order].numpy(), _LOGIT)
        parts["opacityOverTime"] = [store.stepped(logit.numpy(), _LOGIT) for logit in logits]
    return parts


def _motion(store: _Store, pixel: float, motion: NodeMotion, rows: np.ndarray, features: list[str]) -> dict:
    """Store the nodes, and what particles in ``rows`` follow; add to ``features`` what readers must know."""
    curve, count = motion.curve, motion.translations.shape[1]
    nodes = {"positions": store.stepped(motion.positions.numpy(), _LENGTH * pixel)}
    nodes["translations"] = store.stepped(motion.translations.reshape(-1, 3).numpy(), _CURVE * pixel)
    if motion.rotations is not None:
        if motion.rotations.shape[2] == 4:
            features.append(QUATERNIONS)
        nodes["rotations"] = store.stepped(motion.rotations.flatten(0, 1).numpy(), _GIBBS)
    about = {"kind": curve.kind, "count": count, "frames": curve.times}
    about |= {"natural": curve.straight} if curve.kind == "spline" else {"padding": PADDING}
    parts = {"nodes": nodes, "curve": about}
    if len(motion.times):
        parts["timeOffsets"] = {"times": store.add(motion.times), "offsets": store.add(motion.offsets)}
    links, weights = motion.links.numpy()[rows], motion.weights.numpy()[rows]
    if store.compressed:  # whoever reads them divides by their sum
        weights = np.rint(weights / weights.max(1, keepdims=True) * UNIT_BYTE.one) / UNIT_BYTE.one
    links, weights = _slots(links, weights)
    component = BYTE if len(motion.positions) <= 256 else SHORT
    blocks = [np.s_[:, first : first + _SLOTS] for first in range(0, links.shape[1], _SLOTS)]
    parts["links"] = [store.add(links[block], component) for block in blocks]
    parts["weights"] = [store.shares(weights[block]) for block in blocks]
    return parts


def _slots(links: np.ndarray, weights: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return links and weights (N, S), S a multiple of 4: a node stays in its column from row to row.

    A column whose node a row does not follow has the weight 0 and keeps its node; the one that was not used
    for longest takes a new node.
    """
    count = len(links)
    width = -(-links.shape[1] // _SLOTS) * _SLOTS
    made, shares = np.zeros((count, width), links.dtype), np.zeros((count, width), weights.dtype)
    held, used = [0] * width, [0] * width
    for row, (nodes, parts) in enumerate(zip(links.tolist(), weights.tolist()), 1):
        free = []
        for node, part in zip(nodes, parts):
            if part > 0:
                column = held.index(node) if node in held else -1
                if column < 0 or used[column] == row:
                    free.append((node, part))
                else:
                    used[column], shares[row - 1, column] = row, part
        for node, part in free:
            column = used.index(min(used))
            held[column], used[column], shares[row - 1, column] = node, row, part
        made[row - 1] = held
    return made, shares
