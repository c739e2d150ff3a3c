"""The LightningModule: fields, warper, inpainter and renderer, and the step that trains them."""

from __future__ import annotations

import lightning
import torch
from torch import Tensor

from forewarp.methods.spec import parameter_kinds
from forewarp.ops.warmup import warm_up
from forewarp.renderer import Renderer
from forewarp.scene.batch import Batch, Target
from forewarp.scene.camera import Camera
from forewarp.scene.paths import RandomPatches
from forewarp.scene.rays import Rays
from forewarp.scene.state import Rendering, State
from forewarp.training.clock import Clock
from forewarp.training.curriculum import Curriculum
from forewarp.training.lattices import Lattices
from forewarp.training.objective import Objective, Step
from forewarp.training.settings import StageSettings


class DynamicSceneModule(lightning.LightningModule):
    """One stage of one scene.

    Args:
        method: what is learned; answers the radiance at a time.
        renderer: makes pictures of it.
        objective: the weighted terms.
        settings: the stage's numbers.
        curriculum: which frames are in play.
        cameras: of the training frames, for random views.
        seed: of the samples' jitter and the random views.
        still: (N, 3) world units, points that are known never to move; None: none is known.
    """

    def __init__(
        self,
        method: torch.nn.Module,
        *,
        renderer: Renderer,
        objective: Objective,
        settings: StageSettings,
        curriculum: Curriculum,
        cameras: list[Camera],
        seed: int = 0,
        still: Tensor | None = None,
    ) -> None:
        super().__init__()
        self.method = method
        self.renderer, self.objective, self.settings = renderer, objective, settings
        self.curriculum = curriculum
        self.patches = RandomPatches(cameras, patches=settings.patches) if cameras else None
        self.generator = torch.Generator().manual_seed(seed)
        self.clock = Clock()
        self.lattices = Lattices(method, settings)
        self.still = still
        self.last: dict[str, float] = {}

    @property
    def fraction(self) -> float:
        """How much of the stage is done."""
        return self.settings.fraction(self.global_step, self.clock.seconds)

    def training_step(self, batch: Batch, batch_idx: int) -> Tensor:
        """The loss of one batch of rays of one time."""
        step = self.look(batch)
        loss, raw = self.objective(step, self.global_step)
        self._remember(loss, raw, step)
        return loss

    def look(self, batch: Batch) -> Step:
        """What the terms of the loss look at."""
        state = self.method.at(batch.time)
        renderings = {
            name: self.renderer(
                state.fields[name],
                batch.rays,
                batch.background,
                self.method.view,
                self.generator,
                keep_all_weights=self.objective.needs_all_weights,
            )
            for name in self.objective.wanted(state.fields)
        }
        return Step(batch, state, renderings, lambda: self._patches(state), lambda: self._stray(batch.time))

    def validation_step(self, target: Target, batch_idx: int) -> Tensor:
        """PSNR of one whole image; logged as ``val/psnr``, the mean over images. For ``trainer.validate``:
        a run does not stop for it, ``TensorBoardPictures`` logs the curve.
        """
        psnr = self.psnr_of(target)
        self.log("val/psnr", psnr, batch_size=1, prog_bar=True)
        return psnr

    def _patches(self, state: State) -> tuple[Tensor, Tensor]:
        rays = self.patches.draw(self.generator).to(self.device)
        field = list(state.fields.values())[-1]
        shape = (self.patches.patches, self.patches.size, self.patches.size)
        black = torch.zeros(3, device=self.device)
        drawn = self.renderer(field, rays, black, self.method.view, self.generator)
        return drawn.depth.reshape(shape) / (rays.far - rays.near), drawn.opacity.reshape(shape)

    def _stray(self, time: float) -> Tensor | None:
        """How far some of the points that stand still are displaced (N, 3), in half sides of the scene."""
        if self.still is None or not self.method.moves:
            return None
        rows = torch.randint(len(self.still), (min(1024, len(self.still)),), generator=self.generator)
        return self.method.displacement(self.still[rows].to(self.device), time) / self.method.unit

    def _remember(self, loss: Tensor, raw: dict[str, Tensor], step: Step) -> None:
        best = list(step.renderings.values())[-1]
        error = float((best.rgb.detach() - step.batch.rgb).square().mean())
        self.curriculum.report(step.batch.frame, error)
        self.last = {
            "loss": float(loss.detach()),
            "psnr": -10 * torch.log10(torch.tensor(max(error, 1e-10))).item(),
            "frames_in_play": self.curriculum.in_play,
            "occupied_voxels": len(step.state.canonical.values),
            "samples": best.samples,
            "dropped_voxels": step.state.dropped,
        } | {f"loss/{name}": float(value) for name, value in raw.items()}
        if step.state.coverage is not None:
            self.last["coverage"] = float(step.state.coverage.detach().clamp(max=1).mean())

    def on_fit_start(self) -> None:
        """Let the data follow the curriculum."""
        self.trainer.datamodule.picker = self.curriculum

    def on_train_start(self) -> None:
        """Start the training clock, once the kernels are there: compiling them is not training."""
        warm_up(self.device)
        self.clock.start()

    def on_train_end(self) -> None:
        """Stop it."""
        self.clock.stop()

    def on_train_batch_start(self, batch: Batch, batch_idx: int) -> int | None:
        """Set what depends on the fraction done: rates, bases, the lattice, the active voxels."""
        fraction = self.fraction
        if fraction >= 1:
            self.trainer.should_stop = True
            return -1
        self._follow(fraction)
        return None

    def _follow(self, fraction: float) -> None:
        settings = self.settings
        self.curriculum.fraction = fraction
        optimizer = self.optimizers().optimizer
        factor = settings.rate_factor(fraction)
        for group in optimizer.param_groups:
            group["lr"] = group["base_rate"] * factor
        motion = getattr(self.method, "motion", None)
        bases = settings.at("bases", fraction)
        if motion is not None:
            every = motion.trajectory.bases
            motion.trajectory.bases_in_play.fill_(every if bases is None else min(int(bases), every))
        self.lattices.follow(fraction, self.global_step, optimizer)

    def configure_optimizers(self) -> torch.optim.Optimizer:
        """Adam with the ancestors' betas; a rate of its own for every kind of parameter."""
        groups = []
        for kind, parameters in parameter_kinds(self.method).items():
            if kind not in self.settings.rates:
                raise ValueError(
                    f"stage.{self.settings.name}.rates: expected a rate for '{kind}', "
                    f"but got {sorted(self.settings.rates)}"
                )
            rate = float(self.settings.rates[kind])
            groups.append({"params": parameters, "lr": rate, "base_rate": rate, "name": kind})
        return torch.optim.Adam(groups, betas=(0.9, 0.99), eps=1e-8, fused=True)

    def configure_gradient_clipping(
        self, optimizer, gradient_clip_val=None, gradient_clip_algorithm=None
    ) -> None:
        """Clip the gradients' norm where the stage asks for it."""
        if self.settings.max_gradient > 0:
            torch.nn.utils.clip_grad_norm_(self.method.parameters(), self.settings.max_gradient)

    def on_save_checkpoint(self, checkpoint: dict) -> None:
        """All that a continued run needs to equal an uninterrupted one."""
        checkpoint["forewarp"] = {
            "generator": self.generator.get_state(),
            "curriculum": self.curriculum.state_dict(),
            "clock": self.clock.state_dict(),
            "lattices": self.lattices.state_dict(),
        }

    def on_load_checkpoint(self, checkpoint: dict) -> None:
        """Continue from ``on_save_checkpoint``."""
        state = checkpoint["forewarp"]
        self.generator.set_state(state["generator"])
        self.curriculum.load_state_dict(state["curriculum"])
        self.clock.load_state_dict(state["clock"])
        self.lattices.load_state_dict(state["lattices"])

    def psnr_of(self, target: Target, pixels: Tensor | None = None) -> Tensor:
        """PSNR (dB) of an image, or of its flat ``pixels`` (R,) alone, by the best rendering."""
        frame, truth = target.frame, target.rgb.reshape(-1, 3)
        truth = truth if pixels is None else truth[pixels]
        drawn = self.render_image(frame.camera, frame.time, target.background, pixels=pixels)
        error = (drawn.rgb.clamp(0, 1) - truth.to(drawn.rgb)).square().mean()
        return -10 * torch.log10(error.clamp(min=1e-10))

    @torch.no_grad()
    def render_image(
        self,
        camera: Camera,
        time: float,
        background: Tensor,
        state: State | None = None,
        pixels: Tensor | None = None,
    ) -> Rendering:
        """A whole picture, or flat ``pixels`` (R,) of it, by the best rendering. ``state`` of the same time,
        handed in, saves the warp.
        """
        state = state or self.method.at(time)
        field = list(state.fields.values())[-1]
        rays = camera.rays(pixels).to(self.device)
        return render_all(self.renderer, field, rays, background.to(self.device), self.method.view)


def render_all(
    renderer: Renderer, field, rays: Rays, background: Tensor, view, chunk: int = 65536
) -> Rendering:
    """Render many rays in chunks; the samples' arrays are left empty."""
    parts = []
    with torch.no_grad():
        for begin in range(0, len(rays), chunk):
            parts.append(renderer(field, rays[begin : begin + chunk], background, view))
    none = parts[0].weights[:0]
    joined = {
        k: torch.cat([getattr(p, k) for p in parts]) for k in ("rgb", "depth", "opacity", "transmittance")
    }
    return Rendering(
        **joined,
        weights=none,
        colors=parts[0].colors[:0],
        ray_ids=parts[0].ray_ids[:0],
        samples=sum(p.samples for p in parts),
    )
