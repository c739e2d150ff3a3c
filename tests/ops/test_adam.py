import math

import pytest
import torch
from torch.utils._python_dispatch import TorchDispatchMode

from forewarp.ops.adam import AdamState, adam_rows


def state(shape=(6, 3), seed=0):
    generator = torch.Generator().manual_seed(seed)
    value = torch.randn(*shape, generator=generator)
    return value, torch.zeros(shape), torch.zeros(shape), torch.zeros(shape[:-1])


def step(parts, gradient, lr=0.1):
    value, mean, square, steps = parts
    adam_rows([AdamState(value, gradient, mean, square, steps, lr)], (0.9, 0.99), 1e-15)


def numbered(shape, seed):
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed))


@pytest.mark.parametrize("shape", [(6, 3), (37, 4), (40, 1), (33, 17)])
def test_it_is_adam_where_every_row_has_a_gradient(backend, shape):
    parts = state(shape)
    value, mean, square = (part.clone().flatten().double().tolist() for part in parts[:3])
    for n in range(1, 5):
        gradient = numbered(shape, n)
        step(parts, gradient)
        for i, g in enumerate(gradient.flatten().tolist()):  # as printed
            mean[i], square[i] = 0.9 * mean[i] + 0.1 * g, 0.99 * square[i] + 0.01 * g * g
            value[i] -= 0.1 * mean[i] / (1 - 0.9**n) / math.sqrt(square[i] / (1 - 0.99**n))
    torch.testing.assert_close(parts[0].flatten(), torch.tensor(value), rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize("rows", [6, 32])
def test_rows_without_a_gradient_stay_and_each_counts_its_own_steps(backend, rows):
    parts, gradient = state((rows, 3)), torch.ones(rows, 3)
    gradient[0] = 0
    step(parts, gradient)
    gradient[0], gradient[2] = 1, 0
    gradient[4, :2] = 0  # a part of it has one
    before = [part.clone() for part in parts]
    step(parts, gradient)
    assert all(torch.equal(now[2], then[2]) for now, then in zip(parts, before))
    assert parts[3].tolist() == [1, 2, 1, 2, 2, 2] + [2] * (rows - 6)
    torch.testing.assert_close(parts[0][:2], before[0][:2] - 0.1)  # a whole rate at any row's first step


@pytest.mark.parametrize("width", range(1, 18))
def test_rows_of_any_width_and_number_of_steps_equal_the_reference(width):
    fast = state((53, width))
    fast[3].copy_(torch.arange(53) + 1700.0)  # some blocks below the end of the table, some beyond
    fast[1].normal_()
    fast[2].uniform_(0.5, 1.0)
    gradient, rest = numbered((53, width), 1), [3, 20, 31, 40, 51]
    gradient[rest] = 0
    gradient[41, 1:], gradient[42, :-1] = 0, 0  # a part of it has one
    exact, before = [part.double() for part in fast], [part.clone() for part in fast]
    for _ in range(3):
        step(fast, gradient, 1e-3)
        step(exact, gradient.double(), 1e-3)
    for part, twin, then in zip(fast, exact, before):
        torch.testing.assert_close(part.double(), twin, rtol=1e-5, atol=1e-6)
        assert torch.equal(part[rest], then[rest])


class Called(TorchDispatchMode):
    """The operators that PyTorch calls, by name."""

    def __init__(self):
        super().__init__()
        self.names = []

    def __torch_dispatch__(self, func, types, args=(), kwargs=None):
        self.names.append(func.overloadpacket.__name__)
        return func(*args, **(kwargs or {}))


def test_on_a_gpu_no_step_waits_for_numbers_of_it():
    """Without a kernel no operator depends on numbers that would first have to come to the host."""
    parts, gradient = [part.double() for part in state((37, 3))], numbered((37, 3), 1).double()
    gradient[3] = 0
    with Called() as called:
        step(parts, gradient)
    assert len(called.names) > 10
    assert not {"nonzero", "index", "index_put_", "masked_select", "_local_scalar_dense"} & set(called.names)


def test_not_a_number_is_kept(backend):
    parts, gradient = state((37, 3)), torch.ones(37, 3)
    for row in (3, 35):  # among those side by side, and beyond
        gradient[row] = torch.tensor([float("nan"), 0.0, 0.0])
    step(parts, gradient)
    assert parts[0].isnan().nonzero().tolist() == [[3, 0], [35, 0]]


def test_states_that_do_not_go_together_are_refused(backend):
    value, mean, square, steps = state((200, 3))
    with pytest.raises(ValueError, match="exp_avg: expected shape"):
        step((value, mean[:1], square[:1], steps), torch.ones(200, 3))
    with pytest.raises(ValueError, match="steps: expected shape"):
        step((value, mean, square, steps[:5]), torch.ones(200, 3))


@pytest.mark.parametrize("count", [-1e9, -5000.0, float("nan"), 1e30])
def test_any_count_of_steps_stays_within_the_table(count):
    parts = state((40, 3))
    parts[3][::3] = count
    step(parts, torch.ones(40, 3))
    assert bool(parts[0].isfinite().all())


@pytest.mark.parametrize("rows", [5, 70])
def test_how_numbers_lie_in_memory_does_not_matter(backend, rows):
    together = numbered((rows, 6, 3), 2)
    together[rows // 2] = 0
    gradients = (together[:, 0], together[:, 1:4], numbered((3, rows), 3).T)
    for gradient in gradients:
        part, whole = state(gradient.shape), state(gradient.shape)
        spread = [torch.stack([t, t], -1)[..., 0] for t in whole]
        for _ in range(2):
            step(part, gradient)
            step(whole, gradient.contiguous())
            step(spread, gradient)
        for first, second, third in zip(part, whole, spread):
            assert torch.equal(first, second)
            torch.testing.assert_close(third, first)


def test_many_parameters_take_a_step_at_one_go(backend):
    shapes = [(40, 3), (7, 2, 3), (33, 5), (20, 17), (16, 1), (4, 6)]
    alone, together = ([state(shape) for shape in shapes] for _ in range(2))
    alone[1], together[1] = ([part.double() for part in parts[1]] for parts in (alone, together))
    gradients = [torch.randn(shape) for shape in shapes]
    gradients[0][5] = 0
    gradients[1] = gradients[1].double()
    rates = [0.1 * (1 + number) for number in range(len(shapes))]
    for parts, gradient, lr in zip(alone, gradients, rates):
        step(parts, gradient, lr)
    states = [AdamState(v, g, m, s, n, lr) for (v, m, s, n), g, lr in zip(together, gradients, rates)]
    adam_rows(states, (0.9, 0.99), 1e-15)
    assert all(torch.equal(a, b) for pair in zip(alone, together) for a, b in zip(*pair))
    adam_rows([], (0.9, 0.99), 1e-15)
