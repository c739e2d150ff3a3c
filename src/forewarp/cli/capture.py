"""
forewarp-capture makes a scene from a video, or from those of several cameras: it takes frames, finds the
cameras' poses from what stands still, and writes what experiment=video_with_poses reads (docs/capture.md).

  forewarp-capture hand.mp4 out=captures/hand
  forewarp-train experiment=video_with_poses data.root=captures data.scene=hand budget.minutes=5

forewarp-open hand.mp4 does this and all that follows, up to a page that plays it.

What one types most:
  video=FILE                    a video; its rotation flag and its own time stamps are heeded. A scan of
                                Record3D (.r3d) has poses and measured depth of its own
  videos=FOLDER                 or a video of each of several cameras, which film one scene (see below)
  images=FOLDER                 or pictures of one size, in the order of their names
  name_pattern='(?P<frame>[0-9]+)$'  reads frame or time in pictures' names that say it in several ways
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

Several cameras, videos=FOLDER: cam00.mp4, ... of any names and rates, or a sub-folder of pictures for each
  offsets=null                  when each began: by sound, where all have it; [0, 0.2, ...] or
                                {cam00: 0, cam01: 0.2}, seconds; none: all together
  without=[cam13]               leave out cameras
  fixed=true                    the cameras stand; false: they move; null: as their images show
  rate=30                       pictures a second, of sub-folders
  masks=FOLDER                  with a sub-folder for each camera

After Ctrl-C the same command goes on.
"""

from __future__ import annotations

import importlib.util
from pathlib import Path

from forewarp.cli.entry import command
from forewarp.data.files import LAYOUTS, one_of, threads_of, whole
from forewarp.files import check_replaceable
from forewarp.runs.config import check_seed
from forewarp.runs.overrides import next_command, text_override

MATCHING = ("auto", "sequential", "exhaustive")
PATHS = ("video", "videos", "images", "colmap", "masks", "out")
# Keys of several cameras, and what they are where they are not set.
RIG = {"offsets": None, "without": [], "fixed": None, "rate": None}
LEAST_HELD = 4  # cameras from which on one is held out by the command that comes next
MINUTES = 5  # of training in the command that comes next
SUFFIX = ".r3d"  # of scans by Record3D
LENSES = ("SIMPLE_PINHOLE", "PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV")


def capture(config) -> None:
    """Make a scene, and say what was found."""
    from omegaconf import OmegaConf

    source, out = check(config)  # what follows loads torch; mistakes have been answered before
    from forewarp.capture import record3d, rig, scene
    from forewarp.capture.frames import Source
    from forewarp.capture.pipeline import ABOUT, PICTURE, capture
    from forewarp.capture.poses import Search
    from forewarp.progress import Counted

    search = Search(config.matching, config.lens, config.features, config.seed, config.threads)
    options = {"frames": config.frames, "force": config.force}
    videos, held = source.pop("videos"), []
    if is_scan(source["video"]):
        facts = record3d.capture_record3d(source["video"], out, Counted, ABOUT, config.frames)
        lines = record3d.summary(facts)
    elif videos is None:
        of = Source(**source, size=config.size, name_pattern=config.name_pattern)
        facts = capture(of, out, search, Counted, **options)
        lines = scene.summary(facts)
    else:
        options |= OmegaConf.to_container(OmegaConf.masked_copy(config, ["size", "name_pattern", *RIG]))
        facts = rig.capture_rig(videos, out, search, Counted, masks=source["masks"], **options)
        lines, posed = rig.summary(facts), [name for name in facts["cameras"] if name not in facts["lost"]]
        # One in the middle, as the outermost see what no other does.
        one = text_override("data.test_cameras", posed[len(posed) // 2]).partition("=")[2]
        held = [f"data.test_cameras=[{one}]"] if len(posed) >= LEAST_HELD else []
    drawn = out / PICTURE
    print(*lines, f"written: {out}" + (f"; see {drawn}" if drawn.is_file() else ""), sep="\n")
    where = [text_override("data.root", str(out.parent)), text_override("data.scene", out.name), *held]
    words = ["experiment=video_with_poses", *where, f"budget.minutes={MINUTES}"]
    print("next:", f"  {next_command('train', words)}", sep="\n")


def is_scan(video) -> bool:
    """Tell whether a file is a scan by Record3D, by its name."""
    return video is not None and video.suffix.lower() == SUFFIX


def check(config) -> tuple[dict, object]:
    """Refuse settings that cannot work, before anything is loaded; return what to capture, and where to."""
    source = {key: None if config[key] is None else Path(config[key]) for key in PATHS if key != "out"}
    video, videos, images = source["video"], source["videos"], source["images"]
    given = [key for key in ("video", "videos", "images") if source[key] is not None]
    if len(given) != 1:
        got = " and ".join(given) or "none"
        expected = "expected video=FILE, videos=FOLDER or images=FOLDER"
        raise ValueError(f"video, videos, images: {expected}, but got {got}; set one of them")
    needs = {"colmap": "images"} if source["colmap"] is not None else {}
    needs |= {key: "videos" for key, value in RIG.items() if config[key] != value}
    for key, needed in needs.items():
        if needed != given[0]:
            advice = "set images=" if key == "colmap" else "remove it"
            raise ValueError(f"{key}: expected {needed}=FOLDER beside it, but got {given[0]}=; {advice}")
    one_of(config.force, "force", True, False)
    one_of(config.fixed, "fixed", True, False, None)
    if config.rate is not None and not (type(config.rate) in (int, float) and 0 < config.rate < 1e6):
        raise ValueError(f"rate: expected pictures a second, above 0, but got {config.rate}")
    if isinstance(name := config.without, str):
        raise ValueError(f"without: expected a list of names, but got {name}; write without=[{name}]")
    for key, path in source.items():
        what, there = ("file", Path.is_file) if key == "video" else ("folder", Path.is_dir)
        if path is not None and not there(path):
            got = "another thing" if path.exists() else "none"
            of_images = key == "video" and (path.is_dir() or "%" in path.name or "*" in path.name)
            advice = f"images={path if path.is_dir() else path.parent}" if of_images else f"{key}=..."
            raise ValueError(f"{key}: expected an existing {what}, but got {got}: {path}; set {advice}")
    for key, least in (("frames", 3), ("size", 64), ("features", 100)):
        if config[key] is not None or key == "features":
            whole(config[key], key, least)
    if config.threads is not None:
        threads_of(config.threads)
    check_seed(config.seed)
    one_of(config.matching, "matching", *MATCHING)
    one_of(config.lens, "lens", *LENSES)
    if typed := [key for key in ("masks", "colmap") if is_scan(video) and source[key] is not None]:
        raise ValueError(f"{typed[0]}: expected none beside a scan of Record3D, but got one; remove it")
    for package in ("pycolmap", "cv2", *(["lzfse"] if is_scan(video) else [])):
        if importlib.util.find_spec(package) is None:
            raise ImportError(f"capture: expected {package}, but got none; install forewarp[capture]")
    out = Path(config.out or Path("captures") / (video or videos or images).resolve().stem)
    if Path.cwd().is_relative_to(out.resolve()):
        raise ValueError(f"out: expected a folder to be made, but got {out}, which you are in; name another")
    for key, path in source.items():
        place, ours = out.resolve(), path and path.resolve()
        inside = key in ("videos", "images", "masks") and ours and place.is_relative_to(ours)
        if inside or (ours and ours.is_relative_to(place)):
            expected = f"out: expected a folder apart from what is read, but got {out}"
            raise ValueError(f"{expected} with {key}={path}; set out=...")
    if (out / LAYOUTS["nerfstudio"][0]).exists() and not config.overwrite:
        raise ValueError(f"{out}: expected a new folder, but got a scene; set overwrite=true or out=...")
    check_replaceable(out, "capture.json")
    return source, out


def main() -> None:
    """Run the console script."""
    command("capture", capture, __doc__)


if __name__ == "__main__":
    main()
