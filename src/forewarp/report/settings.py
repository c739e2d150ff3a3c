"""Tell runs apart by what they compute: which keys of a configuration count, and how a difference is named.

Runs whose configurations are equal in all that counts are repetitions, told apart by their seeds. Any other
difference is a *setting*, named by the overrides that were typed, or where these do not tell two runs apart
by the fewest keys that do.
"""

from __future__ import annotations

import hashlib
import json
import re
import shlex
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import suppress

Row = dict

# Keys of a run's config.yaml that change neither what is computed nor how it is measured, and why. All others
# count, those of other packages too.
NOT_COUNTED = {
    "seed": "what repetitions differ in",
    "seeds": "how many jobs a sweep has",
    **dict.fromkeys(
        ("paths", "run", "data.root"), "where files lie; data.json says whether they are the same"
    ),
    **dict.fromkeys(("data.cache_bytes", "data.disk_cache_bytes"), "memory, and no frame"),
    **dict.fromkeys(("trainer.accelerator", "trainer.devices", "threads"), "the protocol says what computed"),
    **dict.fromkeys(("views", "reduce"), "the protocol says which views were measured, and how large"),
    **dict.fromkeys(("logger", "trackers", "viewer", "host", "port", "sheets"), "what is shown"),
    **dict.fromkeys(("evaluate", "score", "lpips_weights"), "what is measured, not how"),
    **dict.fromkeys(("checkpoint_seconds", "resume", "trust", "absent", "data_changed"), "how the job runs"),
    "plan_only": "such a run is not made",
    "renders": "where images lay that another program rendered",
    "sentinel.skip": "how many broken steps may be",
    "callbacks": "ours only watch; those of other packages count",
    **dict.fromkeys(("command", "variant", "debug"), "names; a debug run is left out as a whole"),
    **dict.fromkeys(("capture", "effects", "plan", "planned"), "what chose the effects, which count"),
}
WATCHERS = "forewarp."  # callbacks below it only watch
# Typed keys whose choice every row has in a column or in its ``CONDITIONS``.
IN_COLUMNS = {
    "model",
    "preset",
    "ablation",
    "experiment",
    "dataset",
    "scene",
    "data",
    "data.scene",
    "windows",
}
IN_COLUMNS |= {"data.held_out", "data.half_resolution", "data.scale", "trainer"}
IN_COLUMNS |= {"name", "minutes", "device", "megabytes"}  # of images that another program rendered
IN_COLUMNS |= {"sweeps", "launcher", "budget.minutes", "budget.iterations", "budget.clock", "budget"}

DIGEST = "configuration"  # names rows of tables whose configurations nothing else tells apart
# Rows that differ in these are not compared; how each is named where rows differ in it.
CONDITIONS = {"clock": "{} clock", "threads": "threads: {:g}", "device": "{}", "measured": "{}"}
CONDITIONS |= {"pictures": "{}", "iterations": "{:g} steps at most", "held_out": "{:g} views held out"}
CONDITIONS |= {"train_views": "{:g} training views"}
# What runs that only differ in the seed share, beside their configuration.
SAME = ("dataset", "scene", "method", "preset", "ablation", "minutes", *CONDITIONS)


def key_of(row: Row, names: Iterable[str]) -> tuple:
    """Return a row's values; where all test views were measured, that is None, as in older tables."""
    every = "measured" in row and (row["measured"] or "").startswith("all ")
    return tuple(None if every and name == "measured" else row[name] for name in names)


def words_of(name: str) -> list[str]:
    """Split a setting or a command into its overrides, without spaces inside them.

    >>> words_of("preset.rays=64 stage.fine.num_voxels=[[0, 8000]] ~stage.coarse")
    ['preset.rays=64', 'stage.fine.num_voxels=[[0,8000]]', '~stage.coarse']
    """
    return [re.sub(r"\s", "", part) for part in re.split(r"(?<!\s)\s+(?=[+~]|[\w./]+=)", name) if part]


def counts(key: str) -> bool:
    """Tell whether a key, dotted or of a group, changes what a run computes.

    >>> counts("data.root"), counts("logger.csv.name"), counts("data.box"), counts("runner")
    (False, False, True, True)
    """
    parts = re.split(r"[./]", key)
    return not any(".".join(parts[:n]) in NOT_COUNTED for n in range(1, len(parts) + 1))


def configuration(config: Mapping, files: object = None, planned: Iterable[str] = ()) -> dict[str, object]:
    """Return what counts of a run's configuration: dotted key -> value; a key that is null has no entry.

    Of a run that planned its effects (``effects: auto``) what the plan chose does not count, which may differ
    from seed to seed, but what was typed does, and what the plan left alone.

    Args:
        config: the content of ``config.yaml``.
        files: the fingerprint of the scene's files, if there is one.
        planned: the overrides of the run's plan.
    """
    counted = {key: value for key, value in flat(config) if counts(key) and value is not None}
    for name, callback in (config.get("callbacks") or {}).items():
        if callback and not str(callback.get("_target_")).startswith(WATCHERS):
            counted |= {f"callbacks.{name}.{key}": value for key, value in flat(callback)}
    if counted.get("data.seed") == config.get("seed"):
        counted.pop("data.seed", None)
    if _is_drawn_anew(config):
        counted.pop("data.synthesis.seed")
        files = None
    if start := counted.get("start"):  # of the same seed, where windows of a film have several
        counted["start"] = re.sub(rf"seed{config.get('seed')}\b", "seed", str(start))
    for name, stage in (config.get("stage") or {}).items():  # repeats objective.<name>
        if (stage or {}).get("objective") == (config.get("objective") or {}).get(name):
            counted = {key: v for key, v in counted.items() if not key.startswith(f"stage.{name}.objective.")}
    if config.get("effects") == "auto":
        effects = [word.partition("=")[0].replace("/", ".") for word in planned if word.startswith("model/")]
        effects += ["model.trajectory"] if "model.motion" in effects else []  # which motion brings
        counted = {key: v for key, v in counted.items() if ".".join(key.split(".")[:2]) not in effects}
        counted |= typed(str(config.get("command")))
    if files:
        counted["data.files"] = digest_of(files)
    return counted


def digest_of(content: object) -> str:
    """Return eight digits of a SHA-256 of what JSON can hold.

    >>> digest_of({"a": 1.0, "b": None}) == digest_of({"b": None, "a": 1.0})
    True
    """
    return hashlib.sha256(json.dumps(content, sort_keys=True, default=str).encode()).hexdigest()[:8]


def _is_drawn_anew(config: Mapping) -> bool:
    """Tell whether a procedural scene has other cameras for each seed, as specimens have: its folder is named
    by the seed.
    """
    data, seed = config.get("data") or {}, config.get("seed")
    is_named = re.search(rf"seed{seed}\b", str(data.get("root"))) is not None
    return is_named and (data.get("synthesis") or {}).get("seed") == seed


def flat(content: object, key: str = "") -> Iterator[tuple[str, object]]:
    """Yield the dotted keys and the values of nested mappings; a list is one value, and 1 is 1.0.

    >>> dict(flat({"a": {"b": 1, "c": [1, 2]}, "d": None}))
    {'a.b': 1.0, 'a.c': '[1.0, 2.0]', 'd': None}
    """
    if isinstance(content, Mapping):
        for name, value in content.items():
            yield from flat(value, f"{key}.{name}" if key else str(name))
    elif isinstance(content, list):
        yield key, json.dumps([value for part in content for _, value in flat(part)])
    else:
        is_bool = isinstance(content, bool)
        yield key, json.dumps(content) if is_bool else float(content) if isinstance(content, int) else content


def typed(command: str) -> dict[str, str]:
    """Return the overrides of a command that count and that no column tells: key -> override, as typed.

    >>> typed("forewarp-train seed=1 model=forward logger=csv 'preset.rays=64' ~stage.coarse")
    {'preset.rays': 'preset.rays=64', 'stage.coarse': '~stage.coarse'}
    """
    words = []
    with suppress(ValueError):  # quotes that do not end
        words = shlex.split(command.partition(" #")[0])
    overrides = [re.sub(r"\s", "", word) for word in words if "=" in word or word.startswith("~")]
    by_key = {word.partition("=")[0].lstrip("+~"): word for word in overrides}
    counted = {key: word for key, word in by_key.items() if key not in IN_COLUMNS and counts(key)}
    return {key: word for key, word in counted.items() if not key.startswith(("-", "hydra."))}


def scene_of(row: Row) -> str:
    """Return the scene's name without what ``name_scenes`` adds."""
    return row["scene"].removesuffix(f" (files {row.get('files')})")


def name_scenes(rows: Iterable[Row]) -> None:
    """Add the digest of its ``files`` to the name of a scene that other rows have of other files, as two
    captures of one name are other scenes. Rows that lack it, as those of earlier versions, keep the name.
    """
    for same in grouped(((row.get("dataset"), scene_of(row)), row) for row in rows).values():
        several = len({row.get("files") for row in same} - {None}) > 1
        for row in same:
            digest = f" (files {row['files']})" if several and row.get("files") else ""
            row["scene"] = scene_of(row) + digest


def name_settings(rows: Sequence[Row]) -> None:
    """Give rows their ``overrides``, ``setting``, ``words`` and ``variant``, and other scenes other names
    (``name_scenes``).

    ``overrides`` has the typed overrides that count and, where two configurations would share these under the
    same conditions, more keys. ``setting`` is that without what all rows share on each scene, and does not
    depend on the scene; ``words`` are the same by their keys, with keys as short as they are
    unambiguous. ``variant`` names a row among these: its ablation, or its method and preset where rows differ
    in them, and its words; ``base`` for a row without any of those that others of its method and preset have.

    A row of a CSV file has no ``configuration``: the ``overrides`` stored there tell, or else its command.
    Rows of the same words with another ``digest`` are named by their experiments, or else by the digest.
    """
    name_scenes(rows)
    words: dict[int, dict[str, str]] = {}
    for family in grouped((family_of(row), row) for row in rows).values():
        words |= _overrides(family)
    for row in rows:
        row["overrides"] = _text(words[id(row)])
    kept = set()
    for of_scene in grouped((row["scene"], words[id(row)]) for row in rows).values():
        every = {key for of_row in of_scene for key in of_row}
        kept |= {key for key in every if len({of_row.get(key) for of_row in of_scene}) > 1}
    words = {
        row: {key: word for key, word in overrides.items() if key in kept} for row, overrides in words.items()
    }
    short = shortest({key for of_row in words.values() for key in of_row})
    plain = grouped((family_of(row), row) for row in rows if family_of(row)[-1] is None)
    counted = {name: len({_text(words[id(row)]) for row in of_family}) for name, of_family in plain.items()}
    main = max(counted, key=counted.get, default=None)
    for row in rows:
        overrides = words[id(row)]
        shown = {key: word.lstrip("+").replace(key, short[key], 1) for key, word in overrides.items()}
        is_main = row["ablation"] == "base" or (family_of(row) == main and counted[main] > 1)
        begin = family_of(row)[-1] or ("" if is_main else f"{row['method']}-{row['preset']}")
        row |= {"setting": _text(overrides), "words": shown}
        row["variant"] = " ".join(filter(None, (begin, _text(shown)))) or "base"
    for same in grouped((row["variant"], row) for row in rows).values():
        if len({*map(family_of, same)}) > 1:
            for row in same:
                row["variant"] = f"{row['method']}-{row['preset']} {row['variant']}"


def family_of(row: Row) -> tuple[str, str, str | None]:
    """Return method, preset and ablation; None for the preset as it is, which ``ablation=base`` names."""
    return row["method"], row["preset"], None if row["ablation"] == "base" else row["ablation"]


def _text(words: Mapping[str, str]) -> str:
    return " ".join(words.values())


def _overrides(family: Sequence[Row]) -> dict[int, dict[str, str]]:
    """Return each row's overrides by their keys, by its id; rows are of one method, preset and ablation."""
    words: dict[int, dict[str, str]] = {}
    for same in grouped(((row["scene"], _identity(row)), row) for row in family).values():
        stored = [_stored(row) for row in same]
        shared = [key for key in sorted(stored[0]) if all(key in of_row for of_row in stored)]
        words |= {id(row): {key: stored[0][key] for key in shared} for row in same}
    configured, used = [row for row in family if row.get("configuration") is not None], set()
    while key := _telling(configured, words, used):
        used.add(key)
        for row in configured:
            words[id(row)] = dict(
                sorted((words[id(row)] | _word(key, row["configuration"].get(key))).items())
            )
    cells = grouped((_cell(row, words), row) for row in family if row.get("digest"))
    for cell in cells.values():
        pairs, digests = {(row["digest"], _experiment(row)) for row in cell}, {row["digest"] for row in cell}
        is_distinct = len({experiment for _, experiment in pairs}) == len(pairs) == len(digests)
        for row in cell if len(digests) > 1 else ():
            word = _experiment(row) if is_distinct else f"{DIGEST}={row['digest']}"
            words[id(row)] |= {word.partition("=")[0]: word}
    return words


def _cell(row: Row, words: Mapping[int, Mapping]) -> tuple:
    """Return what rows of one family share that only their configurations could tell apart."""
    return key_of(row, ("scene", "minutes", *CONDITIONS)), _text(words[id(row)])


def _experiment(row: Row) -> str:
    """Return the typed override that chooses a row's experiment; ``experiment=none`` without one."""
    typed_words = re.findall(r"(?:^|\s)\+?(experiment=\S+)", row["command"] or "")
    return typed_words[-1] if typed_words else "experiment=none"


def _word(key: str, value: object) -> dict[str, str]:
    """Write a key of a configuration as if it were typed; a class is named without its module.

    >>> _word("model.upsampler._target_", "theirs.parts.Learned"), _word("model.blur", 2.0)
    ({'model.upsampler': 'model.upsampler=Learned'}, {'model.blur': 'model.blur=2'})
    """
    name = key.removesuffix("._target_")
    text = value_text(name, {key: value})
    return {name: f"{name}={''.join(text.split())}"}


def value_text(key: str, values: Mapping[str, object]) -> str:
    """Write the value of a key of a configuration; of a class its name, and null where there is none."""
    if (target := values.get(f"{key}._target_")) is not None:
        return str(target).rpartition(".")[2]
    value = values.get(key)
    is_whole = isinstance(value, float) and value.is_integer()
    return "null" if value is None else str(int(value)) if is_whole else str(value)


def _identity(row: Row) -> object:
    """Tell which configuration a row has; of a row of a table without digests, what its overrides tell."""
    return row.get("digest") or tuple(_stored(row).values())


def _stored(row: Row) -> dict[str, str]:
    """Return the overrides of a row by their keys, but for those that ``_overrides`` adds to tables."""
    if (stored := row.get("overrides")) is None:
        return typed(row["command"] or "")
    named = {re.split("=", word)[0].lstrip("+~"): word for word in words_of(stored)}
    return {key: word for key, word in named.items() if key not in ("experiment", DIGEST)}


def _telling(rows: Sequence[Row], words: Mapping[int, Mapping], used: set[str]) -> str | None:
    """Choose the key, none of ``used``, that tells the most configurations apart which share their words and
    conditions; None where all are told apart.
    """
    cells = grouped((_cell(row, words), row["configuration"]) for row in rows)
    counts_of: dict[str, int] = {}
    for cell in cells.values():
        distinct = list({frozenset(values.items()): values for values in cell}.values())
        for key in {key for values in distinct for key in values} - used if len(distinct) > 1 else ():
            counts_of[key] = counts_of.get(key, 0) + len({values.get(key) for values in distinct}) - 1
    best = max(counts_of.values(), default=0)
    short = sorted(key for key, count in counts_of.items() if count == best > 0)
    return min(short, key=lambda key: key.count(".") - 1.5 * key.endswith("._target_"), default=None)


def shortest(keys: Iterable[str]) -> dict[str, str]:
    """Shorten each key to the fewest last parts that no other key ends in.

    >>> shortest(["objective.fine.weights.rigid", "model/motion", "stage.a.lr.x", "stage.b.lr.x"]).values()
    dict_values(['rigid', 'motion', 'a.lr.x', 'b.lr.x'])
    """
    parts = {key: tuple(re.split(r"[./]", key)) for key in keys}
    short = {}
    for key, of_key in parts.items():
        others = [other for other in parts.values() if other != of_key]
        lengths = range(1, len(of_key) + 1)
        n = next((n for n in lengths if all(other[-n:] != of_key[-n:] for other in others)), len(of_key))
        short[key] = ".".join(of_key[-n:])
    return short


def repeated(rows: Sequence[Row]) -> list[Row]:
    """Return the rows whose configuration, conditions and seed another row has that was measured later."""
    groups = grouped(((key_of(row, (*SAME, "seed")), _identity(row)), row) for row in rows)
    ordered = (sorted(same, key=lambda row: row["measured_at"]) for same in groups.values())
    return [row for same in ordered for row in same[:-1]]


def grouped(pairs: Iterable[tuple]) -> dict[object, list]:
    """Gather the values of pairs by their keys.

    >>> grouped([("a", 1), ("b", 2), ("a", 3)])
    {'a': [1, 3], 'b': [2]}
    """
    values: dict[object, list] = {}
    for key, value in pairs:
        values.setdefault(key, []).append(value)
    return values
