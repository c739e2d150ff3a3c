"""Doubts about a fitted run: what its steps, cameras and training images say against it, and why."""

from __future__ import annotations

import sys
from statistics import fmean

import torch

from forewarp.data.module import blind_frames
from forewarp.scene.frame import spread
from forewarp.training.module import DynamicSceneModule
from forewarp.training.stages import Run

FEW = 10  # steps of a stage, or fewer, that can hardly have changed anything
SHORT = 1000  # steps of a run, or fewer, that may be all that is wrong with it
LOW, ABOVE = 21.0, 5.0  # dB; a fit is in doubt below LOW, or less than ABOVE better than one colour
_VIEWS, _PIXELS = 8, 2000  # training images that are looked at, and pixels of each


def doubts(run: Run, module: DynamicSceneModule) -> list[str]:
    """Return lines that say what is wrong with a fitted run, and its likeliest causes; none if all is well.

    A stage that minutes ended after few steps, cameras that see nothing of the box, and training images that
    were not trained on or that the fit does not show are doubted. A stage whose steps were asked for is not.

    Cost: some thousand pixels of eight training images are rendered.
    """
    lines, made, scene = [], run.finished(), run.datamodule.scene
    for stage in run.stages:
        name = stage.settings.name
        most = stage.settings.over(len(scene.train)).iterations
        steps, seconds = made[name]["steps"], made[name]["seconds"]
        if steps < min(FEW, most or FEW):
            lines.append(
                f"stage.{name} ended after {steps} steps in {seconds:.1f} s; raise budget.minutes, give it "
                f"more of them (stage.{name}.share), or leave it out (~stage.{name})"
            )
    in_play = max(noted.get("frames_in_play", len(scene.train)) for noted in made.values())
    if in_play < len(scene.train) and run.stages[-1].settings.curriculum.get("most") is None:
        lines.append(
            f"{len(scene.train) - in_play} of {len(scene.train)} training images were never trained on, as "
            "the budget ended before their times came in; raise it"
        )
    if blind := blind_frames(scene):
        lines.append(f"{blind} of {len(scene.train)} training cameras see nothing of the box {scene.box}")
    reached, one_color = training_psnr(run, module)
    if reached < max(LOW, one_color + ABOVE):
        lines.append(
            f"training images are reached to {reached:.1f} dB; one color alone has {one_color:.1f} dB"
        )
        steps = sum(noted["steps"] for noted in made.values())
        causes = [f"too little training, {steps} steps: raise the budget"] if steps < SHORT else []
        causes = [*causes, *run.datamodule.suspects][:3]
        lines += [f"  likely cause {number}: {cause}" for number, cause in enumerate(causes, 1)]
    return lines


def tell(lines: list[str]) -> None:
    """Print doubts to stderr, so that they are seen behind the tables."""
    for line in lines:
        print(line if line.startswith(" ") else f"warning: {line}", file=sys.stderr)


def training_psnr(run: Run, module: DynamicSceneModule) -> tuple[float, float]:
    """Return the mean PSNR, dB, of a fit on pixels of training images, and that of their mean colors."""
    targets, chooser = run.datamodule.targets("train"), torch.Generator().manual_seed(0)
    reached, one_color = [], []
    for number in spread(len(targets), _VIEWS):
        target = targets[number]
        colors = target.rgb.reshape(-1, 3) if target.valid is None else target.rgb[target.valid]
        pixels = torch.randint(target.rgb[..., 0].numel(), (_PIXELS,), generator=chooser)
        with torch.no_grad():
            reached.append(float(module.psnr_of(target, pixels)))
        error = float(colors.var(0, correction=0).mean())
        one_color.append(float(-10 * torch.tensor(max(error, 1e-10)).log10()))
    return fmean(reached), fmean(one_color)
