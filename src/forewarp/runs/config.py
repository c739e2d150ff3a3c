"""Keep a run's config in its folder, read it back safely, and tell runs apart by their configs.

A run's folder may come from anyone: its config is data, which may name classes of forewarp and of packages
that the user trusts, and nothing else. Nothing here loads torch, so a mistyped command is answered at once.
"""

from __future__ import annotations

import glob
import hashlib
import importlib
import inspect
import json
import os
import re
import sys
from collections.abc import Iterable, Sequence
from contextlib import suppress
from pathlib import Path

from hydra.core.hydra_config import HydraConfig
from hydra.types import RunMode
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from forewarp.data.files import RECORD, mismatch, number, one_of
from forewarp.files import MOST_CONFIG, check_command, parse_yaml, read_text, refuse_links
from forewarp.outline import check_outline
from forewarp.runs.devices import device_for
from forewarp.runs.overrides import constant, key_of, typed_overrides

# Two runs differ if these keys differ; device, folder and what is shown do not count.
IDENTITY = ("data", "model", "objective", "stage", "preset", "budget", "seed")
# Keys that tell runs apart where they are set; configs of before lack them.
IDENTITY_IF_SET = ("start", "target")
NOT_OF_RUN = ("cache_bytes", "disk_cache_bytes")  # keys of the data that change no frame
DATA_IF_SET = ("name_pattern",)  # keys of the data that count where they are set; configs of before lack them
HASH = "{hash}"
# May be set beside resume=<run>.
MAY_CHANGE = "trainer", "threads", "lpips_weights", "sheets", "views", "reduce", "evaluate", "logger"
MAY_CHANGE += "trackers", "checkpoint_seconds", "sentinel", "data_changed", "score", "viewer", "host", "port"
MAY_CHANGE += ("plan_only",)
MOST_SEED = 2**31 - 100  # each stage adds its number, and what finds poses takes 31 bits
TRUST_VARIABLE = "FOREWARP_TRUST"
# Allowed beside the classes of forewarp. Listed by full name, as a prefix would allow all of torch.
_LOGGERS = ("CSVLogger", "MLFlowLogger", "TensorBoardLogger", "WandbLogger")
ELSEWHERE = {f"lightning.pytorch.loggers.{name}" for name in _LOGGERS}
ELSEWHERE |= {"lightning.Trainer", "lightning.pytorch.Trainer"}
# Where a config may name our own classes: key at the top -> beginnings of their full names. Classes that
# write to a path, such as the checkpoints' callback, are in none of these modules.
_PARTS_OF_METHODS = ("forewarp.methods.", "forewarp.fields.", "forewarp.renderer.")
_WATCHERS = ("curves.AccuracyCurve", "images.TrainingImages")
HOMES = {
    "data": ("forewarp.data.module.", "forewarp.synth.module."),
    "model": _PARTS_OF_METHODS,
    "objective": ("forewarp.training.objective.",),
    "stage": (*_PARTS_OF_METHODS, "forewarp.training.objective.", "forewarp.training.schedule."),
    "callbacks": ("forewarp.training.callbacks.", *(f"forewarp.evaluation.{name}" for name in _WATCHERS)),
    "trainer": ("lightning.Trainer", "lightning.pytorch.Trainer"),
    "logger": ("lightning.pytorch.loggers.", "forewarp.training.loggers.CsvLogger"),
}
_RESERVED = {"_target_", "_partial_", "_recursive_", "_convert_"}
# What OmegaConf raises for plain data that are no config.
_NO_CONFIG = OmegaConfBaseException, ValueError, TypeError, AssertionError
_PARTS = {"name", "version", "sub_dir"}  # keys that make up the path a logger writes to
# Its others.
_PLAIN = {"default_hp_metric", "flush_logs_every_n_steps", "log_graph", "prefix"}
_PLAIN |= {"project", "group", "tags", "notes", "job_type", "offline", "experiment_name"}
_NAMED = ("model", "preset", "seed", "data", "data.root", "data.scene", "data.held_out")  # see ``in_words``
UNUSED = ("logger", "callbacks")  # parts of a config that only training uses


def hashed(config: DictConfig) -> DictConfig:
    """Replace ``{hash}`` in the key ``run`` by ten digits of a hash of the keys that tell runs apart.

    So each configuration has a folder of its own, and a finished job is found again. A precision other than
    32-true counts too, and for a run bounded by minutes the device and the number of threads. Before the
    digits of a job of a sweep stands what tells it apart; so do they where a sweep names no folders, even if
    nothing but the seed differs: the next sweep may have another budget. A folder without digits that holds
    this very run, as earlier versions named them, is found again.
    """
    typed, run = typed_overrides(), str(config.run)
    words = in_words([word for word in typed if key_of(word) not in constant]) if is_swept() else ""
    usual = f"{config.data.get('scene')}/{config.model.name}-{config.preset.name}-seed{config.seed}"
    is_usual = is_swept() and Path(run).as_posix().endswith(usual)
    if (words or is_usual) and HASH not in run and "run" not in map(key_of, typed):
        if holds(Path(run), config):
            return config
        run += f"-{HASH}"
    if HASH in run:
        digits = content_hash(config)
        told = "-".join(filter(None, (words, digits)))
        pattern = glob.escape(run).replace(HASH, f"*{digits}")
        config.run = next(iter(sorted(glob.glob(pattern))), run.replace(HASH, told))
    return config


def holds(folder: Path, config: DictConfig) -> bool:
    """Tell whether a folder holds a run of this config; one that cannot be read does not."""
    path = folder / "config.yaml"
    if not path.is_file():
        return False
    with suppress(ValueError, OSError):
        return content_hash(read_config(path, None)) == content_hash(config)
    return False


def is_swept() -> bool:
    """Tell whether this is a job of ``--multirun``."""
    return HydraConfig.initialized() and HydraConfig.get().mode == RunMode.MULTIRUN


def in_words(overrides: Sequence[str]) -> str:
    """Name a job of a sweep by its overrides, but for what its folder's name says by itself.

    >>> in_words(["model=forward", "stage.fine.lr.means=1e-3", "model/view_dependence=sh", "~stage.coarse"])
    'fine-means-1e-3-view_dependence-sh-without-coarse'
    """
    words = []
    for override in overrides:
        key, value = key_of(override), override.partition("=")[2]
        first, *others = re.split(r"[./]", key)
        name = "-".join(dict.fromkeys([*others[: first in ("stage", "objective")], *others[-1:]])) or first
        if first in (*IDENTITY, "ablation", "capture") and key not in _NAMED and value != "null":
            word = f"without-{name}" if override.startswith("~") else f"{name}-{value.strip('[]')}"
            words.append(re.sub(r"[^\w.-]+", "_", word).strip("-_."))
    while len(words) > 1 and len("-".join(words)) > 60:
        words.pop()
    return "-".join(words)[:60]


def content_hash(config: DictConfig, more: Sequence[str] = (), *others: object) -> str:
    """Return ten digits of a SHA-256 of ``IDENTITY`` and ``more`` keys of a config, and of ``others``."""
    make_absolute(config)
    content = {key: plain(config.get(key)) for key in (*IDENTITY, *more)}
    content |= {key: value for key in IDENTITY_IF_SET if (value := set_value(config, key)) is not None}
    if isinstance(data := content["data"], dict):
        absent = {key for key in DATA_IF_SET if data.get(key) is None}
        content["data"] = {key: value for key, value in data.items() if key not in {*NOT_OF_RUN, *absent}}
    precision = config.trainer.get("precision")
    if config.budget.minutes is not None:
        content["on"] = [device_for(config).type, precision, config.get("threads")]
    elif precision not in (None, "32-true"):
        content["precision"] = precision
    if others:
        content["others"] = others
    return hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()[:10]


def set_value(config: DictConfig, key: str) -> object:
    """Return what a key holds, as dicts and lists; None where there is nothing but null, or no key."""
    value = plain(config.get(key))
    nothing = isinstance(value, dict) and all(part is None for part in value.values())
    return None if nothing else value


def plain(part: object) -> object:
    """Return a part of a config as dicts and lists, its interpolations resolved."""
    return OmegaConf.to_container(part, resolve=True) if OmegaConf.is_config(part) else part


def saved_config(
    run: str | None, changes: DictConfig, key: str = "run", unused: Sequence[str] = UNUSED
) -> DictConfig:
    """Read the config in a run's folder and apply the changes that the command line may make.

    Args:
        run: the run's folder.
        changes: the command's own config; the keys ``trainer``, ``threads``, ``lpips_weights``, ``sheets``
            and ``data.root`` are applied if they are not null. ``trust`` names packages whose code the run's
            config may name.
        key: name of the key that holds the folder, for errors.
        unused: parts of the config that are left out, and need no trust.

    Raises:
        ValueError: if there is no run, a link lies in its folder, its scene is procedural and missing, or
            the config names code that is not trusted.
    """
    if run is None:
        raise ValueError("run: expected the folder of a run, but got nothing; set run=runs/...")
    refuse_links(Path(run))
    path = Path(run) / "config.yaml"
    if not path.is_file():
        raise mismatch(path, "the configuration of a run", "none", f"set {key}=<a run's folder>")
    saved = read_config(path, trust_of(changes.get("trust")), unused)
    for name in ("trainer", "threads", "lpips_weights", "sheets"):
        if changes.get(name) is not None:
            saved[name] = changes[name]
    if (changes.get("data") or {}).get("root") is not None:
        saved.data.root = changes.data.root
    saved.run = str(run)
    check_values(saved)
    refuse_to_synthesize(saved)
    return saved


def resumed(config: DictConfig) -> DictConfig:
    """With ``resume=<folder>``: return the config in the folder, with the typed keys that may change.

    Raises:
        ValueError: if another key was typed, or the folder holds no run.
    """
    if config.get("resume") is None:
        return config
    typed = typed_overrides(of_sweep=True)
    replaced = ["logger"] if any(key_of(override).split(".")[0] == "logger" for override in typed) else []
    trust = OmegaConf.create({"trust": config.get("trust")})
    saved = saved_config(str(config.resume), trust, "resume", replaced)
    saved.resume, saved.data_changed = str(config.resume), "refuse"
    saved.paths = config.get("paths")  # where loggers write beside the run, as this command has it
    for override in typed:
        key = key_of(override)
        if key == "data.root":
            saved.data.root = config.data.root
        elif key.split(".")[0] in MAY_CHANGE:
            saved[key.split(".")[0]] = config[key.split(".")[0]]
        elif key not in ("resume", "trust"):
            expected = f"{key}: expected no such key beside resume=, whose config.yaml holds it"
            known = f"{', '.join(MAY_CHANGE)}, data.root, trust"
            raise ValueError(f"{expected}, but got {override}; beside it go {known}")
    return saved


def read_config(path: Path, trust: Sequence[str] | None = (), unused: Sequence[str] = ()) -> DictConfig:
    """Read the config in a run's folder; ``trust`` and ``unused`` as in ``trusted_config``.

    Raises:
        ValueError: if the file is no config of a run, or names untrusted code.
    """
    config = trusted_config(read_text(path, MOST_CONFIG), path, trust, unused)
    check_outline(OmegaConf.to_container(config), f"{path}: ")
    if config.get("renders") is not None:
        advice = "measure them again by the command in this file"
        raise mismatch(path, "a run of forewarp", "images that another program rendered", advice)
    for key in (*IDENTITY, "trainer", "callbacks"):
        if key not in config and key != "objective":  # a method may have no objective
            raise ValueError(f"{path}: expected the key {key}, but got none; delete the run's folder")
    return config


def check_values(config: DictConfig) -> None:
    """Refuse values of a run's config that would be noticed late, or never.

    Raises:
        ValueError: naming the key.
    """
    for key in ("data", "callbacks"):
        if not OmegaConf.is_dict(config.get(key)):
            raise ValueError(f"{key}: expected keys of its own, but got {config.get(key)!r:.80}")
    if config.data.get("_target_") is None:
        raise ValueError("data: expected a layout, but got none (_target_); set data=dnerf or the like")
    number(config.get("checkpoint_seconds"), "checkpoint_seconds", 0)
    check_command(config.get("command"), "command")
    for key in ("seed", "data.seed", "data.synthesis.seed"):
        if key == "seed" or OmegaConf.select(config, key) is not None:
            check_seed(OmegaConf.select(config, key), key)
    one_of(config.get("evaluate", True), "evaluate", True, False)
    weights = config.get("lpips_weights")
    places = weights if OmegaConf.is_list(weights) else [] if weights is None else [weights]
    if not all(isinstance(place, str) for place in places):
        raise ValueError(f"lpips_weights: expected a file, a folder, a list or null, but got {weights}")
    for name, callback in config.callbacks.items():
        if callback is not None and "_target_" not in (callback if OmegaConf.is_dict(callback) else {}):
            raise ValueError(f"callbacks.{name}: expected a class (_target_) or null, but got {callback}")
    scene = None if OmegaConf.is_missing(config.data, "scene") else config.data.get("scene")
    if isinstance(scene, str) and (not scene.strip() or {"..", "/"} & set(Path(scene).parts)):
        raise ValueError(f"data.scene: expected the name of a folder below data.root, but got {scene!r}")


def check_seed(seed: object, key: str = "seed") -> None:
    """Refuse a seed that random numbers of some package could not begin from."""
    if type(seed) is not int or not 0 <= seed <= MOST_SEED:
        raise ValueError(f"{key}: expected a whole number in [0, {MOST_SEED}], but got {seed}")


def refuse_to_synthesize(config: DictConfig) -> None:
    """Refuse a stored config whose procedural scene is missing: a run's folder writes nothing elsewhere.

    Raises:
        ValueError: naming the scene's folder.
    """
    target, root = str(config.data.get("_target_")), Path(str(config.data.get("root")))
    folder = root if "LegoComplete" in target else root / str(config.data.get("scene"))
    if target.startswith("forewarp.synth.") and not (folder / RECORD).is_file():
        advice = "write it by the run's own command (command: in its config.yaml), or set data.root"
        raise ValueError(f"data.root: expected the scene of the run, but got none in {folder}; {advice}")


def make_absolute(config: DictConfig) -> None:
    """Make ``data.root`` and ``start`` absolute, as a run may be evaluated from another folder."""
    for part, key in ((config, "start"), (config.data, "root")):
        if not OmegaConf.is_missing(part, key) and part.get(key) is not None:
            part[key] = str(Path(part[key]).expanduser().resolve())


def trusted_config(
    text: str, where: Path, trust: Sequence[str] | None = (), unused: Sequence[str] = ()
) -> DictConfig:
    """Parse a resolved config; refuse a config that is not safe to instantiate.

    Args:
        text: the YAML.
        where: the file, named in errors.
        trust: packages whose code the config may name; no other package is imported.
            None: do not check targets, for a config that is only compared and never instantiated.
        unused: keys that are emptied, and so not checked.

    Raises:
        ValueError: if the text is no YAML mapping, has aliases or interpolations, or is nested too deep; if a
            ``_target_`` is neither a class of forewarp (named by the module that defines it), nor in
            ``ELSEWHERE``, nor defined in a trusted package; or if a logger would write outside the run's
            folder.
    """
    content = parse_yaml(text, where)
    if not isinstance(content, dict):
        raise ValueError(f"{where}: expected a mapping, but got another kind; delete the run's folder")
    content |= {key: {} for key in unused}
    _check(content, where, "", trust)
    try:
        return OmegaConf.create(content)
    except _NO_CONFIG as error:
        reason = (str(error).splitlines() or [type(error).__name__])[0]
        raise ValueError(f"{where}: expected a config, but got {reason}; delete the run's folder") from None


def trust_of(named: str | Iterable[str] | None = None) -> tuple[str, ...]:
    """List the trusted packages: those named, then those in ``FOREWARP_TRUST``.

    Args:
        named: a name, several separated by commas, or a list; None: none.

    Raises:
        ValueError: for a name that is no package name, such as an empty one or a wildcard.

    >>> trust_of("theirs"), trust_of(["theirs", "other.part", "theirs"])
    (('theirs',), ('theirs', 'other.part'))
    """
    found: dict[str, None] = {}
    for source, given in (("trust", named), (TRUST_VARIABLE, os.environ.get(TRUST_VARIABLE) or None)):
        names = given.split(",") if isinstance(given, str) else [] if given is None else given
        for name in list(names) if isinstance(names, Iterable) else [names]:
            name = name.strip() if isinstance(name, str) else name
            if not isinstance(name, str) or not all(part.isidentifier() for part in name.split(".")):
                expected = f"names of packages, as {source}={'[theirs]' if source == 'trust' else 'theirs'}"
                raise ValueError(f"{source}: expected {expected}, but got {name!r:.80}; name each")
            found[name] = None
    return tuple(found)


def without_trust(arguments: Sequence[str]) -> tuple[list[str], tuple[str, ...]]:
    """Split a command line into the arguments other than ``trust=...`` and the packages to trust.

    >>> without_trust(["run", "trust=[theirs,other]"])
    (['run'], ('theirs', 'other'))
    """
    named = [argument.partition("=")[2] for argument in arguments if argument.startswith("trust=")]
    lists = [re.sub(r"^\[(.*)\]$", r"\1", text) for text in named]
    rest = [argument for argument in arguments if not argument.startswith("trust=")]
    return rest, trust_of([name for text in lists for name in text.split(",")])


def check_planned(config: DictConfig, trust: Sequence[str]) -> None:
    """Check a config composed with overrides from a plan file, like a stored config."""
    where = f"plan={config.planned}"
    _check(OmegaConf.to_container(config, resolve=True), where, "", trust)


def _check(node: object, where: Path, key: str, trust: Sequence[str] | None) -> None:
    if isinstance(node, dict):
        for name, value in node.items():
            _check_plain(name, where, key)
            inner = f"{key}.{name}" if key else str(name)
            if name == "_target_" and trust is not None:
                check_target(value, where, inner, trust)
                _check_logger(node, where, key)
            elif str(name).startswith("_") and name not in _RESERVED:
                raise ValueError(f"{where}: {inner}: expected no key of this name; delete it")
            _check(value, where, inner, trust)
    elif isinstance(node, list):
        for i, value in enumerate(node):
            _check(value, where, f"{key}[{i}]", trust)
    else:
        _check_plain(node, where, key)


def _check_plain(value: object, where: Path, key: str) -> None:
    """Refuse a key or a value that is no plain data, or that would be resolved later."""
    if not isinstance(value, str | int | float | bool | None) or (isinstance(value, str) and "${" in value):
        raise ValueError(
            f"{where}: {key}: expected a plain value, but got {str(value)[:80]}; write the value"
        )


def check_target(name: object, where: Path | str, key: str, trust: Sequence[str]) -> None:
    """Refuse a ``_target_`` unless it is a class of forewarp, in ``ELSEWHERE``, or of a trusted package.

    Raises:
        ValueError: naming file and key, and how to trust the package.
    """
    home = HOMES.get(re.split(r"[./\[]", key)[0], ())
    if isinstance(name, str) and name in ELSEWHERE and name.startswith(home):
        return
    refusal = f"{where}: {key}: expected a class of forewarp, but got {name!r:.80}"
    parts = name.split(".") if isinstance(name, str) else []
    if len(parts) < 2 or not all(part.isidentifier() for part in parts):
        raise ValueError(refusal)
    if name.startswith("lightning.pytorch.loggers."):
        raise ValueError(f"{refusal}; a folder may name {', '.join(_LOGGERS)}; add logger=NAME to resume=")
    if parts[0] != "forewarp":
        _check_foreign(name, refusal, trust)
        return
    found = _imported(parts, refusal)
    # A module's own imports do not count: ``forewarp.cli.entry.Path`` is not a class of forewarp.
    if not inspect.isclass(found) or found.__module__ != name.rpartition(".")[0]:
        raise ValueError(refusal)
    if not name.startswith(home):
        raise ValueError(f"{refusal}, which is none for this key")


def _imported(parts: Sequence[str], refusal: str) -> object:
    """Import what a name names, first modules, then attributes."""
    try:
        found = importlib.import_module(parts[0])
        for i, part in enumerate(parts[1:], 2):
            if not hasattr(found, part) and hasattr(found, "__path__"):
                importlib.import_module(".".join(parts[:i]))
            found = getattr(found, part)
        return found
    except Exception as error:  # an import may raise anything
        reason = str(error).partition("\n")[0] or type(error).__name__
        raise ValueError(f"{refusal}, which cannot be imported ({reason:.120})") from None


def _check_foreign(name: str, refusal: str, trust: Sequence[str]) -> None:
    """Refuse a target that no trusted package defines; import nothing of packages that are not trusted."""
    if not _is_below(name, trust):
        raise ValueError(refusal + advice(name, trust))
    parts = name.split(".")
    if any(part.startswith("__") for part in parts):
        raise ValueError(refusal)
    found = _imported(parts, refusal)
    # A module's own imports do not count, or ``theirs.module.subprocess.run`` would be allowed.
    home = getattr(found, "__module__", None)
    if not callable(found) or not isinstance(home, str):
        raise ValueError(f"{refusal}, which is nothing to call that {parts[0]} defines")
    if not _is_below(home, trust) and not (inspect.isclass(found) and _is_below(home, ["forewarp"])):
        raise ValueError(f"{refusal}, which {home} defines{advice(home, trust)}")


def _is_below(name: str, trust: Sequence[str]) -> bool:
    return any(f"{name}.".startswith(f"{package}.") for package in trust)


def advice(name: str, trust: Sequence[str] = ()) -> str:
    """Say how to trust the package of a name; return "" for Python's own modules.

    >>> advice("theirs.Class", ["other"])
    '; if you trust the package theirs, add trust=[other,theirs] (or set FOREWARP_TRUST=other,theirs)'
    """
    package = name.partition(".")[0]
    if package in sys.stdlib_module_names:
        return ""
    names = ",".join([*trust, package])
    return f"; if you trust the package {package}, add trust=[{names}] (or set {TRUST_VARIABLE}={names})"


def _check_logger(node: dict, where: Path, key: str) -> None:
    """Refuse a logger that would write outside the run's folder, by its name or by an option."""
    if not node["_target_"].startswith(HOMES["logger"]):
        return
    if node.get("tracking_uri") is not None:
        got, advice = f"{node['tracking_uri']!r:.80}", "set MLFLOW_TRACKING_URI, or add logger=mlflow"
        raise ValueError(f"{where}: {key}.tracking_uri: expected null, but got {got}; {advice}")
    if others := sorted(node.keys() - _PARTS - _PLAIN - _RESERVED - {"tracking_uri"}):
        known = f"one of {', '.join(sorted(_PARTS | _PLAIN))}"
        raise mismatch(f"{where}: {key}.{others[0]}", known, "another option", "delete it")
    for name in sorted(_PARTS & node.keys()):
        if not re.fullmatch(r"(\w[\w.-]*)?", str(node[name])):
            raise mismatch(f"{where}: {key}.{name}", "the name of a folder", f"{node[name]!r:.80}")
