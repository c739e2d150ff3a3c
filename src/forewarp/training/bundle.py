"""A step put into a file: all that it takes to take it again, without the data."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path

import torch

from forewarp.scene.batch import Batch
from forewarp.scene.box import Box
from forewarp.scene.camera import Camera
from forewarp.scene.frame import Frame, Scene
from forewarp.scene.lens import Lens
from forewarp.scene.rays import Rays
from forewarp.training.archive import read_archive, write_archive
from forewarp.training.module import DynamicSceneModule

_OF_CAMERA = ("width", "height", "fx", "fy", "cx", "cy", "camera_to_world", "near", "far", "skew")
_KINDS = {"unit": float, "state_dict": dict, "config": str, "noted": dict}


@dataclass(frozen=True)
class Bundle:
    """A stored step: the ``batch``, a ``scene`` whose frames have no pixels, the ``unit`` of density, the
    stage's ``state_dict``, the run's ``config`` as YAML, and what else was ``noted``: ``found``, ``stage``,
    ``step`` and ``random`` (states of the generators before the step).
    """

    batch: Batch
    scene: Scene
    unit: float
    state_dict: dict
    config: str
    noted: dict


def write_bundle(path: Path, module: DynamicSceneModule, batch: Batch, scene: Scene, noted: dict) -> None:
    """Write a step, whole or not at all; ``path`` lies in ``<run>/<stage>/broken``.

    Raises:
        OSError: naming the file, where it cannot be written.
    """
    config = path.parents[2] / "config.yaml"
    content = {
        "batch": _plain_batch(batch.to("cpu")),
        "scene": _plain_scene(scene),
        "unit": module.method.radiance.activation.unit,
        "state_dict": module.state_dict(),
        "config": config.read_text() if config.is_file() else "",
        "noted": noted,
    }
    write_archive(path, content)


def read_bundle(path: Path) -> Bundle:
    """Read what ``write_bundle`` wrote; nothing in the file is executed.

    Raises:
        ValueError: where it is no such file.
    """
    try:
        content = read_archive(path)
        batch, scene = _batch(content["batch"]), _scene(content["scene"])
        rest = {name: content[name] for name in _KINDS}
        bundle = Bundle(batch, scene, **rest)
        _check(bundle)
        return bundle
    except OSError:
        raise
    except Exception as error:  # cameras and boxes refuse in their own ways
        detail = (str(error).splitlines() or [""])[0][:80]
        raise ValueError(
            f"{path}: expected a step that a run left in broken/, but got {type(error).__name__} ({detail})"
        ) from None


def _check(bundle: Bundle) -> None:
    """Raise where a part is not what ``write_bundle`` puts there, naming it."""
    noted, batch = bundle.noted, bundle.batch
    for name, kind in _KINDS.items():
        if not isinstance(getattr(bundle, name), kind):
            raise TypeError(name)
    for name, kind in (("found", str), ("stage", str), ("step", int), ("random", dict)):
        if not isinstance(noted.get(name), kind):
            raise TypeError(f"noted.{name}")
    for name in ("samples", "torch"):
        if not torch.is_tensor(noted["random"].get(name)) or noted["random"][name].dtype != torch.uint8:
            raise TypeError(f"noted.random.{name}")
    rays = batch.rays
    if not rays.origins.shape == rays.directions.shape == batch.rgb.shape == (len(rays), 3):
        raise ValueError("batch")
    if type(batch.frame) is not int or not 0 <= batch.frame < len(bundle.scene.train):
        raise ValueError("batch.frame")
    if not 0 <= batch.time <= 1 or not 0 < bundle.unit < math.inf:
        raise ValueError("batch.time, unit")


def _plain_batch(batch: Batch) -> dict:
    rays = batch.rays
    # An origin that all rays share would be stored once, and read as more than the file holds.
    content = {"origins": rays.origins.contiguous(), "directions": rays.directions.contiguous()}
    content |= {"near": rays.near, "far": rays.far}
    named = {"rgb": batch.rgb.contiguous(), "background": batch.background.contiguous()}
    return content | named | {"time": batch.time, "frame": batch.frame}


def _batch(content: dict) -> Batch:
    rays = Rays(**{name: content[name] for name in ("origins", "directions", "near", "far")})
    return Batch(rays, **{name: content[name] for name in ("rgb", "background", "time", "frame")})


def _plain_scene(scene: Scene) -> dict:
    frames = []
    for frame in scene.train:
        camera, lens = frame.camera, frame.camera.lens
        numbers = {name: getattr(camera, name) for name in _OF_CAMERA}
        bent = None if lens is None else [list(lens.k), list(lens.p)]
        frames.append({"name": frame.name, "time": frame.time, "camera": numbers, "lens": bent})
    box = [list(scene.box.low), list(scene.box.high)]
    about = {"name": scene.name, "canonical_time": scene.canonical_time, "still": scene.still}
    return {"frames": frames, "box": box, **about}


def _scene(content: dict) -> Scene:
    frames = []
    for entry in content["frames"]:
        lens = None if entry["lens"] is None else Lens(*map(tuple, entry["lens"]))
        frames.append(Frame(entry["name"], entry["time"], Camera(**entry["camera"], lens=lens), _no_pixels))
    box = Box(*map(tuple, content["box"]))
    name, time = content["name"], content["canonical_time"]
    return Scene(name, tuple(frames), (), (), box, time, False, still=content["still"])


def _no_pixels():
    raise ValueError("frame: expected a scene with images, but got one of a stored step")
