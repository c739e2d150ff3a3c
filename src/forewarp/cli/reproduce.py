"""
forewarp-reproduce runs the sweeps of a page, and then writes the page. A failed job is named at the end and
stops no other; finished jobs are skipped, so the same command continues. `make TARGET KEY=...` calls it.

  forewarp-reproduce tables                          every method on procedural counterparts, no data needed
  forewarp-reproduce tables data=DATASETS scenes=hook,lego methods=all minutes=5 seeds=3
  forewarp-reproduce price-list data=DATASETS model=forward
  forewarp-reproduce ablations preset=compact data=DATASETS   each part at rest, on hook and a counterpart
  forewarp-reproduce ablations small=1                        the same runs, a few steps each: does it work?

What it runs:
  demo            the procedural vehicle by three methods, two at a time, beside each other, and a video
  tables          the paper's tables; with data=FOLDER on real scenes (FOLDER/dnerf/hook ...)
  ablations       what each part of the paper's method brings on counterparts, at equal minutes and steps;
                  with preset=compact where training has come to rest, two seeds at a time
  accuracy-time   accuracy of each choice against training time, on one scene
  price-list      what each choice costs and brings, on the procedural vehicle and real scenes
  effects         what a scene calls for, the preset, every effect and none
  gpu             seconds of steps and frames, and PSNR against seconds, of model=forward on device=gpu

Keys (capitals do, too):
  data=FOLDER       holds dnerf/hook and so on; without it procedural scenes
  scenes=A,B        of the D-NeRF scenes
  methods=A,B|all   tables: in place of a sweep's own
  model=NAME        accuracy-time, price-list, effects: particles or forward
  preset=NAME       demo, fast or faithful; ablations: compact
  minutes=N         of training a run;  steps=N  optimiser steps a run
  seeds=3           seeds 0, 1 and 2;  seeds=4,7  these
  sweeps=A,B|all    tables: in place of the default; ablations: both sweeps of ablations
  changes="K=1,2"   accuracy-time, price-list: these in place of sweeps/price_list_<model>.yaml
  views=N           test views to measure;  out=FOLDER  where the page goes
  jobs=N            sweeps at a time where two are possible (2);  threads=N  CPU threads a run
  launcher=NAME     where jobs run, as of forewarp-train;  device=cpu|gpu  of gpu
  more="K=V ..."    overrides added to every sweep
  small=1           tiny scenes and a few steps, to try the command
  plan_only=true    say how many runs there are and what each will take, and end there; without it a sum is
                    said first (not with small=1)
"""

from __future__ import annotations

import difflib
import shlex
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from itertools import chain
from pathlib import Path
from types import SimpleNamespace

import yaml

from forewarp.cli.entry import INTERRUPTED, MISTAKE, arguments_of, interrupted, project_root
from forewarp.cli.mistakes import flat, one_line
from forewarp.data.files import one_of
from forewarp.interrupts import listening
from forewarp.runs import overrides
from forewarp.runs.config_files import configurations
from forewarp.runs.overrides import key_of, merged

# Keys that may be typed, with what they are where they are left out.
KEYS = shlex.split("data scenes methods model preset minutes steps seeds sweeps changes views out threads")
KEYS = dict.fromkeys([*KEYS, "launcher", "more", "small", "plan_only"], "") | {"jobs": "2", "device": "gpu"}
TABLES = ["dnerf", "hypernerf", "nhr", "lego_complete"]
ABLATIONS = ["ablation_modules", "ablation_losses"]
OF_FORWARD = [*ABLATIONS, "resolution"]
# Sweeps and the counterparts they run on without data: long ones first, as a free core takes the next.
COUNTERPARTS = (
    "methods:hypernerf methods:dnerf ablation_modules:hypernerf resolution:hypernerf ablation_losses:dnerf "
    "flow:drive nhr:nhr lego_complete:lego_complete ablation_modules:dnerf ablation_modules:lego_complete"
)
# The voxel networks come with the fine stage, to which the demo's numbers give too little of the training; on
# fewer rays and voxels it makes enough steps within minutes.
OF_ABLATIONS = shlex.split(
    "stage.fine.share=2 preset.rays=512 modules.num_voxels=[[0,4096]] callbacks.accuracy=null "
    "callbacks.pictures=null logger=none paths.runs=runs/ablations"
)
ROOM = ["stage.coarse.background_num_voxels=[[0,27000]]", "stage.fine.background_num_voxels=[[0,110592]]"]
# With small=1, beside Job.small; gpu has a tiny model, and tables have scenes as small as metrics allow.
SMALL = shlex.split("sheets=1 logger=none callbacks.pictures=null")
FEW = {
    "dnerf": "data.synthesis.size=64 data.synthesis.frames=16 data.synthesis.test_views=[2,2,2]",
    "hypernerf": "data.synthesis.frames=9",
    "nhr": "data.synthesis.size=96 data.synthesis.frames=6",
    "lego_complete": "data.synthesis.size=64 data.synthesis.frames=8 data.synthesis.test_views=[1,2,4] "
    "data.synthesis.motions=[lift_tilt,drive]",
}
FEW["drive"] = FEW["lego_complete"]  # of one folder
FEW_VOXELS = "modules.num_voxels=[[0,4096]] preset.rays=256"
FEW_IN_ROOM = "stage.coarse.num_voxels=[[0,8000]] stage.coarse.background_num_voxels=[[0,1000]] "
FEW_IN_ROOM += "stage.fine.background_num_voxels=[[0,8000]]"
TINY = shlex.split(
    "data.scene=tiny paths.data=runs/bench-gpu data.synthesis.size=32 data.synthesis.frames=8 "
    "data.synthesis.test_views=[1,1,1] preset.rays=64 preset.inpainter_width=16 data.held_out=2 "
    "stage.coarse.num_voxels=[[0,1000]] stage.fine.num_voxels=[[0,1500]]"
)
Sweep = list[str]  # the overrides of one `forewarp-train`


class Keys(SimpleNamespace):
    """What was typed, as text; "" where a key was left out."""

    @classmethod
    def typed(cls, arguments: list[str]) -> Keys:
        """Read ``key=value`` words.

        Raises:
            ValueError: for another word, or a key that there is not.
        """
        typed = {}
        for argument in arguments:
            key, equals, value = argument.partition("=")
            key = key.lower()
            if not equals or key not in KEYS:
                near = difflib.get_close_matches(key, KEYS, 1)
                hint = f"did you mean {near[0]}=?" if near else f"known are {', '.join(KEYS)}"
                raise ValueError(f"expected key=value with a known key, but got '{argument}'; {hint}")
            typed |= {key: value} if value else {}
        return cls(**KEYS | typed)

    def chosen(self, *scenes: str) -> Sweep:
        """Return overrides that choose scenes of D-NeRF in ``data``; none without it."""
        scene = f"data.scene={','.join(scenes)}"
        return [f"paths.scenes={self.data}", "dataset=dnerf", scene] if self.data else []

    def drawn(self, default: str = "") -> Sweep:
        """Return the override of seeds: so many, or those listed."""
        seeds = self.seeds or default
        return [] if not seeds else [f"seed={seeds}" if "," in seeds else f"seeds={seeds}"]

    def given(self, *names: str) -> Sweep:
        """Return those of the keys that were typed, as ``key=value``."""
        return [f"{name}={getattr(self, name)}" for name in names if getattr(self, name)]

    def of_two(self) -> str:
        """Return the model, which is one of two.

        Raises:
            ValueError: for another one.
        """
        model = self.model or "particles"
        one_of(model, "model", "particles", "forward")
        return model


@dataclass
class Job:
    """What to run: lanes of sweeps, ``jobs`` lanes at a time, then other commands, one after the other."""

    lanes: list[list[Sweep]]
    then: list[list[str]]
    jobs: int = 1
    small: tuple[str, str, str] = ("0.01", "4", "1")  # of a small run: minutes, or steps, and test views


def plan_of(kind: str, keys: Keys) -> Job:
    """Return what ``kind`` runs with these keys.

    Raises:
        ValueError: for a kind that there is not, or a key that would have no effect.
    """
    if kind not in KINDS:
        raise ValueError(f"expected one of {', '.join(KINDS)}, but got '{kind}'")
    job = KINDS[kind](keys)
    more = [*shlex.split(keys.more), *keys.given("threads", "launcher")]
    job.lanes = [[merged(sweep, more) for sweep in lane] for lane in job.lanes if lane]
    return _made_small(job) if keys.small else job


def _made_small(job: Job) -> Job:
    """Shorten all runs, and keep them and their pages apart, below runs/small."""

    def shortened(sweep: Sweep) -> Sweep:
        by_steps = any(word.startswith("budget.iterations=") for word in sweep)
        minutes, steps, views = job.small
        until = _until(steps=steps) if by_steps else _until(minutes)
        return apart(merged(sweep, [*SMALL, *until, f"views={views}"]))

    def apart(command: list[str]) -> list[str]:
        moved = [word.replace("out=docs/", "out=runs/").replace("runs/", "runs/small/") for word in command]
        named = any(word.startswith(("run=", "runs=", "paths.runs=", "out=")) for word in moved)
        return moved if named else [*moved, "paths.runs=runs/small"]

    job.lanes = [[shortened(sweep) for sweep in lane] for lane in job.lanes]
    job.then = [apart(command) for command in job.then]
    return job


def words(text: str) -> list[str]:
    """Split a list at spaces and commas.

    >>> words("hook, lego mutant")
    ['hook', 'lego', 'mutant']
    """
    return text.replace(",", " ").split()


def demo(keys: Keys) -> Job:
    """Fit the procedural vehicle by three methods; make a video and a page that plays by particles."""
    # Kernels of particles compile for half a minute the first time, beside the others' training.
    # Processor time, as beside other work a wall clock would leave some stages without a step.
    common = ["experiment=demo", "threads=1", "trainer=cpu", "budget.clock=processor"]
    common.append(f"budget.minutes={keys.minutes or 0.3}")
    fits = {model: f"runs/demo/{model}" for model in ("particles", "forward", "backward")}
    lanes = [[[*common, f"model={model}", f"run={run}"]] for model, run in fits.items()]
    lanes[0][0].append("~stage.coarse")  # in so short a run its start alone may take all its time
    compare = ["report", "kind=compare", f"runs=[{','.join(fits.values())}]", "out=runs/demo"]
    film = ["render", "run=runs/demo/particles", "path=both"]
    page = ["export", "run=runs/demo/particles", "format=html"]
    return Job(lanes, [compare, film, page], int(keys.jobs))


def tables(keys: Keys) -> Job:
    """Make the paper's tables: of counterparts by all methods, or of the scenes in a folder."""
    scenes = words(keys.scenes)
    sweeps = words(keys.sweeps) or (["dnerf"] if scenes else TABLES)
    if scenes and not keys.data:
        raise ValueError("scenes: expected data=<folder that holds dnerf/> beside it, but got none")
    if not keys.data and keys.sweeps not in ("", "all", "ablations"):
        raise ValueError(f"sweeps: expected all or ablations without data=, but got {keys.sweeps}")
    if "methods" in sweeps and not scenes:
        advice = "methods=all fits all scenes by all methods"
        raise ValueError(f"scenes: expected scenes=hook,... beside sweeps=methods, but got none; {advice}")
    preset = keys.preset or ("fast" if keys.data else "demo")
    minutes = keys.minutes or ("null" if preset == "faithful" else "5" if keys.data else "1")
    base = [f"preset={preset}", *_until(minutes, keys.steps), *keys.drawn("1"), "score=null"]
    base += keys.given("views")
    out = keys.out or "runs/paper/results"
    then = [["report", "kind=paper", "runs=runs/paper", f"out={out}", "curves=docs/results"]]
    if not keys.data:
        sweeps = keys.sweeps or ("all" if keys.small else "")
        return Job(_counterparts(sweeps, base, keys), then, int(keys.jobs))
    if sweeps == ["all"]:
        sweeps = [*TABLES, *OF_FORWARD]
    sweeps = [name for sweep in sweeps for name in (ABLATIONS if sweep == "ablations" else [sweep])]
    base += [*keys.chosen(*scenes), "absent=refuse"] if scenes else [f"paths.scenes={keys.data}"]
    return Job([[[*base, f"sweeps={sweep}", *_models(keys.methods, sweep)] for sweep in sweeps]], then)


def _until(minutes: str | None = None, steps: str | None = None) -> Sweep:
    return ["budget.minutes=null", f"budget.iterations={steps}"] if steps else [f"budget.minutes={minutes}"]


def _models(methods: str, sweep: str) -> Sweep:
    """Return the override that names methods in place of a sweep's own, where a sweep is of any method."""
    if not methods or sweep in (*OF_FORWARD, "flow"):
        return []
    if methods == "all":
        content = yaml.safe_load((project_root() / "sweeps" / "methods.yaml").read_text())
        methods = content["hydra"]["sweeper"]["params"]["model"]
    return [f"model={','.join(words(methods))}"]


def _counterparts(sweeps: str, base: Sweep, keys: Keys) -> list[list[Sweep]]:
    """Return the sweeps of counterparts, a lane each: the tables', those of ``ablations``, or ``all``, which
    together draw every figure.
    """
    left_out = {"": OF_FORWARD, "ablations": [*TABLES, "methods", "resolution", "flow"], "all": []}
    base = [*base, "budget.clock=processor", "threads=1"]

    def of_pair(sweep: str, data: str) -> Sweep:
        more = _models(keys.methods, sweep)
        if data == "hypernerf" and sweeps == "ablations":
            more += ROOM
        if keys.small and sweeps == "all":
            more += [*shlex.split(FEW[data]), "paths.data=runs/data", "callbacks.accuracy=null"]
            more += shlex.split(FEW_VOXELS) * (sweep in OF_FORWARD)
            more += shlex.split(FEW_IN_ROOM) * (sweep in OF_FORWARD and data == "hypernerf")
        return [*base, f"sweeps={sweep}", f"scene=counterpart_{data}", *more]

    pairs = [pair.split(":") for pair in COUNTERPARTS.split()]
    return [[of_pair(*pair)] for pair in pairs if pair[0] not in left_out[sweeps]]


def ablations(keys: Keys) -> Job:
    """Leave out each part of the paper's method on three counterparts, at equal minutes and equal steps."""
    if keys.preset == "compact":
        return _at_rest(keys)
    if keys.data or keys.methods:
        expected = "data, methods: expected none, as ablations are of model=forward on counterparts"
        advice = f"of real scenes: forewarp-reproduce tables data={keys.data or 'FOLDER'} sweeps=ablations"
        raise ValueError(f"{expected}, but got some; {advice}")
    common = [f"preset={keys.preset or 'demo'}", f"views={keys.views or 9}", "score=null", *keys.drawn("2")]
    untils = _until(keys.minutes or "2.5"), _until(steps=keys.steps or "600")
    each = [_counterparts("ablations", [*common, *until, *OF_ABLATIONS], keys) for until in untils]
    job = Job([first + second for first, second in zip(*each)], [_ablation_page(keys)], int(keys.jobs))
    if keys.small:  # without the scene that costs most; the two lanes take about as long
        job.lanes = [[sweep for sweep in chain(*lanes) if ROOM[0] not in sweep] for lanes in each]
        job.small = ("0.02", "8", "5")
    return job


def _at_rest(keys: Keys) -> Job:
    """Leave out each part where training has come to rest; a lane for each seed."""
    unused = ("minutes", "methods", "scenes", "sweeps", "model", "changes")
    if given := keys.given(*unused):
        raise ValueError(f"{', '.join(given)}: expected none beside preset=compact, but got some")
    base = ["sweeps=ablation_converged", "score=null", "paths.runs=runs/ablations", *keys.given("views")]
    base += _until(steps=keys.steps or "1") if keys.steps or keys.small else []
    base += [f"paths.scenes={keys.data}"] if keys.data else []
    seeds = keys.seeds or "2"
    drawn = words(seeds) if "," in seeds else range(int(seeds))
    lanes = [[[*base, f"seed={seed}"]] for seed in drawn]
    return Job(lanes, [_ablation_page(keys)], int(keys.jobs))


def _ablation_page(keys: Keys) -> list[str]:
    return ["report", "kind=ablation", "runs=runs/ablations", f"out={keys.out or 'docs/results'}"]


def _compared(keys: Keys, base: Sweep) -> list[Sweep]:
    """All changes of the method's price list; with ``changes`` the reference, then these."""
    if keys.changes:
        reference = [*base, "sweeps=accuracy_time", *keys.given("model")]
        return [reference, [*reference, *shlex.split(keys.changes)]]
    return [[*base, f"sweeps=price_list_{keys.of_two()}"]]


def accuracy_time(keys: Keys) -> Job:
    """Draw the accuracy of each choice against training time, on one scene."""
    base = [f"budget.minutes={keys.minutes or 3}", *keys.drawn()]
    base += keys.chosen(*words(keys.scenes or "jumpingjacks"))
    return Job([_compared(keys, base)], [["report", "kind=accuracy_time", *keys.given("out")]])


def price_list(keys: Keys) -> Job:
    """List what each choice costs and brings, on the vehicle and real scenes."""
    if not keys.data:
        raise ValueError("data: expected data=<folder that holds dnerf/>, but got none")
    runs = f"runs/price-list/{keys.model or 'particles'}"
    base = [f"budget.minutes={keys.minutes or 3}", *keys.drawn("2"), f"paths.runs={runs}"]
    lane = _compared(keys, base)
    for scene in words(keys.scenes or "jumpingjacks hook"):
        lane += _compared(keys, [*base, *keys.chosen(scene)])
    return Job([lane], [["report", "kind=price_list", f"runs={runs}", f"out={keys.out or 'docs/results'}"]])


def effects(keys: Keys) -> Job:
    """Compare what a scene calls for with the preset, with every effect and with none."""
    model = keys.of_two()
    every = "all_effects" + "_particles" * (model == "particles")
    lane = ["sweeps=effects", *keys.drawn("" if keys.data else "2"), f"model={model}"]
    lane += [f"ablation=auto,base,{every},no_effects", f"budget.minutes={keys.minutes or 1}"]
    scenes = keys.chosen(*words(keys.scenes or "bouncingballs hook"))
    return Job([[[*lane, *scenes]]], [["report", "kind=effects", *keys.given("out")]])


def gpu(keys: Keys) -> Job:
    """Time steps and frames, and PSNR against seconds, of the paper's method on a GPU."""
    lane, folder = [], "runs/bench-gpu"
    for scene in words(keys.scenes or "jumpingjacks hook") if keys.data else ["vehicle"]:
        base = ["model=forward", "start_motion=own", f"trainer={keys.device}", *keys.chosen(scene)]
        base += ["+variant.name=base"]
        fast = ["preset=fast", "data.held_out=8", *_until(keys.minutes or "10"), f"run={folder}/{scene}-fast"]
        faithful = ["preset=faithful", *_until(steps="240"), f"run={folder}/{scene}-faithful"]
        lane += [merged([*base, *half], TINY if keys.small else []) for half in (fast, faithful)]
    pages = ("accuracy_time", "price_list")
    then = [["report", f"kind={kind}", f"runs={folder}", f"out={folder}/results"] for kind in pages]
    return Job([lane], then)


def cost_of(job: Job, *, listed: bool = False) -> list[str]:
    """Say in lines how many runs a job has, and what they will take; with ``listed`` also each of them.

    Raises:
        ValueError, HydraException, OmegaConfBaseException: if a run is no possible one.
    """
    from hydra import compose, initialize_config_dir
    from omegaconf import read_write

    from forewarp.runs.cost import Total, joined
    from forewarp.runs.jobs import cost_of_sweep, listing

    lines = []

    def total_of(sweep: Sweep) -> Total:
        typed = arguments_of("train", sweep)
        single = [word for word in typed if not overrides.is_sweep(word)]
        config = compose("train", [*single, "hydra.mode=MULTIRUN"], return_hydra_config=True)
        with read_write(config.hydra):
            config.hydra.overrides.task = [word for word in typed if not word.startswith("hydra.")]
        overrides.constant.clear()
        overrides.constant.update(map(key_of, single))
        costs, whole = cost_of_sweep(config, every=listed)
        lines.extend(listing(costs))
        return whole

    with initialize_config_dir(str(configurations()), version_base="1.3"):
        lanes = [[total_of(sweep) for sweep in lane] for lane in job.lanes]
    return [*joined(lanes, min(job.jobs, len(lanes))).lines(), *(lines if listed else [])]


KINDS = demo, tables, ablations, accuracy_time, price_list, effects, gpu
KINDS = {kind.__name__.replace("_", "-"): kind for kind in KINDS}
_RUNNING: set[subprocess.Popen] = set()


def run(job: Job) -> int:
    """Run all sweeps, then the other commands; return the worst exit status. Ctrl-C ends everything."""

    def run_lane(lane: list[Sweep], prefix: str) -> int:
        return max(_call("train", sweep, prefix) for sweep in lane)

    at_once = min(job.jobs, len(job.lanes))
    prefixes = [f"{number} | " if at_once > 1 else "" for number in range(1, len(job.lanes) + 1)]
    with ThreadPoolExecutor(at_once) as pool:
        try:
            statuses = list(pool.map(run_lane, job.lanes, prefixes))
        except KeyboardInterrupt:
            for process in list(_RUNNING):
                process.terminate()
            raise
    return max([*statuses, *(_call(name, arguments) for name, *arguments in job.then)])


def _call(name: str, arguments: list[str], prefix: str = "") -> int:
    """Run a command, each line of its output behind ``prefix``; return its exit status.

    Raises:
        KeyboardInterrupt: if the command was interrupted, with the number of the signal.
    """
    if name == "train" and not any(word.startswith("run=") for word in arguments):
        arguments = ["--multirun", *arguments]
    print(f"{prefix}{shlex.join([f'forewarp-{name}', *arguments])}", flush=True)
    arguments = [*arguments, *["~hydra.callbacks.cost"] * (name == "train")]  # all of it was said before
    command = [str(Path(sys.executable).with_name(f"forewarp-{name}")), *arguments]
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.STDOUT} if prefix else {}
    with subprocess.Popen(command, text=True, **pipes) as process:
        _RUNNING.add(process)
        try:
            for line in process.stdout or ():
                print(f"{prefix}{line}", end="", flush=True)
            process.wait()
        except BaseException:  # leave no command behind, and let it save
            _end(process)
            raise
        finally:
            _RUNNING.discard(process)
    if process.returncode < 0 or process.returncode > INTERRUPTED:
        raise KeyboardInterrupt(abs(process.returncode) % INTERRUPTED)
    return process.returncode


def _end(process: subprocess.Popen) -> None:
    """Ask a command to end, and wait for it; another interruption kills it."""
    process.terminate()
    try:
        process.communicate()
    except BaseException:
        process.kill()
        raise


def main() -> None:
    """Run the console script."""
    kind, *arguments = sys.argv[1:] or ["--help"]
    if {"-h", "--help"} & {kind, *arguments}:
        print(__doc__.strip())
        return
    try:
        keys = Keys.typed(arguments)
        job = plan_of(kind, keys)
    except ValueError as error:
        print(f"forewarp-reproduce: error: {error}", file=sys.stderr)
        sys.exit(MISTAKE)
    plan_only = keys.plan_only not in ("", "false", "0")
    try:
        if plan_only or not keys.small:
            print(*cost_of(job, listed=plan_only), sep="\n", flush=True)
    except Exception as error:
        line = one_line(error) or flat(str(error))
        if plan_only:
            print(f"forewarp-reproduce: error: {line}", file=sys.stderr)
            sys.exit(MISTAKE)
        print(f"no estimate: {line}", flush=True)  # the sweep with the mistake ends with it
    try:
        with listening():
            sys.exit(0 if plan_only else run(job))
    except KeyboardInterrupt as interruption:
        sys.exit(interrupted("reproduce", interruption))


if __name__ == "__main__":
    main()
