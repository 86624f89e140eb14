"""The method: arrays in, values out."""
