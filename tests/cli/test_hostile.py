"""A run's folder that a stranger made: whatever command opens it, nothing outside it is written or run."""

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
from omegaconf import OmegaConf

from forewarp.files import replace_file
from forewarp.runs.config import UNUSED

OPENS = {  # command -> how it is pointed at the folder, and what keeps it short
    "train": ("resume={}", "checkpoint_seconds=0"),
    "evaluate": ("run={}", "sheets=0"),
    "render": ("run={}", "path=orbit", "frames=2", "size=16"),
    "export": ("run={}", "format=ply"),
    "report": ("kind=run", "run={}"),
}
SECRET = "the user's own"


def within(key, value):
    """Change a key of the stored config."""

    def change(run, outside):
        config = OmegaConf.load(run / "config.yaml")
        OmegaConf.update(config, key, value(outside) if callable(value) else value, force_add=True)
        OmegaConf.save(config, run / "config.yaml")

    return change


def link(name, to):
    """Put a link in the place of what lies at ``name``."""

    def change(run, outside):
        place = run / name
        shutil.rmtree(place) if place.is_dir() else place.unlink(missing_ok=True)
        place.parent.mkdir(exist_ok=True)
        place.symlink_to(outside / to)

    return change


def keeper(outside):
    target = "forewarp.training.checkpoints.KeepCheckpoint"
    return {"_target_": target, "_partial_": True, "path": f"{outside}/secret", "seconds": 0}


def writer(outside):
    target = "lightning.pytorch.loggers.TensorBoardLogger"
    return {"_target_": target, "_partial_": True, "log_dir": str(outside)}


def synthetic(outside):
    target = "forewarp.synth.module.SyntheticDataModule"
    return {"_target_": target, "root": str(outside), "scene": "new", "synthesis": {}}


KINDS = {  # what is wrong with the folder -> how it is made, and what the refusal names; None: none
    "planned": (within("planned", lambda outside: f"{outside}/secret"), None),
    "callbacks": (within("callbacks.x", keeper), "callbacks.x._target_"),
    "logger": (within("logger.x", writer), "logger.x.log_dir"),
    "scene": (within("data.scene", "../../x"), "data.scene"),
    "synthetic": (within("data", synthetic), "new"),
    "images": (link("images", "."), "images"),
    "stage": (link("fine", "."), "fine"),
    "plan": (link("plan.yaml", "secret"), "plan.yaml"),
    "lock": (link(".lock.held", "secret"), ".lock.held"),
    "deep": (link("coarse/tensorboard/deep", "."), "deep"),
    "nowhere": (link("videos", "not/there"), "videos"),
    "film": (link("videos/both.mp4", "secret"), "both.mp4"),
    "numbers": (link("metrics.json", "secret"), "metrics.json"),
    "config": (link("config.yaml", "secret"), "config.yaml"),
    "pipe": (lambda run, outside: os.mkfifo(run / "fine" / "new.pt"), "new.pt"),
}
LEFT_OUT = (
    "callbacks",
    "logger",
    "scene",
    "synthetic",
)  # of which the page of a run says that it is left out


def tree(folder):
    """Return all that lies in a folder, with the content of its files."""
    paths = sorted(Path(folder).rglob("*"))
    return {path: path.read_bytes() if path.is_file() and not path.is_symlink() else None for path in paths}


@pytest.fixture
def outside(in_tmp):
    (in_tmp / "outside").mkdir()
    (in_tmp / "outside" / "secret").write_text(SECRET)
    return in_tmp / "outside"


ATTACKS = [(kind, name) for kind, (_, named) in KINDS.items() for name in (OPENS if named else ["train"])]


@pytest.mark.slow
@pytest.mark.parametrize(("kind", "name"), ATTACKS)
def test_nothing_outside_is_written(kind, name, fitted, outside, forewarp):
    make, named = KINDS[kind]
    run = Path(shutil.copytree(fitted, "run"))
    make(run, outside)
    before, scenes = tree(outside), tree(fitted.parent / "scenes")
    done = forewarp(name, *(word.format(run) for word in OPENS[name]))
    assert tree(outside) == before
    assert tree(fitted.parent / "scenes") == scenes
    assert not any(SECRET.encode() in (content or b"") for content in tree(run).values())
    assert "Traceback" not in done.err
    if named is None or kind in UNUSED and name != "train":
        assert done.status == 0, done
    elif name != "report" or kind not in LEFT_OUT:
        assert done.status == 2, done
        assert named in done.err.splitlines()[-1]


@pytest.mark.slow
def test_the_folder_itself_may_be_a_link(fitted, in_tmp, forewarp):
    shutil.copytree(fitted, "disk/run")
    Path("run").symlink_to("disk/run")
    assert forewarp("evaluate", "run=run", "sheets=0", "views=1").status == 0


def test_a_file_is_not_written_through_a_link_that_lies_in_wait(in_tmp, monkeypatch):
    Path("secret").write_text(SECRET)
    Path(".page.md.guessed.part.md").symlink_to("secret")
    with monkeypatch.context() as patch:
        patch.setattr("forewarp.files.secrets.token_hex", lambda count: "guessed")
        with pytest.raises(FileExistsError):
            replace_file(Path("page.md"), "x")
    Path("page.md").symlink_to("secret")
    replace_file(Path("page.md"), "x")
    assert not Path("page.md").is_symlink()  # the link is replaced, not followed
    assert Path("secret").read_text() == SECRET


COMMAND = """
if __name__ == "__main__":
    from forewarp.cli.entry import quiet
    quiet()
    import subprocess, sys
    from concurrent.futures import ProcessPoolExecutor
    from multiprocessing import get_context
    with ProcessPoolExecutor(1, get_context("spawn")) as pool:
        print(pool.submit(abs, -3).result())
    print(subprocess.run([sys.executable, "-m", "pickle", "-h"], capture_output=True).returncode)
"""


@pytest.mark.slow
def test_no_process_that_is_started_imports_of_the_current_folder(in_tmp):
    """Neither what begins workers nor what they import; in a process of its own, as commands are."""
    if sys.version_info < (3, 11):
        pytest.skip("Python 3.10 knows no PYTHONSAFEPATH")
    for name in ("multiprocessing", "pickle", "numpy", "joblib"):
        Path(f"{name}.py").write_text("open('trace', 'w')\nraise SystemExit(3)\n")
    Path("bin").mkdir()
    Path("bin/command.py").write_text(COMMAND)  # whose folder is the first to import from
    done = subprocess.run([sys.executable, "bin/command.py"], capture_output=True, text=True, check=True)
    assert done.stdout.split() == ["3", "0"]
    assert not os.path.exists("trace")


TYPED = """
from forewarp.cli.entry import quiet
quiet()
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
with ProcessPoolExecutor(1, get_context("spawn")) as pool:
    pool.submit(eval, "__import__('planted')").exception()
"""


@pytest.mark.slow
def test_workers_of_typed_code_import_nothing_of_the_current_folder(in_tmp):
    """Where the first place to import from is the current folder, whatever it is: an empty text."""
    Path("planted.py").write_text("open('trace', 'w')\n")
    subprocess.run([sys.executable, "-c", TYPED], capture_output=True, check=True)
    assert not os.path.exists("trace")


@pytest.mark.slow
def test_a_helper_process_imports_nothing_of_the_current_folder(in_tmp, monkeypatch):
    from forewarp.methods.particles import start

    for name in ("numba", "numpy", "forewarp"):
        Path(f"{name}.py").write_text("open('trace', 'w')\nraise SystemExit(3)\n")
    monkeypatch.setattr(start, "compile_backward", None)  # the other process has its own
    monkeypatch.setattr(start, "cores", lambda: 2)
    with start._backward_compiled_beside(new=True):
        pass
    assert not os.path.exists("trace")
