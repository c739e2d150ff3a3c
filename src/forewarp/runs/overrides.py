"""Words of a command line: what was typed, and which win."""

from __future__ import annotations

import shlex
from collections.abc import Sequence

from hydra.core.hydra_config import HydraConfig

OF_A_SWEEP = ("sweeps=", "seeds=", "launcher=")  # words that say how jobs are run, not what one is


def typed_words(*, all_of_them: bool = False) -> list[str]:
    """The words of this run's command line, without those of a sweep unless it is ``all_of_them``."""
    words = list(HydraConfig.get().overrides.task)
    return words if all_of_them else [word for word in words if not word.startswith(OF_A_SWEEP)]


def as_typed(name: str, words: Sequence[str]) -> str:
    """A command line as a shell takes it.

    >>> as_typed("train", ["data.scene=hook", "stage.fine.num_voxels=[[0,4000]]"])
    "forewarp-train data.scene=hook 'stage.fine.num_voxels=[[0,4000]]'"
    """
    return shlex.join([f"forewarp-{name}", *words])


def key_of(word: str) -> str:
    """What a word sets.

    >>> key_of("+trainer.precision=bf16-mixed"), key_of("~stage.fine")
    ('trainer.precision', 'stage.fine')
    """
    return word.split("=")[0].lstrip("+~")


def merged(words: Sequence[str], later: Sequence[str]) -> list[str]:
    """Words and later ones, which win where both set the same key.

    >>> merged(["model/view_dependence=sh", "preset.bases=12"], ["model/view_dependence=none"])
    ['preset.bases=12', 'model/view_dependence=none']
    """
    known = {key_of(word) for word in later}
    return [word for word in words if key_of(word) not in known] + list(later)


def of_what_is_on(words: Sequence[str]) -> list[str]:
    """Words without those that say more of an effect that they switch off: ``model.view_dependence.width`` beside
    ``model/view_dependence=none``.

    >>> of_what_is_on(["model/motion=none", "model.trajectory.features=12", "model.view_dependence.width=32"])
    ['model/motion=none', 'model.view_dependence.width=32']
    """
    groups = [word.partition("=") for word in words if word.startswith("model/")]
    off = [group.removeprefix("model/") for group, _, choice in groups if choice == "none"]
    off = [f"model.{effect}" for effect in [*off, *(["trajectory"] if "motion" in off else [])]]
    return [word for word in words if ".".join(key_of(word).split(".")[:2]) not in off]
