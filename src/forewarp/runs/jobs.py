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

_MOST = 12  # jobs, but for seeds, that are looked at where nobody asks for each
_DECIDE = ("model", "preset", "budget.minutes", "budget.iterations")  # most of what a job costs


class PlanOnly(SystemExit):
    """Ends a command that was asked for its cost alone, before any job; ``error``: why there is none."""

    def __init__(self, error: Exception | None = None) -> None:
        super().__init__()
        self.error = error


class ReportCost(Callback):
    """Print before a sweep what its jobs will cost; with ``plan_only`` list them, and end there."""

    def on_multirun_start(self, config: DictConfig, **_) -> None:
        """Print it; where that fails say so, and the sweep goes on: it refuses what is wrong with itself."""
        failed = None
        try:
            print(*estimate_lines(config, listed=config.plan_only), sep="\n", flush=True)
        except Exception as error:
            failed = error
            if not config.plan_only:
                said = " ".join(str(error).split()) or type(error).__name__
                print(f"no estimate: {said}"[:200], flush=True)
        if config.plan_only:
            raise PlanOnly(failed)


def estimate_lines(config: DictConfig, *, listed: bool = False) -> list[str]:
    """Return as lines of text what a sweep will cost; with ``listed`` a line for each job as well.

    Args:
        config: as of ``jobs_of``.
        listed: whether to list the jobs.

    Raises:
        ValueError, HydraException, OmegaConfBaseException: if a job is no possible one.
    """
    costs, whole = cost_of_sweep(config, every=listed)
    lines = whole.lines()
    if costs is None:
        lines[0] += f" (chosen by {_target(config.hydra.sweeper)}; finished jobs are skipped)"
    return [*lines, *listing(costs)] if listed else lines


def listing(costs: Sequence[tuple[Job, Cost]] | None) -> list[str]:
    """Write a line for each job; none where the sweeper chooses them."""
    lengths = ["?" if cost.wall is None else spell(cost.wall) for _, cost in costs or ()]
    return [f"  {job.state or length:>9}  {job.folder}" for (job, _), length in zip(costs or (), lengths)]


def cost_of_sweep(config: DictConfig, *, every: bool = True) -> tuple[list[tuple[Job, Cost]] | None, Total]:
    """Estimate the jobs of a sweep and what they take together; the list is None if the sweeper chooses each
    job by the scores of earlier ones.

    Args:
        config: as of ``jobs_of``.
        every: whether to look at each job and its scene, which takes about a second each; else a few jobs
            stand for all, and scenes are not read.

    Raises:
        ValueError, HydraException, OmegaConfBaseException: if a job is no possible one.
    """
    own, prices = read_costs(own_file()), read_costs(PRICES)

    def estimated(job: DictConfig) -> tuple[Job, Cost]:
        read = job_of(job, own, read=every)
        return read, cost_of(read, own, prices)

    local, of_jobs = is_local(config), _crossed(config)
    if of_jobs is None:
        with as_job(config):
            job, cost = estimated(deepcopy(config))
        count = config.hydra.sweeper.get("n_trials") or 1
        some = [
            (replace(job, folder=Path(f"{job.folder}-{number}"), state=""), cost) for number in range(count)
        ]
        return None, total(some, at_once(config, count), local=local)
    seedless = [_seedless(words) for words in of_jobs]
    few = {*(seedless if every else _few(seedless))}
    looked_at = [words for words, rest in zip(of_jobs, seedless) if rest in few]
    known = {tuple(words): estimated(job) for job, words in zip(jobs_of(config, looked_at), looked_at)}
    costs = []
    for number, words in enumerate(of_jobs):
        if (found := known.get(tuple(words))) is None:
            job, cost = known[max(known, key=lambda other: len({*words} & {*other}))]
            found = replace(job, folder=Path(f"{job.folder}-{number}"), state="", alike=True), cost
        costs.append(found)
    return costs, total(costs, at_once(config, len(costs)), local=local)


def _seedless(words: Sequence[str]) -> tuple[str, ...]:
    return tuple(word for word in words if key_of(word) != "seed")


def _few(jobs: Sequence[tuple[str, ...]]) -> list[tuple[str, ...]]:
    """Choose jobs that stand for all: one for each value of ``_DECIDE``, then for other values up to
    ``_MOST``; all of them if these are no more.
    """
    jobs = list(dict.fromkeys(jobs))
    if len(jobs) <= _MOST:
        return jobs
    chosen, seen = [], set()
    for decides in (True, False):
        for words in jobs:
            new = {word for word in words if key_of(word) in _DECIDE or not decides} - seen
            if not chosen or (new and (decides or len(chosen) < _MOST)):
                chosen.append(words)
                seen.update(words)
    return chosen


def jobs_of(config: DictConfig, of_jobs: Sequence[Sequence[str]] | None = None) -> Iterator[DictConfig]:
    """Compose each job of a sweep; those that differ in the seed alone are composed once.

    While a job is at hand it is Hydra's own (``HydraConfig``).

    Args:
        config: of the sweep, as ``Callback.on_multirun_start`` gets it.
        of_jobs: overrides of the jobs to compose; None: all of the sweep.

    Raises:
        HydraException, OmegaConfBaseException: if a job cannot be composed.
    """
    composed, mode = {}, OmegaConf.to_container(config.hydra.overrides.hydra)  # ${..} as typed
    for of_job in (_crossed(config) or ()) if of_jobs is None else of_jobs:
        seed = [override for override in of_job if key_of(override) == "seed"]
        rest = _seedless(of_job)
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
