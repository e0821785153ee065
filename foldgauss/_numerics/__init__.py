"""Numerics that are independent of any model.

`batch` aligns, broadcasts and checks modules with batch dimensions; `factor` and `triangular` compute Cholesky factors
and triangular solves; `regression.weighted_regression` fits polynomials; `abstract` is the interface of distributions;
`simd` has vectors for Numba kernels.
"""
