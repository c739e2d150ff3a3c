import inspect
import json
import time
from concurrent.futures import ThreadPoolExecutor

import pytest
from hydra.utils import instantiate

from forewarp.data.dnerf import read_scene
from forewarp.data.files import SceneError
from forewarp.synth import module
from tests.support.configs import composed, options

SMALL = ["size=16", "frames=3", "test_views=[1,1,1]", "val_views=0", "samples_per_pixel=1"]
ARGUMENTS = {"size": 16, "frames": 3, "test_views": [1, 1, 1], "val_views": 0, "samples_per_pixel": 1}


@pytest.mark.slow
def test_writes_a_scene_that_reads(forewarp, in_tmp):
    done = forewarp("synthesize", "folder=a/s", *SMALL)
    assert (done.status, done.out) == (0, "written: a/s\n")
    scene = read_scene("a", "s")
    assert (len(scene.train), len(scene.test), scene.train[0].camera.width) == (3, 3, 16)
    assert [path.name for path in in_tmp.joinpath("a").iterdir()] == ["s"]


@pytest.mark.slow
def test_keeps_a_scene_unless_told_otherwise(forewarp, ok, refused, in_tmp):
    forewarp("synthesize", "folder=s", *SMALL)
    assert "s: expected a new or empty folder" in refused("synthesize", "folder=s", *SMALL, "seed=1")
    assert json.loads((in_tmp / "s" / "synthesis.json").read_text())["seed"] == 0
    ok("synthesize", "folder=s", *SMALL, "seed=1", "overwrite=true")
    assert json.loads((in_tmp / "s" / "synthesis.json").read_text())["seed"] == 1


@pytest.mark.slow
def test_never_overwrites_what_is_no_scene(refused, in_tmp):
    (in_tmp / "s").mkdir()
    (in_tmp / "s" / "thesis.txt").write_text("dear")
    assert "expected a new or empty folder" in refused("synthesize", "folder=s", *SMALL, "overwrite=true")
    assert (in_tmp / "s" / "thesis.txt").read_text() == "dear"
    assert "expected a folder, but got the file" in refused("synthesize", "folder=s/thesis.txt")


@pytest.mark.slow
def test_runs_that_begin_together_write_a_scene_once(tmp_path, monkeypatch):
    written = []

    def slow(folder, **arguments):
        written.append(folder)
        time.sleep(0.3)
        write(folder, **arguments)

    write = module.WRITERS["dnerf"]
    monkeypatch.setitem(module.WRITERS, "dnerf", slow)
    with ThreadPoolExecutor(3) as pool:
        data = [module.SyntheticDataModule(tmp_path, "s", synthesis=ARGUMENTS, rays=8) for _ in range(3)]
        list(pool.map(lambda one: one.prepare(), data))
    assert len(written) == 1
    assert module.is_scene(tmp_path / "s")


@pytest.mark.slow
def test_every_dataset_has_a_writer_whose_defaults_are_the_configs():
    assert sorted(module.WRITERS) == options("dataset")
    for name, writer in module.WRITERS.items():
        config = composed(f"dataset={name}", name="synthesize")
        for key, parameter in inspect.signature(writer).parameters.items():
            if key not in ("folder", "progress"):
                default = parameter.default
                assert config[key] == (list(default) if isinstance(default, tuple) else default), (name, key)


def test_a_folder_of_something_else_is_left_alone(tmp_path):
    (tmp_path / "s").mkdir()
    (tmp_path / "s" / "thesis.txt").write_text("dear")
    with pytest.raises(SceneError, match="expected a synthesised scene or nothing"):
        module.SyntheticDataModule(tmp_path, "s", synthesis=ARGUMENTS).setup("fit")
    assert (tmp_path / "s" / "thesis.txt").read_text() == "dear"


@pytest.mark.slow
@pytest.mark.parametrize("name", [name for name in options("data") if name.startswith("synthetic")])
def test_synthetic_data_names_arguments_of_its_writer(name, tmp_path):
    data = instantiate(composed(f"data={name}", f"data.root={tmp_path}").data, _convert_="all")
    assert set(data.synthesis) <= set(inspect.signature(module.WRITERS[data.dataset]).parameters)


def test_bad_arguments_leave_nothing(refused, in_tmp):
    line = refused("synthesize", "folder=s", "size=2")
    assert line == "size: expected a whole number of at least 8, but got 2; set size=..."
    assert list(in_tmp.iterdir()) == []


@pytest.mark.slow
@pytest.mark.parametrize(
    ("dataset", "keys", "marker"),
    [
        ("lego_complete", ["size=8", "frames=2", "motions=[lift]", "test_views=[1,1,1]"], "lift"),
        ("hypernerf", ["size=16", "frames=3"], "dataset.json"),
        ("nhr", ["size=24", "frames=2", "points=20"], "CamPose.inf"),
        ("multicam", ["size=16", "frames=2", "cameras=2"], "truth.json"),
        ("iphone", ["size=12", "frames=2"], "dataset.json"),
    ],
)
def test_every_dataset_is_written_whole_and_replaced(forewarp, ok, refused, in_tmp, dataset, keys, marker):
    command = ["synthesize", f"dataset={dataset}", "folder=s", "samples_per_pixel=1", *keys]
    done = forewarp(*command)
    assert (done.status, done.out) == (0, "written: s\n")
    assert "images 100%" in done.err
    assert (in_tmp / "s" / marker).exists()
    assert "set overwrite=true" in refused(*command)
    ok(*command, "overwrite=true")
    assert [path.name for path in in_tmp.iterdir()] == ["s"]


LEGO = {"size": 8, "frames": 2, "motions": ["lift", "drive"], "test_views": [1, 2, 1], "val_views": 0}


@pytest.mark.slow
@pytest.mark.parametrize(
    ("kind", "scene", "synthesis", "counts"),
    [
        (module.SyntheticDataModule, "s", ARGUMENTS, (3, 3)),
        (module.SyntheticLegoCompleteDataModule, "drive", LEGO, (2, 2 + 3 + 1)),
        (module.SyntheticHyperNeRFDataModule, "s", {"size": 16, "frames": 3}, (3, 3)),
        (module.SyntheticNHRDataModule, "s", {"size": 24, "frames": 2, "points": 20}, (36, 4)),
    ],
)
def test_every_dataset_is_synthesised_at_first_use(tmp_path, capsys, kind, scene, synthesis, counts):
    synthesis = {**synthesis, "samples_per_pixel": 1}
    data = kind(tmp_path / "root", scene, synthesis=synthesis, rays=8)
    assert not (tmp_path / "root").exists()
    data.setup("fit")
    assert (len(data.scene.train), len(data.scene.test)) == counts
    assert "100%" in capsys.readouterr().err
    kind(tmp_path / "root", scene, synthesis=synthesis, rays=8).setup("fit")
    assert capsys.readouterr().err == ""
    with pytest.raises(SceneError, match=r"synthesis\.json: frames: expected 7, but got .; use another data"):
        kind(tmp_path / "root", scene, synthesis={**synthesis, "frames": 7}).setup("fit")
