"""A config whose parts are of another kind than every run's is refused by the key, in every command."""

import pytest
import yaml

from forewarp.outline import check_outline
from forewarp.report.results import read_run
from forewarp.runs.config import read_config

GOOD = {"model": {"name": "forward"}, "data": {}, "objective": None, "stage": {"fine": {"curriculum": {}}}}
GOOD |= {"preset": {"name": "demo"}, "budget": {}, "seed": 0, "trainer": {}, "callbacks": {"accuracy": None}}
BIG = int("9" * 300)


@pytest.mark.parametrize(
    ("change", "says"),
    [
        ({"model": ["a"]}, r"model: expected keys of its own, but got \['a'\]; write them below it"),
        ({"model": {"name": ["a"]}}, r"model.name: expected a text, but got \['a'\]"),
        ({"stage": None}, "stage: expected keys of its own, but got None"),
        ({"stage": "x"}, "stage: expected keys of its own, but got 'x'"),
        ({"stage": {"fine": 3}}, "stage.fine: expected keys of its own or null, but got 3"),
        (
            {"stage": {"fine": {"curriculum": True}}},
            "stage.fine.curriculum: expected keys of its own, but got Tr",
        ),
        ({"preset": None}, "preset: expected keys of its own, but got None"),
        ({"budget": -1}, "budget: expected keys of its own, but got -1"),
        (
            {"callbacks": {"accuracy": {"_partial_": 1}}},
            "callbacks.accuracy._partial_: expected true or false",
        ),
        (
            {"data": {"frames": BIG}},
            r"data.frames: expected a number of at most 64 bits, but got 9+\.\.\.9+$",
        ),
        ({"objective": "x"}, "objective: expected keys of its own or null, but got 'x'"),
        ({"paths": {"runs": {}}}, "paths.runs: expected a text, but got {}"),
        ({"trackers": {"tags": 5}}, "trackers.tags: expected a list of texts, but got 5"),
        ({"stage": {"fine": {"objective": {"every": "x"}}}}, "stage.fine.objective.every: expected keys of"),
        ({"paths": ["x"]}, r"paths: expected keys of its own or null, but got \['x'\]"),
    ],
)
def test_a_part_of_another_kind_is_named(tmp_path, change, says):
    check_outline(GOOD)
    (tmp_path / "config.yaml").write_text(yaml.safe_dump(GOOD | change))
    with pytest.raises(ValueError, match=f"config.yaml: {says}"):
        read_config(tmp_path / "config.yaml")
    with pytest.raises(ValueError, match=f"config.yaml: {says}"):
        read_run(tmp_path)
