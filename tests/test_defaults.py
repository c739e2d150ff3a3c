"""What Python's constructors do is what ``preset=faithful`` does: a default is the same in both places.

(Of particles, whose defaults are those of ``preset=fast``: tests/methods/particles/test_options.py.)
"""

from dataclasses import asdict, is_dataclass
from inspect import Parameter, signature

import pytest
from hydra.utils import get_class
from omegaconf import OmegaConf

from forewarp.methods.ndvg import NDVGStage
from tests.support.configs import composed

METHODS = ["forward", "backward", "nerf", "tnerf", "dnerf", "nerfies", "hypernerf", "ndvg", "tineuvox_s"]
METHODS += ["tineuvox_b", "neural_volumes"]
# Keys that have no default of their own in Python, or another one, and why.
ELSEWHERE = {
    # One class serves both; its defaults are those of S.
    "tineuvox_b": {"model.channels", "model.width", "model.alpha_init"},
}
# Of two stages that differ, the defaults are those of the fine one.
STAGE = "fine"


def plain(value):
    """Return a value as YAML has it: lists for tuples, mappings for dataclasses, {} for None."""
    if is_dataclass(value):
        return plain(asdict(value))
    if isinstance(value, dict):
        return {key: plain(part) for key, part in value.items() if key != "_target_"}
    if isinstance(value, list | tuple):
        return [plain(part) for part in value]
    return value


def defaults_of(cls):
    """Return the defaults of a class's constructor, and of those that it passes other keywords on to."""
    found = {}
    for part in reversed(cls.__mro__):
        if "__init__" in vars(part) and part is not object:
            parameters = signature(part.__init__).parameters.values()
            found |= {p.name: p.default for p in parameters if p.default is not Parameter.empty}
    return found


def differences(place, content, default=None):
    """Yield the keys of a part of a configuration, and of its parts, that have another default in Python.

    A part that is itself a constructor's default, as a method's sampling, is compared as a whole.
    """
    if "_target_" not in content:
        return
    defaults = defaults_of(get_class(content["_target_"])) if default is None else vars(default)
    for key, value in content.items():
        name = f"{place}.{key}"
        if isinstance(value, dict) and "_target_" in value:
            known = defaults.get(key)
            yield from differences(name, value, known if is_dataclass(known) else None)
        elif key in defaults and plain(value) != plain(defaults[key]) and (value or defaults[key]):
            yield name, value, defaults[key]


@pytest.mark.slow
@pytest.mark.parametrize("method", METHODS)
def test_constructors_have_the_defaults_of_the_faithful_preset(method):
    config = composed("data.scene=x", f"model={method}", "preset=faithful")
    config = OmegaConf.to_container(config, resolve=True)
    parts = {"model": config["model"]} | {f"stage.{name}": s for name, s in config["stage"].items()}
    found = [difference for place, part in parts.items() for difference in differences(place, part)]
    assert {name for name, *_ in found} == ELSEWHERE.get(method, set()), found


@pytest.mark.slow
def test_a_stage_of_ndvg_has_the_defaults_of_its_last_one():
    stage = composed("data.scene=x", "model=ndvg", "preset=faithful").stage[STAGE]
    assert asdict(NDVGStage()) == {name: stage[name] for name in asdict(NDVGStage())}
