"""What every format refuses."""

import inspect
from importlib import import_module
from types import SimpleNamespace

import pytest
from omegaconf import OmegaConf

from forewarp.cli.export import CHOICES, REAL, WHOLE
from forewarp.export import formats
from forewarp.export.formats import FORMATS, write
from forewarp.export.source import Source
from tests.support.configs import ROOT


@pytest.mark.parametrize("kind", FORMATS)
def test_a_method_that_knows_no_matter_is_refused_in_one_line(tmp_path, kind):
    source = Source(SimpleNamespace(method=object()), "tnerf", [], [0.0])
    options = dict.fromkeys(FORMATS[kind].options)
    with pytest.raises(ValueError, match=f"format={kind}: expected a method .*, but got tnerf"):
        write(kind, source, tmp_path / "out", {}, lambda *n: None, **options)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(("kind", "extra"), [("mesh", "export"), ("html", "viewer")])
def test_without_its_extra_a_format_says_what_to_install(refused, fitted, monkeypatch, kind, extra):
    monkeypatch.setattr(formats, "find_spec", lambda name: None)
    said = refused("export", f"run={fitted}", f"format={kind}")
    assert said.startswith(f"format={kind}: expected the package ")
    assert said.endswith(f"but got none; install forewarp[{extra}]")


@pytest.mark.parametrize("kind", FORMATS)
def test_options_are_arguments_with_defaults_in_the_config_and_limits(kind):
    made = FORMATS[kind]
    function = getattr(import_module(f"forewarp.export.{made.module}"), made.function)
    named = [p.name for p in inspect.signature(function).parameters.values() if p.kind is p.KEYWORD_ONLY]
    assert named == list(made.options)
    config = OmegaConf.load(ROOT / "conf" / "export.yaml")
    for name in named:
        assert name in config
        assert sum(name in known for known in (CHOICES, REAL, WHOLE)) == 1
