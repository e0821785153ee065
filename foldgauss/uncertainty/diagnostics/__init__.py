"""Irregular frames, calibration, plots and reports of a posterior."""
