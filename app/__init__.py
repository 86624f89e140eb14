"""Wires, threads and shows: the commands."""
