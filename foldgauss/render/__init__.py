"""Pixels from two-dimensional splats: one door, `render`, and the engines behind it."""

from foldgauss.render.colors import solve_colors
from foldgauss.render.door import ENGINES, render
from foldgauss.render.splats import RenderOptions, Splats2D, pixels_per_unit

__all__ = ["ENGINES", "RenderOptions", "Splats2D", "pixels_per_unit", "render", "solve_colors"]
