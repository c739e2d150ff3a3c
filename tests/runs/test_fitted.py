import json
import shutil

from omegaconf import OmegaConf

from forewarp import load
from forewarp.runs.config import saved_config
from forewarp.runs.fitted import opened


def test_a_run_is_opened_to_look_at_and_other_data_are_told(fitted, tmp_path, capsys):
    run = shutil.copytree(fitted, tmp_path / "run")
    config = saved_config(str(run), OmegaConf.create({"trust": []}))
    made, module = opened(config)
    assert made.folder == run
    assert not module.training
    assert capsys.readouterr().err == ""
    before = json.loads((run / "data.json").read_text())
    (run / "data.json").write_text(json.dumps(before | {"texts": {}}))
    for ways in (lambda: opened(config), lambda: load(run)):
        ways()
        assert (
            f"warning: {run}/data.json: expected the data that the run was begun with"
            in capsys.readouterr().err
        )
