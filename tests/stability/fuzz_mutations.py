"""Ways to harm a file."""

from __future__ import annotations

import json
import zipfile
from collections.abc import Callable, Iterator
from pathlib import Path
from random import Random

import yaml

_ODD = [
    *(
        None,
        True,
        0,
        -1,
        1,
        2,
        3.7,
        1e-300,
        1e300,
        -1e300,
        10**400,
        float("nan"),
        float("inf"),
        "",
        "x",
        "0.5",
    ),
    *(
        "../x",
        "/etc/passwd",
        "a\nb.png",
        "\ud800",
        "x" * 9999,
        "${oc.env:HOME}",
        "${a.b}",
        "os.system",
        [],
        [1],
    ),
    *([[1.0] * 4] * 4, {}, {"a": 1}, {"_target_": "os.system", "command": "false"}, {"_args_": [1]}),
]
_WORDS = [
    b"",
    b"nan",
    b"inf",
    b"-1",
    b"0",
    b"1e300",
    b"1e400",
    b"x",
    b"1 2",
    b"\n",
    b"\x00",
    b"*a",
    b"&a",
    b"!!",
]


def mutate(path: Path, draw: Random, stored: dict[Path, bytes]) -> str:
    """Change a file in one way of those that suit it; says which."""
    ways: list[Callable] = [_truncate, _flip, _repeat, _insert, _other_file, _gone]
    ways += {".json": [_in_tree] * 12 + [_word] * 4, ".yaml": [_in_tree] * 12 + [_word] * 8}.get(
        path.suffix, []
    )
    ways += {".inf": [_word] * 12, ".ckpt": [_in_archive] * 12, ".npz": [_in_archive] * 4}.get(
        path.suffix, []
    )
    way = draw.choice(ways)
    try:
        way(path, draw, stored)
    except (ValueError, TypeError, OSError, KeyError, IndexError, yaml.YAMLError, zipfile.BadZipFile):
        path.write_bytes(b"")  # changed before, so that there is nothing left to change in this way
    return f"{path.name}: {way.__name__[1:]}"


def _truncate(path: Path, draw: Random, stored: dict) -> None:
    content = path.read_bytes()
    path.write_bytes(content[: draw.randrange(len(content) + 1)])


def _flip(path: Path, draw: Random, stored: dict) -> None:
    content = bytearray(path.read_bytes())
    for _ in range(draw.choice((1, 1, 3, 20))):
        content[draw.randrange(len(content))] ^= draw.randrange(1, 256)
    path.write_bytes(content)


def _repeat(path: Path, draw: Random, stored: dict) -> None:
    content = path.read_bytes()
    begin, end = sorted(draw.randrange(len(content) + 1) for _ in range(2))
    path.write_bytes(content[:end] + content[begin:end] * draw.choice((0, 1, 3)) + content[end:])


def _insert(path: Path, draw: Random, stored: dict) -> None:
    content = path.read_bytes()
    at = draw.randrange(len(content) + 1)
    path.write_bytes(content[:at] + draw.randbytes(draw.choice((1, 4, 300))) + content[at:])


def _other_file(path: Path, draw: Random, stored: dict) -> None:
    path.write_bytes(draw.choice(list(stored.values())))


def _gone(path: Path, draw: Random, stored: dict) -> None:
    path.unlink()
    if draw.random() < 0.5:
        path.mkdir()


def _word(path: Path, draw: Random, stored: dict) -> None:
    blank = draw.choice((b" ", b"\n", b":", b","))
    words = path.read_bytes().split(blank)
    at = draw.randrange(len(words))
    words[at : at + 1] = draw.choice(([], [draw.choice(_WORDS)], [words[at]] * 2, [draw.choice(words)]))
    path.write_bytes(blank.join(words))


def _in_tree(path: Path, draw: Random, stored: dict) -> None:
    """Another value in a JSON or YAML file, one less, one twice, or one in another's place."""
    tree = json.loads(path.read_text()) if path.suffix == ".json" else yaml.safe_load(path.read_text())
    places = list(_slots(tree))
    (at, key), (there, other) = draw.choice(places), draw.choice(places)
    kind = draw.choice(("value", "value", "value", "less", "twice", "copy"))
    if kind == "less":
        at.pop(key)
    elif kind == "twice" and isinstance(at, list):
        at.insert(key, at[key])
    else:  # a copy: no value may hold itself
        at[key] = json.loads(json.dumps(there[other] if kind == "copy" else draw.choice(_ODD)))
    text = json.dumps(tree) if path.suffix == ".json" else yaml.safe_dump(tree)
    path.write_bytes(text.encode(errors="surrogatepass"))


def _slots(tree: dict | list) -> Iterator[tuple]:
    """Every place of a tree that holds a value, as (container, key)."""
    for key, value in tree.items() if isinstance(tree, dict) else enumerate(tree):
        yield tree, key
        if isinstance(value, dict | list):
            yield from _slots(value)


def _in_archive(path: Path, draw: Random, stored: dict) -> None:
    """Other bytes in one part of an archive, whose checksum then fits them."""
    with zipfile.ZipFile(path) as archive:
        parts = {name: bytearray(archive.read(name)) for name in archive.namelist()}
    likely = [name for name in parts if name.endswith("data.pkl")] * 10
    part = parts[draw.choice([*likely, *parts])]
    for _ in range(draw.choice((1, 1, 2, 5))):
        at = draw.randrange(len(part))
        part[at : at + 1] = draw.choice((b"", bytes([draw.randrange(256)]), bytes([part[at]]) * 2))
    with zipfile.ZipFile(path, "w") as archive:
        for name, content in parts.items():
            archive.writestr(name, bytes(content))
