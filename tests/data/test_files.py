"""Whole numbers of configs and arguments: refused in one line that names the key."""

import numpy as np
import pytest

from forewarp.data.files import whole
from forewarp.scene.errors import SceneError


@pytest.mark.parametrize("value", [2, 7, np.int64(2)])
def test_a_whole_number_passes(value):
    found = whole(value, "data.frames", 2)
    assert (found, type(found)) == (value, int)


@pytest.mark.parametrize("value", [1, -2, 2.0, "2", True, None, [2], np.float32(2)])
def test_another_is_named(value):
    with pytest.raises(
        SceneError, match=r"^data.frames: expected a whole number of at least 2, but got .*; set"
    ):
        whole(value, "data.frames", 2)


def test_multiples():
    assert whole(16, "size", 8, 8) == 16
    with pytest.raises(
        SceneError, match="size: expected a multiple of 8 of at least 8, but got 20; set size"
    ):
        whole(20, "size", 8, 8)
