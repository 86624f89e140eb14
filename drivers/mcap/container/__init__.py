"""MCAP files: their chunks, messages and order, and the bags that are made of several."""
