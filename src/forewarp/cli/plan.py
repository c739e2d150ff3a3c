"""
forewarp-plan says which effects a scene calls for, each with the number that decides. It reads the training
images; where silhouettes stand still it also fits the scene without effects for a fixed number of steps, and
looks at what is left over. The choices depend on no budget or clock; the fit's cost is printed, and comes on
top of the budget. What nothing speaks against stays as the preset has it. It never looks at test views.

  forewarp-plan scene=specimen_glossy                           a synthetic scene that stands still
  forewarp-plan experiment=dnerf data.root=../data/dnerf data.scene=hook
  forewarp-train plan=runs/hook/plan-0123456789/plan.yaml       fit what it says
  forewarp-train experiment=dnerf data.root=../data/dnerf data.scene=hook effects=auto     both at once

All overrides of forewarp-train work here too; what is typed is fixed, and not decided by the plan.
  plan.folder=FOLDER     where plan.yaml and the still fit go
Overrule a plan by an override: forewarp-train plan=FILE model/view_dependence=none
"""

from __future__ import annotations

from forewarp.cli.entry import command


def plan(config) -> None:
    """Make a plan and print it."""
    from forewarp.cli.prepare import refuse_all, refuse_missing_scene
    from forewarp.planning.plan_file import show_plan
    from forewarp.runs.overrides import typed_overrides

    if isinstance(file := config.plan, str):
        raise ValueError(f"plan: expected plan.folder=FOLDER, but got {file}; forewarp-train takes a file")
    refuse_all(config)
    refuse_missing_scene(config)
    from forewarp.planning.plan import make_plan  # loads torch; mistakes have been answered before

    show_plan(make_plan(config, typed_overrides()))


def main() -> None:
    """Run the console script."""
    command("plan", plan, __doc__, config="train")


if __name__ == "__main__":
    main()
