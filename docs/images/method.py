"""Draw docs/images/method.png: one idea, a canonical scene moved forward, as voxels and as particles.

    python docs/images/method.py

A flat arm bends about its left end. Splat, curves and the shapes of ellipses are computed.
"""

from pathlib import Path

import numpy as np
from matplotlib.figure import Figure
from matplotlib.patches import Ellipse

SIDE, WIDE = 22, 0.13  # cells along the side of the lattice; half the arm's width
TURN = 0.95  # radians that the arm's end turns by
BLUE, RED, GREY = "#31688e", "#d1495b", "0.82"
TITLES = ("canonical scene", "trajectories", "the scene at a time", "a picture")


def bend(points: np.ndarray, time: float = 1.0) -> np.ndarray:
    """Move points (N, 2): the farther along the arm, the farther it turns."""
    angle = time * TURN * np.clip(points[:, 0] - 0.1, 0, 1)
    along, up = points[:, 0] - 0.1, points[:, 1] - 0.3
    turned = np.stack(
        [along * np.cos(angle) - up * np.sin(angle), along * np.sin(angle) + up * np.cos(angle)], -1
    )
    return turned + [0.1, 0.3]


def splat(points: np.ndarray) -> np.ndarray:
    """Average bilinear splat of ones: the coverage (SIDE, SIDE) of each cell."""
    cover = np.zeros((SIDE, SIDE))
    low = np.floor(points * SIDE - 0.5).astype(int)
    part = points * SIDE - 0.5 - low
    for dx, dy in ((0, 0), (0, 1), (1, 0), (1, 1)):
        weight = (part[:, 0] if dx else 1 - part[:, 0]) * (part[:, 1] if dy else 1 - part[:, 1])
        np.add.at(cover, tuple(np.clip(low + [dx, dy], 0, SIDE - 1).T), weight)
    return np.clip(cover, 0, 1).T


def lattice(axis, filled: np.ndarray) -> None:
    """Show cells (SIDE, SIDE) and the lattice's lines."""
    axis.imshow(filled, origin="lower", extent=(0, 1, 0, 1), cmap="Blues", vmin=0, vmax=1.6)
    for line in np.linspace(0, 1, SIDE + 1):
        axis.axhline(line, color=GREY, lw=0.3)
        axis.axvline(line, color=GREY, lw=0.3)


def ellipses(axis, points: np.ndarray, *, moved: bool, radii=(0.062, 0.034)) -> None:
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
        axis.annotate("", curve[-1], curve[-3], arrowprops={"arrowstyle": "->", "color": RED, "lw": 1})
    axis.plot(*points.T, "o", **style)


def camera(axis, *, tiles: bool) -> None:
    """Draw a camera at the right; ``tiles``: a picture plane of tiles, else rays with samples."""
    eye = np.array([1.22, 0.55])
    ends = np.stack([np.full(5, 0.05), np.linspace(0.05, 0.98, 5)], -1)
    if tiles:
        plane = eye + 0.28 * (np.stack([np.full(9, 0.05), np.linspace(0.05, 0.98, 9)], -1) - eye)
        for tile, (begin, end) in enumerate(zip(plane, plane[1:])):
            axis.plot(*np.stack([begin, end]).T, color=("black", RED)[tile % 2], lw=4)
        axis.plot(*np.stack([eye, plane[0]]).T, *np.stack([eye, plane[-1]]).T, color="black", lw=0.6)
    else:
        for end in ends:
            line = eye + np.linspace(0.18, 1, 26)[:, None] * (end - eye)
            axis.plot(*np.stack([eye, end]).T, color="black", lw=0.6)
            axis.plot(*line.T, ".", color="black", ms=2.5)
    axis.plot(*eye, "k<", ms=9)


def main() -> None:
    """Draw both rows."""
    figure = Figure(figsize=(12, 6.4), layout="constrained")
    axes = figure.subplots(2, 4)
    cells = np.stack(np.meshgrid(*[(np.arange(SIDE) + 0.5) / SIDE] * 2), -1).reshape(-1, 2)
    cells = cells[(abs(cells[:, 1] - 0.3) < WIDE) & (cells[:, 0] > 0.1) & (cells[:, 0] < 0.9)]
    still = np.zeros((SIDE, SIDE))
    still[tuple((cells[:, ::-1] * SIDE).astype(int).T)] = 1
    spots = np.stack(np.meshgrid(np.linspace(0.14, 0.86, 9), 0.3 + np.linspace(-0.11, 0.11, 4)), -1).reshape(
        -1, 2
    )
    spots += np.random.default_rng(0).normal(0, 0.008, spots.shape)
    nodes = np.stack([np.linspace(0.16, 0.84, 5), np.full(5, 0.3)], -1)
    lattice(axes[0, 0], still)
    lattice(axes[0, 1], 0.4 * still)
    some = np.isin((cells[:, 0] * SIDE).astype(int), (4, 9, 14, 18)) & (abs(cells[:, 1] - 0.3) < 0.05)
    paths(axes[0, 1], cells[some], color=BLUE, ms=2)
    for column in (2, 3):
        lattice(axes[0, column], splat(bend(cells)))
        ellipses(axes[1, column], spots, moved=True)
    ellipses(axes[1, 0], spots, moved=False)
    ellipses(axes[1, 1], spots, moved=False, radii=(0.03, 0.017))
    paths(axes[1, 1], nodes, color="black", ms=6)
    camera(axes[0, 3], tiles=False)
    camera(axes[1, 3], tiles=True)
    below = (
        (
            "voxels on a lattice",
            "a curve for each voxel",
            "average splat onto a lattice",
            "march rays through it",
        ),
        (
            "Gaussians",
            "curves of place and turn for each node",
            "blends of the nodes' rigid maps",
            "composite in tiles",
        ),
    )
    for row, texts in zip(axes, below):
        for axis, text in zip(row, texts):
            axis.set(xlim=(0, 1.27), ylim=(0, 1), aspect="equal", xticks=[], yticks=[])
            axis.set_xlabel(text)
            axis.spines[:].set_visible(False)
    for axis, title in zip(axes[0], TITLES):
        axis.set_title(title)
    axes[0, 0].set_ylabel("model=forward")
    axes[1, 0].set_ylabel("model=particles")
    figure.savefig(Path(__file__).with_suffix(".png"), dpi=100)


if __name__ == "__main__":
    main()
