"""The tree that is continued from frame to frame."""
