"""A frame becomes a map of points."""
