"""Functionals of distributions: moments, conditional and marginal densities by quadrature, divergences, plots."""
