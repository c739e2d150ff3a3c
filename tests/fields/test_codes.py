import pytest
import torch

from forewarp.fields.networks import CameraCodes, TimeCodes


@pytest.mark.parametrize(
    ("time", "shares"),
    [(0.0, (1, 0, 0)), (0.5, (0, 1, 0)), (0.125, (0.75, 0.25, 0)), (0.75, (0, 0.5, 0.5)), (1.0, (0, 0, 1))],
)
def test_codes_between_times_are_those_beside_it(time, shares):
    codes = TimeCodes((0.0, 0.5, 1.0), 4)
    expected = torch.tensor(shares, dtype=torch.float32) @ codes.table
    torch.testing.assert_close(codes(time), expected)


def test_beyond_the_training_times_they_stay():
    codes = TimeCodes((0.25, 0.5), 4)
    assert codes(0.0).equal(codes.table[0])
    assert codes(1.0).equal(codes.table[1])


def test_first_values_are_small_and_positive():
    table = TimeCodes([i / 99 for i in range(100)], 8).table.detach()
    assert 0 <= float(table.min()) < float(table.max()) < 0.05


def test_a_camera_that_is_not_known_sees_by_the_mean():
    codes = CameraCodes({55, 1, 9}, 3)  # ids are not rows
    for row, camera in enumerate((1, 9, 55)):
        assert codes(camera).equal(codes.table[row])
    for unknown in (None, 0, 2, -1):
        torch.testing.assert_close(codes(unknown), codes.table.mean(0))
    assert CameraCodes({None, 4}, 3)(None).shape == (3,)
