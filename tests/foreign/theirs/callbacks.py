"""A callback that counts steps, and can interrupt a run as Ctrl-C does."""

import signal
from pathlib import Path

import lightning


class Count(lightning.Callback):
    """Writes the number of steps of a stage into its folder.

    Args:
        stop_at: the step after which the process gets a SIGINT; None: never.
    """

    def __init__(self, stop_at=None):
        self.stop_at = stop_at

    def on_train_batch_end(self, trainer, module, *_):
        """Note the step, log a number, and interrupt if it is time."""
        Path(trainer.default_root_dir, "steps.txt").write_text(str(module.global_step))
        for logger in trainer.loggers:
            logger.log_metrics({"theirs/step": module.global_step}, module.global_step)
        if module.global_step == self.stop_at:
            signal.raise_signal(signal.SIGINT)
