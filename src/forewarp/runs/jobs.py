"""List the jobs of ``--multirun`` before any of them runs, as Hydra's sweeper will make them."""

from __future__ import annotations

import os
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from copy import deepcopy
from dataclasses import replace
from pathlib import Path

from hydra import compose
from hydra.core.global_hydra import GlobalHydra
from hydra.core.hydra_config import HydraConfig
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.experimental.callback import Callback
from omegaconf import DictConfig, OmegaConf

from forewarp.runs.cost import PRICES, Cost, Job, Total, cost_of, job_of, own_file, read_costs, spell, total
from forewarp.runs.overrides import key_of


class PlanOnly(SystemExit):
    """Ends a command that was asked for its cost alone, before any job; ``error``: why there is none."""

    def __init__(self, error: Exception | None = None) -> None:
        super().__init__()
        self.error = error


class TellCost(Callback):
    """Say before a sweep what its jobs will cost; with ``plan_only`` list them, and end there."""

    def on_multirun_start(self, config: DictConfig, **_) -> None:
        """Print it; where that fails say so, and the sweep goes on: it refuses what is wrong with itself."""
        failed = None
        try:
            print(*tell_sweep(config, listed=config.plan_only), sep="\n", flush=True)
        except Exception as error:
            failed = error
            if not config.plan_only:
                said = " ".join(str(error).split()) or type(error).__name__
                print(f"no estimate: {said}"[:200], flush=True)
        if config.plan_only:
            raise PlanOnly(failed)


def tell_sweep(config: DictConfig, *, listed: bool = False) -> list[str]:
    """Say in lines what a sweep will cost, with ``listed`` also what each of its jobs will.

    Args:
        config: as of ``jobs_of``.
        listed: whether to list the jobs.

    Raises:
        ValueError, HydraException, OmegaConfBaseException: if a job is no possible one.
    """
    costs, whole = cost_of_sweep(config)
    lines = whole.lines()
    if costs is None:
        lines[0] += f" (those that {_target(config.hydra.sweeper)} chooses; finished ones are skipped)"
    elif listed:
        for job, cost in costs:
            length = "?" if cost.wall is None else spell(cost.wall)
            lines.append(f"  {job.state or length:>9}  {job.folder}")
    return lines


def cost_of_sweep(config: DictConfig) -> tuple[list[tuple[Job, Cost]] | None, Total]:
    """Estimate the jobs of a sweep and what they take together; the list is None if the sweeper chooses each
    job by the scores of earlier ones.

    Args:
        config: as of ``jobs_of``.

    Raises:
        ValueError, HydraException, OmegaConfBaseException: if a job is no possible one.
    """
    own, prices = read_costs(own_file()), read_costs(PRICES)

    def estimated(job: DictConfig) -> tuple[Job, Cost]:
        read = job_of(job, own)
        return read, cost_of(read, own, prices)

    local = is_local(config)
    if _crossed(config) is None:
        with as_job(config):
            job, cost = estimated(deepcopy(config))
        count = config.hydra.sweeper.get("n_trials") or 1
        some = [
            (replace(job, folder=Path(f"{job.folder}-{number}"), state=""), cost) for number in range(count)
        ]
        return None, total(some, at_once(config, count), local=local)
    costs = [estimated(job) for job in jobs_of(config)]
    return costs, total(costs, at_once(config, len(costs)), local=local)


def jobs_of(config: DictConfig) -> Iterator[DictConfig]:
    """Compose each job of a sweep; those that differ in the seed alone are composed once.

    While a job is at hand it is Hydra's own (``HydraConfig``).

    Args:
        config: of the sweep, as ``Callback.on_multirun_start`` gets it.

    Raises:
        HydraException, OmegaConfBaseException: if a job cannot be composed.
    """
    composed, mode = {}, OmegaConf.to_container(config.hydra.overrides.hydra)  # ${..} as typed
    for of_job in _crossed(config) or ():
        seed = [override for override in of_job if key_of(override) == "seed"]
        rest = tuple(override for override in of_job if override not in seed)
        if rest not in composed:
            composed[rest] = compose(config.hydra.job.config_name, [*mode, *of_job], return_hydra_config=True)
        job = deepcopy(composed[rest])
        if seed:
            job.seed = OverridesParser.create().parse_override(seed[-1]).value()
        with as_job(job):
            yield job


@contextmanager
def as_job(config: DictConfig) -> Iterator[None]:
    """Let a config with its node ``hydra`` be the running job's."""
    before = HydraConfig.instance().cfg
    HydraConfig.instance().set_config(config)
    try:
        yield
    finally:
        HydraConfig.instance().cfg = before


def at_once(config: DictConfig, jobs: int) -> int:
    """Return how many jobs of a sweep run at the same time."""
    launcher, target = config.hydra.launcher, _target(config.hydra.launcher)
    cores, most = os.cpu_count() or 1, jobs
    if "Basic" in target:
        most = 1
    elif "joblib" in target:
        asked = launcher.get("n_jobs") or 1
        most = asked if asked > 0 else cores + 1 + asked  # joblib's -1 is all cores
    elif "ray" in target:
        each = OmegaConf.select(launcher, "ray.remote.num_cpus") or 1
        most = int((OmegaConf.select(launcher, "ray.init.num_cpus") or cores) // each)
    return max(1, min(most, jobs, config.hydra.sweeper.get("n_jobs") or jobs))


def is_local(config: DictConfig) -> bool:
    """Tell whether jobs run on this machine."""
    target = _target(config.hydra.launcher)
    return not ("Slurm" in target or OmegaConf.select(config.hydra.launcher, "ray.init.address"))


def _crossed(config: DictConfig) -> Sequence[Sequence[str]] | None:
    """Return the overrides of each job; None where the sweeper does not cross values."""
    from hydra_plugins.forewarp_one_at_a_time import OneAtATime  # which without changes is Hydra's own

    sweeper = OmegaConf.to_container(config.hydra.sweeper, resolve=True)
    if not str(sweeper.get("_target_")).endswith((".BasicSweeper", ".OneAtATime")):
        return None
    lists = {key: sweeper[key] for key in ("changes", "scenes") if key in sweeper}
    params = [f"{key}={value}" for key, value in (sweeper.get("params") or {}).items()]
    parser = OverridesParser.create(config_loader=GlobalHydra.instance().config_loader())
    typed = parser.parse_overrides([*params, *OmegaConf.to_container(config.hydra.overrides.task)])
    (jobs,) = OneAtATime(None, **lists).split_arguments(typed, None)
    return jobs


def _target(config: DictConfig) -> str:
    return str(config.get("_target_"))
