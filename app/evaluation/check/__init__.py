"""Holds what was exported against what it says of itself."""
