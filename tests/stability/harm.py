"""Hypothesis strategies that harm files: bits, lengths, words, values in JSON and YAML, arrays, archives."""

import io
import json
import zipfile
from pathlib import Path

import numpy as np
import yaml
from hypothesis import strategies as st

ODD = [
    *(None, True, 0, -1, 1, 2, 3.7, 1e-300, 1e300, -1e300, 10**400, float("nan"), float("inf"), "", "x"),
    *("0.5", "../x", "/etc/passwd", "a\nb.png", "\ud800", "x" * 9999, "${oc.env:HOME}", "${a.b}"),
    *("os.system", [], [1], [[1.0] * 4] * 4, {}, {"a": 1}, {"_args_": [1]}),
    {"_target_": "os.system", "command": "false"},
]
WORDS = [*b" nan inf -1 0 1e300 1e400 x *a &a !!".split(b" "), b"1 2", b"\n", b"\0"]
NAN_SIGNALLING = np.full((6, 8), 0x7F800001, np.uint32).view(np.float32)
ARRAYS = [
    *(np.full((6, 8), np.nan, np.float32), NAN_SIGNALLING, NAN_SIGNALLING[:2, :3], np.full((6, 8), 1e300)),
    *(-np.ones((6, 8)), np.zeros((0, 6)), np.zeros((3, 2), np.complex64), np.full((2, 6), np.inf)),
    *(
        np.full((2, 3), 1e30),
        np.full((2, 6), 1e30),
        np.diag([-1e30] * 6),
        np.array("x"),
        np.array([["a"] * 3]),
    ),
]


def truncated(draw, content):
    return content[: draw(st.integers(0, len(content)))]


def flipped(draw, content):
    changed = bytearray(content)
    for at in draw(st.lists(st.integers(0, len(content) - 1), min_size=1, max_size=20)):
        changed[at] ^= draw(st.integers(1, 255))
    return bytes(changed)


def spliced(draw, content):
    """Leave a part out, repeat one, or put other bytes in."""
    begin, end = (draw(st.integers(0, len(content))) for _ in range(2))
    return content[:begin] + draw(st.binary(max_size=300)) + content[end:]


def reworded(draw, content):
    """One word or line less, twice, or another."""
    blank = draw(st.sampled_from([b" ", b"\n", b":", b","]))
    words = content.split(blank)
    at, other = (draw(st.integers(0, len(words) - 1)) for _ in range(2))
    others = [[], [words[at]] * 2, [words[other]], [draw(st.sampled_from(WORDS))]]
    words[at : at + 1] = draw(st.sampled_from(others))
    return blank.join(words)


def slots(tree):
    """Every place of a tree that holds a value, as (container, key)."""
    for key, value in tree.items() if isinstance(tree, dict) else enumerate(tree):
        yield tree, key
        if isinstance(value, dict | list):
            yield from slots(value)


def replanted(draw, tree):
    """Another value in a tree of JSON, one less, one twice, or one in another's place."""
    places = list(slots(tree))
    (at, key), (there, other) = (places[draw(st.integers(0, len(places) - 1))] for _ in range(2))
    kind = draw(st.sampled_from(["odd", "odd", "less", "twice", "copy"]))
    if kind == "less":
        at.pop(key)
    elif kind == "twice" and isinstance(at, list):
        at.insert(key, at[key])
    else:  # a copy: no value may hold itself
        value = there[other] if kind == "copy" else draw(st.sampled_from(ODD))
        at[key] = json.loads(json.dumps(value))
    return tree


def in_json(draw, content):
    return json.dumps(replanted(draw, json.loads(content))).encode()


def in_yaml(draw, content):
    """As JSON, which is YAML too."""
    return json.dumps(replanted(draw, yaml.load(content, yaml.CSafeLoader))).encode()


def saved(save, *arrays, **named):
    file = io.BytesIO()
    save(file, *arrays, **named)
    return file.getvalue()


def in_npy(draw, content):
    return saved(np.save, draw(st.sampled_from(ARRAYS)))


def in_npz(draw, content):
    """Another array, or one less."""
    arrays = dict(np.load(io.BytesIO(content)))
    name = draw(st.sampled_from(sorted(arrays)))
    arrays[name] = draw(st.sampled_from([None, *ARRAYS]))
    return saved(np.savez, **{key: value for key, value in arrays.items() if value is not None})


def in_archive(draw, content):
    """Other bytes in one part of an archive, whose checksum then fits them."""
    with zipfile.ZipFile(io.BytesIO(content)) as archive:
        parts = {name: archive.read(name) for name in archive.namelist()}
    pickles = [name for name in parts if name.endswith("data.pkl")] * 10  # where most can go wrong
    name = draw(st.sampled_from([*pickles, *parts]))
    for _ in range(draw(st.sampled_from([1, 1, 2, 5]))):
        at = draw(st.integers(0, max(len(parts[name]) - 1, 0)))
        part = parts[name][at : at + 1]
        other = draw(st.sampled_from([b"", part * 2, bytes([draw(st.integers(0, 255))])]))
        parts[name] = parts[name][:at] + other + parts[name][at + 1 :]
    file = io.BytesIO()
    with zipfile.ZipFile(file, "w") as archive:
        for part, value in parts.items():
            archive.writestr(part, value)
    return file.getvalue()


ANY = [truncated, flipped, spliced]
WAYS = {
    ".json": [in_json] * 8 + [reworded] * 2,
    ".yaml": [in_yaml] * 8 + [reworded] * 4,
    ".inf": [reworded] * 8,
    ".npy": [in_npy] * 4,
    ".npz": [in_npz] * 3 + [in_archive] * 3,
    ".ckpt": [in_archive] * 8,
}


class Changes(dict):
    """What files become; None: they are gone."""

    def __repr__(self):
        return f"{[path.name for path in self]}"  # not all their bytes


@st.composite
def harmed(draw, files: dict[Path, bytes]) -> Changes:
    """Draw one or two files and what they become. Every kind of file is as likely."""
    kinds: dict[str, list[Path]] = {}
    for path in files:
        kinds.setdefault(path.suffix, []).append(path)
    changes = Changes()
    for _ in range(draw(st.sampled_from([1, 1, 2]))):
        path = draw(st.sampled_from(kinds[draw(st.sampled_from(sorted(kinds)))]))
        way = draw(st.sampled_from([*ANY, *WAYS.get(path.suffix, []), "other", "gone"]))
        if way == "gone":
            changes[path] = None
        elif way == "other":
            changes[path] = files[draw(st.sampled_from(list(files)))]
        else:
            changes[path] = way(draw, files[path])
    return changes
