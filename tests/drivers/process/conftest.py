from virtual_camera import openni2_redist, virtual_cameras

__all__ = ["openni2_redist", "virtual_cameras"]
