"""``forewarp-train``: fit a scene, stage by stage, and measure it."""

from __future__ import annotations

from shlex import quote

from forewarp.cli.entry import command

HELP = """
forewarp-train fits a moving scene, stage by stage, by the method that model= names, and measures it on its
test views. The same command run again skips what is finished and goes on with what was interrupted.

  forewarp-train                                     the procedural vehicle, written at first use
  forewarp-train experiment=demo                     the same in about a minute
  forewarp-train experiment=dnerf data.root=../data/dnerf data.scene=hook budget.minutes=5

What one types most (options such as --multirun or --config-dir=FOLDER come first):
  data.root=FOLDER data.scene=NAME    where the scenes are, and which one
  preset=demo|fast|faithful           the method's numbers: small, cheap (the default), as in the paper
  budget.minutes=N                    of training, all stages together; 10 with preset=fast
  budget.clock=wall|processor         what minutes are of; processor time does not depend on other work
  budget.iterations=N                 the same in steps; the first that is reached ends training
  model=particles|forward|backward    Gaussians (default), the paper's method, its like-for-like opponent
  model=nerf|tnerf|dnerf|nerfies|hypernerf   networks along rays, as in their papers with preset=faithful
  model=ndvg|tineuvox_s|tineuvox_b    voxel grids with networks, as in their papers with preset=faithful
  model=neural_volumes                a volume decoded from pictures of the instant
  model/view_dependence=none|harmonics     switch an effect; all others work alike (of forward: none|sh|mlp)
  stage.NAME.lr.GROUP=RATE            a learning rate; groups: means, color, shifts, ... (see --cfg job)
  seed=N                              of all random numbers
  trainer=cpu|gpu|auto                the device
  resume=FOLDER                       go on with the run in a folder; no other override is needed
  trust=[PACKAGE]                     beside resume=: code of other packages that the run's config may name
  score=psnr|ssim|ms_ssim|...         metric that a job of --multirun returns, on views not trained on
  sentinel.skip=N                     skip up to N steps of a stage whose numbers are not finite
  run=FOLDER                          the run's folder (runs/<scene>/<model>-<preset>-seed<seed>)
  effects=auto                        find out what the scene calls for, then fit that: see forewarp-plan
  plan=FILE                           fit what a plan says; an override typed beside it wins
  viewer=true                         show the run on a page while it trains: see forewarp-view
  evaluate=false                      do not measure at the end
  views=N                             measure N test views, evenly spread, in place of all
  reduce=2                            average 2 x 2 pixels of each test view and of its truth, then score
  data.held_out=N                     hold N training views out and record their PSNR against training time
  scene=DATASET_NAME                  a scene of the paper below paths.scenes=FOLDER, such as scene=dnerf_hook
  ablation=NAME                       an ablation of the paper; ablation=full is its whole method
  launcher=local|joblib|ray|slurm|submitit   where the jobs of --multirun run
  ~stage.fine                         drop a stage
  --multirun seeds=3                  one run after another; --multirun sweeps=dnerf: a prepared sweep
  --multirun sweeps=accuracy_time stage.fine.density=45,180  what choices cost; see forewarp-report
  --multirun sweeps=price_list_particles seeds=2  the same for every choice, one at a time; also _forward

A run's folder holds config.yaml, a folder for each stage (checkpoint, handover.json, TensorBoard events,
images), images/ of the test views, per_image.json and metrics.json. With data.held_out or validation views it
also holds accuracy_time.csv and accuracy_time.png.
Watch: tensorboard --logdir runs
"""


def train(config) -> float | None:
    """Fit the stages that are not finished and measure the run; return its score if one is asked for."""
    from forewarp.cli.checks import refuse_all, refuse_missing_scene
    from forewarp.runs.config import check_planned, hashed, resumed, trust_of

    refuse_all(config)
    trust = trust_of(config.get("trust"))
    if config.get("planned") is not None:
        check_planned(config, trust)
    if config.get("score") not in (None, "psnr"):
        from forewarp.runs.fitted import named

        named(config.score)
    viewer = viewer_of(config)  # as typed: a saved config has none
    config = resumed(config)
    refuse_missing_scene(config)
    # These load torch; mistakes have been answered before.
    from forewarp.evaluation.evaluate import notes_of
    from forewarp.report.curve import draw_own
    from forewarp.runs.build import build_run
    from forewarp.runs.fitted import Score, is_measured, measure_run
    from forewarp.runs.session import session

    config = hashed(planned(config))
    run = build_run(config)
    if is_skipped(run, config.get("absent", "refuse")):
        print(f"skipped: {run.datamodule.place}: no such scene")
        return None
    if config.evaluate and is_measured(run):
        with session(run, config, finished=True):
            other = f" reduce={config.reduce}" if config.get("reduce") else ""
            print(f"measured before: {run.folder}; again with forewarp-evaluate run={run.folder}{other}")
            return Score(run, config).of()
    refuse_early(run, config)
    score = Score(run, config)
    with watched(run, viewer), session(run, config):
        keep_plan(config)
        print(beginning(run, config), flush=True)
        module = run.fit()
        if config.evaluate:
            measure_run(run, module, config)
        else:
            said = f"fitted: {run.folder}; measure it with forewarp-evaluate run={run.folder}"
            print(said, *notes_of(module.method.protocol()), sep="\n")
        draw_own(run.folder)
        if config.evaluate:
            at = quote(f"run={run.folder}")
            print(f"look at  forewarp-view {at}, or a page: forewarp-report kind=run {at}")
        value = score.of(module)
    for name, noted in run.finished().items():
        if steps := noted.get("skipped_steps"):
            print(f"{name}: {steps} broken steps skipped; each lies in {run.folder / name / 'broken'}")
    return value


def refuse_early(run, config) -> None:
    """Read the scene, and refuse what could not be trained or measured, before the run's folder is made."""
    run.check_device()
    run.datamodule.setup("fit")
    if config.evaluate and config.get("reduce") is not None:
        run.datamodule.targets("test").reduced(config.reduce)


def viewer_of(config) -> dict | None:
    """Return where a page should listen, None if none is asked for; refuse one that cannot be made."""
    from forewarp.cli.view import require_viewer
    from forewarp.viewer.address import check_address

    viewer = config.get("viewer", False)
    if type(viewer) is not bool:
        raise ValueError(f"viewer: expected true or false, but got {viewer}")
    if not viewer:
        return None
    require_viewer()
    refuse_one_port(config)
    check_address(config.host, config.port)
    return {"host": config.host, "port": config.port}


def refuse_one_port(config) -> None:
    """Refuse one port for jobs that may run at once."""
    from hydra.core.hydra_config import HydraConfig
    from hydra.types import RunMode

    if not (HydraConfig.initialized() and HydraConfig.get().mode == RunMode.MULTIRUN) or config.port == 0:
        return
    if "BasicLauncher" not in str(HydraConfig.get().launcher.get("_target_")):
        raise ValueError(
            f"port: expected 0 where jobs may run at once, so that each takes one that is free, but got "
            f"{config.port}; set port=0, or launcher=local"
        )


def watched(run, viewer: dict | None):
    """Return a context in which a page shows the run while it trains, if one is asked for."""
    from contextlib import nullcontext

    if viewer is None:
        return nullcontext()
    from forewarp.viewer.live import live

    return live(run, **viewer)


def planned(config):
    """With ``effects=auto``: make or read the plan, and return the config of the run that it says."""
    choice = config.get("effects", "given")
    if choice not in ("given", "auto"):
        raise ValueError(f"effects: expected given or auto, but got {choice}")
    if choice == "given" or config.get("resume") is not None:
        return config
    from forewarp.planning.plan import make_plan
    from forewarp.planning.plan_file import own_folder, show_plan
    from forewarp.planning.trials import composed
    from forewarp.runs.build import build_run
    from forewarp.runs.overrides import merged, typed_overrides, without_switched_off

    if is_skipped(build_run(config), config.get("absent", "refuse")):
        return config
    made = make_plan(config, typed_overrides())
    show_plan(made, to_fit=False)
    typed = typed_overrides(of_sweep=True)
    config = composed(without_switched_off(merged([*made["overrides"], *own_folder(typed)], typed)))
    config.planned = made["file"]
    return config


def keep_plan(config) -> None:
    """Copy the plan that a run follows into its folder."""
    from pathlib import Path
    from shutil import copyfile

    if config.get("planned") is not None and Path(config.planned).is_file():
        copyfile(config.planned, Path(config.run) / "plan.yaml")


def beginning(run, config) -> str:
    """Say in two lines what is about to be trained, on what device, and into which folder; in one more why
    a GPU is left aside, if it is.
    """
    from forewarp.runs.build import why_on_cpu

    scene, why = run.datamodule.scene, why_on_cpu(config)
    views = f"{_images(scene.train, 'training')} and {_images(scene.test, 'test')}"
    lines = [f"{scene.name}: {views}, on the {run.device.type.upper()}", *([] if why is None else [why])]
    return "\n".join([*lines, f"run: {run.folder}"])


def _images(frames, kind: str) -> str:
    sizes = sorted({(frame.camera.width, frame.camera.height) for frame in frames})
    ends = dict.fromkeys([*sizes[:1], *sizes[-1:]])
    size = " to ".join(f"{width} x {height}" for width, height in ends)
    return f"{len(frames)} {kind} images" + (f" ({size})" if size else "")


def is_skipped(run, absent: str) -> bool:
    """Skip this sweep job if its scene is missing; synthetic scenes are never skipped."""
    if absent not in ("refuse", "skip"):
        raise ValueError(f"absent: expected refuse or skip, but got {absent}")
    if absent == "refuse" or hasattr(run.datamodule, "prepare"):
        return False
    return run.datamodule.place is not None and not run.datamodule.place.is_dir()


def main() -> None:
    """Run the console script."""
    command("train", train, HELP)


if __name__ == "__main__":
    main()
