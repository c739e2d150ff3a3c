"""
forewarp-capture makes a scene from a video: it takes the sharpest frames, finds the cameras' poses from what
stands still, and writes what experiment=video_with_poses reads (docs/capture.md).

  forewarp-capture video=hand.mp4 out=captures/hand
  forewarp-train experiment=video_with_poses data.root=captures data.scene=hand

What one types most:
  video=FILE                    a video; its rotation flag and its own time stamps are heeded
  images=FOLDER                 or pictures of one size, in the order of their names
  colmap=FOLDER                 poses that are known: a COLMAP model, of the pictures in images=
  masks=FOLDER                  what moves is bright; poses are not found from it. A mask for each frame
                                of the video in order, or masks with the pictures' names
  out=FOLDER                    the scene's folder (captures/<name of the video>)
  frames=N                      how many frames of a video; by default all of a short one, else by its motion
  size=1600                     pixels of the longer side, at most; null: as filmed
  matching=exhaustive           match every pair of pictures, where the camera comes back to where it was
  lens=SIMPLE_RADIAL            a simpler camera, where few pictures or points tell of the lens
  threads=N seed=N              processors; random choices
  force=true                    go on where the camera is said to stand or only to turn, or known
                                poses to be wrong
  overwrite=true                replace an earlier capture in out

After Ctrl-C the same command goes on.
"""

from __future__ import annotations

from forewarp.cli.entry import command
from forewarp.runs.config import check_seed
from forewarp.runs.overrides import command_line, text_override

MATCHING = ("auto", "sequential", "exhaustive")
PATHS = ("video", "images", "colmap", "masks", "out")
LENSES = ("SIMPLE_PINHOLE", "PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV")


def capture(config) -> None:
    """Make a scene, and say what was found."""
    from pathlib import Path

    source, out = check(config)
    # These load torch; mistakes have been answered before.
    from forewarp.capture.frames import Source
    from forewarp.capture.pipeline import PICTURE, capture
    from forewarp.capture.poses import Search
    from forewarp.capture.scene import summary
    from forewarp.progress import Counted

    if type(config.force) is not bool:
        raise ValueError(f"force: expected true or false, but got {config.force}")
    search = Search(config.matching, config.lens, config.features, config.seed, config.threads)
    facts = capture(
        Source(**source), out, search, Counted, frames=config.frames, size=config.size, force=config.force
    )
    for line in summary(facts):
        print(line)
    drawn = Path(out) / PICTURE
    print(f"written: {out}" + (f"; see {drawn}" if drawn.is_file() else ""))
    where = [text_override("data.root", str(out.parent)), text_override("data.scene", out.name)]
    print(f"next: {command_line('train', ['experiment=video_with_poses', *where])}")


def check(config) -> tuple[dict, object]:
    """Refuse settings that cannot work, before anything is loaded; return what to capture, and where to."""
    from importlib.util import find_spec
    from pathlib import Path

    from forewarp.data.files import MARKERS
    from forewarp.files import check_replaceable

    source = {key: None if config[key] is None else Path(config[key]) for key in PATHS if key != "out"}
    video, images = source["video"], source["images"]
    if (video is None) == (images is None):
        got = "both" if video else "neither"
        raise ValueError(
            f"video, images: expected video=FILE or images=FOLDER, but got {got}; set one of them"
        )
    if video is not None and source["colmap"] is not None:
        raise ValueError("colmap: expected images=FOLDER beside it, but got video=; set images=")
    for key, path in source.items():
        what, there = ("file", Path.is_file) if key == "video" else ("folder", Path.is_dir)
        if path is not None and not there(path):
            got = "another thing" if path.exists() else "none"
            raise ValueError(f"{key}: expected an existing {what}, but got {got}: {path}; set {key}=...")
    for key, least, or_null in (
        ("frames", 3, True),
        ("size", 64, True),
        ("features", 100, False),
        ("threads", 1, True),
    ):
        value = config[key]
        if not (or_null and value is None) and (type(value) is not int or value < least):
            raise ValueError(f"{key}: expected a whole number of at least {least}, but got {value}")
    check_seed(config.seed)
    for key, known in (("matching", MATCHING), ("lens", LENSES)):
        if config[key] not in known:
            raise ValueError(f"{key}: expected one of {', '.join(known)}, but got '{config[key]}'")
    for package in ("pycolmap", "cv2"):
        if find_spec(package) is None:
            raise ImportError(f"capture: expected {package}, but got none; install forewarp[capture]")
    out = Path(config.out or Path("captures") / (video or images).resolve().stem)
    if Path.cwd().is_relative_to(out.resolve()):
        raise ValueError(f"out: expected a folder to be made, but got {out}, which you are in; name another")
    for key, path in source.items():
        place, ours = out.resolve(), path and path.resolve()
        if ours and ours.is_relative_to(place):
            raise ValueError(
                f"out: expected a folder that holds no inputs, but got {out} with {key}={path}; set out=..."
            )
        if ours and key in ("images", "masks") and place.is_relative_to(ours):
            raise ValueError(
                f"out: expected a folder outside {key}={path}, which is read, but got {out}; set out=..."
            )
    if (out / MARKERS["posed_video"]).exists() and not config.overwrite:
        raise ValueError(f"{out}: expected a new folder, but got a scene; set overwrite=true or out=...")
    check_replaceable(out, "capture.json")
    return source, out


def main() -> None:
    """Run the console script."""
    command("capture", capture, __doc__)


if __name__ == "__main__":
    main()
