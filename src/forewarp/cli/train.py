"""``forewarp-train``: fit a scene, stage by stage, and measure it."""

from __future__ import annotations

from forewarp.cli.entry import command

HELP = """
forewarp-train fits a moving scene by forward warping, coarse and fine, and measures it on its test views.
The same command run again skips finished stages and goes on with an interrupted one.

  forewarp-train                                     the procedural vehicle, written at first use
  forewarp-train experiment=demo                     the same in about a minute
  forewarp-train experiment=dnerf data.root=../data/dnerf data.scene=hook budget.minutes=5

What one types most:
  data.root=FOLDER data.scene=NAME    where the scenes are, and which one
  budget=demo|fast|faithful           what the run may cost; fast is the default
  budget.minutes=N                    of training, all stages together
  budget.iterations=N                 the same in steps; with both, what comes first (null switches one off)
  model=forward|backward              the paper's method, or its opponent
  model/view=none|sh|mlp              (and every other effect) switched by a word
  seed=N                              of everything random
  trainer=cpu|gpu|auto                where
  run=FOLDER                          where the run lives (runs/<scene>/<model>-<budget>-seed<seed>)
  evaluate=false                      no test views at the end
  ~stage.fine                         drop a stage
  --multirun seed=0,1,2               one run after another; --multirun sweeps=methods: a prepared sweep

A run's folder holds config.yaml, a folder a stage (checkpoint, handover.json, TensorBoard events, images),
images/ of the test views, per_image.json and metrics.json. Watch: tensorboard --logdir runs
"""


def train(config) -> None:
    """Fit what is not finished, then measure."""
    from forewarp.cli.measure import measure
    from forewarp.cli.runs import build_run, claim

    run = build_run(config)
    run.datamodule.setup("fit")  # before the folder is made: a mistyped scene leaves nothing behind
    claim(config)
    module = run.fit()
    if config.evaluate:
        measure(run, module, config)
    else:
        print(f"fitted: {run.folder}")


def main() -> None:
    """The console script."""
    command("train", train, HELP)


if __name__ == "__main__":
    main()
