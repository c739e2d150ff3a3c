"""``forewarp-plan``: what a scene calls for, and why."""

from __future__ import annotations

from forewarp.cli.entry import command

HELP = """
forewarp-plan looks at a scene and says which effects it calls for, each with the number that decides. It
reads the pictures, fits short coarse stages, looks at what these leave, and tries from there what is still
open, scored on training views that it sets aside; test views are never looked at.

  forewarp-plan scene=specimen_glossy                           a made scene that calls for one thing
  forewarp-plan experiment=dnerf data.root=../data/dnerf data.scene=hook
  forewarp-train plan=runs/hook/plan-0123456789/plan.yaml       the run that it says
  forewarp-train experiment=dnerf data.root=../data/dnerf data.scene=hook effects=auto     both in one go

All words of forewarp-train go here too; what is typed is fixed and not asked. What one types most:
  plan.minutes=N         the best for a run of N minutes; left out: the cheapest within noise of the best
  plan.trials=false      evidence alone, no trials: less sure, in a third of the time
  plan.seeds=N           of every trial from the coarse stage
  plan.steps=N plan.seconds=N              of a coarse stage, what comes first
  plan.trial_steps=N plan.trial_seconds=N  of a trial, what comes first
  plan.folder=FOLDER     where plan.yaml and the trials go; a plan cut short goes on there
Overrule it by one key: forewarp-train plan=FILE model/inpainter=unet3d
"""


def plan(config) -> None:
    """Plan and say so."""
    from forewarp.cli.absent import refuse_absent
    from forewarp.cli.train import refuse_seeds, refuse_two_models
    from forewarp.planning.plan_file import tell
    from forewarp.runs.overrides import typed_words

    if isinstance(config.plan, str):
        raise ValueError(
            f"plan: expected keys as plan.minutes=10, but got {config.plan}; forewarp-train takes a file"
        )
    refuse_seeds(config)
    refuse_two_models(config)
    refuse_absent(config)
    from forewarp.planning.plan import make_plan  # loads torch; what is mistyped has been answered before

    tell(make_plan(config, typed_words()))


def main() -> None:
    """The console script."""
    command("plan", plan, HELP, config="train")


if __name__ == "__main__":
    main()
