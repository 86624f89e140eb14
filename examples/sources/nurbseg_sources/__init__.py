"""Sources of frames for nurbseg."""
