"""Fixtures that run hard cases on every device, in both implementations of the operators."""

import importlib.util
from datetime import timedelta

import pytest
import torch
from hypothesis import HealthCheck, settings

from forewarp.ops import backend

# The deadline is for what waits for ever; on a busy machine an input may wait for a while.
FUZZ = {"max_examples": 5000, "deadline": timedelta(minutes=2), "database": None, "derandomize": True}
FUZZ = settings(suppress_health_check=list(HealthCheck), **FUZZ)
settings.register_profile("fuzz", FUZZ)
PLACES = ["cpu-reference", "cpu-numba", *(["cuda-reference"] if torch.cuda.is_available() else [])]


@pytest.fixture(params=PLACES)
def place(request, monkeypatch):
    """Return a device, and choose an implementation of the operators."""
    device, kind = request.param.split("-")
    if kind == "numba" and importlib.util.find_spec("numba") is None:
        pytest.skip("Numba is not installed")
    monkeypatch.setattr(backend, "numba_installed", lambda: kind == "numba")
    return torch.device(device)


@pytest.fixture(params=["cpu", *(["cuda"] if torch.cuda.is_available() else [])])
def device(request):
    """Return each device there is."""
    return torch.device(request.param)
