"""Call the commands in this process, from tests and fixtures of any scope; share one fitted run."""

from __future__ import annotations

import contextlib
import importlib
import io
import logging
import os
from types import SimpleNamespace
from unittest.mock import patch

import torch
from hydra.core.global_hydra import GlobalHydra
from hydra.core.hydra_config import HydraConfig

# A scene of 32 x 32 pixels, with test views of all three kinds.
SCENE = {"size": 32, "frames": 6, "test_views": (2, 1, 2), "val_views": 1, "samples_per_pixel": 1}
TINY = ["model=forward", "data=dnerf", "data.scene=vehicle", "preset=demo", "trainer=cpu", "data.rays=128"]
TINY += ["budget.iterations=60", "stage.fine.num_voxels=[[0,8000]]", "stage.coarse.num_voxels=[[0,4000]]"]
TINY += ["threads=1", "data.depth_kind=ray"]


def call(name, *arguments):
    """Run a command; ``call("train", "data.scene=x")`` gives ``status``, ``out`` and ``err``.

    Environment, logging, threads and Hydra are as before afterwards.
    """
    out, err, quiet = io.StringIO(), io.StringIO(), logging.getLogger("forewarp.metrics")
    level, disabled, threads = quiet.level, logging.root.manager.disable, torch.get_num_threads()
    # Hydra composes the config once more to learn its hydra.mode, which only sweeps set.
    sweeps = any(str(argument).startswith("sweeps=") for argument in arguments)
    mode = patch("hydra._internal.hydra.Hydra.get_mode", return_value=None)
    mode = contextlib.nullcontext() if sweeps else mode
    status = None
    typed = patch("sys.argv", [f"forewarp-{name}", *map(str, arguments)])
    told = contextlib.redirect_stdout(out), contextlib.redirect_stderr(err)
    with mode, patch.dict(os.environ), typed, told[0], told[1]:
        try:
            importlib.import_module(f"forewarp.cli.{name}").main()
        except SystemExit as leaving:
            status = leaving.code
        finally:
            GlobalHydra.instance().clear()
            HydraConfig.instance().cfg = None
            quiet.setLevel(level)
            logging.disable(disabled)
            torch.set_num_threads(threads)
    return SimpleNamespace(status=status, out=out.getvalue(), err=err.getvalue())


def fitted_run(factory):
    """The folder of a small finished run, made once a session.

    Its scene is in ``scenes/vehicle`` beside it, and what the command printed in ``said.txt``. It is shared:
    copy it before changing anything in it.
    """
    from forewarp.synth.scenes import synthesize

    run = factory.getbasetemp() / "fitted" / "run"
    if not run.is_dir():
        synthesize(run.parent / "scenes" / "vehicle", **SCENE)
        done = call("train", *TINY, f"data.root={run.parent}/scenes", f"run={run}")
        assert done.status == 0, done.err
        (run / "said.txt").write_text(done.out + "\n---\n" + done.err)
    return run
