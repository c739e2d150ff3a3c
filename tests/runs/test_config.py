"""A config from a run's folder is data: whoever made it cannot make the reader do anything."""

import importlib
import re
import sys

import pytest
from hydra.core.override_parser.overrides_parser import OverridesParser
from omegaconf import OmegaConf

from forewarp.files import MOST_CONFIG
from forewarp.runs import config
from forewarp.runs.config import (
    HOMES,
    check_values,
    read_config,
    saved_config,
    trust_of,
    trusted_config,
    without_trust,
)
from forewarp.runs.overrides import as_text
from tests.support.configs import CONF, composed


def typed(word):
    """An override, as Hydra reads it."""
    return OverridesParser.create().parse_override(word)


def read(text, *trust):
    return trusted_config(text, "config.yaml", trust)


def target(name, key="model"):
    return f"{key}: {{_target_: {name}}}"


TARGETS = [
    *("os.system", "builtins.exec", "hydra.utils.call", "torch.load", "torch.hub.load"),
    # reached through a module that may be named; a function, which would write
    *("forewarp.cli.entry.os.system", "forewarp.cli.entry.Path", "forewarp.files.replace_file"),
    *("torch.nn.modules.module.warnings.warn", "lightning.Trainer.fit", "lightning.pytorch.cli.LightningCLI"),
    "lightning.pytorch.loggers.csv_logs.CSVLogger",
    # classes of torch and lightning that write files, listen or compile, by whatever way they are reached
    *("torch.nn.functional.torch.package.PackageExporter", "torch.nn.Linear", "torch.distributed.TCPStore"),
    *("lightning.pytorch.loggers.tensorboard.SummaryWriter", "lightning.pytorch.profilers.PyTorchProfiler"),
    *("lightning.pytorch.callbacks.os.system", "lightning.pytorch.callbacks.ModelCheckpoint"),
    # what modules of ours import, though ours it is or looks
    *("forewarp.training.checkpoints.lightning.Trainer", "forewarp.training.loggers.TensorBoardLogger"),
    *("forewarp.training.checkpoints.torch.package.PackageExporter", "forewarp.training.stages.Curriculum"),
    *("forewarp.training.stages.Run.__class__", "forewarp.no.such.thing", "forewarp.", "forewarp"),
    *("forewarped.Thing", "", 7, None, ["os.system"]),
]


@pytest.mark.parametrize("target", TARGETS)
def test_what_is_no_class_of_ours_is_refused(target):
    node = {"_target_": target, "_partial_": True}
    for place in ({"a": node}, {"b": [{"c": {"d": [node]}}]}):
        for trust in ((), ("forewarp",)):  # which changes nothing
            with pytest.raises(ValueError, match=r"_target_: expected a class of forewarp, but got"):
                read(OmegaConf.to_yaml(place), *trust)


@pytest.mark.parametrize("key", ["name", "version", "sub_dir"])
def test_a_logger_stays_in_the_folder_of_its_run(key):
    for logger in ("lightning.pytorch.loggers.TensorBoardLogger", "forewarp.training.loggers.CsvLogger"):
        node = {"_target_": logger}
        read(OmegaConf.to_yaml({"logger": node | {key: "name"}}))
        for value in ("/tmp/x", "..", "../x", "a/b", "a\\b", ["x"]):
            with pytest.raises(ValueError, match=f"logger.{key}: expected the name of a folder, but got"):
                read(OmegaConf.to_yaml({"logger": node | {key: value}}))


PLAIN = "a: expected a plain value, but got"
ODD = [
    *((f"a: {text!r}", PLAIN) for text in ("${oc.env:HOME}", "x${a}", "${oc.create:{a: 1}}", "${oc.dec:1}")),
    ("a: &x [1]\nb: *x", "expected no aliases, but got"),
    ("a: " + "[" * 60 + "]" * 60, "expected at most 40 levels"),
    ("a: !!python/object/apply:os.system [false]", "expected YAML"),
    ("- 1", "expected a mapping"),
    *((f"a: {{{name}: [1]}}", f"{name}: expected no key of this name") for name in ("_args", "_args_")),
    ("a: [", "expected YAML"),
    *((f"a: {tag}", "but got the tag") for tag in ("!!binary JHtvYy5lbnY6SE9NRX0=", "!!set {x}", "!x y")),
    ('a: !!python/object/apply:pathlib.PosixPath ["${oc.env:HOME}"]', "but got the tag"),
    ("${oc.env:HOME}: 1", "expected a plain value"),
    ("a: 1" + ":59" * 9999, "expected numbers of at most 308 digits"),
]


@pytest.mark.parametrize("trust", [(), None])  # None: only compared, but data all the same
@pytest.mark.parametrize(("text", "said"), ODD)
def test_what_is_no_plain_config_is_refused_in_one_line(text, said, trust):
    with pytest.raises(ValueError, match=re.escape(said)) as refusal:
        trusted_config(text, "config.yaml", trust)
    assert len(str(refusal.value).splitlines()) == 1
    assert str(refusal.value).startswith("config.yaml: ")


FROM_VIDEO = ["experiment=video_with_poses", "data.scene=x", "model=forward", "model/motion=dct_features"]


@pytest.mark.slow
@pytest.mark.parametrize("words", [["experiment=demo_hypernerf"], FROM_VIDEO])
def test_what_we_write_ourselves_is_trusted(words):
    text = OmegaConf.to_yaml(OmegaConf.create(OmegaConf.to_container(composed(*words), resolve=True)))
    assert read(text) == OmegaConf.create(text)


def test_every_target_of_ours_is_trusted():
    files = [path for path in CONF.rglob("*.yaml") if path.relative_to(CONF).parts[0] != "hydra"]
    # What Hydra itself is given, such as its own callbacks, is in no run's folder.
    texts = [re.sub(r"^hydra:\n( .*\n?|\n)*", "", path.read_text(), flags=re.M) for path in files]
    named = {name.strip("}") for text in texts for name in re.findall(r"_target_: (\S+)", text)}
    assert len(named) > 20
    places = {name: [key for key in HOMES if is_read(target(name, key))] for name in named}
    assert [name for name, keys in places.items() if not keys] == []
    assert places["forewarp.evaluation.curves.AccuracyCurve"] == ["callbacks"]
    assert not any(is_read(target("forewarp.runs.jobs.ReportCost", key)) for key in (*HOMES, "hydra"))
    assert places["forewarp.synth.module.SyntheticDataModule"] == ["data"]


def is_read(text):
    try:
        return bool(read(text))
    except ValueError:
        return False


def test_a_class_of_ours_is_refused_where_it_does_not_belong():
    writes = "forewarp.training.checkpoints.KeepCheckpoint"
    for text in (target(writes, "callbacks"), target("forewarp.renderer.Renderer", "planned")):
        with pytest.raises(ValueError, match="which is none for this key"):
            read(text)


@pytest.mark.parametrize(
    ("key", "value"),
    [
        *(("checkpoint_seconds", "[nan]"), ("checkpoint_seconds", "inf"), ("evaluate", "maybe")),
        *(("seed", str(2**32)), ("seed", "1.5"), ("lpips_weights", "[a,3]"), ("callbacks.progress", "text")),
        *(("data.scene", "' '"), ("data.scene", "../../x"), ("data.seed", "-1")),
    ],
)
def test_a_value_that_would_be_noticed_late_is_refused_at_once(key, value):
    config = composed("data.scene=x")
    OmegaConf.update(config, key, typed(f"{key}={value}").value(), force_add=True)
    with pytest.raises(ValueError, match=f"^{re.escape(key)}: expected "):
        check_values(config)


NAMES = ["{a}", "null", "a=b", "~x", "-x", "[a]", "[a", "{", "'", "a'b", "a\\", "$x", "1e3", "007", "(1)"]
NAMES += [" a ", "true"]


@pytest.mark.slow
def test_odd_names_are_taken_as_typed():
    for name in NAMES:
        scene, run = map(typed, as_text([f"data.scene={name}", f"run=runs/{name}"]))
        assert (scene.value(), run.value()) == (name, f"runs/{name}")
    config = composed(*as_text(["data.scene=[a", "run=runs/a'b"]))
    assert (config.data.scene, config.run) == ("[a", "runs/a'b")


PATTERNS = [r"(?P<camera>\d+)_(?P<frame>\d+)", "(?P<frame>[0-9]+)$", r"^(a,b|\(c\))=(?P<time>[\d.]+)", "a,b"]


@pytest.mark.parametrize("pattern", PATTERNS)
def test_a_pattern_of_names_is_one_text(pattern):
    for key in ("name_pattern", "data.name_pattern"):
        (word,) = as_text([f"{key}={pattern}"])
        assert as_text(["--multirun", word, f"{key}={pattern}"])[1:] == [word, word]
        assert typed(word).value() == pattern


def test_a_list_null_and_an_interpolation_stay_hydras_and_home_is_found(monkeypatch):
    monkeypatch.setenv("HOME", "/home/me")
    assert as_text(["runs=[a,b]", "run=null", "run=${paths.runs}/x", "out=~/x", "data.scene=~/x"]) == [
        *("runs=[a,b]", "run=null", "run=${paths.runs}/x", "out=/home/me/x", "data.scene='~/x'")
    ]


def test_a_file_that_holds_no_config_is_refused(tmp_path):
    path = tmp_path / "config.yaml"
    for content, said in (
        (b"#" * (MOST_CONFIG + 1), f"expected at most {MOST_CONFIG} bytes"),
        (b"a: 1", "expected the key data, but got none"),
        (b"\xff\xfe\x00", "expected"),
    ):
        path.write_bytes(content)
        with pytest.raises(ValueError, match=f"config.yaml: {said}"):
            read_config(path)
        with pytest.raises(ValueError, match=f"config.yaml: {said}"):
            saved_config(str(tmp_path), OmegaConf.create({}))


@pytest.fixture
def strangers(tmp_path, monkeypatch):
    """A package whose import leaves a trace, and another."""
    (tmp_path / "strangers").mkdir()
    (tmp_path / "strangers" / "__init__.py").write_text("")
    (tmp_path / "strangers" / "module.py").write_text(
        "import os\nfrom functools import partial\nfrom forewarp.renderer import Renderer\n"
        "class Thing:\n    @classmethod\n    def make(cls): pass\n"
        "def thing(): pass\nhalf = partial(thing)\nnumber = 3\n"
    )
    (tmp_path / "strangersother.py").write_text("class Thing: pass\n")
    monkeypatch.syspath_prepend(str(tmp_path))
    importlib.invalidate_caches()
    yield
    for name in [name for name in sys.modules if name.startswith("strangers")]:
        del sys.modules[name]


def test_what_is_not_trusted_is_refused_before_it_is_imported(strangers):
    thing = target("strangers.module.Thing")
    line = (
        "config.yaml: model._target_: expected a class of forewarp, but got 'strangers.module.Thing'; "
        "if you trust the package strangers, add trust=[strangers] (or set FOREWARP_TRUST=strangers)"
    )
    for text in (thing, f"{thing}\ntrust: [strangers]"):  # a folder has no say in it
        with pytest.raises(ValueError, match=f"^{re.escape(line)}$"):
            read(text)
    with pytest.raises(ValueError, match=r"add trust=\[strangers,strangersother\] \(or set"):
        read(target("strangersother.Thing"), "strangers")
    assert trusted_config(thing, "x", None).model._target_ == "strangers.module.Thing"  # compared, never made
    assert not [name for name in sys.modules if name.startswith("strangers")]
    read(target("builtins.print"), "builtins")
    with pytest.raises(ValueError, match=r"expected a class of forewarp, but got 'builtins.print'$"):
        read(target("builtins.print"))


@pytest.mark.parametrize("name", ["Thing", "thing", "Thing.make", "Renderer"])
def test_a_trusted_package_may_be_named(strangers, name):
    for trust in ("strangers", "strangers.module"):
        assert read(target(f"strangers.module.{name}"), trust) is not None


NOTHING = "nothing to call that strangers defines$"


@pytest.mark.parametrize(
    ("name", "told"),
    [
        ("module.os.system", "which (posix|nt) defines$"),
        ("module.half", "which functools defines$"),
        ("module.Thing.__subclasses__", "strangers.module.Thing.__subclasses__'$"),
        *((name, NOTHING) for name in ("module.Thing.mro", "module.number", "module")),
        ("module.absent", "which cannot be imported"),
    ],
)
def test_trust_ends_where_the_package_ends(strangers, name, told):
    with pytest.raises(ValueError, match=f"expected a class of forewarp, but got .*{told}"):
        read(target(f"strangers.{name}"), "strangers")


def test_trust_is_named_in_words_or_in_the_environment(monkeypatch):
    monkeypatch.setenv("FOREWARP_TRUST", "third, theirs")
    assert trust_of() == ("third", "theirs")
    assert trust_of("theirs,other.part") == ("theirs", "other.part", "third")
    monkeypatch.setenv("FOREWARP_TRUST", "")
    assert trust_of(OmegaConf.create(["theirs"])) == ("theirs",)
    assert without_trust(["a", "trust=theirs", "trust=[x, y]"]) == (["a"], ("theirs", "x", "y"))
    assert without_trust(["a"]) == (["a"], ())


NO_NAMES = ["", "*", "theirs.*", ["theirs", ""], "a,,b", "a/b", 3, True, [None], ".", "a."]


@pytest.mark.parametrize("named", NO_NAMES)
def test_what_is_no_name_of_a_package_is_refused(named, monkeypatch):
    with pytest.raises(ValueError, match=r"^trust: expected names of packages, as trust=\[theirs\], but got"):
        trust_of(named)
    if isinstance(named, str) and named:
        monkeypatch.setenv("FOREWARP_TRUST", named)
        with pytest.raises(ValueError, match="^FOREWARP_TRUST: expected names of packages, as FOREWARP_TR"):
            trust_of()


@pytest.mark.slow
def test_sweeps_with_other_budgets_have_folders_of_their_own(in_tmp, monkeypatch):
    place = {"sweep": True}
    monkeypatch.setattr(config, "is_swept", lambda: place["sweep"])

    def folder(*words):
        monkeypatch.setattr(config, "typed_overrides", lambda: list(words))
        monkeypatch.setattr(config, "constant", {word.partition("=")[0] for word in words} - {"seed"})
        job = composed("experiment=demo", "budget.minutes=null", *words)
        return config.hashed(job), job

    short, longer = (["budget.iterations=3"], ["budget.iterations=5"])
    runs = [folder(*budget, f"seed={seed}")[0].run for budget in (short, longer) for seed in (0, 1)]
    assert len(set(runs)) == 4
    assert all(re.fullmatch(r"runs/vehicle/particles-demo-seed[01]-\w{10}", run) for run in runs)
    others = [folder(*short, "seed=0", word)[0].run for word in ("data.held_out=8", "data.root=elsewhere")]
    assert len({*runs, *others}) == 6
    place["sweep"] = False
    plain, job = folder(*short, "seed=0")
    assert plain.run == "runs/vehicle/particles-demo-seed0"  # as before, and as a sweep named it
    stored = in_tmp / plain.run / "config.yaml"
    stored.parent.mkdir(parents=True)
    stored.write_text(OmegaConf.to_yaml(job, resolve=True))
    place["sweep"] = True
    assert folder(*short, "seed=0")[0].run == plain.run
    assert folder(*longer, "seed=0")[0].run == runs[2]
    stored.write_text("nothing")
    assert folder(*short, "seed=0")[0].run == runs[0]
