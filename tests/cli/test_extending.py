"""Write the files of docs/extending.md into a folder and run the page's commands."""

import importlib
import json
import re
import sys
from pathlib import Path

import imageio.v3 as imageio
import numpy as np
import pytest
import torch
import yaml

from forewarp import load
from forewarp.scene.camera import look_at

PAGE = Path(__file__).parents[2] / "docs" / "extending.md"
SMALL = [
    *("data.root=scenes", "data.scene=toy", "trainer=cpu", "threads=1", "data.rays=32", "sheets=0"),
    *("budget.minutes=null", "budget.iterations=10", "callbacks.pictures=null", "run=run"),
]
VOXELS = ["stage.coarse.num_voxels=[[0,800]]", "~stage.fine"]


def files_of(page):
    """Return the files that the page gives whole: name -> text."""
    return {name: text for name, text in re.findall(r"^`(mine/\S+)`\n\n```\w+\n(.*?)```", page, re.M | re.S)}


def write_toy(folder):
    """Write sixteen pictures of a rising disc in the format of the page's reader."""
    folder.mkdir(parents=True)
    frames, rows = [], np.mgrid[:16, :16]
    for i in range(16):
        disc = np.hypot(rows[0] - 10 + i / 4, rows[1] - 8) < 3
        imageio.imwrite(folder / f"{i}.png", disc[..., None] * np.array([128, 64, 128, 255], np.uint8))
        turn = torch.tensor(0.4 * i)
        center = torch.stack([3 * turn.cos(), 3 * turn.sin(), torch.tensor(1.0)])
        pose = look_at(center, torch.zeros(3), torch.tensor([0.0, 0.0, 1.0]))
        frames.append({"image": f"{i}.png", "time": i / 15, "focal": 19.0, "pose": pose.tolist()})
    content = {"size": [16, 16], "range": [1.0, 5.5], "box": [[-1] * 3, [1] * 3], "frames": frames}
    (folder / "cameras.json").write_text(json.dumps(content))


@pytest.fixture
def work(in_tmp, monkeypatch):
    """Write the page's files and a scene, and make them importable; return the folder."""
    for name, text in files_of(PAGE.read_text()).items():
        (in_tmp / name).parent.mkdir(parents=True, exist_ok=True)
        (in_tmp / name).write_text(text)
    for folder in ("mine", "mine/conf"):
        (in_tmp / folder / "__init__.py").touch()
    write_toy(in_tmp / "scenes" / "toy")
    monkeypatch.syspath_prepend(str(in_tmp))
    importlib.invalidate_caches()
    yield in_tmp
    for name in [name for name in sys.modules if name.split(".")[0] == "mine"]:
        del sys.modules[name]


def test_the_method_trains_on_the_data_of_the_page(forewarp, ok, refused, work):
    words = ["--config-dir", "mine/conf", "experiment=mine", "model=balls", *SMALL]
    shown = forewarp("train", *words, "--cfg", "job", "--resolve")
    assert (shown.status, yaml.safe_load(shown.out)["model"]["count"]) == (0, 64)
    ok("train", *words)
    assert "mine/psnr" in (work / "run" / "fine" / "csv" / "metrics.csv").read_text()
    assert forewarp("train", *words).out.startswith("measured before")
    assert "trust=[mine]" in refused("evaluate", "run=run")
    ok("evaluate", "run=run", "trust=[mine]")
    scene = load("run", trust=["mine"])
    assert scene.trajectories(scene.matter().points, [0.0, 1.0]).shape == (64, 2, 3)


@pytest.mark.slow
def test_the_effect_is_switched_by_a_word(ok, work):
    words = ["--config-dir", "mine/conf", "experiment=mine", "model=forward", *SMALL, *VOXELS]
    for choice, name in (("sheen", "Sheen"), ("none", "NoneType")):
        ok("train", *words, f"model/view_dependence={choice}", "evaluate=false", f"run={choice}")
        assert type(load(choice, trust=["mine"]).method.view_dependence).__name__ == name
