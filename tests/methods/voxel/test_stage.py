"""The numbers of a voxel method's stage: schedules, and what is refused by the name of its key."""

from forewarp.methods.voxel.structure import VoxelStage


def numbers(**changes):
    return VoxelStage(**({"name": "coarse", "num_voxels": [[0, 8000]]} | changes))


def test_schedules_hold_until_the_next_entry():
    made = numbers(num_voxels=[[0, 10], [0.5, 20], [0.75, 30]])
    assert [made.at("num_voxels", f) for f in (0, 0.49, 0.5, 0.74, 0.75, 1)] == [10, 10, 20, 20, 30, 30]
    assert made.at("bases", 0.5) is None
    assert numbers(num_voxels=[[0.2, 10]]).at("num_voxels", 0.0) == 10  # the first holds from the beginning
