"""Nodes that carry particles: each a rest position, a way it went, and how far it turned."""

from __future__ import annotations

import torch
from torch import Tensor

from forewarp.ops.backend import use_numba
from forewarp.ops.checks import check_shape


def node_maps(motion: Tensor, places: Tensor) -> Tensor:
    """What nodes do to points around them, less the identity.

    A point x beside a node at p goes to ``R (x - p) + p + v``. ``R`` is that of the Gibbs vector r, whose
    length is the tangent of half the angle: ``R - I = D = 2 (r r^t - |r|^2 I + [r]x) / (1 + |r|^2)``: no
    trigonometry, smooth at 0. The map is ``x + D x + d`` with ``d = v - D p``.

    Args:
        motion: (M, 6), v in world units and r.
        places: (M, 3) the rest positions, world units.

    Returns:
        (M, 12): D row by row, then d. Differentiable in ``motion``.

    Raises:
        ValueError: for other shapes.

    Cost: about 60 operations a node.

    >>> node_maps(torch.tensor([[0.0, 0.0, 1.0, 0.0, 0.0, 0.0]]), torch.ones(1, 3))[0, 9:]
    tensor([0., 0., 1.])
    """
    check_shape("motion", motion, ("M", 6))
    check_shape("places", places, (len(motion), 3))
    shift, turn = motion[:, :3], motion[:, 3:]
    x, y, z = turn.unbind(-1)
    zero, square = torch.zeros_like(x), turn.square().sum(-1)
    across = torch.stack([zero, -z, y, z, zero, -x, -y, x, zero], -1).reshape(-1, 3, 3)
    eye = torch.eye(3).to(motion)
    linear = turn[:, :, None] * turn[:, None] - square[:, None, None] * eye + across
    linear = linear * (2 / (1 + square))[:, None, None]
    rest = shift - (linear @ places[..., None])[..., 0]
    return torch.cat([linear.reshape(-1, 9), rest], -1)


def carry_nodes(shift: Tensor, turn: Tensor | None, basis: Tensor, places: Tensor) -> tuple[Tensor, Tensor]:
    """Where nodes are at a time, from their curves: ``motion`` (M, 6) and its ``node_maps`` (M, 12).

    Args:
        shift, turn: (M, K, 3) coefficients; None where nothing turns.
        basis: (K,) of the time.
        places: (M, 3).

    Returns:
        both; where a gradient is asked for, with their graph.

    Cost: 6 numbers a node and coefficient that is not 0.
    """
    check_shape("places", places, ("M", 3))
    _check_curves(shift, turn, (len(places), len(basis), 3))
    asks = torch.is_grad_enabled() and (shift.requires_grad or (turn is not None and turn.requires_grad))
    if use_numba(shift) and shift.dtype == torch.float32 and not asks:
        from forewarp.ops import kernels_nodes

        motion, maps = shift.new_empty(len(places), 6), shift.new_empty(len(places), 12)
        arrays = (shift, shift[:0] if turn is None else turn, basis, places, motion, maps)
        kernels_nodes.carry(*(a.detach().numpy() for a in arrays))
        return motion, maps
    went = torch.einsum("mkc,k->mc", shift, basis)
    turned = torch.zeros_like(went) if turn is None else torch.einsum("mkc,k->mc", turn, basis)
    motion = torch.cat([went, turned], -1)
    return motion, node_maps(motion, places)


def stiffness(motion: Tensor, places: Tensor, edges: Tensor, weights: Tensor) -> Tensor:
    """How far nodes are from moving rigidly together: ``sum w |v_l - v_m - D_m (p_l - p_m)|^2``.

    Args:
        motion, places: as of ``node_maps``.
        edges: (M, E) int64, the neighbours l of each node m.
        weights: (M, E).

    Returns:
        (), differentiable in ``motion``.

    Raises:
        ValueError: for shapes that do not go together.

    Cost: about 40 operations an edge.
    """
    _check_edges(motion, places, edges, weights)
    linear = node_maps(motion, places)[:, :9].reshape(-1, 3, 3)
    apart = places[edges] - places[:, None]
    strain = motion[edges, :3] - motion[:, None, :3] - (linear[:, None] @ apart[..., None])[..., 0]
    return (weights[..., None] * strain.square()).sum()


def _check_edges(motion: Tensor, places: Tensor, edges: Tensor, weights: Tensor) -> None:
    check_shape("motion", motion, ("M", 6))
    check_shape("places", places, (len(motion), 3))
    check_shape("edges", edges, (len(motion), "E"))
    check_shape("weights", weights, tuple(edges.shape))


def _check_curves(shift: Tensor, turn: Tensor | None, shape: tuple[int | str, ...]) -> None:
    check_shape("shift", shift, shape)
    if turn is not None:
        check_shape("turn", turn, tuple(shift.shape))


def pull_nodes(
    motion: Tensor, places: Tensor, by_maps: Tensor, edges: Tensor, weights: Tensor, factor: float
) -> tuple[Tensor, float]:
    """Gradients by ``motion`` of a loss that has ``by_maps`` (M, 12) and of ``factor`` times ``stiffness``.

    Args:
        motion, places, edges, weights: as of ``stiffness``.
        by_maps: slopes by ``node_maps``.
        factor: of the stiffness.

    Returns:
        gradients (M, 6), and the stiffness itself.

    Cost: about 60 operations an edge.
    """
    _check_edges(motion, places, edges, weights)
    check_shape("by_maps", by_maps, (len(motion), 12))
    if use_numba(motion) and motion.dtype == torch.float32:
        from forewarp.ops import kernels_nodes

        found = torch.zeros_like(motion)
        arrays = (motion, places, by_maps.contiguous(), edges, weights, found)
        return found, kernels_nodes.pull(*(a.detach().numpy() for a in arrays), float(factor))
    own = motion.detach().clone().requires_grad_()
    with torch.enable_grad():
        strain = stiffness(own, places, edges, weights)
        ((node_maps(own, places) * by_maps).sum() + factor * strain).backward()
    return own.grad, float(strain.detach())


def spread_nodes(
    shift: Tensor, turn: Tensor | None, slope: Tensor, basis: Tensor, bend: Tensor, factor: float, unit: float
) -> tuple[Tensor, Tensor | None, float]:
    """Carry gradients by ``motion`` at a time to the coefficients of the curves, and keep curves smooth.

    The bend of a node is ``b = sum_k c_k bend_k``, of ``shift`` in shares of ``unit``; what is added to the
    loss is ``factor mean b^2``, once for ``shift`` and once for ``turn``.

    Args:
        shift, turn: (M, K, 3) coefficients; None where nothing turns.
        slope: (M, 6) gradients by ``motion``.
        basis, bend: (K,) of the time; of its second difference.
        factor: of the squared bend.
        unit: a length, world units.

    Returns:
        gradients by ``shift`` and by ``turn`` (M, K, 3), and the mean of b^2, both kinds together.

    Cost: about 20 operations a coefficient.
    """
    _check_curves(shift, turn, ("M", "K", 3))
    check_shape("slope", slope, (len(shift), 6))
    check_shape("basis", basis, (shift.shape[1],))
    check_shape("bend", bend, (shift.shape[1],))
    parts = ((shift, slope[:, :3], unit), (turn, slope[:, 3:], 1.0))
    found, total = [], 0.0
    for value, own, scale in parts:
        if value is None:
            found.append(None)
            continue
        value = value.detach()
        if use_numba(value) and value.dtype == torch.float32:
            from forewarp.ops import kernels_nodes

            gradient = torch.empty_like(value)
            arrays = (value, own, basis, bend, gradient)
            total += kernels_nodes.spread(*(a.numpy() for a in arrays), float(factor), float(scale))
        else:
            bent = torch.einsum("mkc,k->mc", value, bend) / scale
            total += float(bent.square().mean())
            pulled = 2 * factor / (bent.numel() * scale) * bent
            gradient = own[:, None] * basis[:, None] + pulled[:, None] * bend[:, None]
        found.append(gradient)
    return *found, total
