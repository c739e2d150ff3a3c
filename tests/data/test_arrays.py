"""Exact depth and trajectories: refused unless they are what they should be."""

import numpy as np
import pytest
import torch

from forewarp.data.arrays import StoredDepth, read_truth, write_array, write_truth
from forewarp.scene.errors import SceneError
from forewarp.scene.frame import Truth


@pytest.mark.parametrize(
    ("depth", "match"),
    [
        (np.ones((3, 4)), r"shape \(4, 3\), but got shape \(3, 4\)"),
        (np.full((4, 3), np.nan), "expected finite depths >= 0"),
        (-np.ones((4, 3)), "but got values from -1.0 to -1.0"),
    ],
)
def test_bad_depth(tmp_path, depth, match):
    write_array(tmp_path / "d.npy", depth)
    with pytest.raises(SceneError, match=match):
        StoredDepth(tmp_path / "d.npy", (3, 4))()


def test_depth_that_is_no_array(tmp_path):
    (tmp_path / "d.npy").write_bytes(b"")
    with pytest.raises(SceneError, match=r"d.npy: expected a NumPy file"):
        StoredDepth(tmp_path / "d.npy", (3, 4))()


def test_no_file_is_no_truth(tmp_path):
    assert read_truth(tmp_path / "t.npz", 0.0) is None


@pytest.mark.parametrize(
    ("arrays", "match"),
    [
        ({"points": np.ones((2, 3, 3))}, r"expected arrays points and times, but got \['points'\]"),
        (
            {"points": np.ones((2, 3, 3)), "times": np.arange(2)},
            r"expected points \(N, T, 3\) and times \(T,\)",
        ),
        ({"points": np.full((2, 1, 3), np.inf), "times": [0]}, "points: expected finite numbers"),
        (
            {"points": np.ones((2, 2, 3)), "times": [0.5, 1]},
            "begin at the canonical time 0, but got 0.5 to 1",
        ),
        ({"points": np.ones((2, 2, 3)), "times": [0, 2]}, "but got 0 to 2"),
        ({"points": np.array([None]), "times": [0]}, "points: expected an array"),
    ],
)
def test_bad_trajectories(tmp_path, arrays, match):
    np.savez(tmp_path / "t.npz", **arrays)
    with pytest.raises(SceneError, match=match):
        read_truth(tmp_path / "t.npz", 0.0)


def test_trajectories_round_trip(tmp_path):
    truth = Truth(torch.rand(5, 2, 3), torch.tensor([0.25, 1.0], dtype=torch.float64))
    write_truth(tmp_path / "t.npz", truth)
    read = read_truth(tmp_path / "t.npz", 0.25)
    assert torch.equal(read.points, truth.points)
    assert torch.equal(read.times, truth.times)
