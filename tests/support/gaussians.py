"""Particles before a camera, for tests of their operators."""

import torch

from forewarp.ops.gaussians import Gaussians, Pinhole, Warp

SIZE = (29, 21)  # no multiple of a tile


def pinhole(size=SIZE, **changes):
    """A camera at z = -4 that looks along z, turned a little about it."""
    angle = torch.tensor(0.3, dtype=torch.float64)
    c, s = angle.cos().item(), angle.sin().item()
    turned = (c, -s, 0.0, s, c, 0.0, 0.0, 0.0, 1.0)
    common = {"near": 0.2, "skew": 0.2, "middle": (size[0] / 2 + 0.3, size[1] / 2 - 0.4)}
    return Pinhole(turned, (0.1, -0.2, -4.0), (1.1 * size[0], 1.2 * size[0]), size=size, **common | changes)


def straight(size=(16, 16), **changes):
    """A camera at z = -4 that looks along z: a world unit at the origin is 10 pixels."""
    eye = (1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0)
    middle = (size[0] / 2, size[1] / 2)
    return Pinhole(eye, (0.0, 0.0, -4.0), (40.0, 40.0), middle, size, 0.2, **changes)


def crowd(count=60, nodes=5, degree=2, color_basis=2, opacity_basis=2, dtype=torch.float64, seed=0, scale=-2):
    """Random particles, how they move, and what a time makes of colour and opacity."""
    generator = torch.Generator().manual_seed(seed)

    def random(*shape):
        return torch.randn(*shape, generator=generator, dtype=torch.float64).to(dtype)

    means, log_scales = 0.5 * random(count, 3), scale + 0.5 * random(count, 3)
    quaternions, opacity = random(count, 4), random(count, opacity_basis)
    colors = 0.3 * random(count, (degree + 1) ** 2 + color_basis, 3)
    particles = Gaussians(means, log_scales, quaternions, opacity, colors)
    links = torch.randint(0, nodes, (count, 4), generator=generator).int()
    shares = torch.rand(count, 4, generator=generator, dtype=torch.float64).to(dtype)
    warp = Warp(0.1 * random(nodes, 12), links, shares / shares.sum(-1, keepdim=True))
    weights = torch.cat([torch.ones(1, dtype=dtype), 0.3 * random(opacity_basis - 1)])
    return particles, warp, random(color_basis), weights


def one(mean=(0.0, 0.0, 0.0), scale=0.1, opacity=0.0, color=(0.0, 0.0, 0.0), quaternion=(1.0, 0.0, 0.0, 0.0)):
    """A single particle that nothing moves, float32; ``opacity`` is a logit, ``color`` is added to 1/2."""
    scales = torch.as_tensor(scale, dtype=torch.float32).expand(3).log()[None].clone()
    numbers = ([mean], [quaternion], [[opacity]], [[color]])
    means, quaternions, logits, added = (torch.tensor(n, dtype=torch.float32) for n in numbers)
    return Gaussians(means, scales, quaternions, logits, added / 0.28209479177387814)


def together(*parts):
    """Particles of several groups."""
    return Gaussians(*(torch.cat(columns) for columns in zip(*parts)))


def still(particles):
    """A warp under which nothing moves."""
    count = len(particles.means)
    none = torch.zeros(count, 1)
    return Warp(torch.zeros(1, 12), none.int(), none)


NO_TINTS, NO_FADES = torch.zeros(0), torch.ones(1)
