"""MCAP recordings with ROS 2 messages."""
