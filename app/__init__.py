"""The commands: configuration, runs, view, export and evaluation."""
