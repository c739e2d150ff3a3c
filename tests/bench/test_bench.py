"""The benchmarks in tiny sizes: what they time, and the tables that they write."""

import json
from dataclasses import replace
from functools import cache

import pytest
import torch

from forewarp.training.objective import total
from tests.bench import particles, performance, start_up
from tests.bench.faithful import FIELDS, known_rows, measured, write
from tests.bench.limits import REGIONS, by_time, error_shares, limits_of, main, regions
from tests.bench.particles import Loop, Size, figure
from tests.bench.workloads import CASES, make_module
from tests.stability.report import implementation

TINY = Size(particles=300, side=32, nodes=9)


@cache
def taken(dense, threshold=0.0):
    """Take a step; return its images, the step, the features' gradient (X, Y, Z, C) and the radiance."""
    module, batch = make_module(20, dense, rays=400, shift=2.0, threshold=threshold)
    with implementation("reference" if dense else "Numba"):
        factors = module.objective.factors(0)
        step = module.look(batch, factors)
        total(step, factors)[0].backward()
    radiance = module.method.radiance
    gradient = torch.zeros(*radiance.lattice.shape, 12)
    x, y, z = radiance.voxels.unbind(-1)
    gradient[x, y, z] = radiance.features.grad
    images = {name.removesuffix(".rgb"): t.detach() for name, t in step.tensors() if name.endswith(".rgb")}
    return images, step, gradient, radiance


# The one saving that is not exact: no colour for samples of less weight than 1e-4.
@pytest.mark.slow
@pytest.mark.parametrize(("threshold", "most"), [(0.0, 1e-4), (1e-4, 5e-4)])
def test_a_step_on_what_is_occupied_draws_what_the_dense_one_draws(threshold, most):
    images, step, _, radiance = taken(False, threshold)
    exact, whole, _, everything = taken(True)
    assert len(radiance.voxels) < 0.12 * len(everything.voxels)
    assert step.noted["samples"] < 0.5 * whole.noted["samples"]
    assert exact.keys() == images.keys() == {"upsampled", "inpainted"}
    for name, image in exact.items():
        assert image.std() > 0.05
        torch.testing.assert_close(images[name], image, atol=most, rtol=0)


@pytest.mark.slow
def test_a_step_on_what_is_occupied_learns_what_the_dense_one_learns():
    inside, everywhere = taken(False)[2], taken(True)[2]
    present = inside.abs().amax(-1) > 0
    assert int(present.sum()) > 100
    scale = everywhere.abs().max()
    assert float((inside - everywhere)[present].abs().max()) < 1e-3 * scale


@pytest.mark.slow
@pytest.mark.parametrize(("name", "dense"), [("splat", True), ("fields", False), ("inpaint", False)])
def test_every_operator_can_be_timed(name, dense):
    seen = []
    with torch.autograd.graph.saved_tensors_hooks(lambda t: seen.append(t) or t, lambda t: t):
        CASES[name].make(12, dense)()
    assert seen  # the gradient is timed too


@pytest.mark.slow
def test_tables_of_voxels_are_made(monkeypatch):
    monkeypatch.setattr(performance, "by_itself", lambda side, rays: 1e6)
    lines = performance.goals_table(side=8, rays=16, picture=12, frame_side=8).splitlines()
    assert lines[3].endswith("| reached |")
    assert performance.splat_error(80) <= 1e-5
    monkeypatch.setattr(performance, "cost_of", lambda case, size, dense: (1e-8 * size**3, 3 * 2**20))
    text = performance.growth_tables({"splat": replace(CASES["splat"], dense_sizes=(32,))})
    assert "**splat**: seconds grow as its cube to the power 1.00" in text
    assert "| 32 | 0.328 | 3 | 0.328 | 3 | 1.0 |" in text


@pytest.fixture(scope="module")
def loop():
    return Loop(TINY)


@pytest.mark.slow
def test_the_figure_is_as_large_as_asked_and_stays_so(loop):
    assert (len(loop.method.gaussians.means), len(loop.method.deformation.nodes.positions)) == (300, 9)
    before = loop.method.gaussians.means.detach().clone()
    for _ in range(3):
        loop.step()
    assert len(loop.method.gaussians.means) == 300
    assert float((loop.method.gaussians.means.detach() - before).abs().max()) > 0
    assert loop.picture().shape == (32 * 32, 3)
    assert figure(100)[1] == pytest.approx(2 * figure(400)[1])  # a quarter as many are twice as far apart


def test_every_kernel_of_a_step_belongs_to_a_part(loop):
    with particles.kernels_timed() as spent:
        loop.step()
        loop.picture()
    assert len(spent) > 10
    counted = {
        key
        for kernels in particles.PARTS.values()
        for part, names in kernels
        for key in spent
        if key[0] == part and (not names or key[1] in names)
    }
    assert counted == spent.keys()


@pytest.mark.slow
def test_tables_of_particles_are_made(monkeypatch):
    monkeypatch.setattr(particles, "STEPS", 2)
    monkeypatch.setattr(particles, "FEW", 1)
    text = particles.parts_table(TINY)
    for name in (*particles.PARTS, "**a whole step**", "**a picture**"):
        (line,) = (line for line in text.splitlines() if line.startswith(f"| {name} |"))
        cells = [cell.strip() for cell in line.split("|")[2:-1]]
        assert all(float(cell) > 0 for cell in cells if cell)
        # Plain PyTorch has no tiles.
        assert bool(cells[2]) == (name in particles.PARTS and name != "sorting into tiles")
    grown = particles.growth_table(TINY, {"particles": (100, 200), "nodes": (4, 9)})
    assert grown.count("to the power") == 2
    assert "**threads**" in grown
    lines = particles.effects_table(TINY).splitlines()[2:]
    assert [line.split("|")[1].strip() for line in lines] == list(particles.ALONE)
    assert all(float(cell) > 0 for line in lines for cell in line.split("|")[2:-1])
    assert min(particles.lightning_shares(TINY, 4)) > 0
    monkeypatch.setattr(particles, "lightning_shares", lambda size, steps: (0.010, 0.007))
    assert "| 70%: 10 and 7 ms | **missed** |" in particles.goals_table(TINY)


@pytest.mark.slow
def test_a_start_is_timed_by_its_parts(tmp_path):
    small = ["data.synthesis.size=32", "data.synthesis.frames=8", "data.synthesis.test_views=[1,1,1]"]
    spent = start_up.started([*start_up.USUAL, "data.scene=tiny", f"paths.data={tmp_path}", *small])
    assert spent.keys() >= {label for *_, label in start_up.COUNTED} | {start_up.WHOLE}
    assert sum(s for name, s in spent.items() if name != start_up.WHOLE) <= spent[start_up.WHOLE] + 0.1


@pytest.mark.slow
def test_a_step_with_published_numbers_is_counted_and_timed(fitted):
    scene = fitted.parent / "scenes" / "vehicle"
    step = measured("tnerf", scene, 4)
    assert (step["rays"], step["of"], step["parameters"]) == (4, 500, 600_452)
    assert min(step["flop"], step["seconds"]) > 0
    assert step["bytes"] > 12 * step["parameters"]  # with gradients and Adam's moments
    assert set(json.loads(json.dumps(step))) == set(FIELDS)


def test_a_method_that_failed_says_why_in_its_row(tmp_path):
    page = tmp_path / "page.md"
    page.write_text("# Steps\n<!-- steps -->\n<!-- end of steps -->\n")
    row = {"method": "nerf", "of": 1000, "rays": 1000, "flop": 3 * 10**9, "seconds": 8.64, "bytes": 2**30}
    row |= {"parameters": 1_500_000, "steps": 20_000, "failed": "", "scene": "ball", "day": "today"}
    less = row | {"method": "nerfies", "rays": 500}
    failed = dict.fromkeys(FIELDS) | {"method": "ndvg", "failed": "killed", "scene": "ball", "day": "today"}
    write([row, less, failed], page)
    lines = page.read_text().splitlines()
    assert "| `nerf` | 1,000 | 3 | 3.0 | 8.6 | 1.0 | 1.50 | 20,000 | 2.0 |" in lines
    shown = "1,000, measured with 500 | ≈ 6 | 6.0 | ≈ 17.3 | 1.0 with 500 | 1.50 | 20,000 | ≈ 4.0 |"
    assert f"| `nerfies` | {shown}" in lines
    assert any(line.startswith("| `ndvg` | killed |") for line in lines)
    assert known_rows(page.with_suffix(".csv"))[:2] == [row, less]


NOISE = torch.rand(40, 48, 3, generator=torch.Generator().manual_seed(0))
DISC = (torch.arange(40)[:, None] - 20) ** 2 + (torch.arange(48)[None] - 20) ** 2 < 100


@pytest.mark.slow
def test_limits_of_a_run_are_a_row(fitted, capsys, monkeypatch):
    rows = []
    monkeypatch.setattr("tests.bench.limits.limits_of", lambda run: rows.append(limits_of(run, 2)) or rows[0])
    main([str(fitted)])
    head, _, line = (
        [cell.strip() for cell in row.split("|")[1:-1]] for row in capsys.readouterr().out.splitlines()
    )
    assert (head[0], line[0], len(line)) == ("scene", "vehicle", len(head))
    (row,) = rows
    assert row["outside"] + row["outline"] + row["inside"] == pytest.approx(1)
    assert row["low-passed truth"] > row["test views"] > 5
    assert row["voxel, pixels"] > 1


def test_limits_by_time():
    means = by_time([(0.0, 20.0), (0.1, 22.0), (0.5, 30.0)])
    expected = {"test views": 24.0, "first fifth": 21.0, "between": 30.0, "last fifth": float("nan")}
    assert means == pytest.approx(expected, nan_ok=True)


def test_regions_share_no_pixel_and_miss_none():
    masks = regions(DISC)
    assert list(masks) == list(REGIONS)
    assert (sum(mask.int() for mask in masks.values()) == 1).all()
    assert masks["inside"][20, 20]
    assert masks["outside"][0, 0]
    assert masks["outline"][20, [26, 29, 30, 33]].tolist() == [False, True, True, False]
    assert regions(torch.ones(5, 7, dtype=bool))["inside"].all()


def test_errors_are_shared_out_whole():
    image = NOISE.clone()
    image[20, 20] += 1.0
    image[0, 0] += 2.0
    shares = {name: round(float(error), 4) for name, error in error_shares(NOISE, image, DISC).items()}
    assert shares == {"outside": 4.0, "outline": 0.0, "inside": 1.0}
