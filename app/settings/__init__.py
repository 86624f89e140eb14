"""The settings of a run, a file for each section."""
