"""Segments many recordings, each frame independently."""
