"""``hydra/sweeper=one_at_a_time``: run a job for each change of a list; Hydra's own sweeper crosses all."""

import shlex
from collections.abc import Sequence
from dataclasses import dataclass, field

from hydra._internal.core_plugins.basic_sweeper import BasicSweeper, BasicSweeperConf
from hydra.core.config_store import ConfigStore


class OneAtATime(BasicSweeper):
    """Hydra's sweeper, each of whose jobs is repeated for every one of ``changes``.

    Args:
        max_batch_size: jobs launched together; None: all.
        params: as of Hydra's sweeper: key -> comma-separated values, all crossed with one another.
        changes: a string for each change, holding its overrides as one types them ("" for none).

    Raises:
        ValueError: if there is no change, and so no job.
    """

    def __init__(
        self, max_batch_size: int | None, params: dict[str, str] | None = None, changes: Sequence[str] = ("",)
    ) -> None:
        super().__init__(max_batch_size, params)
        if not changes:
            raise ValueError(
                "hydra.sweeper.changes: expected at least one change, but got []; use [''] for the plain job"
            )
        self.changes = changes

    def split_arguments(self, overrides, max_batch_size):
        """Return the batches of jobs, each job a list of overrides; the base class asks for them."""
        (jobs,) = BasicSweeper.split_arguments(overrides, None)
        return list(self.split_overrides_to_chunks(changed(jobs, self.changes), max_batch_size))


def changed(jobs: Sequence[Sequence[str]], changes: Sequence[str]) -> list[list[str]]:
    """Return every job with every change, which wins where both set a key.

    >>> changed([["seed=0", "preset=fast"]], ["", "preset=demo", "preset.nodes=0 model=backward"])[1:]
    [['seed=0', 'preset=demo'], ['seed=0', 'preset=fast', 'preset.nodes=0', 'model=backward']]
    """
    from forewarp.runs.overrides import merged  # not above: Hydra reads this file in every application

    return [merged(job, shlex.split(change)) for change in changes for job in jobs]


@dataclass  # Hydra runs this file outside sys.modules, where a dataclass cannot read postponed annotations
class OneAtATimeConf(BasicSweeperConf):
    """The keys of ``hydra.sweeper``."""

    _target_: str = "hydra_plugins.forewarp_one_at_a_time.OneAtATime"
    changes: list[str] = field(default_factory=lambda: [""])


ConfigStore.instance().store(
    group="hydra/sweeper", name="one_at_a_time", node=OneAtATimeConf, provider="forewarp"
)
