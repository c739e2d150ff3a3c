"""
forewarp-train fits a moving scene, stage by stage, by the method that model= names, and measures it on its
test views. The same command run again skips what is finished and goes on with what was interrupted.

  forewarp-train                                     the procedural vehicle, written at first use
  forewarp-train experiment=demo                     the same in about a minute
  forewarp-train experiment=dnerf data.root=../data/dnerf data.scene=hook budget.minutes=5

What one types most (beside options such as --multirun or --config-dir=FOLDER):
  data.root=FOLDER data.scene=NAME    where the scenes are, and which one
  preset=demo|fast|faithful           the method's numbers: small, cheap (the default), as in the paper
  budget.minutes=N                    of training, all stages together; 10 with preset=fast
  budget.clock=wall|processor         what minutes are of; processor time does not depend on other work
  budget.iterations=N                 the same in steps; the first that is reached ends training
  target.psnr=DB                      end earlier: once views held out reach it (with data.held_out=8)
  target.plateau=DB                   or once a doubling of training time gains less
  plan_only=true                      say what it will cost, also with --multirun, and end there
  model=particles|forward|backward    Gaussians (default), the paper's method, its like-for-like opponent
  model=nerf|tnerf|dnerf|nerfies|hypernerf   networks along rays, as in their papers with preset=faithful
  model=ndvg|tineuvox_s|tineuvox_b    voxel grids with networks, as in their papers with preset=faithful
  model=neural_volumes                a volume decoded from pictures of the instant
  start_motion=own|particles          of model=forward: its voxels find the motion themselves, or a stage
                                      of particles finds it first (default of preset=fast dataset=dnerf)
  model/view_dependence=none|harmonics     switch an effect; all others work alike (of forward: none|sh|mlp)
  stage.NAME.lr.GROUP=RATE            a learning rate; groups: means, scales, colors, ... (see --cfg job)
  seed=N                              of all random numbers
  trainer=cpu|gpu|auto                the device
  resume=FOLDER                       go on with the run in a folder; no other override is needed
  trust=[PACKAGE]                     beside resume=: code of other packages that the run's config may name
  score=psnr|ssim|ms_ssim|...         metric that a job of --multirun returns, on views not trained on
  sentinel.skip=N                     skip up to N steps of a stage whose numbers are not finite
  run=FOLDER                          the run's folder (runs/<scene>/<model>-<preset>-seed<seed>)
  debug=fast|overfit|profile|limit    a short run to find mistakes: a few steps of all; three views again and
                                      again; where time goes; a part of data and budget
  effects=auto                        find out what the scene calls for, then fit that: see forewarp-plan
  plan=FILE                           fit what a plan says; an override typed beside it wins
  viewer=true                         show the run on a page while it trains: see forewarp-view
  evaluate=false                      do not measure at the end
  views=N                             measure N test views, evenly spread, in place of all
  reduce=2                            average 2 x 2 pixels of each test view and of its truth, then score
  data.name_pattern='REGEX'           frame or time (and camera) in images' names that say it in several ways
  data.depth_kind=axis|ray            depth: along the optical axis, or along each pixel's ray
  data.masks=off                      masks and alpha that say which pixels count are not read
  data.camera_order=number|text       rows of poses_bounds.npy: by number, or as texts (cam1, cam10, cam2)
  data.held_out=N                     hold N training views out and record their PSNR against training time
  dataset=dnerf data.scene=hook       a scene of a dataset below paths.scenes=FOLDER, here FOLDER/dnerf/hook
  ablation=NAME                       an ablation of the paper; ablation=full is its whole method
  logger=tensorboard|csv|wandb|mlflow|none   where curves and scores go; several: logger=[tensorboard,mlflow]
  trackers.film=false                 also .config, .lr, .grad_norm: what else they get; trackers.tags=[pilot]
  windows=N                           a long film in N parts that share what stands still, one after another,
                                      or at once with launcher=joblib; the same as windows=still, then =each
  launcher=local|joblib|ray|slurm|submitit   where the jobs of --multirun run
  ~stage.fine                         drop a stage
  --multirun seeds=3                  one run after another, and before them what they will cost;
                                      --multirun sweeps=dnerf: a prepared sweep
  --multirun sweeps=accuracy_time stage.fine.density=45,180  what choices cost; see forewarp-report
  --multirun sweeps=price_list_particles seeds=2  the same for every choice, one at a time; also _forward

A run's folder holds config.yaml, a folder for each stage (checkpoint, handover.json, images), images/ of the
test views, per_image.json and metrics.json. With data.held_out or validation views it also holds
accuracy_time.csv and accuracy_time.png.
Watch: tensorboard --logdir runs
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence

from forewarp.cli.entry import command
from forewarp.runs.cost import clocks
from forewarp.runs.overrides import next_command

# Of a profiler's table: action, calls, seconds in all. The row of the total has no mean.
_ROW = re.compile(r"^\|\s+(\S.*?)\s*\|\s+\d\S*\s*\|\s+(\d+)\s*\|\s+(\d\S*)\s*\|", re.M)


def train(config) -> float | None:
    """Prepare a run, fit the stages that are not finished, and measure it.

    Returns:
        the run's score, if one is asked for.
    """
    from forewarp.cli.prepare import prepare

    if config.get("plan_only"):
        print(cost_of_one(config), flush=True)
        return None
    moments = [clocks()]
    prepared = prepare(config)
    if prepared is None:  # a sweep goes on without this scene
        return None
    with prepared.session():
        if prepared.measured:
            folder, reduce = prepared.run.folder, prepared.config.get("reduce")
            words = [f"run={folder}", *([f"reduce={reduce}"] if reduce else [])]
            print(f"measured before: {folder}; again with", f"  {next_command('evaluate', words)}", sep="\n")
            return prepared.score.of()
        print(beginning(prepared.run, prepared.config), flush=True)
        is_new = not any(prepared.run.folder.glob("*/last.ckpt"))
        module = prepared.run.fit()
        moments.append(clocks())
        score = measure(prepared, module)
        if is_new and not prepared.config.get("debug"):  # what earlier parts of a run took is unknown
            keep_cost(prepared, [*moments, clocks()])
        return score


def cost_of_one(config) -> str:
    """Say in lines what a run will cost; write nothing."""
    from forewarp.cli.prepare import refuse_all, refuse_missing_scene
    from forewarp.runs.config import resumed
    from forewarp.runs.cost import PRICES, cost_of, job_of, own_file, read_costs, total

    refuse_all(config)
    config = resumed(config)
    refuse_missing_scene(config)
    own = read_costs(own_file())
    job = job_of(config, own)
    lines = total([(job, cost_of(job, own, read_costs(PRICES)))], 1).lines()
    return "\n".join([*lines, f"  run: {job.folder}"])


def keep_cost(prepared, moments: Sequence[Mapping[str, float]]) -> None:
    """Keep what a run took for estimates to come; ``moments``: it began, was fitted, was measured."""
    from forewarp.runs.cost import add_cost, measured_cost

    frames = prepared.run.datamodule.scene.test
    pixels = max((frame.camera.width * frame.camera.height for frame in frames), default=None)
    add_cost(measured_cost(prepared.config, prepared.run.folder, moments, pixels=pixels))


def measure(prepared, module) -> float | None:
    """Measure a fitted run, or say how to; draw its curve; return the score."""
    from forewarp.methods.method import HasMovingGaussians
    from forewarp.report.figures import draw_own
    from forewarp.runs.build import PROFILE
    from forewarp.runs.fitted import doubts_of, log_film, log_scores, measure_run, tell, training_psnr

    run, config = prepared.run, prepared.config
    of_run = f"run={run.folder}"
    if config.evaluate:
        metrics = measure_run(run, module, config)
        log_scores(run, metrics)
        if (config.get("trackers") or {}).get("film"):
            log_film(run, module, metrics)
    else:
        print(f"fitted: {run.folder}; measure it with", f"  {next_command('evaluate', [of_run])}", sep="\n")
        tell(doubts_of(config, run, module.to(run.device)))
    if config.get("debug") == "overfit":
        reached, one_color = training_psnr(run, module.to(run.device))
        views, steps = len(run.datamodule.scene.train), sum(done["steps"] for done in run.finished().values())
        about = f"of {views} training images after {steps} steps; one color alone has {one_color:.2f}"
        print(f"overfit  psnr {reached:.2f} {about}", verdict(reached, one_color), sep="\n")
    for file in sorted(run.folder.glob(f"*/*-{PROFILE}.txt")):
        print(f"profile  {file}", *costliest(file.read_text("utf-8")), sep="\n")
    draw_own(run.folder)
    if config.evaluate:
        plays = isinstance(module.method, HasMovingGaussians)
        shown = [("a page that plays it offline", "export", [of_run, "format=html"])] if plays else []
        shown += [("fly around it", "view", [of_run])]
        shown += [("its scores and worst views, and what to try", "report", ["kind=run", of_run])]
        for what, name, words in shown:
            print(f"{what}:", f"  {next_command(name, words)}", sep="\n")
    score = prepared.score.of(module)
    for name, noted in run.finished().items():
        if steps := noted.get("skipped_steps"):
            print(f"{name}: {steps} broken steps skipped; each lies in {run.folder / name / 'broken'}")
    return score


def verdict(reached: float, one_color: float) -> str:
    """Say whether training images seen again and again are learned, from their PSNR, dB, and one color's."""
    from forewarp.runs.fitted import ABOVE, LOW

    least = max(LOW, one_color + ABOVE)
    if reached >= least:
        return f"overfitted: at least {least:.1f} dB, so the method can learn these images"
    more = "if more steps (budget.iterations) do not help, look for a mistake in the data or the method"
    return f"not overfitted: less than {least:.1f} dB; {more}"


def costliest(table: str, rows: int = 5) -> list[str]:
    """Return the first rows of a simple profiler's sorted table, as lines; none of another table."""
    found = _ROW.findall(table)[:rows]
    lines = [f"  {float(seconds):8.2f} s in {calls:>6} calls  {action}" for action, calls, seconds in found]
    return [*lines, "  (a row includes those that it calls)"] if lines else []


def beginning(run, config) -> str:
    """Say in two lines what is about to be trained, on what device, and into which folder; in one more why
    a GPU is left aside, if it is.
    """
    from forewarp.runs.devices import why_on_cpu

    scene, why = run.datamodule.scene, why_on_cpu(config)
    images = f"{images_of(scene.train, 'training')} and {images_of(scene.test, 'test')}"
    lines = [f"{scene.name}: {images}, on the {run.device.type.upper()}", why, f"run: {run.folder}"]
    lines[1:1] = [f"assumed: {line}" for line in scene.protocol.get("assumed", [])]
    return "\n".join(line for line in lines if line is not None)


def images_of(frames, kind: str) -> str:
    """Count images and say their sizes, the smallest and the largest."""
    sizes = sorted({(frame.camera.width, frame.camera.height) for frame in frames})
    ends = dict.fromkeys([*sizes[:1], *sizes[-1:]])
    size = " to ".join(f"{width} x {height}" for width, height in ends)
    return f"{len(frames)} {kind} images" + (f" ({size})" if size else "")


def main() -> None:
    """Run the console script."""
    command("train", train, __doc__)


if __name__ == "__main__":
    main()
