"""Rigid motion: nodes that carry particles, the weights of these nodes, and screws."""

from __future__ import annotations

import torch
from torch import Tensor

from forewarp.ops.backend import arrays, check_shapes, match_threads, use_numba
from forewarp.ops.layout import EPSILON

_WIDEST = 16  # nodes of a particle that the kernel knows
_EDGES = "motion (M, 6), places (M, 3), edges (M, E), weights (M, E)"
_PULLED = f"{_EDGES}, by_maps (M, 12)"
_SMALL = 0.05  # radian; below, series in the squared angle are exact to single precision


def _check(shapes: str, turns: Tensor, *tensors: Tensor) -> None:
    """Check shapes: if ``turns``, motion or rotations, has a fourth number of these, all have."""
    if turns.shape[-1] in (4, 7):
        shapes = shapes.replace("(M, 6)", "(M, 7)").replace("rotation (M, K, 3)", "rotation (M, K, 4)")
    check_shapes(shapes, *tensors)


def node_maps(motion: Tensor, places: Tensor) -> Tensor:
    """Return what nodes do to points around them, less the identity.

    A point x beside a node at p goes to ``R (x - p) + p + v``. ``R`` is that of the Gibbs vector r, whose
    length is the tangent of half the angle: ``R - I = D = 2 (r r^t - |r|^2 I + [r]x) / (1 + |r|^2)``: no
    trigonometry, smooth at 0. The map is ``x + D x + d`` with ``d = v - D p``. A Gibbs vector is infinite at
    half a turn. With one number w more, ``R`` is that of the quaternion ``(1 + w, r)`` of any length, and
    turns without end: ``D = 2 (r r^t - |r|^2 I + (1 + w) [r]x) / ((1 + w)^2 + |r|^2)``.

    Args:
        motion: (M, 6), v in world units and r; or (M, 7), and w.
        places: (M, 3) the rest positions, world units.

    Returns:
        (M, 12): D row by row, then d. Differentiable in ``motion``.

    Raises:
        ValueError: for other shapes.

    Cost: about 60 operations a node.

    >>> node_maps(torch.tensor([[0.0, 0.0, 1.0, 0.0, 0.0, 0.0]]), torch.ones(1, 3))[0, 9:]
    tensor([0., 0., 1.])
    """
    _check("motion (M, 6), places (M, 3)", motion, motion, places)
    shift, gibbs, more = motion[:, :3], motion[:, 3:6], motion[:, 6:]
    x, y, z = gibbs.unbind(-1)
    scalar = 1 + more.sum(-1)[:, None, None]
    zero, square = torch.zeros_like(x), gibbs.square().sum(-1)
    across = torch.stack([zero, -z, y, z, zero, -x, -y, x, zero], -1).reshape(-1, 3, 3)
    eye = torch.eye(3).to(motion)
    linear = gibbs[:, :, None] * gibbs[:, None] - square[:, None, None] * eye + scalar * across
    linear = linear * (2 / (scalar.square() + square[:, None, None]).clamp(min=EPSILON))
    rest = shift - (linear @ places[..., None])[..., 0]
    return torch.cat([linear.reshape(-1, 9), rest], -1)


def carry_nodes(
    shift: Tensor, rotation: Tensor | None, basis: Tensor, places: Tensor
) -> tuple[Tensor, Tensor]:
    """Carry nodes along their curves to a time: ``motion`` (M, 6) or (M, 7), and its ``node_maps`` (M, 12).

    Args:
        shift, rotation: (M, K, 3) coefficients, of rotations also (M, K, 4); None where nothing rotates.
        basis: (K,) of the time.
        places: (M, 3).

    Returns:
        both; where a gradient is asked for, with their graph.

    Cost: 6 numbers a node and coefficient that is not 0.
    """
    curves = [shift] if rotation is None else [shift, rotation]
    shapes = "places (M, 3), basis (K), shift (M, K, 3), rotation (M, K, 3)"
    _check(shapes, curves[-1], places, basis, shift, curves[-1])
    asks = torch.is_grad_enabled() and any(curve.requires_grad for curve in curves)
    if use_numba(shift) and shift.dtype == torch.float32 and not asks:
        from forewarp.ops.kernels import nodes as kernels

        motion = shift.new_empty(len(places), 3 + curves[-1].shape[2])
        maps = shift.new_empty(len(places), 12)
        pair = (shift, shift[:0] if rotation is None else rotation)
        kernels.carry(*arrays(*pair, basis, places, motion, maps))
        return motion, maps
    parts = [torch.einsum("mkc,k->mc", curve, basis) for curve in curves]
    motion = torch.cat([*parts, *[torch.zeros_like(parts[0])] * (2 - len(parts))], -1)
    return motion, node_maps(motion, places)


def stiffness(motion: Tensor, places: Tensor, edges: Tensor, weights: Tensor) -> Tensor:
    """Measure how far nodes are from moving rigidly: ``sum w |v_l - v_m - D_m (p_l - p_m)|^2``.

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
    _check(_EDGES, motion, motion, places, edges, weights)
    linear = node_maps(motion, places)[:, :9].reshape(-1, 3, 3)
    apart = places[edges] - places[:, None]
    strain = motion[edges, :3] - motion[:, None, :3] - (linear[:, None] @ apart[..., None])[..., 0]
    return (weights[..., None] * strain.square()).sum()


def pull_nodes(
    motion: Tensor, places: Tensor, by_maps: Tensor, edges: Tensor, weights: Tensor, factor: float
) -> tuple[Tensor, float]:
    """Return gradients by ``motion`` of a loss with ``by_maps`` (M, 12), and of ``factor`` x ``stiffness``.

    Args:
        motion, places, edges, weights: as of ``stiffness``.
        by_maps: gradients by ``node_maps``.
        factor: of the stiffness.

    Returns:
        gradients as ``motion``, and the stiffness itself.

    Raises:
        ValueError: for shapes that do not go together.

    Cost: about 60 operations an edge.
    """
    _check(_PULLED, motion, motion, places, edges, weights, by_maps)
    if use_numba(motion) and motion.dtype == torch.float32:
        from forewarp.ops.kernels import nodes as kernels

        gradient = torch.zeros_like(motion)
        pulled = kernels.pull(*arrays(motion, places, by_maps, edges, weights, gradient), float(factor))
        return gradient, pulled
    leaf = motion.detach().clone().requires_grad_()
    with torch.enable_grad():
        strain = stiffness(leaf, places, edges, weights)
        ((node_maps(leaf, places) * by_maps).sum() + factor * strain).backward()
    return leaf.grad, float(strain.detach())


def spread_nodes(
    shift: Tensor, rotation: Tensor | None, by_motion: Tensor, basis: Tensor, bend: Tensor, factor: float,
    unit: float,
) -> tuple[Tensor, Tensor | None, float]:  # fmt: skip
    """Carry gradients by ``motion`` at a time to the coefficients of the curves, and keep curves smooth.

    The bend of a node is ``b = sum_k c_k bend_k``, of ``shift`` in shares of ``unit``; what is added to the
    loss is ``factor mean b^2``, once for ``shift`` and once for ``rotation``.

    Args:
        shift, rotation: (M, K, 3) coefficients, of rotations also (M, K, 4); None where nothing rotates.
        by_motion: (M, 6) or (M, 7), gradients by ``motion``.
        basis, bend: (K,) of the time; of its second difference.
        factor: of the squared bend.
        unit: a length, world units.

    Returns:
        gradients by ``shift`` and by ``rotation``, and the mean of b^2, both kinds together.

    Raises:
        ValueError: for shapes that do not go together.

    Cost: about 20 operations a coefficient.
    """
    shapes = "shift (M, K, 3), rotation (M, K, 3), by_motion (M, 6), basis (K), bend (K)"
    turns = shift if rotation is None else rotation
    _check(shapes, turns, shift, turns, by_motion, basis, bend)
    gradients, total = [], 0.0
    for curve, by_curve, scale in ((shift, by_motion[:, :3], unit), (rotation, by_motion[:, 3:], 1.0)):
        if curve is None:
            gradients.append(None)
            continue
        curve = curve.detach()
        if use_numba(curve) and curve.dtype == torch.float32:
            from forewarp.ops.kernels import nodes as kernels

            gradient = torch.empty_like(curve)
            # Half of the columns of ``by_motion`` are no contiguous array: read as they lie.
            inputs = (t.numpy() for t in (curve, by_curve, basis, bend, gradient))
            total += kernels.spread(*inputs, float(factor), float(scale))
        else:
            bent = torch.einsum("mkc,k->mc", curve, bend) / scale
            total += float(bent.square().mean())
            pulled = 2 * factor / (bent.numel() * scale) * bent
            gradient = by_curve[:, None] * basis[:, None] + pulled[:, None] * bend[:, None]
        gradients.append(gradient)
    return *gradients, total


def skin_weights(shares: Tensor, learned: Tensor) -> Tensor:
    """Return the weights ``s_j exp(l_j) / sum_k s_k exp(l_k)`` of the nodes that particles follow.

    Args:
        shares: (N, L), >= 0; a row of zeros gives zeros.
        learned: (N, L), of any size: what counts is how far apart the numbers of a row are.

    Returns:
        (N, L). Differentiable in ``learned``, where a gradient is asked for.

    Raises:
        ValueError: for shapes that do not go together.

    Cost: an exponential a weight.

    >>> skin_weights(torch.tensor([[0.5, 0.5]]), torch.tensor([[1000.0, 1000.0]]))
    tensor([[0.5000, 0.5000]])
    """
    check_shapes("shares (N, L), learned (N, L)", shares, learned)
    asks = torch.is_grad_enabled() and learned.requires_grad
    fast = use_numba(learned) and learned.dtype == torch.float32 and shares.dtype == torch.float32
    if not fast or asks or not 0 < shares.shape[1] <= _WIDEST:
        top = learned.detach().amax(-1, keepdim=True)  # a row less it means the same, and is safe
        weights = shares * (learned - top).exp()
        return weights / weights.sum(-1, keepdim=True).clamp(min=EPSILON)
    from forewarp.ops.kernels import nodes as kernels

    match_threads()
    weights = torch.empty(shares.shape)
    kernels.weigh(*arrays(shares.reshape(-1), learned.reshape(-1), weights.view(-1)), shares.shape[1])
    return weights


def move_by_screw(points: Tensor, rotation: Tensor, shift: Tensor) -> Tensor:
    """Move points by the exponential of a screw (se(3)): ``x' = R x + V v``.

    With ``theta = |w|`` and ``W`` the matrix of ``w x``: ``R = I + a W + b W^2`` and ``V = I + b W + c W^2``,
    where ``a = sin(theta) / theta``, ``b = (1 - cos(theta)) / theta^2``, ``c = (1 - a) / theta^2``. Small
    angles take the series, so that value and gradient are finite at 0, where ``x' = x + v`` (Nerfies, with
    its axis ``(w, v) / theta`` written out).

    Args:
        points: x (..., 3).
        rotation: w (..., 3), radian about the origin.
        shift: v (..., 3), in the unit of the points.

    Returns:
        (..., 3). Differentiable in all three.

    >>> move_by_screw(torch.tensor([1.0, 0.0, 0.0]), torch.zeros(3), torch.tensor([0.0, 2.0, 0.0]))
    tensor([1., 2., 0.])
    """
    check_shapes("points (..., 3), rotation (..., 3), shift (..., 3)", points, rotation, shift)
    a, b, c = _coefficients(rotation.square().sum(-1, keepdim=True))
    about = torch.linalg.cross(rotation, points)
    along = torch.linalg.cross(rotation, shift)
    rotated = points + a * about + b * torch.linalg.cross(rotation, about)
    return rotated + shift + b * along + c * torch.linalg.cross(rotation, along)


def _coefficients(squared: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Return ``sin(t)/t``, ``(1 - cos t)/t^2`` and ``(t - sin t)/t^3`` of squared angles."""
    small = squared < _SMALL**2
    q = torch.where(small, squared, 0.0)
    series = (
        1 - q / 6 * (1 - q / 20 * (1 - q / 42)),
        (1 - q / 12 * (1 - q / 30 * (1 - q / 56))) / 2,
        (1 - q / 20 * (1 - q / 42 * (1 - q / 72))) / 6,
    )
    safe = torch.where(small, 1.0, squared)
    angle = safe.sqrt()
    exact = angle.sin() / angle, (1 - angle.cos()) / safe, (angle - angle.sin()) / (angle * safe)
    return tuple(torch.where(small, near, far) for near, far in zip(series, exact))


def stretch(jacobian: Tensor, floor: float = 1e-6) -> Tensor:
    """Sum the squared logarithms of a map's singular values: 0 where it is locally rigid (Nerfies' elastic
    energy).

    Args:
        jacobian: (..., 3, 3).
        floor: of a singular value.

    Returns:
        (...,) >= 0. Differentiable also where singular values are equal, as at the identity.

    >>> float(stretch(2 * torch.eye(3)) / torch.tensor(2.0).log() ** 2)
    3.0
    """
    check_shapes("jacobian (..., 3, 3)", jacobian)
    return torch.linalg.svdvals(jacobian).clamp(min=floor).log().square().sum(-1)


def geman_mcclure(squared: Tensor, scale: float) -> Tensor:
    """Robust loss ``2 q / (q + 4) * scale`` of squared residuals, q over ``scale^2``: at most ``2 * scale``.

    Near 0 it is a half of the squared residual over the scale. Barron's general robust loss of shape -2 is
    ``2 q / (q + 4)``; Nerfies' and HyperNeRF's code multiplies it by its scale, for which their weights are.

    >>> geman_mcclure(torch.tensor([0.0, 1.0, torch.inf]), 0.5)
    tensor([0.0000, 0.5000, 1.0000])
    """
    return 2 * scale / (1 + 4 / (squared / scale**2).clamp(min=torch.finfo(squared.dtype).tiny))
