"""List the steps of a network by watching it run, so that a drawing of it cannot be wrong."""

from __future__ import annotations

from collections.abc import Callable, Iterator

import torch
from torch import Tensor, nn
from torch.overrides import TorchFunctionMode

VIEWS = {
    "__getitem__",
    "contiguous",
    "flatten",
    "movedim",
    "permute",
    "reshape",
    "to",
}  # no steps of a network


class _Recorder(TorchFunctionMode):
    """Records calls that take what the network was given or made, or its parameters."""

    def __init__(self, given: Tensor) -> None:
        super().__init__()
        self.steps = [{"does": "input", "from": [], "shape": list(given.shape[1:]), "parameters": 0}]
        self.maker = {id(given): 0}  # of a tensor: its step
        self.learned: dict[int, set[nn.Parameter]] = {}  # of a tensor: the parameters that it was made of
        self.kept = [given]  # as long as they live no other tensor has their id

    def __torch_function__(self, function, types, args=(), kwargs=None):
        """Call the function, and record it."""
        tensors = [x for x in _flat([args, kwargs or {}]) if isinstance(x, Tensor)]
        learned = set().union(*(self._learned(x) for x in tensors))
        sources = [self.maker[id(x)] for x in tensors if id(x) in self.maker]
        weights = [tuple(x.shape) for x in tensors if self._learned(x)]
        made = function(*args, **kwargs or {})
        if not isinstance(made, Tensor) or not (sources or learned):
            return made
        self.kept.append(made)
        name = function.__name__
        if not sources:
            self.learned[id(made)] = learned
        elif name in VIEWS:
            self.maker[id(made)] = sources[0]
        else:
            shape = list(made.shape[1:])
            shape = [shape[-1], *shape[:-1]] if name == "linear" else shape  # whose channels come last
            step = {"does": name, "from": sources, "shape": shape}
            if weights and name != "batch_norm":
                step["kernel"] = list(weights[0][2:]) or [1] * (len(shape) - 1)
            self.steps.append(step | {"parameters": sum(x.numel() for x in learned)})
            self.maker[id(made)] = len(self.steps) - 1
        return made

    def _learned(self, x: Tensor) -> set[nn.Parameter]:
        return {x} if isinstance(x, nn.Parameter) else self.learned.get(id(x), set())


def outline(network: Callable[[Tensor], Tensor], given: Tensor) -> list[dict]:
    """Run a network and list its steps, those that lead to what it returns.

    Args:
        network: takes ``given``, and returns a tensor.
        given: (1, channels, sides ...), on the network's device; on ``meta`` nothing is computed.

    Returns:
        for each step what it ``does`` (``input``, then ``conv3d``, ``max_pool3d`` ...), the numbers of the
        steps that it takes its input ``from``, the ``shape`` of what it makes (channels, then sides), how
        many ``parameters`` it has, and the ``kernel`` of a layer.
    """
    with torch.no_grad(), _Recorder(given) as recorder:
        made = network(given)
    steps, used = recorder.steps, {recorder.maker[id(made)]}
    for number in reversed(range(len(steps))):
        used |= set(steps[number]["from"]) if number in used else set()
    kept = [number for number in range(len(steps)) if number in used]
    numbers = {number: i for i, number in enumerate(kept)}
    return [steps[n] | {"from": [numbers[source] for source in steps[n]["from"]]} for n in kept]


def _flat(values) -> Iterator:
    for value in values.values() if isinstance(values, dict) else values:
        if isinstance(value, list | tuple | dict):
            yield from _flat(value)
        else:
            yield value
