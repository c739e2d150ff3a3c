"""TiNeuVox and NDVG: sizes, starts, identities, what they can learn."""

from copy import deepcopy
from dataclasses import replace
from functools import partial

import pytest
import torch

from forewarp.data.module import SceneDataModule
from forewarp.fields.grids import RadianceGrid
from forewarp.methods.method import Start, parameter_count
from forewarp.methods.ndvg import NDVG
from forewarp.methods.rays import Marching
from forewarp.methods.tineuvox import TiNeuVox
from forewarp.renderer import Renderer
from forewarp.scene.cloud import Handover
from forewarp.scene.view import Batch, Moment, View
from forewarp.training.objective import Objective
from forewarp.training.schedule import StageSettings
from forewarp.training.stages import Stage
from tests.support.sampled_methods import at_full_size, batch
from tests.support.still_cameras import camera, moving_scene, static_ceiling
from tests.support.tiny_scene import make_run

S, B = {}, {"channels": 6, "width": 256, "alpha_init": 1e-3}
SMALL = {"tineuvox": {"width": 16, "position_frequencies": 3}, "ndvg": {"width": (16, 16)}}
KINDS = {"tineuvox": TiNeuVox, "ndvg": NDVG}
THICK = {"tineuvox": {"alpha_init": 1e-2}, "ndvg": {"numbers": {"alpha_init": 1e-2}}}
JITTER = Marching(jitter=True, occupancy=8)


def start(num_voxels=9**3, still=None, weights=None, **numbers):
    numbers["num_voxels"] = num_voxels if isinstance(num_voxels, list) else [[0, num_voxels]]
    return Start(moving_scene(still), "fine", numbers, weights=weights or {})


def method(kind, num_voxels=9**3, seed=0, still=None, numbers=None, **options):
    torch.manual_seed(seed)
    return KINDS[kind](start(num_voxels, still, **(numbers or {})), **(SMALL[kind] | options))


def rates(made, lr=1.0):
    return torch.optim.SGD(
        [{"params": p, "lr": lr, "base_lr": lr, "name": n} for n, p in made.param_groups().items()]
    )


def some_points(count=200, seed=3, dtype=torch.float32):
    return 1.8 * torch.rand(count, 3, generator=torch.Generator().manual_seed(seed), dtype=dtype) - 0.9


def shown(made, time, points=None):
    """Density and colour at some points."""
    points = some_points() if points is None else points
    density, color = made.field(Moment(time)).look_up(points)
    return density, color(slice(None), torch.tensor([0.0, 0.6, 0.8]).expand(len(points), 3))


@pytest.mark.parametrize(
    ("options", "side", "parts", "total"),
    [
        (S, 100, (2_452, 9_731, 9_216, 65, 7_203), 4_028_667),
        (B, 160, (12_318, 90_627, 47_104, 257, 102_531), 24_828_837),
        (S | {"camera": True}, 100, (2_452, 9_731, 9_216, 65, 7_843, 2_452), 4_000_000 + 31_759),
        (B | {"camera": True}, 160, (12_318, 90_627, 47_104, 257, 106_371, 12_318), 24_576_000 + 268_995),
    ],
)
def test_published_counts_of_tineuvox(options, side, parts, total):
    made = TiNeuVox(start(9**3), **options)
    head = made.head
    color = sum(map(parameter_count, (head.bottleneck, head.shading, head.color_head)))
    networks = (made.time_code, made.offsets, head.trunk, head.density_head, made.camera_code)
    counts = [parameter_count(part) for part in networks if part is not None]
    assert (*counts[:4], color, *counts[4:]) == parts
    assert made.marching_lattice(side**3).shape == (side,) * 3
    assert at_full_size(made, side**3) == total


def test_published_counts_of_ndvg():
    fine, coarse = (
        NDVG(start(**numbers)) for numbers in ({}, {"view_dependence": False, "deformation_voxels": 1.625})
    )
    assert parameter_count(fine.network) == parameter_count(coarse.network) == 14_276
    assert parameter_count(fine.color) == 26_243
    assert coarse.color is None
    assert fine.marching_lattice(160**3).shape == (190,) * 3
    assert at_full_size(fine, 160**3) == 80_724_519
    # Published: 1,024,000 and 1,664,000 voxels; whole numbers of a side make of them 101^3 and 118^3 or so.
    assert at_full_size(coarse, 1_024_000) == pytest.approx(10_766_276, rel=0.01)


@pytest.mark.parametrize(("options", "moved", "opaque"), [(S, 0.14, 5.0e-3), (B, 0.12, 5.0e-4)])
def test_tineuvox_starts_thin_and_moved(options, moved, opaque):
    torch.manual_seed(0)
    made = TiNeuVox(start(9**3), **options)
    points = 3 * torch.rand(500, 3, generator=torch.Generator().manual_seed(0)) - 1.5
    offset = made.field(Moment(0.5)).offset(points).detach()
    assert float(offset.norm(dim=-1).mean()) == pytest.approx(moved, abs=0.06)
    size = made.lattice_marched.voxel_size
    assert float(made.activation.alpha(torch.zeros(()), 0.5 * size)) == pytest.approx(opaque, rel=0.01)


def test_reads_of_tineuvox_agree_where_the_grid_is_linear():
    made = method("tineuvox", padded=False)
    with torch.no_grad():
        made.grid.features[:] = made.grid.lattice.to_world(made.grid.voxels) @ torch.randn(3, 4) + 1
    points = some_points()
    one, two, four = made.read(points).split(4, -1)
    torch.testing.assert_close(one, two)
    torch.testing.assert_close(one, four)
    assert not made.read(points + 3).any()


def test_padding_moves_the_voxels_and_a_constant_stays_inside():
    plain, padded = (method("tineuvox", 10**3, padded=padded) for padded in (False, True))
    assert (plain.grid.lattice.shape, padded.grid.lattice.shape) == ((9,) * 3, (10,) * 3)
    with torch.no_grad():
        for made in (plain, padded):
            made.grid.features.fill_(2.0)
    middle = 0.3 * some_points()
    for made in (plain, padded):
        torch.testing.assert_close(made.read(middle), torch.full((200, 12), 2.0))
    end = padded.read(torch.full((1, 3), 0.99)).detach()
    assert float(end.max()) < 0.1  # the padding


def test_tineuvox_without_its_code_does_not_know_the_time():
    made = method("tineuvox")
    with torch.no_grad():
        made.grid.features.normal_()
        assert not shown(made, 0.2)[0].equal(shown(made, 0.7)[0])
        made.time_code[-1].weight.zero_()
    for one, other in zip(shown(made, 0.2), shown(made, 0.7)):
        assert one.equal(other)


def test_the_camera_changes_colour_only():
    made = method("tineuvox", camera=True)
    made.cameras = [0, 1]
    fields = [made.field(Moment(0.5, camera=camera)) for camera in (0, 1, None, 7)]
    points, towards = some_points(), torch.tensor([0.0, 0.6, 0.8]).expand(200, 3)
    seen = [(density, color(slice(None), towards)) for density, color in (f.look_up(points) for f in fields)]
    assert seen[0][0].equal(seen[1][0])
    assert not seen[0][1].equal(seen[1][1])
    assert not seen[0][1].equal(seen[2][1])
    assert seen[2][1].equal(seen[3][1])  # who took no training picture sees by the mean of the others
    torch.testing.assert_close(fields[2].camera, (fields[0].camera + fields[1].camera) / 2)


def test_the_grid_of_tineuvox_freezes():
    made = method("tineuvox", numbers={"frozen_from": 0.9})
    with torch.no_grad():
        made.grid.features.fill_(1 / 3)
    for progress, rate, value in ((0.5, 1.0, 1 / 3), (0.95, 0.0, 0.33325195)):
        optimizer = rates(made)
        made.advance(progress, 1, optimizer)
        assert {g["name"]: g["lr"] for g in optimizer.param_groups}["grid"] == rate
        assert optimizer.param_groups[-1]["lr"] == 1.0
        assert float(made.grid.features.detach()[0, 0]) == pytest.approx(value)
    made.grow(2000, optimizer)
    with torch.no_grad():
        made.grid.features.fill_(1 / 3)
    made.advance(0.95, 2, rates(made))
    assert float(made.grid.features.detach()[0, 0]) == pytest.approx(0.33325195)  # what grew later, too
    kept = made.protocol()["faults"]
    assert "padded" in kept
    assert "frozen_from" in kept
    assert "faults" not in method("tineuvox", padded=False).protocol()


@pytest.mark.parametrize(("alpha", "opaque"), [(1e-2, 5.0e-3), (1e-6, 5.0e-7)])
def test_ndvg_starts_half_hidden_and_unmoved(alpha, opaque):
    made = method("ndvg", numbers={"alpha_init": alpha})
    pictures = []
    for time in (0.0, 0.3, 1.0):
        field = made.field(Moment(time))
        density, _ = field.look_up(some_points())
        offset, mask = field.offset(some_points())
        assert not offset.any()
        assert mask.eq(0.5).all()
        step = 0.5 * made.lattice_marched.voxel_size
        alpha = -torch.expm1(-density * step)
        torch.testing.assert_close(alpha, torch.full((200,), 0.5 * opaque), rtol=0.01, atol=0)
        pictures.append(made.at(Moment(time)).render(View(camera()), torch.ones(3)).rgb)
    assert pictures[0].equal(pictures[1])
    assert pictures[0].equal(pictures[2])


def test_ndvg_without_mask_and_offset_is_a_voxel_radiance_field():
    made = method("ndvg", numbers={"view_dependence": False, "deformation_voxels": 1.0})
    with torch.no_grad():
        made.network[-1].bias[3] = 30.0
        made.canonical.density.normal_().mul_(3)
        made.canonical.color.normal_()
    lattice, index = made.canonical.lattice, made.canonical.index
    values = torch.cat([made.canonical.density, made.canonical.color], -1)
    grid = RadianceGrid(lattice, index, values, made.activation)
    rays = View(camera()).rays()
    expected = Renderer()(grid, rays, torch.ones(3))
    drawn = made.at(Moment(0.7)).render(View(camera()), torch.ones(3))
    for part in ("rgb", "opacity", "depth"):
        torch.testing.assert_close(getattr(drawn, part), getattr(expected, part), atol=1e-4, rtol=1e-4)


def test_the_mask_counts_twice():
    made = method("ndvg", numbers={"view_dependence": False})
    clear, half = 30.0, 0.0
    seen = []
    for bias in (clear, half):
        with torch.no_grad():
            made.network[-1].bias[3] = bias
        density, color = shown(made, 0.5)
        step = 0.5 * made.lattice_marched.voxel_size
        seen.append((-torch.expm1(-density * step), color))
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
        torch.testing.assert_close(field.look_up(points - moved)[0], rest.look_up(points)[0])
        made.network[-1].weight.normal_(std=0.1)
        near, far = (made.field(Moment(t)).offset(points)[0].norm(dim=-1).mean() for t in (1e-6, 1.0))
    assert float(far) > 2e-3
    assert (float(near) < 1e-4) == continuous


@pytest.mark.parametrize("kind", KINDS)
def test_growing_keeps_values_and_starts_the_rates_anew(kind):
    made = method(kind, [[0, 5**3], [0.5, 9**3]])
    if kind == "ndvg":
        made.canonical.color.data.fill_(3.0)
        corner = made.canonical.density.data[0].fill_(2.0).clone()
    else:
        made.grid.features.data.fill_(3.0)
    optimizer = rates(made)
    for group in optimizer.param_groups:
        group["lr"] = 0.25
    made.advance(0.4, 3, optimizer)
    assert {g["lr"] for g in optimizer.param_groups} == {0.25}
    made.advance(0.5, 4, optimizer)
    assert {g["lr"] for g in optimizer.param_groups} == {1.0}
    assert float(made.voxels) == 9**3
    assert made.lattice_marched.voxel_size == pytest.approx(made.marching_lattice(9**3).voxel_size)
    grid = made.canonical.color if kind == "ndvg" else made.grid.features
    assert grid.eq(3.0).all()
    assert {id(p) for g in optimizer.param_groups for p in g["params"]} == {id(p) for p in made.parameters()}
    if kind == "ndvg":
        assert made.canonical.density[0].equal(corner - 1)
        assert made.canonical.density[-1].eq(-1)


@pytest.mark.parametrize("kind", KINDS)
def test_points_that_never_move_are_pulled_to_stay(kind):
    made = method(kind, still=some_points(50))
    field, draw = made.field(Moment(0.5)), torch.Generator().manual_seed(0)
    last = (made.offsets if kind == "tineuvox" else made.network)[-1]
    for shift in (0.0, 0.3):
        with torch.no_grad():
            last.weight.zero_()
            last.bias.fill_(shift)
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


@pytest.mark.parametrize("kind", KINDS)
def test_a_dead_start_is_named(kind):
    alive = method(kind, 13**3, marching=Marching(color_threshold=1e-3), **THICK[kind])
    dead = method(kind, 13**3, marching=Marching(color_threshold=0.9), **THICK[kind])
    for made in (alive, dead):
        for _ in range(19):
            made.look(batch(), {}, torch.Generator())
    alive.look(batch(), {}, torch.Generator())
    key = {"tineuvox": "model", "ndvg": "stage.fine"}[kind]
    advice = f"dead start; set it to 0, or a larger {key}.alpha_init, or preset.occupancy=0"
    with pytest.raises(ValueError, match=advice):
        dead.look(batch(), {}, torch.Generator())


def test_each_view_of_a_batch_is_seen_by_the_code_of_its_camera():
    made = method("tineuvox", 13**3, camera=True, alpha_init=1e-2)
    made.cameras = [0, 1]
    one = batch().observations[0]
    both = [replace(one, moment=Moment(0.5, camera=i), rgb=one.rgb / (1 + i)) for i in (0, 1)]
    terms = ("photo", "point_color", "background_entropy")

    def look(*seen):
        step = made.look(Batch(seen, 0), {}, torch.Generator().manual_seed(0))
        return step, torch.stack([step.terms[name]().detach() for name in terms])

    step, found = look(*both)
    alone = [look(seen) for seen in both]
    torch.testing.assert_close(found, sum(values for _, values in alone) / 2)
    assert step.noted["samples"] == sum(other.noted["samples"] for other, _ in alone)
    drawn = [dict(step.tensors())["rgb"].detach() for step in (step, *(other for other, _ in alone))]
    torch.testing.assert_close(drawn[0], torch.cat(drawn[1:]))
    assert not drawn[1].allclose(drawn[2])


def test_the_second_stage_of_ndvg_goes_on_where_the_first_ended():
    first = method("ndvg", 13**3, marching=JITTER, numbers={"view_dependence": False, "box_alpha": 0.05})
    with torch.no_grad():
        first.network[-1].weight.normal_(std=0.05)
        first.deformation.features.normal_()
        inside = first.canonical.lattice.to_world(first.canonical.voxels).norm(dim=-1) < 0.4
        first.canonical.density[:, 0] = torch.where(inside, 6.0, -20.0)
    box = first.bounds([0.0, 0.5, 1.0])
    assert all(-1 < low < -0.2 and 0.2 < high < 1 for low, high in zip(box.low, box.high))
    begun = Start(moving_scene(), "fine", {"num_voxels": [[0, 9**3]], "masked": True}, before=first)
    second = NDVG(begun, **SMALL["ndvg"], marching=JITTER)
    assert second.network[-1].weight.equal(first.network[-1].weight)
    nodes = second.deformation.lattice.to_world(second.deformation.voxels)
    with torch.no_grad():
        left, found = (made.carried(nodes, 0.5)[0] for made in (first, second))
        forgetful = deepcopy(second)
        forgetful.deformation.features.zero_()
        lost = forgetful.carried(nodes, 0.5)[0]
    size = float(left.abs().mean())
    torch.testing.assert_close(found, left, atol=1e-3 * size, rtol=0)
    assert float((lost - left).abs().mean()) > 0.05 * size > 1e-3
    hidden = second.canonical.density[:, 0] == -100
    assert 0.3 < float(hidden.float().mean()) < 1
    assert 0 < float(second.occupancy.occupied.float().mean()) < 1
    third = NDVG(
        replace(begun, numbers={"num_voxels": [[0, 9**3]], "carry": True, "masked": False}), **SMALL["ndvg"]
    )
    carried, left = (
        m.activation.sigma(m.canonical.density)[
            m.canonical.lattice.to_world(m.canonical.voxels).norm(dim=-1) < 0.2
        ]
        for m in (third, first)
    )
    torch.testing.assert_close(carried.mean(), left.mean(), rtol=1e-3, atol=0)


def test_voxels_before_a_camera_are_empty():
    made = method("ndvg", 17**3)
    made._clear([replace(moving_scene().train[0].camera, near=2.5)])
    away = made.canonical.lattice.to_world(made.canonical.voxels) - camera().center.float()
    close = away.norm(dim=-1) <= 2.5
    assert close.any()
    assert (made.canonical.density[:, 0] == -100).equal(close)


def test_the_released_faults_of_ndvg_are_named():
    assert method("ndvg").faults() == ["offsets jump at the canonical time (continuous)"]
    still = method("ndvg", still=some_points(5), continuous=True)
    assert still.faults() == ["points that never move are not looked at (weights.still)"]
    of_some = start(still=some_points(5), weights={"still": 1.0})
    seen = Handover(of_some.scene.box, False, 2)
    short = "the first stage never sees the last 1 training pictures (pool)"
    for frames, faults in ((2, [short]), (3, [])):
        begun = replace(of_some, handover=replace(seen, frames_in_play=frames), blank=True)
        assert NDVG(begun, **SMALL["ndvg"], continuous=True).faults() == faults


@pytest.mark.parametrize("kind", KINDS)
def test_gradcheck(kind):
    made = method(kind, 5**3, **({"padded": False} if kind == "tineuvox" else {"continuous": True})).double()
    with torch.no_grad():
        for parameter in made.parameters():
            parameter.add_(0.5 * torch.randn_like(parameter))
    grids = [made.grid] if kind == "tineuvox" else [made.canonical, made.deformation]
    values = [parameter for grid in grids for parameter in grid.parameters()]
    toward = torch.tensor([[0.0, 0.6, 0.8]], dtype=torch.float64).expand(4, 3)

    def look(points, last, *_):
        density, color = made.field(Moment(0.7)).look_up(points)
        return density, color(torch.arange(4), toward)

    points = (0.4 * some_points(4, dtype=torch.float64) + 0.013).requires_grad_()
    last = (made.head.density_head if kind == "tineuvox" else made.network[-1]).bias
    inputs = (points, last, *values)
    assert torch.autograd.gradcheck(look, inputs, eps=1e-7, atol=1e-4, nondet_tol=1e-12, fast_mode=True)


@pytest.mark.parametrize("kind", KINDS)
def test_permuted_rays_give_permuted_pictures(kind):
    made = method(kind, marching=Marching(occupancy=8))
    order = torch.randperm(144, generator=torch.Generator().manual_seed(0))
    with torch.no_grad():
        whole, some = (
            made.at(Moment(0.5)).render(View(camera(), pixels), torch.ones(3)).rgb for pixels in (None, order)
        )
    torch.testing.assert_close(some, whole[order], atol=1e-6, rtol=0)


def learned(kind, folder, **options):
    """The mean train PSNR on the toy."""
    rate = {"grid": 8e-2, "density": 0.1, "color": 0.1, "network": 5e-3}
    rate["deformation"] = 3e-3 if kind == "tineuvox" else 0.1
    groups = method(kind, **options).param_groups()
    settings = StageSettings.of(
        "fine",
        lr={name: rate[name] for name in groups},
        iterations=400,
        curriculum={"all_in": 0.0},
        num_voxels=[[0, 9**3], [0.2, 17**3]],
    )
    weights = {"photo": 1.0, "point_color": 1e-2, "background_entropy": 1e-3}
    data = SceneDataModule(moving_scene, rays=96)
    model = partial(KINDS[kind], **(SMALL[kind] | options), marching=Marching(jitter=True))
    module = make_run(folder, [Stage(settings, Objective(weights))], data=data, model=model).fit()
    psnr = [float(module.psnr_of(target)) for target in data.targets("train")]
    return sum(psnr) / len(psnr)


@pytest.mark.slow
@pytest.mark.parametrize("kind", KINDS)
def test_it_learns_what_moves(kind, tmp_path):
    assert learned(kind, tmp_path) > static_ceiling() + 3


@pytest.mark.slow
def test_tineuvox_learns_what_moves_even_without_moving_it(tmp_path, monkeypatch):
    from forewarp.methods.tineuvox import TiNeuVoxField

    monkeypatch.setattr(TiNeuVoxField, "_offset", lambda self, placed: placed.new_zeros(len(placed), 3))
    assert learned("tineuvox", tmp_path) > static_ceiling() + 3
