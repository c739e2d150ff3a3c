"""The sentinel: stop a stage at the first number that is not finite, and store that step."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

import lightning
import torch
from torch import Tensor

from forewarp.scene.view import Batch
from forewarp.training.bundle import write_bundle
from forewarp.training.module import DynamicSceneModule
from forewarp.training.objective import parts


class BrokenStep(ValueError):
    """A step produced a number that is not finite."""


@dataclass(frozen=True)
class Found:
    """The first number found that is not finite in a step.

    Attributes:
        kind: the check that failed: ``parameter``, ``loss``, ``gradient`` or ``optimizer``.
        tensor: name of the first tensor that is not finite.
        terms: loss terms whose value or gradient is not finite.
    """

    kind: str
    tensor: str
    terms: tuple[str, ...] = ()

    def __str__(self) -> str:
        return f"{self.kind}: {self.tensor}" + (f" (terms {', '.join(self.terms)})" if self.terms else "")


def all_finite(tensors: Iterable[Tensor]) -> bool:
    """Check that the sum of squares of each tensor is finite.

    Cost: one pass in a few fused calls and one wait for a GPU: 0.4 ms a million floats.
    """
    tensors = [t.detach() for t in tensors if t.numel()]
    return not tensors or bool(torch.stack(torch._foreach_norm(tensors)).isfinite().all())


def first_bad(named: Iterable[tuple[str, Tensor | None]], squared: bool = False) -> str | None:
    """Return the name of the first tensor with an entry (or, if ``squared``, a square) that is not finite."""
    for name, tensor in named:
        if tensor is not None and tensor.is_floating_point():
            values = tensor.detach().square() if squared else tensor.detach()
            if not bool(values.isfinite().all()):
                return name
    return None


def diagnose(module: DynamicSceneModule, batch: Batch, number: int) -> Found | None:
    """Repeat step ``number`` up to its gradients and find what is not finite; None if nothing is.

    A gradient counts as broken once its square overflows, as Adam stores squares. Reset the module's
    generator to its state before the step; weights and gradients do not change.
    """
    parameters = dict(module.method.named_parameters())
    if name := first_bad(parameters.items()):
        return Found("parameter", name)
    factors = module.objective.factors(number)
    step = module.look(batch, factors)
    found = parts(step, factors)
    bad = tuple(name for name, (value, _) in found.items() if not bool(value.isfinite().all()))
    if bad:
        return Found("loss", first_bad([*_tensors(batch), *step.tensors()]) or f"the term {bad[0]}", bad)
    if step.gradients is not None:  # the method's own, of all terms together
        name = first_bad(step.gradients.items(), squared=True)
        return None if name is None else Found("gradient", name)
    slopes = {name: _slopes(value * factor, parameters) for name, (value, factor) in found.items()}
    total = {p: sum(s[p] for s in slopes.values() if s[p] is not None) for p in parameters}
    name = first_bad(((p, g) for p, g in total.items() if torch.is_tensor(g)), squared=True)
    if name is None:
        return None
    guilty = [term for term, s in slopes.items() if first_bad([("", s[name])], squared=True) is not None]
    return Found("gradient", name, tuple(guilty))


def _slopes(value: Tensor, parameters: dict[str, Tensor]) -> dict[str, Tensor | None]:
    if not value.requires_grad:
        return dict.fromkeys(parameters)
    found = torch.autograd.grad(value, list(parameters.values()), retain_graph=True, allow_unused=True)
    return dict(zip(parameters, found))


def _tensors(batch: Batch) -> Iterable[tuple[str, Tensor | None]]:
    """Yield the colours and rays of a batch by name."""
    for number, one in enumerate(batch.observations):
        yield from ((f"batch[{number}].{part}", getattr(one, part)) for part in ("rgb", "background"))
        rays = one.view.rays()
        yield from (
            (f"batch[{number}].rays.{part}", getattr(rays, part)) for part in ("origins", "directions")
        )


class Sentinel(lightning.Callback):
    """Check the loss and gradients of every step, the parameters now and then, and all before a checkpoint.

    A number that is not finite ends the stage. The step is stored as ``broken/step_<n>.pt`` (repeat it with
    ``forewarp.replay``), and the last checkpoint stays as it is.

    Args:
        folder: the stage's folder.
        skip: number of broken steps to skip instead: store each, count it in ``skipped``, learn nothing.
        every: steps between two checks of the parameters, which only broken gradients can break.

    Raises:
        ValueError: for a ``skip`` that is not a whole number >= 0.
    """

    def __init__(self, folder: Path, *, skip: int = 0, every: int = 10) -> None:
        if type(skip) is not int or skip < 0:
            raise ValueError(f"sentinel.skip: expected a whole number of steps >= 0, but got {skip}")
        self.folder, self.skip, self.every, self.skipped = Path(folder), skip, every, 0

    def on_train_batch_start(self, trainer, module, batch, batch_idx) -> None:
        """Note the states of the random generators; check the parameters if it is time."""
        self._batch, self._number, self._drop = batch, module.global_step, False
        self._random = {"samples": module.generator.get_state(), "torch": torch.get_rng_state()}
        if self._number % self.every == 0:
            self._check_parameters(trainer, module)

    def on_before_backward(self, trainer, module, loss) -> None:
        """Check the loss."""
        if not bool(loss.detach().isfinite()):
            raw = {name: v for name, v in module.last.items() if name.startswith("loss/")}
            terms = (name.removeprefix("loss/") for name, value in raw.items() if not math.isfinite(value))
            self._stop(trainer, module, Found("loss", "the loss", tuple(terms)), may_skip=True)

    def on_before_optimizer_step(self, trainer, module, optimizer) -> None:
        """Check the gradients; drop those of a step to skip, so that Adam does nothing."""
        if not self._drop and not _rescales(trainer):
            learned = (p for group in optimizer.param_groups for p in group["params"])
            if not all_finite(p.grad for p in learned if p.grad is not None):
                named = [(name, p.grad) for name, p in module.method.named_parameters()]
                if name := first_bad(named, squared=True):  # a norm may overflow where no entry's square does
                    self._stop(trainer, module, Found("gradient", name), may_skip=True)
        if self._drop:
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
            self._stop(trainer, module, Found("optimizer", name))

    def state_dict(self) -> dict:
        """Return the number of skipped steps."""
        return {"skipped": self.skipped}

    def load_state_dict(self, state: dict) -> None:
        """Continue the count."""
        self.skipped = int(state["skipped"])

    def _check_parameters(self, trainer, module) -> None:
        named = list(module.method.named_parameters())
        if not all_finite(p for _, p in named) and (name := first_bad(named)):
            self._stop(trainer, module, Found("parameter", name))

    def _stop(self, trainer, module, seen: Found, may_skip: bool = False) -> None:
        found, path, refusal = self._keep(trainer, module, seen)
        if may_skip and self.skipped < self.skip and refusal is None:
            self.skipped, self._drop = self.skipped + 1, True
            return
        batch, stage = self._batch, f"stage.{module.settings.name}"
        frame = trainer.datamodule.scene.train[batch.frame].name
        again = f"python -m forewarp.replay {path} shows it again"
        if refusal is not None:
            again = f"{path} could not be written ({refusal})"
        raise BrokenStep(
            f"{stage}: expected finite numbers, but got {found} at step {self._number}, frame {frame} "
            f"(time {batch.time:.4g}); {again}; begin anew with "
            f"lower {stage}.lr, or go on with resume={self.folder.parent} sentinel.skip=1"
        )

    def _keep(self, trainer, module, seen: Found) -> tuple[str, Path, str | None]:
        """Repeat the step to find the first broken tensor, and store it.

        Returns:
            what was found, the file, and why it could not be written (None if it was).
        """
        after = module.generator.get_state()
        module.generator.set_state(self._random["samples"])
        counted = {name: value.clone() for name, value in module.method.named_buffers()}
        with trainer.precision_plugin.forward_context(), torch.enable_grad():
            again = diagnose(module, self._batch, self._number)
        module.generator.set_state(after)
        for name, value in module.method.named_buffers():
            value.copy_(counted[name])
        found = str(again or f"{seen}, though not when the step was repeated,")
        path = self.folder / "broken" / f"step_{self._number}.pt"
        noted = {"found": found, "stage": module.settings.name, "step": self._number, "random": self._random}
        try:
            write_bundle(path, module, self._batch, trainer.datamodule.scene, noted)
        except OSError as error:  # report what was found all the same
            return found, path, error.strerror or str(error)
        return found, path, None


def _rescales(trainer: lightning.Trainer) -> bool:
    """Return whether a float16 gradient scaler is active, which skips overflowing steps by design."""
    return getattr(trainer.precision_plugin, "scaler", None) is not None
