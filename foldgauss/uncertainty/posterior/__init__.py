"""Posterior of the frame times: exact passes, the Laplace approximation and emcee."""
