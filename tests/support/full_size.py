"""How large a method of grids is once they have grown."""

import math

from forewarp.methods.method import parameter_count
from forewarp.scene.box import Lattice


def at_full_size(made, num_voxels):
    """How many parameters NDVG or TiNeuVox has with about so many voxels."""
    marched = made.marching_lattice(num_voxels)
    if hasattr(made, "canonical"):
        grids = [(made.canonical, Lattice.of_count(made.box, num_voxels)), (made.deformation, marched)]
    else:
        grids = [(made.grid, marched)]
    count = parameter_count(made)
    for grid, lattice in grids:
        channels = sum(parameter.shape[1] for parameter in grid.parameters())
        count += channels * math.prod(lattice.shape) - parameter_count(grid)
    return count
