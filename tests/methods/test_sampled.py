"""NeRF, T-NeRF, D-NeRF, Nerfies and HyperNeRF: sizes, identities, gradients, what they can learn."""

import math
from dataclasses import replace
from functools import partial
from types import SimpleNamespace

import pytest
import torch
from torch.autograd import gradcheck
from torch.testing import assert_close

from forewarp.fields.networks import ScrewWarp, TimeCodes
from forewarp.methods.dnerf import DNeRF
from forewarp.methods.hypernerf import HyperNeRF
from forewarp.methods.nerf import NeRF
from forewarp.methods.nerfies import Nerfies
from forewarp.methods.rays import NO_JUMP, OF_JAX, OF_PYTORCH, Sampling
from forewarp.methods.tnerf import TNeRF
from forewarp.ops.encode import positional_encoding
from forewarp.scene.view import Batch, Moment, Observation, View
from tests.support.sampled_methods import GENTLE, KINDS, SMALL, WARP, batch, method, psnr_after, shown, start
from tests.support.still_cameras import camera, moving_scene, niche_scene, static_ceiling

OF_WARP = {"frequencies": 6, "width": 128, "layers": 6, "skip": 5}
POINT = 3 * (1 + 2 * 3)  # channels of an encoded point of the small methods
BENT = ("nerfies", "hypernerf")  # space, by a warp
WHITE = torch.ones(3)
NARROW = {"width": 8, "layers": 2, "position_frequencies": 1}
NARROW_WARP = {"warp_width": 8, "warp_layers": 2, "warp_frequencies": 2}


def draw():
    return torch.Generator().manual_seed(0)


def skipping(kind, *, sampling=None, **changes):
    """A small method whose networks read their input again in the second layer, as the published ones."""
    torch.manual_seed(0)
    skips = {"skip": 2} | ({"warp_skip": 2} if kind in BENT else {})
    return KINDS[kind](start(), sampling=sampling or Sampling(12, 12, **GENTLE), **(skips | changes))


@torch.no_grad()
def liven(made):
    """Give heads that start near 0 values of the size of others."""
    for name, parameter in made.named_parameters():
        for part, factor in (("warp.turn", 1e3), ("warp.shift", 1e3), ("slice.head", 1e4)):
            if name == f"{part}.weight":
                parameter.mul_(factor)
    return made


def double_and_narrow(kind, fine_samples=0, **changes):
    """A method in float64 with few parameters, whose octaves and ambient coordinates are partly in."""
    changes = NARROW | (NARROW_WARP if kind in BENT else {}) | changes
    made = liven(skipping(kind, sampling=Sampling(4, fine_samples, **GENTLE), **changes)).double()
    made.advance(0.03, 1, None)
    return made


def points_in_double(count):
    return torch.randn(count, 3, generator=torch.Generator().manual_seed(1)).double()


@pytest.mark.slow
@pytest.mark.parametrize(
    ("kind", "changes"), [*((kind, {}) for kind in KINDS), ("dnerf", {"continuous": True})]
)
def test_gradients_of_a_field_against_differences(kind, changes):
    made = double_and_narrow(kind, **changes)
    points = points_in_double(3).requires_grad_()
    assert gradcheck(lambda x, *_: shown(made, 0.75, x), (points, *made.parameters()), fast_mode=True)


@pytest.mark.slow
def test_gradients_of_the_regularisers_against_differences():
    made = double_and_narrow("nerfies")
    points, warp = points_in_double(4), made.warp
    table = made.codes.table.detach().clone().requires_grad_()
    code = table.detach()[1].clone().requires_grad_()

    def strain(code, *_):
        return warp.elastic(points, code, 0.7)

    def stray(table, *_):
        return warp.stray(points, table, 0.7, None, draw())

    for term, values, factor, most in ((strain, code, 0.05, 0.06), (stray, table, 0.02, 0.002)):
        with torch.no_grad():  # so that the robust terms are not at their ends
            warp.shift.weight.mul_(factor)
            warp.turn.weight.mul_(factor)
        assert 0.01 < float(term(values).detach().mean()) / most < 0.95
        assert gradcheck(term, (values, *warp.parameters()), fast_mode=True)


def test_the_snapshot_asks_the_network_in_world_units():
    made = method("tnerf", **GENTLE)
    points, directions = torch.randn(4, 5, 3), torch.nn.functional.normalize(torch.randn(4, 3), dim=1)
    x, t = positional_encoding(points, 3), positional_encoding(torch.tensor([0.25]), 2)
    towards = positional_encoding(directions, 1)[:, None].expand(4, 5, -1)
    raw, color = made.network(torch.cat([x, t.expand(4, 5, -1)], -1), towards)
    first, field = made.fields(Moment(0.25))
    density, seen = field.radiance(points, directions[:, None])
    assert first is None
    assert_close((density, seen), (torch.nn.functional.softplus(raw), color))
    assert_close(field.density(points), density)
    assert made.at(Moment(0.25)).holds(Moment(0.25, camera=3))
    assert not made.at(Moment(0.25)).holds(Moment(0.2))


@pytest.mark.parametrize(("kind", "inside_box"), [*((kind, False) for kind in KINDS), ("tnerf", True)])
def test_a_step_gives_the_losses_of_its_passes(kind, inside_box):
    made = method(kind, inside_box=inside_box, **GENTLE)
    step = made.look(batch(), {"photo": 1.0}, draw())
    values = {name: term() for name, term in step.terms.items()}
    assert values["photo"].item() == step.squared_error.item()
    assert ("coarse_photo" in values) == (kind in ("nerf", *BENT))
    assert set(values) <= set(type(made).terms)
    sum(value for value in values.values() if value is not None).backward()
    assert all(p.grad is None or p.grad.isfinite().all() for p in made.parameters())
    blind = {name for name, p in made.named_parameters() if p.grad is None or not p.grad.any()}
    assert all("code" in name or "slice" in name for name in blind), blind
    assert {"density", "weights", "rgb"} == {name for name, _ in step.tensors()}
    assert step.noted["samples"] <= 144 * 24


def bias(network, value):
    torch.nn.init.constant_(network.density_head.bias, value)


@pytest.mark.parametrize(
    ("kind", "options", "kill", "advice"),
    [
        (
            "tnerf",
            {},
            lambda made: bias(made.network, -100),
            "set another seed=N, or model.sampling.density=softplus model.sampling.open_end=false",
        ),
        ("nerf", {}, lambda made: (bias(made.coarse, -100), bias(made.fine, 1)), "set another seed=N"),
        (
            "tnerf",
            {"occupancy": 8, **GENTLE},
            lambda made: made.occupancy.occupied.zero_(),
            "set another seed=N, or model.sampling.occupancy=0",
        ),
    ],
    ids=["all", "first pass", "nothing left"],
)
def test_a_dead_start_is_named(kind, options, kill, advice):
    made, generator = method(kind, **options), draw()
    kill(made)
    for _ in range(19):
        noted = made.look(batch(), {"photo": 1.0}, generator).noted
        assert (noted["opacity"] > 0) == (kind == "nerf")
        assert (noted["samples"] == 0) == ("occupancy" in options)
    with pytest.raises(ValueError, match=f"0 along every ray in each of 20 .*: a dead start; {advice}"):
        made.look(batch(), {"photo": 1.0}, generator)


@pytest.mark.slow
def test_a_start_that_comes_alive_is_none():
    made, generator = method("tnerf"), draw()
    for step in range(40):
        bias(made.network, 1.0 if step % 15 == 14 else -100)
        opacity = made.look(batch(), {"photo": 1.0}, generator).noted["opacity"]
        assert (opacity > 0) == (step % 15 == 14)


def test_pictures_say_where_matter_may_be():
    confined, free = (method("tnerf", occupancy=8, hull=hull, **GENTLE) for hull in (0.1, 0.0))
    clear = "what pictures show as clear is empty from the start"
    assert (clear in confined.departures(), clear in free.departures()) == (True, False)
    assert free.occupancy.possible.all()
    possible = confined.occupancy.possible
    assert 0 < int(possible.sum()) < len(possible)
    assert confined.occupancy.occupied.equal(possible)
    blank = TNeRF(replace(start(), blank=True), sampling=Sampling(occupancy=8, hull=0.1))
    assert blank.occupancy.possible.all()


@pytest.mark.parametrize("kind", ["nerf", *BENT])
def test_one_pass_has_one_network(kind):
    made = method(kind, fine_samples=0, **GENTLE)
    step = made.look(batch(), {"photo": 1.0}, draw())
    assert made.coarse is made.fields(Moment(0.5))[0] is step.terms["coarse_photo"]() is None
    assert step.noted["samples"] <= 144 * 12
    assert "one pass" in made.protocol()["departures"]


WITHOUT_WARP = "as Nerfies without its warp (the configuration was not published)"


@pytest.mark.parametrize(
    ("make", "departures", "faults"),
    [
        (NeRF, OF_PYTORCH, []),
        (DNeRF, OF_PYTORCH, ["offsets jump at the canonical time (continuous)"]),
        (partial(DNeRF, continuous=True), (*OF_PYTORCH, NO_JUMP), []),
        (Nerfies, OF_JAX, []),
        (partial(Nerfies, sampling=Sampling()), (*OF_JAX, "relu density"), []),
        (HyperNeRF, OF_JAX, ["pictures are drawn with random samples (jitter_in_pictures)"]),
        (
            partial(HyperNeRF, sampling=Sampling(density="softplus")),
            (*OF_JAX, "pictures are drawn without random samples"),
            [],
        ),
        (partial(NeRF, glorot=True, sampling=Sampling(density="softplus")), (WITHOUT_WARP, OF_JAX[0]), []),
        (
            partial(TNeRF, sampling=Sampling(jitter_in_pictures=True, inside_box=True, **GENTLE)),
            (
                *(*OF_PYTORCH, "softplus density", "the last interval ends with the ray"),
                *("empty outside the scene's box", "pictures are drawn with random samples"),
            ),
            [],
        ),
    ],
)
def test_departures_and_faults_are_those_of_the_publication(make, departures, faults):
    expected = {"departures": "; ".join(departures), "faults": "; ".join(faults)}
    assert make(start()).protocol() == {name: text for name, text in expected.items() if text}


@torch.no_grad()
def test_nerf_draws_the_same_image_at_all_times():
    made, view = skipping("nerf"), View(camera())
    first, later = (made.at(Moment(time)).render(view, WHITE) for time in (0.0, 0.7))
    assert first.rgb.equal(later.rgb)
    assert first.depth.equal(later.depth)


@torch.no_grad()
def give_without(template, other, columns):
    """Give a template the weights of another that reads more channels, without these columns of its input."""
    state, shapes = dict(other.state_dict()), template.state_dict()
    for name, weight in state.items():
        if weight.shape != shapes[name].shape:
            kept = torch.ones(weight.shape[1], dtype=torch.bool)
            kept[columns] = False
            state[name] = weight[:, kept]
    template.load_state_dict(state)


def test_tnerf_without_the_columns_of_its_time_is_the_nerf_of_its_weights():
    timed, static = skipping("tnerf"), skipping("nerf")
    times = slice(POINT, POINT + 5)
    give_without(static.fine, timed.network, times)
    for layer in timed.network.trunk.layers[:2]:
        assert not shown(timed, 0.2)[0].equal(shown(timed, 0.3)[0])
        with torch.no_grad():
            layer.weight[:, times] = 0
    for time in (0.25, 0.5):
        assert_close(shown(timed, time), shown(static, time))


def test_dnerf_at_the_canonical_time_is_its_nerf_alone():
    made = skipping("dnerf")
    points = torch.randn(64, 3, generator=torch.Generator().manual_seed(3))
    toward = positional_encoding(torch.tensor([0.0, 0.6, 0.8]), 1).expand(64, -1)
    raw, color = made.template(positional_encoding(points, 3), toward)
    assert_close(shown(made, 0.0), (torch.nn.functional.softplus(raw), color), rtol=0, atol=0)
    for time, moves in ((0.0, False), (0.5, True)):
        made.zero_grad(set_to_none=True)
        made.look(batch(time), {}, draw()).terms["photo"]().backward()
        moved = [name for name, p in made.named_parameters() if p.grad is not None and p.grad.any()]
        met = {name.split(".")[0] for name in moved}
        assert met == {"template"} | ({"offsets", "offset_head"} if moves else set())


def test_the_content_of_dnerf_moves_against_its_offset():
    made, shift, points = method("dnerf", **GENTLE), torch.tensor([0.1, -0.2, 0.3]), torch.randn(64, 3)
    with torch.no_grad():
        made.offset_head.weight.zero_()
        made.offset_head.bias.zero_()
        rest = shown(made, 0.5, points)
        assert rest[0].equal(shown(made, 0.0, points)[0])
        made.offset_head.bias.copy_(shift)
        assert_close(shown(made, 0.5, points - shift)[0], rest[0])
        assert_close(shown(made, 0.0, points)[0], rest[0])


def test_continuous_offsets_go_to_zero_at_the_canonical_time():
    jumps, glides = (skipping("dnerf", continuous=continuous) for continuous in (False, True))
    points = torch.randn(64, 3)
    assert float(glides.backward_flow(points, 1e-5).detach().abs().max()) < 1e-4
    assert float(jumps.backward_flow(points, 1e-5).detach().abs().mean()) > 1e-3


def test_the_second_time_is_a_neighbours_side_and_offsets_are_summed():
    made, asked = skipping("dnerf"), []

    def offset(points, time):
        asked.append(time)
        return time * torch.ones_like(points)

    made.backward_flow = offset
    seen, generator = SimpleNamespace(points=torch.zeros(7, 4, 3)), draw()
    for time, low, high in ((0.0, 0.0, 0.5), (0.5, 0.0, 1.0), (1.0, 0.5, 1.0)):
        term, between = made.extra_terms(seen, batch(time), generator)["second_time"], []
        for _ in range(200):
            value, (first, second) = float(term()), asked[-2:]
            assert first == time
            assert value == pytest.approx(7 * 4 * 3 * (time - second) ** 2, rel=1e-4, abs=1e-6)
            between.append(second)
        assert low <= min(between) < low + 0.05
        assert high - 0.05 < max(between) <= high
        assert sum(between) / 200 == pytest.approx((low + high) / 2, abs=0.05)


def test_nerfies_starts_as_near_the_identity_as_published():
    torch.manual_seed(0)
    points, warp = 0.8 * torch.rand(500, 3) - 0.4, ScrewWarp(8, **OF_WARP)
    code = TimeCodes((0.0, 1.0), 8)(0.0)
    for window, published in ((0.0, 1.0e-4), (6.0, 1.3e-3)):
        moved = (warp(points, code, window) - points).norm(dim=-1).mean()
        assert float(moved.detach()) == pytest.approx(published, rel=0.5)


@pytest.mark.parametrize("kind", BENT)
def test_octaves_that_are_not_in_count_nowhere(kind):
    made = liven(skipping(kind))
    for progress, octaves in ((0.0, 0.0), (0.16, 3.0), (1.0, 6.0)):
        assert made.advance(progress, 1, None)["octaves"] == made.octaves_in == pytest.approx(octaves)
        for layer in made.warp.trunk.layers[:2]:  # the second reads the input again
            before = shown(made, 0.5)[0]
            with torch.no_grad():
                layer.weight[:, 3 : 3 + 36] += 1.0
            assert shown(made, 0.5)[0].equal(before) == (octaves == 0)


def test_a_rigid_warp_is_not_elastic():
    warp = ScrewWarp(8, **OF_WARP)
    with torch.no_grad():
        for head, value in ((warp.turn, torch.tensor([0.3, -0.2, 0.5])), (warp.shift, torch.full((3,), 0.4))):
            head.weight.zero_()
            head.bias.copy_(value)
    assert_close(warp.elastic(torch.randn(20, 3), torch.zeros(8), 6.0), torch.zeros(20), atol=1e-5, rtol=0)


@pytest.mark.parametrize("factor", [2.0, 1.01])
def test_the_elastic_term_of_a_warp_that_scales(factor):
    warp, eye = ScrewWarp(2, frequencies=1, width=6, layers=2, skip=None), torch.eye(3)
    with torch.no_grad():
        for parameter in warp.parameters():
            parameter.zero_()
        warp.trunk.layers[0].weight[:, :3] = torch.cat([eye, -eye])  # one of x and -x passes the ReLU
        warp.trunk.layers[1].weight.copy_(torch.eye(6))
        warp.shift.weight.copy_((factor - 1) * torch.cat([eye, -eye], 1))
    points = torch.randn(9, 3)
    assert_close(warp(points, torch.zeros(2), 1.0), factor * points)
    q = 3 * math.log(factor) ** 2 / 0.03**2
    expected = torch.full((9,), 0.03 * 2 * q / (q + 4))
    assert_close(warp.elastic(points, torch.zeros(2), 1.0), expected, rtol=1e-4, atol=0)


@pytest.mark.slow
def test_the_elastic_term_is_summed_over_coarse_samples_and_averaged_over_rays():
    made, generator = liven(skipping("nerfies", elastic_samples=None)), draw()
    seen = made.along(Moment(0.5), View(camera()).rays(), WHITE, generator)
    strain = made.warp.elastic(seen.coarse.points.reshape(-1, 3), made.codes(0.5), 0.0).detach()
    expected = float((seen.coarse.weights.detach().reshape(-1) * strain).sum() / 144)
    term = made.extra_terms(seen, batch(), generator)["elastic"]
    found = term()
    found.backward()
    assert float(found.detach()) == pytest.approx(expected, rel=1e-4)
    assert made.warp.shift.weight.grad.any()
    assert all(p.grad is None for p in (*made.coarse.parameters(), *made.fine.parameters()))
    made.elastic_samples = 400  # of 144 x 12
    drawn = torch.stack([term().detach() for _ in range(30)])
    assert float(drawn.std()) > 0
    assert float(drawn.mean()) == pytest.approx(expected, rel=0.1)


def by_cameras(*ids):
    """Nerfies whose training pictures are of cameras with these ids, whose codes differ much."""
    scene = moving_scene()
    train = tuple(replace(frame, camera_id=camera) for frame, camera in zip(scene.train, ids))
    torch.manual_seed(0)
    made = Nerfies(start(replace(scene, train=train)), **SMALL, **WARP, sampling=Sampling(12, 12, **GENTLE))
    with torch.no_grad():
        made.camera_codes.table.copy_(torch.tensor([[9.0, -9.0], [-9.0, 9.0]]))
    return made


def test_a_snapshot_holds_what_it_draws_alike():
    for made, alike in ((by_cameras(1, 2, 2), False), (method("hypernerf", **GENTLE), True)):
        first, second = Moment(0.5, camera=1), Moment(0.5, camera=2)
        assert made.at(first).holds(second) == alike
        assert made.at(first).holds(replace(first, frame=3))
        with torch.no_grad():
            drawn = [made.at(moment).render(View(camera()), WHITE).rgb for moment in (first, second)]
        assert drawn[0].equal(drawn[1]) == alike


def test_each_view_of_a_batch_is_seen_by_the_code_of_its_camera():
    made, rgb = by_cameras(1, 2, 2), torch.rand(144, 3)
    both = [Observation(Moment(0.5, camera=i), View(camera()), rgb, WHITE) for i in (1, 2)]
    step = made.look(Batch(tuple(both), 0), {"photo": 1.0}, draw())
    assert step.noted["samples"] == 2 * 144 * 24
    sum(step.terms[name]() for name in ("photo", "coarse_photo")).backward()
    assert made.camera_codes.table.grad.ne(0).all()
    generator = draw()
    alone = [made.look(Batch((seen,), 0), {"photo": 1.0}, generator) for seen in both]
    assert float(step.squared_error) == pytest.approx(sum(float(one.squared_error) for one in alone) / 2)
    assert dict(step.tensors())["rgb"].shape == (288, 3)


@pytest.mark.parametrize("kind", BENT)
def test_points_that_never_move_are_pulled_to_stay(kind):
    made, generator = method(kind, still=torch.randn(50, 3), **GENTLE), draw()
    seen = made.along(Moment(0.5), View(camera()).rays(), WHITE, generator)
    term = made.extra_terms(seen, batch(), generator)["still"]
    low = float(term().detach())
    torch.nn.init.constant_(made.warp.shift.bias, 0.1)
    assert low < 0.001 < 0.0019 < float(term().detach()) <= 0.002
    assert method(kind, **GENTLE).extra_terms(seen, batch(), generator)["still"]() is None


def test_hypernerf_without_its_slice_is_the_nerfies_of_its_weights():
    sliced, bent = liven(skipping("hypernerf")), skipping("nerfies", camera_code_size=0)
    bent.codes.load_state_dict(sliced.codes.state_dict())
    bent.warp.load_state_dict(sliced.warp.state_dict())
    for which in ("coarse", "fine"):
        give_without(getattr(bent, which), getattr(sliced, which), slice(POINT, POINT + 4))
    bent.window.fill_(2.5)
    sliced.windows.copy_(torch.tensor([2.5, 0.0]))
    assert_close(shown(sliced, 0.25), shown(bent, 0.25))
    ours, theirs = (made.along(Moment(0.25), View(camera()).rays(), WHITE) for made in (sliced, bent))
    assert_close((ours.rgb, ours.coarse.rgb), (theirs.rgb, theirs.coarse.rgb))
    sliced.advance(1.0, 1, None)
    assert sliced.windows.tolist() == [6.0, 1.0]
    sliced.windows[0] = 2.5
    assert not shown(sliced, 0.25)[0].allclose(shown(bent, 0.25)[0])


def test_pictures_of_a_jittered_method_are_drawn_alike():
    plain, jittered = (method("tnerf", jitter_in_pictures=jitter, **GENTLE) for jitter in (False, True))
    with torch.no_grad():
        snapshots = (made.at(Moment(0.5)) for made in (jittered, jittered, plain))
        first, again, other = (snapshot.render(View(camera()), WHITE).rgb for snapshot in snapshots)
    assert first.equal(again)
    assert not first.equal(other)


@pytest.mark.slow
@pytest.mark.parametrize("kind", KINDS)
def test_it_learns_what_moves(kind, tmp_path):
    weights = dict.fromkeys({"photo", "coarse_photo"} & set(KINDS[kind].func.terms), 1.0)
    model = partial(KINDS[kind], sampling=Sampling(12, 12, **GENTLE))
    psnr, ceiling = psnr_after(model, tmp_path, weights, iterations=260), static_ceiling()
    assert ceiling - 3 < psnr <= ceiling if kind == "nerf" else psnr > ceiling + 3


FIELD = {"width": 48, "layers": 3, "skip": None, "position_frequencies": 4, "direction_frequencies": 1}
BEND = {"warp_width": 32, "warp_layers": 3, "warp_skip": None, "warp_frequencies": 3}
OF_THE_NICHE = {  # with the steps that it takes to tell the two of a pair apart
    "tnerf": (partial(TNeRF, **FIELD, time_frequencies=2), 1000),
    "hypernerf": (partial(HyperNeRF, **FIELD, **BEND, slice_width=32), 500),
    "dnerf": (partial(DNeRF, **FIELD, time_frequencies=2), 1000),
    "nerfies": (partial(Nerfies, **FIELD, **BEND, elastic_samples=64), 500),
}


@pytest.mark.slow
def test_fields_that_know_the_time_show_what_appears_better_than_bent_ones(tmp_path):
    """Each beside the one that it adds the time, or its slice, to."""
    psnr, rates = {}, {"lr": {"network": 3e-3}, "lr_final_factor": 0.1}
    for kind, (model, steps) in OF_THE_NICHE.items():
        weights = {"photo": 1.0} | ({"elastic": 1e-3} if kind == "nerfies" else {})
        model = partial(model, sampling=Sampling(16, 0, **GENTLE))
        how = {"read": niche_scene, "rays": 128, "seed": 2, "iterations": steps}
        psnr[kind] = psnr_after(model, tmp_path / kind, weights, **how, **rates)
    assert psnr["tnerf"] > psnr["dnerf"] + 1, psnr
    assert psnr["hypernerf"] > psnr["nerfies"] + 1, psnr
