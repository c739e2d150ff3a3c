"""Make a method, fit it to a small scene, and interrupt or kill its run."""

import os
import signal
from dataclasses import replace

import lightning
import torch

from forewarp.training.objective import Objective, set_gradients
from forewarp.training.schedule import StageSettings
from forewarp.training.stages import Stage
from tests.contract.scenes import data_of
from tests.contract.table import METHODS
from tests.support.tiny_scene import make_run


def stage_of(entry, name="fine", **changes):
    """Make a stage for an entry of the table, with ``changes`` to the entry."""
    entry = replace(entry, **changes)
    settings = StageSettings.of(name, lr=entry.lr, iterations=entry.steps, **entry.numbers)
    return Stage(settings, Objective(entry.weights), entry.model)


def run_of(stages, data, folder, *watchers, **options):
    """Make a silent run on the CPU."""
    return make_run(folder, stages, data=data, callbacks=watchers, **options)


def module_of(entry, data, **changes):
    """Make a module as it is at the beginning of its stage."""
    data.setup("fit")
    torch.manual_seed(0)
    stage = stage_of(entry, **changes)
    module = run_of([stage], data, ".")._module(stage)
    data.picker, data.asks = module.curriculum, module.method.asks
    return module


def batch_of(data):
    """Draw a batch."""
    return next(iter(data.train_dataloader()))


def gradients_of(module, batch):
    """Compute the gradients of a step, as training does, and return them."""
    module.zero_grad()
    loss, gradients = module.loss_of(batch)
    if gradients is None:
        loss.backward()
    else:
        set_gradients(module.method, gradients)
    return {name: p.grad for name, p in module.method.named_parameters() if p.grad is not None}


class Losses(lightning.Callback):
    """Record the loss of every step."""

    def __init__(self):
        self.values = []

    def on_train_batch_end(self, trainer, module, *_):
        self.values.append(module.last["loss"])


class Stop(lightning.Callback):
    """Save and exit after a step, like Ctrl-C."""

    def __init__(self, step):
        self.step = step

    def on_train_batch_end(self, trainer, module, *_):
        if module.global_step == self.step:
            next(c for c in trainer.callbacks if hasattr(c, "save")).save(trainer)
            raise SystemExit


class Die(Stop):
    """Kill the process after a step."""

    def on_train_batch_end(self, trainer, module, *_):
        if module.global_step == self.step:
            os.kill(os.getpid(), signal.SIGKILL)


def killed(name, dataset, root, folder, step, steps):
    """Start a run that is killed after a step; call it in a process of its own."""
    torch.set_num_threads(1)
    stages = [stage_of(METHODS[name], steps=steps)]
    run_of(stages, data_of(dataset, root), folder, Die(step), checkpoint_seconds=0.0).fit()
