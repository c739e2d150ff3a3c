"""Writes what a finished run leaves, without training anything."""

import json
import shlex
from pathlib import Path

import imageio.v3 as iio
import yaml

from forewarp.report.settings import words_of


def write_run(
    root,
    variant="base",
    seed=0,
    *,
    scene="ball",
    minutes=1.0,
    against="base",
    psnr=30.0,
    curve=((10, 20.0), (20, 25.0), (40, 25.5)),
    steps=100,
    epe=None,
    ability="all",
    command=None,
    config=None,
    metrics=None,
):
    """A run's folder; None for ``psnr`` or ``curve`` leaves out what would hold it.

    ``config`` and ``metrics`` are merged into what is written. None for ``against``: ``variant`` is no name,
    but what was typed.
    """
    folder = Path(root) / scene / f"{variant}-{minutes}-seed{seed}"
    (folder / "coarse").mkdir(parents=True)
    variant_of = {"name": variant, "about": f"the {variant}", "against": against} if against else None
    whole = {"data": {"scene": scene}, "model": {"name": "forward"}, "preset": {"name": "fast"}}
    whole |= {"budget": {"minutes": minutes}, "variant": variant_of, "seed": seed}
    words = [f"variant={variant}"] if against else words_of(variant)
    whole |= {"typed": {word.partition("=")[0]: word.partition("=")[2] for word in words if not against}}
    whole["command"] = command or shlex.join(["forewarp-train", *words, f"seed={seed}"])
    (folder / "config.yaml").write_text(yaml.safe_dump(whole | (config or {})))
    (folder / "coarse" / "done.json").write_text(json.dumps({"steps": steps, "seconds": 50.0}))
    if psnr is not None:
        numbers = {
            "protocol": {"device": "a cpu", "threads": 2, "versions": {"torch": "2"}},
            "seconds": {"train": 50.0, "render_per_frame": 0.5},
            "peak_memory_bytes": 2**30,
            "parameters": 2_000_000,
            "test": {ability: {"psnr": psnr, "ssim": 0.9}},
        }
        if epe is not None:
            numbers["flow"] = {"epe_moving": epe}
        more = metrics or {}
        numbers |= more | {"protocol": numbers["protocol"] | more.get("protocol", {})}
        (folder / "metrics.json").write_text(json.dumps(numbers))
    if curve is not None:
        lines = [f"{s},coarse,{s},{p},{'' if epe is None else epe},100" for s, p in curve]
        text = "\n".join(["seconds,stage,step,psnr,epe_moving,voxels", *lines])
        (folder / "accuracy_time.csv").write_text(text + "\n")
    return folder


def write_views(folder, views, sheet=None):
    """What was measured of test views, name -> (time, PSNR), and a sheet (H, W, 3) of each."""
    about = {"ability": "all"}
    images = [{"name": n, "time": t, "scores": {"psnr": psnr}} | about for n, (t, psnr) in views.items()]
    (folder / "per_image.json").write_text(json.dumps({"images": images}))
    for name in views if sheet is not None else ():
        file = folder / "images" / "sheets" / f"{name}.png"
        file.parent.mkdir(parents=True, exist_ok=True)
        iio.imwrite(file, sheet)


def rows_of(text, first):
    """The cells of a Markdown table's rows that begin with ``first``."""
    cells = [[cell.strip() for cell in line.split("|")[1:-1]] for line in text.splitlines()]
    return [row for row in cells if row[:1] == [first]]
