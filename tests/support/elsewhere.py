"""Tensors that pretend to lie on a GPU, to find code that mixes devices where there is no GPU."""

import torch
from torch.overrides import TorchFunctionMode
from torch.utils._pytree import tree_flatten, tree_map

GPU = torch.device("cuda", 0)
_HOME = torch.device("cpu")
_MOVES = ("to", "cpu", "cuda", "copy_", "type_as")
_READS = ("numpy", "tolist", "item", "__float__", "__int__", "__bool__", "_has_compatible_shallow_copy_type")


class Elsewhere(TorchFunctionMode):
    """While it is on, ``tensor.to("cuda")`` gives a copy in main memory that is taken to lie on a GPU.

    So is everything that is computed from it: told by storage, which views, ``detach`` and ``nn.Parameter``
    share. Its ``device`` is the GPU, so that no kernel of the CPU is chosen; an operator that is given
    tensors of both places raises RuntimeError, as a GPU would. As there, a tensor without axes may be
    elsewhere, and rows may be picked by indices of the CPU.
    """

    def __init__(self):
        super().__init__()
        self._there = {}  # kept alive, so that no address comes back

    def is_there(self, tensor):
        """Tell whether a tensor is taken to lie on the GPU."""
        with torch._C.DisableTorchFunction():
            return tensor.untyped_storage()._cdata in self._there

    def _put(self, tensor):
        with torch._C.DisableTorchFunction():
            storage = tensor.untyped_storage()
        self._there[storage._cdata] = storage

    def __torch_function__(self, func, types, args=(), kwargs=None):
        """See ``TorchFunctionMode``."""
        kwargs = dict(kwargs or {})
        name = getattr(func, "__name__", "")
        given = [t for t in tree_flatten((args, kwargs))[0] if isinstance(t, torch.Tensor)]
        there = [t for t in given if self.is_there(t)]
        if name == "__get__" and getattr(func, "__self__", None) is torch.Tensor.device:
            return GPU if there else func(*args, **kwargs)
        if name in _MOVES[:3]:
            return self._moved(func, args, kwargs)
        if name == "__set__" and getattr(func, "__self__", None) is torch.Tensor.data:
            return func(*args, **kwargs)
        if name in _READS or name in ("copy_", "type_as"):
            if name == "numpy" and there:
                raise TypeError("can't convert cuda:0 device type tensor to numpy")
            return func(*args, **kwargs)
        self._check(name, args, given, there)
        asked = kwargs.get("device")
        if asked is not None and torch.device(asked).type == "cuda":
            kwargs["device"] = _HOME
        here = asked is not None and torch.device(asked).type == "cpu"
        found = func(*args, **kwargs)
        if (there and not here) or (asked is not None and not here):
            tree_map(lambda t: self._put(t) if isinstance(t, torch.Tensor) else None, found)
        return found

    def _moved(self, func, args, kwargs):
        """What ``to``, ``cpu`` and ``cuda`` give: a copy in the other place, else what they always do."""
        before = self.is_there(args[0])
        goal = {"cpu": _HOME, "cuda": GPU}.get(func.__name__)
        rest = list(args[1:])
        for i, one in enumerate(rest):
            if isinstance(one, torch.Tensor):
                goal, rest[i] = GPU if self.is_there(one) else _HOME, one.dtype
            elif isinstance(one, str | torch.device):
                goal, rest[i] = torch.device(one), _HOME
        if kwargs.get("device") is not None:
            goal, kwargs["device"] = torch.device(kwargs["device"]), _HOME
        after = before if goal is None else goal.type == "cuda"
        found = args[0] if func.__name__ in ("cpu", "cuda") else func(args[0], *rest, **kwargs)
        if before != after and found.untyped_storage()._cdata == args[0].untyped_storage()._cdata:
            found = found.clone()
        with torch._C.DisableTorchFunction():
            same = found.untyped_storage()._cdata
        if after:
            self._put(found)
        else:
            self._there.pop(same, None)
        return found

    def _check(self, name, args, given, there):
        """Raise for tensors of both places, but for what a GPU allows."""
        if not there or len(there) == len(given):
            return
        picks = name in ("__getitem__", "__setitem__", "index_select") and self.is_there(args[0])
        beside = [t for t in given if not self.is_there(t) and t.dim() > 0]
        if picks:
            value = args[2] if name == "__setitem__" else None
            beside = [t for t in beside if t is value]
        if beside:
            shapes = ", ".join(str(tuple(t.shape)) for t in beside)
            raise RuntimeError(f"{name}: expected all tensors on cuda:0, but got {shapes} on the CPU")
