"""Point maps of frames, grids of their points, rays and normals."""
