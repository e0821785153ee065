"""Likelihood of the frame times given the splats, from residuals of rendered frames."""
