"""Showing and saving results with Rerun."""
