"""Folders and files of other people's data sets."""
