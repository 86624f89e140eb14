"""What a frame's result looks like."""
