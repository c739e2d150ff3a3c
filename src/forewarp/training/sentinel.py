"""The sentinel: stop a stage at the first number that is not finite, and store that step to look at."""

from __future__ import annotations

import math
from collections.abc import Iterable
from functools import partial
from pathlib import Path

import lightning
import torch
from torch import Tensor
from torch.nn.utils import get_total_norm

from forewarp.archives import write_archive
from forewarp.methods.method import check_least
from forewarp.scene.view import Batch
from forewarp.training.module import DynamicSceneModule
from forewarp.training.objective import parts


class BrokenStep(ValueError):
    """A step produced a number that is not finite."""


def all_finite(tensors: Iterable[Tensor]) -> bool:
    """Check that the sum of squares of all tensors is finite.

    Cost: one pass in a few fused calls and one wait for a GPU: 0.4 ms a million floats.
    """
    tensors = [t.detach() for t in tensors if t.numel()]
    return bool(get_total_norm(tensors).isfinite())


def first_bad(named: Iterable[tuple[str, Tensor | None]], squared: bool = False) -> str | None:
    """Return the name of the first tensor with an entry (or, if ``squared``, a square) that is not finite."""
    for name, tensor in named:
        if tensor is not None and tensor.is_floating_point():
            values = tensor.detach().square() if squared else tensor.detach()
            if not bool(values.isfinite().all()):
                return name
    return None


def diagnose(module: DynamicSceneModule, batch: Batch, number: int) -> str | None:
    """Repeat step ``number`` up to its gradients and name what is not finite; None if nothing is.

    A gradient counts as broken once its square overflows, as Adam stores squares. Reset the module's
    generator to its state before the step; weights and gradients do not change.
    """
    parameters = dict(module.method.named_parameters())
    if name := first_bad(parameters.items()):
        return f"parameter: {name}"
    factors = module.objective.factors(number)
    step = module.look(batch, factors)
    terms = parts(step, factors)
    bad = [name for name, (value, _) in terms.items() if not bool(value.isfinite().all())]
    if bad:
        name = first_bad([*_inputs(batch), *step.tensors()]) or f"the term {bad[0]}"
        return f"loss: {name} (terms {', '.join(bad)})"
    if step.gradients is not None:  # the method's own, of all terms together
        name = first_bad(step.gradients.items(), squared=True)
        return name and f"gradient: {name}"
    learn = {name: value * factor for name, (value, factor) in terms.items() if value.requires_grad}
    gradients_of = partial(torch.autograd.grad, retain_graph=True, allow_unused=True)
    by_all = gradients_of(list(learn.values()), list(parameters.values())) if learn else ()
    if (name := first_bad(zip(parameters, by_all), squared=True)) is None:
        return None
    by_term = [(term, *gradients_of(value, parameters[name])) for term, value in learn.items()]
    guilty = [term for term, gradient in by_term if first_bad([(term, gradient)], squared=True)]
    return f"gradient: {name}" + (f" (terms {', '.join(guilty)})" if guilty else "")


def _inputs(batch: Batch) -> Iterable[tuple[str, Tensor | None]]:
    """Yield the colours and rays of a batch by name."""
    for number, seen in enumerate(batch.observations):
        rays = seen.view.rays()
        named = {"rgb": seen.rgb, "background": seen.background}
        named |= {"rays.origins": rays.origins, "rays.directions": rays.directions}
        yield from ((f"batch[{number}].{name}", tensor) for name, tensor in named.items())


class Sentinel(lightning.Callback):
    """Check the loss and gradients of every step, the parameters now and then, and all before a checkpoint.

    A number that is not finite ends the stage. The step's batch and weights are stored as
    ``broken/step_<n>.pt``, for ``torch.load``, and the last checkpoint stays as it is.

    Args:
        folder: the stage's folder.
        skip: number of broken steps to skip instead: store each, count it in ``skipped``, learn nothing.
        every: steps between two checks of the parameters, which only broken gradients can break.

    Raises:
        ValueError: for a ``skip`` that is not a whole number >= 0.
    """

    def __init__(self, folder: Path, *, skip: int = 0, every: int = 10) -> None:
        check_least(of="sentinel", skip=skip)
        self.folder, self.skip, self.every, self.skipped = Path(folder), skip, every, 0

    def on_train_batch_start(self, trainer, module, batch, batch_idx) -> None:
        """Note what the step begins with; check the parameters if it is time."""
        self._batch, self._number = batch, module.global_step
        self._generator = module.generator.get_state()
        if self._number % self.every == 0:
            self._check_parameters(trainer, module)

    def on_before_optimizer_step(self, trainer, module, optimizer) -> None:
        """Check loss and gradients; drop the gradients of a step to skip: nothing is learned of it."""
        found, gradients = None, {name: p.grad for name, p in module.method.named_parameters()}
        if not math.isfinite(module.last["loss"]):
            losses = {name: value for name, value in module.last.items() if name.startswith("loss")}
            found = f"loss: {', '.join(name for name, value in losses.items() if not math.isfinite(value))}"
        elif not all_finite(gradient for gradient in gradients.values() if gradient is not None) and (
            name := first_bad(gradients.items(), squared=True)
        ):  # a norm may overflow where no entry's square does
            found = f"gradient: {name}"
        if found:
            self._stop(trainer, module, found, may_skip=True)
            for parameter in module.method.parameters():
                parameter.grad = None

    def check(self, trainer: lightning.Trainer) -> None:
        """Check all that a checkpoint would hold."""
        module = trainer.lightning_module
        self._check_parameters(trainer, module)
        names = {id(p): name for name, p in module.method.named_parameters()}
        moments = (
            (f"{key} of {names[id(p)]}", value)
            for optimizer in trainer.optimizers
            for p, state in optimizer.state.items()
            for key, value in state.items()
            if torch.is_tensor(value)
        )
        if name := first_bad(moments):
            self._stop(trainer, module, f"optimizer: {name}")

    def state_dict(self) -> dict:
        """Return the number of skipped steps."""
        return {"skipped": self.skipped}

    def load_state_dict(self, state: dict) -> None:
        """Continue the count."""
        self.skipped = int(state["skipped"])

    def _check_parameters(self, trainer, module) -> None:
        named = list(module.method.named_parameters())
        if not all_finite(p for _, p in named) and (name := first_bad(named)):
            self._stop(trainer, module, f"parameter: {name}")

    def _stop(self, trainer, module, found: str, may_skip: bool = False) -> None:
        """Repeat the step to name its first broken tensor, store it, and raise unless it may be skipped."""
        after = module.generator.get_state()
        module.generator.set_state(self._generator)
        counted = {name: value.clone() for name, value in module.method.named_buffers()}
        with trainer.precision_plugin.forward_context(), torch.enable_grad():
            again = diagnose(module, self._batch, self._number)
        module.generator.set_state(after)
        for name, value in module.method.named_buffers():
            value.copy_(counted[name])
        found = again or f"{found}, though not when the step was repeated,"
        frame = trainer.datamodule.scene.train[self._batch.frame].name
        path = self.folder / "broken" / f"step_{self._number}.pt"
        content = {"found": found, "step": self._number, "frame": frame}
        content |= {"batch": _plain(self._batch), "state_dict": module.state_dict()}
        stored = f"its batch and weights are in {path}"
        try:
            write_archive(path, content)
            if may_skip and self.skipped < self.skip:
                self.skipped += 1
                return
        except OSError as error:  # say what was found all the same
            stored = f"{path} could not be written ({error.strerror or error})"
        key = f"stage.{module.settings.name}"
        at = f"at step {self._number}, frame {frame} (time {self._batch.time:.4g})"
        advice = f"begin anew with lower {key}.lr, or go on with resume={self.folder.parent} sentinel.skip=1"
        raise BrokenStep(f"{key}: expected finite numbers, but got {found} {at}; {stored}; {advice}")


def _plain(batch: Batch) -> list[dict]:
    """Return the observations of a batch as tensors and plain numbers."""
    return [
        {"time": seen.moment.time, "frame": seen.moment.frame, "camera": seen.moment.camera}
        | {"camera_to_world": seen.view.camera.camera_to_world, "pixels": seen.view.indices}
        | {"rgb": seen.rgb.cpu(), "background": seen.background.cpu()}
        for seen in (*batch.observations, *batch.instant)
    ]
