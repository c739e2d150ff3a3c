"""Reversed time is the same task to what has no canonical time; it moves the canonical time of the others."""

from dataclasses import replace
from functools import partial

import pytest
import torch

from forewarp.methods.method import Start
from forewarp.methods.ndvg import NDVG
from forewarp.methods.tineuvox import TiNeuVox
from forewarp.scene.view import Moment, View
from tests.support.sampled_methods import KINDS, learned
from tests.support.still_cameras import camera, moving_scene, static_ceiling

GRIDS = {
    "tineuvox": partial(TiNeuVox, width=16, position_frequencies=3),
    "ndvg": partial(NDVG, width=(16, 16)),
}
ALL = KINDS | GRIDS
TIED = {"dnerf", "ndvg"}  # to the canonical time


def reversed_scene():
    """The sliding square, from its end to its beginning."""
    scene = moving_scene()
    frames = tuple(replace(frame, time=1 - frame.time) for frame in scene.train)
    return replace(scene, train=frames, test=frames[:1], canonical_time=1.0)


def drawn(kind, canonical_time, time):
    """A picture by a method with chance weights."""
    torch.manual_seed(0)
    scene = replace(moving_scene(), canonical_time=canonical_time)
    made = ALL[kind](Start(scene, "fine", {"num_voxels": [[0, 9**3]], "alpha_init": 0.1}))
    with torch.no_grad():
        for parameter in made.parameters() if kind in GRIDS else ():  # which start at 0
            parameter.add_(0.3 * torch.randn_like(parameter))
        return made.at(Moment(time)).render(View(camera()), torch.ones(3)).rgb


@pytest.mark.parametrize("kind", ALL)
def test_the_canonical_time_counts_where_there_is_one(kind):
    for time in (0.0, 1.0):
        first, last = (drawn(kind, canonical_time, time) for canonical_time in (0.0, 1.0))
        assert first.equal(last) == (kind not in TIED)


@pytest.mark.slow
def test_tnerf_learns_a_scene_as_well_from_its_end_on(tmp_path):
    psnr = [
        learned("tnerf", tmp_path / str(i), read)[1] for i, read in enumerate((moving_scene, reversed_scene))
    ]
    assert min(psnr) > static_ceiling() + 3
    assert abs(psnr[0] - psnr[1]) < 3, psnr
