"""``python -m tests.bench.memory``: what a rig of long films takes, in memory, on disk and in time.

A short synthetic clip is looped to the wanted length, once for each of some cameras, in the layout of
DyNeRF. Then ``forewarp-train`` fits particles to it for 200 steps and measures two views, in a process of
its own; twenty times a second the resident memory of it and of all that it has started is added up.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path

import imageio_ffmpeg

from forewarp.cli.entry import quiet
from forewarp.runs.config_files import project_root
from tests.stability.report import replace_section, table

SIZE, CAMERAS, CLIP = (1352, 1014), 20, 15  # pixels, films, and frames of the clip that is looped
FRAMES = (300, 1500, 6000)  # of all films together
STEPS = 200
GOAL = 3e9  # bytes
EVERY_S = 0.05
OTHERS = (
    (FRAMES[-1], CAMERAS, SIZE, True),
    (300, 5, SIZE),
    (300, CAMERAS, (338, 254)),
    (300, CAMERAS, (676, 506)),
)
_PAGE = os.sysconf("SC_PAGE_SIZE")


@dataclass
class Sampled:
    """Resident bytes of a process and its descendants over time, until it ends."""

    process: int
    rows: list[tuple[float, int]] = field(default_factory=list)
    ended: threading.Event = field(default_factory=threading.Event)

    def run(self) -> None:
        """Take samples until ``ended``. Pages that two processes share count twice."""
        while not self.ended.wait(EVERY_S):
            self.rows.append((time.time(), sum(map(resident, family(self.process)))))

    def peak(self, begin: float = 0.0, end: float = float("inf")) -> int:
        """Return the most bytes between two times; 0 where nothing was sampled."""
        return max((size for at, size in self.rows if begin <= at <= end), default=0)


def resident(process: int) -> int:
    """Return the resident bytes of a process; 0 where it has ended."""
    with suppress(OSError, IndexError):
        return int(Path(f"/proc/{process}/statm").read_text().split()[1]) * _PAGE
    return 0


def family(process: int) -> list[int]:
    """List a process and its descendants."""
    found = [process]
    for parent in found:
        with suppress(OSError):
            for task in Path(f"/proc/{parent}/task").iterdir():
                found += map(int, (task / "children").read_text().split())
    return found


def write_rig(
    folder: Path, frames: int, cameras: int, size: tuple[int, int], in_folders: bool = False
) -> None:
    """Write films of ``frames`` in all, or folders of JPEGs, ``size`` (width, height), and their poses."""
    from forewarp.data.multicam import write_poses
    from tests.support.written_scenes import fixed_cameras

    folder.mkdir(parents=True)
    clip, ffmpeg = folder / "clip.mp4", [imageio_ffmpeg.get_ffmpeg_exe(), "-y", "-v", "error"]
    source = f"testsrc2=size={size[0]}x{size[1]}:rate=30:duration={CLIP / 30}"
    coded = ["-pix_fmt", "yuv420p", "-c:v", "libx264", "-preset", "veryfast", "-crf", "20"]
    subprocess.run([*ffmpeg, "-f", "lavfi", "-i", source, *coded, str(clip)], check=True)
    again = ["-stream_loop", str(frames // cameras // CLIP - 1), "-i", str(clip), "-c", "copy"]
    for k in range(cameras):
        film = folder / f"cam{k:02d}.mp4"
        subprocess.run([*ffmpeg, *again, str(film)], check=True)
        if in_folders:
            film.with_suffix("").mkdir()
            subprocess.run([*ffmpeg, "-i", str(film), f"{film.with_suffix('')}/%04d.jpg"], check=True)
            film.unlink()
    clip.unlink()
    write_poses(folder, fixed_cameras(cameras, size[::-1]), near=14.0, far=30.0)


def fitted(answer: Path, overrides: Sequence[str]) -> None:
    """Be forewarp-train, and write down when films were decoded and when each step was done."""
    from forewarp.cli import train
    from forewarp.data.films import FilmStore
    from forewarp.training.module import DynamicSceneModule

    told, fill = {"steps": [], "decoded": [0.0, 0.0]}, FilmStore.fill

    def timed_fill(store, films):
        begin = time.time()
        fill(store, films)
        if time.time() - begin > told["decoded"][1] - told["decoded"][0]:
            told["decoded"] = [begin, time.time()]

    def stepped(module, *_):
        told["steps"].append(time.time())

    FilmStore.fill, DynamicSceneModule.on_train_batch_end = timed_fill, stepped
    sys.argv[1:] = overrides
    try:
        train.main()
    finally:
        answer.write_text(json.dumps(told))


def measure(frames: int, cameras: int, size: tuple[int, int], in_folders: bool = False) -> dict[str, float]:
    """Write, fit and score a rig in a temporary folder.

    Raises:
        ValueError: with what the command said, where it fails.
    """
    with tempfile.TemporaryDirectory(prefix="forewarp-memory-") as place:
        place = Path(place)
        write_rig(place / "scenes" / "loop", frames, cameras, size, in_folders)
        own = [
            "experiment=multicam",
            f"data.root={place}/scenes",
            "data.scene=loop",
            "data.scale=1",
            "views=2",
        ]
        own += ["budget.minutes=null", f"budget.iterations={STEPS}", "trainer=cpu", f"run={place}/runs/run"]
        answer, said = place / "answer.json", place / "said.txt"
        call = [sys.executable, "-m", "tests.bench.memory", "--fit", str(answer), *own]
        with said.open("w") as stream:
            process = subprocess.Popen(call, stdout=stream, stderr=stream)
            sampled = Sampled(process.pid)
            watch = threading.Thread(target=sampled.run)
            watch.start()
            status = process.wait()
            sampled.ended.set()
            watch.join()
        if status or not answer.is_file():
            raise ValueError(f"memory: expected a fitted run, but got {said.read_text()[-3000:]}")
        told, began = json.loads(answer.read_text()), sampled.rows[0][0]
        steps, (begin, end) = told["steps"], told["decoded"]
        stages = [json.loads(path.read_text()) for path in place.glob("runs/**/done.json")]
        disk = sum(path.stat().st_size for path in place.glob("runs/**/.frames/*"))
        return {
            "disk": disk,
            "decoding": end - begin if disk else 0.0,
            "to the first step": steps[0] - began - (end - begin if disk else 0.0),
            "step": sum(s["clocks"]["processor"] for s in stages) / sum(s["steps"] for s in stages),
            "peak before": sampled.peak(0.0, steps[0]),
            "peak training": sampled.peak(steps[0], steps[-1]),
            "peak scoring": sampled.peak(steps[-1]),
            "peak": sampled.peak(),
        }


def row(told: dict[str, float], frames: int, cameras: int, size: tuple[int, int], *images: bool) -> list[str]:
    """Write a case as a row."""
    peaks = [f"{told[f'peak {part}'] / 1e9:.2f}" for part in ("before", "training", "scoring")]
    shape = [
        f"{frames:,}{' JPEG' if images else ''}",
        str(cameras),
        f"{size[0]} x {size[1]}",
        f"{told['disk'] / 1e9:.1f}",
    ]
    times = [f"{told['decoding']:.0f}", f"{told['to the first step']:.0f}", f"{1e3 * told['step']:.0f}"]
    return [*shape, *times, *peaks]


HEAD = [
    "frames",
    "films",
    "pixels",
    "disk, GB",
    "decoding, s",
    "else to the first step, s",
    "a step, processor ms",
]
HEAD += ["GB before it", "in training", "after it"]


def memory_table(cases: Sequence[tuple] = ()) -> str:
    """Measure the cases, by default all; say whether the goal is reached."""
    rows, most = [], 0.0
    for case in cases or (*((frames, CAMERAS, SIZE) for frames in FRAMES), *OTHERS):
        told = measure(*case)
        rows.append(row(told, *case))
        most = max(most, told["peak"]) if case[1:] == (CAMERAS, SIZE) else most
        print(dict(zip(HEAD, rows[-1])), file=sys.stderr, flush=True)
    verdict = "reached" if most <= GOAL else "**missed**"
    said = f"The most at {SIZE[0]} x {SIZE[1]} and {CAMERAS} films is {most / 1e9:.2f} GB"
    return f"{table(HEAD, rows)}\n\n{said} (wanted: {GOAL / 1e9:g} GB, {verdict})."


def main(arguments: Sequence[str]) -> None:
    """Write the table into docs/results/performance.md; with ``--fit FILE OVERRIDES`` be what is measured."""
    if arguments[:1] == ["--fit"]:
        fitted(Path(arguments[1]), arguments[2:])
        return
    parser = argparse.ArgumentParser(prog="python -m tests.bench.memory", description=__doc__)
    parser.add_argument(
        "--frames", type=int, nargs="*", help="print rows of these at full size, write nothing"
    )
    given = parser.parse_args(arguments)
    quiet()
    text = memory_table([(frames, CAMERAS, SIZE) for frames in given.frames or ()])
    print(text)
    if not given.frames:
        replace_section(project_root() / "docs" / "results" / "performance.md", "memory", text)


if __name__ == "__main__":
    main(sys.argv[1:])
