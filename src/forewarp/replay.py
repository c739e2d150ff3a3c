"""``python -m forewarp.replay <bundle>``: repeat a training step that met a number that is not finite."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from forewarp.cli.entry import MISTAKE, quiet
from forewarp.cli.mistakes import one_line
from forewarp.runs.config import without_trust


def replay(path: Path, trust: Sequence[str] = ()) -> str:
    """Repeat the step of a bundle; name the first tensor that is not finite, or say that all are finite.

    Args:
        path: path of the bundle, a file in <run>/<stage>/broken/.
        trust: packages beside forewarp whose code its config may name.

    Raises:
        ValueError: if the file is no such bundle.
    """
    import torch

    from forewarp.runs.build import build_run
    from forewarp.runs.config import parsed
    from forewarp.training.bundle import read_bundle
    from forewarp.training.checkpoints import misfits
    from forewarp.training.sentinel import diagnose

    bundle = read_bundle(path)
    stage, number = bundle.noted["stage"], bundle.noted["step"]
    config = parsed(bundle.config, path, trust)
    if config.trainer.accelerator != "cpu" and not torch.cuda.is_available():
        config.trainer.accelerator = "cpu"  # this may be another machine
    run = build_run(config)
    if stage not in (names := [stage.settings.name for stage in run.stages]):
        known = " or ".join(names)
        raise ValueError(f"{path}: expected a step of stage {known}, but got one of {stage!r:.80}")
    module = run.rebuilt(stage, bundle.scene)
    if differ := misfits(module, bundle.state_dict):
        raise ValueError(
            f"{path}: expected weights that its config describes, but got others: {', '.join(differ[:3])}"
        )
    module.load_state_dict(bundle.state_dict)
    trainer = replace(run, callbacks=lambda *_: []).make_trainer(path.parent, [])
    try:
        module.generator.set_state(bundle.noted["random"]["samples"])
        torch.set_rng_state(bundle.noted["random"]["torch"])
    except (RuntimeError, TypeError):
        raise ValueError(f"{path}: expected states of random generators, but got other bytes") from None
    device = trainer.strategy.root_device
    with trainer.precision_plugin.forward_context():
        found = diagnose(module.to(device), bundle.batch.to(device), number)
    name = bundle.scene.train[bundle.batch.frame].name
    where = f"stage {stage}, step {number}, frame {name} (time {bundle.batch.time:.4g})"
    return f"{where}: {found or 'all is finite, where the run saw ' + bundle.noted['found']}"


def main(arguments: Sequence[str] | None = None) -> None:
    """Print what is found; end with one line and status 2 if the file cannot be used."""
    parser = argparse.ArgumentParser(
        prog="python -m forewarp.replay",
        description="Repeat a training step that met a number that is not finite, and name its tensor.",
    )
    parser.add_argument("bundle", type=Path, help="<run>/<stage>/broken/step_<n>.pt; trust=[PACKAGE] beside")
    quiet()
    try:
        rest, trust = without_trust(sys.argv[1:] if arguments is None else arguments)
        print(replay(parser.parse_args(rest).bundle, trust))
    except Exception as error:
        line = one_line(error)
        if line is None:
            raise
        print(f"forewarp.replay: error: {line}", file=sys.stderr)
        sys.exit(MISTAKE)


if __name__ == "__main__":
    main()
