"""A step in a file: all that is needed to repeat it without the dataset."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import torch

from forewarp.scene.box import Box
from forewarp.scene.camera import Camera, Lens
from forewarp.scene.frame import Frame, Scene
from forewarp.scene.view import Batch, Moment, Observation, View
from forewarp.training.checkpoints import read_archive, write_archive
from forewarp.training.module import DynamicSceneModule

_OF_CAMERA = ("width", "height", "fx", "fy", "cx", "cy", "camera_to_world", "near", "far", "skew")
_KINDS = {"state_dict": dict, "config": str, "noted": dict}


@dataclass(frozen=True)
class Bundle:
    """A stored step.

    Attributes:
        batch: the step's batch.
        scene: cameras, times and box; its frames have no images.
        state_dict: state of the stage's module.
        config: the run's config, as YAML.
        noted: ``found`` (what is not finite), ``stage``, ``step`` and ``random`` (the states of the random
            generators before the step).
    """

    batch: Batch
    scene: Scene
    state_dict: dict
    config: str
    noted: dict


def write_bundle(path: Path, module: DynamicSceneModule, batch: Batch, scene: Scene, noted: dict) -> None:
    """Write a step as a whole file; ``path`` lies in ``<run>/<stage>/broken``.

    Raises:
        OSError: naming the file, if it cannot be written.
    """
    config = path.parents[2] / "config.yaml"
    content = {
        "batch": _plain_batch(batch.to("cpu")),
        "scene": _plain_scene(scene),
        "state_dict": module.state_dict(),
        "config": config.read_text() if config.is_file() else "",
        "noted": noted,
    }
    write_archive(path, content)


def read_bundle(path: Path) -> Bundle:
    """Read what ``write_bundle`` wrote; nothing in the file is executed.

    Raises:
        ValueError: in one line, if the file is no such step.
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
    except Exception as error:  # cameras and boxes raise errors of their own
        detail = (str(error).splitlines() or [""])[0][:80]
        raise ValueError(
            f"{path}: expected a step that a run left in broken/, but got {type(error).__name__} ({detail})"
        ) from None


def _check(bundle: Bundle) -> None:
    """Raise, naming the part, unless every part is of the kind that ``write_bundle`` writes."""
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
    for one in (*batch.observations, *batch.instant):
        count = len(one.view)
        if one.rgb.shape != (count, 3) or one.background.shape not in ((3,), (count, 3)):
            raise ValueError("batch")
        if not 0 <= one.moment.time <= 1:
            raise ValueError("batch.time")
    if type(batch.frame) is not int or not 0 <= batch.frame < len(bundle.scene.train):
        raise ValueError("batch.frame")


def _plain_batch(batch: Batch) -> dict:
    parts = {name: [_plain(one) for one in getattr(batch, name)] for name in ("observations", "instant")}
    return parts | {"frame": batch.frame}


def _batch(content: dict) -> Batch:
    observations, instant = (tuple(map(_observation, content[name])) for name in ("observations", "instant"))
    if not observations:
        raise ValueError("batch")
    return Batch(observations, content["frame"], instant)


def _plain(one: Observation) -> dict:
    moment, view = one.moment, one.view
    when = {"time": moment.time, "frame": moment.frame, "camera": moment.camera}
    pixels = None if view.pixels is None else view.pixels.contiguous()
    where = {"view": _plain_camera(view.camera), "pixels": pixels, "crop": view.crop}
    return when | where | {"rgb": one.rgb.contiguous(), "background": one.background.contiguous()}


def _observation(content: dict) -> Observation:
    moment = Moment(**{name: content[name] for name in ("time", "frame", "camera")})
    crop, pixels, camera = content["crop"], content["pixels"], _camera(content["view"])
    if pixels is not None and not bool(((pixels >= 0) & (pixels < camera.width * camera.height)).all()):
        raise ValueError("batch.pixels")
    view = View(camera, pixels, None if crop is None else tuple(crop))
    return Observation(moment, view, content["rgb"], content["background"])


def _plain_camera(camera: Camera) -> dict:
    lens = camera.lens
    bent = None if lens is None else [list(lens.k), list(lens.p)]
    return {name: getattr(camera, name) for name in _OF_CAMERA} | {"lens": bent}


def _camera(content: dict) -> Camera:
    lens = None if content["lens"] is None else Lens(*map(tuple, content["lens"]))
    return Camera(**{name: content[name] for name in _OF_CAMERA}, lens=lens)


def _plain_scene(scene: Scene) -> dict:
    frames = [
        {"name": f.name, "time": f.time, "camera_id": f.camera_id, "camera": _plain_camera(f.camera)}
        for f in scene.train
    ]
    box = [list(scene.box.low), list(scene.box.high)]
    about = {"name": scene.name, "canonical_time": scene.canonical_time, "still": scene.still}
    return {"frames": frames, "box": box, **about}


def _scene(content: dict) -> Scene:
    frames = tuple(
        Frame(one["name"], one["time"], _camera(one["camera"]), _no_pixels, camera_id=one["camera_id"])
        for one in content["frames"]
    )
    box = Box(*map(tuple, content["box"]))
    name, time = content["name"], content["canonical_time"]
    return Scene(name, frames, (), (), box, time, False, still=content["still"])


def _no_pixels():
    raise ValueError("frame: expected a scene with images, but got one of a stored step")
