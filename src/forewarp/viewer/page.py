"""A page: what a browser is shown, and what its controls do, by viser."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
import torch
import viser
import viser.transforms
from torch import Tensor

from forewarp.browser import splat_arrays
from forewarp.drawing.files import png_bytes, to_bytes
from forewarp.scene.cloud import Ellipsoids
from forewarp.viewer.controls import Controls
from forewarp.viewer.desk import Superseded
from forewarp.viewer.film import write_film
from forewarp.viewer.look import Look, axis_of, vertical_fov
from forewarp.viewer.studio import Studio
from forewarp.viewer.visit import Visit

_MOVED = 1e-3  # of the distance to the pivot: a camera that went farther has left where it stood
_ARRIVES = 0.5  # seconds in which a camera that was sent somewhere may still tell where it was
_QUALITY = {True: 92, False: 80}  # of JPEG, at rest and while moving


class Page:
    """One browser; its ``visit`` decides what it is shown.

    Args:
        studio: what is seen.
        client: the browser.
        folder: where videos go.
    """

    def __init__(self, studio: Studio, client: viser.ClientHandle, folder: Path) -> None:
        self.studio, self.client, self.folder = studio, client, folder
        self.visit = Visit(studio, self)
        self.controls: Controls | None = None
        self._splats, self._stood, self._building = None, float("-inf"), threading.Lock()
        self.status = client.gui.add_markdown("...")
        self.build()

    def build(self) -> None:
        """Make the controls, once there is a method that says what can be shown; adapt them to another."""
        with self._building:  # threads of the server and of a run in training may come at once
            if self.controls is not None:
                self.controls.adapt()
                return
            if not self.studio.subjects:
                self.tell(self.studio.note)
                return
            self.controls = Controls(self)

        @self.client.camera.on_update
        async def _(camera: viser.CameraHandle) -> None:
            self._camera_moved(camera)

        self._camera_moved(self.client.camera)

    # What a visit draws on.

    def canvas(self) -> tuple[int, int]:
        """See ``Surface``."""
        camera = self.client.camera
        return max(1, camera.image_width), max(1, camera.image_height)

    def show(self, picture: Tensor, *, rest: bool) -> None:
        """See ``Surface``."""
        if self._splats is not None:
            self._splats.remove()
            self._splats = None
        self.client.scene.set_background_image(to_bytes(picture), format="jpeg", jpeg_quality=_QUALITY[rest])
        self.client.flush()

    def splats(self, ellipsoids: Ellipsoids) -> None:
        """See ``Surface``."""
        unit = self.studio.scene.box.diagonal / 100
        arrays = splat_arrays(ellipsoids, unit)
        if self._splats is None:
            behind = to_bytes(self.studio.subjects[0].background[None, None])  # as in exact pictures
            self.client.scene.set_background_image(behind, format="png")
        # The same name takes the place of the one before.
        self._splats = self.client.scene.add_gaussian_splats("/splats", *arrays, scale=unit)

    def tell(self, text: str) -> None:
        """See ``Surface``."""
        self.status.content = text

    def time_is(self, time: float) -> None:
        """See ``Surface``."""
        self.controls.time.value = round(time, 3)

    def playing_is(self, playing: bool) -> None:
        """See ``Surface``."""
        self.controls.playing_is(playing)

    # What they do.

    def stand(self, index: int | None) -> None:
        """Stand where a training image was taken, or leave."""
        index = self.visit.stand(index)
        self.controls.stands()
        if index is not None:
            self._stood = time.monotonic()
            self.controls.image.value = index
            frame = self.studio.scene.train[index]
            pose = frame.camera.camera_to_world
            center, ahead = pose[:3, 3], pose[:3, 2]
            away = max(float((self.studio.focus - center) @ ahead), 1e-3 * self.studio.scene.box.diagonal)
            camera = self.client.camera
            with self.client.atomic():
                camera.up_direction = axis_of(pose, self.studio.up).numpy()
                camera.position = center.numpy()
                camera.look_at = (center + away * ahead).numpy()
                camera.fov = vertical_fov(frame.camera)
            self.controls.time.value = round(frame.time, 3)
            self.playing_is(False)

    def _camera_moved(self, camera: viser.CameraHandle) -> None:
        pose = torch.eye(4, dtype=torch.float64)
        pose[:3, :3] = torch.from_numpy(viser.transforms.SO3(camera.wxyz).as_matrix())
        pose[:3, 3] = torch.from_numpy(np.array(camera.position))
        look = self.visit.look
        arriving = time.monotonic() - self._stood < _ARRIVES
        if look.stand is not None and (arriving or self._is_near(pose, look.pose)):
            self.visit.refresh()  # the canvas may have another size
            return
        self.visit.change(pose=pose, fov=float(camera.fov))
        self.controls.stands()

    def _is_near(self, pose: Tensor, other: Tensor) -> bool:
        far = float((other[:3, 3] - self.studio.focus).norm())
        moved = float((pose[:3, 3] - other[:3, 3]).norm()) > _MOVED * far
        return not moved and float(pose[:3, 2] @ other[:3, 2]) > 1 - _MOVED**2

    def save_screenshot(self) -> None:
        """Send the picture as a file, or say why there is none; waits."""
        try:
            self._screenshot()
        except Superseded:
            pass
        except Exception as error:  # what went wrong while it was drawn, or a browser that does not answer
            self.tell(f"no screenshot: {told(error)}")

    def _screenshot(self) -> None:
        look = self.visit.look
        if look.by_browser:
            width, height = self.canvas()
            seen = self.client.get_render(height, width, transport_format="png", timeout=30)
            drawn = torch.from_numpy(seen[..., :3] / 255.0)
        else:
            drawn = self.visit.request(look, urgency=1)
        names = "-".join(subject.name for subject in self.studio.subjects)
        name = f"{self.studio.scene.name}-{names}-{look.show}-{look.time:.3f}.png"
        self.client.send_file_download(name, png_bytes(drawn), save_immediately=True)

    def save_film(self, keys: Sequence[Look], seconds: float, say: Callable[[str], None]) -> None:
        """Write and send a video, or say why there is none; waits. See ``write_film``."""
        try:
            file = write_film(
                self.folder,
                self.visit,
                keys,
                seconds,
                lambda done, of: say(f"{done} of {of} pictures"),
            )
        except Superseded:
            return
        except Exception as error:  # also what went wrong while a picture was drawn
            say(f"no video: {told(error)}")
            return
        say(f"written: {file}")
        self.client.send_file_download(file.name, file.read_bytes(), save_immediately=True)


def told(error: Exception) -> str:
    """Say what went wrong; its kind too, where its words are none of ours."""
    ours = isinstance(error, ValueError) or getattr(error, "errno", None) is not None
    return str(error) if ours else f"{type(error).__name__}: {error}"
