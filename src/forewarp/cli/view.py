"""
forewarp-view opens a page on which one flies around a finished run and through its time. It prints the page's
address, and runs until Ctrl-C.

  forewarp-view run=runs/vehicle/particles-demo-seed0
  forewarp-view run=FOLDER run2=ANOTHER        two runs of one scene, beside each other under one camera

What one types most:
  run=FOLDER                    the run (needed)
  run2=FOLDER                   another run of the same scene
  host=ADDRESS port=N           where to listen: 127.0.0.1, for this machine alone, and 8080
  size=N                        rows of a picture at rest (as the images, at least 400)
  points=N tail=SHARE           how many trajectories, and for what share of the time they stay visible
  trust=[PACKAGE]               code of other packages that the runs' configs may name
  data.root=FOLDER              where the data are now, if they moved
  threads=N trainer=cpu         threads and device to compute with

A run in training: forewarp-train ... viewer=true
"""

from __future__ import annotations

import sys
from pathlib import Path
from signal import SIGINT

from forewarp.cli.entry import command
from forewarp.files import read_json
from forewarp.interrupts import signal_of

TOLERANCE = 1e-3  # by which two runs' test cameras may differ, of their distance to the origin


def view(config) -> None:
    """Load one or two runs and serve their page until Ctrl-C."""
    from forewarp.cli.prepare import refuse_numbers, require_viewer
    from forewarp.runs.config import saved_config

    require_viewer()
    runs = [saved_config(config.run, config)]
    if config.run2 is not None:
        runs.append(saved_config(config.run2, config, "run2"))
    refuse_numbers(config, "size", "points", "tail")
    # These load torch; mistakes have been answered before.
    from forewarp.runs.fitted import trust_degrees
    from forewarp.viewer.rendering import Viewer
    from forewarp.viewer.server import serve

    renderers = [renderer_of(saved, config) for saved in runs]
    scene = renderers[0].scene
    for other in renderers[1:]:
        refuse_other_scene(scene, other.scene)
        warn_of_other_files(Path(config.run), Path(config.run2), scene.name)
    viewer = Viewer(scene, renderers, rows=config.size, trust=trust_degrees(Path(config.run)))
    title = " | ".join([scene.name, *(renderer.name for renderer in renderers)])
    folder = Path(config.run) / "videos"
    with serve(viewer, host=config.host, port=config.port, title=title, folder=folder) as address:
        print(f"see it: {address} (Ctrl-C ends)", flush=True)
        try:
            viewer.queue.run_forever()
        except KeyboardInterrupt as interruption:
            if signal_of(interruption) != SIGINT:
                raise
            print()


def renderer_of(saved, config):
    """Load a run's method."""
    from forewarp.runs.fitted import opened
    from forewarp.viewer.rendering import SceneRenderer

    run, module = opened(saved)
    name = Path(saved.run).resolve().name
    return SceneRenderer(name, module, run.datamodule, count=config.points, tail=float(config.tail))


def refuse_other_scene(scene, other) -> None:
    """Refuse a second run of another scene: of another name, or other test cameras and times.

    Raises:
        ValueError: naming ``run2``.
    """
    import torch

    if scene.name != other.name:
        raise ValueError(f"run2: expected a run of {scene.name}, as run= is, but got one of {other.name}")
    same = len(scene.test) == len(other.test) and all(
        abs(a.time - b.time) < TOLERANCE
        and torch.allclose(a.camera.center, b.camera.center, rtol=TOLERANCE, atol=TOLERANCE)
        for a, b in zip(scene.test, other.test)
    )
    if not same:
        expected = f"run2: expected a run of the same {scene.name} as run= is"
        raise ValueError(f"{expected}, but got one with other test views")


def warn_of_other_files(run: Path, other: Path, scene: str) -> None:
    """Warn on stderr of a second run that was trained on other files, as another capture of this name has."""
    files, others = (read_json(folder / "data.json") for folder in (run, other))
    if files and others and files != others:
        expected = f"run2: expected a run on the files of {scene} that run= was trained on"
        advice = "where they are of another capture, the two do not compare"
        print(f"warning: {expected}, but got one on others (see data.json); {advice}", file=sys.stderr)


def main() -> None:
    """Run the console script."""
    command("view", view, __doc__)


if __name__ == "__main__":
    main()
