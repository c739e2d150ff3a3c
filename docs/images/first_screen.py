"""Draw the README's picture: the truth beside what each method made of it, a row for each scene.

    python docs/images/first_screen.py docs/images/methods.png runs/demo runs/first/hook

Each folder holds the measured runs ``particles``, ``forward`` and ``backward`` of one scene.
"""

import sys
from pathlib import Path

from forewarp.files import read_json
from forewarp.report.compare import read_metrics
from forewarp.report.sheets import figure_of, read_picture, sheets_of, show, thirds

METHODS = ("particles", "forward", "backward")
NEAR = 0.5  # the time of the views that are shown


def row_of(folder: Path) -> dict:
    """Return the pictures of a scene's view nearest to ``NEAR``: title -> (H, W, C)."""
    sheets = {method: sheets_of(folder / method) for method in METHODS}
    times = {
        image["name"]: image["time"] for image in read_json(folder / METHODS[0] / "per_image.json")["images"]
    }
    shared = set.intersection(*map(set, sheets.values()))
    view = min(sorted(shared), key=lambda name: abs(times[name] - NEAR))
    parts = {method: thirds(read_picture(sheets[method][view])) for method in METHODS}
    return {"truth": parts[METHODS[0]][0]} | {about(folder / m, m): parts[m][1] for m in METHODS}


def about(run: Path, method: str) -> str:
    """Say how good a run is, and after how long."""
    metrics = read_metrics(run)
    psnr = [image["scores"]["psnr"] for image in read_json(run / "per_image.json")["images"]]
    return f"{method}: {sum(psnr) / len(psnr):.1f} dB, {metrics['seconds']['train']:.0f} s"


def main(out: str, *folders: str) -> None:
    """Draw a row for each folder into ``out``."""
    rows = [row_of(Path(folder)) for folder in folders]
    figure, axes = figure_of(len(rows), 1 + len(METHODS), (11, 2.9 * len(rows)))
    for line, pictures in zip(axes, rows):
        show(line, pictures)
    figure.savefig(out, dpi=100)


if __name__ == "__main__":
    main(*sys.argv[1:])
