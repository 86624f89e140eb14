"""The commands: configuration, runs, view and export."""
