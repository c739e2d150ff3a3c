import ast
import errno
import logging
import os
import platform
import shlex
import shutil
import signal
import subprocess
import sys
from importlib.metadata import version
from pathlib import Path
from types import SimpleNamespace

import pytest
from hydra import initialize_config_dir
from hydra.core.global_hydra import GlobalHydra
from hydra.errors import HydraException
from jinja2 import UndefinedError
from lightning.pytorch.loggers import mlflow
from omegaconf import OmegaConf
from omegaconf.errors import ConfigKeyError

from forewarp.cli import entry
from forewarp.cli.mistakes import one_line, unknown_key, with_keys
from forewarp.data.files import SceneError
from forewarp.provenance import drop_missing_backend
from forewarp.runs.overrides import next_command
from forewarp.runs.session import claim
from tests.support.configs import CONF, ROOT, options

TEXTS = {path.stem: path.read_text() for path in sorted(Path(entry.__file__).parent.glob("*.py"))}
COMMANDS = ("open", "train", "evaluate", "render", "export", "synthesize", "report", "capture")


@pytest.mark.parametrize(("policy", "spins"), [(None, "10000"), ("PASSIVE", "10000"), ("active", None)])
def test_threads_that_wait_passively_spin_a_little_first(monkeypatch, policy, spins):
    for name, value in (("OMP_WAIT_POLICY", policy), ("GOMP_SPINCOUNT", None)):
        monkeypatch.delenv(name, raising=False)
        if value is not None:
            monkeypatch.setenv(name, value)
    entry.wait_briefly()
    assert os.environ.get("GOMP_SPINCOUNT") == spins
    assert os.environ["OMP_WAIT_POLICY"] == (policy or "passive")


@pytest.mark.parametrize("name", COMMANDS)
def test_help_says_what_it_does_and_what_one_types(ok, name):
    done = ok(name, "--help")
    assert done.out.startswith(f"forewarp-{name} ")
    assert done.out.count(f"forewarp-{name}") >= 2  # and examples
    assert done.err == ""


@pytest.mark.slow
def test_help_lists_every_choice(forewarp):
    lines = forewarp("train", "--help").out.splitlines()
    for group in ("data", "model", "model/view_dependence", "preset", "capture", "experiment", "trainer"):
        (line,) = [line for line in lines if line.split()[:1] == [group]]
        assert line.split()[1::2] == options(group)


@pytest.mark.slow
def test_info_prints_where_options_come_from(ok, monkeypatch):
    for name, value in (("handlers", []), ("level", logging.WARNING)):  # Hydra sets them
        monkeypatch.setattr(logging.root, name, value)
    monkeypatch.setattr(logging, "raiseExceptions", True)
    assert f"file://{CONF}" in ok("train", "--info", "searchpath").out
    assert "preset: fast" in ok("train", "--info=defaults-tree", "model=nerf").out
    assert "preset: demo" in ok("train", "model=nerf", "--info", "defaults-tree", "preset=demo").out


@pytest.mark.parametrize("name", [name for name, text in TEXTS.items() if "\ndef main(" in text])
def test_every_command_runs_as_a_module_too(name):
    *_, last = ast.parse(TEXTS[name]).body
    assert ast.unparse(last) == "if __name__ == '__main__':\n    main()"


def test_the_version_is_forewarps(ok):
    assert ok("report", "--version").out == f"forewarp {version('forewarp')}\n"


def test_variables_of_launchers_decide_nothing(monkeypatch):
    of_others = {"PL_TRAINER_MAX_STEPS": "1", "RANK": "", "LOCAL_RANK": "x", "SLURM_PROCID": "2"}
    for name, value in of_others.items():
        monkeypatch.setenv(name, value)
    entry.drop_launchers()
    left = [name for name in os.environ if name.startswith("PL_TRAINER") or name in ("RANK", "LOCAL_RANK")]
    assert left == []
    assert os.environ["SLURM_PROCID"] == "2"  # launchers of sweeps need it; ``SingleProcess`` is of rank 0


@pytest.mark.parametrize(
    ("named", "left"),
    [
        ("module://not_there.inline", "agg"),
        ("module://json.decoder", "module://json.decoder"),
        ("svg", "svg"),
    ],
)
def test_a_notebooks_backend_that_is_not_installed_is_dropped(monkeypatch, named, left):
    monkeypatch.setenv("MPLBACKEND", named)
    drop_missing_backend()
    assert os.environ["MPLBACKEND"] == left


def test_missing_conf_is_named(refused, monkeypatch, in_tmp):
    monkeypatch.setenv("FOREWARP_ROOT", str(in_tmp))
    line = refused("train")
    assert line.startswith(f"{in_tmp / 'conf'}: expected the configuration files, but got none; ")


@pytest.mark.slow
@pytest.mark.parametrize("installed", [False, True])
def test_data_lie_in_the_checkout_or_in_the_current_folder(forewarp, monkeypatch, in_tmp, installed):
    monkeypatch.delenv("FOREWARP_ROOT", raising=False)  # other tests compose in this process
    if installed:
        package = in_tmp / "site" / "forewarp"
        shutil.copytree(CONF, package / "conf")
        monkeypatch.setattr("forewarp.runs.config_files.PACKAGE", package)
    shown = OmegaConf.create(forewarp("train", "--cfg", "job", "--resolve").out)
    assert shown.paths.data == ("./data" if installed else str(ROOT / "data"))
    assert shown.run.startswith("runs/")


@pytest.mark.slow
def test_options_of_ones_own_stand_beside_ours(ok, in_tmp):
    override = "defaults:\n  - override /model: backward\n\nseed: 7\n"
    sweep = "hydra: {sweeper: {params: {model: 'forward,backward'}}}\n"
    for group, text in (("experiment", override), ("sweeps", sweep)):
        (in_tmp / "conf" / group).mkdir(parents=True)
        (in_tmp / "conf" / group / "mine.yaml").write_text(f"# @package _global_\n{text}")
    words = ["--config-dir", "conf", "dataset=mine", "preset=demo", "sweeps=mine", "--cfg", "all"]
    config = OmegaConf.create(ok("train", *words).out)
    assert (config.seed, config.model.name, config.preset.name) == (7, "backward", "demo")
    assert config.hydra.sweeper.params.model == "forward,backward"


@pytest.mark.slow
@pytest.mark.parametrize(
    ("arguments", "line"),
    [
        (["data.nothing_like_it=1"], "data.nothing_like_it: expected a key of the configuration, but got"),
        (
            ["data.train_views=3"],
            "data.train_views: expected + before a key that is not in this configuration, ",
        ),
        (["callbacks.pictures.psnr_rays=5"], "; type +callbacks.pictures.psnr_rays=5"),
        (["callbacks={progress: {every: 5}}"], "; type +callbacks.progress.every=VALUE"),
        (["objective.fine.weights.dssim=0.2"], "; type +objective.fine.weights.dssim=0.2"),
        (
            ["model=forward", "model.blur=0.3"],
            "model.blur: expected a key of the configuration, but got none",
        ),
        (["budget.minuts=1"], "got none of this name; did you mean budget.minutes?"),
        (["minutes=2"], "got none of this name; did you mean budget.minutes?"),
        (["experiment=video"], "; did you mean video_with_poses?"),
        (["model=forwrd"], "; did you mean forward?"),
        (["logger=[tensorboard,wand]"], "; none; tensorboard; wandb; did you mean wandb?"),
        (["--inf"], "--inf: expected an option of Hydra's, but got none of this name; did you mean --info?"),
        (["--experiment", "demo"], "--experiment: expected options without dashes; type experiment=demo"),
        (["experiment", "demo"], "or an existing folder, but got neither; type experiment=demo"),
        (["model=nerf", "seeds", "--multirun"], "seeds: expected KEY=VALUE or an existing folder, but got"),
        (["modle/view_dependence=sh"], "modle/view_dependence: expected a key of the configuration, but got"),
        (["--multirun", "seed=0,1", "model=forward,backward", "budgt=fast"], "did you mean budget?"),
        (["data.scene=sc a,b"], "data.scene: expected one value, but got sc a,b, which reads as several; "),
        (["data.scene=a,b"], """type a name that has a comma as "data.scene='a,b'\""""),
        (["data=[1"], "data=[1: no viable alternative at input '[1'"),
        (["budget.minutes=-1"], "budget.minutes: expected a number > 0 or null, but got -1"),
        (["model=forward", "+stage.coarse.bogus=1"], "stage.coarse: expected a key of num_voxels,"),
        (["model=forward", "+model.renderer.bogus=1"], "model.renderer: "),
        (["--multirun", "hydra/sweeper=one_at_a_time", "hydra.sweeper.changes=[]"], "changes: expected at"),
        (["--multirun", "sweeps=dnerf", "hydra.sweeper.scenes=[]"], "hydra.sweeper.scenes: expected at"),
        (["preset=compact"], "preset: expected demo, fast or faithful, as compact is of model=forward"),
        (["model=tnerf", "ablation=base"], "model: expected forward or backward or particles, which base is"),
        (["model=tnerf", "+stage.coarse.share=1"], "stage.coarse: expected a stage of the method, but got"),
    ],
)
def test_a_mistyped_command_ends_in_one_line(refused, in_tmp, arguments, line):
    assert line in refused("train", *arguments, "paths.data=data")
    assert list(in_tmp.iterdir()) == []


@pytest.mark.slow
def test_naming_a_key_leaves_hydra_to_the_other_jobs_of_a_sweep():
    error = HydraException("Could not override 'budgt'")
    GlobalHydra.instance().clear()
    with initialize_config_dir(str(CONF), version_base="1.3"):
        of_sweep = GlobalHydra.instance().hydra
        assert "did you mean budget?" in unknown_key(error, "train", ["budgt=fast"])
        assert GlobalHydra.instance().hydra is of_sweep


@pytest.mark.slow
def test_an_option_that_not_every_job_has_is_named(refused, in_tmp):
    jobs = ["--multirun", "model=forward", "ablation=full,no_coarse", "stage.coarse.hull_frames=3"]
    expected = "stage.coarse.hull_frames: expected an option of every job, but got one that not all have"
    assert expected in refused("train", *jobs, "paths.data=data")


@pytest.mark.slow
@pytest.mark.parametrize(
    ("arguments", "model", "owner"),
    [
        (["preset.rays=1024"], "particles", "forward"),
        (["model/inpainter=unet3d"], "particles", "forward"),
        (["model/motion=spline", "model=forward"], "forward", "particles"),
        (["stage.fine.density=60", "model=backward"], "backward", "particles"),
    ],
)
def test_an_option_of_another_method_names_it(refused, in_tmp, arguments, model, owner):
    line = refused("train", *arguments, "paths.data=data")
    option = arguments[0] if arguments[0] in line else arguments[0].partition("=")[0]
    expected = f"expected an option of model={model}, but got one of model={owner}; add model={owner}"
    assert line == f"{option}: {expected}, or leave it out"
    assert list(in_tmp.iterdir()) == []


@pytest.mark.slow
def test_how_motion_begins_is_own_or_of_particles(refused, in_tmp):
    words = "train", "experiment=dnerf", "data.scene=x"
    expected = "start_motion: expected own or particles, but got 'forward_demo'"
    assert refused(*words, "model=forward", "start_motion=forward_demo") == expected
    for model in ("backward", "nerf", "particles"):
        line = refused(*words, f"model={model}", "start_motion=particles")
        assert line.startswith(f"start_motion=particles: expected an option of model={model}, but")
    key = "stage.coarse.hull_frames"
    line = refused(*words, "model=forward", f"{key}=3")
    assert line.startswith(f"{key}: expected a key of a run that begins with the motion of particles, but")
    assert line.endswith("; add start_motion=own")


@pytest.mark.slow
@pytest.mark.parametrize(("name", "key"), [("evaluate", "run"), ("train", "resume")])
def test_a_bare_folder_is_a_run(refused, in_tmp, name, key):
    (in_tmp / "demo").mkdir()
    line = "demo/config.yaml: expected the configuration of a run, but got none; set "
    assert refused(name, "demo").startswith(f"{line}{key}=")
    line = "runs/nothing: expected KEY=VALUE or an existing folder, but got neither"
    assert refused(name, "runs/nothing") == line


def test_what_follows_an_option_is_no_run(in_tmp):
    (in_tmp / "demo").mkdir()
    words = ["--config-dir", "demo", "demo", "run=demo", "-x", "other"]
    assert with_keys("render", words) == ["--config-dir", "demo", "run=demo", "run=demo", "-x", "other"]
    assert with_keys("synthesize", ["demo"]) == ["demo"]
    for name in ("~stage.coarse", "seed=0"):  # an override, though a sweep's folder has this name
        (in_tmp / name).mkdir()
        assert with_keys("render", [name, f"./{name}"]) == [name, f"run=./{name}"]


@pytest.mark.parametrize(
    ("typed", "path", "printed"),
    [
        (".venv/bin/forewarp-train", "", ".venv/bin/forewarp-view"),
        ("{0}/.venv/bin/forewarp-train", "", ".venv/bin/forewarp-view"),
        ("{0}/.venv/bin/forewarp-train", "{0}/.venv/bin", "forewarp-view"),
        ("/elsewhere/bin/forewarp-train", "", "/elsewhere/bin/forewarp-view"),
        ("forewarp-train", "", "forewarp-view"),
        ("/usr/bin/pytest", "", "forewarp-view"),
    ],
)
def test_a_command_to_type_next_has_the_path_of_this_one(in_tmp, monkeypatch, typed, path, printed):
    program = in_tmp / ".venv" / "bin" / "forewarp-view"
    program.parent.mkdir(parents=True)
    program.touch(0o755)
    monkeypatch.setattr(sys, "argv", [typed.format(in_tmp)])
    monkeypatch.setenv("PATH", path.format(in_tmp) or str(in_tmp))
    assert next_command("view", ["run=a b"]) == f"{printed} 'run=a b'"


@pytest.fixture
def things(in_tmp):
    """A run of a clip, two of another one, a scene, films and images."""
    for run in ("opened/clip/runs/a", "runs/hand/a", "runs/hand/b"):
        (in_tmp / run).mkdir(parents=True)
        (in_tmp / run / "config.yaml").touch()
    for file in (
        "captures/hand/transforms.json",
        "clip.mp4",
        "films/a.MOV",
        "pictures/a.png",
        "rig/cam0/a.png",
    ):
        (in_tmp / file).parent.mkdir(parents=True, exist_ok=True)
        (in_tmp / file).touch()


@pytest.mark.parametrize(
    ("name", "word", "meant"),
    [
        ("capture", "clip.mp4", ["video=clip.mp4"]),
        ("capture", "gone.mp4", ["video=gone.mp4"]),
        ("capture", "films", ["videos=films"]),
        ("capture", "rig", ["videos=rig"]),
        ("capture", "pictures", ["images=pictures"]),
        ("open", "clip.mp4", ["video=clip.mp4"]),
        ("view", "clip", ["run=opened/clip/runs/a"]),
        ("view", "runs/hand/b", ["run=runs/hand/b"]),
        ("report", "clip", ["run=opened/clip/runs/a", "kind=run"]),
        ("report", "run=runs/hand/a", ["run=runs/hand/a", "kind=run"]),
        ("report", "runs/hand", ["runs=runs/hand"]),
        ("train", "runs/hand/a", ["resume=runs/hand/a"]),
        ("view", "nothing", ["nothing"]),
    ],
)
def test_a_file_or_folder_alone_means_what_it_is(things, name, word, meant):
    assert with_keys(name, [word]) == meant


@pytest.mark.parametrize(
    ("name", "word", "says"),
    [
        (
            "view",
            "clip.mp4",
            "clip.mp4: expected the folder of a run, but got a film; type forewarp-open clip.mp4",
        ),
        ("view", "hand", "hand: expected one run, but got 2; type run= and one of runs/hand/a, runs/hand/b"),
        ("train", "captures/hand", "got a scene; type forewarp-train experiment=video_with_poses data.root="),
    ],
)
def test_what_a_command_cannot_take_is_refused_with_what_to_type(refused, things, name, word, says):
    assert says in refused(name, word)


@pytest.mark.slow
def test_an_interpolation_is_typed_as_it_is(refused, in_tmp):
    line = "${x}: expected a key of the configuration, but got none of this name; no name may hold ${"
    assert refused("train", "data.scene=a${x}b") == line
    assert refused("train", "run=${paths.runs}/x", "evaluate=maybe").startswith("evaluate: expected true")


@pytest.mark.parametrize("seeds", ["0", "-1", "1.5", "x", "null"])
def test_a_number_of_seeds_that_would_run_nothing_is_refused(refused, in_tmp, seeds):
    line = f"seeds: expected a whole number of at least 1, but got {seeds}"
    assert refused("train", "--multirun", f"seeds={seeds}") == line


@pytest.mark.slow
def test_the_whole_story_on_demand(forewarp, monkeypatch, in_tmp):
    monkeypatch.setenv("FOREWARP_TRACEBACK", "1")
    done = forewarp("train", "seeds=2")
    assert done.status == 2
    assert "Traceback" in done.err


@pytest.mark.slow
def test_a_bug_keeps_its_traceback(forewarp, monkeypatch, in_tmp):
    def broken(config):
        raise RuntimeError("oops")

    monkeypatch.setattr("forewarp.cli.train.train", broken)
    done = forewarp("train")
    assert done.status == 1
    assert "Traceback" in done.err
    assert done.err.endswith("forewarp-train: error: RuntimeError: oops; this is a bug, please report it\n")


@pytest.mark.slow
@pytest.mark.parametrize("by", ["ctrl-c", "lightning"])
@pytest.mark.parametrize(
    ("number", "status", "says"),
    [(signal.SIGINT, 130, "interrupted"), (signal.SIGTERM, 143, "ended by SIGTERM")],
)
def test_interruption_says_how_to_go_on(forewarp, monkeypatch, in_tmp, by, number, status, says):
    before = signal.signal(signal.SIGINT, signal.default_int_handler)

    def interrupted(config):
        try:
            signal.raise_signal(number)
        except KeyboardInterrupt:
            if by == "lightning":  # exits by itself
                raise SystemExit(1)  # noqa: B904
            raise

    monkeypatch.setattr("forewarp.cli.train.train", interrupted)
    done = forewarp("train")
    assert signal.getsignal(signal.SIGTERM) is signal.SIG_DFL
    signal.signal(signal.SIGINT, before)
    assert done.status == status
    assert f"forewarp-train: {says}; run the same command again" in done.err
    assert "Traceback" not in done.err


@pytest.mark.parametrize(
    ("error", "line"),
    [
        (SceneError("a.json: frames: expected a list,\n but got 1"), "a.json: frames: expected a list,; but"),
        (OSError(errno.ENOSPC, "No space left", "x/last.ckpt"), "x/last.ckpt: expected room to write, but"),
        (
            RuntimeError("[database.cc:68] database or disk is full"),
            "a file: expected room to write, but got No",
        ),
        (PermissionError(errno.EACCES, "Permission denied", "x"), "x: expected a usable file or folder, but"),
        (ImportError("install forewarp[synth]"), "install forewarp[synth]"),
        (
            RuntimeError("Could not determine home directory."),
            "~: expected a user with a home folder, but got",
        ),
        (
            UndefinedError("'x' is undefined"),
            "runs: expected files as forewarp-train and forewarp-evaluate write",
        ),
        (
            ConfigKeyError("Missing key c\n    full_key: a.c\n    object_type=dict"),
            "a.c: expected a value in the run's config.yaml, but got no such key; add a.c",
        ),
        (ModuleNotFoundError("No module named 'trimesh'"), "No module named 'trimesh'; install it with make"),
    ],
)
def test_one_line(error, line):
    assert one_line(error).startswith(line)


@pytest.mark.slow
def test_a_killed_command_leaves_no_temporary_folder(ok, monkeypatch, in_tmp):
    """Whatever there is while a job runs would stay where the process is killed."""
    there = []
    monkeypatch.setattr("tempfile.tempdir", str(in_tmp))
    monkeypatch.setattr("forewarp.cli.train.train", lambda config: there.extend(in_tmp.iterdir()))
    ok("train")
    assert there == list(in_tmp.iterdir()) == []


@pytest.mark.slow
def test_a_failed_job_of_several_does_not_stop_the_others(forewarp, monkeypatch, in_tmp):
    seen = []

    def job(config):
        seen.append(config.seed)
        if config.seed == 0:
            raise ValueError("seed: expected another")

    monkeypatch.setattr("forewarp.cli.train.train", job)
    done = forewarp("train", "seed=0,1", "run=a b/${seed}", "--multirun")
    assert seen == [0, 1]
    assert done.status == 2
    lines = "forewarp-train: error: seed: expected another", "forewarp-train: 1 of 2 jobs failed:"
    assert done.err.splitlines() == [*lines, "  forewarp-train seed=0 'run=a b/${seed}'"]


def test_the_notice_of_a_new_experiment_is_silenced(caplog):
    entry.quiet()
    logging.getLogger(mlflow.__name__).warning("Experiment with name forewarp not found. Creating it.")
    assert caplog.records == []


def test_freed_memory_stays_where_the_c_library_can_be_told(monkeypatch):
    asked = []
    library = SimpleNamespace(mallopt=lambda *given: asked.append(given))
    for found in (library, SimpleNamespace()):  # another library has no such call
        monkeypatch.setattr(entry.ctypes, "CDLL", lambda name, found=found: found)
        entry._keep_memory()
    monkeypatch.undo()
    assert len(asked) == 2
    if platform.libc_ver()[0] == "glibc":
        assert [entry.ctypes.CDLL(None).mallopt(*given) for given in asked] == [1, 1]


@pytest.mark.slow
def test_a_pattern_of_names_is_taken_as_typed_also_of_a_sweep_and_as_stored(ok, in_tmp, monkeypatch):
    seen, pattern = [], r"(?P<camera>\d+)_(?P<frame>\d+)"

    def job(config):
        seen.append((config.seed, config.data.name_pattern))
        claim(config)

    monkeypatch.setattr("forewarp.cli.train.train", job)
    typed = ["data=dnerf", "data.scene=x", "run=a/${seed}", f"data.name_pattern={pattern}"]
    ok("train", "--multirun", "seeds=2", *typed)
    assert seen == [(0, pattern), (1, pattern)]
    stored = shlex.split(OmegaConf.load("a/1/config.yaml").command)
    ok("train", *stored[1:])
    assert seen[2:] == [(1, pattern)]


def test_a_pattern_of_names_is_taken_as_typed(ok, in_tmp, monkeypatch):
    seen = []
    monkeypatch.setattr("forewarp.cli.capture.capture", lambda config: seen.append(config.name_pattern))
    ok("capture", "images=x", "name_pattern=(?P<frame>[0-9]+)$")
    assert seen == ["(?P<frame>[0-9]+)$"]


@pytest.mark.slow
def test_a_terminal_that_knows_ascii_only_shows_other_characters_escaped():
    code = "from forewarp.cli.entry import quiet; quiet(); print('Gr\u00f6\u00dfe')"
    environment = {**os.environ, "PYTHONIOENCODING": "ascii"}
    done = subprocess.run([sys.executable, "-c", code], env=environment, capture_output=True, check=True)
    assert done.stdout.strip() == rb"Gr\xf6\xdfe"


@pytest.mark.parametrize(("encoding", "mend"), [("ascii", "PYTHONUTF8=1"), ("utf-8", "rename the file")])
def test_a_name_that_is_decoded_in_half_says_what_to_set(refused, monkeypatch, encoding, mend):
    monkeypatch.setattr(sys, "getfilesystemencoding", lambda: encoding)
    assert mend in refused("train", "data=dnerf", "data.scene=T\udcc3\udca4nz")
