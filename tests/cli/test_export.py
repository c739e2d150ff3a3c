import json
import re
import shutil

import numpy as np
import pytest
from omegaconf import OmegaConf
from plyfile import PlyData

from forewarp import load
from forewarp.cli.export import check
from forewarp.export import formats
from tests.support.configs import CONF


@pytest.mark.slow
def test_it_writes_what_the_run_has_into_its_folder_and_says_so(forewarp, ok, fitted, tmp_path, monkeypatch):
    run, sources, write = shutil.copytree(fitted, tmp_path / "vehicle"), [], formats.write
    text = (run / "config.yaml").read_text()
    assert "eval_background: white" in text
    (run / "metrics.json").write_text('{"trust": {"degrees": 9.5}}')
    (run / "config.yaml").write_text(text.replace("eval_background: white", "eval_background: black"))
    noted = lambda kind, source, *a, **k: sources.append(source) or write(kind, source, *a, **k)  # noqa: E731
    monkeypatch.setattr(formats, "write", noted)
    done, folder = forewarp("export", str(run), "times=[0.25]"), run / "exports" / "ply"
    assert done.out.startswith(f"written: {folder}/frames/frame_0000.ply: 1 file"), done
    assert "ply 100% | 1/1" in done.err
    assert (sources[0].background, sources[0].trust) == ((0, 0, 0), 9.5)
    about = json.loads((folder / "about.json").read_text())
    assert (about["times"], about["method"]) == ([0.25], "forward")
    assert len(PlyData.read(folder / "frames" / "frame_0000.ply")["vertex"]) == about["points"]
    words = ["format=npz", "times=2", "points=20", "views=1", f"out={tmp_path / 'here'}"]
    ok("export", f"run={run}", *words)
    with np.load(tmp_path / "here" / "trajectories.npz") as stored:
        tracks, scene = dict(stored), load(run)
    wanted = scene.trajectories(scene.matter().points.new_tensor(tracks["points"]), [0.0, 1.0])
    np.testing.assert_allclose(tracks["positions"], wanted, atol=1e-5)


@pytest.mark.parametrize(
    ("words", "says"),
    [
        (["format=stl"], "format: expected ply, glb, usd, mesh, gltf, html or npz, but got 'stl'"),
        (["layer=still"], "layer: expected all or moving or resting, but got still"),
        (["compressed=9"], "compressed: expected false or true, but got 9"),
        (["times=0"], "times: expected a whole number of at least 1, or a list, but got 0"),
        (["times=[0,2]"], "each later than the one before, but got [0, 2]"),
        (["times=[1,0]"], "expected numbers in [0, 1], each later than the one before, but got [1, 0]"),
        (["times=[]"], "each later than the one before, but got []"),
        (["format=mp4"], "but got 'mp4'; a film is made by forewarp-render"),
        (["points=9"], "points: expected an option of format=ply (degree, up, compressed); leave it out"),
        (["format=glb", "times=3"], "times: expected none with format=glb, which holds all times; leave it"),
        (["format=glb", "quality=high"], "quality: expected compact or lossless, but got high"),
        (["degree=4"], "degree: expected a whole number from 0 to 3, but got 4"),
        (["format=npz", "points=0"], "points: expected a whole number from 1 to 1000000, but got 0"),
        (["format=mesh", "files=stl"], "files: expected ply or obj, but got stl"),
        (["format=mesh", "level=1"], "level: expected a number from 0.01 to 0.99, but got 1"),
    ],
)
def test_mistakes_end_before_anything_is_loaded(monkeypatch, words, says):
    monkeypatch.setattr("forewarp.runs.overrides.typed_overrides", lambda: words)
    config = OmegaConf.merge(OmegaConf.load(CONF / "export.yaml"), OmegaConf.from_dotlist(words))
    with pytest.raises(ValueError, match=re.escape(says)):
        check(config)


@pytest.mark.slow
def test_a_method_without_particles_has_no_layers(refused, fitted):
    says = "expected a run of particles, as they alone tell what moves, but got one of another method"
    assert refused("export", f"run={fitted}", "layer=moving", "times=2") == f"layer: {says}; leave it out"
    assert refused("render", f"run={fitted}", "layer=resting", "frames=2") == f"layer: {says}; leave it out"
    assert refused("render", f"run={fitted}", "masks=true", "frames=2") == f"masks: {says}; leave it out"
    assert not (fitted / "exports").exists()


@pytest.mark.slow
def test_a_folder_of_others_is_left_alone(refused, fitted, in_tmp):
    (in_tmp / "a file").touch()
    said = refused("export", f"run={fitted}", "out=.")
    assert "but got a file in it; move it, or choose another" in said
    assert [file.name for file in in_tmp.iterdir()] == ["a file"]
