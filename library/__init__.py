"""What programs get: a segmenter, results, measured objects, boxes and meshes."""
