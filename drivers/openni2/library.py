"""Finds, loads and initializes the OpenNI2 library, and turns its status codes into our errors."""

import ctypes
import os
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from nurbseg.common.closing import closed_on_error
from nurbseg.common.errors import BackendMissingError, DeviceNotFoundError, DriverError
from nurbseg.drivers.openni2 import capi

#: Name of the library file; the one without the number comes only with the development package.
LIBRARY_FILE = "libOpenNI2.so.0"
#: Environment variable that names the folder of the library and its drivers.
REDIST_VARIABLE = "OPENNI2_REDIST"

_INSTALL_HINT = (
    "install Debian's and Ubuntu's package libopenni2-0 (apt install libopenni2-0), "
    f"or set {REDIST_VARIABLE} to the folder that holds {LIBRARY_FILE}"
)


@dataclass(frozen=True, slots=True)
class DeviceListing:
    """A device as the library lists it, before it is opened; the USB ids are 0 for one that is not on USB."""

    uri: str
    vendor: str
    name: str
    usb_vendor: int
    usb_product: int


def find_library() -> str:
    """Return what to load: the library in `OPENNI2_REDIST`'s folder, else the system's.

    Raises BackendMissingError if the folder named by `OPENNI2_REDIST` does not hold the library.
    """
    folder = os.environ.get(REDIST_VARIABLE)
    if not folder:
        return LIBRARY_FILE
    path = Path(folder) / LIBRARY_FILE
    if not path.is_file():
        raise BackendMissingError(
            f"{REDIST_VARIABLE}={folder}: no {LIBRARY_FILE} in this folder; correct or unset it"
        )
    return str(path.absolute())


class Library:
    """The native library, initialized for as long as anybody uses it.

    Use `in_use`, which counts the users; the last one to go shuts it down, so that the next one finds the
    cameras that are there by then (some drivers look only once).

    Each of the `listeners` is a device's URI and a function that is called with each state that it reports,
    `capi.DeviceState.ERROR` when it is disconnected. It runs on one of the library's threads, so it must be
    quick and must not wait.
    """

    def __init__(self, path: str) -> None:
        try:
            self.native = ctypes.CDLL(path)
            capi.declare(self.native)
        except OSError as err:
            raise BackendMissingError(f"OpenNI2 cannot be loaded ({err}); {_INSTALL_HINT}") from err
        except AttributeError as err:
            raise BackendMissingError(f"{path} is not OpenNI2 2.2 ({err}); {_INSTALL_HINT}") from err
        self.path = path
        self._users = 0
        self._handle = ctypes.c_void_p()
        self.listeners: list[tuple[str, Callable[[int], None]]] = []
        # The library calls these from its own threads for as long as it is initialized, and would not
        # keep them alive.
        self._callbacks = capi.OniDeviceCallbacks(
            capi.DeviceCallback(),
            capi.DeviceCallback(lambda device, _: self._notify(device, capi.DeviceState.ERROR)),
            capi.StateCallback(lambda device, state, _: self._notify(device, state)),
        )

    def _notify(self, device: Any, state: int) -> None:
        # Called on the library's threads: it only passes on a state, and takes no lock.
        uri = os.fsdecode(device.contents.uri)
        for watched, listener in tuple(self.listeners):
            if watched == uri:
                listener(state)

    def check(self, status: int, doing: str, error: type[DriverError] = DriverError) -> None:
        """Raise an error if a function did not answer OK; must follow it on the same thread.

        Raises DeviceNotFoundError if the library reports that there is no such device; DriverError or
        `error`; the message holds `doing` and the library's own text.
        """
        if status == capi.Status.OK:
            return
        words = (self.native.oniGetExtendedError() or b"").decode(errors="replace").strip()
        known = status in capi.Status.__members__.values()
        name = capi.Status(status).name.lower().replace("_", " ") if known else f"status {status}"
        message = f"{doing}: OpenNI2 answers {name}" + (f" ({' '.join(words.split())})" if words else "")
        raise (DeviceNotFoundError if status == capi.Status.NO_DEVICE else error)(message)

    def devices(self) -> list[DeviceListing]:
        """Return what is listed now; opened recordings are among it."""
        listed, count = ctypes.POINTER(capi.OniDeviceInfo)(), ctypes.c_int()
        self.check(self.native.oniGetDeviceList(ctypes.byref(listed), ctypes.byref(count)), "listing devices")
        try:
            return [
                DeviceListing(
                    uri=os.fsdecode(each.uri),
                    vendor=each.vendor.decode(errors="replace"),
                    name=each.name.decode(errors="replace"),
                    usb_vendor=each.usb_vendor_id,
                    usb_product=each.usb_product_id,
                )
                for each in listed[: count.value]
            ]
        finally:
            self.native.oniReleaseDeviceList(listed)

    def version(self) -> str:
        """Return the library's version."""
        version = self.native.oniGetVersion()
        return f"{version.major}.{version.minor}.{version.maintenance}.{version.build}"

    def _add_user(self) -> None:
        if self._users == 0:
            with closed_on_error(self.native.oniShutdown):
                status = self.native.oniInitialize(capi.API_VERSION)
                self.check(status, f"initializing OpenNI2 from {self.path}", BackendMissingError)
            self.native.oniRegisterDeviceCallbacks(
                ctypes.byref(self._callbacks), None, ctypes.byref(self._handle)
            )
        self._users += 1

    def _remove_user(self) -> None:
        self._users -= 1
        if self._users == 0:
            if self._handle:
                # Waits for a running callback; Python's other threads run meanwhile.
                self.native.oniUnregisterDeviceCallbacks(self._handle)
                self._handle = ctypes.c_void_p()
            self.native.oniShutdown()


_lock = threading.Lock()
_loaded: dict[str, Library] = {}


@contextmanager
def in_use() -> Iterator[Library]:
    """Keep the library initialized for a while; the last user shuts it down.

    Raises BackendMissingError if it is not installed, or finds no drivers; the message says what to do.
    """
    path = find_library()
    with _lock:
        if path not in _loaded:
            _loaded[path] = Library(path)
        library = _loaded[path]
        library._add_user()
    try:
        yield library
    finally:
        with _lock:
            library._remove_user()
