"""Each loss term of the voxel methods applies the right function, and only terms that count are computed."""

from dataclasses import replace

import pytest
import torch

from forewarp import losses
from forewarp.fields.grids import Activation, RadianceGrid
from forewarp.methods.method import Step
from forewarp.methods.voxel.losses import TERMS, Seen, voxel_terms
from forewarp.methods.voxel.model import VoxelSnapshot
from forewarp.ops.grid import neighbour_pairs
from forewarp.renderer import Marched, Renderer
from forewarp.scene.box import Box, Lattice
from forewarp.scene.view import Moment
from forewarp.training.objective import Objective, total
from tests.support.tiny_scene import ball_data, ball_scene, begun, built, forward_model, stage

LATTICE = Lattice(Box((0, 0, 0), (2, 3, 4)), (3, 4, 5))


def rendering(seed):
    generator = torch.Generator().manual_seed(seed)

    def draw(*shape):
        return torch.rand(*shape, generator=generator).requires_grad_()

    ids, every = torch.tensor([0, 0, 3]), torch.tensor([0, 0, 0, 0, 1, 3, 3])
    return Marched(draw(4, 3), draw(4), draw(4), draw(4), draw(3), draw(3, 3), ids, 3, draw(7), every)


def looked(inpainted=True, moving=True, background=True):
    """Make up what the terms are computed from."""
    truth = torch.rand(4, 3, generator=torch.Generator().manual_seed(9))
    generator = torch.Generator().manual_seed(3)
    index = torch.arange(60, dtype=torch.int32).reshape(LATTICE.shape)
    values = torch.randn(60, 4, generator=generator).requires_grad_()
    canonical = RadianceGrid(LATTICE, index, values, Activation(0.0, 1.0))
    names = ["upsampled", "inpainted"] if inpainted else ["upsampled"]
    state = VoxelSnapshot(
        Moment(0.5),
        dict.fromkeys(names, canonical),
        canonical,
        Renderer(),
        flow=torch.randn(60, 3, generator=generator).requires_grad_() if moving else None,
        inpaint_difference=torch.randn(1, 4, 3, 4, 5, generator=generator) if inpainted else None,
        background=canonical.with_values(torch.randn(60, 4, generator=generator)) if background else None,
    )
    depth, stray = torch.rand(2, 4, 4, generator=generator), torch.randn(7, 3, generator=generator)
    drawn = {n: rendering(i) for i, n in enumerate(names)}
    return Seen(
        truth,
        state,
        drawn,
        lambda: (depth, torch.ones(2, 4, 4)),
        lambda: stray if background else None,
        neighbour_pairs,
    )


def loss_of(objective, seen, number=0, terms=None):
    """Return the loss and the unweighted terms."""
    terms = voxel_terms(objective.literal) if terms is None else terms
    step = Step({name: lambda term=term: term(seen) for name, term in terms.items()}, torch.zeros(()))
    return total(step, objective.factors(number))


def test_every_term_is_the_pure_function_of_its_parts():
    seen = looked()
    _, raw = loss_of(Objective(dict.fromkeys(TERMS, 1.0)), seen)
    pairs = neighbour_pairs(seen.state.canonical.index)
    truth, both = seen.rgb, list(seen.renderings.values())
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
        "static_points": losses.static_points(seen.stray()),
        "moving_opacity": losses.moving_opacity(grids[0].activation.alpha(grids[0].raw_density, 1.0)),
    }
    for name, value in expected.items():
        torch.testing.assert_close(raw[name], value.detach())


def test_terms_of_effects_that_are_off_are_left_out():
    nothing = looked(inpainted=False, moving=False, background=False)
    _, raw = loss_of(Objective(dict.fromkeys(TERMS, 1.0)), nothing)
    off = {"flow_l1", "tv_flow", "inpaint_diff", "static_points", "moving_opacity"}
    assert set(raw) == set(TERMS) - off


def method_for(objective, **choices):
    """A method, ready for a stage of this objective."""
    made = stage()
    scene = ball_scene(frames=2, size=8)
    method = built(forward_model(**choices), Lattice(scene.box, (3, 3, 3)), frames=2)
    return begun(method, scene, replace(made, objective=objective))


def test_the_printed_forms():
    seen = looked()
    names = ["photo", "point_color", "background_entropy"]
    _, plain = loss_of(Objective(dict.fromkeys(names, 1.0)), seen)
    _, printed = loss_of(Objective(dict.fromkeys(names, 1.0), literal=names), seen)
    assert printed["photo"].item() == pytest.approx(3 * plain["photo"].item())
    expected = sum(
        losses.point_color(r.weights, r.colors, r.ray_ids, seen.rgb, all_ray_ids=r.all_ray_ids)
        for r in seen.renderings.values()
    )
    torch.testing.assert_close(printed["point_color"], expected.detach())
    assert printed["point_color"] < plain["point_color"]
    expected = sum(losses.sample_entropy(r.all_weights) for r in seen.renderings.values())
    torch.testing.assert_close(printed["background_entropy"], expected.detach())


@pytest.mark.parametrize(
    ("literal", "needed"),
    [((), False), (["photo"], False), (["point_color"], True), (["background_entropy"], True)],
)
def test_the_weights_of_all_samples_are_kept_only_for_a_printed_form(literal, needed, monkeypatch):
    method, asked, march = method_for(Objective({}, literal=literal)), [], VoxelSnapshot.march

    def noted(self, name, rays, background, **options):
        asked.append(options["keep_all_weights"])
        return march(self, name, rays, background, **options)

    monkeypatch.setattr(VoxelSnapshot, "march", noted)
    data = ball_data(rays=4, frames=2, size=8)
    method.look(data.batches.draw(), {"photo": 1.0}, torch.Generator().manual_seed(0))
    assert asked == [needed]
