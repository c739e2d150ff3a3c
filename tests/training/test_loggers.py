"""One run of every tracker for all stages of a run, with its hyperparameters and scores."""

from functools import partial

import lightning
import pytest
import torch
from lightning.pytorch.loggers import MLFlowLogger, TensorBoardLogger, WandbLogger
from lightning.pytorch.utilities.rank_zero import rank_zero_only
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from forewarp.drawing.images import write_video
from forewarp.files import read_json, read_rows
from forewarp.training.callbacks import Scalars
from forewarp.training.environment import SingleProcess
from forewarp.training.loggers import CsvLogger, Labels, RunLoggers, redacted
from tests.support.tiny_scene import Interrupt, make_run, stage

STEPS = 6
PARAMETERS = {"model.name": "forward", "stage.fine.density": 45.0, "preset.rays": "None", "model.still": True}
SCORES = {"test/all/psnr": 30.5}


class Note(lightning.Callback):
    """Logs as callbacks of Lightning's do, in several hooks and in two ways."""

    def on_train_start(self, trainer, module):
        module.log("begin", 1.0)

    def on_train_batch_end(self, trainer, module, *_):
        module.log("mine", float(module.global_step))

    def on_train_epoch_end(self, trainer, module):
        for logger in trainer.loggers:
            logger.log_metrics({"end": 2.0}, module.global_step)


def logged(folder, makers, *callbacks):
    """Train two stages of six steps with loggers, and log the scores of the run."""
    labels = Labels("ball", "minutes", ("pilot", "two"), True)
    (folder / "run").mkdir(exist_ok=True)
    (folder / "run" / "config.yaml").write_text("seed: 7\nroot: /home/me/my scans\n")
    write_video(folder / "test.gif", [torch.rand(8, 10, 3) for _ in range(3)], fps=8)
    loggers = RunLoggers(makers, folder / "run", folder, lambda: PARAMETERS, labels)
    stages = [stage(name, iterations=STEPS) for name in ("coarse", "fine")]
    own = [Scalars(every=2), *callbacks]
    with loggers:
        module = make_run(folder / "run", stages, callbacks=own, loggers=loggers).fit()
        loggers.log_image("images/last", torch.rand(8, 8, 3), module.global_step)
        loggers.log_scores(SCORES, 2 * STEPS)
        loggers.log_film("film/test", folder / "test.gif", 2 * STEPS)


def interrupted_and_continued(folder, makers):
    """The same, but killed in the second stage, two steps after its last checkpoint."""

    class Crash(Interrupt):
        def on_train_batch_end(self, trainer, module, *given):
            if module.global_step == 2:
                super().on_train_batch_end(trainer, module, *given)
            if module.settings.name == "fine" and module.global_step == 4:
                raise SystemExit

    class Save(Interrupt):
        def on_train_batch_end(self, trainer, module, *_):
            if module.settings.name == "fine" and module.global_step == 2:
                for callback in trainer.callbacks:
                    if hasattr(callback, "save"):
                        callback.save(trainer)

    with pytest.raises(SystemExit):
        logged(folder, makers, Save("fine", 2), Crash("fine", 4))
    logged(folder, makers)


@pytest.fixture
def plain():
    tensorboard = partial(TensorBoardLogger, name="tensorboard", version="", default_hp_metric=False)
    return {"tensorboard": tensorboard, "csv": partial(CsvLogger, name="csv", version="")}


@pytest.mark.slow
def test_stages_are_one_curve_and_a_continued_run_goes_on_in_it(tmp_path, plain):
    interrupted_and_continued(tmp_path, plain)
    rows = read_rows(tmp_path / "run" / "csv" / "metrics.csv")
    steps = [int(row["step"]) for row in rows if row["train/loss"]]
    assert steps == [2, 4, 6, 8, 10, 12]
    assert [row["test/all/psnr"] for row in rows if row["test/all/psnr"]] == ["30.5"]
    text = (tmp_path / "run" / "csv" / "hparams.yaml").read_text()
    assert "stage.fine.density: 45.0" in text
    events = EventAccumulator(str(tmp_path / "run" / "tensorboard"))
    events.Reload()
    assert [point.step for point in events.Scalars("train/loss")] == steps
    assert [(point.step, point.value) for point in events.Scalars("test/all/psnr")] == [(12, 30.5)]
    assert events.Tags()["images"] == ["images/last", "film/test"]
    (film,) = events.Images("film/test")
    assert (film.step, film.width, film.height) == (12, 10, 8)
    assert film.encoded_image_string == (tmp_path / "test.gif").read_bytes()
    assert b"seed: 7\nroot: my scans\n" in events.Tensors("config/text_summary")[0].tensor_proto.string_val[0]
    (table,) = (events.SummaryMetadata("_hparams_/session_start_info").plugin_data.content,)
    assert b"stage.fine.density" in table


@pytest.mark.slow
def test_what_others_log_is_on_the_axis_of_the_run(tmp_path, plain):
    loggers = RunLoggers({"csv": plain["csv"]}, tmp_path)
    run = make_run(tmp_path, [stage("coarse", iterations=50), stage("fine", iterations=50)], loggers=loggers)
    run.callbacks = lambda *_: [Note()]
    with loggers:
        run.fit()
    rows = read_rows(tmp_path / "csv" / "metrics.csv")
    assert [(row["step"], row["mine"]) for row in rows if row["mine"]] == [("49", "50.0"), ("99", "50.0")]
    assert [row["step"] for row in rows if row["end"]] == ["50", "100"]


@pytest.mark.slow
def test_a_run_outlives_a_tracker_that_fails(tmp_path, plain, capsys):
    def broken(self, metrics, step):
        raise ConnectionError("no route\nto host")

    broken_logger = type("Broken", (CsvLogger,), {"log_metrics": broken})
    logged(tmp_path, {"bad": partial(broken_logger, name="bad", version=""), **plain})
    told = [line for line in capsys.readouterr().err.splitlines() if line.startswith("warning: ")]
    assert told == ["warning: logger.bad failed and is left out from now on: ConnectionError: no route"]
    assert read_rows(tmp_path / "run" / "csv" / "metrics.csv")[-1]["test/all/psnr"] == "30.5"


def test_a_run_of_another_rank_logs_all_the_same(tmp_path, plain, monkeypatch):
    monkeypatch.setattr(rank_zero_only, "rank", 2)  # as SLURM_PROCID=2 would have it
    with RunLoggers(plain, tmp_path) as loggers:
        loggers.open()
        loggers.log({"train/loss": 1.0}, 1)
    assert [row["train/loss"] for row in read_rows(tmp_path / "csv" / "metrics.csv")] == ["1.0"]
    assert SingleProcess().global_rank() == rank_zero_only.rank == 0


def test_the_environment_of_a_run_heeds_no_variables(monkeypatch):
    for name in ("LOCAL_RANK", "NODE_RANK", "GROUP_RANK", "WORLD_SIZE", "SLURM_NTASKS"):
        monkeypatch.setenv(name, "3")
    one = SingleProcess()
    found = (one.local_rank(), one.node_rank(), one.global_rank(), one.world_size())
    assert (*found, one.creates_processes_externally) == (0, 0, 0, 1, False)


@pytest.mark.parametrize("name", ["tensorboard", "csv"])
def test_a_tracker_that_holds_nothing_is_said(tmp_path, plain, capsys, name):
    with RunLoggers(plain, tmp_path) as loggers:
        loggers.open()
        loggers.log({"train/loss": 1.0}, 1)
        for file in (tmp_path / name).glob("*e*"):
            file.unlink()
    (said,) = capsys.readouterr().err.splitlines()
    assert said.startswith(
        f"warning: logger.{name} failed and is left out from now on: ValueError: expected what"
    )


def test_a_row_that_a_killed_run_left_half_written_is_dropped(tmp_path, plain):
    for step in (1, 2):
        loggers = RunLoggers({"csv": plain["csv"]}, tmp_path)
        with loggers:
            loggers.open(0, step - 1)
            loggers.log({"train/loss": 1.0, "train/psnr": 20.0}, step)
        file = tmp_path / "csv" / "metrics.csv"
        file.write_text(file.read_text() + "1")
    assert [row["step"] for row in read_rows(file)][:2] == ["1", "2"]


def test_what_was_logged_before_the_first_checkpoint_is_not_there_twice(tmp_path, plain):
    for steps in (3, 4):
        loggers = RunLoggers(plain, tmp_path)
        with loggers:
            loggers.open()
            for step in range(1, steps + 1):
                loggers.log({"train/loss": 1.0}, step)
    events = EventAccumulator(str(tmp_path / "tensorboard"))
    events.Reload()
    assert [point.step for point in events.Scalars("train/loss")] == [1, 2, 3, 4]
    assert [row["step"] for row in read_rows(tmp_path / "csv" / "metrics.csv")] == ["1", "2", "3", "4"]


@pytest.mark.filterwarnings("ignore:.*noload.*")  # SQLAlchemy's, of what MLflow calls
def test_mlflow_has_one_run_with_parameters_curves_and_scores(tmp_path, plain):
    mlflow = pytest.importorskip("mlflow", reason="needs forewarp[trackers]")
    makers = {"mlflow": partial(MLFlowLogger, experiment_name="forewarp", tracking_uri=None)}
    interrupted_and_continued(tmp_path, makers)
    client = mlflow.MlflowClient(f"sqlite:///{tmp_path}/mlflow.db")
    (experiment,) = client.search_experiments(filter_string="name = 'forewarp'")
    (run,) = client.search_runs([experiment.experiment_id])
    assert run.info.run_id == read_json(tmp_path / "run" / "loggers.json")["mlflow"]
    assert run.info.status == "FINISHED"
    assert run.info.run_name.endswith("/run")
    assert run.data.params["stage.fine.density"] == "45.0"
    assert run.data.metrics["test/all/psnr"] == 30.5
    assert {"sweep": "minutes", "pilot": "true", "two": "true"}.items() <= run.data.tags.items()
    assert {one.path for one in client.list_artifacts(run.info.run_id)} >= {"config.yaml", "film"}
    steps = {point.step for point in client.get_metric_history(run.info.run_id, "train/loss")}
    assert steps == {2, 4, 6, 8, 10, 12}


@pytest.mark.slow
def test_wandb_has_one_run_for_a_continued_one(tmp_path, monkeypatch):
    wandb = pytest.importorskip("wandb", reason="needs forewarp[trackers]")
    monkeypatch.setenv("WANDB_SILENT", "true")
    began, init = [], wandb.init
    monkeypatch.setattr(wandb, "init", lambda **options: began.append(options) or init(**options))
    makers = {"wandb": partial(WandbLogger, project="forewarp", offline=True, group=None)}
    interrupted_and_continued(tmp_path, makers)
    assert [(one["group"], one["tags"]) for one in began] == [("minutes", ["pilot", "two"])] * 2
    media = {path.suffix for path in (tmp_path / "wandb").glob("offline-run-*/files/media/**/*")}
    assert {".gif", ".png", ".json"} <= media  # the film, images, the config as a table
    name = read_json(tmp_path / "run" / "loggers.json")["wandb"]
    parts = sorted(path.name for path in (tmp_path / "wandb").glob("offline-run-*"))
    assert len(parts) == 2  # which wandb sync joins, as both are of one run
    assert all(part.endswith(name) for part in parts)
    assert not [path for path in (tmp_path / "run").rglob("*") if path.is_symlink()]


def test_a_tracker_that_takes_nothing_is_named(tmp_path):
    pytest.importorskip("mlflow", reason="needs forewarp[trackers]")
    loggers = RunLoggers({"mlflow": partial(MLFlowLogger, tracking_uri="nowhere://x")}, tmp_path / "run")
    with pytest.raises(ValueError, match=r"logger.mlflow: expected a tracker that takes this run, but got"):
        loggers.open(0)


def test_a_package_that_is_missing_is_named(tmp_path, monkeypatch):
    monkeypatch.setattr("forewarp.training.loggers.find_spec", lambda name: None)
    with pytest.raises(ImportError, match="expected wandb for mine, but got none; install forewarp.tr"):
        RunLoggers({"mine": partial(WandbLogger)}, tmp_path)


def test_paths_and_passwords_reach_no_tracker():
    command = (
        "forewarp-train --config-dir=/home/me/conf 'data.root=/srv/x/my scans' model/motion=none run=a/b"
    )
    command += " 'hydra.searchpath=[file:///home/me/a,/home/me/b,pkg://c]' start=/home/me"
    uris = [
        "https://me:p@ss@host:80/a",
        "logger.mlflow.tracking_uri=http://u@host",
        "sqlite:////home/me/m.db",
    ]
    config = {"command": command, "root": "/home/me/x y", "uris": uris, "path": "/a/b:/c/d", "seed": 1}
    config |= {"depth": "${data.root}/depth", "out": "../a/b", "none": None}
    assert redacted(config) == {
        "command": "forewarp-train --config-dir=conf 'data.root=my scans' model/motion=none run=a/b"
        " 'hydra.searchpath=[a,b,pkg://c]' 'start=~'",
        "root": "x y",
        "uris": ["https://host:80/a", "logger.mlflow.tracking_uri=http://host", "m.db"],
        **{"path": "b:d", "seed": 1, "depth": "${data.root}/depth", "out": "../a/b", "none": None},
    }
