"""Draw the README's picture: the truth beside what each method made of it, a row for each scene.

    python docs/images/first_screen.py docs/images/methods.png runs/demo runs/first/hook

Each folder holds the measured runs ``particles``, ``forward`` and ``backward`` of one scene.
"""

import sys
from pathlib import Path

import numpy as np
from PIL import Image

from forewarp.report.figures import figure_of, save, sheets_of, thirds, view_near
from forewarp.report.results import read_compared

METHODS = ("particles", "forward", "backward")
NEAR = 0.5  # the time of the views that are shown


def main(out: str, *folders: str) -> None:
    """Draw a row for each folder into ``out``."""
    figure, axes = figure_of(len(folders), 1 + len(METHODS), (11, 2.9 * len(folders)))
    for line, folder in zip(axes, folders):
        runs = read_compared([Path(folder) / method for method in METHODS])
        view = view_near(runs, NEAR)
        sheets = [Image.open(sheets_of(row["folder"])[view]) for row in runs.values()]
        parts = [thirds(np.asarray(sheet) / 255) for sheet in sheets]
        psnr = [np.mean([image["scores"]["psnr"] for image in row["images"]]) for row in runs.values()]
        after = [row["metrics"]["seconds"]["train"] for row in runs.values()]
        titles = [f"{METHODS[i]}: {psnr[i]:.1f} dB, {after[i]:.0f} s" for i in range(len(METHODS))]
        pictures = {"truth": parts[0][0], **{titles[i]: parts[i][1] for i in range(len(METHODS))}}
        for axis, (title, picture) in zip(line, pictures.items()):
            axis.imshow(picture)
            axis.set_title(title, fontsize="small")
            axis.set_axis_off()
    save(figure, Path(out))


if __name__ == "__main__":
    main(*sys.argv[1:])
