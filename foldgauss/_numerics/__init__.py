"""Numerical helpers that know no model: batch shapes, triangular factors, safe gradients, regression, SIMD types."""
