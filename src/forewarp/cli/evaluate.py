"""``forewarp-evaluate``: measure a finished run again."""

from __future__ import annotations

from forewarp.cli.entry import command

HELP = """
forewarp-evaluate measures a finished run on its test views and prints the table. Everything is rebuilt from
the run's own config.yaml; images/, per_image.json and metrics.json are written anew.

  forewarp-evaluate run=runs/vehicle/forward-demo-seed0
  forewarp-evaluate run=FOLDER data.root=../elsewhere/dnerf

What one types most:
  run=FOLDER               the run (needed)
  trust=[PACKAGE]          code of other packages that the run's config may name
  data.root=FOLDER         where the data are now, if they moved
  lpips_weights=FILE       a backbone's weights, or a folder of them, for LPIPS
  sheets=N                 how many truth | prediction | error pictures
  threads=N trainer=cpu    what to compute with
"""


def evaluate(config) -> None:
    """Load and measure."""
    from forewarp.runs.identity import saved_config

    saved = saved_config(config.run, config)
    # These load torch; what is mistyped has been answered before.
    from forewarp.runs.build import build_run, measure_run
    from forewarp.runs.lock import alone, tell_other_data

    run = build_run(saved)
    with alone(run.folder):
        module = run.load()
        tell_other_data(run)
        measure_run(run, module, saved)


def main() -> None:
    """The console script."""
    command("evaluate", evaluate, HELP)


if __name__ == "__main__":
    main()
