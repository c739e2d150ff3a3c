"""A config from a run's folder is data: whoever made it cannot make the reader do anything."""

import importlib
import re
import sys

import pytest
from omegaconf import OmegaConf

from forewarp.files import MOST_CONFIG
from forewarp.runs.config import read_config, saved_config, trust_of, trusted_config, without_trust
from tests.support.configs import CONF, composed


def read(text, *trust):
    return trusted_config(text, "config.yaml", trust)


TARGETS = [
    *("os.system", "builtins.exec", "subprocess.Popen", "hydra.utils.call", "torch.load", "torch.hub.load"),
    # reached through a module that may be named; a function, which would write
    *("forewarp.cli.entry.os.system", "forewarp.cli.entry.Path", "forewarp.data.files.replace_file"),
    *("torch.nn.functional.F", "torch.nn.modules.module.warnings.warn", "lightning.Trainer.fit"),
    *("lightning.pytorch.cli.LightningCLI", "lightning.pytorch.loggers.csv_logs.CSVLogger"),
    # classes of torch and lightning that write files, listen or compile, by whatever way they are reached
    *("torch.nn.functional.torch.package.PackageExporter", "torch.nn.Linear", "torch.distributed.TCPStore"),
    *("torch.optim.optimizer.torch.distributed.TCPStore", "lightning.pytorch.callbacks.os.system"),
    *("lightning.pytorch.loggers.tensorboard.SummaryWriter", "lightning.pytorch.profilers.PyTorchProfiler"),
    "lightning.pytorch.callbacks.ModelCheckpoint",
    # what modules of ours import, though ours it is or looks
    *("forewarp.training.checkpoints.lightning.Trainer", "forewarp.training.callbacks.TensorBoardLogger"),
    *(
        "forewarp.training.checkpoints.torch.package.PackageExporter",
        "forewarp.training.stages.StageSettings",
    ),
    *("forewarp.training.stages.Run.__class__", "forewarp.no.such.thing", "forewarp.", "forewarp"),
    *("forewarped.Thing", "", 7, None, ["os.system"]),
]


@pytest.mark.parametrize("target", TARGETS)
def test_what_is_no_class_of_ours_is_refused(target):
    node = {"_target_": target, "_partial_": True}
    for place in ({"a": node}, {"b": [{"c": {"d": [node]}}]}):
        with pytest.raises(ValueError, match=r"_target_: expected a class of forewarp, but got"):
            read(OmegaConf.to_yaml(place))


@pytest.mark.parametrize("key", ["name", "version", "sub_dir"])
@pytest.mark.parametrize("value", ["/tmp/x", "..", "../x", "a/b", "a\\b", ["x"]])
@pytest.mark.parametrize("logger", ["TensorBoardLogger", "CSVLogger"])
def test_a_logger_stays_in_the_folder_of_its_stage(key, value, logger):
    node = {"_target_": f"lightning.pytorch.loggers.{logger}", key: value}
    read(OmegaConf.to_yaml({"logger": node | {key: "name"}}))
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
        ("a: " + "x" * MOST_CONFIG, f"expected at most {MOST_CONFIG} characters"),
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
        ["experiment=demo_hypernerf"],
        ["experiment=lego_complete", "data.scene=x", "preset=faithful", "trainer=gpu", "logger=none"],
        ["experiment=video_with_poses", "data.scene=x", "model=forward", "model/motion=dct_features"],
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
    (tmp_path / "config.yaml").write_bytes(b"#" * (MOST_CONFIG + 1))
    with pytest.raises(ValueError, match=f"config.yaml: expected at most {MOST_CONFIG} bytes"):
        read_config(tmp_path / "config.yaml")
    (tmp_path / "config.yaml").write_bytes(b"\xff\xfe\x00")
    with pytest.raises(ValueError, match="config.yaml: expected"):
        saved_config(str(tmp_path), OmegaConf.create({}))


@pytest.fixture
def strangers(tmp_path, monkeypatch):
    """A package whose import leaves a trace."""
    folder = tmp_path / "strangers"
    folder.mkdir()
    (folder / "__init__.py").write_text("")
    (folder / "module.py").write_text(
        "import os\nimport subprocess\nfrom functools import partial\n"
        "from forewarp.renderer import Renderer\n"
        "class Thing:\n    @classmethod\n    def make(cls): pass\n"
        "def thing(): pass\nhalf = partial(thing)\nnumber = 3\n"
    )
    (tmp_path / "strangersother").mkdir()
    (tmp_path / "strangersother" / "__init__.py").write_text("class Thing: pass\n")
    monkeypatch.syspath_prepend(str(tmp_path))
    importlib.invalidate_caches()
    yield
    for name in [name for name in sys.modules if name.startswith("strangers")]:
        del sys.modules[name]


def target(name):
    return f"a: {{_target_: {name}}}"


def test_what_is_not_trusted_is_refused_before_it_is_imported(strangers):
    with pytest.raises(ValueError) as refusal:  # noqa: PT011
        read(target("strangers.module.Thing"))
    assert str(refusal.value) == (
        "config.yaml: a._target_: expected a class of forewarp, but got 'strangers.module.Thing'; "
        "if you trust the package strangers, add trust=[strangers] (or set FOREWARP_TRUST=strangers)"
    )
    with pytest.raises(ValueError, match=r"add trust=\[strangers,strangersother\] \(or set"):
        read(target("strangersother.Thing"), "strangers")
    with pytest.raises(ValueError, match=r"expected a class of forewarp, but got 'strangers.module.Thing'"):
        read(target("strangers.module.Thing") + "\ntrust: [strangers]")
    assert not [name for name in sys.modules if name.startswith("strangers")]


@pytest.mark.parametrize("name", ["Thing", "thing", "Thing.make", "Renderer"])
def test_a_trusted_package_may_be_named(strangers, name):
    for trust in ("strangers", "strangers.module"):
        assert read(target(f"strangers.module.{name}"), trust) is not None


@pytest.mark.parametrize(
    ("name", "told"),
    [
        ("module.os.system", "which (posix|nt) defines$"),
        ("module.half", "which functools defines$"),
        ("module.Thing.__subclasses__", "strangers.module.Thing.__subclasses__'$"),
        ("module.Thing.mro", "nothing to call that strangers defines$"),
        ("module.number", "nothing to call that strangers defines$"),
        ("module.absent", "which cannot be imported"),
        ("module", "nothing to call that strangers defines$"),
    ],
)
def test_trust_ends_where_the_package_ends(strangers, name, told):
    with pytest.raises(ValueError, match=f"expected a class of forewarp, but got .*{told}"):
        read(target(f"strangers.{name}"), "strangers")


def test_trust_in_forewarp_changes_nothing():
    for name in ("forewarp.data.files.replace_file", "forewarp.cli.entry.os.system"):
        with pytest.raises(ValueError, match="expected a class of forewarp"):
            read(target(name), "forewarp")


def test_whose_decision_it_is_decides(strangers):
    read(target("builtins.print"), "builtins")
    with pytest.raises(ValueError, match=r"expected a class of forewarp, but got 'builtins.print'$"):
        read(target("builtins.print"))


def test_trust_is_named_in_words_or_in_the_environment(monkeypatch):
    monkeypatch.setenv("FOREWARP_TRUST", "third, theirs")
    assert trust_of() == ("third", "theirs")
    assert trust_of("theirs,other.part") == ("theirs", "other.part", "third")
    monkeypatch.setenv("FOREWARP_TRUST", "")
    assert trust_of(OmegaConf.create(["theirs"])) == ("theirs",)
    assert without_trust(["a", "trust=theirs", "trust=[x, y]"]) == (["a"], ("theirs", "x", "y"))
    assert without_trust(["a"]) == (["a"], ())


@pytest.mark.parametrize(
    "named", ["", "*", "theirs.*", ["theirs", ""], "a,,b", "a/b", 3, True, [None], ".", "a."]
)
def test_what_is_no_name_of_a_package_is_refused(named, monkeypatch):
    with pytest.raises(ValueError, match=r"^trust: expected names of packages, as trust=\[theirs\], but got"):
        trust_of(named)
    if isinstance(named, str) and named:
        monkeypatch.setenv("FOREWARP_TRUST", named)
        with pytest.raises(ValueError, match="^FOREWARP_TRUST: expected names of packages, as FOREWARP_TR"):
            trust_of()


def test_a_config_that_is_compared_is_data(strangers):
    assert trusted_config(target("strangers.module.Thing"), "x", None).a._target_ == "strangers.module.Thing"
    assert "strangers" not in sys.modules
    for text in ("a: ${b}", "a: &x [1]\nb: *x", "a: " + "[" * 60 + "]" * 60, "a: {_args_: [1]}"):
        with pytest.raises(ValueError, match="^x: "):
            trusted_config(text, "x", None)
