"""What pages name exists: files, symbols, keys, targets of ``make`` and modules."""

import re
from functools import cache
from pathlib import Path
from pkgutil import resolve_name

import pytest

from tests.support.configs import CONF, ROOT
from tests.test_site import FENCE, PAGES

SOURCE = ROOT / "src" / "forewarp"
# Where a file that a page names may lie; of a bare name anywhere in the package, the tests or the configs.
BASES = (ROOT, SOURCE, CONF, ROOT / "src", ROOT / "docs", ROOT / "docs" / "results")
TREES = (SOURCE, ROOT / "tests", CONF)
FILE = re.compile(r"([\w.-]+(?:/[\w.-]+)*\.(?:py|yaml|toml))(?:(?:: |::)(.+))?")
SYMBOL = re.compile(r"([A-Z][a-z]\w*(?:\.\w+)*)(?:\(.*\))?")
KEY = re.compile(r"[+~]{0,2}([a-z][\w/]*(?:\.(?:\w+|<\w+>))*)(=?)[^ =]*")
GROUPS = {
    "stage",
    "model",
    "data",
    "preset",
    "budget",
    "callbacks",
    "objective",
    "target",
    "trackers",
    "paths",
}
# Of what a run writes and of other programs; capitals that are no symbols; of a page's address.
FILES = {"config.yaml", "plan.yaml", "hparams.yaml", "render.py"}
WORDS = {
    "None",
    "True",
    "Host",
    "Origin",
    "Ours",
    "ParticleField3DGaussianSplat",
    "CamPose.inf",
    "Intrinsic.inf",
}
KEYS = {"trails", "controls"}
YOURS = re.compile(r"mine|[A-Z]{4}|^\+?hydra\.")  # of the reader, or of a plugin of Hydra's


def spans(text: str) -> list[str]:
    """Return the pieces of code within a page's sentences and tables."""
    return re.findall(r"(?<!`)`([^`\n]+)`(?!`)", FENCE.sub("", text).replace("\\|", "|"))


@cache
def read(file: Path) -> str:
    """Return the text of a file."""
    return file.read_text()


def named_in(file: Path) -> set[str]:
    """Return what a file defines or imports, and the attributes that it sets."""
    text = read(file)
    imported = re.findall(r"^ *(?:from [\w.]+ )?import (.*)$", text, re.MULTILINE)
    stored = re.findall(r"(?:^|\.|, )\s*(\w+)(?:: [^=\n(]+)?(?: =|: |, )", text, re.MULTILINE)
    return {*re.findall(r"(?:class|def) (\w+)", text), *stored, *re.findall(r"\w+", " ".join(imported))}


@cache
def symbols() -> set[str]:
    """Return what any file of the package defines or imports."""
    return set().union(*map(named_in, SOURCE.rglob("*.py")))


@cache
def keys() -> set[str]:
    """Return the groups of options, all keys of configurations, and what the package annotates."""
    found = KEYS | {folder.name for folder in CONF.rglob("*") if folder.is_dir()}
    for file in (*CONF.rglob("*.yaml"), *(ROOT / "sweeps").rglob("*.yaml"), *SOURCE.rglob("*.py")):
        for key in re.findall(r"([\w/@.]+)\"?:(?=\s)", read(file)):
            found.update(re.split(r"[/@.]", key))
    return found


def files_of(name: str) -> list[Path]:
    """Return the files that a page may mean by a name."""
    near = [base / name for base in BASES if (base / name).is_file()]
    return near or [file for tree in TREES if "/" not in name for file in tree.rglob(name)]


def resolves(name: str) -> bool:
    """Return whether a dotted name of the package can be imported."""
    try:
        return resolve_name(name) is not None
    except (ImportError, AttributeError):
        return False


def is_missing(code: str) -> bool:
    """Return whether a piece of code names a file, symbol or key that does not exist."""
    if YOURS.search(code):
        return False
    if named := FILE.fullmatch(code):
        inside = set(re.findall(r"\w+", named[2] or ""))
        return named[1] not in FILES and not any(inside <= named_in(file) for file in files_of(named[1]))
    if code.startswith("forewarp.") and re.fullmatch(r"[\w.]+", code):
        return not resolves(code)
    if symbol := SYMBOL.fullmatch(code):
        return code not in WORDS and not set(symbol[1].split(".")) <= symbols()
    key = KEY.fullmatch(code)
    if key and (key[2] or ("." in key[1] and key[1].partition(".")[0] in GROUPS)):
        return not {part for part in re.split(r"[/.]", key[1]) if part.isidentifier()} <= keys()
    return False


@pytest.mark.slow
@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.relative_to(ROOT).as_posix())
def test_what_pages_name_exists(page):
    text = page.read_text()
    own = "\n".join(block for _, _, block in FENCE.findall(text))  # a page's own files and symbols
    assert [code for code in spans(text) if is_missing(code) and code.rpartition("/")[2] not in own] == []


def test_what_does_not_exist_is_found():
    good = [
        "methods/method.py: Method.at",
        "Snapshot",
        "forewarp.load",
        "data.held_out=8",
        "stage.fine.density",
    ]
    stale = ["scene/batch.py", "methods/method.py: Method.gaze", "Skin", "forewarp.lode", "data.hold_out=8"]
    assert [code for code in good + stale if is_missing(code)] == stale


def test_targets_and_modules_that_pages_name_exist():
    targets = set(re.findall(r"^([\w-]+):", (ROOT / "Makefile").read_text(), re.MULTILINE))
    for page in PAGES:
        text = page.read_text()
        code = "\n".join([*spans(text), *(block for _, _, block in FENCE.findall(text))])
        assert set(re.findall(r"^\s*make ([a-z][\w-]*)", code, re.MULTILINE)) <= targets, page
        for module in re.findall(r"python -m (tests[\w.]*)", text):
            assert files_of(module.replace(".", "/") + ".py"), (page, module)
