"""Posterior of frame times: parametrization and prior, and three ways to compute it.

`increments` maps ordered times to unconstrained coordinates; `exact` runs the forward-backward algorithm on grids,
`laplace` a Gaussian approximation, and `sampling` emcee with convergence checks and resumable files of draws.
"""
