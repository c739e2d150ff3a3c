"""
forewarp-render makes a video of a finished run, into its videos/.

  forewarp-render run=runs/vehicle/particles-demo-seed0 path=both
  forewarp-render run=runs/hand/particles-fast-seed0 path=lean       a film by one camera
  forewarp-render run=FOLDER path=trajectories format=gif size=300

Of a film, what no training image shows, or only from other sides, fades to black; how much did is said.

What one types most:
  run=FOLDER                    the run (needed)
  path=as_filmed                the camera's own way, at its own speed; what you get of a film without path=
  path=stabilised               the same, smoothed
  path=lean                     a slow figure of eight about it, within the angle that is trusted
  path=fixed                    one camera, through time; what you get of other scenes without path=
  path=swing                    to and fro while time passes, as far as the training cameras stand. Of a
                                film fixed and swing, too, stay within the angle that is trusted
  path=orbit time=0.5           once around, at one time
  path=both                     once around while time passes
  path=trajectories             as fixed, with the trajectories of points on the moving surface drawn over it
  frames=N fps=N size=N         how many, how many a second (20; with frames= alone as many as keep a film's
                                speed), pixels of the longer side (as the images, at least 400)
  view=N                        the test view that it shows or starts from
  format=mp4|gif|png            a video, an animated picture, one picture a frame
  layer=moving|resting          only the particles that move, or those that rest, whose holes in a film get
                                the colours around them
  masks=true                    also a mask of what moves for each picture, in videos/<name>_masks/
  points=N tail=SHARE           how many trajectories, and for what share of the time they stay visible
  trust=[PACKAGE]               code of other packages that the run's config may name
  data.root=FOLDER              where the data are now, if they moved
  threads=N trainer=cpu         threads and device to compute with
"""

from __future__ import annotations

from pathlib import Path

from forewarp.cli.entry import command
from forewarp.runs.overrides import next_command

HALF = 0.5  # share of a pixel, above which it counts as what fills it
_FRAMES, _MOST_FRAMES = 60, 1200  # of a video whose length nothing tells, and at most without frames=
_RATE = 20.0  # frames a second
LEAST_SIZE = 400  # pixels of the longer side, unless size= asks for another


def render(config) -> None:
    """Load a run and write the video."""
    from forewarp.runs.config import saved_config

    saved = saved_config(config.run, config)
    check(config)
    # These load torch; mistakes have been answered before.
    from forewarp.runs.fitted import opened

    if config.path in ("orbit", "both") and saved.get("capture") != "cut_out":
        around = f"path={config.path} goes all around, also to where no camera of a capture from one side has"
        print(f"{around} looked; path=lean stays within the angle that is trusted")
    file = write_film(config, *opened(saved))
    print(f"written: {file}" + (f" and {file.with_suffix('')}_masks" if config.masks == "true" else ""))


def write_film(config, run, module) -> Path:
    """Write the video that the config describes, and its masks, into the run's folder; return its file.
    Without a ``path`` the config gets the one that suits the scene.
    """
    from forewarp.drawing.images import write_video
    from forewarp.evaluation.images import FILMED
    from forewarp.progress import Counted
    from forewarp.runs.fitted import film_of

    film = film_of(run)
    config.path = config.path or ("fixed" if film is None else "as_filmed")
    name = config.path if config.layer == "all" else f"{config.path}_{config.layer}"
    folder, seconds = Path(run.folder) / "videos", run.datamodule.scene.protocol.get("seconds")
    count, fps = pace(config.frames, config.fps, seconds if config.path in FILMED else None)
    with Counted(config.path) as progress:
        masks = folder / f"{name}_masks"
        pictures = pictures_of(config, module, run.datamodule, count, film, masks, progress)
        return write_video(folder / f"{name}.{config.format}", pictures, fps=fps)


def pace(frames: int | None, fps: float | None, seconds: float | None) -> tuple[int, float]:
    """Choose how many pictures a video has, and how many a second.

    Args:
        frames, fps: as asked for. Where not both are, a film keeps its speed.
        seconds: how long the film lasts whose path is followed; None: nothing tells.

    >>> pace(None, None, 3.0), pace(20, None, 10.0), pace(20, 30, 10.0), pace(None, 25, 100.0)
    ((60, 20.0), (20, 2.0), (20, 30.0), (1200, 12.0))
    """
    rate = float(fps or _RATE)
    lasts = round(seconds * rate) if seconds else _FRAMES
    count = frames or min(max(lasts, 2), _MOST_FRAMES)
    is_kept = count == lasts or not seconds or (frames and fps)
    return count, rate if is_kept else count / seconds


def pictures_of(config, module, datamodule, count: int, film, masks: Path, progress):
    """Render ``count`` pictures of the video that the config describes, and report each to ``progress``.

    If it asks for them, write for each which of its pixels are mostly what moves, ``masks/0000.png`` ...
    """
    from forewarp.drawing.images import keep_first, write_png
    from forewarp.evaluation.filmed import Fade
    from forewarp.evaluation.images import Filled, make_shots, moving_share, sized, video
    from forewarp.evaluation.layers import layer_of, moving_rows
    from forewarp.evaluation.trajectories import Trajectories

    frames, method, targets = datamodule.scene.train, module.method, datamodule.targets("test")
    cameras = [frame.camera for frame in frames]
    if config.view >= len(targets):
        raise ValueError(f"view: expected a test view, 0 to {len(targets) - 1}, but got {config.view}")
    moving = moving_rows(method, frames, "masks") if str(config.masks).lower() == "true" else None
    module.method = layer_of(method, config.layer, frames)
    fade = None if datamodule.scene.has_alpha else Fade(cameras)
    behind = targets[config.view].background.to(module.device)
    holes = [Filled(behind)] if config.layer == "resting" and fade is not None else []
    paints = [*holes, *filter(None, [fade])]
    if config.path == "trajectories":
        paints.append(Trajectories(module, cameras, count=config.points, tail=float(config.tail)))
    target = targets[config.view]
    camera = target.frame.camera
    start = sized(camera, config.size or max(camera.width, camera.height, LEAST_SIZE))
    seconds = datamodule.scene.protocol.get("seconds")
    shots = make_shots(config.path, count, float(config.time), start, cameras, film, seconds)

    def pictures():
        if moving is not None:
            keep_first(masks, len(shots))
        for number, picture in enumerate(video(module, shots, behind, paints)):
            if moving is not None:
                share = moving_share(method, moving, *shots[number])
                write_png(masks / f"{number:04d}.png", (share > HALF).float())
            progress(number + 1, len(shots))
            yield picture
        if fade is not None and (line := fade.told()):
            print(line)

    return pictures()


def check(config) -> None:
    """Refuse settings of which no video can be made, before anything is loaded."""
    from forewarp.cli.prepare import LEAST, RANGES, refuse_numbers
    from forewarp.data.files import one_of
    from forewarp.drawing.images import FORMATS
    from forewarp.evaluation.images import PATHS
    from forewarp.evaluation.layers import LAYERS
    from forewarp.export.formats import FORMATS as OF_EXPORT

    page = next_command("export", [f"run={config.run or '<a run>'}", f"format={config.format}"])
    exported = f"it is written by {page}" if config.format in OF_EXPORT else ""
    one_of(config.format, "format", *FORMATS, advice=exported)
    for key, known in (("path", PATHS), ("layer", LAYERS)):
        if config[key] is not None or key != "path":
            one_of(config[key], key, *known)
    config.masks = str(config.masks).lower()  # typed, it is text, as the folder of forewarp-capture is
    one_of(config.masks, "masks", "true", "false")
    refuse_numbers(config, *LEAST, *RANGES)


def main() -> None:
    """Run the console script."""
    command("render", render, __doc__)


if __name__ == "__main__":
    main()
