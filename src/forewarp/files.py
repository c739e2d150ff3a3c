"""Write files whole or not at all; read them only up to a size."""

from __future__ import annotations

import csv
import errno
import glob
import io
import json
import os
import re
import secrets
import shutil
import stat
import time
import zipfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from reprlib import repr as short
from typing import TYPE_CHECKING

import yaml

if TYPE_CHECKING:
    import numpy as np

# The most bytes that are read of a file.
MOST_CONFIG = 1 << 20  # of a config or a plan; ours have a few thousand
MOST_BYTES = 1 << 26  # of a text that is parsed, which takes up to thirty times as much memory
MOST_POINTS = 1 << 28  # of a cloud of points as text
MOST_IMAGE = 1 << 29
MOST_FILM = MOST_ARCHIVE = 1 << 40
MOST_ARRAYS = 1 << 30  # of NumPy's files, also when unpacked
MOST_COMMAND = 1 << 16  # characters of a command, as splitting it takes time that grows by the square
MOST_LEVELS = 40  # of YAML, one within the other

_POINTER, _MOST_POINTER = b"version https://git-lfs", 1024  # what Git LFS leaves where it has not fetched

_FULL = errno.ENOSPC, errno.EDQUOT, errno.EFBIG  # what a full disk says
_LEFT = 24 * 3600  # seconds after which nobody fills a folder any more
_PLAIN_TAGS = {f"tag:yaml.org,2002:{kind}" for kind in ("str", "int", "float", "bool", "null", "map", "seq")}
_PLAIN_TAGS |= {None, "!"}
_DIGITS = (
    308  # of a number: larger ones fit no float, those of sixty parts take time that grows by the square
)
_NUMBER = re.compile(r"[-+]?\.?[0-9][\w.:+-]*")  # of any notation of YAML


def disk_error(said: str, path: Path) -> OSError:
    """Return the error of a ``path`` that another program could not write, by what it ``said``."""
    if re.search("no space left|quota exceeded|too large", said, re.IGNORECASE):
        return OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), str(path))
    got = short(" ".join(said.split()[:40])) if said.strip() else "it ended early (is the disk full?)"
    return OSError(errno.EIO, got, str(path))


@contextmanager
def written_whole(path: Path, *, synced: bool = False) -> Iterator[Path]:
    """Write to the path that this gives, which is renamed to ``path`` at the end; make its folder.

    The file has a random name and is made here, so that no link that lies in wait is written through.

    Args:
        path: appears whole or not at all; a file or a link already there is replaced.
        synced: wait until the bytes are on the disk before renaming.

    Raises:
        OSError: naming ``path``, where it cannot be written; nothing is then left behind.
    """
    beside = path.with_name(f".{path.name}.{secrets.token_hex(8)}.part{path.suffix}")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        os.close(os.open(beside, os.O_WRONLY | os.O_CREAT | os.O_EXCL | getattr(os, "O_NOFOLLOW", 0), 0o666))
        yield beside
        if synced:
            with beside.open("rb+") as file:
                os.fsync(file.fileno())
        os.replace(beside, path)
    except OSError as error:
        # A full disk names no file, or a temporary one of a library's.
        if error.errno not in _FULL and error.filename not in (None, str(beside), str(path)):
            raise
        raise OSError(error.errno, error.strerror or str(error), str(path)) from error
    finally:
        with suppress(OSError):
            beside.unlink()


@contextmanager
def held(folder: Path) -> Iterator[Callable[[], None]]:
    """Watch a folder within the block; yields what refuses to go on once it is not there any more.

    What is written later would otherwise make a new folder, which holds a part of what belongs into it.

    Raises:
        ValueError: by what is yielded, if the folder was deleted or moved, or another took its place.
    """
    descriptor = os.open(folder, os.O_RDONLY)  # while it is open, no other folder gets its number

    def check() -> None:
        with suppress(FileNotFoundError):
            if os.path.samestat(os.fstat(descriptor), folder.stat()):
                return
        expected = f"{folder}: expected the folder that this run works in"
        raise ValueError(f"{expected}, but it was deleted or moved meanwhile; run the same command again")

    try:
        yield check
    finally:
        os.close(descriptor)


@contextmanager
def folder_written_whole(path: Path, mark: str) -> Iterator[Path]:
    """Fill the folder that this gives, which takes the place of ``path`` at the end.

    Args:
        path: appears whole or not at all; stays as it was if anything fails. What a killed call left of it
            is put back first. See ``check_replaceable`` for what it may hold.
        mark: see ``check_replaceable``.

    Raises:
        ValueError: see ``check_replaceable``.
        OSError: where it cannot be written; nothing is then left behind.
    """
    check_replaceable(path, mark)
    path = Path(os.path.abspath(path))
    before = path.with_name(f".{path.name}.before")
    if before.exists() and not path.exists():  # killed between the two renames below
        os.replace(before, path)
        check_replaceable(path, mark)
    # A name of its own, as another call may be filling one for the same folder.
    beside = path.with_name(f".{path.name}.{secrets.token_hex(4)}.part")
    made = [folder for folder in path.parents if not folder.exists()]
    try:
        for old in [before, *filter(_is_left, path.parent.glob(f".{glob.escape(path.name)}.*.part"))]:
            shutil.rmtree(old, ignore_errors=True)
        beside.mkdir(parents=True)
        yield beside
        if path.exists():
            os.replace(path, before)
        try:
            os.replace(beside, path)
        except BaseException:
            with suppress(OSError):
                os.replace(before, path)
            raise
        shutil.rmtree(before, ignore_errors=True)
        made = []
    except OSError as error:
        if error.errno not in _FULL and not str(error.filename).startswith(str(beside)):
            raise
        # Of a file that is gone by now: name the one that it would have been.
        name = str(error.filename or path).replace(str(beside), str(path))
        raise OSError(error.errno, error.strerror, name) from error
    finally:
        shutil.rmtree(beside, ignore_errors=True)
        for folder in made:
            with suppress(OSError):  # not empty: someone else's by now
                folder.rmdir()


def _is_left(part: Path) -> bool:
    """Whether a half-filled folder is so old that the call that filled it was killed."""
    with suppress(OSError):
        return time.time() - part.stat().st_mtime > _LEFT
    return False


def refuse_links(folder: Path) -> None:
    """Refuse a folder in which a link, a pipe or a device lies, at any depth; it may be a link itself.

    What is read from and written into a folder that came from someone else then stays in it.

    Raises:
        ValueError: naming the file.
    """
    for parent, folders, files in os.walk(folder):
        for name in sorted((*folders, *files)):
            path = os.path.join(parent, name)
            with suppress(FileNotFoundError):  # another process may be writing
                mode = os.lstat(path).st_mode
                if stat.S_ISLNK(mode):
                    expected = (
                        "no links inside a run's folder, as files would be read and written where they lead"
                    )
                    got = f"one to {os.readlink(path)}; put the file itself there, or delete the link"
                    raise ValueError(f"{path}: expected {expected}, but got {got}")
                if not (stat.S_ISREG(mode) or stat.S_ISDIR(mode)):
                    raise ValueError(f"{path}: expected a file, but got a device or a pipe; delete it")


def check_replaceable(path: Path, mark: str) -> None:
    """Refuse a path at which lies what is not ours: a file, a link, or a folder with files of others.

    Args:
        path: of the folder.
        mark: name of a JSON file in every folder of ours; its ``bytes`` has the other files as keys.

    Raises:
        ValueError: naming ``path`` and a file that is not ours.
    """
    if not os.path.lexists(path):
        return
    expected = f"{path}: expected no folder, an empty one, or one written before (with {mark})"
    if path.is_symlink() or not path.is_dir():
        raise ValueError(f"{expected}, but got a file or a link; choose another")
    content = read_json(path / mark) or {}
    ours = {mark, *content["bytes"]} if isinstance(content.get("bytes"), dict) else set()
    found = sorted(file.relative_to(path).as_posix() for file in path.rglob("*") if not file.is_dir())
    others = [name for name in found if name not in ours]
    if others:
        raise ValueError(f"{expected}, but got {others[0]} in it; move it, or choose another")


def link_of(path: Path) -> str:
    """Return the link that opens a file in a browser: ``file:///...``."""
    return Path(path).resolve().as_uri()


def replace_file(path: Path, content: bytes | str) -> None:
    """Write ``content`` as a whole file.

    Raises:
        OSError: naming ``path``, where it cannot be written.
    """
    with written_whole(path) as beside:
        beside.write_bytes(content.encode() if isinstance(content, str) else content)


def write_json(path: Path, content: dict) -> None:
    """Write an object as a whole JSON file.

    Raises:
        OSError: naming ``path``, where it cannot be written.
        ValueError: for numbers that are not finite, which JSON does not have.
    """
    replace_file(path, json.dumps(content, indent=2, allow_nan=False) + "\n")


def read_json(path: Path) -> dict | None:
    """Read the object of a JSON file; None if the file is missing or refused by ``load_json``."""
    try:
        return load_json(path)
    except (FileNotFoundError, NotADirectoryError, ValueError):
        return None


def _whole(digits: str) -> int:
    """Read a whole number of JSON."""
    if len(digits) > _DIGITS:
        raise ValueError(
            f"a number of {len(digits)} digits, {digits[:10]}...; write one of at most {_DIGITS}"
        )
    return int(digits)


def load_json(path: Path, top: type = dict) -> dict | list:
    """Read the object of a JSON file, or the list where ``top`` is list.

    Raises:
        OSError: where it cannot be read.
        ValueError: in one line, if the file is too large, does not parse or holds another thing.
    """
    text = decoded(read_bytes(path), path)
    try:
        content = json.loads(text, parse_int=_whole)
    except json.JSONDecodeError as error:
        raise ValueError(f"{path}: line {error.lineno}: expected JSON, but got {error.msg}") from error
    except (ValueError, RecursionError) as error:  # absurd numbers or nesting
        raise ValueError(f"{path}: expected JSON, but got {str(error)[:80]}") from error
    if not isinstance(content, top):
        kind = "object" if top is dict else top.__name__
        raise ValueError(f"{path}: expected a JSON {kind} at the top, but got {type(content).__name__}")
    return content


def check_command(command: object, where: object) -> None:
    """Refuse a command, of a run's config, that is no text or longer than ``MOST_COMMAND``."""
    if command is not None and not (isinstance(command, str) and len(command) <= MOST_COMMAND):
        got = f"{len(command)}" if isinstance(command, str) else short(command)
        raise ValueError(f"{where}: expected a text of at most {MOST_COMMAND} characters, but got {got}")


class _PlainLoader(getattr(yaml, "CSafeLoader", yaml.SafeLoader)):
    """PyYAML's safe loader as OmegaConf has it: dates are texts, 1e-3 is a number, no key stands twice."""

    yaml_implicit_resolvers = {
        first: [(tag, pattern) for tag, pattern in kinds if not tag.endswith(":timestamp")]
        for first, kinds in yaml.SafeLoader.yaml_implicit_resolvers.items()
    }

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict:
        """Make a dict, and refuse a key that stands there twice."""
        names = set()
        for key, _ in node.value:
            if isinstance(key, yaml.ScalarNode) and key.value in names:
                raise yaml.constructor.ConstructorError(
                    None, None, f"the key {key.value!r:.80} twice", key.start_mark
                )
            names.add(key.value if isinstance(key, yaml.ScalarNode) else None)
        return super().construct_mapping(node, deep)


_PlainLoader.add_implicit_resolver(
    "tag:yaml.org,2002:float", re.compile(r"[-+]?[0-9]+(?:_[0-9]+)*[eE][-+]?[0-9]+$"), list("-+0123456789")
)


def load_yaml(path: Path, *, texts: bool = False) -> object:
    """Read plain data from a YAML file of at most ``MOST_CONFIG`` bytes; as ``parse_yaml``."""
    return parse_yaml(read_text(path, MOST_CONFIG), path, texts=texts)


def parse_yaml(text: str, where: object, *, texts: bool = False) -> object:
    """Parse plain data.

    Args:
        text: the YAML.
        where: named in errors.
        texts: leave all values as text, as they stand there.

    Raises:
        ValueError: in one line, for what does not parse, and as ``check_yaml``.
    """
    try:
        check_yaml(text, where)
        return yaml.load(text, yaml.BaseLoader if texts else _PlainLoader)
    except (yaml.YAMLError, RecursionError) as error:
        reason = getattr(error, "problem", None) or (str(error).splitlines() or [type(error).__name__])[0]
        line = getattr(getattr(error, "problem_mark", None), "line", None)
        at = "" if line is None else f" in line {line + 1}"
        raise ValueError(f"{where}: expected YAML, but got {reason}{at}") from error


def check_yaml(text: str, where: object) -> None:
    """Refuse YAML that holds more than plain data, before any value is made of it.

    Aliases and deep nesting can exhaust memory or the stack, numbers of many digits time; tags make objects
    of texts.

    Raises:
        ValueError: naming ``where`` and what came.
        yaml.YAMLError: for what does not parse.
    """
    level = 0
    for event in yaml.parse(text, Loader=_PlainLoader):
        if isinstance(event, yaml.AliasEvent):
            raise ValueError(f"{where}: expected no aliases, but got *{event.anchor}; write it out")
        if (tag := getattr(event, "tag", None)) not in _PLAIN_TAGS:
            expected = "YAML of texts, numbers, true, false, null, lists and mappings"
            raise ValueError(f"{where}: expected {expected}, but got the tag {tag[:80]}; write plain values")
        is_plain = isinstance(event, yaml.ScalarEvent) and event.implicit[0]
        if is_plain and len(event.value) > _DIGITS and _NUMBER.fullmatch(event.value):
            got = f"{len(event.value)}: {event.value[:10]}..."
            raise ValueError(f"{where}: expected numbers of at most {_DIGITS} digits, but got {got}")
        level += isinstance(event, yaml.CollectionStartEvent) - isinstance(event, yaml.CollectionEndEvent)
        if level > MOST_LEVELS:
            raise ValueError(f"{where}: expected at most {MOST_LEVELS} levels, but got more")


def decoded(raw: bytes, path: Path) -> str:
    """Decode the text of a file: UTF-8, or UTF-16 or UTF-32 as its first bytes tell.

    Raises:
        ValueError: naming the line of the first byte that is none, as of Latin-1.
    """
    try:
        return raw.decode(json.detect_encoding(raw))
    except UnicodeDecodeError as error:
        line, byte = raw.count(b"\n", 0, error.start) + 1, raw[error.start]
        got = f"the byte 0x{byte:02x}, as of Latin-1; save the file as UTF-8"
        raise ValueError(f"{path}: line {line}: expected text in UTF-8, but got {got}") from error


def read_rows(path: Path) -> list[dict[str, str]]:
    """Read the rows of a CSV file whose first line names the columns; a missing file has none.

    Raises:
        ValueError: in one line, for a file that is no table of text.
    """
    if not path.is_file():
        return []
    try:
        return list(csv.DictReader(io.StringIO(read_text(path), newline="")))
    except (csv.Error, ValueError) as error:  # NUL bytes
        raise ValueError(f"{path}: expected a table, but got {short(str(error))}; delete it") from error


def read_text(path: Path, most: int = MOST_BYTES) -> str:
    """Read a file as UTF-8, as ``read_bytes`` does; bytes that are no text are replaced."""
    return read_bytes(path, most).decode(errors="replace")


def read_bytes(path: Path, most: int = MOST_BYTES) -> bytes:
    """Read a regular file.

    Raises:
        OSError: where it cannot be read.
        ValueError: as ``check_size``; nothing is then read.
    """
    check_size(path, most)
    return path.read_bytes()


def check_size(path: Path, most: int) -> None:
    """Refuse a file that must not be opened.

    Raises:
        OSError: where there is none, or a folder.
        ValueError: for a device, a pipe, a file of more than ``most`` bytes, and a pointer of Git LFS to one.
    """
    about = path.stat()
    if stat.S_ISDIR(about.st_mode):
        raise IsADirectoryError(errno.EISDIR, os.strerror(errno.EISDIR), str(path))
    if not stat.S_ISREG(about.st_mode):
        raise ValueError(f"{path}: expected a file, but got a device or a pipe")
    if about.st_size > most:
        raise ValueError(f"{path}: expected at most {most} bytes, but got {about.st_size}")
    if len(_POINTER) <= about.st_size < _MOST_POINTER:
        with path.open("rb") as stream:
            if stream.read(len(_POINTER)) == _POINTER:
                got = "a pointer of Git LFS to it; fetch it with git lfs pull"
                raise ValueError(f"{path}: expected the file itself, but got {got}")


def own_folder() -> Path:
    """Return the user's own folder for what forewarp keeps between runs, which no one else ships."""
    try:
        cache = Path(os.environ.get("XDG_CACHE_HOME") or "~/.cache").expanduser()
    except RuntimeError:  # a user without a home
        cache = Path(os.devnull)  # in which nothing is read or written
    return cache / "forewarp"


@contextmanager
def memory_within(more: int) -> Iterator[None]:
    """Let this process take at most so many bytes beside what it has, where the system knows such a limit.

    For libraries that take as much as a file says before they look whether it has that much.

    Raises:
        MemoryError: within, where they ask for more.
    """
    try:
        import resource

        used = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
        soft, hard = resource.getrlimit(resource.RLIMIT_AS)
        known = [limit for limit in (used + more, soft, hard) if limit != resource.RLIM_INFINITY]
        resource.setrlimit(resource.RLIMIT_AS, (min(known), hard))
    except (ImportError, OSError, ValueError):  # no Linux
        yield
        return
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_AS, (soft, hard))


def unpack_arrays(data: bytes) -> dict[str, np.ndarray]:
    """Return the arrays of an .npz by name.

    Raises:
        ValueError: for objects, or arrays that unpack to more than ``MOST_ARRAYS``.
        zipfile.BadZipFile: for another file.
    """
    import numpy as np  # late: commands that only print help need none

    with zipfile.ZipFile(io.BytesIO(data)) as archive:
        unpacked = sum(part.file_size for part in archive.infolist())
    if unpacked > MOST_ARRAYS:
        raise ValueError(f"{unpacked} bytes unpacked")
    with np.load(io.BytesIO(data), allow_pickle=False) as loaded:
        return dict(loaded)
