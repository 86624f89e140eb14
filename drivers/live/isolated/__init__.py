"""A camera that is read by a process of its own."""
