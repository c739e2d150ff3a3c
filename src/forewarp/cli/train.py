"""``forewarp-train``: fit a scene, stage by stage, and measure it."""

from __future__ import annotations

from forewarp.cli.entry import command

HELP = """
forewarp-train fits a moving scene, stage by stage, by the method that model= names, and measures it on its
test views. The same command run again skips what is finished and goes on with what was interrupted.

  forewarp-train                                     the procedural vehicle, written at first use
  forewarp-train experiment=demo                     the same in about a minute
  forewarp-train experiment=dnerf data.root=../data/dnerf data.scene=hook budget.minutes=5

What one types most (options such as --multirun or --config-dir=FOLDER stand before all of it):
  data.root=FOLDER data.scene=NAME    where the scenes are, and which one
  preset=demo|fast|faithful           the method's numbers: small, cheap (the default), as printed
  budget.minutes=N                    of training, all stages together
  budget.iterations=N                 the same in steps; with both, what comes first (null switches one off)
  model=forward|backward|tnerf        the paper's method, its opponent, a network that is told the time
  model/view_dependence=none|sh|mlp              (and every other effect) switched by a word
  seed=N                              of everything random
  trainer=cpu|gpu|auto                where
  resume=FOLDER                       go on with the run there; nothing else need be typed
  trust=[PACKAGE]                     beside resume=: code of other packages that the run's config may name
  score=psnr|ssim|ms_ssim|...         what a job of --multirun returns, of views that nothing learns from
  sentinel.skip=N                     leave out up to N steps of a stage that are not finite, and count them
  run=FOLDER                          where the run lives (runs/<scene>/<model>-<preset>-seed<seed>)
  effects=auto                        find out what the scene calls for, then fit that: see forewarp-plan
  plan=FILE                           as a plan says; what is typed beside it wins
  evaluate=false                      no test views at the end
  data.held_out=N                     set N training views aside: a curve of their PSNR against training time
  scene=DATASET_NAME                  as scene=dnerf_hook: a scene of the paper below paths.scenes=FOLDER
  ablation=NAME                       what the paper takes away, from ablation=full
  launcher=local|joblib|ray|slurm|submitit   of --multirun: where its jobs run
  ~stage.fine                         drop a stage
  --multirun seeds=3                  one run after another; --multirun sweeps=methods: a prepared sweep
  --multirun sweeps=accuracy_time preset.rays=1024,2048    what choices cost: see forewarp-report
  --multirun sweeps=price_list seeds=2                     the same of every choice, one at a time

A run's folder holds config.yaml, a folder a stage (checkpoint, handover.json, TensorBoard events, images),
images/ of the test views, per_image.json and metrics.json; where there are views that nothing learns from
(data.held_out, or validation views) also accuracy_time.csv and accuracy_time.png.
Watch: tensorboard --logdir runs
"""


def train(config) -> float | None:
    """Fit what is not finished, then measure what was not; returns the score, where one is wanted."""
    from forewarp.cli.absent import refuse_absent
    from forewarp.runs.identity import claim, hashed, resumed
    from forewarp.runs.trust import check_planned, trust_of

    refuse_seeds(config)
    refuse_two_models(config)
    trust = trust_of(config.get("trust"))
    if config.get("planned") is not None:
        check_planned(config, trust)
    if config.get("score") not in (None, "psnr"):
        from forewarp.runs.score import named

        named(config.score)
    config = resumed(config)
    refuse_absent(config)
    # These load torch; what is mistyped has been answered before.
    from forewarp.cli.report import draw_run
    from forewarp.runs.build import build_run, is_measured, measure_run
    from forewarp.runs.lock import alone, same_data
    from forewarp.runs.score import Score

    config = hashed(planned(config))
    run = build_run(config)
    if skips(run, config.get("absent", "refuse")):
        print(f"skipped: {run.datamodule.place}: no such scene")
        return None
    if config.evaluate and is_measured(run):
        with alone(run.folder):
            claim(config, finished=True)
            same_data(run, config.get("data_changed", "refuse"))
            print(f"measured before: {run.folder}; again with forewarp-evaluate run={run.folder}")
            return Score(run, config).of()
    run.datamodule.setup("fit")  # before the folder is made: a mistyped scene leaves nothing behind
    score = Score(run, config)
    with alone(run.folder):
        claim(config)
        same_data(run, config.get("data_changed", "refuse"))
        keep_plan(config)
        print(beginning(run, config), flush=True)
        module = run.fit()
        if config.evaluate:
            measure_run(run, module, config)
        else:
            print(f"fitted: {run.folder}; measure it with forewarp-evaluate run={run.folder}")
        draw_run(run.folder)
        value = score.of(module)
    tell_skipped(run)
    return value


def planned(config):
    """With ``effects=auto`` the config of the run that a plan says, made now where there is none yet."""
    choice = config.get("effects", "given")
    if choice not in ("given", "auto"):
        raise ValueError(f"effects: expected given or auto, but got {choice}")
    if choice == "given" or config.get("resume") is not None:
        return config
    from forewarp.planning.plan import make_plan
    from forewarp.planning.plan_file import own_folder, tell
    from forewarp.planning.trials import composed
    from forewarp.runs.build import build_run
    from forewarp.runs.overrides import merged, of_what_is_on, typed_words

    if skips(build_run(config), config.get("absent", "refuse")):
        return config
    made = make_plan(config, typed_words())
    tell(made, to_fit=False)
    words = typed_words(all_of_them=True)
    config = composed(of_what_is_on(merged([*made["words"], *own_folder(words)], words)))
    config.planned = made["file"]
    return config


def keep_plan(config) -> None:
    """Put the plan that a run follows into its folder."""
    from pathlib import Path
    from shutil import copyfile

    if config.get("planned") is not None and Path(config.planned).is_file():
        copyfile(config.planned, Path(config.run) / "plan.yaml")


def refuse_seeds(config) -> None:
    """Refuse ``seeds=`` where nothing repeats the run, or where a sweeper would search among them."""
    from hydra.core.hydra_config import HydraConfig
    from hydra.types import RunMode

    alone = not (HydraConfig.initialized() and HydraConfig.get().mode == RunMode.MULTIRUN)
    if alone and config.get("seeds", 1) != 1:
        raise ValueError(f"seeds: expected --multirun beside seeds={config.seeds}; add it, or use seed=N")
    if not alone and "_optuna_" in str(HydraConfig.get().sweeper.get("_target_")):
        swept = str((HydraConfig.get().sweeper.get("params") or {}).get("seed", ""))
        if config.get("seeds", 1) != 1:
            raise ValueError(f"seeds: expected 1 of a search, but got {config.seeds}; use seed=N")
        if swept.startswith("range"):
            raise ValueError(
                "hydra.sweeper.params.seed: expected one seed, as this sweeper would search among several, "
                f"but got {swept}; add hydra.sweeper.params.seed=0"
            )


def refuse_two_models(config) -> None:
    """Refuse an ablation of another method."""
    known = config.get("variant") or {}
    if config.model.name not in known.get("of", [config.model.name]):
        raise ValueError(
            f"model: expected {' or '.join(known.of)}, which {known.name} is a change of, but got "
            f"{config.model.name}; leave one of them out"
        )


def beginning(run, config) -> str:
    """What is about to be trained, on what, and where it goes: two lines."""
    from forewarp.training.device import device_of

    scene, device = run.datamodule.scene, device_of(config.trainer.accelerator).type.upper()
    views = f"{_images(scene.train, 'training')} and {_images(scene.test, 'test')}"
    return f"{scene.name}: {views}, on the {device}\nrun: {run.folder}"


def _images(frames, kind: str) -> str:
    sizes = sorted({(frame.camera.width, frame.camera.height) for frame in frames})
    ends = dict.fromkeys([*sizes[:1], *sizes[-1:]])
    size = " to ".join(f"{width} x {height}" for width, height in ends)
    return f"{len(frames)} {kind} images" + (f" ({size})" if size else "")


def skips(run, absent: str) -> bool:
    """Whether a job of a sweep is left out, as its scene is not there; what makes its own scene never is."""
    if absent not in ("refuse", "skip"):
        raise ValueError(f"absent: expected refuse or skip, but got {absent}")
    if absent == "refuse" or hasattr(run.datamodule, "prepare"):
        return False
    return run.datamodule.place is not None and not run.datamodule.place.is_dir()


def tell_skipped(run) -> None:
    """Say of every stage how many steps were left out, where any were."""
    for name, noted in run.finished().items():
        if steps := noted.get("skipped_steps"):
            print(f"{name}: {steps} broken steps skipped; each lies in {run.folder / name / 'broken'}")


def main() -> None:
    """The console script."""
    command("train", train, HELP)


if __name__ == "__main__":
    main()
