"""``forewarp-synthesize``: write the procedural scene."""

from __future__ import annotations

from forewarp.cli.entry import command

HELP = """
forewarp-synthesize writes a procedural brick vehicle whose arm lifts, whose rubber band stretches and whose
ball bounces, as a D-NeRF scene with exact depth and exact point trajectories. Equal keys give equal files.

  forewarp-synthesize                                data/vehicle in the project
  forewarp-synthesize folder=scenes/large size=400 frames=100

What one types most:
  folder=FOLDER                    the scene's own folder
  size=N frames=N seed=N           pixels a side, training images, cameras
  motion=lift|lift_tilt|drive      how it moves
  test_views=[10,10,10]            at training times, between them, at the canonical time
  samples_per_pixel=N              rays averaged into a pixel
  overwrite=true                   replace the scene that is there

Train on it: forewarp-train data=dnerf data.root=scenes data.scene=large
"""


def synthesize(config) -> None:
    """Write the scene."""
    from pathlib import Path

    from omegaconf import OmegaConf

    from forewarp.cli.measure import Progress
    from forewarp.cli.synthetic import is_scene, write_whole

    arguments = OmegaConf.to_container(config, resolve=True)
    folder, overwrite = Path(arguments.pop("folder")), arguments.pop("overwrite")
    arguments.pop("paths")
    if folder.exists() and not folder.is_dir():
        raise ValueError(f"folder: expected a folder, but got the file {folder}; set folder=...")
    if folder.is_dir() and any(folder.iterdir()) and not (is_scene(folder) and overwrite):
        advice = "set overwrite=true or folder=..." if is_scene(folder) else "set folder=..."
        raise ValueError(f"{folder}: expected a new or empty folder, but got one with files; {advice}")
    with Progress("images") as progress:
        write_whole(folder, arguments, progress)
    print(f"written: {folder}")


def main() -> None:
    """The console script."""
    command("synthesize", synthesize, HELP)


if __name__ == "__main__":
    main()
