"""Model-independent numerics: batch shapes, triangular factors, safe gradients, regression, SIMD types."""
