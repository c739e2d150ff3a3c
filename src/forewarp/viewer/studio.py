"""What all pages share: one scene, or two of it side by side, and the desk."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import torch
from torch import Tensor

from forewarp.drawing.images import in_a_row
from forewarp.scene.camera import Camera
from forewarp.scene.frame import Scene
from forewarp.viewer.desk import Desk, Stale
from forewarp.viewer.look import SPLATS, Look, Point, camera_of, pivot
from forewarp.viewer.subject import Subject

LEAST_SIZE = 400  # rows of a picture at rest, if the images have fewer
_GAP = 4  # white pixels between two pictures
_SAME = 1e-3  # by which two runs' test cameras may differ, of their distance to the origin


class Studio:
    """Subjects of one scene and the desk that pages ask.

    Args:
        scene: of all subjects.
        subjects: none while a run in training has not begun, else one or two.
        size: rows of a picture at rest; None: as the training images have, at least ``LEAST_SIZE``.
    """

    def __init__(self, scene: Scene, subjects: Sequence[Subject] = (), *, size: int | None = None) -> None:
        self.scene, self.subjects = scene, list(subjects)
        self.size = size or max(LEAST_SIZE, *(frame.camera.height for frame in scene.train))
        self.focus, self.up = pivot(scene)  # of all pages' cameras
        self.desk = Desk()
        self.note = ""  # what a run in training is doing
        self.pages: tuple = ()  # that are open now

    @property
    def shows(self) -> tuple[str, ...]:
        """What can be shown of all subjects; splats of one alone."""
        common = [show for show in self.subjects[0].shows if all(show in s.shows for s in self.subjects)]
        return tuple(show for show in common if show != SPLATS or len(self.subjects) == 1)

    @property
    def follows(self) -> bool:
        """Whether points can be followed in all subjects."""
        return all(subject.follows for subject in self.subjects)

    def known(self, look: Look) -> Look:
        """Return a look without what the present methods cannot show, as those of an earlier stage could."""
        look = look if look.show in self.shows else replace(look, show=self.shows[0])
        return look if self.follows else replace(look, tails=False, followed=())

    def prepare(self, look: Look) -> None:
        """Compute what a picture needs besides its pixels."""
        for subject in self.subjects:
            subject.prepare(look)

    def picture(self, look: Look, width: int, height: int, stale: Stale, parts: int = 1) -> Tensor:
        """Draw a look, (height, width, 3) in [0, 1]: all subjects beside each other; of a training view,
        truth, prediction and error, a row for each subject.

        Raises:
            Superseded: if ``stale`` says that it is no longer wanted.
        """
        count = len(self.subjects)
        if look.stand is not None:
            room = (width - 2 * _GAP) // 3, (height - (count - 1) * _GAP) // count
            rows = [in_a_row(subject.compared(look.stand, *room), _GAP) for subject in self.subjects]
            gap = rows[0].new_ones(_GAP, rows[0].shape[1], 3)
            stacked = torch.cat([part for row in rows for part in (gap, row)][1:])
            return on_white(stacked, width, height)
        wide = self.part_width(width)
        camera = self._camera(look, wide, height)
        found = [subject.picture(look, camera, stale, parts) for subject in self.subjects]
        return found[0] if count == 1 else on_white(in_a_row(found, _GAP), width, height)

    def part_width(self, width: int) -> int:
        """Return the columns of one subject's picture."""
        count = len(self.subjects)
        return max(1, (width - (count - 1) * _GAP) // count)

    def _camera(self, look: Look, wide: int, height: int) -> Camera:
        """Make the camera of one subject's picture; beside another it sees what a square one would."""
        camera = camera_of(look, wide, height, self.scene)
        if len(self.subjects) == 1 or wide >= height:
            return camera
        return replace(camera, fx=camera.fx * wide / height, fy=camera.fy * wide / height)

    def point_at(self, look: Look, x: float, y: float, width: int, height: int) -> Point | None:
        """Return the world point seen at ``x y``, fractions of the whole picture; None: nothing solid."""
        wide = self.part_width(width)
        number = min(int(x * len(self.subjects)), len(self.subjects) - 1)
        column = int(x * width) - number * (wide + _GAP)
        camera = self._camera(look, wide, height)
        return self.subjects[number].point_at(camera, (column, int(y * height)), look.time)


def on_white(picture: Tensor, width: int, height: int) -> Tensor:
    """Put a picture (h, w, 3) into the middle of a white one (height, width, 3)."""
    white = picture.new_ones(height, width, 3)
    top, left = (height - picture.shape[0]) // 2, (width - picture.shape[1]) // 2
    white[top : top + picture.shape[0], left : left + picture.shape[1]] = picture
    return white


def refuse_other_scene(scene: Scene, other: Scene) -> None:
    """Refuse two runs of different scenes.

    Raises:
        ValueError: if the names differ, or what the test images were taken with.
    """
    if scene.name != other.name:
        raise ValueError(f"run2: expected a run of {scene.name}, as run= is, but got one of {other.name}")
    same = len(scene.test) == len(other.test) and all(
        abs(a.time - b.time) < _SAME
        and torch.allclose(a.camera.center, b.camera.center, rtol=_SAME, atol=_SAME)
        for a, b in zip(scene.test, other.test)
    )
    if not same:
        raise ValueError(
            f"run2: expected a run of the same {scene.name} as run= is, but got one with other test views"
        )
