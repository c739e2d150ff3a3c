"""NeRF, T-NeRF, D-NeRF, Nerfies and HyperNeRF: sizes, identities, what they can learn."""

from dataclasses import replace
from functools import partial

import pytest
import torch

from forewarp.methods.dnerf import DNeRF
from forewarp.methods.hypernerf import HyperNeRF
from forewarp.methods.method import parameter_count
from forewarp.methods.nerf import NeRF
from forewarp.methods.nerfies import Nerfies
from forewarp.methods.rays import NO_JUMP, OF_JAX, OF_PYTORCH, Sampling
from forewarp.methods.tnerf import TNeRF
from forewarp.ops.encode import positional_encoding
from forewarp.scene.view import Batch, Moment, Observation, View
from tests.support.sampled_methods import GENTLE, KINDS, SMALL, WARP, batch, learned, method, shown, start
from tests.support.still_cameras import camera, moving_scene, static_ceiling


@pytest.mark.parametrize(
    ("make", "count"),
    [
        (NeRF, 1_191_688),
        (partial(NeRF, position_frequencies=8, skip=5, glorot=True), 1_179_400),
        (TNeRF, 600_452),
        (partial(TNeRF, time_frequencies=10), 606_596),
        (DNeRF, 1_095_047),
        (Nerfies, 1_275_410 - 2 + 3 * 8),  # one camera, where the rig has two; three times
        (partial(Nerfies, camera_code_size=0), 2 * 589_700 + 95_494 + 3 * 8),
        (HyperNeRF, 1_305_616 + 3 * 8),
    ],
)
def test_published_counts(make, count):
    assert parameter_count(make(start())) == count


def test_the_snapshot_asks_the_network_in_world_units():
    made = method("tnerf", **GENTLE)
    points, directions = torch.randn(4, 5, 3), torch.nn.functional.normalize(torch.randn(4, 3), dim=1)
    x, t = positional_encoding(points, 3), positional_encoding(torch.tensor([0.25]), 2)
    raw, color = made.network(
        torch.cat([x, t.expand(4, 5, -1)], -1), positional_encoding(directions, 1)[:, None].expand(4, 5, -1)
    )
    first, field = made.fields(Moment(0.25))
    density, seen = field.radiance(points, directions[:, None])
    assert first is None
    torch.testing.assert_close(density, torch.nn.functional.softplus(raw))
    torch.testing.assert_close(seen, color)
    torch.testing.assert_close(field.density(points), density)
    assert made.at(Moment(0.25)).holds(Moment(0.25, camera=3))
    assert not made.at(Moment(0.25)).holds(Moment(0.2))


@pytest.mark.parametrize("inside_box", [False, True])
@pytest.mark.parametrize("kind", KINDS)
def test_a_step_gives_the_losses_of_its_passes(kind, inside_box):
    made = method(kind, inside_box=inside_box, **GENTLE)
    step = made.look(batch(), {"photo": 1.0}, torch.Generator().manual_seed(0))
    values = {name: term() for name, term in step.terms.items()}
    assert values["photo"].item() == step.squared_error.item()
    assert ("coarse_photo" in values) == (kind in ("nerf", "nerfies", "hypernerf"))
    assert set(values) <= set(type(made).terms)
    sum(value for value in values.values() if value is not None).backward()
    assert all(p.grad is None or p.grad.isfinite().all() for p in made.parameters())
    blind = {name for name, p in made.named_parameters() if p.grad is None or not p.grad.any()}
    assert all("code" in name or "slice" in name for name in blind), blind
    assert {"density", "weights", "rgb"} == {name for name, _ in step.tensors()}
    assert step.noted["samples"] <= 144 * 24


def test_a_dead_start_is_named():
    made = method("tnerf")
    with torch.no_grad():
        made.network.density_head.bias.fill_(-100)
    generator = torch.Generator().manual_seed(0)
    for _ in range(19):
        assert made.look(batch(), {"photo": 1.0}, generator).noted["opacity"] == 0
    advice = "set another seed=N, or model.sampling.density=softplus model.sampling.open_end=false"
    with pytest.raises(ValueError, match=f"a dead start; {advice}"):
        made.look(batch(), {"photo": 1.0}, generator)


def test_a_first_pass_that_is_dead_alone_is_named():
    made, generator = method("nerf"), torch.Generator().manual_seed(0)
    with torch.no_grad():
        made.coarse.density_head.bias.fill_(-100)
        made.fine.density_head.bias.fill_(1)
    for _ in range(19):
        assert made.look(batch(), {"photo": 1.0}, generator).noted["opacity"] > 0
    with pytest.raises(ValueError, match="a dead start"):
        made.look(batch(), {"photo": 1.0}, generator)


def test_a_field_that_nothing_is_left_of_is_dead():
    made = method("tnerf", occupancy=8, **GENTLE)
    made.occupancy.occupied.zero_()
    generator = torch.Generator().manual_seed(0)
    for _ in range(19):
        assert made.look(batch(), {"photo": 1.0}, generator).noted["samples"] == 0
    with pytest.raises(ValueError, match=r"0 along every ray in each of 20 .* or model.sampling.occupancy=0"):
        made.look(batch(), {"photo": 1.0}, generator)


def test_pictures_say_where_matter_may_be():
    confined, free = (method("tnerf", occupancy=8, hull=hull, **GENTLE).occupancy for hull in (0.1, 0.0))
    assert free.possible.all()
    clear = "what pictures show as clear is empty from the start"
    assert clear in method("tnerf", occupancy=8, hull=0.1, **GENTLE).departures()
    assert clear not in method("tnerf", occupancy=8, hull=0.0, **GENTLE).departures()
    assert 0 < int(confined.possible.sum()) < len(confined.possible)
    assert confined.occupied.equal(confined.possible)
    blank = TNeRF(replace(start(), blank=True), sampling=Sampling(occupancy=8, hull=0.1))
    assert blank.occupancy.possible.all()
    with pytest.raises(ValueError, match=r"model.sampling.hull: expected a fraction in \[0, 1\], but got 2"):
        Sampling(hull=2)


@pytest.mark.parametrize("kind", ["nerf", "nerfies", "hypernerf"])
def test_one_pass_has_one_network(kind):
    made = method(kind, fine_samples=0, **GENTLE)
    step = made.look(batch(), {"photo": 1.0}, torch.Generator().manual_seed(0))
    assert made.coarse is None
    assert made.fields(Moment(0.5))[0] is None
    assert step.terms["coarse_photo"]() is None
    assert step.noted["samples"] <= 144 * 12
    assert "one pass" in made.protocol()["departures"]


def test_a_start_that_comes_alive_is_none():
    made, generator = method("tnerf"), torch.Generator().manual_seed(0)
    for step in range(40):
        with torch.no_grad():
            made.network.density_head.bias.fill_(1.0 if step % 15 == 14 else -100)
        opacity = made.look(batch(), {"photo": 1.0}, generator).noted["opacity"]
        assert (opacity > 0) == (step % 15 == 14)


@pytest.mark.parametrize(
    ("make", "departures", "faults"),
    [
        (NeRF, OF_PYTORCH, []),
        (TNeRF, OF_PYTORCH, []),
        (DNeRF, OF_PYTORCH, ["offsets jump at the canonical time (continuous)"]),
        (partial(DNeRF, continuous=True), (*OF_PYTORCH, NO_JUMP), []),
        (Nerfies, OF_JAX, []),
        (HyperNeRF, OF_JAX, ["pictures are drawn with random samples (jitter_in_pictures)"]),
        (
            partial(HyperNeRF, sampling=Sampling(density="softplus")),
            (*OF_JAX, "pictures are drawn without random samples"),
            [],
        ),
        (
            partial(NeRF, glorot=True, sampling=Sampling(density="softplus")),
            ("as Nerfies without its warp (the configuration was not published)", OF_JAX[0]),
            [],
        ),
        (
            partial(TNeRF, sampling=Sampling(jitter_in_pictures=True)),
            (*OF_PYTORCH, "pictures are drawn with random samples"),
            [],
        ),
    ],
)
def test_departures_and_faults_are_those_of_the_publication(make, departures, faults):
    made = make(start())
    expected = {"departures": "; ".join(departures), "faults": "; ".join(faults)}
    assert made.protocol() == {name: text for name, text in expected.items() if text}


def test_its_protocol_names_departures():
    published = method("tnerf").protocol()["departures"]
    changed = method("tnerf", inside_box=True, occupancy=8, **GENTLE).protocol()["departures"]
    assert "softplus" not in published
    assert changed.startswith(published)
    assert "softplus density; the last interval ends with the ray; empty outside" in changed
    assert "relu density" in method("nerfies").protocol()["departures"]


def test_nerf_shows_the_same_at_all_times():
    made = method("nerf", **GENTLE)
    for one, other in zip(shown(made, 0.0), shown(made, 0.7)):
        assert one.equal(other)


def test_tnerf_without_its_time_is_a_nerf():
    made = method("tnerf", **GENTLE)
    assert not shown(made, 0.2)[0].equal(shown(made, 0.3)[0])
    with torch.no_grad():
        made.network.trunk.layers[0].weight[:, 21:] = 0  # after the position's columns
    assert shown(made, 0.2)[0].equal(shown(made, 0.3)[0])


def test_dnerf_at_the_canonical_time_is_its_nerf():
    made = method("dnerf", **GENTLE)
    points = torch.randn(64, 3, generator=torch.Generator().manual_seed(3))
    expected = torch.nn.functional.softplus(made.template.density(positional_encoding(points, 3)))
    density = shown(made, 0.0)[0]
    assert density.equal(expected)
    density.sum().backward()
    assert made.offset_head.weight.grad is None
    assert not shown(made, 0.5)[0].equal(density)


def test_the_content_of_dnerf_moves_against_its_offset():
    made, shift = method("dnerf", **GENTLE), torch.tensor([0.1, -0.2, 0.3])
    with torch.no_grad():
        made.offset_head.weight.zero_()
        made.offset_head.bias.zero_()
        points = torch.randn(64, 3)
        rest = shown(made, 0.5, points)
        assert rest[0].equal(shown(made, 0.0, points)[0])
        made.offset_head.bias.copy_(shift)
        torch.testing.assert_close(shown(made, 0.5, points - shift)[0], rest[0])
        torch.testing.assert_close(shown(made, 0.0, points)[0], rest[0])


def test_continuous_offsets_go_to_zero_at_the_canonical_time():
    jumps, glides = (
        KINDS["dnerf"](start(), sampling=Sampling(**GENTLE), continuous=continuous)
        for continuous in (False, True)
    )
    points = torch.randn(64, 3)
    assert float(glides.offset(points, 1e-5).detach().abs().max()) < 1e-4
    assert float(jumps.offset(points, 1e-5).detach().abs().mean()) > 1e-3


def test_nerfies_starts_near_the_identity_and_lets_octaves_in():
    made = Nerfies(start())
    points = 0.8 * torch.rand(500, 3) - 0.4
    for window, most in ((0.0, 1e-3), (6.0, 1e-2)):
        moved = made.warp(points, made.codes(0.5), window).detach()
        assert 0 < float((moved - points).norm(dim=-1).mean()) < most
    optimizer = torch.optim.SGD(made.parameters(), 0.0)
    for progress, octaves in ((0.0, 0.0), (0.16, 3.0), (0.32, 6.0), (1.0, 6.0)):
        assert made.advance(progress, 1, optimizer)["octaves"] == pytest.approx(octaves)
        assert float(made.window) == pytest.approx(octaves)


def test_waves_that_are_not_let_in_do_not_matter():
    made = method("nerfies", **GENTLE)
    before = shown(made, 0.5)[0]
    with torch.no_grad():
        made.warp.trunk.layers[0].weight[:, 3 : 3 + 36] += 1.0
    assert shown(made, 0.5)[0].equal(before)


def test_equal_codes_look_equal():
    for kind in ("nerfies", "hypernerf"):
        made = method(kind, **GENTLE)
        made.advance(1.0, 1, torch.optim.SGD(made.parameters(), 0.0))
        with torch.no_grad():
            made.codes.table[1] = made.codes.table[0]
        assert shown(made, 0.0)[0].equal(shown(made, 0.5)[0])
        assert not shown(made, 0.0)[0].equal(shown(made, 1.0)[0])


def test_a_rigid_warp_is_not_elastic_and_one_that_doubles_is():
    made = Nerfies(start())
    points = torch.randn(20, 3)
    with torch.no_grad():
        for head in (made.warp.turn, made.warp.shift):
            head.weight.zero_()
        made.warp.turn.bias.copy_(torch.tensor([0.3, -0.2, 0.5]))
        made.warp.shift.bias.fill_(0.4)
    rigid = made.warp.elastic(points, made.codes(0.5), 6.0)
    torch.testing.assert_close(rigid, torch.zeros(20), atol=1e-5, rtol=0)
    other = Nerfies(start())
    with torch.no_grad():
        for head in (other.warp.turn, other.warp.shift):
            head.weight.mul_(1e3)
    bent = other.warp.elastic(points, other.codes(0.5), 6.0)
    assert float(bent.detach().mean()) > 0.5
    bent.sum().backward()
    assert other.warp.shift.weight.grad.isfinite().all()


def by_cameras(*ids):
    """Nerfies whose training pictures are of cameras with these ids, whose codes differ much."""
    scene = moving_scene()
    train = tuple(replace(frame, camera_id=camera) for frame, camera in zip(scene.train, ids))
    torch.manual_seed(0)
    options = SMALL | WARP | {"sampling": Sampling(12, 12, **GENTLE)}
    made = Nerfies(start(replace(scene, train=train)), **options)
    with torch.no_grad():
        made.camera_codes.table.copy_(torch.tensor([[9.0, -9.0], [-9.0, 9.0]]))
    return made


def test_a_snapshot_holds_what_it_draws_alike():
    plain = method("hypernerf", **GENTLE)
    for made, alike in ((by_cameras(1, 2, 2), False), (plain, True)):
        one, other = Moment(0.5, camera=1), Moment(0.5, camera=2)
        assert made.at(one).holds(other) == alike
        assert made.at(one).holds(replace(one, frame=3))
        with torch.no_grad():
            drawn = [made.at(m).render(View(camera()), torch.ones(3)).rgb for m in (one, other)]
        assert drawn[0].equal(drawn[1]) == alike


def test_each_view_of_a_batch_is_seen_by_the_code_of_its_camera():
    made = by_cameras(1, 2, 2)
    rgb, white = torch.rand(144, 3), torch.ones(3)
    both = [Observation(Moment(0.5, camera=i), View(camera()), rgb, white) for i in (1, 2)]
    step = made.look(Batch(tuple(both), 0), {"photo": 1.0}, torch.Generator().manual_seed(0))
    assert step.noted["samples"] == 2 * 144 * 24
    sum(step.terms[name]() for name in ("photo", "coarse_photo")).backward()
    assert made.camera_codes.table.grad.ne(0).all()
    generator = torch.Generator().manual_seed(0)
    alone = [made.look(Batch((one,), 0), {"photo": 1.0}, generator) for one in both]
    mean = sum(float(one.squared_error) for one in alone) / 2
    assert float(step.squared_error) == pytest.approx(mean)
    assert dict(step.tensors())["rgb"].shape == (288, 3)


def test_points_that_never_move_are_pulled_to_stay():
    still = torch.randn(50, 3)
    for kind in ("nerfies", "hypernerf"):
        made = method(kind, still=still, **GENTLE)
        draw = torch.Generator().manual_seed(0)
        seen = made.along(Moment(0.5), View(camera()).rays(), torch.ones(3), draw)
        (term,) = (t for n, t in made.extra_terms(seen, batch(), {}, draw).items() if n == "still")
        low = float(term().detach())
        with torch.no_grad():
            made.warp.shift.bias.fill_(0.1)
        assert low < 1 < 1.9 < float(term().detach()) <= 2
        bare = method(kind, **GENTLE)
        assert bare.extra_terms(seen, batch(), {}, draw)["still"]() is None


def test_hypernerf_without_its_slice_ignores_it():
    made = method("hypernerf", **GENTLE)
    optimizer = torch.optim.SGD(made.parameters(), 0.0)
    for progress, matters in ((0.0, False), (1.0, True)):
        made.advance(progress, 1, optimizer)
        before = shown(made, 0.5)[0]
        with torch.no_grad():
            made.slice.head.bias += 0.3
        assert shown(made, 0.5)[0].equal(before) != matters
    assert made.windows.tolist() == [6.0, 1.0]


def test_pictures_of_a_jittered_method_are_drawn_alike():
    plain, jittered = (method("tnerf", jitter_in_pictures=jitter, **GENTLE) for jitter in (False, True))
    with torch.no_grad():
        one, two, other = (
            made.at(Moment(0.5)).render(View(camera()), torch.ones(3)).rgb
            for made in (jittered, jittered, plain)
        )
    assert one.equal(two)
    assert not one.equal(other)


@pytest.mark.parametrize(
    "kind", ["tnerf", *(pytest.param(k, marks=pytest.mark.slow) for k in KINDS if k != "tnerf")]
)
def test_it_learns_what_moves(kind, tmp_path):
    psnr = learned(kind, tmp_path)[1]
    if kind == "nerf":
        assert static_ceiling() - 3 < psnr <= static_ceiling()
    else:
        assert psnr > static_ceiling() + 3
