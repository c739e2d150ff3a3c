"""A run from its folder alone."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from omegaconf import OmegaConf

from forewarp.runs.identity import saved_config
from forewarp.runs.build import build_run
from forewarp.training.stages import Run


def stored_run(folder: str | Path, trust: str | Sequence[str] | None = None) -> Run:
    """The run in a folder, put together as its config says; nothing is read or computed yet.

    Args:
        folder: of the run.
        trust: packages beside forewarp whose code its config may name, as ``trust_of`` takes them.

    Raises:
        ValueError: where it is no run, or its config names code that is not trusted.
    """
    trust = trust if trust is None or isinstance(trust, str) else list(trust)
    return build_run(saved_config(str(folder), OmegaConf.create({"trust": trust})))
