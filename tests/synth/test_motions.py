import numpy as np
import pytest

from forewarp.synth.vehicle import MOTIONS, joints

MANY = np.linspace(0, 1, 41)


@pytest.mark.parametrize("motion", MOTIONS)
def test_every_motion_spans_few_low_frequencies(motion):
    """Ten cosines hold every joint's map to 5e-3: what a trajectory grid can learn."""
    maps = np.stack([np.concatenate(list(joints(motion, t).values())) for t in MANY]).reshape(len(MANY), -1)
    steps = np.pi * (np.arange(len(MANY)) + 0.5) / len(MANY)
    basis = np.cos(steps[:, None] * np.arange(10))
    fitted = basis @ np.linalg.lstsq(basis, maps, rcond=None)[0]
    assert np.abs(fitted - maps).max() < 5e-3
    assert np.abs(maps - maps[0]).max() > 0.1


@pytest.mark.parametrize("motion", MOTIONS)
def test_the_band_keeps_its_volume_and_follows_the_pin(motion):
    bands = np.stack([joints(motion, t)["band"] for t in MANY])
    np.testing.assert_allclose(np.linalg.det(bands[:, :3, :3]), np.linalg.det(bands[0, :3, :3]), rtol=1e-12)
    for t, band in zip(MANY, bands):
        pin = joints(motion, t)["stick"] @ (0.36, 0.125, 0, 1)
        np.testing.assert_allclose(band @ (1, 0, 0, 1), pin, atol=1e-12)


def test_the_ball_keeps_its_volume_while_it_squashes():
    maps = np.stack([joints("lift_tilt", t)["ball"][:3, :3] for t in MANY])
    np.testing.assert_allclose(np.linalg.det(maps), 1, rtol=1e-12)
    assert maps[:, 2, 2].min() < 0.8
    assert maps[:, 2, 2].max() > 1.0


def test_wheels_roll_as_far_as_the_vehicle_travels():
    """Where the tyres touch the ground they stand still along the heading: a turn makes one side of an axle
    slip back by as much as the other slips on.
    """
    before, after = joints("drive", 0.5), joints("drive", 0.5001)
    slips = []
    for wheel in ("wheel2", "wheel3"):
        low = np.linalg.solve(before[wheel], before[wheel][:, 3] - (0, 0, 0.16, 0))
        slips.append(((after[wheel] - before[wheel]) @ low)[:3] @ before["chassis"][:3, 0])
    travelled = np.linalg.norm(after["chassis"][:, 3] - before["chassis"][:, 3])
    assert abs(sum(slips)) / 2 < 0.01 * travelled
