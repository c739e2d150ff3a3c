"""The layout of LLFF, as NSFF and DynamicNeRF have it: ``images/`` of one camera, a row of poses for each."""

from __future__ import annotations

from pathlib import Path

from forewarp.data.agreement import small_image
from forewarp.data.cameras import opengl_rows
from forewarp.data.files import SUFFIXES, images_alone, mismatch
from forewarp.data.images import by, inspect_image, read_image
from forewarp.data.multicam import FILE, ends_of, ordered_rows
from forewarp.data.names import in_order

_SAME_SHAPE = 0.02  # share by which the proportions of images and rows may differ


def as_transforms(
    folder: Path, near: float | None = None, far: float | None = None
) -> tuple[dict, list[str]]:
    """Make of a scene's ``poses_bounds.npy`` and ``images/`` what a ``transforms.json`` would hold.

    Images may be smaller than rows say; ``near`` and ``far`` are as typed. Also say in lines what was
    assumed.

    Raises:
        SceneError: for other numbers of rows and images, for rows that are none, images of another shape, and
            as ``ends_of``.
    """
    there = (path for path in (folder / "images").glob("[!.]*") if path.suffix in SUFFIXES)
    paths, told = images_alone(in_order(there, lambda path: path.name), folder / "images")
    if not paths:
        raise mismatch(folder / "images", "an image for each row of poses_bounds.npy", "none")
    advice = "rename images with as many digits each"
    images = lambda: [small_image(read_image(path)) for path in paths]  # noqa: E731
    names = [path.name for path in paths]
    cameras, assumed = ordered_rows(folder / FILE, names, images, None, advice)
    frames = []
    for path, camera in zip(paths, cameras):
        width, height = inspect_image(path).size
        if abs(width * camera.height / (height * camera.width) - 1) > _SAME_SHAPE:
            expected = f"the proportions of {by((camera.width, camera.height))} pixels, as its row says"
            raise mismatch(path, expected, by((width, height)))
        pose = opengl_rows(camera.camera_to_world, str(path))
        focal = camera.fx * width / camera.width
        frames.append({"file_path": f"images/{path.name}", "transform_matrix": pose, "fl_x": focal})
    near, far = ends_of(cameras, names, str(folder / FILE), near, far)
    return {"frames": frames, "near": near, "far": far}, told + assumed
