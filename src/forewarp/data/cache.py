"""Keep decoded images of all scenes within a bounded amount of memory."""

from __future__ import annotations

import weakref
from collections import OrderedDict
from collections.abc import Callable

from torch import Tensor

from forewarp.clock import left_out
from forewarp.scene.errors import SceneError


class ImageCache:
    """Keep a tensor for each owner while the owner lives and all together take at most ``limit`` bytes.

    The least recently used goes first. What is larger than ``limit`` is never kept.

    >>> import torch
    >>> class Owner: pass
    >>> cache, a, b = ImageCache(4), Owner(), Owner()
    >>> for owner in (a, b):
    ...     _ = cache.get(owner, lambda: torch.zeros(3, dtype=torch.uint8))
    >>> cache.bytes
    3
    """

    def __init__(self, limit: int) -> None:
        self._kept: OrderedDict[int, tuple[weakref.ref, Tensor]] = OrderedDict()
        self.bytes, self.limit = 0, limit

    def get(self, owner: object, make: Callable[[], Tensor]) -> Tensor:
        """Give what is kept for ``owner``, or make and keep it; treat it as read-only."""
        key = id(owner)
        if key in self._kept:
            self._kept.move_to_end(key)
            return self._kept[key][1]
        with left_out():  # reading pictures is no training
            made = make()
        if made.nbytes <= self.limit:
            # Freed as soon as the owner dies; until then no other object can have its id.
            self._kept[key] = (weakref.ref(owner, lambda _: self._drop(key)), made)
            self.bytes += made.nbytes
            self._shrink()
        return made

    def resize(self, limit: int) -> None:
        """Allow ``limit`` bytes from now on.

        Raises:
            SceneError: for anything but a number >= 0.
        """
        if isinstance(limit, bool) or not isinstance(limit, (int, float)) or not 0 <= limit < float("inf"):
            raise SceneError(f"data.cache_bytes: expected a number of bytes >= 0, but got {limit!r}")
        self.limit = int(limit)
        self._shrink()

    def _shrink(self) -> None:
        while self.bytes > self.limit:
            self._drop(next(iter(self._kept)))

    def _drop(self, key: int) -> None:
        _, gone = self._kept.pop(key)
        self.bytes -= gone.nbytes


CACHE = ImageCache(1_500_000_000)
