import numpy as np
import pytest
from virtual_camera import openni2_redist, virtual_cameras

__all__ = ["openni2_redist", "rng", "virtual_cameras"]


@pytest.fixture
def rng():
    return np.random.default_rng(0)
