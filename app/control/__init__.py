"""What the ways of controlling a run share: the list of its commands, and its state."""
