"""Posterior of frame times: the prior, and two ways to compute it.

`log_prob` holds the prior of ordered times and the density; `exact` runs the forward-backward algorithm on grids, and
`sampling` emcee, with convergence checks and draws in files from which it resumes.
"""
