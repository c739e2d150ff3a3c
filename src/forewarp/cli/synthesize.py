"""
forewarp-synthesize writes a procedural brick vehicle whose arm lifts, whose rubber band stretches and whose
ball bounces, with exact point trajectories, in the format of one of four datasets; or films two movers in a
room, with true poses, times and masks. The files depend on the keys alone, not on the number of processes.

  forewarp-synthesize                                data/vehicle in the project
  forewarp-synthesize folder=scenes/large size=400 frames=100
  forewarp-synthesize dataset=lego_complete          three scenes at full size: minutes, 0.9 GB
  forewarp-synthesize dataset=multicam folder=rig    then forewarp-capture videos=rig

What one types most:
  dataset=dnerf          one scene, a random camera for each time, exact depth
          lego_complete  three scenes with 200 + 197 + 50 test views and exact depth: a counterpart of the
                         paper's data, not the authors' files
          hypernerf      two phones on a rig in a textured room: lens distortion, no alpha, static points
          nhr            20 cameras of two image sizes around it: masks, point clouds
          multicam       two movers in a room: videos by cameras=12 that begin apart, with a clap;
                         truth/ for experiment=video_with_poses; synchronised=true for experiment=multicam
          iphone         the same by a hand-held phone with a LiDAR, for experiment=iphone: co-visible pixels,
                         keypoints, two phones beside its path (beside=5: with every fifth frame)
  folder=FOLDER          the scene's own folder
  size=N frames=N seed=N pixels, times, random cameras
  motion=lift|lift_tilt|drive      how it moves; motions=[...] for lego_complete
  test_views=[10,10,10]            dnerf: at training times, between them, at the canonical time
  test_views=[4,4,50]              lego_complete: a training time, steps between two of them, canonical
  samples_per_pixel=N              rays averaged into a pixel
  workers=N                        processes; left out: one for each processor if there is enough to do
  overwrite=true                   replace the scene in the folder

Train on it: forewarp-train data=dnerf data.root=scenes data.scene=large
"""

from __future__ import annotations

from forewarp.cli.entry import command


def synthesize(config) -> None:
    """Write a procedural scene."""
    from pathlib import Path

    from omegaconf import OmegaConf

    from forewarp.data.files import RECORD
    from forewarp.runs.config import check_seed

    arguments = OmegaConf.to_container(config, resolve=True)
    folder, overwrite = Path(arguments.pop("folder")), arguments.pop("overwrite")
    dataset, workers = arguments.pop("dataset"), arguments.pop("workers")
    arguments.pop("paths")
    check_seed(arguments["seed"])
    if folder.exists() and not folder.is_dir():
        raise ValueError(f"folder: expected a folder, but got the file {folder}; set folder=...")
    is_scene = (folder / RECORD).is_file()
    if folder.is_dir() and any(folder.iterdir()) and not (is_scene and overwrite):
        advice = "set overwrite=true or folder=..." if is_scene else "set folder=..."
        raise ValueError(f"{folder}: expected a new or empty folder, but got one with files; {advice}")
    # These load torch; mistakes have been answered before.
    from forewarp.progress import Counted
    from forewarp.synth.module import write_whole

    with Counted("images") as progress:
        write_whole(folder, dataset, arguments, workers=workers, progress=progress)
    print(f"written: {folder}")


def main() -> None:
    """Run the console script."""
    command("synthesize", synthesize, __doc__)


if __name__ == "__main__":
    main()
