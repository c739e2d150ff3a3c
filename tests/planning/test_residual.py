"""What time and direction explain of errors."""

import math
from collections import namedtuple
from types import SimpleNamespace

import pytest
import torch

from forewarp.planning.residual import cells_of, explained, residual
from tests.support.tiny_scene import ball_data

VIEWS, CELLS = 40, 30
Drawn = namedtuple("Drawn", "rgb depth opacity")


@pytest.fixture(scope="module")
def seen():
    """Of every cell in every view: directions, cosines over time, cells, views, and noise (P, 3)."""
    generator = torch.Generator().manual_seed(0)
    cells, views = torch.arange(CELLS).repeat(VIEWS), torch.arange(VIEWS).repeat_interleave(CELLS)
    directions = torch.nn.functional.normalize(torch.randn(VIEWS, 3, generator=generator).double(), dim=-1)
    times = torch.rand(VIEWS, 1, generator=generator).double()
    over_time = torch.cos(math.pi * times * torch.arange(1, 3))
    noise = 0.01 * torch.randn(len(cells), 3, generator=generator).double()
    return directions[views], over_time[views], cells, views, noise


@pytest.mark.parametrize("moves", [False, True])
def test_what_causes_the_errors_explains_them(seen, moves):
    directions, over_time, cells, views, noise = seen
    cause = over_time if moves else directions
    errors = noise + (cause[:, :1] * torch.linspace(-0.3, 0.3, CELLS).double()[cells][:, None])
    by_direction, by_time = (explained(x, errors, cells, views) for x in (directions, over_time))
    assert (by_time > 0.7, by_time < 0.05) == (moves, not moves)
    assert (by_direction > 0.7, by_direction < 0.05) == (not moves, moves)


def test_noise_is_explained_by_nothing(seen):
    directions, over_time, cells, views, noise = seen
    assert explained(directions, noise, cells, views) < 0
    assert explained(over_time, noise, cells, views) < 0


def test_cells_are_a_tenth_of_the_extent():
    places = torch.stack([torch.linspace(0, 2, 401), torch.zeros(401), torch.zeros(401)], -1).double()
    assert 10 <= int(cells_of(places).max()) + 1 <= 12


@pytest.mark.parametrize(("opacity", "tells"), [(0.0, False), (1.0, True)])
def test_a_fit_without_opaque_matter_tells_nothing(opacity, tells):
    def render(view, background):
        count = len(view)
        return Drawn(torch.full((count, 3), 0.5), torch.full((count,), 2.0), torch.full((count,), opacity))

    method = SimpleNamespace(device="cpu", at=lambda moment: SimpleNamespace(render=render))
    found = residual(method, ball_data().targets("train"))
    assert (found is not None) is tells
