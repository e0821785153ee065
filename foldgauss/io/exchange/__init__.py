"""Formats of other programs.

`vegas_ply` reads and writes videos of the published VeGaS code, `gaussians_ply` static 3DGS scenes, and `pseudomesh`
frames as triangles for mesh tools.
"""
