"""``python -m tests.bench.ends RUN``: what the first and the last test view of a run with particles lack.

The motion alone is trained on, by the training pictures nearest to an end of time: once by them, once by the
test view of the end, too. If pictures and view can then be had together, a smooth motion could show both, and
the pictures alone do not tell which; what the first gains shows whether there was time enough. The run's
folder is not changed.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence

import torch

from forewarp import load
from forewarp.methods.particles.model import Particles
from forewarp.scene.frame import Frame, Scene
from forewarp.scene.view import Batch, Moment, Observation, View
from forewarp.training.module import DynamicSceneModule
from tests.stability.report import table

STEPS, PICTURES, SHOWN = 1200, 14, 4
RATES = {"shifts": 1e-3, "node_turns": 1e-3, "skin": 1e-3, "time_offsets": 0.03}
FALL, SHARE = 0.1, 1 / 8  # what is left of the rates; of the steps, those by the test view
WHITE = torch.ones(3)


def sorted_from(frames: Sequence[Frame], last: bool) -> list[Frame]:
    """Frames by their distance from an end of time."""
    return sorted(frames, key=lambda frame: frame.time, reverse=last)


def refit(
    module: DynamicSceneModule, scene: Scene, last: bool, view: Frame | None, steps: int = STEPS
) -> None:
    """Train the motion on, by the pictures nearest to an end of time, and by a test view if there is one.

    Raises:
        ValueError: for another method than particles that move.
    """
    method = module.method
    if not isinstance(method, Particles) or not method.moves:
        raise ValueError("ends: expected a run of particles that move")
    method.progress = 1.0  # no picture's time is shifted at random any more
    groups = [(RATES[name], p) for name, ps in method.param_groups().items() if name in RATES for p in ps]
    names = {id(p): name for name, p in method.named_parameters()}
    optimizer = torch.optim.Adam([{"params": [p], "lr": rate} for rate, p in groups], betas=(0.9, 0.99))
    scheduler = torch.optim.lr_scheduler.ExponentialLR(optimizer, FALL ** (1 / steps))
    pictures = [observed(frame) for frame in sorted_from(scene.train, last)[:PICTURES]]
    unseen, draw = None if view is None else observed(view), torch.Generator().manual_seed(0)
    for _ in range(steps):
        by_view = float(torch.rand((), generator=draw)) < SHARE
        picture = pictures[int(torch.randint(len(pictures), (), generator=draw))]
        batch = Batch((unseen if by_view and unseen is not None else picture,), 0)
        found = module.look(batch, module.objective.factors(0)).gradients
        for _, p in groups:
            p.grad = found.get(names[id(p)])
        optimizer.step()
        scheduler.step()


def observed(frame: Frame) -> Observation:
    """What a frame shows, as particles ask for it."""
    return Observation(
        Moment(frame.time), View(frame.camera), frame.load().reshape(-1, 4).contiguous(), WHITE
    )


@torch.no_grad()
def psnr(method: Particles, frame: Frame) -> float:
    """PSNR of a picture over white, dB."""
    rgb, alpha = (frame.load().reshape(-1, 4).float() / 255).split([3, 1], -1)
    drawn = method.at(Moment(frame.time)).render(View(frame.camera), WHITE).rgb.reshape(-1, 3)
    return -10 * float(torch.log10((drawn.clamp(0, 1) - torch.lerp(WHITE, rgb, alpha)).square().mean()))


def report(run: str, steps: int = STEPS) -> str:
    """Make the table of both ends of a run."""
    rows = []
    for last in (False, True):
        for way in ("as it is", "trained on", "trained on, by the test view too"):
            opened = load(run)
            module, scene = opened.module, opened.scene
            view, next_view = sorted_from(scene.test, last)[:2]
            if way != "as it is":
                refit(module, scene, last, view if "too" in way else None, steps)
            shown = (view, next_view, *sorted_from(scene.train, last)[:SHOWN])
            cells = [f"{psnr(module.method, frame):.1f}" for frame in shown]
            rows.append(["last" if last else "first", way, *cells])
    names = ["test view", "the next", "training picture", *(f"{i} away" for i in range(1, SHOWN))]
    return table(["end of time", "motion", *names], rows)


def main(arguments: Sequence[str]) -> None:
    """Print the table of a run's folder."""
    if len(arguments) != 1:
        sys.exit("usage: python -m tests.bench.ends RUN")
    print(report(arguments[0]))


if __name__ == "__main__":
    main(sys.argv[1:])
