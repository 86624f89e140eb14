"""A Kinect v1 by its real driver: libfreenect plays images from files (fakenect), OpenNI2 sees a camera.

Import `kinect` where it is wanted. It needs Debian's libfreenect0.5 and libusb-1.0-0-dev, and the source of
libfreenect, of which Debian builds no driver for OpenNI2.
"""

import os
import shutil
import subprocess
from pathlib import Path

import numpy as np
import pytest
from virtual_camera import openni2_redist

__all__ = ["kinect", "kinect_driver", "openni2_redist"]

HERE = Path(__file__).parent
#: Names a folder with the source, unpacked, and perhaps Debian's package, too.
VARIABLE = "NURBSEG_LIBFREENECT"
FRAMES = 60
#: The driver states the Kinect's ticks of 60 MHz as microseconds.
TICKS_PER_S = 60e6


@pytest.fixture(scope="session")
def kinect_driver(openni2_redist, tmp_path_factory):
    """Build the driver; return what the environment must have."""
    given = os.environ.get(VARIABLE)
    roots = [Path("/usr/lib"), *([Path(given)] if given else [])]
    libraries = [path for root in roots for path in root.rglob("fakenect/libfreenect.so.0.5")]
    source = next(Path(given).rglob("OpenNI2-FreenectDriver"), None) if given else None
    usb = Path("/usr/include/libusb-1.0/libusb.h")
    if not libraries or source is None or not usb.is_file() or shutil.which("g++") is None:
        pytest.skip(
            "a Kinect is played by Debian's libfreenect0.5 (apt install libfreenect0.5 libusb-1.0-0-dev) and "
            f"its source (apt source libfreenect; {VARIABLE} names the folder that it is unpacked in)"
        )
    root, fakenect = source.parent, libraries[0].parent
    redist = tmp_path_factory.mktemp("kinect")
    shutil.copytree(openni2_redist, redist, symlinks=True, dirs_exist_ok=True)
    drivers = redist / "OpenNI2" / "Drivers"
    (drivers / "libVirtualCam.so.0").unlink()
    headers = (
        "include",
        "src",
        "wrappers/cpp",
        "OpenNI2-FreenectDriver/extern/OpenNI-Linux-x64-2.2.0.33/Include",
    )
    include = [f"-I{root / header}" for header in headers] + [f"-I{usb.parent}"]
    common = ["-O1", "-w", "-fPIC", "-shared", *include]
    command = [
        "g++",
        "-fpermissive",
        '-DPROJECT_VER="0.5.3"',
        *common,
        *map(str, (source / "src").glob("*.cpp")),
    ]
    library = [f"-L{fakenect}", "-l:libfreenect.so.0.5", "-o", str(drivers / "libFreenectDriver.so.0")]
    subprocess.run([*command, *library], check=True, timeout=240)
    shim = redist / "shim.so"
    subprocess.run(
        ["g++", "-xc", *common, str(HERE / "fakenect_shim.c"), "-o", str(shim)], check=True, timeout=60
    )
    return {"OPENNI2_REDIST": str(redist), "LD_LIBRARY_PATH": str(fakenect), "LD_PRELOAD": str(shim)}


@pytest.fixture
def kinect(kinect_driver, tmp_path, monkeypatch):
    """Plug one in that plays `FRAMES` frames, and then fails as when it is unplugged."""
    folder = tmp_path / "kinect"
    folder.mkdir()
    names = []
    for number in range(FRAMES):
        ticks, time_s = int(number / 30 * TICKS_PER_S) & 0xFFFFFFFF, 1000 + number / 30
        for kind, head, image, late in (
            ("d", b"P5 640 480 65535\n", depth_image(number), 0),
            ("r", b"P6 640 480 255 \n", color_image(number), 1),
        ):
            name = (
                f"{kind}-{time_s + 0.005 * late:.6f}-{ticks + 1000 * late}.{'pgm' if kind == 'd' else 'ppm'}"
            )
            (folder / name).write_bytes(head + image.tobytes())
            names.append(name)
    (folder / "INDEX.txt").write_text("\n".join(names) + "\n")
    for name, value in {**kinect_driver, "FAKENECT_PATH": str(folder)}.items():
        monkeypatch.setenv(name, value)


def depth_image(number):
    """The depth, mm, of a frame: its number is in every pixel."""
    v, u = np.mgrid[:480, :640]
    return (800 + u // 4 + v // 4 + number).astype("<u2")


def color_image(number):
    v, u = np.mgrid[:480, :640]
    return np.stack([u // 3, v // 2, np.full_like(u, number)], axis=-1).astype(np.uint8)
