"""Decodes the images of a recording."""
