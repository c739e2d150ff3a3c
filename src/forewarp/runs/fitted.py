"""A fitted run: open it, or a scene's file, as an object; measure, score and doubt it."""

from __future__ import annotations

import sys
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from statistics import fmean

import numpy as np
import torch
from hydra.core.hydra_config import HydraConfig
from hydra.experimental.callback import Callback
from hydra.utils import get_class
from omegaconf import DictConfig, OmegaConf
from torch import Tensor

from forewarp.clock import KINDS
from forewarp.data.batches import COLORS, color_of
from forewarp.data.checks import blind_frames, bounds
from forewarp.data.files import mismatch, one_of
from forewarp.drawing.images import write_video
from forewarp.evaluation.evaluate import evaluate, mean_scores, show
from forewarp.evaluation.images import shots_of_views, video
from forewarp.fields.moving import MovingGaussians
from forewarp.fields.windows import MovingWindows
from forewarp.files import read_json, write_json
from forewarp.glb.reader import read
from forewarp.methods.method import HasMatter, HasTrajectories, Method
from forewarp.metrics.limits import NETS
from forewarp.metrics.lpips import find_lpips, find_lpips_weights
from forewarp.metrics.registry import METRICS, ImageSuite
from forewarp.ops.backend import is_number
from forewarp.progress import Counted, time_text
from forewarp.runs.build import build_run
from forewarp.runs.config import is_swept, saved_config, trust_of
from forewarp.runs.overrides import key_of, typed_overrides
from forewarp.runs.session import warn_if_changed
from forewarp.scene.camera import Camera, Vector, focus_point, mean_up, tensor_of
from forewarp.scene.cloud import Cloud
from forewarp.scene.film import FilmPath
from forewarp.scene.frame import Frame, Scene, spread
from forewarp.scene.view import Moment, Rendering, View
from forewarp.scene.world import World
from forewarp.training.module import DynamicSceneModule
from forewarp.training.stages import Run

_FILM_SIZE, _FILM_LEAST, _FILM_MOST, _FILM_RATE = 200, 4, 30, 8.0  # pixels, images, images a second
SPLITS = ("train", "val", "test", "held")
_ROUGH = 1e-3  # by which a pose's axes may miss unit length and right angles


@dataclass(repr=False)
class Renderable:
    """What a fitted scene is asked for, wherever it comes from.

    Attributes:
        method: renders and moves points.
        name: of the method in the config, for errors.
        place: the folder or file that it was opened from.
        cameras: of images that it was fitted to, in order; of a file, some of them.
        background: (3,), the colour behind the images that it is measured on.
    """

    method: Method | MovingGaussians | MovingWindows
    name: str
    place: Path
    cameras: Sequence[Camera]
    background: Tensor
    _snapshot = None  # the last that was rendered

    def __repr__(self) -> str:
        """Say in a line what it is and where it came from."""
        return f"{type(self).__name__}({self.place}, {self.name})"

    @property
    def focus(self) -> Tensor:
        """The point (3,) that the cameras look at, world units, to turn round: ``forewarp.orbit``."""
        return focus_point(self.cameras)

    @property
    def up(self) -> Tensor:
        """The direction (3,) that is upwards in the cameras' images."""
        return mean_up(self.cameras)

    def render(
        self, view: Frame | Camera | Vector, time: float | None = None, background: str | Vector | None = None
    ) -> Rendering:
        """Render the scene.

        Args:
            view: a frame, as it is measured; a camera, ``frame.camera`` or one of your own, of the size
                that ``camera.resized(w, h)`` gives it; or a pose ``camera_to_world`` (4, 4), axes as
                OpenCV's, of a camera that is else the first of ``cameras``.
            time: in [0, 1]; None: the frame's.
            background: white, black, or a colour (3,) in [0, 1]; None: ``background`` of the scene.

        Returns:
            images on the CPU: ``rgb`` (H, W, 3) in [0, 1], ``depth`` along the rays in world units (H, W), 0
            where there is nothing, and ``opacity`` (H, W).

        Raises:
            ValueError: for a view without a time, or what is none of these.

        Cost: consecutive images of one time share one snapshot.
        """
        frame = view if isinstance(view, Frame) else None
        camera = view if frame is None else frame.camera
        if not isinstance(camera, Camera):
            camera = replace(self.cameras[0], camera_to_world=_rigid(camera))
        time = frame.time if time is None and frame is not None else time
        if not isinstance(time, int | float | np.number | Tensor) or np.ndim(time) or not 0 <= time <= 1:
            raise ValueError(f"time: expected a number in [0, 1], but got {time}")
        behind = self.background if background is None else _color(background)
        filmed = frame is not None and float(time) == frame.time
        moment = Moment(float(time), None, None if frame is None else frame.camera_id, filmed)
        with torch.no_grad():
            if self._snapshot is None or not self._snapshot.holds(moment):
                self._snapshot = self.method.at(moment)
            drawn = self._snapshot.render(View(camera), behind.to(self.method.device))
        return drawn.shaped(camera.height, camera.width)

    def trajectories(self, points: Vector, times: Vector) -> Tensor:
        """Follow canonical points (N, 3), world units, to ``times`` (T,) in [0, 1]; return (N, T, 3) float32.

        Tensors, arrays and lists will do.
        """
        method = self._able(HasTrajectories, "follows points")
        points, times = tensor_of("points", points, None, 3), tensor_of("times", times, None)
        if not all(0 <= time <= 1 for time in times.tolist()):
            raise ValueError(f"times: expected numbers in [0, 1], but got {times.tolist()}")
        with torch.no_grad():
            return method.trajectories(*(given.float().to(method.device) for given in (points, times))).cpu()

    def matter(self) -> Cloud:
        """Return the canonical matter as points with colour and opacity."""
        with torch.no_grad():
            return self._able(HasMatter, "tells where matter is").matter()

    def _able(self, ability: type, what: str) -> Method | MovingGaussians:
        if not isinstance(self.method, ability):
            raise ValueError(f"model: expected a method that {what}, but got {self.name}")
        return self.method


def _rigid(given: Vector) -> Tensor:
    """Make a pose (4, 4) of what a user gives; refuse what is none."""
    pose = tensor_of("view, as it is no frame and no camera", given, 4, 4)
    turn, last = pose[:3, :3], pose[3].tolist()
    error, volume = float((turn.T @ turn - torch.eye(3)).abs().max()), float(torch.linalg.det(turn))
    if error > _ROUGH or volume < 0 or last != [0, 0, 0, 1]:
        expected = "a rotation (no scale, no mirror) and a place, above 0 0 0 1"
        got = f"a 3x3 of determinant {volume:.4g} above {last}; forewarp.look_at makes poses"
        raise ValueError(f"view: expected a pose of {expected}, but got {got}")
    return pose


def _color(given: str | Vector) -> Tensor:
    """Make a colour (3,) of what a user gives; refuse what is none."""
    if not isinstance(given, str):
        return tensor_of("background", given, 3).float()
    if given not in COLORS:
        raise ValueError(f"background: expected {', '.join(COLORS)} or three numbers, but got '{given}'")
    return color_of(given)


@dataclass(repr=False)
class Fitted(Renderable):
    """A fitted scene, as ``forewarp.load(folder)`` returns it.

    >>> import forewarp
    >>> scene = forewarp.load(fitted_run)
    >>> scene
    Fitted(..., forward)
    >>> frame = scene.frames("test")[0]
    >>> scene.render(frame)
    Rendering(rgb=float32 (32, 32, 3), depth=float32 (32, 32), opacity=float32 (32, 32))
    >>> pose = forewarp.look_at([3, 0, 2], scene.focus, scene.up)
    >>> scene.render(pose, 0.5, background="black").rgb.shape
    torch.Size([32, 32, 3])
    >>> points = scene.matter().points[:5]
    >>> scene.trajectories(points, [0.0, 0.5, 1.0]).shape
    torch.Size([5, 3, 3])
    >>> sorted(scene.metrics["test"])
    ['canonical', 'space', 'time']

    Attributes:
        config: the run's config.
        module: the fitted module; ``module.method`` is the method.
        scene: frames, box, canonical time.
    """

    config: DictConfig
    module: DynamicSceneModule
    scene: Scene

    @property
    def world(self) -> World:
        """Where the scene lies in the world of its data: ``world.to_scene`` and ``world.to_data``."""
        return self.scene.world

    @property
    def folder(self) -> Path:
        """The run's folder."""
        return self.place

    @property
    def metrics(self) -> dict:
        """The content of ``metrics.json``; empty if the run was not measured."""
        return read_json(self.folder / "metrics.json") or {}

    def frames(self, split: str = "test") -> tuple[Frame, ...]:
        """List the frames of ``train``, ``val``, ``test`` or ``held``: names, times, cameras, pictures."""
        one_of(split, "split", *SPLITS)
        return getattr(self.scene, split)


@dataclass(repr=False)
class SceneFile(Renderable):
    """A scene of particles in one file, as ``forewarp.load("scene.glb")`` returns it; no run is needed.

    Attributes:
        seconds: how long time lasts from 0 to 1, as a player shows it.
        world: where the file's places lie in the world of the data.
    """

    seconds: float
    world: World

    @property
    def file(self) -> Path:
        """The file."""
        return self.place

    @property
    def gaussians(self) -> MovingGaussians | MovingWindows:
        """All that the file holds, moving; ``scene.gaussians.ellipsoids(0.5)`` are they at a time.

        Of a film in windows these are its ``MovingWindows``.
        """
        return self.method


def open_file(file: Path, device: str = "cpu") -> SceneFile:
    """Open a ``scene.glb``; see ``forewarp.load``."""
    held = read(file)
    method, setting = held.gaussians.to(device), held.setting
    background = torch.tensor(setting.background)
    world, cameras = World(setting.shift), list(setting.cameras)
    return SceneFile(method, "particles", file, cameras, background, setting.seconds, world)


def opened(config: DictConfig, device: str | torch.device | None = None) -> tuple[Run, DynamicSceneModule]:
    """Open a finished run to look at it; warn if its data have changed since.

    Args:
        config: of ``saved_config``.
        device: None: the one that the config's trainer names.

    Returns:
        the run, and its fitted module.

    Raises:
        ValueError: naming the wrong key of the config, or a stage that is not finished.
    """
    run = build_run(config)
    module = run.load().to(device or run.device)
    warn_if_changed(run)
    return run, module.eval()


def film_of(run: Run) -> FilmPath | None:
    """Return the path of the one camera that filmed a run's scene; None where there was none."""
    return FilmPath.of_scene(run.datamodule.scene, trust_degrees(Path(run.folder)))


def trust_degrees(folder: Path) -> float | None:
    """Return the angle beside its film's path to which a run was found to be good; None: not measured."""
    trust = (read_json(folder / "metrics.json") or {}).get("trust")
    degrees = trust.get("degrees") if isinstance(trust, dict) else None
    return float(degrees) if is_number(degrees) else None


def open_run(
    run: str | Path, *, trust: Sequence[str] = (), device: str = "cpu", data_root: str | Path | None = None
) -> Fitted | SceneFile:
    """Load a finished run from its folder, or a scene from a file; see ``forewarp.load``."""
    if device != "cpu" and not (str(device).startswith("cuda") and torch.cuda.is_available()):
        devices = "cpu" + " or cuda" * torch.cuda.is_available()
        raise ValueError(f"device: expected {devices}, which torch finds here, but got '{device}'")
    run = Path(run).expanduser()
    if run.suffix == ".glb" or run.is_file():
        return open_file(run, device)
    root = None if data_root is None else str(data_root)
    changes = {"trust": list(trust_of(trust)), "data": {"root": root}}
    config = saved_config(str(run), OmegaConf.create(changes))
    made, module = opened(config, device)
    scene, background = made.datamodule.scene, made.datamodule.targets("test").background
    cameras = [frame.camera for frame in scene.train]
    return Fitted(module.method, config.model.name, run, cameras, background, config, module, scene)


def measure_run(run: Run, module: DynamicSceneModule, config: DictConfig) -> dict:
    """Evaluate a fitted run by its config; print and return the numbers."""
    protocol = {"method": method_name(config), "preset": config.preset.name, "seed": config.seed}
    protocol |= {key: config.budget[key] for key in ("minutes", "iterations", "clock")}
    data, folder = run.datamodule, Path(run.folder)
    mask_box = data.scene.protocol.get("mask_box", False)
    suite = ImageSuite(find_lpips(extra=config.lpips_weights), mask_box=mask_box)
    options = {"sheets": config.sheets, "views": config.get("views"), "reduce": config.get("reduce")}
    options |= {"protocol": protocol, "finished": run.finished()}
    module = module.to(run.device)
    if lines := doubts_of(config, run, module):
        protocol["doubts"] = lines
    with Counted("test views") as progress:
        metrics = evaluate(module, data, folder, suite, progress=progress, **options)
    show(metrics, folder)
    tell(lines)
    return metrics


def log_scores(run: Run, metrics: dict) -> None:
    """Log what ``metrics.json`` says of a run to its loggers; see ``scores_to_log``."""
    scores = scores_to_log(metrics, "gpu" if run.device.type == "cuda" else "process")
    run.loggers.log_scores(scores, sum(done["steps"] for done in run.finished().values()))


def log_film(run: Run, module: DynamicSceneModule, metrics: dict) -> None:
    """Make a small film of the test views, ``videos/test.gif``, and log it, if a logger takes films.

    It is left out where there are no test views, and shorter where it would take long: at most 2 s and a
    twentieth of the training, as test views took.
    """
    targets = run.datamodule.targets("test")
    if not len(targets.frames) or not run.loggers.takes_film():
        return
    camera, seconds = targets.frames[0].camera, metrics["seconds"]
    share = min(1.0, (_FILM_SIZE / max(camera.width, camera.height)) ** 2)
    most = (2 + seconds["train"] / 20) / max(share * seconds["render_per_frame"], 1e-9)
    if most < _FILM_LEAST:
        return
    shots = shots_of_views(targets.frames, min(_FILM_MOST, int(most)), _FILM_SIZE)
    images = video(module, shots, targets.background.to(module.device))
    file = write_video(Path(run.folder) / "videos" / "test.gif", images, fps=_FILM_RATE)
    run.loggers.log_film("film/test", file, sum(done["steps"] for done in run.finished().values()))


def scores_to_log(metrics: dict, memory_of: str) -> dict[str, float]:
    """Name the scores of ``metrics.json`` for trackers: ``test/space/psnr``, and what they cost.

    ``memory_of`` is whose memory was measured, ``gpu`` or ``process``.
    ``docs/sweeps.md`` says what each name means, and in which unit. What a run has not is left out.
    """
    kinds, seconds = metrics["test"].items(), metrics["seconds"]
    scores = {f"test/{kind}/{name}": score for kind, of in kinds for name, score in of.items()}
    scores |= {f"trust/{part}": degrees for part, degrees in metrics.get("trust", {}).items()}
    scores |= {"test/flow/epe_moving": metrics.get("flow", {}).get("epe_moving")}
    scores |= {"test/keypoints/pck_t": metrics.get("keypoints", {}).get("pck_t")}
    scores |= {f"test/seconds_training_{clock}": spent for clock, spent in metrics["clocks"].items()}
    scores |= {
        "test/seconds_image_wall": seconds["render_per_frame"],
        "test/parameters": metrics["parameters"],
    }
    scores |= {f"test/peak_memory_{memory_of}_bytes": metrics["peak_memory_bytes"]}
    return {name: float(score) for name, score in scores.items() if score is not None}


def method_name(config: DictConfig) -> str:
    """Name the measured method: the last stage's own method, else the run's."""
    own = [stage.get("model") for stage in config.stage.values() if stage is not None][-1]
    return (own or config.model).get("name", config.model.name)


def is_current(file: Path, run: Run) -> bool:
    """Tell whether a run is finished and a JSON file was written after that."""
    if read_json(file) is None or not all(run.is_finished(stage) for stage in run.stages):
        return False
    done = [run.stage_folder(stage) / "done.json" for stage in run.stages]
    return file.stat().st_mtime_ns >= max(path.stat().st_mtime_ns for path in done)


class Score:
    """The number that a job returns in ``--multirun``, or if ``score`` was typed.

    The mean of a metric over whole images: of the held-out views (``data.held_out``), or else of up to 8
    validation views, never of test views. Stored in the run's ``score.json``.

    Args:
        run: the run, its scene already read.
        config: ``score`` (the metric) and ``lpips_weights``.

    Attributes:
        name: the metric; None if nobody asked for a score, or there can be none.

    Raises:
        ValueError: if the metric is no validation metric, or the sweeper needs a score and there can be none.
    """

    def __init__(self, run: Run, config: DictConfig) -> None:
        self.run, self.file, self.weights = run, Path(run.folder) / "score.json", config.get("lpips_weights")
        self.typed = "score" in map(key_of, typed_overrides())
        self.name = named(config.get("score")) if self.typed or _sweeper() else None
        self.nets = [net for net in NETS if f"lpips_{net}" == self.name]
        if self.name is None:
            return
        if not len(run.datamodule.watched()):
            self._leave_out("the scene has no validation views and none are held out; set data.held_out=8")
        elif self.nets and find_lpips_weights(self.nets[0], self.weights) is None:
            self._leave_out("no backbone weights were found; set lpips_weights=<file or folder>")

    def of(self, module: DynamicSceneModule | None = None) -> float | None:
        """Return the score, measured now or read from ``score.json``; None if there is none.

        Args:
            module: the fitted module; None: load the module if needed.
        """
        if self.name is None:
            return None
        value = self._stored().get(self.name)
        if not is_number(value):
            value = self._measured(module or self.run.load())
        if value is not None:
            print(f"score    {self.name} {value:.4f} of {self._views()}", flush=True)
        return value

    def _stored(self) -> dict:
        """Read the scores in ``score.json``, unless the run was trained after they were written."""
        scores = (read_json(self.file) or {}).get("scores")
        return scores if isinstance(scores, dict) and is_current(self.file, self.run) else {}

    def _views(self) -> str:
        count, held = len(self.run.datamodule.watched()), bool(self.run.datamodule.scene.held)
        return f"{count} {'held out' if held else 'validation'} view{'s' * (count != 1)}"

    def _measured(self, module: DynamicSceneModule) -> float | None:
        """Score all views by every metric, and store what they give beside the scores known before."""
        data = self.run.datamodule
        mask_box = data.scene.protocol.get("mask_box", False)
        suite = ImageSuite(find_lpips(self.nets, self.weights), mask_box=mask_box)
        scores = mean_scores(module.to(self.run.device), data.watched(), suite)
        write_json(self.file, {"views": self._views(), "scores": self._stored() | scores})
        if self.name not in scores:
            self._leave_out(suite.absent.get(self.name, "the views have no such score"))
        return scores.get(self.name)

    def _leave_out(self, why: str) -> None:
        """Go on without a score, unless a sweeper chooses jobs by it, as all but Hydra's own do."""
        # Imported here, as Hydra defines its sweepers anew when it looks for plugins.
        from hydra._internal.core_plugins.basic_sweeper import BasicSweeper

        sweeper = _sweeper().get("_target_")
        if sweeper is not None and not issubclass(get_class(sweeper), BasicSweeper):
            raise ValueError(f"score: expected {self.name}, which the sweeper needs, but got none: {why}")
        if self.typed:
            print(f"no score: {why}", flush=True)
        self.name = None


def named(score: object) -> str | None:
    """Return the metric, or None if ``score`` is null.

    Raises:
        ValueError: if ``score`` is no validation metric, or the sweeper maximises a distance (LPIPS).
    """
    if score is None:
        return None
    if score not in METRICS:
        known = f"a metric of validation views ({', '.join(METRICS)}) or null"
        raise mismatch("score", known, f"{score!r}")
    if not METRICS[score].higher_is_better and "maximize" in str(_sweeper().get("direction")).lower():
        key, expected = "hydra.sweeper.direction", f"minimize for {score}, which is less where it is better"
        raise mismatch(key, expected, "maximize", f"add {key}=minimize")
    return str(score)


def _sweeper() -> DictConfig:
    """Return the config of the sweeper that began this job; empty if none did."""
    return HydraConfig.get().sweeper if is_swept() else OmegaConf.create({})


class TellBest(Callback):
    """Print the best job at the end of a search."""

    def on_multirun_end(self, config: DictConfig, **_) -> None:
        """Print the best job from the sweeper's ``optimization_results.yaml``."""
        file = Path(config.hydra.sweep.dir) / "optimization_results.yaml"
        results = OmegaConf.load(file) if file.is_file() else {}
        if "best_params" in results:
            overrides = " ".join(f"{key}={value}" for key, value in results.best_params.items())
            print(f"best     {config.get('score')} {results.best_value:.4f}: {overrides}")
            print(f"written: {file}", flush=True)


FEW = 50  # steps of a stage that can hardly have learned anything, if there were fewer
SHORT = 1000  # steps of a run, or fewer, that may be all that is wrong with it
LOW, ABOVE = 21.0, 5.0  # dB; a fit is in doubt below LOW, or less than ABOVE better than one colour
LEAST_WALL = 20.0  # seconds of training, below which its processor time says little
HALF, HALF_OF_TWO = 0.5, 0.75  # processors by which a thread, or several, fall short; two are never as fast
_MORE = "raise the budget"  # which is no advice where a target ended training
_VIEWS, _PIXELS = 8, 2000  # training images that are looked at, and pixels of each


def doubts_of(config: DictConfig, run: Run, module: DynamicSceneModule) -> list[str]:
    """Return the ``doubts`` about a run; none of one for debugging, which is too short to be good."""
    return [] if config.get("debug") else doubts(run, module, config.preset.name)


def doubts(run: Run, module: DynamicSceneModule, preset: str) -> list[str]:
    """Return lines that say what is wrong with a fitted run, and its likeliest causes; none if all is well.

    A stage that minutes ended after few steps, cameras that see nothing of the box, and training images that
    were not trained on or that the fit does not show are doubted. A stage whose steps were asked for, or that
    its target ended, is not.

    Cost: some thousand pixels of eight training images are rendered.
    """
    lines, made, scene = [], run.finished(), run.datamodule.scene
    smaller = "" if preset == "demo" else "take preset=demo, whose steps are smaller, "
    ended = next((noted["target"]["reached"] for noted in made.values() if "target" in noted), None)
    for stage in run.stages:
        name = stage.settings.name
        most = stage.settings.over(len(scene.train)).iterations
        steps, seconds = made[name]["steps"], made[name]["seconds"]
        if steps < min(FEW, most or FEW) and not (ended and "target" in made[name]):
            few = f"ended after {steps} step{'s' * (steps != 1)} in {seconds:.1f} s, too few to learn"
            advice = f"raise budget.minutes, give it more of them (stage.{name}.share), {smaller}"
            lines.append(f"stage.{name} {few}; {advice}or leave it out (~stage.{name})")
    in_play = max(noted.get("frames_in_play", len(scene.train)) for noted in made.values())
    if in_play < len(scene.train) and run.stages[-1].settings.curriculum.get("most") is None:
        never = f"{len(scene.train) - in_play} of {len(scene.train)} training images were never trained on"
        advice = f"{ended} ended training before their times came in" if ended else ""
        lines.append(f"{never}, as {advice or 'the budget ended before their times came in; raise it'}")
    lines += busy(run, made)
    if blind := blind_frames(scene):
        lines.append(f"{blind} of {len(scene.train)} training cameras see nothing of the box {bounds(scene)}")
    reached, one_color = training_psnr(run, module)
    if reached < max(LOW, one_color + ABOVE):
        far = f"training images are reached to {reached:.1f} dB"
        lines.append(f"{far}; one color alone has {one_color:.1f} dB")
        steps = sum(noted["steps"] for noted in made.values())
        causes = _likeliest(run.datamodule.suspects, steps, preset)
        causes = [cause for cause in causes if not (ended and cause.endswith(_MORE))][:3]
        lines += [f"  likely cause {number}: {cause}" for number, cause in enumerate(causes, 1)]
    return lines


def busy(run: Run, made: Mapping[str, Mapping]) -> list[str]:
    """Say in a line that training by the wall clock got less than half of its processor time.

    Args:
        run: the run; of one on a GPU, or whose minutes do not bound it, nothing is said.
        made: the ``done.json`` of each stage.
    """
    bounded = [made[stage.settings.name] for stage in run.stages if stage.settings.minutes is not None]
    if run.clock != "wall" or run.device.type != "cpu":
        return []
    wall, processor = (sum(noted.get("clocks", {}).get(kind, 0.0) for noted in bounded) for kind in KINDS)
    if wall < LEAST_WALL or processor >= wall * (HALF if torch.get_num_threads() == 1 else HALF_OF_TWO):
        return []
    steps = sum(noted["steps"] for noted in bounded)
    about = f"other programs kept the machine busy: in {time_text(wall)} of training this one had"
    made_steps = f"{time_text(processor)} of processor time, {steps:,} steps"
    return [f"{about} {made_steps}; for as many as on an idle machine, add budget.clock=processor"]


def _likeliest(suspects: Sequence[str], steps: int, preset: str) -> list[str]:
    """Order the causes of a bad fit; leave out those of another preset, and the same advice given twice."""
    kept = [cause for cause in suspects if preset == "demo" or "preset=demo" not in cause]
    if steps >= SHORT:
        return kept
    return [f"too little training, {steps} steps: {_MORE}", *(one for one in kept if not one.endswith(_MORE))]


def tell(lines: Iterable[str]) -> None:
    """Print doubts to stderr, so that they are seen beside the tables."""
    for line in lines:
        print(line if line.startswith(" ") else f"warning: {line}", file=sys.stderr)


def training_psnr(run: Run, module: DynamicSceneModule) -> tuple[float, float]:
    """Return the mean PSNR, dB, of a fit on pixels of training images, and that of their mean colors."""
    targets, chooser = run.datamodule.targets("train"), torch.Generator().manual_seed(0)
    reached, one_color = [], []
    for number in spread(len(targets), _VIEWS):
        target = targets[number]
        colors = target.rgb.reshape(-1, 3) if target.valid is None else target.rgb[target.valid]
        pixels = torch.randint(target.rgb[..., 0].numel(), (_PIXELS,), generator=chooser)
        with torch.no_grad():
            reached.append(float(module.psnr_of(target, pixels)))
        error = float(colors.var(0, correction=0).mean())
        one_color.append(float(-10 * torch.tensor(max(error, 1e-10)).log10()))
    return fmean(reached), fmean(one_color)
