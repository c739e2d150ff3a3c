"""The docs site: its navigation, its links, its commands, its build, and how it looks in a browser."""

import importlib
import importlib.util
import os
import re
import runpy
import shlex
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import pytest
import yaml

from forewarp.runs.sections import option_groups
from tests.support.browser import Tab, chromium, until
from tests.support.commands import call
from tests.support.configs import CONF, ROOT

DOCS = ROOT / "docs"
PAGES = [ROOT / "README.md", *sorted(DOCS.rglob("*.md"))]
MADE = {"index.md", "reference/index.md"}  # by docs/site/hooks.py
FENCE = re.compile(r"^( *)```(\w*)\n(.*?)^ *```", re.MULTILINE | re.DOTALL)
# What a reader types into the search -> the title of the first page that it lists.
FOUND = {"average splat": "forewarp.ops", "page of a run": "The page of a run", "the viewer": "The viewer"}
# Of packages that tests/cli/test_foreign.py writes, of plans that must exist, and patterns of commands.
OTHERS = ("forewarp-data", "--config-dir", "mine", "model=balls", "plan=", "specimen_<", "...")


def pages_in(entry) -> list[str]:
    """Return the files that a part of the navigation names."""
    if isinstance(entry, str):
        return [entry]
    parts = entry.values() if isinstance(entry, dict) else entry
    return [file for part in parts for file in pages_in(part)]


def anchors(page: Path) -> set[str]:
    """Return the anchors of a page's headings."""
    titles = re.findall(r"^#+ +(.*)$", FENCE.sub("", page.read_text()), re.MULTILINE)
    plain = [re.sub(r"\[(.*?)\]\(.*?\)|[`*]", r"\1", title).strip().lower() for title in titles]
    return {re.sub(r"[^\w\- ]", "", title).replace(" ", "-") for title in plain}


def broken(page: Path) -> list[str]:
    """Return the links of a page that lead nowhere in the repository."""
    found = []
    text = re.sub(r"`[^`\n]*`", "", FENCE.sub("", page.read_text()))
    for link in re.findall(r"\]\(([^)\s]+)\)", text):
        file, _, anchor = link.partition("#")
        target = page.parent / file if file else page
        if re.match(r"https?:", link):
            continue
        if not target.exists() or (anchor and target.suffix == ".md" and anchor not in anchors(target)):
            found.append(link)
    return found


def commands() -> list[str]:
    """Return what pages show after ``forewarp-``; of commands that differ in numbers and names alone, one."""
    found, groups = {}, set(option_groups(CONF))
    for page in PAGES:
        for _, language, text in FENCE.findall(page.read_text()):
            for line in text.replace("\\\n", " ").splitlines() if language == "bash" else ():
                shown = re.match(r"\s*(?:\.venv/bin/)?forewarp-(.*)", line)
                if shown and not any(word in line for word in OTHERS):
                    words = shlex.split(re.sub(r"<[^>]*>", "folder", shown[1]), comments=True)
                    keys = (word.partition("=")[0] for word in words)
                    kind = (word if key in groups else key for word, key in zip(words, keys))
                    found.setdefault(frozenset(kind), shlex.join(words))
    return sorted(found.values())


def composed(line: str) -> tuple[str, list[str]]:
    """Return a command and words that compose its config, of a sweep the first job's."""
    name, *words = shlex.split(line)
    kept = [word for word in words if not word.startswith(("--", "job", "launcher=", "hydra."))]
    if "--multirun" in words:
        kept = [re.sub(r"=(tag|range|interval)\(.*", "=1", word).split(",")[0] for word in kept]
    return name, [*kept, "--cfg", "job"]


def test_the_navigation_holds_every_page_once():
    navigation = pages_in(yaml.safe_load((ROOT / "mkdocs.yml").read_text())["nav"])
    written = {page.relative_to(DOCS).as_posix() for page in PAGES[1:]}
    assert sorted(navigation) == sorted(written | MADE)


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.relative_to(ROOT).as_posix())
def test_links_lead_somewhere(page):
    assert broken(page) == []


def test_links_that_lead_nowhere_are_found(tmp_path):
    page = tmp_path / "page.md"
    page.write_text("# A b\n[a](#a-b) [b](#b) [c](page.md#a-b) [d](none.md) [e](https://x.org) `[f](none)`")
    assert broken(page) == ["#b", "none.md"]


@pytest.mark.parametrize("script", sorted(DOCS.rglob("*.py")), ids=lambda script: script.name)
def test_scripts_find_what_they_import(script):
    try:
        runpy.run_path(str(script), run_name="imported")  # does not call its main
    except ModuleNotFoundError as error:
        if error.name.startswith("forewarp"):
            raise
        pytest.skip(f"no {error.name}")


def test_the_moving_picture_is_small():
    assert (DOCS / "images" / "hook.gif").stat().st_size < 3e6


@pytest.fixture
def part(monkeypatch):
    """``part("hooks")`` is a module of ``docs/site``."""
    pytest.importorskip("mkdocstrings_handlers", reason="no mkdocstrings: make docs adds it")
    monkeypatch.syspath_prepend(str(DOCS / "site"))
    return importlib.import_module


def test_links_to_source_lead_to_the_reference_and_bars_need_no_escape(part):
    page = SimpleNamespace(file=SimpleNamespace(src_uri="results/a.md"))
    text = "[a](../../src/forewarp/ops/splat.py) [b](../b.md#c)\n| `x\\|y` | z \\| |"
    led = part("hooks").on_page_markdown(text, page, None, None)
    assert led == "[a](../reference/ops.md#forewarp.ops.splat) [b](../b.md#c)\n| `x|y` | z \\| |"


def test_doctests_are_fenced(part):
    fenced = part("doctests").fenced
    assert fenced("Add.\n\n>>> 1 + 1\n2\n\nSo.") == "Add.\n\n```pycon\n>>> 1 + 1\n2\n```\n\nSo."


@pytest.mark.slow
@pytest.mark.parametrize("line", commands())
def test_commands_of_the_pages_are_understood(line, in_tmp):
    name, words = composed(line)
    if importlib.util.find_spec(f"forewarp.cli.{name}") is None:
        pytest.skip(f"no forewarp-{name}")
    if {"sweeps=search", "sweeps=search_keys"} & set(words):
        pytest.importorskip("hydra_plugins.hydra_optuna_sweeper", reason="no Optuna: make install-launchers")
    done = call(name, *words)
    assert done.status in (None, 0), done.err


@pytest.fixture(scope="module")
def site(tmp_path_factory):
    """The folder of the built site."""
    pytest.importorskip("mkdocstrings_handlers", reason="no mkdocstrings: make docs adds it")
    folder = tmp_path_factory.mktemp("site")
    words = (sys.executable, "-m", "mkdocs", "build", "--strict", "--quiet", "--site-dir", str(folder))
    quiet = os.environ | {"NO_MKDOCS_2_WARNING": "1"}
    done = subprocess.run(words, cwd=ROOT, env=quiet, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stdout + done.stderr
    return folder


@pytest.mark.slow
def test_the_site_fetches_nothing_from_elsewhere(site):
    fetched = re.compile(
        r"<(?:script|img|iframe)[^>]*src=.?(?:https?:)?//[^>]*|<link[^>]*href=.?https?://[^>]*"
    )
    pages = list(site.rglob("*.html"))
    assert len(pages) > 40
    assert {found for page in pages for found in fetched.findall(page.read_text())} == set()


@pytest.mark.slow
def test_the_reference_shows_functions_and_their_doctests_as_code(site):
    pages = {page.stem: page.read_text() for page in (site / "reference").glob("*.html")}
    assert 'id="forewarp.ops.splat.average_splat"' in pages["ops"]
    assert 'id="forewarp.load"' in pages["forewarp"]
    assert "language-pycon" in pages["ops"]
    assert [name for name, text in pages.items() if "<blockquote>" in text] == []


@pytest.mark.slow
@pytest.mark.browser
def test_pages_open_from_disk_fit_a_phone_and_are_searched(site):
    with chromium() as browser:
        tab = Tab(browser, None, width=390, height=800)
        for file in ("index.html", "method.html", "results/price-list.html", "reference/ops.html"):
            tab.page.goto((site / file).as_uri(), wait_until="networkidle")
            assert tab.page.evaluate("document.documentElement.scrollWidth") <= 390, file
        wide = Tab(browser, None, width=1280, height=800)
        wide.page.goto((site / "index.html").as_uri())
        box, titles = wide.page.get_by_role("textbox", name="Search"), ".md-search-result__item h1"

        def lists_first(title, words):
            box.fill("")
            box.press_sequentially(words)  # again, if the index was not read yet
            wide.page.wait_for_timeout(1000)
            return wide.page.locator(titles).all_inner_texts()[:1] == [title]

        box.click()
        for words, title in FOUND.items():
            assert until(lists_first, title, words)
        assert (tab.errors, wide.errors) == ([], [])
