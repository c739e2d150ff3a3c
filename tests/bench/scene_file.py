"""What ``scene.glb`` costs: bytes, and PSNR of test views rendered from the file and by the run.

.venv/bin/python -m tests.bench.scene_file runs/hook runs/lego
"""

import sys
import tempfile
import zlib
from pathlib import Path
from statistics import fmean

import torch

from forewarp.export.formats import write
from forewarp.export.tracks import Source, no_progress
from forewarp.metrics.image import psnr
from forewarp.runs.config import saved_config
from forewarp.runs.fitted import open_file, opened
from forewarp.scene.view import Moment, View


def row(folder: str) -> str:
    """Write a run's file, and compare: a row of the table."""
    from omegaconf import OmegaConf

    run, module = opened(saved_config(folder, OmegaConf.create({"trust": []})))
    scene, targets = run.datamodule.scene, run.datamodule.targets("test")
    background = tuple(targets.background.tolist())
    cameras, times = zip(*((frame.camera, frame.time) for frame in scene.train))
    source = Source(module, "particles", cameras, [0.0], background, image_times=times)
    sizes, values = [], []
    with tempfile.TemporaryDirectory() as out:
        for quality in ("compact", "lossless"):
            about = write("glb", source, Path(out) / quality, {}, no_progress, quality=quality, seconds=4.0)
            file = Path(out) / quality / "scene.glb"
            sizes += [file.stat().st_size, len(zlib.compress(file.read_bytes(), 9))]
            if quality == "compact":
                count, held = about["particles"], open_file(file).gaussians
    for target in (targets[i] for i in range(len(targets))):
        images, view = [], View(target.frame.camera)
        with torch.no_grad():
            for shown in (module.method, held):
                drawn = shown.at(Moment(target.frame.time)).render(view, target.background)
                images.append(drawn.rgb.clamp(0, 1).reshape(target.rgb.shape))
        values.append([psnr(image, target.rgb) for image in images] + [psnr(*images)])
    of_run, of_file, apart = (fmean(column) for column in zip(*values))
    compact, deflated, lossless, _ = (f"{size / 1e6:.3f}" for size in sizes)
    numbers = f"{of_run:.2f} | {of_file:.2f} | {of_file - of_run:+.3f} | {apart:.1f}"
    return f"| {scene.name} | {count:,} | {compact} | {deflated} | {lossless} | {numbers} |"


if __name__ == "__main__":
    torch.set_num_threads(1)
    print("| scene | particles | MB | deflated | lossless | run, dB | file, dB | lost | file to run, dB |")
    print("|---|---:|---:|---:|---:|---:|---:|---:|---:|")
    for name in sys.argv[1:]:
        print(row(name), flush=True)
