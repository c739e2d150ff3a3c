"""A long film in windows, by one command."""

import json
from pathlib import Path

import pytest
import yaml

import forewarp
from forewarp.synth.scenes import synthesize

SHORT = ["trainer=cpu", "threads=1", "budget.minutes=null", "budget.iterations=8", "logger=none", "sheets=0"]
SCENE = ["data=dnerf", "data.root=.", "data.scene=vehicle", "callbacks.accuracy=null"]


@pytest.mark.slow
def test_windows_begin_from_what_stands_still_and_play_in_one_file(ok, refused, in_tmp):
    synthesize(Path("vehicle"), size=16, frames=12, samples_per_pixel=1, test_views=(4, 2, 1), val_views=0)
    missing = refused("train", *SHORT, *SCENE, "windows=each", "data.window=[0,0.5]")
    assert "start: expected a finished run of what stands still, but got none in" in missing
    assert "windows=still" in missing
    words = ["train", *SHORT, *SCENE, "windows=2", "run=film"]
    done = ok(*words)
    still, *windows = sorted(Path("film").iterdir())
    assert (still.name, [place.name[:12] for place in windows]) == ("still", ["window-0.5_1", "window-0_0.5"])
    assert not list(still.glob("coarse"))
    views = [len(json.loads((place / "per_image.json").read_text())["images"]) for place in windows]
    assert sum(views) == 7, views
    assert done.out.splitlines()[-1].startswith("  all")
    assert "7 views" in done.out.splitlines()[-1]
    config = yaml.safe_load((windows[0] / "config.yaml").read_text())
    assert (config["start"], config["data"]["window"]) == (str(still.resolve()), [0.5, 1])
    again = ok(*words)
    assert again.out.count("measured before") == 2
    assert "format: expected glb or html for a film's windows" in refused("export", "run=film", "format=ply")
    assert "film/exports/glb/scene.glb" in ok("export", "run=film", "format=glb", "seconds=5").out
    film = forewarp.load("film/exports/glb/scene.glb")
    assert [window.begin for window in film.gaussians.windows] == [0.0, 0.5]
    for time in (0.0, 0.49, 0.51, 1.0):
        assert float(film.render(film.cameras[0], time).opacity.max()) > 0.1
    one = str(windows[1])
    assert "1 file" in ok("export", f"run={one}", "format=glb").out
    assert len(forewarp.load(f"{one}/exports/glb/scene.glb").gaussians.means) > 16
    window = refused("train", *SHORT, *SCENE, "windows=each", "data.window=[0,1]", f"start={one}", "run=more")
    assert "start: expected a run that begins from images" in window
    assert window.endswith(f"set start={still.resolve()}")
    other = refused("train", *SHORT, *SCENE, "windows=2", "run=film", "seed=1")
    assert "seed: expected 0, as the run that this folder holds, but got 1" in other
    wrong = refused("train", *SHORT, *SCENE, "start=film/still", "model=forward", "preset=demo")
    assert wrong == "start: expected model=particles beside it, but got model=forward"
