from dataclasses import replace

import pytest

from forewarp.data import published
from tests.support.written_scenes import write_dnerf


@pytest.fixture
def one_scene(monkeypatch, in_tmp):
    """Of the paper only one scene, which is in ``my scenes``; returns its folder."""
    folder = write_dnerf(in_tmp / "my scenes" / "dnerf" / "toy")
    counts = {split: len(list((folder / split).iterdir())) for split in ("train", "val", "test")}
    toy = replace(published.DATASETS[0], scenes={"toy": published.Blender(counts)})
    monkeypatch.setattr(published, "DATASETS", [toy])
    return folder


def test_what_is_complete_ends_with_the_command_of_the_tables(ok, one_scene):
    lines = ok("data", "check", "my scenes").out.splitlines()
    assert lines[0] == "D-NeRF: 1 of 1 scenes complete in my scenes/dnerf"
    assert lines[1].startswith("  toy  complete      ")
    assert lines[2].startswith("  licence: none is stated")
    assert (
        lines[-1] == "all 1 scenes are complete; the paper's tables: make reproduce-tables DATA='my scenes'"
    )


def test_what_lacks_is_told_with_where_its_authors_keep_it(forewarp, one_scene):
    (one_scene / "train" / "r_0.png").unlink()
    done = forewarp("data", "check", "my scenes")
    assert done.status == 1
    assert "incomplete    my scenes/dnerf/toy: expected" in done.out
    assert "  to get what lacks: github.com/albertpumarola/D-NeRF links to it" in done.out
    assert done.out.endswith("none of 1 scenes is complete; on counterparts of all: make reproduce-tables\n")
