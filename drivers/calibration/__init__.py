"""Calibration files, and the lens model."""
