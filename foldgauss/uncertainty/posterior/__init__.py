"""Posterior of frame times: the prior, and two ways to compute it.

`increments` holds the prior of ordered times; `exact` runs the forward-backward algorithm on grids, and `sampling`
emcee, with convergence checks and draws in files from which it resumes.
"""
