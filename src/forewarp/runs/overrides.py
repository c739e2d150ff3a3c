"""The overrides of a command line: list and merge them, and refuse names of earlier versions."""

from __future__ import annotations

import re
import shlex
from collections.abc import Sequence

OF_A_SWEEP = ("sweeps=", "seeds=", "launcher=")  # these say how jobs are run, not what a job computes

_OF_PRESET = "rays|background|bases|nodes|padding|alpha_threshold|skip_alpha|inpainter_width"
SINCE_3 = "renamed in 0.3"
_VARIANTS = (  # that forewarp had
    r"background_grid|backward|bases_(5|15|20)|carry_off|coarse_[268]0|color_all|confine|frames_all|grid_(64|96|160)|"
    r"loss_(no_entropy|no_point_color|no_tv_flow|tv_density|tv_depth)|motion_(features|none)|nodes_0|padding_0|"
    r"preset_(demo|faithful)|radiance_mlp|rays_(1024|2048|8192|whole)|recompute_off|see_off|skip_off|start_box|"
    r"tv_depth_every_4|unet_(16|16_half|32|64)|upsampler_(learned|trilinear)|view_(mlp|none)|voxels_all"
)
# Pattern of a whole override, its replacement (None: there is none), and the reason. Oldest version first,
# as a later one may rename again what an earlier one renamed.
RENAMED = (
    (
        r"budget=(.*)",
        r"preset=\1",
        "the choice is called preset since 0.2; what may be spent is budget.minutes",
    ),
    (r"budget\.name=(.*)", r"preset=\1", "the choice is called preset since 0.2"),
    (rf"budget\.({_OF_PRESET})(=.*)?", r"preset.\1\2", "the method's numbers are called preset since 0.2"),
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
    (r"(objective(?:\.\w+)?\.weights)\.still_points(=.*)?", r"\1.static_points\2", SINCE_3),
    (r"(stage\.[\w-]+)\.passes(=.*)?", r"\1.steps_per_picture\2", SINCE_3),
    (r"model/view(=.*)?", r"model/view_dependence\1", SINCE_3),
    (r"model\.view([.=].*)?", r"model.view_dependence\1", SINCE_3),
    (
        rf"variant=(.*,)?({_VARIANTS})(,.*)?",
        None,
        "type model=forward and the change, as preset.rays=1024; sweeps/price_list_forward.yaml has all",
    ),
    (r"variant=base", "ablation=base", SINCE_3),
    (
        r"variant=([^{]*)",
        r"ablation=\1",
        "move your file from variant/ to ablation/, as the group is called since 0.3",
    ),
    (
        r"ablation=(.*,)?voxels_(20|40|60|80)(,.*)?",
        None,
        "sweeps=resolution has these sizes since 0.3; one of them is stage.fine.num_voxels=[[0,512000]]",
    ),
)


def typed_overrides(*, of_sweep: bool = False) -> list[str]:
    """List the overrides of this job's command line; ``of_sweep`` keeps those that only say how jobs run."""
    from hydra.core.hydra_config import HydraConfig

    typed = list(HydraConfig.get().overrides.task)
    return typed if of_sweep else [override for override in typed if not override.startswith(OF_A_SWEEP)]


def command_line(name: str, overrides: Sequence[str]) -> str:
    """Quote a command so that it can be pasted into a shell.

    >>> command_line("train", ["data.scene=hook", "stage.fine.num_voxels=[[0,4000]]"])
    "forewarp-train data.scene=hook 'stage.fine.num_voxels=[[0,4000]]'"
    """
    return shlex.join([f"forewarp-{name}", *overrides])


def text_override(key: str, text: str) -> str:
    """Write an override whose value Hydra keeps as text, in quotes only where it needs them.

    >>> text_override("data.scene", "hand"), text_override("data.scene", "2024_11")
    ('data.scene=hand', "data.scene='2024_11'")
    """
    from hydra.core.override_parser.overrides_parser import OverridesParser
    from hydra.errors import HydraException

    try:
        read = OverridesParser.create().parse_override(f"{key}={text}")
        if not read.is_sweep_override() and read.value() == text:
            return f"{key}={text}"
    except HydraException:  # its grammar has no such bare value
        pass
    # In Hydra's quotes a backslash is one unless a quote follows.
    inner = re.sub(r"(\\+)(?='|$)", r"\1\1", text).replace("'", r"\'")
    return f"{key}='{inner}'"


def key_of(override: str) -> str:
    """Return the key that an override sets.

    >>> key_of("+trainer.precision=bf16-mixed"), key_of("~stage.fine")
    ('trainer.precision', 'stage.fine')
    """
    return override.split("=")[0].lstrip("+~")


def merged(overrides: Sequence[str], later: Sequence[str]) -> list[str]:
    """Join two lists of overrides; a later one replaces an earlier one of the same key.

    >>> merged(["model/view_dependence=sh", "preset.bases=12"], ["model/view_dependence=none"])
    ['preset.bases=12', 'model/view_dependence=none']
    """
    known = {key_of(override) for override in later}
    return [override for override in overrides if key_of(override) not in known] + list(later)


def without_switched_off(overrides: Sequence[str]) -> list[str]:
    """Drop settings of effects that the same overrides switch off, which Hydra would refuse.

    >>> without_switched_off(["model/motion=none", "model.trajectory.features=12", "model.renderer.step=1"])
    ['model/motion=none', 'model.renderer.step=1']
    """
    groups = [override.partition("=") for override in overrides if override.startswith("model/")]
    off = [group.removeprefix("model/") for group, _, choice in groups if choice == "none"]
    off = [f"model.{effect}" for effect in [*off, *(["trajectory"] if "motion" in off else [])]]
    return [override for override in overrides if ".".join(key_of(override).split(".")[:2]) not in off]


def refuse_renamed(overrides: Sequence[str]) -> None:
    """Refuse overrides of earlier versions and name their replacement.

    Raises:
        ValueError: naming the override, its replacement and the version that renamed it.

    >>> refuse_renamed(["preset=fast", "budget.minutes=3"])
    >>> refuse_renamed(["budget.bases=12"])
    Traceback (most recent call last):
    ValueError: budget.bases=12: expected preset.bases=12; the method's numbers are called preset since 0.2
    """
    for override in overrides:
        before, now = re.fullmatch(r"([+~]*(?:hydra\.sweeper\.params\.)?)(.*)", override, re.DOTALL).groups()
        reason = None
        for old, new, why in RENAMED:
            if found := re.fullmatch(old, now, re.DOTALL):
                if new is None:
                    raise ValueError(f"{override}: expected no such override; {why}")
                now, reason = found.expand(new), reason or why
        if reason:
            raise ValueError(f"{override}: expected {before}{now}; {reason}")
