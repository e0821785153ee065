"""Rendering of Gaussian splats: `render` composites `Splats2D` to an image, differentiably, with a choice of engines.

`Camera` and `project` turn `Gaussians3D` into splats, and `solve_colors` fits colors by least squares. `cpu` is the
NumPy interface to the CPU engine. Nothing here depends on time or video.
"""

from foldgauss.render.api import COMPOSITINGS, ENGINES, render
from foldgauss.render.camera import Camera, Gaussians3D, project
from foldgauss.render.colors import solve_colors
from foldgauss.render.splats import RenderOptions, Splats2D, pixels_per_unit

__all__ = [
    "COMPOSITINGS",
    "ENGINES",
    "Camera",
    "Gaussians3D",
    "RenderOptions",
    "Splats2D",
    "pixels_per_unit",
    "project",
    "render",
    "solve_colors",
]
