"""Where there is no browser its tests are skipped, or fail if one is needed."""

import sys

import pytest

from tests.support.browser import NEEDED, chromium


@pytest.mark.parametrize(
    ("needed", "outcome"), [("", pytest.skip.Exception), ("1", pytest.fail.Exception)], ids=["skip", "fail"]
)
@pytest.mark.parametrize("lacks", ["playwright", "chromium"])
def test_a_missing_browser_is_told(monkeypatch, lacks, needed, outcome):
    monkeypatch.setenv(NEEDED, needed)
    if lacks == "playwright":
        monkeypatch.setitem(sys.modules, "playwright.sync_api", None)
    else:
        pytest.importorskip("playwright.sync_api", reason="no playwright; make install-browser adds it")
        monkeypatch.setattr("shutil.which", lambda name: "/nowhere/chromium")
    with pytest.raises(outcome, match=f"no {lacks}.*make install-browser"), chromium():
        pass
