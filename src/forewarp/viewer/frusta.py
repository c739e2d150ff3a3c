"""The training cameras of a scene, as a page shows them."""

from __future__ import annotations

from collections.abc import Callable

import torch
import viser
import viser.transforms

from forewarp.drawing.images import hues
from forewarp.scene.frame import spread
from forewarp.viewer.look import vertical_fov
from forewarp.viewer.studio import Studio

_MOST = 200


class Frusta:
    """Training cameras that can be clicked; nothing is sent before they are first shown.

    Args:
        client: the browser.
        studio: whose scene's cameras.
        clicked: called with the index of a training image.
    """

    def __init__(self, client: viser.ClientHandle, studio: Studio, clicked: Callable[[int], object]) -> None:
        self.client, self.studio, self.clicked = client, studio, clicked
        self._made: list[viser.CameraFrustumHandle] = []

    def show(self, visible: bool) -> None:
        """Show or hide all; one thread at a time."""
        if visible and not self._made:
            frames = self.studio.scene.train
            self._made = [self._add(index) for index in spread(len(frames), _MOST)]
        with self.client.atomic():
            for frustum in self._made:
                frustum.visible = visible

    def _add(self, index: int) -> viser.CameraFrustumHandle:
        frame = self.studio.scene.train[index]
        camera = frame.camera
        frustum = self.client.scene.add_camera_frustum(
            f"/cameras/{index}",
            fov=vertical_fov(camera),
            aspect=camera.width / camera.height,
            scale=0.05 * float((camera.center - self.studio.focus).norm()),
            thickness=1.5,
            thickness_units="screen",
            color=tuple(hues(torch.tensor(0.8 * frame.time)).mul(255).int().tolist()),
            wxyz=viser.transforms.SO3.from_matrix(camera.camera_to_world[:3, :3].numpy()).wxyz,
            position=camera.center.numpy(),
            visible=False,
            variant="filled",  # a line alone is hard to hit
        )

        @frustum.on_click
        async def _(_: viser.SceneNodePointerEvent) -> None:
            self.clicked(index)

        return frustum
