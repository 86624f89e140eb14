"""Calibration files, and the model of lens distortion."""
