"""Folders and files in the formats of public data sets."""
