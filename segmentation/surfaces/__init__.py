"""Surfaces, their fits and their metrics (eq. 4-22)."""
