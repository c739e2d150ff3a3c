"""What a lattice can show of an image, and what a part of a fit would reach."""

import pytest
import torch
from omegaconf import OmegaConf

from forewarp.metrics.image import psnr
from forewarp.runs.build import build_run
from forewarp.runs.config import saved_config
from tests.bench.limits import FITTED, fitted_parts, low_passed
from tests.support.commands import call


def test_what_is_smooth_survives_and_what_is_fine_does_not():
    ramp = torch.linspace(0, 1, 48).expand(40, 48)[..., None].expand(-1, -1, 3)
    inner = (slice(4, -4), slice(4, -4))
    assert psnr(low_passed(ramp, 4)[inner], ramp[inner]) > 60
    chequered = ((torch.arange(40)[:, None] + torch.arange(48)) % 2).float()[..., None].expand(-1, -1, 3)
    assert (low_passed(chequered, 4)[inner] - 0.5).abs().max() < 0.02


def test_wider_voxels_show_less():
    image = torch.rand(40, 48, 3, generator=torch.Generator().manual_seed(0))
    found = [psnr(low_passed(image, pixels), image) for pixels in (1.5, 2, 4, 8)]
    assert found == sorted(found, reverse=True)
    assert low_passed(image, 1000).shape == image.shape
    assert low_passed(image, 1.0) is image  # voxels as fine as pixels lose nothing


@pytest.mark.slow
def test_what_is_fitted_to_a_view_shows_it_better_and_is_given_back(fitted, tmp_path):
    words = ["data=dnerf", "data.scene=vehicle", f"data.root={fitted.parent}/scenes", f"run={tmp_path}/run"]
    words += ["model=particles", "budget.iterations=80", "evaluate=false", "logger=none", "threads=1"]
    assert call("train", *words).status == 0
    run = build_run(saved_config(tmp_path / "run", OmegaConf.create(), "runs"))
    found = fitted_parts(run, views=2, steps=20)
    before = found.pop("as it is")
    assert found.pop("scene") == "vehicle"
    assert list(found) == list(FITTED)
    assert min(found.values()) > before + 0.1
    assert max(found.values()) == found["all of these"]
    assert fitted_parts(run, views=2, steps=1)["as it is"] == before
