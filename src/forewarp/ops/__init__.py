"""Pure functions on tensors; ``kernels`` has their Numba versions for the CPU."""
