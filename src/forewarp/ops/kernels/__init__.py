"""Numba kernels behind the operators, for the CPU, and the vectors of float32 that they compute with."""
