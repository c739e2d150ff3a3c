"""
forewarp-plan finds out which effects a scene calls for, and says for each the number that decides. It reads
the pictures and fits short runs. Of particles it leaves out one effect after the other, and keeps those that
are missed; of voxels (model=forward) it measures what coarse stages leave unexplained, and tries the effects
that are still open. It scores on training views that it sets aside, never on test views.

  forewarp-plan scene=specimen_glossy                           a synthetic scene that calls for one effect
  forewarp-plan experiment=dnerf data.root=../data/dnerf data.scene=hook
  forewarp-train plan=runs/hook/plan-0123456789/plan.yaml       fit what it says
  forewarp-train experiment=dnerf data.root=../data/dnerf data.scene=hook effects=auto     both at once

All overrides of forewarp-train work here too; what is typed is fixed, and not decided by the plan. What one
types most:
  plan.minutes=N         plan for a run of N minutes: an effect must be worth the steps it costs
  plan.least=DB          gain below which an effect does not count; particles 0.6 dB, voxels 0.1
  plan.trials=false      only coarse stages, no trials: less sure, in a third of the time
  plan.seeds=N           seeds of every trial
  plan.steps=N plan.seconds=N              bounds of a coarse stage; the first that is reached ends it
  plan.trial_steps=N plan.trial_seconds=N  bounds of a trial; a few have two or three times as much
  plan.folder=FOLDER     where plan.yaml and the trials go; an interrupted plan goes on there
Overrule a plan by an override: forewarp-train plan=FILE model/view_dependence=none
"""

from __future__ import annotations

from forewarp.cli.entry import command


def plan(config) -> None:
    """Make a plan and print it."""
    from forewarp.cli.prepare import refuse_all, refuse_missing_scene
    from forewarp.planning.plan_file import show_plan
    from forewarp.runs.overrides import typed_overrides

    if isinstance(config.plan, str):
        raise ValueError(
            f"plan: expected keys as plan.minutes=10, but got {config.plan}; forewarp-train takes a file"
        )
    refuse_all(config)
    refuse_missing_scene(config)
    from forewarp.planning.plan import make_plan  # loads torch; mistakes have been answered before

    show_plan(make_plan(config, typed_overrides()))


def planned():
    """Make or read a plan of what was typed; return the config of the run that the plan says."""
    from hydra import compose

    from forewarp.planning.plan import make_plan
    from forewarp.planning.plan_file import own_folder, show_plan
    from forewarp.runs.overrides import merged, typed_overrides, without_switched_off

    typed = typed_overrides(of_sweep=True)
    made = make_plan(compose("train", typed), typed_overrides())
    show_plan(made, to_fit=False)
    config = compose("train", without_switched_off(merged([*made["overrides"], *own_folder(typed)], typed)))
    config.planned = made["file"]
    return config


def main() -> None:
    """Run the console script."""
    command("plan", plan, __doc__, config="train")


if __name__ == "__main__":
    main()
