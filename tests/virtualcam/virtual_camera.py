"""A camera for tests: a real OpenNI2 driver, built here, told what to do by a file.

Import the fixtures where they are wanted (``from virtual_camera import openni2_redist, virtual_cameras``).
`virtual_cameras` also sets the environment, which programs started by a test inherit.
"""

import shutil
import subprocess
from pathlib import Path

import numpy as np
import pytest

HERE = Path(__file__).parent
HEADERS = Path("/usr/include/openni2")
#: How far to the side the pattern of registered depth is taken; as in pixels.h.
REGISTRATION_SHIFT = 5
DEBIAN_PACKAGES = "libopenni2-0 libopenni2-dev g++"


class CannotBuildError(Exception):
    """Something that the driver is built from is not installed."""


def build(folder):
    """Build the driver, and return a folder that OPENNI2_REDIST may name: links to Debian's library."""
    library = next(Path("/usr/lib").glob("*/libOpenNI2.so.0"), None)
    compiler = shutil.which("g++")
    if library is None or compiler is None or not (HEADERS / "Driver/OniDriverAPI.h").is_file():
        raise CannotBuildError(
            f"the virtual camera is built from Debian's {DEBIAN_PACKAGES}: apt install them"
        )
    drivers = folder / "OpenNI2" / "Drivers"
    drivers.mkdir(parents=True)
    (folder / library.name).symlink_to(library)
    (drivers / "libOniFile.so.0").symlink_to(library.parent / "OpenNI2/Drivers/libOniFile.so.0")
    command = [compiler, "-std=c++17", "-O2", "-fPIC", "-shared", "-pthread", f"-I{HEADERS}"]
    target = drivers / "libVirtualCam.so.0"
    subprocess.run([*command, str(HERE / "driver.cpp"), "-o", str(target)], check=True, timeout=120)
    return folder


class VirtualCamera:
    """One camera; each keyword is a line of its script (the keys are where driver.cpp and stream.h ask)."""

    def __init__(self, path, **script):
        self.path = path
        self.script = {}
        self.set(plugged=1, **script)

    def set(self, **script):
        """Change the script; takes effect within a few milliseconds."""
        self.script.update(script)
        lines = "".join(f"{key} {value}\n" for key, value in self.script.items())
        partial = self.path.with_suffix(".part")
        partial.write_text(lines)
        partial.replace(self.path)

    @property
    def uri(self):
        return self.script.get("uri", f"virtual/{self.path.stem}")

    def unplug(self):
        self.set(plugged=0)

    def plug(self):
        self.set(plugged=1)


class VirtualCameras:
    """The cameras of one computer."""

    def __init__(self, redist, folder):
        self.redist = redist
        self.folder = folder
        self.environment = {"OPENNI2_REDIST": str(redist), "NURBSEG_VIRTUALCAM": str(folder)}

    def add(self, name="one", /, **script):
        return VirtualCamera(self.folder / f"{name}.cam", **script)


@pytest.fixture(scope="session")
def openni2_redist(tmp_path_factory):
    try:
        return build(tmp_path_factory.mktemp("redist"))
    except CannotBuildError as err:
        pytest.skip(str(err))


@pytest.fixture
def virtual_cameras(openni2_redist, tmp_path, monkeypatch):
    folder = tmp_path / "cameras"
    folder.mkdir()
    cameras = VirtualCameras(openni2_redist, folder)
    for name, value in cameras.environment.items():
        monkeypatch.setenv(name, value)
    return cameras


def depth_image(frame, width=640, height=480, registered=True, mirrored=False):
    """The depth in millimeters that the camera shows in its n-th frame."""
    row, col = np.mgrid[:height, :width]
    col = col[:, ::-1] if mirrored else col
    col = col + REGISTRATION_SHIFT if registered else col
    return (500 + (row * 7 + col * 3 + frame * 11) % 4000).astype(np.uint16)


def color_image(frame, width=640, height=480, mirrored=False):
    """The color that the camera shows in its n-th frame."""
    row, col = np.mgrid[:height, :width]
    col = col[:, ::-1] if mirrored else col
    image = np.stack([row + frame, col + 2 * frame, row * 3 + col * 5 + frame * 7], axis=-1)
    return (image & 255).astype(np.uint8)


def frame_number(frame, fps=30):
    """Which of the camera's frames this is, by the camera's time."""
    return round(frame.timestamp_ns * 1e-9 * fps)


def dump_frames(source, folder, count):
    """Write frames of a source for a camera to play (its key "frames"); depth and color must be VGA."""
    folder.mkdir(parents=True, exist_ok=True)
    for number in range(count):
        frame = source.read()
        (folder / f"depth_{number:04d}.raw").write_bytes(np.ascontiguousarray(frame.depth_mm).tobytes())
        (folder / f"color_{number:04d}.raw").write_bytes(np.ascontiguousarray(frame.color).tobytes())


def open_descriptors():
    return len(list(Path("/proc/self/fd").iterdir()))


def native_threads():
    return len(list(Path("/proc/self/task").iterdir()))
