"""Formats of other programs: PLY of VeGaS and 3DGS, meshes."""
