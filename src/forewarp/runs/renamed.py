"""Words and runs of earlier versions: each is refused, with what there is in its place."""

from __future__ import annotations

import re
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from omegaconf import DictConfig

_OF_A_METHOD = "rays|background|bases|nodes|padding|alpha_threshold|skip_alpha|inpainter_width"
SINCE_3 = "renamed in 0.3"
# What a whole word was, what it is now (None: nothing in its place), why.
RENAMED = (
    (
        r"budget=(.*)",
        r"preset=\1",
        "the choice is called preset since 0.2; what may be spent is budget.minutes",
    ),
    (r"budget\.name=(.*)", r"preset=\1", "the choice is called preset since 0.2"),
    (
        rf"budget\.({_OF_A_METHOD})(=.*)?",
        r"preset.\1\2",
        "the method's numbers are called preset since 0.2",
    ),
    (r"experiment=hypernerf_faithful", "experiment=hypernerf preset=faithful", "one experiment since 0.2"),
    (r"renderer([.=].*)?", r"model.renderer\1", "it is a part of the model since 0.2"),
    (r"model\.warp=(.*)", r"model=\1", "the method's name is model.name since 0.2"),
    (r"stage=(demo|fast|faithful)", r"stage=forward_\1", "each method has its own since 0.2"),
    (r"objective=(fast|faithful)", r"objective=forward_\1", "each method has its own since 0.2"),
    (r"suits([.=].*)?", None, "every experiment takes every preset since 0.2"),
    (r"(stage\.[\w-]+|modules\.alone)\.rates(\..*)?(=.*)?", r"\1.lr\2\3", SINCE_3),
    (r"(stage\.[\w-]+)\.final_rate(=.*)?", r"\1.lr_final_factor\2", SINCE_3),
    (r"(stage\.[\w-]+|modules\.alone)\.hold(=.*)?", r"\1.lr_hold\2", SINCE_3),
    (r"(stage\.[\w-]+|modules)\.voxels(=.*)?", r"\1.num_voxels\2", SINCE_3),
    (r"(stage\.[\w-]+)\.background_voxels(=.*)?", r"\1.background_num_voxels\2", SINCE_3),
    (r"(preset|model\.radiance|model\.background)\.skip_alpha(=.*)?", r"\1.alpha_threshold\2", SINCE_3),
    (r"model\.renderer\.opaque(=.*)?", r"model.renderer.early_stop_eps\1", SINCE_3),
    (r"model/view(=.*)", r"model/view_dependence\1", SINCE_3),
    (r"model\.view([.=].*)?", r"model.view_dependence\1", SINCE_3),
    (r"variant=base", "ablation=base", SINCE_3),
    (
        r"variant=.*",
        None,
        "type what a variant changed, as preset.rays=1024; sweeps/price_list.yaml lists all that there were",
    ),
    (
        r"ablation=.*voxels_\d+.*",
        None,
        "sweeps=resolution has these sizes since 0.3; one of them is stage.fine.num_voxels=[[0,512000]]",
    ),
)


def refuse_renamed(words: list[str]) -> None:
    """Raise ValueError for a word of an earlier version.

    Args:
        words: of the command line, without the command.

    >>> refuse_renamed(["preset=fast", "budget.minutes=3"])
    >>> refuse_renamed(["budget.bases=12"])
    Traceback (most recent call last):
    ValueError: budget.bases=12: expected preset.bases=12; the method's numbers are called preset since 0.2
    """
    for word in words:
        for old, new, why in RENAMED:
            sign, plain = re.fullmatch(r"([+~]*)(.*)", word, re.DOTALL).groups()
            if found := re.fullmatch(old, plain, re.DOTALL):
                now = "no such word" if new is None else sign + found.expand(new)
                raise ValueError(f"{word}: expected {now}; {why}")


def refuse_old(config: DictConfig, path: Path) -> None:
    """Raise ValueError for the config of a run that an earlier version made: its folder differs."""
    stages = [stage for stage in (config.get("stage") or {}).values() if stage is not None]
    old = "0.1" if "warp" in (config.get("model") or {}) else None
    old = old or ("0.2" if any("rates" in stage for stage in stages) else None)
    if old is not None:
        raise ValueError(
            f"{path}: expected a run of forewarp 0.3, but got one of {old}, which version {old}.0 reads; "
            f"run its command again into another folder, or install forewarp {old}.0"
        )
