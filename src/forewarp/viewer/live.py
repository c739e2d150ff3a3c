"""See a run while it trains."""

from __future__ import annotations

import contextlib
import time
import traceback
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import lightning
import torch

from forewarp.training.stages import Run
from forewarp.viewer.server import served
from forewarp.viewer.studio import Studio
from forewarp.viewer.subject import Subject

_EVERY = 2.0  # seconds between two pictures of a page at rest
_FRESH = 20.0  # seconds after which points of trajectories are chosen anew


class LiveView(lightning.Callback):
    """Draw what pages ask for between two steps, one picture a step, while the training clock is stopped.

    The run's numbers are the same as without: nothing is changed, and random numbers are put back.

    Args:
        studio: what pages see.
        name: what they call the run.

    Cost: a step reads the clock, and asks whether a page wants something.
    """

    def __init__(self, studio: Studio, name: str) -> None:
        self.studio, self.name = studio, name
        self._last = float("-inf")

    def on_train_start(self, trainer, module) -> None:
        """Show the method of this stage from now on."""
        self.studio.subjects = [Subject(self.name, module, trainer.datamodule, fresh=_FRESH)]
        self._each_page(module, lambda page: page.build())
        self._last = float("-inf")

    def on_train_batch_end(self, trainer, module, outputs, batch, batch_idx) -> None:
        """Draw one picture, if one is asked for."""
        studio, now = self.studio, time.monotonic()
        if now - self._last > _EVERY:
            self._last = now
            studio.note = f"{module.settings.name} {module.fraction:.0%}, step {module.global_step}"
            self._each_page(module, lambda page: (page.build(), page.visit.refresh()))
        if studio.desk.is_due():
            with module.clock.paused(), torch.random.fork_rng(devices=[]):
                studio.subjects[0].forget()
                studio.desk.serve()

    def on_train_end(self, trainer, module) -> None:
        """Say that there is nothing new to see."""
        self.studio.note = f"{module.settings.name} has ended; what follows is not shown"
        self._each_page(module, lambda page: page.tell(self.studio.note))

    def _each_page(self, module, do: Callable[[Any], object]) -> None:
        """Do something with every page while the training clock is stopped; what goes wrong with one is told
        on stderr and ends no training.
        """
        pages = self.studio.pages
        with module.clock.paused() if pages else contextlib.nullcontext():
            for page in pages:
                try:
                    do(page)
                except Exception as error:
                    traceback.print_exception(error)


@contextlib.contextmanager
def live(run: Run, *, host: str, port: int) -> Iterator[None]:
    """Serve a page of a run whose stages are trained within; says where it is.

    Raises:
        ValueError: if nothing can listen there.
    """
    folder = Path(run.folder)
    studio = Studio(run.datamodule.scene)
    studio.note = "waiting for the first step"
    before = run.callbacks
    title = f"{studio.scene.name} | {folder.name}, in training"
    with served(studio, host=host, port=port, title=title, folder=folder / "videos") as address:
        run.tell(f"see it: {address}")
        run.callbacks = lambda name, where: [*before(name, where), LiveView(studio, folder.name)]
        try:
            yield
        finally:
            run.callbacks = before
    run.tell(f"see it again: forewarp-view run={folder}")
