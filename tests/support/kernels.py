"""Which compiled kernels a piece of code calls, and with what kinds of arguments."""

import importlib

import pytest


def watch(monkeypatch, *parts):
    """Return a set that takes each call of a public kernel of ``forewarp.ops.kernels.<part>``."""
    numba = pytest.importorskip("numba")
    met = set()

    def watched(name, kernel):
        def call(*arguments):
            met.add((name, *(str(numba.typeof(a)) for a in arguments)))
            return kernel(*arguments)

        call.stats = kernel.stats
        return call

    for part in parts:
        home = importlib.import_module(f"forewarp.ops.kernels.{part}")
        for name, kernel in list(vars(home).items()):
            own = hasattr(kernel, "py_func") and kernel.py_func.__module__ == home.__name__
            if own and not name.startswith("_"):
                monkeypatch.setattr(home, name, watched(name, kernel))
    return met
