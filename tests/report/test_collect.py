import pytest

from forewarp.report.collect import Point, by_scene, collect, grouped, machine, read_run
from tests.support.runs_on_disk import write_run


def test_a_run_is_read_whole(tmp_path):
    result = read_run(write_run(tmp_path, "unet_16", 3, epe=0.125, against="grid_64"))
    assert (result.scene, result.variant, result.seed) == ("ball", "unet_16", 3)
    assert result.against(["base"]) == "grid_64"
    assert (result.minutes, result.about) == (1.0, "the unet_16")
    assert result.curve[1] == Point(20.0, 25.0, 20, 0.125)
    seconds = {"step": 0.5, "frame": 0.5, "steps": 100}
    assert (
        result.numbers
        == {"psnr": 30.0, "ssim": 0.9, "epe": 0.125, "memory": 1.0, "parameters": 2.0} | seconds
    )
    assert result.command == "forewarp-train variant=unet_16 seed=3"
    assert machine([result, result]) == "a cpu, 2 threads, torch 2"


def test_names_do_not_depend_on_spaces_within_an_override(tmp_path):
    plain, spaced = "size=[[0,8000]]", "size=[[0, 8000]]"
    for name in ("", spaced, f"rays=64 {plain}", f"data.box=null {spaced}"):
        write_run(tmp_path, name, against=None)
    names = [result.variant for result in collect(tmp_path)[0]]
    assert sorted(names) == ["base", f"data.box=null {plain}", f"rays=64 {plain}", plain]
    assert {result.against(names) for result in collect(tmp_path)[0]} == {"base", plain}


def test_a_run_without_a_variant_is_named_after_its_choices(tmp_path):
    config = {"variant": None, "command": None}
    folder = write_run(tmp_path, ability="time", curve=None, config=config)
    result = read_run(folder)
    assert (result.variant, result.about, result.against([])) == ("forward-fast", "", "base")
    assert result.command.startswith("forewarp-train # as ")
    assert (result.ability, result.curve, "epe" in result.numbers) == ("time", (), False)


def test_folders_without_results_are_named_and_the_others_read(tmp_path):
    write_run(tmp_path)
    write_run(tmp_path, "late", psnr=None)
    spoiled = write_run(tmp_path, "spoiled")
    (spoiled / "metrics.json").write_text("{")
    odd = write_run(tmp_path, "odd")
    (odd / "config.yaml").write_text("seed: 0\n")
    results, without = collect(tmp_path, ["metrics.json"])
    assert [result.variant for result in results] == ["base"]
    assert [line.split("-")[0] for line in without] == ["ball/late", "ball/odd", "ball/spoiled"]
    assert without[0].endswith("no metrics.json; run its command again")
    assert without[1].endswith("cannot be read (no key 'data')")
    assert "Expecting" in without[2]


def test_no_runs_at_all_is_an_error(tmp_path):
    with pytest.raises(ValueError, match="expected folders of runs, but got none; make some with"):
        collect(tmp_path)


def test_groups_hold_the_seeds_and_the_base_comes_first(tmp_path):
    for variant, seed, minutes in (("a", 1, 1.0), ("a", 0, 1.0), ("base", 0, 1.0), ("a", 0, 3.0)):
        write_run(tmp_path, variant, seed, minutes=minutes)
    write_run(tmp_path, scene="cube")
    scenes = by_scene(collect(tmp_path)[0])
    assert list(scenes) == ["ball", "cube"]
    groups = grouped(scenes["ball"])
    assert list(groups) == [("base", 1.0), ("a", 1.0), ("a", 3.0)]
    assert [result.seed for result in groups["a", 1.0]] == [0, 1]


def test_a_config_that_is_no_config_of_ours_is_left_out(tmp_path):
    for seed, text in enumerate(["#" * (1 << 20) + "x", "a: " + "[" * 5000]):
        (write_run(tmp_path, seed=seed) / "config.yaml").write_text(text)
    write_run(tmp_path, seed=2)
    results, without = collect(tmp_path)
    assert [result.seed for result in results] == [2]
    assert "config.yaml: expected at most 1048576 bytes, but got 1048577)" in without[0]
    assert "cannot be read (" in without[1]
