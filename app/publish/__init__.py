"""Gives the results of a run to other programs while it goes on."""
