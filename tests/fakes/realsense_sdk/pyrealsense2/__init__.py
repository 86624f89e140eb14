"""The real SDK, whose context lists software devices: for programs that find this folder first.

What is connected stands in the folder that REALSENSE_FOLDER names, a JSON file for each camera; to remove the
file is to unplug it. Each delivers the images of `realsense_images` at its rate.
"""

import contextlib
import importlib
import json
import os
import sys
import threading
import time
from pathlib import Path

_OWN = Path(__file__).parent
_FAKES = _OWN.parent.parent
sys.modules.pop("pyrealsense2", None)
_PATHS = list(sys.path)
sys.path[:] = [each for each in sys.path if Path(each or ".").resolve() != _OWN.parent.resolve()]
real = importlib.import_module("pyrealsense2")
sys.path[:] = [*_PATHS, str(_FAKES)]

import numpy as np  # noqa: E402
from realsense_images import calibration_of, images  # noqa: E402
from software_realsense import SoftwareCamera  # noqa: E402

_FOLDER = Path(os.environ["REALSENSE_FOLDER"])
_cameras = {}


class _Fed:
    """A camera that delivers images until its file is gone."""

    def __init__(self, path):
        self.path = path
        self.settings = settings = json.loads(path.read_text())
        self.size = settings.get("depth", [640, 480, 30]), settings.get("color", [640, 480, 30])
        self.camera = SoftwareCamera(
            real,
            calibration_of(*self.size),
            stated=settings.get("stated", {}),
            sensors=settings.get("sensors", 2),
            modes=((320, 240),) if settings.get("fault") == "size" else (),
            depth_units_m=settings.get("units_m", 0.001),
            fps=(self.size[0][2], self.size[1][2]),
            accelerometer_from_depth=settings.get("accelerometer_from_depth"),
            infos={
                "name": "Intel RealSense D435",
                "serial_number": settings.get("stated_serial", path.stem),
                "firmware_version": settings.get("firmware", "5.17.0.9"),
                "recommended_firmware_version": "5.17.0.9",
                "usb_type_descriptor": settings.get("usb", "3.2"),
                "physical_port": "2-1",
                "product_id": "0B07",
            },
        )
        self.is_over = False
        #: Both streams have one clock, which begins again as long as one of them is not open.
        self.begun_s = time.monotonic()
        for place, (size, kind) in enumerate(zip(self.size, ("depth", "color"), strict=True)):
            thread = threading.Thread(target=self._feed, args=(place, size, kind), daemon=True)
            thread.start()
        if "accelerations" in settings:
            threading.Thread(target=self._shake, args=(settings["accelerations"],), daemon=True).start()

    def _shake(self, accelerations):
        """Send what the accelerometer shows, m/s^2, in turn."""
        number = 0
        while self.path.exists():
            with contextlib.suppress(RuntimeError):  # nobody has opened it yet
                self.camera.send_acceleration(
                    accelerations[number % len(accelerations)], number, 10.0 * number
                )
            number += 1
            time.sleep(0.005)

    def _feed(self, place, size, kind):
        period_s = 1 / size[2]
        begun_s = self.begun_s
        silent = self.settings.get("silent_after")
        number = 0
        fault, kinds = self.settings.get("fault", ""), self.settings.get("only", [kind])
        while self.path.exists() and (silent is None or number < silent) and kind in kinds:
            if begun_s != self.begun_s:
                begun_s, number = self.begun_s, 0
            # A camera's clock does not wait for a busy computer.
            late = int((time.monotonic() - begun_s) / period_s)
            number = late if late > number + 2 else number
            image, time_ms = images(number, size, kind, skew_ms=self.settings.get("skew_ms", 0))
            time.sleep(max(0.0, begun_s + number * period_s - time.monotonic()))
            sent = number
            if fault and number >= 20:
                time_ms, sent = {
                    "back": (time_ms - 600.0, number),
                    "same": (1000.0 * 20 / size[2], number),
                    "negative": (-time_ms, number),
                    "nan": (float("nan"), number),
                    "infinite": (float("inf"), number),
                    "huge": (1e300, number),
                    "numbers back": (time_ms, 40 - number if number < 40 else number),
                    "numbers huge": (time_ms, number + 2_000_000_000),
                    "empty": (time_ms, number),
                    "size": (time_ms, number),
                }[fault]
            other = None
            if fault == "empty" and number == 20:
                image = np.zeros_like(image)
            elif fault == "size" and 20 <= number < 30:
                # The first of its two.
                image, other = image[::2, ::2], self.camera.others[2 * place]
            try:
                self.camera.send_image(place, image, sent, time_ms, other)
            except RuntimeError:
                # Nobody has opened it yet.
                self.begun_s = time.monotonic()
                time.sleep(0.01)
            number += 1
        self.is_over = not self.path.exists() or self.is_over


class _Changes:
    def __init__(self, serials):
        self._serials = serials

    def was_removed(self, device):
        return device.get_info(real.camera_info.serial_number) in self._serials


class Context:
    """Lists the software devices whose files are there."""

    def query_devices(self):
        there = sorted(_FOLDER.glob("*.json"))
        for path in there:
            # One that came back is another device.
            if path not in _cameras or _cameras[path].is_over:
                _cameras[path] = _Fed(path)
        for path in set(_cameras) - set(there):
            del _cameras[path]
        return [_cameras[path].camera.device for path in there]

    def set_devices_changed_callback(self, callback):
        def watch():
            before = set(_FOLDER.glob("*.json"))
            while True:
                time.sleep(0.02)
                now = set(_FOLDER.glob("*.json"))
                if gone := {each.stem for each in before - now}:
                    callback(_Changes(gone))
                before = now

        threading.Thread(target=watch, daemon=True).start()


real.context = Context
