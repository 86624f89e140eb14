"""Two geometric methods of the Point Cloud Library, in a small program that is built on first use.

Needs Debian's libpcl-dev, cmake and a C++ compiler.
"""

import hashlib
import os
import shutil
import subprocess
import tempfile
from collections.abc import Sequence
from functools import cache
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from nurbseg.common.errors import BackendMissingError
from nurbseg.common.kept_code import UnusableFolderError, code_folder, user_cache
from nurbseg.common.process.child import environment
from nurbseg.segmentation.points.registration import PointMap

_BUILD_TIMEOUT_S = 900.0
_RUN_TIMEOUT_S = 120.0
_SOURCES = Path(__file__).with_name("pcl_program")


@cache
def program() -> Path:
    """Return the program, and build it if necessary.

    Raises BackendMissingError, which says what to install, if PCL, cmake or a compiler is missing, or the
    build fails.
    """
    needed = "install them: apt-get install libpcl-dev cmake g++"
    searched = environment().get("PATH", os.defpath)
    if shutil.which("cmake", path=searched) is None or shutil.which("c++", path=searched) is None:
        raise BackendMissingError(f"lccp, pcl-organized: cmake and a C++ compiler are needed; {needed}")
    content = b"".join(path.read_bytes() for path in sorted(_SOURCES.iterdir()))
    digest = hashlib.sha256(content).hexdigest()[:16]
    try:
        folder = code_folder(user_cache(), "nurbseg", f"pcl-{digest}")
    except UnusableFolderError as err:
        raise BackendMissingError(f"lccp, pcl-organized: the program cannot be kept: {err}") from err
    built = folder / "pcl_rivals"
    if built.exists():
        return built
    with tempfile.TemporaryDirectory(dir=folder.parent) as work:
        configure = ["cmake", "-S", _SOURCES, "-B", work, "-DCMAKE_BUILD_TYPE=Release"]
        for command in (configure, ["cmake", "--build", work]):
            try:
                done = _run(command, _BUILD_TIMEOUT_S)
            except subprocess.TimeoutExpired as err:
                raise BackendMissingError(
                    f"lccp, pcl-organized: the build took over {err.timeout:.0f} s"
                ) from err
            if done.returncode != 0:
                reason = (done.stderr or done.stdout).strip().splitlines()
                raise BackendMissingError(
                    f"lccp, pcl-organized: cannot build against PCL ({' '.join(reason[:1])}); {needed}"
                )
        (Path(work) / "pcl_rivals").replace(built)
    return built


def _run(command: Sequence[object], timeout_s: float) -> subprocess.CompletedProcess[str]:
    # The program is found by PATH of the environment that it gets.
    return subprocess.run(
        [*map(str, command)], env=environment(), capture_output=True, text=True, timeout=timeout_s
    )


def _labels(method: str, cloud: PointMap) -> NDArray[np.uint16]:
    height, width = cloud.valid.shape
    with tempfile.TemporaryDirectory() as name:
        points, colors, labels = (Path(name) / each for each in ("points.f32", "colors.u8", "labels.u16"))
        cloud.points_m.tofile(points)
        cloud.color.tofile(colors)
        try:
            done = _run([program(), method, width, height, points, colors, labels], _RUN_TIMEOUT_S)
        except subprocess.TimeoutExpired as err:
            raise RuntimeError(f"{method}: a frame took over {err.timeout:g} s") from err
        if done.returncode != 0:
            raise RuntimeError(f"{method}: exit code {done.returncode}: {done.stderr.strip()}")
        return np.fromfile(labels, np.uint16).reshape(height, width)


def lccp(cloud: PointMap, rng: np.random.Generator) -> NDArray[np.integer]:
    """Locally convex connected patches [1]_ over supervoxels, by PCL.

    References
    ----------
    .. [1] S. Stein et al., "Object partitioning using local convexity", CVPR 2014.
    """
    return _labels("lccp", cloud)


def organized(cloud: PointMap, rng: np.random.Generator) -> NDArray[np.integer]:
    """Planes of the organized cloud, then Euclidean clusters of the remaining points, by PCL [1]_.

    References
    ----------
    .. [1] A. Trevor et al., "Efficient organized point cloud segmentation with connected components",
       SPME 2013.
    """
    return _labels("organized", cloud)
