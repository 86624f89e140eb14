"""The live loop: from a source to a frame's result."""
