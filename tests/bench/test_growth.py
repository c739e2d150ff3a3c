"""Time how operators, a step and a frame grow with size: ``make bench``, not ``make test``."""

import time

import pytest
import torch

from forewarp.ops.warmup import warm_up
from forewarp.training.device import peak_memory_bytes, reset_peak_memory
from tests.bench.timed_cases import CASES

RUNS = [
    (name, size, dense)
    for name, case in CASES.items()
    for size in case.sizes
    for dense in (False, True)
    if not dense or size in case.dense_sizes
]


@pytest.mark.bench
@pytest.mark.benchmark(timer=time.process_time)  # leaves out what else the machine does
@pytest.mark.parametrize(("name", "size", "dense"), RUNS)
def test_growth(benchmark, name, size, dense):
    warm_up()
    work = CASES[name].make(size, dense)
    reset_peak_memory()
    before = peak_memory_bytes()
    work()
    peak = peak_memory_bytes() - before
    benchmark.group = name
    benchmark.extra_info.update(
        {"name": name, "size": size, "dense": dense, "peak": peak, "threads": torch.get_num_threads()}
    )
    benchmark.pedantic(work, rounds=3 if dense else 5, warmup_rounds=1)
