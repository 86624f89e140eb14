"""Scores against a ground truth."""
