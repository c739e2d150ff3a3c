"""Draw docs/images/method.svg: one idea, a canonical scene moved forward, as voxels and as particles.

    python docs/images/method.py

A flat arm bends about its left end, and its middle is drawn out. Splats, curves and ellipses are computed.
"""

from pathlib import Path

import matplotlib
import numpy as np
from matplotlib.figure import Figure
from matplotlib.patches import Ellipse

SIDE, WIDE = 20, 0.1  # cells along the side of the lattice; half the arm's width
TURN = 0.8  # radians that the arm's end turns by
DRAWN = 0.28  # by how much the arm grows longer, all of it between the next two
MIDDLE = (0.3, 0.5)
ROOT, TIP = 0.1, 0.7  # where the arm begins and ends
BLUE, RED, GREY = "#31688e", "#d1495b", "0.82"
WHOLE = (0, 1.2)  # across, with the camera


def bend(points: np.ndarray, time: float = 1.0) -> np.ndarray:
    """Move points (N, 2): the farther along the arm, the farther it turns."""
    along, up = points[:, 0] - ROOT, points[:, 1] - 0.25
    angle = time * TURN * np.clip(along, 0, 1)
    along = along + time * DRAWN * np.clip((points[:, 0] - MIDDLE[0]) / (MIDDLE[1] - MIDDLE[0]), 0, 1)
    turned = np.stack(
        [along * np.cos(angle) - up * np.sin(angle), along * np.sin(angle) + up * np.cos(angle)], -1
    )
    return turned + [ROOT, 0.25]


def grid(side: int) -> np.ndarray:
    """Return the centres (N, 2) of the arm's cells on a lattice."""
    cells = np.stack(np.meshgrid(*[(np.arange(side) + 0.5) / side] * 2), -1).reshape(-1, 2)
    return cells[(abs(cells[:, 1] - 0.25) < WIDE) & (cells[:, 0] > ROOT) & (cells[:, 0] < TIP)]


def covered(points: np.ndarray, side: int) -> np.ndarray:
    """Return which cells (side, side) a dense cloud of points fills: 1 or 0."""
    counts, *_ = np.histogram2d(*points.T, bins=side, range=[[0, 1], [0, 1]])
    return np.where(counts > 0.25 * np.median(counts[counts > 0]), 1.0, 0.0).T


def splat(points: np.ndarray, side: int = SIDE) -> np.ndarray:
    """Bilinear splat of ones: the coverage (side, side) of each cell, at most 1."""
    cover = np.zeros((side, side))
    low = np.floor(points * side - 0.5).astype(int)
    part = points * side - 0.5 - low
    for dx, dy in ((0, 0), (0, 1), (1, 0), (1, 1)):
        weight = (part[:, 0] if dx else 1 - part[:, 0]) * (part[:, 1] if dy else 1 - part[:, 1])
        np.add.at(cover, tuple(np.clip(low + [dx, dy], 0, side - 1).T), weight)
    return np.clip(cover, 0, 1).T


def finer(cover: np.ndarray) -> np.ndarray:
    """Read a lattice (N, N) linearly at the centres of one twice as fine (2N, 2N)."""
    side = len(cover)
    old, new = np.arange(side), (np.arange(2 * side) - 0.5) / 2
    wide = np.stack([np.interp(new, old, row) for row in cover])
    return np.stack([np.interp(new, old, column) for column in wide.T]).T


def lattice(axis, filled: np.ndarray, **style) -> None:
    """Show cells (N, N), and the lattice's lines."""
    shown = {"cmap": "Blues", "vmin": 0, "vmax": 1.6} | style
    axis.imshow(filled, origin="lower", extent=(0, 1, 0, 1), interpolation="nearest", **shown)
    lines = np.repeat(np.linspace(0, 1, len(filled) + 1), 3)
    ends = np.tile([0, 1, np.nan], len(filled) + 1)
    axis.plot(np.concatenate([lines, ends]), np.concatenate([ends, lines]), color=GREY, lw=0.3)


def ellipses(axis, points: np.ndarray, *, moved: bool, radii=(0.055, 0.034)) -> None:
    """Draw a Gaussian at each canonical point, moved, turned and stretched by the warp's slopes."""
    for point in points:
        near = point + 1e-4 * np.array([[0, 0], [1, 0], [0, 1]])
        place = bend(near) if moved else near
        slopes = np.stack([place[1] - place[0], place[2] - place[0]], -1) / 1e-4 * radii
        axes, size, _ = np.linalg.svd(slopes)
        angle = np.degrees(np.arctan2(axes[1, 0], axes[0, 0]))
        axis.add_patch(Ellipse(place[0], *(2 * size), angle=angle, fc=BLUE, ec="white", lw=0.6, alpha=0.55))


def paths(axis, points: np.ndarray, **style) -> None:
    """Draw the trajectories of points, with arrows at their ends."""
    curves = np.stack([bend(points, time) for time in np.linspace(0, 1, 25)], 1)
    for curve in curves:
        axis.plot(*curve.T, color=RED, lw=1)
        if np.ptp(curve, axis=0).max() > 0.02:
            axis.annotate("", curve[-1], curve[-3], arrowprops={"arrowstyle": "->", "color": RED, "lw": 1})
    axis.plot(*points.T, "o", **style)


def camera(axis, *, tiles: bool) -> None:
    """Draw a camera at the right; ``tiles``: a picture plane of tiles, else rays with samples."""
    eye = np.array([1.16, 0.5])
    if tiles:
        plane = np.stack([np.full(9, 1.0), np.linspace(0.3, 0.7, 9)], -1)
        for tile, (begin, end) in enumerate(zip(plane, plane[1:])):
            axis.plot(*np.stack([begin, end]).T, color=("black", RED)[tile % 2], lw=4)
        axis.plot(*np.stack([eye, plane[0]]).T, *np.stack([eye, plane[-1]]).T, color="black", lw=0.6)
    else:
        for end in np.stack([np.full(4, 0.03), np.linspace(0.05, 0.9, 4)], -1):
            line = eye + np.linspace(0.14, 1, 30)[:, None] * (end - eye)
            axis.plot(*np.stack([eye, end]).T, color="black", lw=0.6)
            axis.plot(*line.T, ".", color="black", ms=2)
    axis.plot(*eye, "k<", ms=7)


def voxels(axes) -> None:
    """Draw the six steps of the voxel method."""
    cells, dense = grid(SIDE), grid(8 * SIDE)
    still, torn = splat(cells), splat(bend(cells))
    fine, whole = finer(torn), covered(bend(dense), 2 * SIDE)
    for axis, filled in zip(axes, (still, 0.35 * still, torn, fine, fine, whole)):
        lattice(axis, filled)
    ends = np.isin((cells[:, 0] * SIDE).astype(int), (4, 8, 11, 13)) & (abs(cells[:, 1] - 0.25) < 0.08)
    paths(axes[1], cells[ends], color=BLUE, ms=2)
    gaps = np.ma.masked_less(0.6 * (whole - fine), 0.2)
    axes[4].imshow(gaps, origin="lower", extent=(0, 1, 0, 1), cmap="Reds", vmin=0, vmax=1.6)
    camera(axes[5], tiles=False)


def particles(axes) -> None:
    """Draw the three steps of particles."""
    spots = np.meshgrid(np.linspace(ROOT + 0.04, TIP - 0.04, 8), 0.25 + np.linspace(-0.1, 0.1, 4))
    spots = np.stack(spots, -1).reshape(-1, 2)
    spots += np.random.default_rng(0).normal(0, 0.008, spots.shape)
    nodes = np.stack([np.linspace(ROOT + 0.06, TIP - 0.06, 5), np.full(5, 0.25)], -1)
    ellipses(axes[0], spots, moved=False)
    ellipses(axes[1], spots, moved=False, radii=(0.026, 0.017))
    paths(axes[1], nodes, color="black", ms=5)
    ellipses(axes[2], spots, moved=True)
    camera(axes[2], tiles=True)


TEXTS = (
    ("1  canonical voxels", "density and colour"),
    ("2  trajectories", "a curve for each voxel"),
    ("3  splat", "onto a lattice; gaps open"),
    ("4  up-sample", "a finer lattice"),
    ("5  inpaint", "a 3D U-Net fills gaps"),
    ("6  render", "rays march through it"),
    ("1  Gaussians", "places, shapes, colours"),
    ("2  trajectories", "of nodes, turning too"),
    ("3  move and draw", "composited in tiles"),
)


def main() -> None:
    """Draw both methods."""
    matplotlib.rcParams.update({"svg.hashsalt": "forewarp", "svg.fonttype": "none", "font.size": 10})
    figure = Figure(figsize=(6.6, 7.2), layout="constrained")
    axes = figure.subplots(3, 3).ravel()
    voxels(axes[:6])
    particles(axes[6:])
    for axis, (title, below) in zip(axes, TEXTS):
        axis.set(xlim=WHOLE, ylim=(0, 1), aspect="equal", xticks=[], yticks=[])
        axis.set_title(title, loc="left", fontsize=11, fontweight="bold")
        axis.set_xlabel(below, loc="left")
        axis.spines[:].set_visible(False)
        axis.set_rasterization_zorder(2.5)  # all but words and arrows: as paths they are thousands of lines
    for axis, name in zip(axes[::3], ("model=forward", "model=forward", "model=particles")):
        axis.set_ylabel(name)
    figure.savefig(Path(__file__).with_suffix(".svg"), dpi=150, metadata={"Date": None})


if __name__ == "__main__":
    main()
