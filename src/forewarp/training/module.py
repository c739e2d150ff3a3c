"""The LightningModule: one training step of any method, through the contract of ``Method`` alone."""

from __future__ import annotations

import math
from collections.abc import Mapping

import lightning
import torch
from torch import Tensor

from forewarp.clock import Clock
from forewarp.methods.method import Method, Snapshot, Step
from forewarp.progress import told_if_slow
from forewarp.scene.camera import Camera
from forewarp.scene.view import Batch, Moment, Rendering, Target, View
from forewarp.training.loggers import RunLoggers
from forewarp.training.objective import Objective, set_gradients, total
from forewarp.training.schedule import Curriculum, StageSettings


class DynamicSceneModule(lightning.LightningModule):
    """Train a method for one stage of one scene.

    Args:
        method: the scene to learn; the paper's has ``radiance``, ``motion``, ``inpainter`` and ``renderer``.
        objective: the weights of its loss terms.
        settings: the numbers of the stage.
        curriculum: draws the frame of every step.
        seed: seed of the random numbers that the method draws.

    ``last`` holds the values of the last step, by the names under which they are logged; ``trackers`` are the
    loggers of the run. What ends the stage before its budget sets ``reached``: what it was, and when.
    """

    def __init__(
        self,
        method: Method,
        *,
        objective: Objective,
        settings: StageSettings,
        curriculum: Curriculum,
        seed: int = 0,
    ) -> None:
        super().__init__()
        self.automatic_optimization = False
        method.check(settings.name, (), objective.names, objective.literal)
        self.method, self.objective, self.settings, self.curriculum = method, objective, settings, curriculum
        self.generator = torch.Generator().manual_seed(seed)
        self.clock = Clock()
        self.last: dict[str, float] = {}
        self.reached: dict[str, object] | None = None
        self.trackers = RunLoggers()
        self._noted: Mapping[str, float] = {}
        self._torch_state: Tensor | None = None

    def __setattr__(self, name: str, value: object) -> None:
        """Set an attribute; the name of the hook, which Lightning notes dozens of times a step, at once."""
        if name == "_current_fx_name":
            self.__dict__[name] = value
        else:
            super().__setattr__(name, value)

    @property
    def fraction(self) -> float:
        """Fraction of the stage that is done, in [0, 1]; 1 once its target is reached."""
        return 1.0 if self.reached else self.settings.fraction(self.global_step, self.clock.seconds)

    def training_step(self, batch: Batch, batch_idx: int) -> Tensor:
        """Take one step of the optimiser, and return the loss.

        Optimisation is manual, as a method may compute its gradients itself.
        """
        optimizer = self.optimizers()
        profiled = self.trainer.profiler.profile  # debug=profile shows these parts
        for group in optimizer.param_groups:
            for parameter in group["params"]:
                parameter.grad = None
        with profiled("method.look and loss terms"):
            loss, gradients = self.loss_of(batch)
        with torch.autocast(self.device.type, enabled=False):  # mixed precision is of the forward pass alone
            with profiled("gradients"):
                if gradients is None:
                    self.manual_backward(loss)
                else:
                    set_gradients(self.method, gradients)
            with profiled("optimizer.step"):
                optimizer.step()
        return loss.detach()

    def loss_of(self, batch: Batch) -> tuple[Tensor, Mapping[str, Tensor] | None]:
        """Return the loss of a batch, the weighted sum of the method's terms, and the method's own gradients.

        The gradients are None where autograd computes them.
        """
        factors = self.objective.factors(self.global_step)
        step = self.look(batch, factors)
        loss, raw = total(step, factors)
        error = float(step.squared_error)
        self.curriculum.report(batch.frame, error)
        self.last = {"loss": float(loss.detach()), "psnr": -10 * math.log10(max(error, 1e-10))}
        self.last |= {"frames_in_play": self.curriculum.in_play, **self._noted, **step.noted}
        self.last |= {f"loss/{name}": float(value) for name, value in raw.items()}
        return loss, step.gradients

    def look(self, batch: Batch, factors: Mapping[str, float]) -> Step:
        """Let the method compare itself with a batch."""
        return self.method.look(batch, factors, self.generator)

    def validation_step(self, target: Target, batch_idx: int) -> Tensor:
        """Log the PSNR of one whole image as ``val/psnr``, for ``trainer.validate``.

        A run does not pause to validate: its curve ``val/psnr`` comes from ``TrainingImages``.
        """
        psnr = self.psnr_of(target)
        self.log("val/psnr", psnr, batch_size=1, prog_bar=True)
        return psnr

    def on_fit_start(self) -> None:
        """Let the curriculum pick the frames, and the method say what a batch holds."""
        self.trainer.datamodule.picker = self.curriculum
        self.trainer.datamodule.asks = self.method.asks

    def on_train_start(self) -> None:
        """Compile the kernels, then start the training clock."""
        about = "compiling what this method runs, once on a machine: up to a minute"
        with told_if_slow(self.settings.name, about):
            self.method.warm_up()
        if self._torch_state is not None:  # restored last: callbacks may have drawn random numbers
            torch.set_rng_state(self._torch_state)
            self._torch_state = None
        self.clock.start()

    def on_train_end(self) -> None:
        """Stop the training clock."""
        self.clock.stop()

    def on_train_batch_start(self, batch: Batch, batch_idx: int) -> int | None:
        """Set learning rates, curriculum and the method's own schedule; end the stage when it is done."""
        fraction = self.fraction
        if fraction >= 1:
            self.trainer.should_stop = True
            return -1
        self.curriculum.fraction, self.curriculum.step = fraction, self.global_step
        optimizer = self.optimizers().optimizer
        for group in optimizer.param_groups:
            group["lr"] = group["base_lr"] * self.settings.lr_factor(fraction, group["name"])
        self._noted = self.method.advance(fraction, self.global_step, optimizer)
        return None

    def configure_optimizers(self) -> torch.optim.Optimizer:
        """Make the method's optimiser, with the stage's learning rate for each parameter group."""
        kinds, lr = self.method.param_groups(), self.settings.lr
        if missing := [kind for kind in kinds if kind not in lr]:
            where = f"stage.{self.settings.name}.lr"
            raise ValueError(f"{where}: expected a rate for '{missing[0]}', but got {sorted(lr)}")
        groups = [
            {"params": parameters, "lr": float(lr[kind]), "base_lr": float(lr[kind]), "name": kind}
            for kind, parameters in kinds.items()
        ]
        return self.method.optimizer(groups)

    def on_before_optimizer_step(self, optimizer: torch.optim.Optimizer) -> None:
        """Clip the gradients' norm to the stage's ``max_gradient``; callbacks have seen them before."""
        if self.settings.max_gradient > 0:
            learned = [p for group in optimizer.param_groups for p in group["params"]]
            torch.nn.utils.clip_grad_norm_(learned, self.settings.max_gradient)

    def on_save_checkpoint(self, checkpoint: dict) -> None:
        """Add all that a continued run needs to equal an uninterrupted one to the bit."""
        state = {"generator": self.generator.get_state(), "torch_rng": torch.get_rng_state()}
        state |= {"curriculum": self.curriculum.state_dict(), "clock": self.clock.state_dict()}
        state |= {"reached": self.reached} if self.reached else {}
        checkpoint["forewarp"] = state

    def on_load_checkpoint(self, checkpoint: dict) -> None:
        """Restore what ``on_save_checkpoint`` added."""
        state = checkpoint["forewarp"]
        self.generator.set_state(state["generator"])
        self._torch_state = state["torch_rng"]
        torch.set_rng_state(self._torch_state)
        self.curriculum.load_state_dict(state["curriculum"])
        self.clock.load_state_dict(state["clock"])
        self.reached = state.get("reached")

    def psnr_of(self, target: Target, pixels: Tensor | None = None) -> Tensor:
        """Return the PSNR (dB) of the best rendering of an image, or of its flat ``pixels`` (R,) alone; where
        some pixels do not count, of as many that do.
        """
        truth = target.rgb.reshape(-1, 3)
        if target.valid is not None:
            valid = target.valid.flatten().cpu().nonzero()[:, 0]
            pixels = valid if pixels is None else valid[pixels.cpu() % len(valid)]
        truth = truth if pixels is None else truth[pixels]
        drawn = self.render(View(target.frame.camera, pixels), target.moment, target.background)
        error = (drawn.rgb.clamp(0, 1) - truth.to(drawn.rgb)).square().mean()
        return -10 * torch.log10(error.clamp(min=1e-10))

    @torch.no_grad()
    def render(
        self, view: View | Camera, moment: Moment, background: Tensor, snapshot: Snapshot | None = None
    ) -> Rendering:
        """Render a view at a moment, by the best rendering and without gradient.

        Args:
            view: a camera, or some of its pixels.
            moment: the time, and the frame and camera where known.
            background: colour (3,) or (R, 3) behind everything.
            snapshot: a snapshot of this moment, if already made.
        """
        view = view if isinstance(view, View) else View(view)
        snapshot = snapshot or self.method.at(moment)
        return snapshot.render(view, background.to(self.device))
