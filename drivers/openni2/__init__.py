"""Depth cameras and .oni recordings through OpenNI2."""
