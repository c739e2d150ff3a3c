"""The numbers of a voxel method's stage: schedules, and what is refused by the name of its key."""

import pytest

from forewarp.methods.voxel.stage import VoxelStage


def numbers(**changes):
    return VoxelStage(**({"name": "coarse", "num_voxels": [[0, 8000]]} | changes))


def test_schedules_hold_until_the_next_entry():
    made = numbers(num_voxels=[[0, 10], [0.5, 20], [0.75, 30]])
    assert [made.at("num_voxels", f) for f in (0, 0.49, 0.5, 0.74, 0.75, 1)] == [10, 10, 20, 20, 30, 30]
    assert made.at("bases", 0.5) is None
    assert numbers(num_voxels=[[0.2, 10]]).at("num_voxels", 0.0) == 10  # the first holds from the beginning


@pytest.mark.parametrize(
    ("wrong", "text"),
    [
        ({"num_voxels": []}, r"stage.coarse.num_voxels: expected \[\[fraction, count\], ...\], but got \[\]"),
        ({"num_voxels": [[2, 100]]}, "stage.coarse.num_voxels: expected"),
        ({"num_voxels": [[0, 0]]}, "stage.coarse.num_voxels: expected"),
        ({"bases": [[0, 1, 2]]}, "stage.coarse.bases: expected"),
        (
            {"effects": ["motion", "shine"]},
            r"stage.coarse.effects: expected some of motion, view_dependence, .* got \['motion', 'shine'\]",
        ),
        ({"start": "points"}, "stage.coarse.start: expected auto, box or hull, but got 'points'"),
        ({"confine": 1.5}, r"stage.coarse.confine: expected a fraction in \[0, 1\], but got 1.5"),
        ({"start_alpha": 1.0}, r"stage.coarse.start_alpha: expected a number in \(0, 1\), but got 1.0"),
        ({"box_alpha": 0.0}, r"stage.coarse.box_alpha: expected a number in \(0, 1\), but got 0.0"),
        ({"birth_alpha": 1e-2}, "stage.coarse: expected 0 < birth_alpha < keep_alpha < 1"),
        ({"birth_alpha": 0.0}, "stage.coarse: expected 0 < birth_alpha < keep_alpha < 1"),
        ({"keep_alpha": 1.0}, "stage.coarse: expected 0 < birth_alpha < keep_alpha < 1"),
    ],
)
def test_refuses_by_the_name_of_the_key(wrong, text):
    with pytest.raises(ValueError, match=text):
        numbers(**wrong)


def test_a_key_that_nobody_knows_is_refused():
    with pytest.raises(TypeError, match="unexpected keyword argument 'voxel'"):
        numbers(voxel=1)
