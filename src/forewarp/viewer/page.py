"""A page: what a browser shows, and what its controls do, by viser."""

from __future__ import annotations

import math
import re
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import torch
import viser
from torch import Tensor
from viser.transforms import SO3

from forewarp.drawing.images import hues, png_bytes, to_bytes
from forewarp.evaluation.layers import LAYERS
from forewarp.scene.camera import Camera
from forewarp.scene.cloud import Ellipsoids
from forewarp.scene.frame import spread
from forewarp.viewer.queue import Cancelled
from forewarp.viewer.rendering import SPLATS, Viewer, ViewState, first_frame, turning_axis, vertical_fov
from forewarp.viewer.session import MAX_VIDEO_SECONDS, MIN_VIDEO_SECONDS, Session

_MOVED = 1e-3  # of the distance to the pivot: a camera that went farther has left the training view
_ARRIVAL = 0.5  # seconds in which a camera that was sent somewhere may still tell where it was
_JPEG_QUALITY = {True: 92, False: 80}  # at rest and while moving
_SPEEDS = ("0.1", "0.25", "0.5", "1", "2", "4")
_MAX_CAMERAS, _CAMERA_SIZE = 24, 0.02  # training cameras that are drawn, and their size by their distance
_MOST_ZOOM = 4.0  # of a film's frame
_FOLLOW = "follow the point that I click"
_ABOUT_SPLATS = "*splats*: drawn by the browser, with one colour from all sides and no trajectories"


class Page:
    """One browser with its controls; its ``session`` decides which image it is shown.

    Args:
        viewer: what is seen.
        client: the browser.
        folder: where videos go.
    """

    def __init__(self, viewer: Viewer, client: viser.ClientHandle, folder: Path) -> None:
        self.viewer, self.client, self.folder = viewer, client, folder
        self.session = Session(viewer, self)
        self._splats, self._sent = None, float("-inf")
        self._is_wide = self.canvas()[0] >= self.canvas()[1]  # else a phone's, of whatever pixels
        self._cameras: list[viser.CameraFrustumHandle] = []
        self._showing_cameras = threading.Lock()
        self.status = client.gui.add_markdown("...")
        if len(viewer.renderers) == 2:
            left, right = (renderer.name for renderer in viewer.renderers)
            client.gui.add_markdown(f"left: **{markdown_text(left)}**, right: **{markdown_text(right)}**")
        self._add_time()
        self._add_channels()
        self._add_training_images()
        self._add_video()
        self.adapt()
        if viewer.film is not None or not self._is_wide:
            self.go_home()

        @client.camera.on_update
        async def _(camera: viser.CameraHandle) -> None:
            self._camera_moved(camera)

        self._camera_moved(client.camera)

    def adapt(self) -> None:
        """Offer what the present methods can show; a later stage of a run may have another one."""
        channels, can_follow = self.viewer.channels, self.viewer.can_follow
        if self.channel.options != channels:
            # viser chooses the first where the chosen one is gone, as ``Viewer.supported`` does
            self.channel.options = channels
        self.about_splats.visible = SPLATS in channels
        self.layer.visible = len(self.viewer.layers) > 1
        for control in (self.trajectories, self.follow, self.follow_none):
            control.visible = can_follow
        if not can_follow and self.trajectories.value:
            self.trajectories.value = False

    # What the session shows.

    def canvas(self) -> tuple[int, int]:
        """Return width and height of the page's image, in pixels."""
        camera = self.client.camera
        return max(1, camera.image_width), max(1, camera.image_height)

    def show_image(self, image: Tensor, *, rest: bool) -> None:
        """Show an image (H, W, 3) in [0, 1], stretched over the canvas."""
        if self._splats is not None:
            self._splats.remove()
            self._splats = None
        scene, quality = self.client.scene, _JPEG_QUALITY[rest]
        scene.set_background_image(to_bytes(image), format="jpeg", jpeg_quality=quality)
        self.client.flush()

    def show_splats(self, ellipsoids: Ellipsoids) -> None:
        """Let the browser draw Gaussians in the place of an image, before the same background."""
        unit = self.viewer.scene.box.diagonal / 100
        if self._splats is None:
            background = to_bytes(self.viewer.renderers[0].background[None, None])
            self.client.scene.set_background_image(background, format="png")
        # The same name takes the place of the one before.
        arrays = splat_arrays(ellipsoids, unit)
        self._splats = self.client.scene.add_gaussian_splats("/splats", *arrays, scale=unit)

    def tell(self, text: str) -> None:
        """Say how fast images come, or what is going on."""
        self.status.content = markdown_text(text)

    def show_time(self, time: float) -> None:
        """Move the slider to the time."""
        self.time.value = round(time, 3)

    def show_playing(self, playing: bool) -> None:
        """Name what the button does next."""
        self.play.label = "pause" if playing else "play"

    # The camera, and where training images were taken.

    def show_training_view(self, index: int | None) -> None:
        """Stand where a training image was taken, or leave."""
        index = self.session.show_training_view(index)
        self._show_whether_compared()
        if index is None:
            return
        self._sent = time.monotonic()
        self.image.value = index
        frame = self.viewer.scene.train[index]
        self._stand_at(frame.camera, vertical_fov(frame.camera))
        self.show_time(frame.time)
        self.show_playing(False)

    def go_home(self) -> None:
        """Stand where the first test image was taken, else the first training image, and show all of it."""
        camera = first_frame(self.viewer.scene).camera
        self.show_training_view(None)
        if self.viewer.film is not None:
            self.fly(False)
        else:
            self._stand_at(camera, fitted_fov(camera, *self.canvas()))

    def fly(self, freely: bool) -> None:
        """Fly freely from where the page is, or ride along where the film's camera went."""
        self.free.value = freely
        self._show_cameras()
        if freely:
            state = self.session.state
            camera = self.viewer.film.leant(state.time, *(state.lean or (0.0, 0.0)))
            self._stand_at(camera, fitted_fov(camera, *self.canvas()))
            self._change(lean=None, pose=camera.camera_to_world)
        else:
            self._change(lean=(0.0, 0.0), zoom=1.0)
            self.let_go()

    def let_go(self) -> None:
        """Bring the browser's camera, whose turns lean the view, back to where it leans nothing."""
        base = self.viewer.film.at(0.0)
        self._sent = time.monotonic()
        self._stand_at(base, vertical_fov(base))

    def _lean(self, pose: Tensor) -> None:
        """Lean as far as the browser's camera, ``pose`` (4, 4), was turned."""
        base = self.viewer.film.at(0.0)
        pivot, axes = self.viewer.film.pivot(base), base.camera_to_world[:3, :3]
        right, down, ahead = (axes.T @ (pose[:3, 3] - pivot)).tolist()
        away = math.hypot(right, down, ahead)
        across = math.degrees(math.atan2(right, -ahead))
        upward = math.degrees(math.asin(max(-1.0, min(1.0, -down / max(away, 1e-9)))))
        zoom = float((base.center - pivot).norm()) / max(away, 1e-9)
        self.session.lean(across, upward, min(max(zoom, 1.0), _MOST_ZOOM))
        self._show_whether_compared()

    def _stand_at(self, of_image: Camera, fov: float) -> None:
        pose = of_image.camera_to_world
        center, ahead = pose[:3, 3], pose[:3, 2]
        distance = max(float((self.viewer.focus - center) @ ahead), 1e-3 * self.viewer.scene.box.diagonal)
        camera = self.client.camera
        with self.client.atomic():
            camera.up_direction = turning_axis(pose, self.viewer.up).numpy()
            camera.position = center.numpy()
            camera.look_at = (center + distance * ahead).numpy()
            camera.fov = fov

    def _camera_moved(self, camera: viser.CameraHandle) -> None:
        pose = torch.eye(4, dtype=torch.float64)
        pose[:3, :3] = torch.from_numpy(SO3(camera.wxyz).as_matrix())
        pose[:3, 3] = torch.from_numpy(np.array(camera.position))
        if self.session.state.training_view is not None:
            before = self.session.state.pose
            distance = float((before[:3, 3] - self.viewer.focus).norm())
            shifted = float((pose[:3, 3] - before[:3, 3]).norm()) > _MOVED * distance
            turned = float(pose[:3, 2] @ before[:3, 2]) <= 1 - _MOVED**2
            arriving = time.monotonic() - self._sent < _ARRIVAL
            if arriving or not (shifted or turned):
                self.session.refresh()  # the canvas may have another size
                return
        if self.session.state.lean is None:
            self._change(pose=pose, fov=float(camera.fov))
        elif time.monotonic() - self._sent < _ARRIVAL:
            self.session.refresh()
        else:
            self._lean(pose)

    def _change(self, **changes) -> None:
        self.session.change(**changes)
        self._show_whether_compared()

    def _show_whether_compared(self) -> None:
        """Show the controls that go with whether the page stands in a training view."""
        compared = self.session.state.training_view is not None
        if self.leave.visible != compared:
            self.leave.visible = compared
            self._show_cameras()

    def _show_cameras(self) -> None:
        """Show or hide the training cameras; nothing is sent before they are first shown."""
        with self._showing_cameras:  # threads of the server may come at once
            flies = self.session.state.lean is None and self.session.state.training_view is None
            visible = self.cameras_shown.value and flies
            if visible and not self._cameras:
                indices = spread(len(self.viewer.scene.train), _MAX_CAMERAS)
                self._cameras = [self._add_camera(index) for index in indices]
            with self.client.atomic():
                for camera in self._cameras:
                    camera.visible = visible

    def _add_camera(self, index: int) -> viser.CameraFrustumHandle:
        frame = self.viewer.scene.train[index]
        camera, color = frame.camera, hues(torch.tensor(0.8 * frame.time)).mul(255).int()
        turn = SO3.from_matrix(camera.camera_to_world[:3, :3].numpy()).wxyz
        shape = {"fov": vertical_fov(camera), "aspect": camera.width / camera.height}
        shape["scale"] = _CAMERA_SIZE * float((camera.center - self.viewer.focus).norm())
        # A line alone is hard to hit.
        look = {"thickness": 1.5, "thickness_units": "screen", "variant": "filled", "visible": False}
        place = {"wxyz": turn, "position": camera.center.numpy(), "color": tuple(color.tolist())}
        frustum = self.client.scene.add_camera_frustum(f"/cameras/{index}", **shape, **place, **look)
        on_press(frustum, lambda: self.show_training_view(index))
        return frustum

    # The controls.

    def _add_time(self) -> None:
        gui, session = self.client.gui, self.session
        with gui.add_folder("Time"):
            self.time = gui.add_slider("time", 0.0, 1.0, 0.001, round(session.state.time, 3))
            self.play = gui.add_button("play")
            home = gui.add_button("home")
            is_film = self.viewer.film is not None
            self.free = gui.add_checkbox("fly freely (R)", False, visible=is_film)
            speed = gui.add_dropdown("speed", _SPEEDS, initial_value="1")
            loop = gui.add_checkbox("loop", True)

        def toggle() -> None:
            session.play(not session.playing)
            self._show_whether_compared()
            self.show_playing(session.playing)

        on_edit(self.time, lambda time: self._change(time=float(time)))
        on_press(self.play, toggle)
        on_press(home, self.go_home)
        on_edit(self.free, self.fly)
        if is_film:
            by_key = gui.add_command("fly freely, or along the film", hotkey="R")
            by_key.on_trigger(lambda _: self.fly(not self.free.value))
        on_edit(speed, lambda speed: session.set_speed(float(speed)))
        on_edit(loop, lambda loop: setattr(session, "loop", loop))

    def _add_channels(self) -> None:
        gui, scene, session = self.client.gui, self.client.scene, self.session
        with gui.add_folder("Show", expand_by_default=self._is_wide):
            chosen = session.state.channel
            self.channel = gui.add_dropdown("show", self.viewer.channels, initial_value=chosen)
            self.about_splats = gui.add_markdown(_ABOUT_SPLATS)
            self.layer = gui.add_dropdown("layer", LAYERS, initial_value=session.state.layer)
            self.trajectories = gui.add_checkbox("trajectories", False)
            self.follow = gui.add_button(_FOLLOW)
            self.follow_none = gui.add_button("follow none")
            screenshot = gui.add_button("screenshot")

        async def clicked(event: viser.SceneClickEvent) -> None:
            scene.remove_click_callback(clicked)
            self.follow.label = _FOLLOW
            session.follow(*event.screen_pos)

        def wait_for_click() -> None:
            scene.remove_click_callback("all")
            scene.on_click()(clicked)
            self.follow.label = "now click a point"

        def show(channel: str) -> None:
            self._change(channel=channel)
            if channel == SPLATS and self.session.state.lean is not None:
                self.fly(True)  # the browser draws them from its own camera

        on_edit(self.channel, show)
        on_edit(self.layer, lambda layer: self._change(layer=layer))
        on_edit(self.trajectories, lambda shown: session.change(trajectories=shown))
        on_press(self.follow, wait_for_click)
        on_press(self.follow_none, lambda: session.change(followed=()))
        screenshot.on_click(lambda _: self.save_screenshot())  # in a thread of its own, as it waits

    def _add_training_images(self) -> None:
        gui, last = self.client.gui, len(self.viewer.scene.train) - 1
        with gui.add_folder("Training images", expand_by_default=self._is_wide):
            gui.add_markdown("Choose one, or click its camera, for truth | prediction | error.")
            self.image = gui.add_slider("image", 0, max(last, 1), 1, 0)
            # Over two images side by side there is no one place for a camera.
            is_alone = len(self.viewer.renderers) < 2
            self.cameras_shown = gui.add_checkbox("show cameras", False, visible=is_alone)
            go = gui.add_button("go there")
            self.leave = gui.add_button("leave it", visible=False)
        on_edit(self.image, lambda index: self.show_training_view(int(index)))
        on_press(go, lambda: self.show_training_view(int(self.image.value)))
        on_press(self.leave, lambda: self.show_training_view(None))
        self.cameras_shown.on_update(lambda _: self._show_cameras())  # in a thread, as they are many

    def _add_video(self) -> None:
        gui, keys = self.client.gui, []
        with gui.add_folder("Video", expand_by_default=False):
            status = gui.add_markdown("0 key views")
            add, clear = gui.add_button("add this view and time"), gui.add_button("clear")
            limits = {"min": MIN_VIDEO_SECONDS, "max": MAX_VIDEO_SECONDS}
            seconds = gui.add_number("seconds", 4.0, step=0.5, **limits)
            make = gui.add_button("make the video")

        def tell(text: str) -> None:
            status.content = markdown_text(text)

        def set_keys(*states: ViewState) -> None:
            keys[:] = states
            tell(f"{len(keys)} key views")

        def show_progress(done: int, total: int) -> None:
            tell(f"{done} of {total} images")

        def make_video(_: viser.GuiEvent) -> None:
            make.disabled, file = True, None
            try:
                length = float(seconds.value)
                with told_if_it_fails("video", tell):  # also while an image is rendered
                    file = self.session.write_video(self.folder, list(keys), length, show_progress)
                if file is not None:
                    tell(f"written: {file}")
                    self.client.send_file_download(file.name, file.read_bytes(), save_immediately=True)
            finally:
                make.disabled = False

        on_press(add, lambda: set_keys(*keys, self.session.state))
        on_press(clear, set_keys)
        make.on_click(make_video)  # in a thread of its own, as it waits

    def save_screenshot(self) -> None:
        """Send the image as a file, or say why there is none."""
        state, image = self.session.state, None
        with told_if_it_fails("screenshot", self.tell):  # also by a browser that does not answer
            if state.drawn_by_browser:
                width, height = self.canvas()
                drawn = self.client.get_render(height, width, transport_format="png", timeout=30)
                image = torch.from_numpy(drawn[..., :3] / 255.0)
            else:
                image = self.session.image(state, priority=1)
        if image is not None:
            names = "-".join(renderer.name for renderer in self.viewer.renderers)
            name = f"{self.viewer.scene.name}-{names}-{state.channel}-{state.time:.3f}.png"
            self.client.send_file_download(name, png_bytes(image), save_immediately=True)


def fitted_fov(camera: Camera, width: float, height: float) -> float:
    """Return the angle from top to bottom, radians, by which a canvas shows a camera's whole image.

    A canvas narrower than the image, as a phone's, shows more above and below it.
    """
    across = 0.5 * camera.width / camera.fx
    return 2 * math.atan(max(0.5 * camera.height / camera.fy, across * height / width))


def splat_arrays(cloud: Ellipsoids, unit: float) -> list[np.ndarray]:
    """Return what viser's ``add_gaussian_splats(..., scale=unit)`` takes: centers, covariances, colours,
    opacity. In half precision, which it sends, squares of small lengths vanish: ``unit`` is to be about a
    hundredth of the scene, world units.
    """
    parts = cloud.centers / unit, cloud.covariances / unit**2, cloud.colors, cloud.opacity[:, None]
    return [part.cpu().numpy() for part in parts]


def markdown_text(text: str) -> str:
    """Write text so that Markdown, in which viser takes HTML too, shows it as it is, in one line.

    >>> markdown_text("a_1.png <b>")
    'a&#95;1&#46;png &#60;b&#62;'
    """
    return re.sub(r"[^\w\s]|_", lambda sign: f"&#{ord(sign[0])};", " ".join(text.split()))


@contextmanager
def told_if_it_fails(what: str, tell: Callable[[str], None]) -> Iterator[None]:
    """Say why there is none of ``what``, unless it is no longer wanted; the kind of an error too, where its
    words are none of ours.
    """
    try:
        yield
    except Cancelled:
        pass
    except Exception as error:
        is_ours = isinstance(error, ValueError) or getattr(error, "errno", None) is not None
        tell(f"no {what}: " + (str(error) if is_ours else f"{type(error).__name__}: {error}"))


def on_edit(control, act: Callable) -> None:
    """Call ``act`` with a control's value when the browser has changed it, not when this program has."""

    @control.on_update
    async def _(event: viser.GuiEvent) -> None:
        if event.client is not None:
            act(control.value)


def on_press(button, act: Callable[[], object]) -> None:
    """Call ``act`` when a button or a camera is clicked. It must not wait: others wait for it."""

    @button.on_click
    async def _(_: viser.GuiEvent) -> None:
        act()
