"""The served page: the viewer, and below it a bar with the commands of the run."""
