"""A subject, perhaps in a room, as one moving mesh."""

from __future__ import annotations

from functools import partial

import numpy as np

from forewarp.synth.motions import joints
from forewarp.synth.room import room
from forewarp.synth.shapes import joined
from forewarp.synth.specimens import SPECIMENS
from forewarp.synth.vehicle import vehicle


class World:
    """Everything in the scene as one mesh of fixed topology that moves by ``motion``.

    ``faces`` (F, 3) index the vertices of ``place``; ``part_of_face`` (F,) indexes ``parts``; ``rest``
    (V, 3) are coordinates in each part's rest frame, from which colours are computed.

    Args:
        motion: a name in ``motions.MOTIONS`` (the vehicle) or in ``specimens.SPECIMENS``.
        has_room: put a static room around the subject.
    """

    def __init__(self, motion: str = "lift_tilt", has_room: bool = False):
        self.motion, self.has_room = motion, has_room
        self.specimen = specimen = SPECIMENS.get(motion)
        self.joints = partial(joints, motion) if specimen is None else specimen.joints
        self.parts = vehicle() if specimen is None or specimen.parts is None else specimen.parts()
        self.parts += [] if specimen is None else specimen.extra()
        self.parts += room() if has_room else []
        self.rest, self.faces = joined([(p.vertices, p.faces) for p in self.parts])
        self.part_of_face = np.repeat(np.arange(len(self.parts)), [len(p.faces) for p in self.parts])
        self.smooth = np.array([p.smooth for p in self.parts])[self.part_of_face]
        self.casts = np.array([p.casts for p in self.parts])[self.part_of_face]

    def place(self, time: float) -> np.ndarray:
        """Place every vertex at any ``time`` in [0, 1]: world positions (V, 3) float64."""
        at = self.joints(time)
        return np.concatenate([p.vertices @ at[p.joint][:3, :3].T + at[p.joint][:3, 3] for p in self.parts])

    def light(self, time: float) -> np.ndarray | None:
        """Return where the light is (3,); None where it stands still."""
        return None if self.specimen is None or self.specimen.light is None else self.specimen.light(time)

    def there(self, time: float) -> np.ndarray:
        """Tell which faces (F,) are there at ``time``."""
        absent = () if self.specimen is None else self.specimen.absent(time)
        return np.array([part.name not in absent for part in self.parts])[self.part_of_face]

    def points(self, faces: np.ndarray, barycentric: np.ndarray, time: float) -> np.ndarray:
        """Place surface points, given as faces (N,) and barycentric (N, 3), at ``time``: (N, 3)."""
        corners = self.place(time)[self.faces[faces]]  # (N, 3, 3)
        return np.einsum("nc,ncd->nd", barycentric, corners)
