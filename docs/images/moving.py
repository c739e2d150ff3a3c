"""Draw the README's moving picture: test views, what a run makes of them, and a flight around the scene.

python docs/images/moving.py runs/hook/particles-fast-seed0 docs/images/hook.gif
"""

import sys
from pathlib import Path

import imageio.v3 as imageio
import numpy as np
import torch
from PIL import Image, ImageDraw, ImageFont

import forewarp

SIDE, FOOT = 270, 26  # pixels of a picture's side and of the line below it
SHOWN = 0.95  # share of a picture's side that is shown, around its middle
HELD, FPS = 6, 15  # frames for which a test view stays; frames a second
RISE = 0.35  # height of the flight, as a share of its distance
COLORS = 128


def columns(scene) -> list[list[np.ndarray]]:
    """Return truth, prediction and flight: as many pictures (SIDE, SIDE, 3) uint8 of each."""
    views = scene.frames("test")
    truth = [_cut(_over_white(view.load())) for view in views]
    drawn = [_cut(_bytes(scene.render(view).rgb)) for view in views]
    flight = [_cut(_bytes(scene.render(pose, time).rgb)) for pose, time in _flight(scene, HELD * len(views))]
    return [[p for p in truth for _ in range(HELD)], [p for p in drawn for _ in range(HELD)], flight]


def _flight(scene, count: int):
    """Yield poses once around the scene, z upwards, and times there and back again."""
    middle = scene.focus.numpy()
    away = np.mean([np.linalg.norm(camera.center.numpy() - middle) for camera in scene.cameras])
    for i in range(count):
        turn = 2 * np.pi * i / count
        aside = np.array([np.cos(turn), np.sin(turn), RISE])
        pose = forewarp.look_at(middle + away * aside / np.linalg.norm(aside), middle, up=[0, 0, 1])
        yield pose, 1 - abs(1 - 2 * i / count)


def strip(pictures: tuple[np.ndarray, ...], titles: list[str]) -> Image.Image:
    """Put pictures side by side, each above its title."""
    sheet = Image.new("RGB", (SIDE * len(pictures), SIDE + FOOT), "white")
    draw, font = ImageDraw.Draw(sheet), ImageFont.load_default(14)
    for i, (picture, title) in enumerate(zip(pictures, titles)):
        sheet.paste(Image.fromarray(picture), (i * SIDE, 0))
        draw.text(((i + 0.5) * SIDE, SIDE + FOOT / 2), title, "#333", font, anchor="mm")
    return sheet


def main(run: str, out: str) -> None:
    """Render a run with test views and write the picture."""
    scene = forewarp.load(run)
    psnr = np.mean([values["psnr"] for values in scene.metrics["test"].values()])
    seconds = scene.metrics["seconds"]["train"]
    titles = ["unseen views: truth", f"after {seconds:.0f} s: {psnr:.1f} dB", "from anywhere, at any time"]
    sheets = [strip(pictures, titles) for pictures in zip(*columns(scene))]
    palette = Image.fromarray(np.concatenate([np.asarray(sheet) for sheet in sheets[::7]])).quantize(COLORS)
    palette.putpalette([255 if value > 248 else value for value in palette.getpalette()])  # keep white white
    frames = [sheet.quantize(palette=palette, dither=Image.Dither.NONE) for sheet in sheets]
    frames[0].save(out, save_all=True, append_images=frames[1:], duration=1000 / FPS, loop=0, optimize=True)
    print(f"written: {out}, {Path(out).stat().st_size / 1e6:.2f} MB, {len(imageio.imread(out))} frames")


def _bytes(picture: torch.Tensor) -> np.ndarray:
    return (255 * picture).round().byte().numpy()


def _over_white(picture: torch.Tensor) -> np.ndarray:
    color, alpha = picture[..., :3].double(), picture[..., 3:].double() / 255
    return (color * alpha + 255 * (1 - alpha)).round().byte().numpy()


def _cut(picture: np.ndarray) -> np.ndarray:
    edge = (1 - SHOWN) / 2 * picture.shape[0]
    box = (edge, edge, picture.shape[1] - edge, picture.shape[0] - edge)
    return np.asarray(Image.fromarray(picture).resize((SIDE, SIDE), Image.Resampling.LANCZOS, box))


if __name__ == "__main__":
    main(*sys.argv[1:])
