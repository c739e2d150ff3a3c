"""
forewarp-evaluate measures a finished run on its test views and prints the table. Everything is rebuilt from
the run's own config.yaml; images/, per_image.json and metrics.json are written again.

  forewarp-evaluate run=runs/vehicle/particles-demo-seed0
  forewarp-evaluate run=FOLDER data.root=../elsewhere/dnerf

What one types most:
  run=FOLDER               the run (needed)
  trust=[PACKAGE]          code of other packages that the run's config may name
  data.root=FOLDER         where the data are now, if they moved
  lpips_weights=FILE       a backbone's weights, or a folder of them, for LPIPS
  views=N                  measure N test views, evenly spread, in place of all
  reduce=2                 average 2 x 2 pixels of each view and of its truth, then score
  eval_background=black    measure before another background, white or black; cut-out images alone have one
  sheets=N                 how many pictures of truth | prediction | error
  threads=N trainer=cpu    threads and device to compute with
"""

from __future__ import annotations

from forewarp.cli.entry import command
from forewarp.cli.prepare import refuse_numbers


def evaluate(config) -> None:
    """Load a run and measure it."""
    from forewarp.runs.config import saved_config

    refuse_numbers(config, "views", "sheets", "reduce")
    saved = saved_config(config.run, config)
    saved.views, saved.reduce = config.views, config.reduce  # not those of the run: null is all, and whole
    if (behind := config.eval_background) is not None:
        saved.data.eval_background = behind
    # These load torch; mistakes have been answered before.
    from forewarp.runs.build import build_run
    from forewarp.runs.fitted import measure_run
    from forewarp.runs.session import locked, warn_if_changed

    run = build_run(saved)
    place = run.device  # one that there is not is refused before pictures and weights are read
    with locked(run.folder):
        module = run.load().to(place)
        warn_if_changed(run)
        if behind is not None and not run.datamodule.scene.has_alpha:
            expected = "eval_background: expected a run on cut-out images, as opaque ones have no background"
            raise ValueError(f"{expected}, but got {behind}; leave it out")
        measure_run(run, module, saved)


def main() -> None:
    """Run the console script."""
    command("evaluate", evaluate, __doc__)


if __name__ == "__main__":
    main()
