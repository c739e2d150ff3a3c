"""A config from a run's folder is data: whoever made it cannot make the reader do anything."""

import re

import pytest
from omegaconf import OmegaConf

from configs import CONF, composed
from forewarp.cli.runs import read_config, saved_config
from forewarp.cli.trusted import MOST_BYTES, trusted_config


def read(text):
    return trusted_config(text, "config.yaml")


TARGETS = [
    "os.system",
    "builtins.exec",
    "subprocess.Popen",
    "hydra.utils.call",
    "forewarp.cli.entry.os.system",  # reached through a module that may be named
    "forewarp.data.files.replace_file",  # a function, which would write
    "forewarp.cli.entry.Path",
    "torch.load",
    "torch.hub.load",
    "torch.nn.functional.F",
    "torch.nn.modules.module.warnings.warn",
    "lightning.pytorch.cli.LightningCLI",
    "lightning.pytorch.callbacks.os.system",
    # classes of torch and lightning that write files, listen or compile, by whatever way they are reached
    "torch.nn.functional.torch.package.PackageExporter",
    "torch.nn.Linear",
    "torch.distributed.TCPStore",
    "torch.optim.optimizer.torch.distributed.TCPStore",
    "lightning.pytorch.loggers.tensorboard.SummaryWriter",
    "lightning.pytorch.profilers.AdvancedProfiler",
    "lightning.pytorch.profilers.PyTorchProfiler",
    "lightning.pytorch.callbacks.ModelCheckpoint",
    "lightning.Trainer.fit",
    # what modules of ours import, though ours it is or looks
    "forewarp.training.checkpoints.lightning.Trainer",
    "forewarp.training.checkpoints.torch.package.PackageExporter",
    "forewarp.training.callbacks.TensorBoardLogger",
    "forewarp.training.stages.StageSettings",
    "forewarp.training.stages.Run.__class__",
    "forewarp.no.such.thing",
    "forewarp.",
    "forewarp",
    "forewarped.Thing",
    "",
    7,
    None,
    ["os.system"],
]


@pytest.mark.parametrize("target", TARGETS)
@pytest.mark.parametrize("where", ["top", "deep"])
def test_what_is_no_class_of_ours_is_refused(target, where):
    node = {"_target_": target, "_partial_": True}
    text = OmegaConf.to_yaml({"a": node} if where == "top" else {"b": [{"c": {"d": [node]}}]})
    with pytest.raises(ValueError, match=r"_target_: expected a class of forewarp, but got"):
        read(text)


@pytest.mark.parametrize("key", ["name", "version", "sub_dir"])
@pytest.mark.parametrize("value", ["/tmp/x", "..", "../x", "a/b", "a\\b", ["x"]])
def test_a_logger_stays_in_the_folder_of_its_stage(key, value):
    node = {"_target_": "lightning.pytorch.loggers.TensorBoardLogger", key: value}
    with pytest.raises(ValueError, match=f"logger.{key}: expected the name of a folder, but got"):
        read(OmegaConf.to_yaml({"logger": node}))


@pytest.mark.parametrize("text", ["${oc.env:HOME}", "x${a}", "${oc.create:{a: 1}}", "${oc.decode:1}"])
def test_interpolations_are_refused(text):
    with pytest.raises(ValueError, match=r"a: expected a plain value, but got"):
        read(OmegaConf.to_yaml(OmegaConf.create({"a": "PLACE"})).replace("PLACE", repr(text)))


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("a: &x [1]\nb: *x", "expected no aliases, but got"),
        ("a: " + "[" * 60 + "]" * 60, "expected at most 40 levels"),
        ("a: " + "x" * MOST_BYTES, f"expected at most {MOST_BYTES} characters"),
        ("a: !!python/object/apply:os.system [false]", "expected YAML"),
        ("- 1", "expected a mapping"),
        ("a: {_args: [1]}", "_args: expected no key of this name"),
        ("a: {_args_: [1]}", "_args_: expected no key of this name"),
        ("a: [", "expected YAML"),
    ],
)
def test_what_is_no_plain_config_is_refused_in_one_line(text, said):
    with pytest.raises(ValueError, match=said) as refusal:
        read(text)
    assert len(str(refusal.value).splitlines()) == 1
    assert str(refusal.value).startswith("config.yaml: ")


@pytest.mark.parametrize(
    "words",
    [
        [],
        ["experiment=demo_hypernerf"],
        ["experiment=nhr", "data.scene=x", "model=backward"],
        ["experiment=lego_complete", "data.scene=x", "budget=faithful", "trainer=gpu"],
        ["experiment=video_with_poses", "data.scene=x", "model/motion=dct_features", "logger=none"],
    ],
)
def test_what_we_write_ourselves_is_trusted(words):
    text = OmegaConf.to_yaml(OmegaConf.create(OmegaConf.to_container(composed(*words), resolve=True)))
    assert read(text) == OmegaConf.create(text)


def test_every_target_of_ours_is_trusted():
    files = [path for path in CONF.rglob("*.yaml") if path.relative_to(CONF).parts[0] != "hydra"]
    named = {target for path in files for target in re.findall(r"_target_: (\S+)", path.read_text())}
    assert len(named) > 20
    for target in named:
        read(f"a: {{_target_: {target}}}")


def test_a_large_file_is_not_read(tmp_path):
    (tmp_path / "config.yaml").write_bytes(b"#" * (MOST_BYTES + 1))
    with pytest.raises(ValueError, match=f"config.yaml: expected at most {MOST_BYTES} bytes"):
        read_config(tmp_path / "config.yaml")
    (tmp_path / "config.yaml").write_bytes(b"\xff\xfe\x00")
    with pytest.raises(ValueError, match="config.yaml: expected"):
        saved_config(str(tmp_path), OmegaConf.create({}))
