"""
forewarp-open makes a page that plays a clip: it finds the camera's path, trains, scores and exports, and
shows how far it is and how long it will take. A page in the browser shows the scene while it trains.

  forewarp-open clip.mp4
  forewarp-open clip.mp4 quality=draft

What one types most:
  video=FILE                    the clip; its name alone will do
  quality=draft|good|best       1, 5 or 20 minutes of training; 5 without it
  budget.minutes=N              other minutes; preset=demo|fast|faithful other numbers
  budget.clock=wall|processor   what minutes are of; processor time does not depend on other work
  out=FOLDER                    where the result goes (opened/<name of the clip>)
  browser=false                 print addresses, open none
  force=true                    go on where the camera is said to stand or only to turn
  threads=N seed=N              processors; random choices

The result: page.html, which plays the scene offline and says how good it is; film.mp4, the scene as it was
filmed; scene.glb. Beside them log.txt has what the commands said that did the work, data/ the cameras, and
runs/ the run. After Ctrl-C the same command goes on.
"""

from __future__ import annotations

import os
import shutil
import socket
import sys
import webbrowser
from collections.abc import Callable, Sequence
from contextlib import redirect_stdout
from pathlib import Path
from typing import NamedTuple

from forewarp.cli.capture import capture, is_scan
from forewarp.cli.entry import command, run_part
from forewarp.cli.export import export
from forewarp.cli.prepare import require_viewer
from forewarp.cli.render import render
from forewarp.cli.report import report
from forewarp.cli.train import train
from forewarp.data.files import mismatch, number, one_of, threads_of
from forewarp.files import link_of, read_json, write_json
from forewarp.progress import WholeProgress
from forewarp.runs.config import check_seed
from forewarp.runs.overrides import next_command, text_override

ABOUT, LOG = "open.json", "log.txt"  # in the result's folder: which clip it is of, and what commands said
HOST = "127.0.0.1"
PRESETS = ("demo", "fast", "faithful")
FILM = "as_filmed"  # path of the film
# Seconds that parts may take: cameras, what training needs beside its minutes, and each of the others.
CAMERAS, BESIDE, OTHERS = 240.0, 90.0, 30.0
LEAST = 0.01  # minutes
WHERE = {"moving": "moves", "still": "rests"}
RESULTS = {"page": "page.html", "film": "film.mp4", "scene": "scene.glb"}  # of the result's folder
BETTER = {"draft": "good", "good": "best"}


class Part(NamedTuple):
    """A command that does a part of the work; it is done where ``file`` is there, and not older than that of
    the part before.
    """

    name: str
    seconds: float
    file: Path
    command: str
    task: Callable
    words: Sequence[str]


def open_clip(config) -> None:
    """Do what is not done yet for the page of a clip, say how good it is, and open it."""
    video, out, preset, minutes = check(config)
    claim(out, video)
    port = free_port()
    parts = parts_of(config, video, out, preset, minutes, port)
    left = not_done(parts)
    with open(out / LOG, "a", encoding="utf-8") as log, WholeProgress(video.stem, left) as progress:
        for part in parts[len(parts) - len(left) :]:
            with progress.part(part.name), redirect_stdout(log):
                if part.name == "training":
                    address = f"http://{HOST}:{port}"
                    print(f"see it train: {address}", file=sys.stderr, flush=True)
                    open_page(address, config.browser)
                run_part(part.command, part.task, part.words)
    training = parts[1]
    for part in parts[2:]:
        shutil.copyfile(part.file, out / RESULTS[part.name])
    scores = read_json(training.file) or {}
    print(*lines_of(config, scores, video, out, training.file.parent), sep="\n", flush=True)
    open_page(link_of(out / "page.html"), config.browser)


def check(config) -> tuple[Path, Path, str, float]:
    """Refuse settings that cannot work, before anything is loaded; return the clip, the result's folder, the
    preset and the minutes.
    """
    if config.video is None:
        raise ValueError("video: expected the file of a clip, but got none; type forewarp-open CLIP.mp4")
    video = Path(config.video)
    if not video.is_file():
        got = "a folder" if video.is_dir() else "none"
        raise mismatch("video", "an existing film", f"{got}: {video}", "forewarp-capture takes images")
    if is_scan(video):
        raise mismatch("video", "a film", f"a scan: {video}", "type forewarp-capture, then forewarp-train")
    one_of(config.quality, "quality", *config.qualities)
    stands_for = config.qualities[config.quality]
    preset, minutes = config.preset or stands_for.preset, config.budget.minutes
    one_of(preset, "preset", *PRESETS)
    one_of(config.budget.clock, "budget.clock", "wall", "processor")
    for key in ("browser", "force"):
        one_of(config[key], key, True, False)
    if config.threads is not None:
        threads_of(config.threads)
    check_seed(config.seed)
    require_viewer()
    minutes = number(stands_for.minutes if minutes is None else minutes, "budget.minutes", LEAST)
    return video, Path(config.out or Path("opened") / video.stem), preset, minutes


def claim(out: Path, video: Path) -> None:
    """Make the result's folder; refuse one of another clip, or one that holds other things."""
    about = {"video": str(video.resolve()), "bytes": video.stat().st_size}
    known = read_json(out / ABOUT)
    if known is None and out.is_dir() and any(out.iterdir()):
        raise mismatch(out, "a new folder, or one of this clip", "another one", "set out=...")
    if known not in (None, about):
        advice = "set out=..., or delete it"
        raise mismatch(
            out, f"a folder of {video}", f"one of {known.get('video')}, or of the file before", advice
        )
    out.mkdir(parents=True, exist_ok=True)
    write_json(out / ABOUT, about)


def parts_of(config, video: Path, out: Path, preset: str, minutes: float, port: int) -> tuple[Part, ...]:
    """List the commands that make the page of a clip, in their order."""
    scene = out / "data" / video.stem
    of_processor = "-of-processor" * (config.budget.clock == "processor")
    run = out / "runs" / f"{preset}-{minutes:g}-minutes{of_processor}-seed{config.seed}"
    threads = [f"threads={'null' if config.threads is None else config.threads}"]
    common, of_run = [f"seed={config.seed}", *threads], text_override("run", str(run))
    taken = [text_override("video", str(video)), text_override("out", str(scene)), f"force={config.force}"]
    data = [text_override("data.root", str(scene.parent)), text_override("data.scene", scene.name)]
    budget = [f"preset={preset}", f"budget.minutes={minutes:g}", f"budget.clock={config.budget.clock}"]
    shown = ["logger=none", "viewer=true", f"host={HOST}", f"port={port}", of_run]
    trained = ["experiment=video_with_poses", *data, *budget, *shown, *common]
    film, glb = run / "videos" / f"{FILM}.mp4", run / "exports" / "glb" / "scene.glb"
    return (
        Part("cameras", CAMERAS, scene / "capture.json", "capture", capture, [*taken, *common]),
        Part("training", 60 * minutes + BESIDE, run / "metrics.json", "train", train, trained),
        Part("film", OTHERS, film, "render", render, [of_run, f"path={FILM}", *threads]),
        Part("scene", OTHERS, glb, "export", export, [of_run, "format=glb", *threads]),
        Part("page", OTHERS, run / "page.html", "report", report, [of_run, "kind=run"]),
    )


def not_done(parts: Sequence[Part]) -> dict[str, float]:
    """Return the names and seconds of parts that are to be done: from the first that is not done."""
    before, is_done = 0, True
    left = {}
    for part in parts:
        made = part.file.stat().st_mtime_ns if part.file.is_file() else -1
        is_done = is_done and made >= before
        left |= {} if is_done else {part.name: part.seconds}
        before = made
    return left


def lines_of(config, metrics: dict, video: Path, out: Path, run: Path) -> list[str]:
    """Say in a user's words how good the result is, where it is, and what can be typed next."""
    psnr = {kind: scores["psnr"] for kind, scores in metrics.get("test", {}).items() if "psnr" in scores}
    parts = ", ".join(f"{psnr[kind]:.1f} where it {what}" for kind, what in WHERE.items() if kind in psnr)
    about = f"{psnr['all']:.1f} dB on frames that training did not see" if psnr else "not measured"
    lines = [f"{video.stem}: {about}" + f" ({parts})" * bool(parts)]
    if trust := metrics.get("trust"):
        lines.append(f"good up to {trust['degrees']:.0f} degrees beside where it was filmed")
    lines += [f"{name}  {link_of(out / file)}" for name, file in RESULTS.items()]
    lines += ["fly around it:", f"  {next_command('view', [f'run={run}'])}"]
    better = BETTER.get(config.quality) if config.preset is None and config.budget.minutes is None else None
    if better is not None:
        words = [str(video), f"quality={better}", *([] if config.out is None else [f"out={config.out}"])]
        lines += ["longer, and better:", f"  {next_command('open', words)}"]
    return lines


def open_page(address: str, is_wanted: bool) -> None:
    """Open a page where there is a screen with a browser; else Python would start one in the terminal."""
    if is_wanted and (
        sys.platform in ("darwin", "win32") or {"DISPLAY", "WAYLAND_DISPLAY"} & os.environ.keys()
    ):
        webbrowser.open(address)


def free_port() -> int:
    """Return a port of this machine that is free now."""
    with socket.create_server((HOST, 0)) as server:
        return server.getsockname()[1]


def main() -> None:
    """Run the console script."""
    command("open", open_clip, __doc__)


if __name__ == "__main__":
    main()
