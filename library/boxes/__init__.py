"""Boxes around objects, upright on what these stand on."""
