"""The tree that goes on from frame to frame."""
