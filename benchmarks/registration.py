"""Times the registration of a depth image to its color image, with a plain ``cv2.remap`` beside it.

Run it in the project's folder: ``python benchmarks/registration.py``. The ratio to the remap, which any
registration needs to sample colors, says more than milliseconds on a busy machine.
"""

from __future__ import annotations

import argparse
import platform
from collections.abc import Callable
from statistics import median
from time import perf_counter

import cv2
import numpy as np
from rendered import SyntheticOptions, SyntheticSource

from nurbseg.common.computer import computer
from nurbseg.segmentation.points.registration import Registration

CASES = {
    "VGA, registered already": SyntheticOptions(frames=1),
    "VGA, two bent lenses": SyntheticOptions(frames=1, offset=True, distortion=True),
    "VGA, two straight lenses": SyntheticOptions(frames=1, offset=True),
    "QVGA, two bent lenses": SyntheticOptions(frames=1, offset=True, distortion=True, width=320, height=240),
    "VGA with SXGA color": SyntheticOptions(
        frames=1, offset=True, distortion=True, color_width=1280, color_height=1024
    ),
}


def milliseconds(call: Callable[[], object], runs: int) -> float:
    """Return the median time of a call after one that is not counted."""
    call()
    times = []
    for _ in range(runs):
        start = perf_counter()
        call()
        times.append(perf_counter() - start)
    return 1000 * median(times)


def main() -> None:
    """Print one line for each case."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--runs", type=int, default=60, help="calls that are timed in each case")
    runs = parser.parse_args().runs
    print(computer())
    print(f"Python {platform.python_version()}, numpy {np.__version__}, OpenCV {cv2.__version__}")
    print(f"{'case':<28}{'register':>12}{'remap':>12}{'ratio':>8}{'first call':>14}")
    for name, options in CASES.items():
        with SyntheticSource(options) as source:
            frame = source.read()
        registration = Registration()
        start = perf_counter()
        registration.register(frame)
        first = 1000 * (perf_counter() - start)
        height, width = frame.depth_mm.shape
        v, u = np.mgrid[:height, :width].astype(np.float32)
        u += np.sin(v)
        taken = milliseconds(lambda frame=frame, register=registration.register: register(frame), runs)  # type: ignore[misc]
        remap = milliseconds(
            lambda frame=frame, u=u, v=v: cv2.remap(frame.color, u, v, cv2.INTER_LINEAR),  # type: ignore[misc]
            runs,
        )
        print(f"{name:<28}{taken:>9.2f} ms{remap:>9.2f} ms{taken / remap:>8.1f}{first:>11.1f} ms")


if __name__ == "__main__":
    main()
