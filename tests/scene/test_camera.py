import pytest
import torch

from forewarp.scene.camera import Camera, look_at

UP = torch.tensor([0.0, 0.0, 1.0])


def camera(center=(3.0, 1.0, 2.0), width=6, height=4):
    pose = look_at(torch.tensor(center), torch.zeros(3), UP)
    return Camera(width, height, 5.0, 7.0, width / 2, height / 2, pose, 1.0, 9.0)


def test_hand_worked():
    plain = Camera(2, 2, 1.0, 2.0, 1.0, 1.0, torch.eye(4, dtype=torch.float64), 1.0, 2.0)
    rays = plain.rays()
    # Pixel centres at +0.5; x right, y down, z forward.
    expected = torch.tensor([[-0.5, -0.25, 1], [0.5, -0.25, 1], [-0.5, 0.25, 1], [0.5, 0.25, 1]])
    torch.testing.assert_close(rays.directions / rays.directions[:, 2:], expected)
    assert (rays.origins == 0).all()
    assert (rays.near, rays.far) == (1.0, 2.0)


def test_chosen_pixels_are_rows_of_all():
    picked = torch.tensor([5, 0, 23])
    chosen = camera().rays(picked)
    assert torch.equal(chosen.directions, camera().rays().directions[picked])
    assert len(chosen) == 3
    assert torch.equal(camera().rays()[picked].directions, chosen.directions)


@pytest.mark.parametrize("center", [(3.0, 1.0, 2.0), (0.0, 0.0, 4.0), (0.0, 0.0, -4.0)])
def test_look_at_is_a_rotation_that_sees_the_target_in_the_middle(center):
    view = camera(center)
    rotation = view.camera_to_world[:3, :3]
    torch.testing.assert_close(rotation.T @ rotation, torch.eye(3, dtype=torch.float64))
    assert torch.linalg.det(rotation).item() == pytest.approx(1)
    pixel, depth = view.project(torch.zeros(1, 3, dtype=torch.float64))
    torch.testing.assert_close(pixel[0], torch.tensor([3.0, 2.0], dtype=torch.float64))
    assert depth.item() == pytest.approx(torch.tensor(center).norm().item())
    raised, _ = view.project(torch.tensor([0.0, 0.0, 0.5]))
    assert raised[1] <= 2.0 + 1e-9  # up is up
