"""Likelihood of frame times, from residuals between video frames and images that the model renders.

Given the splats, the likelihood of each frame depends on its own time only: `likelihood_profiles` computes these
curves, `noise` the estimate of correlated residual noise. `refit` refits all
splats.
"""
