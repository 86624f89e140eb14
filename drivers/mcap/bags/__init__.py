"""Bags of ROS that are no MCAP files, and the motion of the camera that any of them may hold."""
