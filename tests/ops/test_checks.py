import pytest
import torch

from forewarp.ops.checks import check_shape


@pytest.mark.parametrize("shape", [("P", 3), (4, 3), (4, "C"), ("A", "B")])
def test_a_shape_that_fits_passes(shape):
    check_shape("points", torch.zeros(4, 3), shape)


def test_dots_stand_for_any_number_of_sizes():
    for size in ((2,), (0, 2), (3, 4, 2)):
        check_shape("points", torch.zeros(size), ("...", 2))
    for size in ((), (3,), (2, 3)):
        with pytest.raises(ValueError, match=r"points: expected shape \(\.\.\., 2\), but got"):
            check_shape("points", torch.zeros(size), ("...", 2))


@pytest.mark.parametrize("shape", [("P", 2), (5, 3), ("P",), ("A", "B", "C")])
def test_another_is_named(shape):
    with pytest.raises(ValueError, match=r"points: expected shape \(.*\), but got \(4, 3\)"):
        check_shape("points", torch.zeros(4, 3), shape)
