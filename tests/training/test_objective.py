import pytest
import torch

from forewarp import losses
from forewarp.ops.grid import neighbour_pairs
from forewarp.scene.batch import Batch
from forewarp.scene.box import Box, Lattice
from forewarp.scene.rays import Rays
from forewarp.fields.radiance_grid import Activation, RadianceGrid, Rendering, State
from forewarp.training.objective import Objective, Step

TERMS = (
    "photo",
    "point_color",
    "background_entropy",
    "flow_l1",
    "inpaint_diff",
    "tv_density",
    "tv_flow",
    "tv_depth",
    "still_points",
    "moving_opacity",
)
LATTICE = Lattice(Box((0, 0, 0), (2, 3, 4)), (3, 4, 5))


def rendering(seed):
    generator = torch.Generator().manual_seed(seed)

    def draw(*shape):
        return torch.rand(*shape, generator=generator).requires_grad_()

    ids, every = torch.tensor([0, 0, 3]), torch.tensor([0, 0, 0, 0, 1, 3, 3])
    return Rendering(draw(4, 3), draw(4), draw(4), draw(4), draw(3), draw(3, 3), ids, 3, draw(7), every)


def step(inpainted=True, moving=True, background=True):
    rays = Rays(torch.zeros(4, 3), torch.zeros(4, 3), 1.0, 2.0)
    batch = Batch(rays, torch.rand(4, 3, generator=torch.Generator().manual_seed(9)), torch.ones(3), 0.5, 0)
    generator = torch.Generator().manual_seed(3)
    index = torch.arange(60, dtype=torch.int32).reshape(LATTICE.shape)
    values = torch.randn(60, 4, generator=generator).requires_grad_()
    canonical = RadianceGrid(LATTICE, index, values, Activation(0.0, 1.0))
    names = ["upsampled", "inpainted"] if inpainted else ["upsampled"]
    state = State(
        0.5,
        dict.fromkeys(names, canonical),
        canonical,
        flow=torch.randn(60, 3, generator=generator).requires_grad_() if moving else None,
        inpaint_difference=torch.randn(1, 4, 3, 4, 5, generator=generator) if inpainted else None,
        background=canonical.with_values(torch.randn(60, 4, generator=generator)) if background else None,
    )
    depth, stray = torch.rand(2, 4, 4, generator=generator), torch.randn(7, 3, generator=generator)
    drawn = {n: rendering(i) for i, n in enumerate(names)}
    return Step(
        batch, state, drawn, lambda: (depth, torch.ones(2, 4, 4)), lambda: stray if background else None
    )


def test_the_loss_is_the_weighted_sum_of_the_raw_terms():
    weights = {name: 0.1 * (i + 1) for i, name in enumerate(TERMS)}
    loss, raw = Objective(weights)(step(), 0)
    assert set(raw) == set(TERMS)
    assert loss.item() == pytest.approx(sum(weights[n] * v.item() for n, v in raw.items()), rel=1e-5)
    assert loss.requires_grad
    assert not any(v.requires_grad for v in raw.values())


def test_every_term_is_the_pure_function_of_its_parts():
    seen = step()
    _, raw = Objective(dict.fromkeys(TERMS, 1.0))(seen, 0)
    pairs = neighbour_pairs(seen.state.canonical.index)
    truth, both = seen.batch.rgb, list(seen.renderings.values())
    grids = [seen.state.canonical, seen.state.background]
    expected = {
        "photo": sum(losses.photometric(r.rgb, truth) for r in both),
        "point_color": sum(losses.point_color(r.weights, r.colors, r.ray_ids, truth) for r in both),
        "background_entropy": sum(losses.background_entropy(r.transmittance) for r in both),
        "flow_l1": losses.flow_l1(seen.state.flow),
        "inpaint_diff": losses.inpaint_diff(seen.state.inpaint_difference),
        "tv_density": sum(losses.tv_density(grid.raw_density, pairs) for grid in grids),
        "tv_flow": losses.tv_flow(seen.state.flow, pairs),
        "tv_depth": losses.tv_depth(*seen.render_patches()),
        "still_points": losses.still_points(seen.stray()),
        "moving_opacity": losses.moving_opacity(grids[0].activation.alpha(grids[0].raw_density, 1.0)),
    }
    for name, value in expected.items():
        torch.testing.assert_close(raw[name], value.detach())


def forbid(*_):
    raise AssertionError("a term of weight 0 was called")


@pytest.mark.parametrize("off", TERMS)
def test_a_term_of_weight_zero_is_never_called(off, monkeypatch):
    function = {"photo": "photometric"}.get(off, off)
    monkeypatch.setattr(losses, function, forbid)
    seen = step()
    if off == "tv_depth":
        seen.render_patches = forbid
    for weights in ({n: 1.0 for n in TERMS if n != off}, {n: float(n != off) for n in TERMS}):
        objective = Objective(weights)
        objective.terms[off] = forbid
        _, raw = objective(seen, 0)
        assert set(raw) == set(TERMS) - {off}


def test_each_nth_step_with_n_times_the_weight():
    objective = Objective({"photo": 1.0, "tv_density": 0.5}, every={"tv_density": 3})
    seen = step()
    (first, raw), (second, later) = objective(seen, 6), objective(seen, 7)
    assert set(raw) == {"photo", "tv_density"}
    assert set(later) == {"photo"}
    assert first.item() == pytest.approx((raw["photo"] + 1.5 * raw["tv_density"]).item())
    assert second.item() == pytest.approx(later["photo"].item())


def test_terms_of_effects_that_are_off_are_left_out():
    _, raw = Objective(dict.fromkeys(TERMS, 1.0))(step(inpainted=False, moving=False, background=False), 0)
    off = {"flow_l1", "tv_flow", "inpaint_diff", "still_points", "moving_opacity"}
    assert set(raw) == set(TERMS) - off


def test_the_printed_forms():
    seen = step()
    names = ["photo", "point_color", "background_entropy"]
    _, built = Objective(dict.fromkeys(names, 1.0))(seen, 0)
    objective = Objective(dict.fromkeys(names, 1.0), literal=names)
    _, printed = objective(seen, 0)
    assert objective.needs_all_weights
    assert printed["photo"].item() == pytest.approx(3 * built["photo"].item())
    expected = sum(
        losses.point_color(r.weights, r.colors, r.ray_ids, seen.batch.rgb, all_ray_ids=r.all_ray_ids)
        for r in seen.renderings.values()
    )
    torch.testing.assert_close(printed["point_color"], expected.detach())
    assert printed["point_color"] < built["point_color"]
    assert [Objective({}, literal=[n]).needs_all_weights for n in names] == [False, True, True]
    expected = sum(losses.sample_entropy(r.all_weights) for r in seen.renderings.values())
    torch.testing.assert_close(printed["background_entropy"], expected.detach())


def test_the_rays_terms_may_look_at_some_renderings_only():
    both = {"upsampled": 1, "inpainted": 2}
    assert Objective({}).wanted(both) == ["upsampled", "inpainted"]
    chosen = Objective({}, photo_on=["inpainted"])
    assert chosen.wanted(both) == ["inpainted"]
    assert chosen.wanted(["upsampled"]) == ["upsampled"]  # what is not there cannot be looked at


@pytest.mark.parametrize(
    ("arguments", "text"),
    [
        ({"weights": {"photos": 1.0}}, "objective: expected a term of photo, .*but got .photos."),
        ({"weights": {}, "every": {"tv": 2}}, "but got 'tv'"),
        ({"weights": {}, "literal": ["ssim"]}, r"objective.literal: .* but got \['ssim'\]"),
        (
            {"weights": {}, "every": {"photo": 0}},
            "objective.every: expected whole numbers of steps >= 1, but got",
        ),
        ({"weights": {}, "every": {"photo": 1.5}}, "objective.every: expected whole numbers"),
    ],
)
def test_refuses(arguments, text):
    with pytest.raises(ValueError, match=text):
        Objective(**arguments)
