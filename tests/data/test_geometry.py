"""Checks that all readers share: numbers, poses, boxes, ranges; each reader's own tests name its keys."""

import numpy as np
import pytest

from forewarp.data.cameras import box_of, pose_of
from forewarp.data.files import SceneError, number, numbers_of, whole

EYE, NAN = np.eye(4), float("nan")
BAD_POSES = {
    "none": (None, "expected 4 x 4 finite numbers, but got None; check the export"),
    "3 x 4": (EYE[:3], "expected 4 x 4 finite"),
    "ragged": ([[1], [1, 2]], "expected 4 x 4 finite"),
    "words": ([["a"] * 4] * 4, "expected 4 x 4 finite"),
    "nan": (EYE * NAN, "expected 4 x 4 finite"),
    "scale": (np.diag([2.0, 2, 2, 1]), "expected a rotation, but got determinant 8"),
    "mirror": (np.diag([1.0, 1, -1, 1]), "expected a rotation, but got determinant -1"),
    "last row": ([*EYE[:3], [0, 0, 1, 1]], "expected the last row 0 0 0 1"),
    "far off": (EYE + 1e12 * np.eye(4, k=3), r"expected a place within 1e\+09 units, but got 1e\+12"),
}


@pytest.mark.parametrize("case", BAD_POSES)
def test_bad_poses(case):
    value, match = BAD_POSES[case]
    with pytest.raises(SceneError, match=f"^a.json: pose: {match}") as caught:
        pose_of(value, "a.json: pose")
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("value", [1.5, -1, NAN, float("inf"), "0.5", True, None, 10**400, [1]])
def test_bad_numbers(value):
    with pytest.raises(SceneError, match=r"^a.json: time: expected a number in \[0, 1\], but got "):
        number(value, "a.json: time", 0, 1)


@pytest.mark.parametrize("words", [["1"], ["1", "2", "3"], ["1", "x"], ["1", "nan"], ["inf", "1"]])
def test_bad_numbers_in_text(words):
    with pytest.raises(SceneError, match=r"^a.txt: line 3: expected 2 finite numbers, but got "):
        numbers_of(words, 2, "a.txt: line 3")


@pytest.mark.parametrize("value", [1, -2, 2.0, "2", True, None, [2], np.float32(2)])
def test_whole_numbers(value):
    found = whole(np.int64(2), "frames", 2)
    assert (found, type(found), whole(16, "size", 8, 8)) == (2, int, 16)
    with pytest.raises(SceneError, match="^frames: expected a whole number of at least 2, but got .*; set"):
        whole(value, "frames", 2)
    with pytest.raises(SceneError, match="size: expected a multiple of 8 of at least 8, but got 20; set"):
        whole(20, "size", 8, 8)


@pytest.mark.parametrize("values", [[1, 2], [1, 1, 1, 0, 2, 2], [0] * 6, "box", [*"abcdef"]])
def test_bad_boxes(values):
    with pytest.raises(SceneError, match="^data.box: expected six numbers x0 y0 z0 x1 y1 z1, each low"):
        box_of(values)
