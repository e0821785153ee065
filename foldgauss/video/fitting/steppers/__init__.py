"""Optimisation steps: on the CPU by Numba kernels, or compiled by JAX for a device."""
