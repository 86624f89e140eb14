"""RealSense cameras through their own SDK, pyrealsense2: ``pip install 'nurbseg[realsense]'``."""
