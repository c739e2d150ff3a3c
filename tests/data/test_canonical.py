import pytest
import torch

from forewarp.data.canonical import with_canonical
from forewarp.data.dnerf import read_scene
from forewarp.scene.errors import SceneError
from forewarp.synth.scenes import synthesize


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    root = tmp_path_factory.mktemp("scenes")
    synthesize(root / "vehicle", size=8, frames=5, test_views=(1, 1, 1), val_views=0, samples_per_pixel=1)
    return read_scene(root, "vehicle", half_resolution=False)


def test_the_middle_training_time_becomes_canonical_and_leads_the_trajectories(scene):
    moved = with_canonical(scene, "middle")
    assert scene.canonical_time == 0
    assert moved.canonical_time == moved.truth.times[0] == moved.protocol["canonical_time"] == 0.5
    at = scene.truth.times.tolist().index(0.5)
    assert torch.equal(moved.truth.points[:, 0], scene.truth.points[:, at])
    assert sorted(moved.truth.times.tolist()) == sorted(scene.truth.times.tolist())


def test_nothing_changes_unasked(scene):
    assert with_canonical(scene, None) is scene


def test_another_word_is_refused(scene):
    with pytest.raises(SceneError, match="data.canonical: expected middle or null, but got last"):
        with_canonical(scene, "last")
