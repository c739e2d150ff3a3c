"""A page's controls and what they do, by viser."""

from __future__ import annotations

import threading
import time
from pathlib import Path

import numpy as np
import torch
import viser
import viser.transforms
from torch import Tensor

from forewarp.browser import splat_arrays
from forewarp.drawing.colors import hues
from forewarp.drawing.files import png_bytes, to_bytes
from forewarp.scene.ellipsoids import Ellipsoids
from forewarp.scene.frame import spread
from forewarp.viewer.desk import Superseded
from forewarp.viewer.film import write_film
from forewarp.viewer.look import axis_of, pivot, vertical_fov
from forewarp.viewer.studio import Studio
from forewarp.viewer.subject import SPLATS
from forewarp.viewer.visit import Visit

_MOST_FRUSTA = 200
_SPEEDS = ("0.1", "0.25", "0.5", "1", "2", "4")
_MOVED = 1e-3  # of the distance to the pivot: a camera that went farther has left where it stood
_ARRIVES = 0.5  # seconds in which a camera that was sent somewhere may still tell where it was
_QUALITY = {True: 92, False: 80}  # of JPEG, at rest and while moving


class Page:
    """One browser's controls; its ``visit`` decides what it is shown.

    Args:
        studio: what is seen.
        client: the browser.
        folder: where videos go.
    """

    def __init__(self, studio: Studio, client: viser.ClientHandle, folder: Path) -> None:
        self.studio, self.client, self.folder = studio, client, folder
        self.visit = Visit(studio, self)
        self.focus, self.up = pivot(studio.scene)
        self.keys, self._splats, self._stood = [], None, float("-inf")
        self._building, self._built = threading.Lock(), False
        self.status = client.gui.add_markdown("...")
        self.build()

    def build(self) -> None:
        """Make the controls, once there is a method that says what can be shown."""
        with self._building:  # threads of the server and of a run in training may come at once
            if self._built:
                return
            self._built = bool(self.studio.subjects)
        if not self._built:
            self.tell(self.studio.note)
            return
        if len(self.studio.subjects) == 2:
            left, right = (subject.name for subject in self.studio.subjects)
            self.client.gui.add_markdown(f"left: **{left}**, right: **{right}**")
        self._add_time()
        self._add_show()
        self._add_cameras()
        self._add_film()

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
        self.time.value = round(time, 3)

    def playing_is(self, playing: bool) -> None:
        """See ``Surface``."""
        self.play.label = "pause" if playing else "play"

    # The controls.

    def _add_time(self) -> None:
        gui, visit = self.client.gui, self.visit
        with gui.add_folder("Time"):
            self.time = gui.add_slider("time", 0.0, 1.0, 0.001, round(visit.look.time, 3))
            self.play = gui.add_button("play")
            speed = gui.add_dropdown("speed", _SPEEDS, initial_value="1")
            loop = gui.add_checkbox("loop", True)

        @self.time.on_update
        async def _(event: viser.GuiEvent) -> None:
            if event.client is not None:  # not our own, while time plays
                visit.change(time=float(self.time.value))
                self._stands()

        @self.play.on_click
        async def _(_: viser.GuiEvent) -> None:
            visit.play(not visit.player.playing)
            self._stands()
            self.playing_is(visit.player.playing)

        @speed.on_update
        async def _(_: viser.GuiEvent) -> None:
            visit.set_speed(float(speed.value))

        @loop.on_update
        async def _(_: viser.GuiEvent) -> None:
            visit.player.loop = loop.value

    def _add_show(self) -> None:
        gui, visit = self.client.gui, self.visit
        with gui.add_folder("Show"):
            show = gui.add_dropdown("show", self.studio.shows, initial_value=visit.look.show)
            if SPLATS in self.studio.shows:
                gui.add_markdown("*splats*: drawn by the browser, with one colour from all sides")
            if self.studio.follows:
                tails = gui.add_checkbox("trajectories", False)
                self._add_following()
            picture = gui.add_button("screenshot")

        @show.on_update
        async def _(_: viser.GuiEvent) -> None:
            visit.change(show=show.value)
            self._stands()

        if self.studio.follows:

            @tails.on_update
            async def _(_: viser.GuiEvent) -> None:
                visit.change(tails=tails.value)

        @picture.on_click
        def _(_: viser.GuiEvent) -> None:  # in a thread of its own, as it waits
            self._screenshot()

    def _add_following(self) -> None:
        gui, visit, scene = self.client.gui, self.visit, self.client.scene
        choose = gui.add_button("follow the point that I click")
        forget = gui.add_button("follow none")

        async def clicked(event: viser.SceneClickEvent) -> None:
            scene.remove_click_callback(clicked)
            choose.label = "follow the point that I click"
            visit.follow(*event.screen_pos)

        @choose.on_click
        async def _(_: viser.GuiEvent) -> None:
            scene.remove_click_callback("all")
            scene.on_click()(clicked)
            choose.label = "now click a point"

        @forget.on_click
        async def _(_: viser.GuiEvent) -> None:
            visit.change(followed=())

    def _add_cameras(self) -> None:
        gui, last = self.client.gui, len(self.studio.scene.train) - 1
        with gui.add_folder("Training images"):
            gui.add_markdown("Choose one, or click its camera, for truth | prediction | error.")
            self.image = gui.add_slider("image", 0, max(last, 1), 1, 0)
            # Over two pictures beside each other there is no one place for a camera.
            self.shown = gui.add_checkbox("show cameras", False, visible=len(self.studio.subjects) == 1)
            self.leave = gui.add_button("leave it", visible=False)
        self._frusta = self._add_frusta()

        @self.shown.on_update
        async def _(_: viser.GuiEvent) -> None:
            self._show_frusta()

        @self.image.on_update
        async def _(event: viser.GuiEvent) -> None:
            if event.client is not None:
                self.stand(min(self.image.value, last))

        @self.leave.on_click
        async def _(_: viser.GuiEvent) -> None:
            self.stand(None)

    def _add_frusta(self) -> list[viser.CameraFrustumHandle]:
        frames, made = self.studio.scene.train, []
        for index in spread(len(frames), _MOST_FRUSTA):
            camera = frames[index].camera
            color = hues(torch.tensor(0.8 * frames[index].time)).mul(255).int().tolist()
            frustum = self.client.scene.add_camera_frustum(
                f"/cameras/{index}",
                fov=vertical_fov(camera),
                aspect=camera.width / camera.height,
                scale=0.05 * float((camera.center - self.focus).norm()),
                thickness=1.5,
                thickness_units="screen",
                color=tuple(color),
                wxyz=viser.transforms.SO3.from_matrix(camera.camera_to_world[:3, :3].numpy()).wxyz,
                position=camera.center.numpy(),
                visible=False,
                variant="filled",  # a line alone is hard to hit
            )

            @frustum.on_click
            async def _(_: viser.SceneNodePointerEvent, index: int = index) -> None:
                self.stand(index)

            made.append(frustum)
        return made

    def _add_film(self) -> None:
        gui, visit = self.client.gui, self.visit
        with gui.add_folder("Video", expand_by_default=False):
            count = gui.add_markdown("0 key views")
            add, clear = gui.add_button("add this view and time"), gui.add_button("clear")
            seconds = gui.add_number("seconds", 4.0, min=0.1, max=600.0, step=0.5)
            make = gui.add_button("make the video")

        def say(text: str | None = None) -> None:
            count.content = text or f"{len(self.keys)} key views"

        @add.on_click
        async def _(_: viser.GuiEvent) -> None:
            self.keys.append(visit.look)
            say()

        @clear.on_click
        async def _(_: viser.GuiEvent) -> None:
            self.keys.clear()
            say()

        @make.on_click
        def _(_: viser.GuiEvent) -> None:  # in a thread of its own, as it waits
            make.disabled = True
            try:
                self._film(float(seconds.value), say)
            finally:
                make.disabled = False

    # What they do.

    def stand(self, index: int | None) -> None:
        """Stand where a training image was taken, or leave."""
        self.visit.stand(index)
        self._stands()
        if index is not None:
            self._stood = time.monotonic()
            self.image.value = index
            frame = self.studio.scene.train[index]
            pose = frame.camera.camera_to_world
            center, ahead = pose[:3, 3], pose[:3, 2]
            away = max(float((self.focus - center) @ ahead), 1e-3 * self.studio.scene.box.diagonal)
            camera = self.client.camera
            with self.client.atomic():
                camera.up_direction = axis_of(pose, self.up).numpy()
                camera.position = center.numpy()
                camera.look_at = (center + away * ahead).numpy()
                camera.fov = vertical_fov(frame.camera)
            self.time.value = round(frame.time, 3)
            self.playing_is(False)

    def _stands(self) -> None:
        """Show the controls that go with where the page stands."""
        stands = self.visit.look.stand is not None
        if self.leave.visible != stands:
            self.leave.visible = stands
            self._show_frusta()

    def _show_frusta(self) -> None:
        visible = self.shown.value and self.visit.look.stand is None
        with self.client.atomic():
            for frustum in self._frusta:
                frustum.visible = visible

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
        self._stands()

    def _is_near(self, pose: Tensor, other: Tensor) -> bool:
        far = float((other[:3, 3] - self.focus).norm())
        moved = float((pose[:3, 3] - other[:3, 3]).norm()) > _MOVED * far
        return not moved and float(pose[:3, 2] @ other[:3, 2]) > 1 - _MOVED**2

    def _screenshot(self) -> None:
        look = self.visit.look
        if look.show == SPLATS:
            width, height = self.canvas()
            seen = self.client.get_render(height, width, transport_format="png", timeout=30)
            drawn = torch.from_numpy(seen[..., :3] / 255.0)
        else:
            try:
                drawn = self.visit.request(look, urgency=1)
            except Superseded:
                return
        names = "-".join(subject.name for subject in self.studio.subjects)
        name = f"{self.studio.scene.name}-{names}-{look.show}-{look.time:.3f}.png"
        self.client.send_file_download(name, png_bytes(drawn), save_immediately=True)

    def _film(self, seconds: float, say) -> None:
        try:
            file = write_film(
                self.folder,
                self.visit,
                list(self.keys),
                seconds,
                lambda done, of: say(f"{done} of {of} pictures"),
            )
        except Superseded:
            return
        except (ValueError, OSError) as error:
            say(str(error))
            return
        say(f"written: {file}")
        self.client.send_file_download(file.name, file.read_bytes(), save_immediately=True)
