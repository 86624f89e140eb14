"""Recordings by OpenNI2."""
