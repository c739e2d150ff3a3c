from forewarp.report.price_list import write_price_list
from tests.support.runs_on_disk import rows_of, write_run


def test_changes_are_against_the_same_seed(tmp_path):
    runs = tmp_path / "runs"
    write_run(runs, "base", 0, psnr=30.0, epe=0.2)
    write_run(runs, "base", 1, psnr=28.0, epe=0.2)
    write_run(runs, "grid_64", 0, psnr=29.0, steps=200, epe=0.1)
    write_run(runs, "grid_64", 1, psnr=27.5, steps=200, epe=0.1)
    write_run(runs, "unet_16", 0, psnr=30.5, steps=50, against="grid_64")
    # Named by what was typed; what all of them share is no part of their names.
    write_run(runs, "data.box=null", 2, psnr=20.0, against=None)
    write_run(runs, "data.box=null preset.rays=64", 2, psnr=21.0, against=None)
    write_run(runs, "data.box=null model=backward preset.rays=64", 2, psnr=21.5, against=None)
    write_run(runs, "alone", 5)
    write_run(runs, "failed", psnr=None)
    page, file = write_price_list(runs, tmp_path / "out")
    text = page.read_text()
    own, change = rows_of(text, "grid_64")
    assert own[1:3] == ["2", "28.25 ± 1.06"]
    assert change[1:5] == ["base", "2", "-0.75 ± 0.35", "+0.0000 ± 0.0000"]
    assert change[5:] == ["-0.1000 ± 0.0000", "×0.50 ± 0.00", *["×1.00 ± 0.00"] * 3, "×2.00 ± 0.00"]
    assert rows_of(text, "unet_16")[0][1:6] == ["grid_64", "1", "+1.50", "+0.0000", ""]
    assert rows_of(text, "preset.rays=64")[1][1:4] == ["base", "1", "+1.00"]
    assert rows_of(text, "model=backward preset.rays=64")[0][1:4] == ["preset.rays=64", "1", "+0.50"]
    assert len(rows_of(text, "base")) == 1
    assert rows_of(text, "alone")[0][2:4] == ["0", ""]  # nothing to compare it with
    assert "Of all test views:" in text
    assert "* ball/failed-1.0-seed0: no metrics.json" in text
    lines = file.read_text().splitlines()
    assert lines[0].startswith("scene,variant,minutes,seed,views,PSNR (dB),SSIM,EPE,s/step,")
    assert len(lines) == 10


def test_scenes_and_minutes_stand_apart(tmp_path):
    for scene, minutes in (("ball", 1.0), ("ball", 3.0), ("cube", 1.0)):
        write_run(tmp_path, scene=scene, minutes=minutes, ability="time")
    text = write_price_list(tmp_path, tmp_path / "out")[0].read_text()
    heads = [line for line in text.splitlines() if line.startswith("## ")]
    assert heads == ["## ball, 1 minutes", "## ball, 3 minutes", "## cube, 1 minutes"]
    assert "Of test views between the training times:" in text


def test_a_page_is_named_after_the_method_that_most_runs_are_of(tmp_path):
    for variant, model in (("base", "particles"), ("nodes=5", "particles"), ("model=forward", "forward")):
        write_run(tmp_path, variant, config={"model": {"name": model}})
    written = write_price_list(tmp_path, tmp_path / "out")
    assert [path.name for path in written] == ["price-list-particles.md", "price-list-particles.csv"]
    assert len(rows_of(written[0].read_text(), "model=forward")) == 1
