"""Pure functions on tensors; ``kernels_*`` are their Numba versions for the CPU."""
