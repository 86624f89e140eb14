"""What every room stands on: frames, settings, errors, compiled loops, files and processes."""
