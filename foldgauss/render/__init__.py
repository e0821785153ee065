"""Pixels from Gaussians: one door, `render`, the engines behind it, and cameras in front of it."""

from foldgauss.render.api import COMPOSITINGS, ENGINES, render
from foldgauss.render.camera import Camera, Gaussians3D, project
from foldgauss.render.colors import solve_colors
from foldgauss.render.splats import RenderOptions, Splats2D, pixels_per_unit
from foldgauss.render.triangle import Triangles

__all__ = [
    "COMPOSITINGS",
    "ENGINES",
    "Camera",
    "Gaussians3D",
    "RenderOptions",
    "Splats2D",
    "Triangles",
    "pixels_per_unit",
    "project",
    "render",
    "solve_colors",
]
