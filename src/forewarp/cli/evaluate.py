"""
forewarp-evaluate measures a finished run on its test views and prints the table. Everything is rebuilt from
the run's own config.yaml; images/, per_image.json and metrics.json are written again. With renders= it
measures images that another program rendered, by the same protocol, as a row for every report.

  forewarp-evaluate run=runs/vehicle/particles-demo-seed0
  forewarp-evaluate run=FOLDER data.root=../elsewhere/dnerf
  forewarp-evaluate renders=output/test/ours_40000/renders name="SC-GS (authors' code)" \\
      data=dnerf data.root=SCENES data.scene=hook minutes=25 device="RTX 3090"

What one types most:
  run=FOLDER               the run (needed, but with renders=)
  trust=[PACKAGE]          code of other packages that the run's config may name
  data.root=FOLDER         where the data are now, if they moved
  lpips_weights=FILE       a backbone's weights, or a folder of them, for LPIPS
  views=N                  measure N test views, evenly spread, in place of all
  reduce=2                 average 2 x 2 pixels of each view and of its truth, then score
  eval_background=black    measure before another background, white or black; cut-out images alone have one
  sheets=N                 how many pictures of truth | prediction | error
  threads=N trainer=cpu    threads and device to compute with

Of images from elsewhere:
  renders=FOLDER           PNG images of all test views, with their names or numbered in their order
  name="..."               what tables call the method (needed)
  data=dnerf data.root=... data.scene=...   the scene, as for forewarp-train
  minutes=N seed=N         of its training
  megabytes=N device="..." size of its model, and what it was trained on
  run=FOLDER               where results go (default: runs/<scene>/<name>-seed<N>)
"""

from __future__ import annotations

import re

from omegaconf import DictConfig, OmegaConf

from forewarp.cli.entry import command
from forewarp.cli.prepare import refuse_numbers


def evaluate(config) -> None:
    """Load a run and measure it."""
    from forewarp.runs.config import saved_config

    refuse_numbers(config, "views", "sheets", "reduce")
    if config.renders is not None:
        evaluate_renders(config)
        return
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


def evaluate_renders(config: DictConfig) -> None:
    """Measure images that another program rendered, into the folder of a row for reports.

    Raises:
        ValueError: for keys that are missing or do not fit, before anything is read.
    """
    from forewarp.cli.prepare import refuse_missing_scene
    from forewarp.data.files import mismatch, number
    from forewarp.runs.config import check_seed

    name = config.name
    if not isinstance(name, str) or not name.strip():
        raise mismatch("name", "what tables call the method", name, 'add name="SC-GS (authors\' code)"')
    if config.data.get("_target_") is None or OmegaConf.is_missing(config.data, "scene"):
        advice = "add data=dnerf data.root=FOLDER data.scene=NAME, or another layout"
        raise mismatch("data", "the scene that the images show", "none", advice)
    if config.reduce is not None:
        raise mismatch("reduce", "null beside renders=", config.reduce, "reduce the images yourself")
    check_seed(config.seed)
    for key in ("minutes", "megabytes"):
        if config[key] is not None:
            number(config[key], key, 0)
    if config.eval_background is not None:
        config.data.eval_background = config.eval_background
    refuse_missing_scene(config)
    if config.run is None:
        words = re.sub(r"[^\w.-]+", "-", name).strip("-.")
        config.run = f"{config.paths.runs}/{config.data.scene}/{words}-seed{config.seed}"
    from forewarp.runs.elsewhere import measure_elsewhere  # loads torch

    measure_elsewhere(config)


def main() -> None:
    """Run the console script."""
    command("evaluate", evaluate, __doc__)


if __name__ == "__main__":
    main()
