"""What a lattice can show of an image, and what a part of a fit would reach."""

from types import SimpleNamespace

import pytest
import torch
from omegaconf import OmegaConf

from forewarp.metrics.image import psnr
from forewarp.runs.build import build_run
from forewarp.runs.config import saved_config
from tests.bench.limits import FITTED, fitted_parts, low_passed, smooth_between
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


def film_of(places: list[float]) -> SimpleNamespace:
    """Return a run on five images of a patch at such columns; the third is held out, and rendered grey."""
    generator = torch.Generator().manual_seed(0)
    texture = torch.rand(1, 3, 24, 24, generator=generator)
    texture = torch.nn.functional.interpolate(texture, (96, 96), mode="bicubic").clamp(0, 1)[0].movedim(0, -1)
    rows, columns = torch.meshgrid(torch.arange(96.0), torch.arange(96.0), indexing="ij")

    def target(index: int) -> SimpleNamespace:
        behind = (columns - places[index]) / 48 - 1, rows / 48 - 1
        patch = torch.nn.functional.grid_sample(
            texture.flip(0).movedim(-1, 0)[None], torch.stack(behind, -1)[None], align_corners=False
        )[0].movedim(0, -1)
        moving = (rows - 48).abs().lt(20) & (columns - 48 - places[index]).abs().lt(20)
        frame = SimpleNamespace(time=index / 4, camera=None)
        rgb = torch.where(moving[..., None], patch, texture)
        return SimpleNamespace(rgb=rgb, moving=moving, frame=frame, moment=None, background=None)

    images = [target(index) for index in range(5)]
    test, train = images[2:3], images[:2] + images[3:]
    module = SimpleNamespace(render=lambda *_: SimpleNamespace(rgb=torch.full((96, 96, 3), 0.5)))
    scene = SimpleNamespace(name="film", train=[image.frame for image in train])
    datamodule = SimpleNamespace(targets=lambda part: test if part == "test" else train, scene=scene)
    return SimpleNamespace(load=lambda: module, datamodule=datamodule, folder="film")


def test_smooth_motion_reaches_what_is_smooth():
    pytest.importorskip("cv2")
    moving, bending, jerking = ([-6, -3, 0, 3, 6], [5, 1.25, 0, 1.25, 5], [-6, -3, 2, 3, 6])
    line, cubic = "as a line, followed", "as a cubic curve, followed"
    even, bent, jerked = (smooth_between(film_of(places)) for places in (moving, bending, jerking))
    assert min(even[line], even[cubic]) > 30
    assert bent[cubic] > bent[line] + 5  # a parabola is no line
    assert max(jerked[line], jerked[cubic]) < 25
    assert even["as it is"] == pytest.approx(jerked["as it is"], abs=1.0)
    bare = film_of(moving)
    bare.datamodule.targets("test")[0].moving = None
    with pytest.raises(ValueError, match="film: expected test images with masks"):
        smooth_between(bare)


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
