"""The wheel, installed elsewhere, works in an empty folder."""

import os
import shutil
import subprocess
import sys
import zipfile
from types import SimpleNamespace

import pytest

from tests.support.configs import CONF, ROOT

DATA = ("*.yaml", "templates/*")  # of reports
SMALL = [
    *("experiment=demo", "trainer=cpu", "threads=1", "sheets=1"),
    *("data.synthesis.size=32", "data.synthesis.frames=5", "data.synthesis.test_views=[1,1,1]"),
    *("data.synthesis.val_views=1", "data.synthesis.samples_per_pixel=1"),
]

SHORT = ["budget.minutes=null", "budget.iterations=2"]


def call(*command, cwd, **variables):
    """A program in a process of its own, which must end well; what it printed, no library's notices."""
    environment = {key: value for key, value in os.environ.items() if not key.startswith("FOREWARP_")}
    options = {"capture_output": True, "text": True, "timeout": 300, "cwd": cwd}
    done = subprocess.run(list(map(str, command)), env=environment | variables, **options)
    said = done.stdout + done.stderr
    assert done.returncode == 0, said
    for notice in ("GPU available", "Tip:", "Warning", "weights_only", "Trainer.fit"):
        assert notice not in said
    return done.stdout


def files(folder):
    """All files below a folder but compiled ones, relative to it."""
    found = (path for path in folder.rglob("*") if path.is_file() and "__pycache__" not in path.parts)
    return {path.relative_to(folder).as_posix() for path in found}


@pytest.fixture(scope="module")
def wheel(tmp_path_factory):
    """The wheel, built from a copy, as a build leaves folders behind."""
    source, out = tmp_path_factory.mktemp("source"), tmp_path_factory.mktemp("wheel")
    for name in ("src", "conf", "sweeps"):
        ignored = shutil.ignore_patterns("__pycache__", "*.egg-info")
        shutil.copytree(ROOT / name, source / name, ignore=ignored)
    for name in ("pyproject.toml", "setup.py", "README.md", "LICENSE"):
        shutil.copy(ROOT / name, source)
    pip = (sys.executable, "-m", "pip", "wheel", "--quiet", "--no-deps", "--no-build-isolation")
    call(*pip, "--wheel-dir", out, source, cwd=out)
    (file,) = out.glob("forewarp-*.whl")
    return file


@pytest.fixture(scope="module")
def installed(wheel, tmp_path_factory):
    """``run("train", ...)`` runs a command of the wheel, which is in ``site``, in the empty ``folder``."""
    site, folder = tmp_path_factory.mktemp("site"), tmp_path_factory.mktemp("empty")
    pip = (sys.executable, "-m", "pip", "install", "--quiet", "--no-deps", "--no-index")
    call(*pip, "--target", site, wheel, cwd=folder)
    # Compiled once is enough: Numba goes by the times of the sources.
    for cache in {file.parent.relative_to(ROOT) for file in (ROOT / "src").rglob("*.nbi")}:
        package = site / cache.parent.relative_to("src")
        shutil.copytree(ROOT / cache, package / "__pycache__", dirs_exist_ok=True)
        for source in (ROOT / cache.parent).glob("*.py"):
            shutil.copystat(source, package / source.name)

    def command(name, *words):
        return call(site / "bin" / f"forewarp-{name}", *words, cwd=folder, PYTHONPATH=str(site))

    return SimpleNamespace(run=command, site=site, folder=folder)


@pytest.mark.slow
def test_the_wheel_holds_every_configuration_and_what_reports_need(wheel):
    names = set(zipfile.ZipFile(wheel).namelist())
    wanted = {f"forewarp/conf/{name}" for name in files(CONF)}
    wanted |= {f"forewarp/sweeps/{name}" for name in files(ROOT / "sweeps")}
    report = ROOT / "src" / "forewarp" / "report"
    wanted |= {f"forewarp/report/{file.relative_to(report)}" for kind in DATA for file in report.glob(kind)}
    player = ROOT / "src" / "forewarp" / "export" / "player"
    wanted |= {f"forewarp/export/player/{file.name}" for file in player.iterdir()}
    assert wanted <= names
    assert {name.split("/")[0].partition("-")[0] for name in names} == {"forewarp", "hydra_plugins"}
    assert {f"hydra_plugins/forewarp_{name}.py" for name in ("one_at_a_time", "search_path")} <= names


@pytest.mark.slow
def test_commands_work_in_an_empty_folder_and_write_nowhere_else(installed):
    run, folder, site = installed.run, installed.folder, installed.site
    before = files(site)
    assert "price_list_particles (with --multirun)" in run("train", "--help")
    assert list(folder.iterdir()) == []
    run("train", *SMALL, *SHORT, "run=runs/demo")
    assert (folder / "runs" / "demo" / "metrics.json").is_file()
    words = ["sweeps=dnerf", "scene=counterpart_dnerf", *SMALL[1:], "evaluate=false", "seeds=1"]
    run("train", "--multirun", *words, *SHORT, "preset=demo", "model=backward,particles")
    # Our own sweeper multiplies scenes and models.
    fitted = [path.parent.name for path in (folder / "runs" / "paper").rglob("config.yaml")]
    assert sorted(name.split("-")[1] for name in fitted) == ["backward", "particles"]
    run("report", "kind=paper", "runs=runs")
    assert (folder / "runs" / "results" / "paper.md").is_file()
    assert {path.name for path in folder.iterdir()} == {"data", "runs"}
    assert files(site) == before
