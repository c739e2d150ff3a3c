"""Decoded images: the limit holds, what is used last stays, and no pixel changes."""

import gc

import pytest
import torch

from forewarp.data.files import SceneError
from forewarp.data.images import CACHE, CachedImage, ImageCache, write_png


class Owner:
    """Somebody that images are made for."""


def maker(log, name, size=4):
    def make():
        log.append(name)
        return torch.full((size,), len(log), dtype=torch.uint8)

    return make


def test_the_limit_holds_and_the_longest_unused_goes_first():
    cache, log, owners = ImageCache(10), [], {name: Owner() for name in "abc"}
    for name in "abacab":
        made = cache.get(owners[name], maker(log, name))
        assert cache.get(owners[name], maker(log, name)) is made
        assert cache.bytes <= 10
    assert log == ["a", "b", "c", "b"]  # c took the place of b, which was not asked for since


def test_what_is_too_large_is_made_every_time():
    cache, log, small, large = ImageCache(10), [], Owner(), Owner()
    cache.get(small, maker(log, "small"))
    for _ in range(2):
        assert len(cache.get(large, maker(log, "large", 11))) == 11
    assert (log, cache.bytes) == (["small", "large", "large"], 4)


def test_an_owners_end_frees_its_image():
    cache, owner = ImageCache(10), Owner()
    cache.get(owner, maker([], "a"))
    del owner
    gc.collect()
    assert cache.bytes == 0
    assert len(cache.get(Owner(), maker([], "b", 10))) == 10


def test_a_smaller_limit_counts_at_once():
    cache, owners = ImageCache(12), [Owner() for _ in range(3)]
    for owner in owners:
        cache.get(owner, maker([], "a"))
    cache.resize(5)
    assert cache.bytes == 4
    for limit in (-1, "1 GB", True, float("inf")):
        with pytest.raises(SceneError, match="data.cache_bytes: expected a number of bytes >= 0, but got"):
            cache.resize(limit)
    assert cache.limit == 5


def test_eviction_changes_no_pixel(tmp_path):
    images = torch.randint(0, 256, (5, 6, 8, 4), dtype=torch.uint8)
    loads = []
    for i, image in enumerate(images):
        write_png(tmp_path / f"{i}.png", image)
        loads.append(CachedImage(tmp_path / f"{i}.png", (8, 6)))
    before = CACHE.limit
    try:
        for limit in (2 * images[0].nbytes, 0):
            CACHE.resize(limit)
            for i in (0, 1, 2, 0, 4, 3, 3, 1, 0):
                assert torch.equal(loads[i](), images[i])
                assert CACHE.bytes <= limit
    finally:
        CACHE.resize(before)
