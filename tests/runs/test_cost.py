"""What jobs will take, from measured ones: numbers worked out by hand."""

import json
import time
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path

import pytest
from omegaconf import OmegaConf

from forewarp.runs import cost
from forewarp.runs.cost import (
    PRICES,
    Job,
    Row,
    add_cost,
    cost_of,
    joined,
    measured_cost,
    own_file,
    read_costs,
    total,
)
from tests.bench.prices import faithful_prices, prices_of

CPU = "a cpu"
LIKE = Row("particles", "fast", "hook", "abc", CPU, 1.0, views=20.0, pixels=160_000.0)
# 0.02 s a step; a view takes 0.1 s to render and 0.4 s to score; 10 s for all else.
MEASURED = replace(
    LIKE, day="2026-11-28", steps=1000.0, seconds=20.0, processor=20.0, frame=0.1, scoring=0.4, rest=10.0
)
MEASURED = replace(MEASURED, memory=0.5, disk=2e6)
PRICE = replace(MEASURED, scene="", numbers="", device="AMD EPYC", seconds=50.0, scoring=None, rest=None)


def job(minutes=None, iterations=None, folder="a", clock="wall", like=LIKE, **more):
    return Job(Path(folder), like, minutes, iterations, clock, **more)


def test_minutes_are_given_and_all_else_is_added():
    found = cost_of(job(2.0), [MEASURED], [PRICE])
    assert (found.training, found.wall, found.source) == (120.0, pytest.approx(140.0), "this machine")
    assert (found.memory, found.disk, found.unknown) == (0.5, 2e6, [])
    assert cost_of(job(2.0, evaluate=False), [MEASURED], []).wall == pytest.approx(130.0)


def test_steps_are_multiplied_and_the_first_bound_ends_training():
    assert cost_of(job(iterations=300), [MEASURED], []).training == pytest.approx(6.0)
    assert cost_of(job(2.0, 300), [MEASURED], []).training == pytest.approx(6.0)
    assert cost_of(job(0.05, 300), [MEASURED], []).training == pytest.approx(3.0)


def test_views_are_scaled_by_their_pixels():
    few = replace(LIKE, views=5.0, pixels=40_000.0)
    assert cost_of(job(1.0, like=few), [MEASURED], []).wall == pytest.approx(60 + 10 + 5 * (0.1 / 4 + 0.4))


def test_a_small_run_tells_little_of_large_views():
    tiny = replace(MEASURED, scene="ball", views=3.0, pixels=1024.0, frame=0.001, scoring=0.1, rest=30.0)
    # 0.001 s become 0.156 s by the pixels; scoring and what a run takes once are not multiplied by them.
    frame = 0.001 * 160_000 / 1024
    assert cost_of(job(1.0), [tiny], []).wall == pytest.approx(60 + 30 + 20 * (frame + 0.1))
    others = [replace(MEASURED, scene="lego"), *[tiny] * 3]
    found = cost_of(job(1.0, like=replace(LIKE, scene="new")), [*others, *[others[0]] * 2], [])
    assert found.wall == pytest.approx(60 + 10 + 20 * 0.5)  # of those with as many pixels


def test_processor_minutes_of_two_threads_are_half_as_many_of_the_wall_clock():
    two = replace(MEASURED, threads=2.0, processor=40.0)
    of_two = replace(LIKE, threads=2.0)
    found = cost_of(job(1.0, clock="processor", like=of_two, evaluate=False), [two], [])
    assert (found.training, found.wall, found.processor) == (30.0, 40.0, 70.0)


def test_the_most_alike_of_this_machine_are_taken_before_the_price_list():
    other = replace(MEASURED, scene="lego", seconds=90.0)
    found = cost_of(job(iterations=1000), [MEASURED, other, other, other], [PRICE])
    assert found.training == 90.0  # the median of 20, 90 and 90
    assert cost_of(job(iterations=1000), [*[MEASURED] * 3, *[other] * 9], []).training == 20.0
    elsewhere = replace(MEASURED, device="another cpu")
    found = cost_of(job(iterations=1000), [elsewhere], [PRICE])
    assert (found.training, found.source) == (50.0, "the price list, AMD EPYC, 2026-11-28")
    assert found.unknown == ["reading and compiling", "scoring"]


def test_a_few_steps_do_not_tell_how_long_many_take():
    few = replace(MEASURED, steps=4.0, seconds=8.0)
    assert cost_of(job(iterations=1000), [few], [PRICE]).training == 50.0
    assert cost_of(job(iterations=6), [few], [PRICE]).training == 12.0


def test_what_nobody_knows_is_said():
    found = cost_of(job(iterations=1000, like=replace(LIKE, model="theirs")), [MEASURED], [PRICE])
    assert (found.wall, found.memory, found.source) == (None, None, "")
    gpu = replace(LIKE, device="NVIDIA H200")
    assert cost_of(job(iterations=9, like=gpu), [MEASURED], [PRICE]).wall is None
    first, *lines = total([(job(iterations=1000), found)], 1).lines()
    assert first == "1 job"
    absent = "neither this machine nor the price list has times of this model and preset"
    assert lines[0] == f"  unknown: the time of 1 of them; {absent}"


def test_jobs_add_up_over_workers_and_those_done_are_left_out(monkeypatch):
    monkeypatch.setattr(cost.os, "cpu_count", lambda: 2)
    jobs = [job(minutes, folder=f"{minutes}", evaluate=False) for minutes in (5.0, 1.0, 2.0, 3.0)]
    jobs += [job(9.0, folder="b", state="finished"), job(9.0, folder="c", state="skipped"), jobs[0]]
    costs = [(each, cost_of(each, [MEASURED], [])) for each in jobs]
    found = total(costs, 2)
    # One worker has 5 minutes, the other 1 + 2 + 3; 10 s a job beside.
    assert found.wall == pytest.approx(6 * 60 + 3 * 10)
    assert found.processor == pytest.approx(11 * 60 + 4 * 10)
    assert found.lines() == [
        "7 jobs: 2 finished before, 1 without a scene, 4 to do; 2 at a time",
        "  about 6.5 min of wall clock on an idle machine, 11.7 min of processor, 11.0 min of it training",
        "  0.5 GiB of memory a job, 8 MB of disk",
        "  estimated from runs of this machine (4)",
    ]
    assert total(costs, 4).wall == pytest.approx(350.0)  # two cores, 700 s of processor
    assert total(costs, 4, local=False).wall == pytest.approx(310.0)
    both = joined([[found, found], [found]], 2)
    assert (both.wall, both.jobs, both.to_do, both.disk) == (pytest.approx(1050.0), 21, 12, 24e6)


@pytest.mark.parametrize(
    ("data", "expected"),
    [
        ({"synthesis": {"test_views": [1, 2, 3], "size": 10, "frames": 5}}, (6, 100)),
        ({"synthesis": {"test_views": [1, 2, 3], "size": 10, "frames": 5, "motions": ["lift"]}}, (17, 100)),
        (
            {"synthesis": {"test_views": [1, 0, 0], "size": 500, "frames": 5}, "half_resolution": "auto"},
            (1, 62_500),
        ),
        ({"synthesis": {"size": 10, "frames": 5}}, (None, None)),
        ({}, (None, None)),
    ],
)
def test_test_views_of_a_scene_to_be_written_are_known_by_its_config(data, expected):
    assert cost._views_to_write(OmegaConf.create(data)) == expected


def test_rows_are_kept_and_read_and_a_broken_file_is_none(tmp_path, monkeypatch):
    monkeypatch.setenv(cost.FILE_VARIABLE, str(tmp_path / "new" / "times.csv"))
    assert read_costs(own_file()) == []
    add_cost(MEASURED)
    add_cost(replace(MEASURED, frame=None))
    assert read_costs(own_file()) == [MEASURED, replace(MEASURED, frame=None)]
    first, second, third = own_file().read_text().splitlines()
    own_file().write_text("\n".join([first, second.replace("1000", "many"), third, ""]))
    add_cost(LIKE)
    assert read_costs(own_file()) == [replace(MEASURED, frame=None), LIKE]  # less the broken row alone
    monkeypatch.setattr(cost, "_KEPT", 1)
    add_cost(LIKE)
    assert read_costs(own_file()) == [LIKE]
    own_file().write_text("something,else\n1,2\n")
    assert read_costs(own_file()) == []


def test_jobs_that_end_at_once_lose_no_row(tmp_path, monkeypatch):
    monkeypatch.setenv(cost.FILE_VARIABLE, str(tmp_path / "times.csv"))
    read = cost.read_costs
    monkeypatch.setattr(cost, "read_costs", lambda file: (read(file), time.sleep(0.02))[0])
    with ThreadPoolExecutor(4) as pool:
        list(pool.map(add_cost, [LIKE] * 4))
    assert len(read(own_file())) == 4


def test_a_job_is_measured_by_the_clock_that_went_less(tmp_path, monkeypatch):
    monkeypatch.setattr(cost, "likeness", lambda config: LIKE)
    for name, wall in (("coarse", 5.0), ("fine", 25.0)):
        (tmp_path / name).mkdir()
        done = {"steps": 100, "clocks": {"wall": wall, "processor": 10.0}, "peak_memory_bytes": 2**30}
        (tmp_path / name / "done.json").write_text(json.dumps(done))
    (tmp_path / "metrics.json").write_text(json.dumps({"seconds": {"render_per_frame": 0.5}}))
    images = [{"seconds_scored": seconds} for seconds in (2.5, 0.25, 0.25, 0.25)]
    (tmp_path / "per_image.json").write_text(json.dumps({"images": images}))
    moments = [{"wall": wall, "processor": of} for wall, of in ((100, 50), (140, 78), (148, 84))]
    row = measured_cost(OmegaConf.create(), tmp_path, moments, pixels=400)
    # 28 s of the processor less 20 of training; of 6 s of measuring 4 x (0.5 + 0.25) are of views.
    assert (row.steps, row.seconds, row.processor, row.rest) == (200, 20, 20, 8 + 3)
    assert (row.views, row.pixels, row.frame, row.scoring, row.memory) == (4, 400, 0.5, 0.25, 1.0)
    assert row.disk == sum(file.stat().st_size for file in tmp_path.rglob("*.json"))


def test_the_price_list_is_the_median_of_runs_and_of_steps_with_published_numbers():
    table = [
        {"method": "forward", "preset": "fast", "device": CPU, "pictures": "20x10, background white"}
        | {"threads": "1", "day": f"2026-11-{day}", "steps": f"{steps}", "step": f"{step}", "frame": frame}
        | {"memory": "0.5", "parameters": "2"}
        for day, steps, step, frame in ((21, 100, 0.1, "1"), (22, 300, 0.3, ""), (23, 200, 0.2, "3"))
    ]
    (row,) = prices_of([table[:1], table[1:], [table[0] | {"step": ""}]])
    assert (row.steps, row.seconds, row.frame, row.pixels) == (200, 40, 2, 200)
    assert (row.memory, row.disk, row.day) == (0.5, 48e6, "2026-11-23")
    step = {"method": "nerf", "scene": "hook", "day": "2026-11-22", "steps": "10", "seconds": "2.5"}
    step |= {"bytes": f"{2**31}", "parameters": "1000", "failed": ""}
    (row,) = faithful_prices([step, step | {"failed": "memory"}], CPU)
    assert (row.preset, row.seconds, row.memory, row.disk) == ("faithful", 25, 2, 24_000)


def test_the_packaged_price_list_has_every_model_with_its_published_numbers_but_particles():
    rows = read_costs(PRICES)
    assert {row.model for row in rows if row.preset == "faithful"} >= {"forward", "backward", "tineuvox_b"}
    assert {(row.model, row.preset) for row in rows} >= {("particles", "fast"), ("forward", "demo")}
    assert all(row.seconds > 0 and row.steps > 0 and row.device and row.day for row in rows)
