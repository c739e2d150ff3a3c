import pytest
import torch

from forewarp.methods.voxel.effects import SphericalHarmonics, ViewNetwork


def test_harmonics_hand_worked():
    features = torch.zeros(1, 12)
    features[0, :3] = torch.tensor([0.1, 0.2, 0.3])
    features[0, 3:6] = torch.tensor([1.0, 0.0, 0.0])  # with y: red
    features[0, 6:9] = torch.tensor([0.0, 1.0, 0.0])  # with z: green
    features[0, 9:12] = torch.tensor([0.0, 0.0, 1.0])  # with x: blue
    color = SphericalHarmonics()(features, torch.tensor([[0.6, 0.8, -0.5]]))
    torch.testing.assert_close(color, torch.sigmoid(torch.tensor([[0.1 + 0.8, 0.2 - 0.5, 0.3 + 0.6]])))


@pytest.mark.parametrize("view", [SphericalHarmonics(), ViewNetwork(features=12, width=8)])
def test_colours_lie_in_the_unit_cube_for_any_number_of_samples(view):
    for samples in (0, 1, 7):
        directions = torch.nn.functional.normalize(torch.randn(samples, 3), dim=-1)
        color = view(1e3 * torch.randn(samples, view.features), directions)
        assert color.shape == (samples, 3)
        assert ((color >= 0) & (color <= 1)).all()


def test_gradcheck():
    features = torch.randn(3, 12, dtype=torch.float64, requires_grad=True)
    directions = torch.randn(3, 3, dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(SphericalHarmonics(), (features, directions))
    assert torch.autograd.gradcheck(ViewNetwork(width=4).double(), (features, directions))
