"""Expectation maximization of Folded-Gaussian mixtures on arrays.

`loop.run_em` iterates; `statistics.accumulate` is the E-step, `m_step.update_components` the M-step. `initialization`
makes the initial parameters, `prune` removes components and powers.
"""
