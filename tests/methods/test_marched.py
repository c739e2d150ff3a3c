"""TiNeuVox and NDVG: sizes, starts, identities, what they can learn."""

from copy import deepcopy
from dataclasses import replace
from functools import partial

import pytest
import torch

from forewarp.fields.grids import RadianceGrid
from forewarp.methods.method import Start
from forewarp.methods.ndvg import NDVG
from forewarp.methods.rays import Marching
from forewarp.methods.tineuvox import TiNeuVox
from forewarp.renderer import Renderer
from forewarp.scene.cloud import Handover
from forewarp.scene.view import Batch, Moment, View
from tests.support.sampled_methods import batch, learns_what_moves
from tests.support.still_cameras import camera, moving_scene

SMALL = {"tineuvox": {"width": 16, "position_frequencies": 3}, "ndvg": {"width": (16, 16)}}
KINDS = {"tineuvox": TiNeuVox, "ndvg": NDVG}
THICK = {"tineuvox": {"alpha_init": 1e-2}, "ndvg": {"numbers": {"alpha_init": 1e-2}}}
TOWARDS = torch.tensor([0.0, 0.6, 0.8])
JITTER = Marching(jitter=True, occupancy=8)


def start(num_voxels=9**3, still=None, weights=None, **numbers):
    numbers["num_voxels"] = num_voxels if isinstance(num_voxels, list) else [[0, num_voxels]]
    return Start(moving_scene(still), "fine", numbers, weights=weights or {})


def method(kind, num_voxels=9**3, seed=0, still=None, numbers=None, **options):
    torch.manual_seed(seed)
    return KINDS[kind](start(num_voxels, still, **(numbers or {})), **(SMALL[kind] | options))


def rates(made, lr=1.0):
    groups = made.param_groups().items()
    return torch.optim.SGD([{"params": p, "lr": lr, "base_lr": lr, "name": n} for n, p in groups])


def some_points(count=200, seed=3, dtype=torch.float32):
    return 1.8 * torch.rand(count, 3, generator=torch.Generator().manual_seed(seed), dtype=dtype) - 0.9


def shown(made, time, points=None):
    """Density and colour at some points."""
    points = some_points() if points is None else points
    density, color = made.field(Moment(time)).at_world(points)
    return density, color(slice(None), TOWARDS.expand(len(points), 3))


def opacity(made, density):
    """The opacity of a step through this density of NDVG."""
    return -torch.expm1(-density * 0.5 * made.lattice_marched.voxel_size)


def test_tineuvox_starts_thin_and_moved():
    torch.manual_seed(0)
    made = TiNeuVox(start(9**3))
    points = 3 * torch.rand(500, 3, generator=torch.Generator().manual_seed(0)) - 1.5
    offset = made.field(Moment(0.5)).offset(points).detach()
    assert float(offset.norm(dim=-1).mean()) == pytest.approx(0.14, abs=0.06)
    size = made.lattice_marched.voxel_size
    assert float(made.activation.alpha(torch.zeros(()), 0.5 * size)) == pytest.approx(5e-3, rel=0.01)


def test_padding_moves_the_voxels_and_a_constant_stays_inside():
    plain, padded = (method("tineuvox", 10**3, padded=padded) for padded in (False, True))
    assert (plain.grid.lattice.shape, padded.grid.lattice.shape) == ((9,) * 3, (10,) * 3)
    for made in (plain, padded):
        torch.nn.init.constant_(made.grid.features, 2.0)
        torch.testing.assert_close(made.read(0.3 * some_points()), torch.full((200, 12), 2.0))
    assert float(padded.read(torch.full((1, 3), 0.99)).detach().max()) < 0.1  # the padding


def test_the_camera_changes_colour_only():
    made, points, towards = method("tineuvox", camera=True), some_points(), TOWARDS.expand(200, 3)
    made.cameras = [0, 1]
    fields = [made.field(Moment(0.5, camera=camera)) for camera in (0, 1, None, 7)]
    density, color_of = zip(*(field.at_world(points) for field in fields))
    colors = [color(slice(None), towards) for color in color_of]
    assert density[0].equal(density[1])
    assert not colors[0].equal(colors[1])
    assert not colors[0].equal(colors[2])
    assert colors[2].equal(colors[3])  # who took no training picture sees by the mean of the others
    torch.testing.assert_close(fields[2].camera, (fields[0].camera + fields[1].camera) / 2)


def test_the_grid_of_tineuvox_freezes():
    made = method("tineuvox", numbers={"frozen_from": 0.9})
    torch.nn.init.constant_(made.grid.features, 1 / 3)
    for progress, rate, value in ((0.5, 1.0, 1 / 3), (0.95, 0.0, 0.33325195)):
        optimizer = rates(made)
        made.advance(progress, 1, optimizer)
        assert [g["lr"] for g in optimizer.param_groups] == [rate, 1.0, 1.0]
        assert float(made.grid.features.detach()[0, 0]) == pytest.approx(value)
    made.grow(2000, optimizer)
    torch.nn.init.constant_(made.grid.features, 1 / 3)
    made.advance(0.95, 2, rates(made))
    assert float(made.grid.features.detach()[0, 0]) == pytest.approx(0.33325195)  # what grew later, too


@pytest.mark.parametrize(("alpha", "opaque"), [(1e-2, 5.0e-3), (1e-6, 5.0e-7)])
def test_ndvg_starts_half_hidden_and_unmoved(alpha, opaque):
    made, pictures = method("ndvg", numbers={"alpha_init": alpha}), []
    for time in (0.0, 0.3):
        field = made.field(Moment(time))
        density, _ = field.at_world(some_points())
        offset, mask = field.offset(some_points())
        assert not offset.any()
        assert mask.eq(0.5).all()
        half = torch.full((200,), 0.5 * opaque)
        torch.testing.assert_close(opacity(made, density), half, rtol=0.01, atol=0)
        pictures.append(made.at(Moment(time)).render(View(camera()), torch.ones(3)).rgb)
    assert pictures[0].equal(pictures[1])


def test_ndvg_without_mask_and_offset_is_a_voxel_radiance_field():
    made = method("ndvg", numbers={"view_dependence": False, "deformation_voxels": 1.0})
    canonical = made.canonical
    with torch.no_grad():
        made.network[-1].bias[3] = 30.0
        canonical.density.normal_().mul_(3)
        canonical.color.normal_()
    values = torch.cat([canonical.density, canonical.color], -1)
    grid = RadianceGrid(canonical.lattice, canonical.index, values, made.activation)
    expected = Renderer()(grid, View(camera()).rays(), torch.ones(3))
    drawn = made.at(Moment(0.7)).render(View(camera()), torch.ones(3))
    for part in ("rgb", "opacity", "depth"):
        torch.testing.assert_close(getattr(drawn, part), getattr(expected, part), atol=1e-4, rtol=1e-4)


def test_the_mask_counts_twice():
    made, seen = method("ndvg", numbers={"view_dependence": False}), []
    for bias in (30.0, 0.0):  # clear, half
        made.network[-1].bias.data[3] = bias
        density, color = shown(made, 0.5)
        seen.append((opacity(made, density), color))
    torch.testing.assert_close(2 * seen[1][0], seen[0][0], rtol=1e-4, atol=1e-6)
    torch.testing.assert_close(2 * seen[1][1], seen[0][1])


@pytest.mark.parametrize("continuous", [False, True])
def test_offsets_of_ndvg_lead_to_the_canonical_time(continuous):
    made, shift = method("ndvg", continuous=continuous), torch.tensor([0.2, -0.1, 0.05])
    with torch.no_grad():
        made.canonical.density.normal_()
        made.network[-1].bias[:3] = shift
        points = 0.5 * some_points()
        field, rest = made.field(Moment(0.5)), made.field(Moment(0.0))
        moved = torch.zeros(3) if continuous else shift
        assert field.offset(points)[0].allclose(moved.expand(200, 3))
        assert not rest.offset(points)[0].any()
        torch.testing.assert_close(field.at_world(points - moved)[0], rest.at_world(points)[0])
        made.network[-1].weight.normal_(std=0.1)
        near, far = (made.field(Moment(t)).offset(points)[0].norm(dim=-1).mean() for t in (1e-6, 1.0))
    assert float(far) > 2e-3
    assert (float(near) < 1e-4) == continuous


@pytest.mark.parametrize("kind", KINDS)
def test_growing_keeps_values_and_starts_the_rates_anew(kind):
    made = method(kind, [[0, 5**3], [0.5, 9**3]])
    torch.nn.init.constant_(made.canonical.color if kind == "ndvg" else made.grid.features, 3.0)
    if kind == "ndvg":
        made.canonical.density.data[0] = 2.0
    optimizer = rates(made, 0.25)
    for group in optimizer.param_groups:
        group["base_lr"] = 1.0
    for progress, rate in ((0.4, 0.25), (0.5, 1.0)):
        made.advance(progress, 3, optimizer)
        assert {g["lr"] for g in optimizer.param_groups} == {rate}
    assert float(made.voxels) == 9**3
    assert made.lattice_marched.voxel_size == pytest.approx(made.marching_lattice(9**3).voxel_size)
    assert (made.canonical.color if kind == "ndvg" else made.grid.features).eq(3.0).all()
    assert {id(p) for g in optimizer.param_groups for p in g["params"]} == {id(p) for p in made.parameters()}
    if kind == "ndvg":
        assert (made.canonical.density[0], made.canonical.density[-1]) == (2.0 - 1, -1)


@pytest.mark.parametrize("kind", KINDS)
def test_points_that_never_move_are_pulled_to_stay(kind):
    made = method(kind, still=some_points(50))
    field, draw = made.field(Moment(0.5)), torch.Generator().manual_seed(0)
    last = (made.offsets if kind == "tineuvox" else made.network)[-1]
    torch.nn.init.zeros_(last.weight)
    for shift in (0.0, 0.3):
        torch.nn.init.constant_(last.bias, shift)
        term = made.extra_terms(field, batch(), draw)["still"]
        assert float(term().detach()) == pytest.approx(shift**2, abs=1e-6)
    assert method(kind).extra_terms(field, batch(), draw)["still"]() is None


def test_weights_of_offsets_do_not_depend_on_what_is_skipped():
    made = method("ndvg", marching=Marching(occupancy=8))
    with torch.no_grad():
        made.network[-1].bias[:3] = torch.tensor([0.1, -0.2, 0.3])
    draw, found = torch.Generator().manual_seed(0), []
    for keep in (None, "front"):
        if keep:
            made.occupancy.cells[: len(made.occupancy.cells) // 2] = False
        terms = made.look(batch(), {}, draw).terms
        found.append([float(terms[name]().detach()) for name in ("flow_l1", "canonical")])
        points = made.look(batch(), {}, draw).noted["samples"]
        ray = 12**0.5 / (0.5 * made.deformation.lattice.voxel_size)  # places along the box's diagonal
        assert found[-1] == pytest.approx([0.2 * points / (144 * ray)] * 2, rel=1e-4)
    assert 0 < found[1][0] < 0.9 * found[0][0]


@pytest.mark.slow
@pytest.mark.parametrize("kind", KINDS)
def test_a_dead_start_is_named(kind):
    marchings = (Marching(color_threshold=threshold) for threshold in (1e-3, 0.9))
    alive, dead = (method(kind, 13**3, marching=marching, **THICK[kind]) for marching in marchings)
    for made, steps in ((alive, 20), (dead, 19)):
        for _ in range(steps):
            made.look(batch(), {}, torch.Generator())
    key = {"tineuvox": "model", "ndvg": "stage.fine"}[kind]
    advice = f"dead start; set it to 0, or a larger {key}.alpha_init, or preset.occupancy=0"
    with pytest.raises(ValueError, match=advice):
        dead.look(batch(), {}, torch.Generator())


def test_each_view_of_a_batch_is_seen_by_the_code_of_its_camera():
    made, seen = method("tineuvox", 13**3, camera=True, alpha_init=1e-2), batch().observations[0]
    made.cameras = [0, 1]
    both = [replace(seen, moment=Moment(0.5, camera=i), rgb=seen.rgb / (1 + i)) for i in (0, 1)]
    batches = [Batch(tuple(views), 0) for views in (both, both[:1], both[1:])]
    steps = [made.look(of_views, {}, torch.Generator().manual_seed(0)) for of_views in batches]
    for name in ("photo", "point_color", "background_entropy"):
        whole, *alone = (step.terms[name]().detach() for step in steps)
        torch.testing.assert_close(whole, sum(alone) / 2)
    assert steps[0].noted["samples"] == sum(step.noted["samples"] for step in steps[1:])
    whole, first, second = (dict(step.tensors())["rgb"].detach() for step in steps)
    torch.testing.assert_close(whole, torch.cat([first, second]))
    assert not first.allclose(second)


@pytest.mark.slow
def test_the_second_stage_of_ndvg_goes_on_where_the_first_ended():
    first = method("ndvg", 13**3, marching=JITTER, numbers={"view_dependence": False, "box_alpha": 0.05})

    def distance(grid):
        return grid.lattice.to_world(grid.voxels).norm(dim=-1)

    with torch.no_grad():
        first.network[-1].weight.normal_(std=0.05)
        first.deformation.features.normal_()
        first.canonical.density[:, 0] = torch.where(distance(first.canonical) < 0.4, 6.0, -20.0)
    box = first.bounds([0.0, 0.5, 1.0])
    assert all(-1 < low < -0.2 and 0.2 < high < 1 for low, high in zip(box.low, box.high))
    numbers = {"num_voxels": [[0, 9**3]], "masked": True}
    begun = Start(moving_scene(), "fine", numbers, before=first)
    second = NDVG(begun, **SMALL["ndvg"], marching=JITTER)
    assert second.network[-1].weight.equal(first.network[-1].weight)
    nodes = second.deformation.lattice.to_world(second.deformation.voxels)
    forgetful = deepcopy(second)
    torch.nn.init.zeros_(forgetful.deformation.features)
    with torch.no_grad():
        left, found, lost = (made.carried(nodes, 0.5)[0] for made in (first, second, forgetful))
    size = float(left.abs().mean())
    torch.testing.assert_close(found, left, atol=1e-3 * size, rtol=0)
    assert float((lost - left).abs().mean()) > 0.05 * size > 1e-3
    assert 0.3 < float((second.canonical.density == -100).float().mean()) < 1
    assert 0 < float(second.occupancy.occupied.float().mean()) < 1
    third = NDVG(replace(begun, numbers=numbers | {"carry": True, "masked": False}), **SMALL["ndvg"])
    carried, left = (
        made.activation.sigma(made.canonical.density)[distance(made.canonical) < 0.2]
        for made in (third, first)
    )
    torch.testing.assert_close(carried.mean(), left.mean(), rtol=1e-3, atol=0)
    assert "the second stage starts from the density of the first" in third.departures()


def test_voxels_before_a_camera_are_empty():
    made = method("ndvg", 17**3)
    made._clear([replace(moving_scene().train[0].camera, near=2.5)])
    away = made.canonical.lattice.to_world(made.canonical.voxels) - camera().center.float()
    close = away.norm(dim=-1) <= 2.5
    assert close.any()
    assert (made.canonical.density[:, 0] == -100).equal(close)


def test_the_released_faults_are_named():
    padded, frozen = method("tineuvox", numbers={"frozen_from": 0.9}).faults()
    assert padded.endswith("(padded)")
    assert frozen.endswith("from 0.9 of the stage on (frozen_from)")
    mended = method("tineuvox", padded=False)
    assert (mended.faults(), mended.departures()[-1]) == ([], "grid sizes of 4 k + 1")
    other = method("tineuvox", 16**3)
    other.padded = False
    with pytest.raises(
        ValueError, match=r"model.padded: expected true for a grid of sizes \(.*\), but got false"
    ):
        other.read(some_points())
    assert method("ndvg").faults() == ["offsets jump at the canonical time (continuous)"]
    still = method("ndvg", still=some_points(5), continuous=True)
    assert still.faults() == ["points that never move are not looked at (weights.still)"]
    of_some = start(still=some_points(5), weights={"still": 1.0})
    short = "the first stage never sees the last 1 images (iterations_per_time)"
    for frames, faults in ((2, [short]), (3, [])):
        left = Handover(of_some.scene.box, False, frames)
        begun = replace(of_some, handover=left, blank=True)
        assert NDVG(begun, **SMALL["ndvg"], continuous=True).faults() == faults


@pytest.mark.parametrize("kind", KINDS)
def test_the_canonical_time_counts_where_there_is_one(kind):
    def drawn(canonical_time):
        torch.manual_seed(0)
        begun = start(alpha_init=0.1) if kind == "ndvg" else start()
        scene = replace(begun.scene, canonical_time=canonical_time)
        made = KINDS[kind](replace(begun, scene=scene), **SMALL[kind])
        with torch.no_grad():
            for parameter in made.parameters():
                parameter.add_(0.3 * torch.randn_like(parameter))
            return made.at(Moment(1.0)).render(View(camera()), torch.ones(3)).rgb

    assert drawn(0.0).equal(drawn(1.0)) == (kind == "tineuvox")


@pytest.mark.parametrize("kind", KINDS)
def test_gradcheck(kind):
    made = method(kind, 5**3, **({"padded": False} if kind == "tineuvox" else {"continuous": True})).double()
    with torch.no_grad():
        for parameter in made.parameters():
            parameter.add_(0.5 * torch.randn_like(parameter))
    grids = [made.grid] if kind == "tineuvox" else [made.canonical, made.deformation]
    values = [parameter for grid in grids for parameter in grid.parameters()]

    def look(points, last, *_):
        density, color = made.field(Moment(0.7)).at_world(points)
        return density, color(torch.arange(4), TOWARDS.double().expand(4, 3))

    points = (0.4 * some_points(4, dtype=torch.float64) + 0.013).requires_grad_()
    last = (made.head.density_head if kind == "tineuvox" else made.network[-1]).bias
    inputs = (points, last, *values)
    assert torch.autograd.gradcheck(look, inputs, eps=1e-7, atol=1e-4, nondet_tol=1e-12, fast_mode=True)


@pytest.mark.slow
@pytest.mark.parametrize("kind", KINDS)
def test_it_learns_what_moves(kind, tmp_path):
    rate = {"grid": 8e-2, "density": 0.1, "color": 0.1, "network": 5e-3}
    rate["deformation"] = 3e-3 if kind == "tineuvox" else 0.1
    lr = {name: rate[name] for name in method(kind).param_groups()}
    weights = {"photo": 1.0, "point_color": 1e-2, "background_entropy": 1e-3}
    model = partial(KINDS[kind], **SMALL[kind], marching=Marching(jitter=True))
    how = {"lr": lr, "iterations": 400, "num_voxels": [[0, 9**3], [0.2, 17**3]]}
    assert learns_what_moves(model, tmp_path, weights, **how)
