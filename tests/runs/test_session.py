"""A run's folder has one process at a time, one config, and the data that it began with."""

import errno
import json
import os
from types import SimpleNamespace

import pytest
from filelock import FileLock
from omegaconf import OmegaConf

from forewarp.data.files import LOCK
from forewarp.runs.session import check_data, claim, locked, session, warn_if_changed
from forewarp.scene.world import World


@pytest.mark.parametrize("holder", [None, b"", b"\xff\xfe\x00", b"x" * 5000])
def test_the_second_is_refused_whatever_the_file_says(tmp_path, holder):
    with locked(tmp_path / "run"):
        path = tmp_path / "run" / LOCK
        assert path.read_text().startswith(f"process {os.getpid()} on ")
        path.unlink() if holder is None else path.write_bytes(holder)
        with pytest.raises(ValueError, match="nobody works on, but got one of .+; wait for it"):
            locked(tmp_path / "run").__enter__()
    with locked(tmp_path / "run"):
        pass


def test_a_folder_that_cannot_be_written_names_the_key(tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(OSError, match="run: ") as caught, locked(tmp_path / "file" / "run"):
        pass
    assert str(caught.value.filename).startswith("run: ")
    with locked(tmp_path / "run"):
        pass


def watched(tmp_path):
    """A session of a run over a scene of two files, without a config to claim."""
    scene, folder = tmp_path / "scene", tmp_path / "run"
    scene.mkdir()
    for name in "ab":
        (scene / f"{name}.png").write_bytes(b"1")
    data = SimpleNamespace(place=scene, fingerprint=lambda: None)
    return session(SimpleNamespace(folder=folder, datamodule=data), OmegaConf.create(), finished=True)


def test_images_exchanged_while_a_run_works_are_said(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr("forewarp.runs.session.claim", lambda config, finished: None)
    with watched(tmp_path):
        a, b = (tmp_path / "scene" / f"{name}.png" for name in "ab")
        a.write_bytes(b"2")  # as many bytes
        b.unlink()
    assert "scene: expected files that stay as they are" in (said := capsys.readouterr().err)
    assert "got others: a.png, b.png; what was trained" in said


def test_a_folder_that_is_moved_while_a_run_works_is_said(tmp_path, monkeypatch):
    monkeypatch.setattr("forewarp.runs.session.claim", lambda config, finished: None)
    working = watched(tmp_path)
    working.__enter__()
    (tmp_path / "run").rename(tmp_path / "elsewhere")
    (tmp_path / "run").mkdir()
    with pytest.raises(ValueError, match="run: expected the folder that this run works in"):
        working.__exit__(None, None, None)


def test_a_file_system_without_locks_is_used_without(tmp_path, monkeypatch):
    asked = []

    def missing(lock):
        asked.append(lock)
        raise OSError(errno.ENOSYS, "Function not implemented")

    monkeypatch.setattr(FileLock, "_acquire", missing)
    with locked(tmp_path), locked(tmp_path):
        assert len(asked) == 2


def test_a_folder_is_claimed_for_one_config(tmp_path):
    def claimed(finished=False, **changes):
        config = {name: {"name": name} for name in ("model", "preset")} | {"objective": {}}
        config |= {"stage": {"fine": {"share": 1}}}
        config |= {"run": str(tmp_path), "data": {"root": str(tmp_path)}, "budget": {"minutes": 1}, "seed": 0}
        config |= {"resume": None, "trust": ["theirs"], "viewer": True, "logger": None, "callbacks": {}}
        claim(OmegaConf.create(config | {"trainer": {"accelerator": "auto"}} | changes), finished=finished)
        return OmegaConf.load(tmp_path / "config.yaml")

    claimed(seed=5)
    stored = claimed()  # nothing was trained with the first, which does not bind
    assert (stored.seed, stored.trust, stored.viewer, stored.command) == (0, None, False, None)
    (tmp_path / "coarse").mkdir()
    (tmp_path / "coarse" / "last.ckpt").touch()
    claimed(finished=True, data={"root": str(tmp_path), "disk_cache_bytes": 1})  # changes no frame
    assert claimed(finished=True, trainer={"accelerator": "cpu"}) == stored
    assert claimed(trainer={"accelerator": "cpu"}).trainer.accelerator == "cpu"
    for changes, says in (
        ({"seed": 1}, "seed: expected 0, as the run that this folder holds, but got 1; use run="),
        ({"seed": 1, "budget": {"minutes": 9}}, "seed: expected 0, .* but got 1 .and 1 more keys.; use run="),
        ({"seed": 1, "model": {"name": "nerf"}}, "model.name: expected model, .* but got nerf .and 1 more"),
        ({"stage": {}}, "stage.fine: expected .*, as the run .* but got nothing"),
    ):
        with pytest.raises(ValueError, match=f"config.yaml: {says}"):
            claimed(**changes)
    (tmp_path / "config.yaml").unlink()
    with pytest.raises(ValueError, match="expected the configuration of the run, but got none"):
        claimed()


def test_data_that_changed_are_refused_unless_accepted(tmp_path, capsys):
    data = {"texts": {"a.json": "1"}, "images": {"count": 1}}
    scene = SimpleNamespace(world=World(scale=0.5))
    run = SimpleNamespace(folder=tmp_path, datamodule=SimpleNamespace(fingerprint=lambda: data, scene=scene))
    with pytest.raises(ValueError, match="data_changed: expected refuse or accept, but got 'x'"):
        check_data(run, "x")
    check_data(run, "refuse")
    data = data | {"texts": {"a.json": "2"}}
    check_data(run, "refuse")  # nothing was trained with the first
    (tmp_path / "coarse").mkdir()
    (tmp_path / "coarse" / "last.ckpt").touch()
    warn_if_changed(run)
    assert capsys.readouterr().err == ""
    data = data | {"texts": {"a.json": "3"}}
    warn_if_changed(run)
    said = f"{tmp_path}/data.json: expected the data that the run was begun with, but got others: a.json"
    assert capsys.readouterr().err == f"warning: {said}\n"
    metrics = {"protocol": {"normalisation": {"center": [0, 0, 0], "scale": 5.0}}}
    (tmp_path / "metrics.json").write_text(json.dumps(metrics))
    warn_if_changed(run)
    assert "unit of the data there now, in which lengths are 10 times as large; " in capsys.readouterr().err
    with pytest.raises(ValueError, match="a.json; use run=..., or go on with data_changed=accept"):
        check_data(run, "refuse")
    check_data(run, "accept")
    check_data(run, "refuse")  # it was accepted once for all
    data = None  # a scene without files
    check_data(run, "refuse")


def test_what_a_killed_process_left_is_removed_but_not_what_may_be_written_now(tmp_path):
    left = [tmp_path / "fine" / ".last.ckpt.0a.part.ckpt", tmp_path / ".metrics.json.0b.part.json"]
    now = [tmp_path / "videos" / ".orbit.mp4.0c.part.mp4", tmp_path / ".page.html.0d.part.html"]
    for file in (*left, *now):
        file.parent.mkdir(exist_ok=True)
        file.touch()
    with locked(tmp_path):
        assert [file.exists() for file in (*left, *now)] == [False, False, True, True]
