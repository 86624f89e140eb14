"""3-D models of a frame as files: meshes, and NURBS for CAD programs."""
