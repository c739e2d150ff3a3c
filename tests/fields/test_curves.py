import pytest
import torch

from forewarp.fields.curves import Curve


@pytest.mark.parametrize("kind", ["spline", "cosines"])
@pytest.mark.parametrize("straight", [False, True])
def test_a_sum_of_bases_is_their_sum(kind, straight):
    curve = Curve(kind, 7, times=20, canonical_time=0.4, straight=straight)
    parts = [(0.3, 2.0), (0.8, -1.5), (1.0, 0.25)]
    expected = sum(factor * curve(time) for time, factor in parts)
    torch.testing.assert_close(curve.summed(parts), expected)
    assert torch.equal(curve.summed([(0.3, 1.0)]), curve(0.3))


def test_a_sum_reaches_as_far_as_it_is_told():
    curve = Curve("spline", 7, times=20, canonical_time=0.0)
    torch.testing.assert_close(curve.summed([(1.1, 1.0)], beyond=0.2), curve(1.1, 0.2))
    with pytest.raises(ValueError, match=r"^spline: expected times in \[0, 1\], but got 1.1"):
        curve.summed([(1.1, 1.0)])
