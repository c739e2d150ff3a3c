"""What a voxel method cannot be built from is refused by the name of its key."""

from dataclasses import replace
from functools import partial

import pytest

from forewarp.fields.curves import TrajectoryField
from forewarp.methods.method import Start
from forewarp.methods.voxel.effects import LearnedUpsampler, Motion, TrilinearUpsampler, UNet3d
from forewarp.methods.voxel.losses import voxel_terms
from forewarp.methods.voxel.structure import VoxelStage
from forewarp.scene.box import Lattice
from tests.support.tiny_scene import BOX, INPAINTER, backward_model, ball_scene, built, forward_model

SCENE = replace(ball_scene(frames=2, size=8), has_alpha=False)
PATHS = partial(TrajectoryField, BOX, bases=2, frames=5, canonical_time=0.0, nodes=8)
ODD = forward_model(upsampler=partial(TrilinearUpsampler, scale=1.5), inpainter=INPAINTER)
OPACITIES, OPACITY = (
    "stage.coarse: expected 0 < birth_alpha < keep_alpha < 1",
    r"expected a number in \(0, 1\), but",
)


def made(model):
    """Make the method of a first stage."""
    return model(Start(SCENE, "coarse", {"num_voxels": [[0, 100]]}, [0]))


GHOST = "model.{0}: expected a factory or null, but got .*choose model/{0}=none"
STAGES = [
    ({"num_voxels": []}, r"stage.coarse.num_voxels: expected \[\[fraction, count\], ...\] .* but got \[\]"),
    ({"num_voxels": [[0.5, 100], [0, 100]]}, "stage.coarse.num_voxels: expected .* ascending fractions"),
    ({"num_voxels": 100}, "stage.coarse.num_voxels: expected .* but got 100"),
    ({"num_voxels": [[2, 100]]}, "stage.coarse.num_voxels: expected"),
    ({"num_voxels": [[0, 0]]}, "stage.coarse.num_voxels: expected"),
    ({"bases": [[0, 1, 2]]}, "stage.coarse.bases: expected"),
    ({"effects": ["motion", "shine"]}, "stage.coarse.effects: expected some of .* got .*shine"),
    ({"start": "points"}, "stage.coarse.start: expected auto, box or hull, but got 'points'"),
    ({"confine": 1.5}, r"stage.coarse.confine: expected a fraction in \[0, 1\], but got 1.5"),
    ({"start_alpha": 1.0}, f"stage.coarse.start_alpha: {OPACITY}"),
    ({"box_alpha": 0.0}, f"stage.coarse.box_alpha: {OPACITY}"),
    *((wrong, OPACITIES) for wrong in ({"birth_alpha": 1e-2}, {"birth_alpha": 0.0}, {"keep_alpha": 1.0})),
]
REFUSED = [
    *(
        (partial(VoxelStage, **({"name": "coarse", "num_voxels": [[0, 8000]]} | wrong)), text)
        for wrong, text in STAGES
    ),
    *(
        (lambda name=name: made(forward_model(**{name: {"width": 3}})), GHOST.format(name))
        for name in ("inpainter", "background")
    ),
    *(
        (
            lambda wrong=wrong: made(backward_model(deformation=wrong)),
            "model.deformation: expected a factory, but got",
        )
        for wrong in (None, {"width": 3})
    ),
    (
        lambda: made(forward_model(trajectory=None)),
        "model.trajectory: expected a factory, but got null; choose another model/motion",
    ),
    *(
        (
            lambda wrong=wrong: Motion(PATHS(), **wrong),
            "model.motion: expected 0 < tau <= 1, 0 <= fade <= 1 and",
        )
        for wrong in ({"tau": 0.0}, {"tau": 2.0}, {"fade": -0.1}, {"fade": 1.5}, {"rest": 0.5})
    ),
    *(
        (
            partial(UNet3d, channels=4, **wrong),
            "model.inpainter: expected a width that is a multiple of 16 and",
        )
        for wrong in ({"width": 12}, {"levels": 1})
    ),
    *(
        (partial(TrilinearUpsampler, scale=scale), "model.upsampler.scale: expected a number > 1, but got")
        for scale in (1, 0.5, float("nan"))
    ),
    (partial(LearnedUpsampler, scale=1.5, channels=4), "expects a whole number, but got 1.5"),
    (
        lambda: built(ODD, Lattice(BOX, (7, 6, 5))),
        "model.upsampler.scale: expected a whole number beside an inpainter, but got 1.5",
    ),
    (
        lambda: forward_model()(Start(SCENE, "coarse", {"num_voxels": [[0, 100]], "start": "hull"}, [0])),
        "stage.coarse.start: expected box, since the images of 'ball' have no alpha",
    ),
    (partial(voxel_terms, ["ssim"]), r"objective.literal: .* but got \['ssim'\]"),
]


@pytest.mark.parametrize(("call", "text"), REFUSED)
def test_refuses_by_the_name_of_the_key(call, text):
    with pytest.raises(ValueError, match=text):
        call()
