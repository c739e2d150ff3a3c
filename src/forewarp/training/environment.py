"""The one process of a run, whatever the variables of a launcher say."""

from __future__ import annotations

from lightning.pytorch.plugins.environments import LightningEnvironment


class SingleProcess(LightningEnvironment):
    """Tell Lightning that this process is the first and only one.

    Variables that a container, a cluster's shell or ``torchrun`` hands on (``SLURM_NTASKS``, ``RANK`` and
    their like) would otherwise decide: a process of another rank trains, and its trackers write nothing.
    """

    def __init__(self) -> None:
        super().__init__()
        self.set_global_rank(0)

    @property
    def creates_processes_externally(self) -> bool:
        """False: nothing launches other processes of this run."""
        return False

    def local_rank(self) -> int:
        """Return 0."""
        return 0

    def node_rank(self) -> int:
        """Return 0."""
        return 0
