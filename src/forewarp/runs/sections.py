"""Let sections of one YAML file be options of Hydra's config groups, beside files of their own.

In every folder that Hydra searches, ``conf/`` or that of another package,

* ``options.yaml`` holds options of the groups beside it: ``trainer: {cpu: ...}`` is ``trainer=cpu``.
  A plain value is what the group's key becomes: ``rotation: {none: null}`` in ``model/options.yaml`` sets
  ``model.rotation``.
* ``numbers/NAME.yaml`` holds the option ``NAME`` of several groups: its keys ``stage`` and ``objective`` for
  these groups, all others for ``numbers``. Below ``effects``, ``exceptions`` and ``scenes`` it holds options
  with a second name: ``exceptions: {hypernerf: ...}`` is ``NAME/hypernerf`` of the group ``exceptions``. What
  a file lacks it takes from those in its ``defaults``; where there is no ``numbers/MODEL_PRESET.yaml``,
  ``numbers/MODEL.yaml`` holds for every preset.
"""

from __future__ import annotations

from copy import copy
from functools import lru_cache
from importlib import resources
from pathlib import Path
from typing import NamedTuple

from hydra._internal.core_plugins import file_config_source as files
from hydra._internal.core_plugins import importlib_resources_config_source as packages
from hydra._internal.sources_registry import SourcesRegistry
from hydra.core.config_store import ConfigStore
from hydra.core.object_type import ObjectType
from hydra.plugins.config_source import ConfigResult, ConfigSource
from omegaconf import OmegaConf

OF_STAGES = ("stage", "objective")  # sections relative to their group, as Hydra's files are
OF_ALL = ("effects", "exceptions", "scenes")  # sections whose keys are those of the whole config


_stored: dict[str, str] = {}  # what Hydra's store, which lasts as long as this process, has of each sweep


def serve(sweeps: Path) -> None:
    """Have Hydra read folders with their sections, and a folder's files as ``sweeps``, in this process."""
    ours = {"file": FileConfigSource, "pkg": ImportlibResourcesConfigSource}
    SourcesRegistry.instance().types.update(ours)
    store = ConfigStore.instance()  # on Hydra's search path the folder above would be a config group
    for file in sorted(sweeps.glob("*.yaml")):
        if _stored.get(file.stem) != (text := file.read_text("utf-8")):
            store.store(file.stem, parsed(text).content, "sweeps", "_global_", provider="forewarp")
            _stored[file.stem] = text


class _File(NamedTuple):
    content: dict
    package: str | None  # of its header


@lru_cache(maxsize=512)  # parsing takes more than half of a composition
def parsed(text: str) -> _File:
    """Parse a YAML file and the package that its header names."""
    package = ConfigSource._get_header_dict(text)["package"]
    return _File(OmegaConf.to_container(OmegaConf.create(text)), package)


class _Sections:
    """Adds the options that are sections to one of Hydra's sources of configs."""

    def __init__(self, provider: str, path: str) -> None:
        super().__init__(provider, path)
        self._files: dict[str, _File | None] = {}

    def __deepcopy__(self, memo: dict) -> _Sections:
        """Return a source that has read nothing yet: Hydra copies it for each composition."""
        fresh = copy(self)
        fresh._files = {}
        return fresh

    def load_config(self, config_path: str) -> ConfigResult:
        """Return a file, or a section as if it were a file of its own."""
        found = self._section(config_path) or self._read(config_path)
        if found is None:
            return super().load_config(config_path)  # tells that there is none
        header, config = {"package": found.package}, OmegaConf.create(found.content)
        return ConfigResult(self.provider, self.full_path(), config, header)

    def is_config(self, config_path: str) -> bool:
        """Tell whether a path is an option: a section or a file."""
        return self._section(config_path) is not None or super().is_config(config_path)

    def is_group(self, config_path: str) -> bool:
        """Tell whether a path is a group: a folder, a key of ``options.yaml``, ``stage`` or ``objective``."""
        of_numbers = config_path in OF_STAGES and super().is_group("numbers")
        return super().is_group(config_path) or of_numbers or bool(self._options(config_path))

    def list(self, config_path: str, results_filter: ObjectType | None) -> list[str]:
        """List the options, the groups or (None) both in a group."""
        names = super().list(config_path, results_filter) if super().is_group(config_path) else []
        if results_filter is not ObjectType.GROUP:
            names += self._options(config_path)
            if config_path in OF_STAGES and super().is_group("numbers"):
                numbers = super().list("numbers", ObjectType.CONFIG)
                names += [name for name in numbers if self._section(f"{config_path}/{name}")]
        return sorted({*names} - {"options"})

    def _section(self, path: str) -> _File | None:
        """Return the section that is this option; None if there is none, or a file."""
        group, _, option = path.rpartition("/")
        first, *rest = path.split("/")
        if group == "numbers":
            numbers = self._numbers(option)
            plain = {key: numbers[key] for key in numbers if key not in (*OF_STAGES, *OF_ALL)}
            return _File(plain, "_global_") if numbers else None
        if super().is_config(path):
            return None
        if first in OF_STAGES + OF_ALL and rest:
            content = self._inherited(first, *rest)
            return content and _File(content, "_global_" if first in OF_ALL else None)
        options = self._options(group)
        if option not in options:
            return None
        folder, _, key = group.rpartition("/")
        if isinstance(options[option], dict):
            return _File(options[option], self._read(f"{folder}/options".lstrip("/")).package)
        return _File({key: options[option]}, folder.replace("/", ".") or "_global_")

    def _inherited(self, group: str, name: str, *keys: str) -> dict | None:
        """Return a section of ``numbers/<name>.yaml``, with a defaults list of what it is merged over."""
        numbers = self._numbers(name)
        content = numbers.get(group)
        for key in keys:
            content = content.get(key) if isinstance(content, dict) else None
        if content is not None and "defaults" in content:
            return content
        files = [file for file in numbers.get("defaults", ()) if file != "_self_"]
        bases = [file for file in files if self._inherited(group, file, *keys) is not None]
        if content is None and not bases:
            return None
        paths = ["/".join(["", group, base, *keys]) if keys else base for base in bases]
        return {"defaults": [*paths, "_self_"], **(content or {})}

    def _numbers(self, name: str) -> dict:
        """Return ``numbers/<model>_<preset>.yaml``, else ``numbers/<model>.yaml``, else nothing."""
        file = self._read(f"numbers/{name}") or self._read(f"numbers/{name.rpartition('_')[0]}")
        return file.content if file else {}

    def _options(self, group: str) -> dict:
        """Return the options of a group that lie in ``options.yaml`` beside its folder: name -> content."""
        folder, _, key = group.rpartition("/")
        file = self._read(f"{folder}/options".lstrip("/"))
        return (file.content.get(key) or {}) if file else {}

    def _read(self, name: str) -> _File | None:
        """Read a file once; None if there is none."""
        if name not in self._files:
            file = self._folder() / self._normalize_file_name(name) if super().is_config(name) else None
            self._files[name] = file and parsed(file.read_text(encoding="utf-8"))
        return self._files[name]


# Of the same names as Hydra's own, which it would register again otherwise.
class FileConfigSource(_Sections, files.FileConfigSource):
    """Serves a folder with its sections."""

    def _folder(self):
        return Path(self.path)


class ImportlibResourcesConfigSource(_Sections, packages.ImportlibResourcesConfigSource):
    """Serves a package's folder with its sections."""

    def _folder(self):
        return resources.files(self.path)


def option_groups(*folders: Path) -> dict[str, list[str]]:
    """Return every group in folders like ``conf/``, with the names of its options, in their order."""
    groups: dict[str, dict[str, None]] = {}
    for conf in folders:
        source = FileConfigSource("forewarp", str(conf))
        inner = (path for path in conf.rglob("*") if path.is_dir() and path.name != "__pycache__")
        names = {path.relative_to(conf).as_posix() for path in inner} | {*OF_STAGES}
        for file in conf.rglob("options.yaml"):
            folder = file.parent.relative_to(conf)
            names |= {(folder / key).as_posix() for key in parsed(file.read_text(encoding="utf-8")).content}
        for name in names:
            groups.setdefault(name, {}).update(dict.fromkeys(source.list(name, ObjectType.CONFIG)))
    return {name: list(groups[name]) for name in sorted(groups)}
