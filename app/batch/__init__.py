"""Many recordings, segmented one after the other and each frame for itself."""
