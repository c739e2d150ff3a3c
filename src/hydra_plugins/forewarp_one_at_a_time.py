"""``hydra/sweeper=one_at_a_time``: a job for each scene and change of a list; Hydra's own crosses all."""

import shlex
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field

from hydra._internal.core_plugins.basic_sweeper import BasicSweeper, BasicSweeperConf
from hydra.core.config_store import ConfigStore


class OneAtATime(BasicSweeper):
    """Hydra's sweeper, each of whose jobs is repeated for every one of ``scenes`` and of ``changes``.

    Args:
        max_batch_size: jobs launched together; None: all.
        params: as of Hydra's sweeper: key -> comma-separated values, all crossed with one another.
        changes: a string for each change, holding its overrides as one types them ("" for none).
        scenes: likewise for each scene; of no effect where the command line chooses one.

    Raises:
        ValueError: if there is no change or no scene, and so no job.
    """

    def __init__(
        self,
        max_batch_size: int | None,
        params: dict[str, str] | None = None,
        changes: Sequence[str] = ("",),
        scenes: Sequence[str] = ("",),
    ) -> None:
        super().__init__(max_batch_size, params)
        for name, given in (("changes", changes), ("scenes", scenes)):
            if not given:
                raise ValueError(
                    f"hydra.sweeper.{name}: expected at least one, but got []; use [''] for the job as it is"
                )
        self.changes, self.scenes = changes, scenes

    def split_arguments(self, overrides, max_batch_size):
        """Return the batches of jobs, each job a list of overrides; the base class asks for them."""
        (jobs,) = BasicSweeper.split_arguments(overrides, None)
        scenes = scenes_left(self.scenes, {override.get_key_element() for override in overrides})
        return list(
            self.split_overrides_to_chunks(changed(changed(jobs, scenes), self.changes), max_batch_size)
        )


def changed(jobs: Sequence[Sequence[str]], changes: Sequence[str]) -> list[list[str]]:
    """Return every job with every change, which wins where both set a key.

    >>> changed([["seed=0", "preset=fast"]], ["", "preset=demo", "preset.nodes=0 model=backward"])[1:]
    [['seed=0', 'preset=demo'], ['seed=0', 'preset=fast', 'preset.nodes=0', 'model=backward']]
    """
    from forewarp.runs.overrides import merged  # not above: Hydra reads this file in every application

    return [merged(job, shlex.split(change)) for change in changes for job in jobs]


def scenes_left(scenes: Sequence[str], typed: Iterable[str]) -> list[str]:
    """Return the scenes of a sweep, less what the keys that are typed choose.

    >>> scenes_left(["experiment=dnerf data.scene=hook", "experiment=dnerf data.scene=lego"], ["data.scene"])
    ['experiment=dnerf']
    """
    from forewarp.runs.overrides import key_of

    if {"experiment", "scene"} & {*typed}:
        return [""]
    kept = [" ".join(word for word in scene.split() if key_of(word) not in typed) for scene in scenes]
    return list(dict.fromkeys(kept))


@dataclass  # Hydra runs this file outside sys.modules, where a dataclass cannot read postponed annotations
class OneAtATimeConf(BasicSweeperConf):
    """The keys of ``hydra.sweeper``."""

    _target_: str = "hydra_plugins.forewarp_one_at_a_time.OneAtATime"
    changes: list[str] = field(default_factory=lambda: [""])
    scenes: list[str] = field(default_factory=lambda: [""])


ConfigStore.instance().store(
    group="hydra/sweeper", name="one_at_a_time", node=OneAtATimeConf, provider="forewarp"
)
