"""The part of OpenNI2's C interface that is used here: constants, structures and prototypes.

References
----------
.. [1] OpenNI 2.2, ``OniCAPI.h``, ``OniCTypes.h``, ``OniCEnums.h`` and ``OniCProperties.h``.
"""

import ctypes
from ctypes import POINTER, c_char, c_char_p, c_int, c_uint16, c_uint64, c_void_p
from enum import IntEnum

#: The version that `oniInitialize` gets: 2.2, as 1000 x major + minor.
API_VERSION = 2002


class Status(IntEnum):
    """What every function returns."""

    OK = 0
    ERROR = 1
    NOT_IMPLEMENTED = 2
    NOT_SUPPORTED = 3
    BAD_PARAMETER = 4
    OUT_OF_FLOW = 5
    NO_DEVICE = 6
    TIME_OUT = 102


class Sensor(IntEnum):
    """The kinds of stream a device may have."""

    IR = 1
    COLOR = 2
    DEPTH = 3


class PixelFormat(IntEnum):
    """How a stream's pixels are stored."""

    DEPTH_1_MM = 100
    DEPTH_100_UM = 101
    RGB888 = 200
    YUV422 = 201
    GRAY8 = 202
    GRAY16 = 203
    JPEG = 204
    YUYV = 205


#: Of the formats that are read; one pixel, bytes.
BYTES_PER_PIXEL = {
    PixelFormat.DEPTH_1_MM: 2,
    PixelFormat.DEPTH_100_UM: 2,
    PixelFormat.RGB888: 3,
    PixelFormat.YUV422: 2,
    PixelFormat.YUYV: 2,
    PixelFormat.GRAY8: 1,
}


class DeviceState(IntEnum):
    """What a device's state callback reports, as far as it is used here."""

    ERROR = 1
    EOF = 3


class DeviceProperty(IntEnum):
    """Properties of a device that are used here."""

    DRIVER_VERSION = 1
    SERIAL_NUMBER = 3
    IMAGE_REGISTRATION = 5
    PLAYBACK_SPEED = 100
    PLAYBACK_REPEAT_ENABLED = 101


class StreamProperty(IntEnum):
    """Properties of a stream that are used here."""

    CROPPING = 0
    HORIZONTAL_FOV = 1
    VIDEO_MODE = 3
    MIRRORING = 7
    AUTO_WHITE_BALANCE = 100
    AUTO_EXPOSURE = 101
    EXPOSURE = 102
    GAIN = 103


class OniVersion(ctypes.Structure):
    """A version number."""

    _fields_ = [("major", c_int), ("minor", c_int), ("maintenance", c_int), ("build", c_int)]


class OniVideoMode(ctypes.Structure):
    """Pixel format, size in pixels and frames per second of a stream."""

    _fields_ = [("pixel_format", c_int), ("width", c_int), ("height", c_int), ("fps", c_int)]


class OniSensorInfo(ctypes.Structure):
    """The modes of one of a device's sensors."""

    _fields_ = [("sensor", c_int), ("mode_count", c_int), ("modes", POINTER(OniVideoMode))]


class OniDeviceInfo(ctypes.Structure):
    """What is known of a device before it is opened."""

    _fields_ = [
        ("uri", c_char * 256),
        ("vendor", c_char * 256),
        ("name", c_char * 256),
        ("usb_vendor_id", c_uint16),
        ("usb_product_id", c_uint16),
    ]


class OniFrame(ctypes.Structure):
    """An image as the library hands it out; `timestamp` is in microseconds, `stride` in bytes."""

    _fields_ = [
        ("data_size", c_int),
        ("data", c_void_p),
        ("sensor", c_int),
        ("timestamp", c_uint64),
        ("frame_index", c_int),
        ("width", c_int),
        ("height", c_int),
        ("mode", OniVideoMode),
        ("cropping_enabled", c_int),
        ("crop_x", c_int),
        ("crop_y", c_int),
        ("stride", c_int),
    ]


class OniCropping(ctypes.Structure):
    """The part of the image that a stream delivers."""

    _fields_ = [("enabled", c_int), ("x", c_int), ("y", c_int), ("width", c_int), ("height", c_int)]


#: void f(const OniDeviceInfo*, void* cookie)
DeviceCallback = ctypes.CFUNCTYPE(None, POINTER(OniDeviceInfo), c_void_p)
#: void f(const OniDeviceInfo*, OniDeviceState, void* cookie)
StateCallback = ctypes.CFUNCTYPE(None, POINTER(OniDeviceInfo), c_int, c_void_p)


class OniDeviceCallbacks(ctypes.Structure):
    """Functions that the library calls when devices come, go or change."""

    _fields_ = [
        ("connected", DeviceCallback),
        ("disconnected", DeviceCallback),
        ("state_changed", StateCallback),
    ]


#: name -> (result, argument types); handles are pointers that nobody here looks into.
PROTOTYPES: dict[str, tuple[object, list[object]]] = {
    "oniInitialize": (c_int, [c_int]),
    "oniShutdown": (None, []),
    "oniGetVersion": (OniVersion, []),
    "oniGetExtendedError": (c_char_p, []),
    "oniGetDeviceList": (c_int, [POINTER(POINTER(OniDeviceInfo)), POINTER(c_int)]),
    "oniReleaseDeviceList": (c_int, [POINTER(OniDeviceInfo)]),
    "oniRegisterDeviceCallbacks": (c_int, [POINTER(OniDeviceCallbacks), c_void_p, POINTER(c_void_p)]),
    "oniUnregisterDeviceCallbacks": (None, [c_void_p]),
    "oniWaitForAnyStream": (c_int, [POINTER(c_void_p), c_int, POINTER(c_int), c_int]),
    "oniDeviceOpen": (c_int, [c_char_p, POINTER(c_void_p)]),
    "oniDeviceClose": (c_int, [c_void_p]),
    "oniDeviceGetSensorInfo": (POINTER(OniSensorInfo), [c_void_p, c_int]),
    "oniDeviceCreateStream": (c_int, [c_void_p, c_int, POINTER(c_void_p)]),
    "oniDeviceEnableDepthColorSync": (c_int, [c_void_p]),
    "oniDeviceGetDepthColorSyncEnabled": (c_int, [c_void_p]),
    "oniDeviceSetProperty": (c_int, [c_void_p, c_int, c_void_p, c_int]),
    "oniDeviceGetProperty": (c_int, [c_void_p, c_int, c_void_p, POINTER(c_int)]),
    "oniDeviceIsImageRegistrationModeSupported": (c_int, [c_void_p, c_int]),
    "oniStreamDestroy": (None, [c_void_p]),
    "oniStreamStart": (c_int, [c_void_p]),
    "oniStreamStop": (None, [c_void_p]),
    "oniStreamReadFrame": (c_int, [c_void_p, POINTER(POINTER(OniFrame))]),
    "oniStreamSetProperty": (c_int, [c_void_p, c_int, c_void_p, c_int]),
    "oniStreamGetProperty": (c_int, [c_void_p, c_int, c_void_p, POINTER(c_int)]),
    "oniFrameRelease": (None, [POINTER(OniFrame)]),
}


def declare(library: ctypes.CDLL) -> None:
    """Give the library's functions their types; raises AttributeError if the library lacks a function."""
    for name, (result, arguments) in PROTOTYPES.items():
        function = getattr(library, name)
        function.restype = result
        function.argtypes = arguments
