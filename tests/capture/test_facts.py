from pathlib import Path

import numpy as np
import pytest

from forewarp.capture.facts import facts_of, told
from forewarp.capture.job import Source
from forewarp.capture.pictures import Pictures
from forewarp.capture.place import Limits
from forewarp.scene.box import Box
from tests.support.sparse_scene import sparse_arc


def test_facts_are_those_of_the_capture():
    """Cameras on an arc of radius 4 over 70 degrees; two of 14 pictures have no pose."""
    sparse = sparse_arc()
    ours = [*sparse.cameras, "frame_000013.jpg", "frame_000014.jpg"]
    originals = {name: f"IMG {n}.jpg" for n, name in enumerate(ours, 1)}
    times = {name: float(n) for n, name in enumerate(ours)}
    pictures = Pictures(Path("pictures"), times, None, 14, 1.0, (320, 240), originals)
    limits = Limits(0.5, 2.0, Box((-1, -1, -1), (1, 2, 3)))
    facts = facts_of(Source(images=Path("p")), pictures, sparse, limits, [2])
    chord = 2 * 4 * np.sin(np.radians(70 / 11) / 2)
    assert facts["path"] == pytest.approx(11 * chord)
    assert facts["camera"]["degrees"] == pytest.approx(2 * np.degrees(np.arctan(160 / 300)))
    assert facts["left_out"] == ["IMG 13.jpg", "IMG 14.jpg"]
    assert facts["originals"] == originals
    assert told(facts) == [
        "registered: 12 of 14 pictures, 320 x 240 pixels, reprojection error 0.50 pixels",
        f"camera: 56 degrees wide; its path is {11 * chord:.2f} long, where what it sees is 1 away",
        "points: 400; box 2.00 x 3.00 x 4.00, near 0.50, far 2.00",
        "left out: 2 pictures without a pose (IMG 13.jpg, IMG 14.jpg); film slower and with more of what "
        "stands still",
    ]
