from forewarp.report.accuracy_time import write_accuracy_time
from forewarp.report.curve import Published
from tests.support.runs_on_disk import rows_of, write_run


def page_of(root, **more):
    files = write_accuracy_time(root / "runs", root / "out", **more)
    assert all(file.is_file() for file in files)
    return (root / "out" / "accuracy-time.md").read_text()


def test_each_decibel_names_the_first_to_reach_it_in_all_seeds(tmp_path):
    runs = tmp_path / "runs"
    write_run(runs, "base", 0, curve=((10, 24.0), (20, 25.2), (40, 25.5)))
    write_run(runs, "base", 1, curve=((10, 24.5), (30, 25.2), (40, 25.5)))
    write_run(runs, "good", 0, curve=((15, 23.0), (35, 27.0), (60, 27.5)))
    write_run(runs, "lucky", 0, curve=((1, 26.0), (2, 26.0)))
    write_run(runs, "lucky", 1, curve=((90, 26.0), (99, 26.0)))
    page = page_of(tmp_path)
    assert rows_of(page, "24") == [["24", "10.0 ± 0.0", "base", "`forewarp-train variant=base seed=0`"]]
    assert rows_of(page, "25")[0][1:3] == ["25.0 ± 7.1", "base"]
    assert rows_of(page, "26")[0][1:3] == ["35.0", "good"]
    assert rows_of(page, "27")[0][1:3] == ["35.0", "good"]
    assert rows_of(page, "28") == []
    assert "seconds to 25 dB" in page  # what the base reaches
    assert rows_of(page, "base")[0][1:] == ["1.0", "2", "25.0 ± 7.1", "25.50 ± 0.00", "", "100 ± 0"]
    csv = (tmp_path / "out" / "accuracy-time-ball.csv").read_text().splitlines()
    assert csv[0].startswith("variant,minutes,seeds,seconds to 25 dB,seconds to 25 dB sd,PSNR")
    assert len(csv) == 4


def test_a_target_of_ones_own_and_what_has_no_curve(tmp_path):
    write_run(tmp_path / "runs", epe=0.25)
    write_run(tmp_path / "runs", "failed", curve=None)
    write_run(tmp_path / "runs", "killed", psnr=None)
    other = Published("other", 100.0, 32.0, "a GPU", "its paper", "dnerf")
    page = page_of(tmp_path, target=20.0, published=[other])
    assert rows_of(page, "base")[0][3:6] == ["10.0", "25.50", "0.2500"]
    assert "* ball/failed-1.0-seed0: no accuracy_time.csv; run its command with data.held_out=8" in page
    assert "* ball/killed-1.0-seed0: no metrics.json; run its command again" in page
    assert not rows_of(page, "killed")
    assert "* other: 32 dB, 100 s, a GPU; its paper" in page
