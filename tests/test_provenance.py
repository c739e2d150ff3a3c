"""Which code ran: of each package its own version and commit, and nobody else's."""

import importlib
import json
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from packaging.requirements import Requirement

from forewarp import provenance

source_of = provenance.source_of.__wrapped__


@pytest.fixture
def site(tmp_path, monkeypatch):
    """A folder on Python's path."""
    monkeypatch.syspath_prepend(str(tmp_path / "site"))
    (tmp_path / "site").mkdir()
    return tmp_path / "site"


def write(folder, **files):
    for name, text in files.items():
        (folder / f"{name}.py").parent.mkdir(parents=True, exist_ok=True)
        (folder / f"{name}.py").write_text(text)
    importlib.invalidate_caches()


def git(folder, *words):
    who = ["-c", "user.name=a", "-c", "user.email=a@b.c"]
    done = subprocess.run(
        ["git", "-C", str(folder), *who, *words], capture_output=True, text=True, check=True
    )
    return done.stdout.strip()


def record(site, name, version="0.1", **files):
    """What pip leaves of an installed package."""
    folder = site / f"{name.replace('-', '_')}-{version}.dist-info"
    folder.mkdir()
    files = {"METADATA": f"Metadata-Version: 2.1\nName: {name}\nVersion: {version}\n"} | files
    for file, text in files.items():
        (folder / file.replace("_url", "_url.json").replace("top_level", "top_level.txt")).write_text(text)
    importlib.invalidate_caches()


@pytest.mark.slow
def test_the_commit_is_of_the_packages_own_checkout(site):
    write(site / "theirs_p", __init__="", methods="a = 1")
    write(site, alone_p="a = 1")
    git(site, "init", "-q")
    git(site, "add", "theirs_p", "alone_p.py")
    git(site, "commit", "-qm", "first")
    commit = git(site, "rev-parse", "--short=9", "HEAD")
    write(site / "other_p", __init__="")  # lies in the checkout, but is not of it
    assert [source_of(name) for name in ("theirs_p", "alone_p")] == [{"commit": commit}] * 2
    assert source_of("other_p") == source_of("nowhere_p") == {}
    write(site / "theirs_p", methods="a = 2")
    assert source_of("theirs_p") == {"commit": f"{commit}+"}
    assert source_of("alone_p") == {"commit": commit}  # what changed is not its file
    assert not {"theirs_p", "alone_p"} & sys.modules.keys()


@pytest.mark.slow
def test_a_package_without_a_checkout_has_what_was_noted_when_it_was_installed(site):
    for name in ("plain_p", "cloned_p", "named_p"):
        write(site / name, __init__="")
    record(
        site, "plain_p", direct_url=json.dumps({"url": "file:///somewhere", "dir_info": {"editable": True}})
    )
    noted = {"url": "https://somewhere", "vcs_info": {"vcs": "git", "commit_id": "0123456789abcdef"}}
    record(site, "cloned_p", "1.2", direct_url=json.dumps(noted))
    record(site, "of-another-name", "3", top_level="named_p\n")
    assert source_of("plain_p") == {"version": "0.1"}
    assert source_of("cloned_p") == {"version": "1.2", "commit": "012345678"}
    assert source_of("named_p") == {"version": "3"}
    lines = provenance.installed.__wrapped__().splitlines()
    assert lines[0].startswith("# Python 3.")
    assert {"cloned-p==1.2", "of-another-name==3", f"numpy=={np.__version__}"} <= {*lines}
    named = [line.partition("==")[0] for line in lines[1:]]
    assert named == sorted({*named})


def test_versions_are_of_what_results_depend_on():
    assert {"python", "forewarp", "torch", "lightning", "hydra-core", "numpy"} <= provenance.versions().keys()


def test_constraints_pin_what_is_installed_with_us_and_name_no_place():
    root = Path(__file__).parents[1]
    project = (root / "pyproject.toml").read_text().partition("[project.scripts]")[0]
    quoted = [Requirement(text) for text in re.findall(r'"([a-z][\w.-]*(?:\[\w+\])?[<>=][^"]*)"', project)]
    wanted = {one.name for one in quoted} - {"sqlalchemy", "setuptools"}
    launchers = {name for name in wanted if name.startswith("hydra-") and name != "hydra-core"}
    lines = [line for line in (root / "constraints.txt").read_text().splitlines() if line[:1] != "#"]
    pins = [Requirement(line) for line in lines]
    assert not [line for line in lines if re.search(r"[/@+]|\bfile\b", line)]
    assert all(re.fullmatch(r"==[\w.]+", str(pin.specifier)) for pin in pins)
    for python in ("3.10", "3.11", "3.12"):
        of = {"python_version": python, "python_full_version": f"{python}.9", "sys_platform": "linux"}
        here = [pin.name for pin in pins if pin.marker is None or pin.marker.evaluate(of)]
        assert len(here) == len(set(here))
        assert wanted - launchers <= {*here}
