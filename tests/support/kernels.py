"""Which compiled kernels a piece of code calls, and with what kinds of arguments."""

import importlib

import pytest


def kernels_of(part):
    """Return the module ``forewarp.ops.kernels.<part>`` and its public kernels by name."""
    home = importlib.import_module(f"forewarp.ops.kernels.{part}")
    own = {name: k for name, k in vars(home).items() if hasattr(k, "py_func") and not name.startswith("_")}
    return home, {name: k for name, k in own.items() if k.py_func.__module__ == home.__name__}


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
        home, kernels = kernels_of(part)
        for name, kernel in kernels.items():
            monkeypatch.setattr(home, name, watched(name, kernel))
    return met
