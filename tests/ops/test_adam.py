import pytest
import torch

from forewarp.methods.rows import RowsAdam
from forewarp.ops.adam import AdamState, adam_rows


def state(shape=(6, 3), seed=0):
    generator = torch.Generator().manual_seed(seed)
    value = torch.randn(*shape, generator=generator)
    return value, torch.zeros(shape), torch.zeros(shape), torch.zeros(shape[:-1])


def step(parts, gradient, rate=0.1):
    value, mean, square, steps = parts
    adam_rows([AdamState(value, gradient, mean, square, steps, rate)], (0.9, 0.99), 1e-15)


@pytest.mark.parametrize("shape", [(6, 3), (37, 4), (40, 1), (33, 17)])
def test_it_is_adam_where_every_row_has_a_gradient(backend, shape):
    parts = state(shape)
    twin = torch.nn.Parameter(parts[0].clone())
    known = torch.optim.Adam([twin], lr=0.1, betas=(0.9, 0.99), eps=1e-15)
    for number in range(5):
        gradient = torch.randn(*shape, generator=torch.Generator().manual_seed(number))
        twin.grad = gradient.clone()
        known.step()
        step(parts, gradient)
    torch.testing.assert_close(parts[0], twin.data)


@pytest.mark.parametrize("rows", [6, 32])
def test_rows_without_a_gradient_stay_as_they_are(backend, rows):
    parts, gradient = state((rows, 3)), torch.ones(rows, 3)
    step(parts, gradient)
    gradient[2] = 0
    gradient[4, :2] = 0  # a part of it has one
    before = [part.clone() for part in parts]
    step(parts, gradient)
    for now, then in zip(parts, before):
        assert torch.equal(now[2], then[2])
    assert parts[3].tolist() == [2, 2, 1, 2, 2, 2] + [2] * (rows - 6)
    torch.testing.assert_close(parts[0][0], before[0][0] - 0.1)


def test_each_row_counts_its_own_steps(backend):
    parts = state()
    first = torch.ones(6, 3)
    first[0] = 0
    step(parts, first)
    before = parts[0].clone()
    step(parts, torch.ones(6, 3))
    # For the first row it is the first step: a whole rate, as for all at their first.
    torch.testing.assert_close(parts[0], before - 0.1)


def test_of_more_axes_the_last_is_a_row(backend):
    parts, gradient = state((4, 5, 3)), torch.ones(4, 5, 3)
    gradient[1, 2] = 0
    step(parts, gradient)
    assert parts[3].sum() == 19


def test_both_agree_after_many_steps():
    fast, exact = state((19, 3)), [part.double() for part in state((19, 3))]
    for number in range(2100):
        gradient = torch.randn(19, 3, generator=torch.Generator().manual_seed(number))
        step(fast, gradient, 1e-3)
        step(exact, gradient.double(), 1e-3)
    torch.testing.assert_close(fast[0].double(), exact[0], rtol=1e-3, atol=1e-3)


@pytest.mark.parametrize("width", range(1, 18))
def test_rows_of_many_steps_have_one_pace_and_those_without_a_gradient_stay(width):
    fast = state((53, width))
    fast[3].copy_(torch.arange(53) + 1700.0)  # some blocks below the end of the table, some beyond
    fast[1].normal_()
    fast[2].uniform_(0.5, 1.0)
    gradient = torch.randn(53, width, generator=torch.Generator().manual_seed(1))
    rest = [3, 20, 31, 40, 51]
    gradient[rest] = 0
    gradient[41, 1:], gradient[42, :-1] = 0, 0  # a part of it has one
    exact, before = [part.double() for part in fast], [part.clone() for part in fast]
    step(fast, gradient, 1e-3)
    step(exact, gradient.double(), 1e-3)
    for part, twin, then in zip(fast, exact, before):
        torch.testing.assert_close(part.double(), twin, rtol=1e-5, atol=1e-6)
        assert torch.equal(part[rest], then[rest])


def test_not_a_number_is_kept(backend):
    parts, gradient = state((37, 3)), torch.ones(37, 3)
    for row in (3, 35):  # among those side by side, and beyond
        gradient[row] = torch.tensor([float("nan"), 0.0, 0.0])
    step(parts, gradient)
    assert parts[0].isnan().nonzero().tolist() == [[3, 0], [35, 0]]


def test_moments_of_another_shape_are_refused(backend):
    value, mean, square, steps = state((200, 3))
    with pytest.raises(ValueError, match="exp_avg: expected shape"):
        step((value, mean[:1], square[:1], steps), torch.ones(200, 3))
    with pytest.raises(ValueError, match="steps: expected shape"):
        step((value, mean, square, steps[:5]), torch.ones(200, 3))


def test_moments_on_another_device_are_refused():
    value, mean, square, steps = state((32, 3))
    with pytest.raises((RuntimeError, NotImplementedError)):
        step((value, mean.to("meta"), square, steps), torch.ones(32, 3))


@pytest.mark.parametrize("count", [-1e9, -5000.0, float("nan"), 1e30])
def test_any_count_of_steps_stays_within_the_table(count):
    parts = state((40, 3))
    parts[3][::3] = count
    step(parts, torch.ones(40, 3))
    assert bool(parts[0].isfinite().all())


def test_what_is_not_contiguous_is_changed_in_place_too():
    plain, spread = state((32, 3)), [torch.zeros(*t.shape, 2)[..., 0] for t in state((32, 3))]
    for part, own in zip(plain, spread):
        own.copy_(part)
    assert not any(part.is_contiguous() for part in spread)
    for _ in range(2):
        step(plain, torch.ones(32, 3))
        step(spread, torch.ones(32, 3))
    for part, own in zip(plain, spread):
        torch.testing.assert_close(own, part)
    assert float(spread[3][0]) == 2


@pytest.mark.parametrize("rows", [5, 70])
def test_gradients_may_be_columns_of_a_larger_tensor(backend, rows):
    together = torch.randn(rows, 6, 3, generator=torch.Generator().manual_seed(2))
    together[rows // 2] = 0
    for first, last in ((0, 1), (1, 4), (4, 6)):
        shape = (rows, last - first, 3)
        part, whole = state(shape), state(shape)
        for _ in range(2):
            step(part, together[:, first:last])
            step(whole, together[:, first:last].contiguous())
        for own, other in zip(part, whole):
            assert torch.equal(own, other)


def test_gradients_may_lie_in_any_order(backend):
    part, whole, turned = state((32, 3)), state((32, 3)), torch.randn(3, 32).T
    step(part, turned)
    step(whole, turned.contiguous())
    assert torch.equal(part[0], whole[0])


def test_many_parameters_take_a_step_at_one_go(backend):
    shapes = [(40, 3), (7, 2, 3), (33, 5), (20, 17), (16, 1), (4, 6)]
    alone, together = ([state(shape) for shape in shapes] for _ in range(2))
    alone[1], together[1] = ([part.double() for part in parts[1]] for parts in (alone, together))
    gradients = [torch.randn(shape) for shape in shapes]
    gradients[0][5] = 0
    gradients[1] = gradients[1].double()
    rates = [0.1 * (1 + number) for number in range(len(shapes))]
    for parts, gradient, rate in zip(alone, gradients, rates):
        step(parts, gradient, rate)
    learned = [AdamState(v, g, m, s, n, r) for (v, m, s, n), g, r in zip(together, gradients, rates)]
    adam_rows(learned, (0.9, 0.99), 1e-15)
    for one, other in zip(alone, together):
        for part, twin in zip(one, other):
            assert torch.equal(part, twin)
    adam_rows([], (0.9, 0.99), 1e-15)


def test_groups_have_rates_and_betas_of_their_own(backend):
    values = [torch.nn.Parameter(torch.zeros(20, 3)) for _ in range(3)]
    groups = [
        {"params": values[:1], "lr": 0.1},
        {"params": values[1:2], "lr": 0.2},
        {"params": values[2:], "lr": 0.1, "betas": (0.5, 0.5)},
    ]
    optimizer = RowsAdam(groups)
    for sign in (1.0, -2.0):
        for value in values:
            value.grad = torch.full((20, 3), sign)
        optimizer.step()
    first, second, third = (float(value.detach()[0, 0]) for value in values)
    assert second == pytest.approx(2 * first)
    assert third != pytest.approx(first, abs=1e-3)


def test_betas_of_one_are_refused():
    with pytest.raises(ValueError, match=r"betas: expected numbers from 0 to below 1, but got \(0.9, 1.0\)"):
        RowsAdam([{"params": [torch.nn.Parameter(torch.zeros(2))]}], betas=(0.9, 1.0))
