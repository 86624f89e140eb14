"""The cameras that OpenNI2 finds, each started for a moment to see what it can do."""

from dataclasses import dataclass, replace

from nurbseg.common.errors import DriverError
from nurbseg.drivers.openni2.capi import Sensor
from nurbseg.drivers.openni2.library import DeviceListing, in_use
from nurbseg.drivers.openni2.opened import OpenedDevice, family_of, is_camera, usb_port
from nurbseg.drivers.openni2.stream import VideoMode, wait_for_any
from nurbseg.drivers.openni2.usb import Speed, UsbDevice, read_usb

#: How long a camera may take to send its first image, seconds.
_FIRST_IMAGE_LIMIT_S = 5.0


@dataclass(frozen=True, slots=True)
class Camera:
    """A camera as it describes itself.

    `family` is its key in `nurbseg.drivers.openni2.usb_ids.FAMILIES`, `uri` is OpenNI2's, and `usb_id` is
    ``vendor:product``. The modes are those that its streams can be set to. `registration` and `sync` are
    whether it can register depth to color, and take both at the same moment. `error` is why it cannot be
    used, and `doubts` what may keep it from working well. What is not known is empty.
    """

    name: str
    family: str
    uri: str
    usb_id: str
    usb_port: str = ""
    usb_speed: Speed = ""
    serial: str = ""
    driver_version: str = ""
    openni2_version: str = ""
    depth_modes: tuple[VideoMode, ...] = ()
    color_modes: tuple[VideoMode, ...] = ()
    registration: bool = False
    sync: bool = False
    error: str = ""
    doubts: tuple[str, ...] = ()


def list_cameras() -> tuple[Camera, ...]:
    """Ask OpenNI2 for its cameras and each camera for what it can do.

    Raises BackendMissingError if OpenNI2 is not installed.
    """
    usb_devices = {device.port: device for device in read_usb()}
    with in_use() as library:
        return tuple(_camera(listing, usb_devices) for listing in library.devices() if is_camera(listing))


def _camera(listing: DeviceListing, usb_devices: dict[str, UsbDevice]) -> Camera:
    port = usb_port(listing.uri)
    usb_device = usb_devices.get(port)
    camera = Camera(
        name=f"{listing.vendor} {listing.name}".strip(),
        family=family_of(listing),
        uri=listing.uri,
        usb_id=f"{listing.usb_vendor:04x}:{listing.usb_product:04x}",
        usb_port=port if port != listing.uri else "",
        usb_speed=usb_device.speed if usb_device else "",
        serial=usb_device.serial if usb_device else "",
    )
    sensors = Sensor.DEPTH, Sensor.COLOR
    try:
        with OpenedDevice(listing.uri) as device:
            streams = {sensor: device.add_stream(sensor) for sensor in sensors if device.has(sensor)}
            modes = [streams[sensor].modes if sensor in streams else () for sensor in sensors]
            camera = replace(
                camera,
                serial=device.serial or camera.serial,
                driver_version=device.driver_version,
                openni2_version=device.library.version(),
                depth_modes=modes[0],
                color_modes=modes[1],
                registration=device.can_register,
            )
            if missing := [sensor.name.lower() for sensor in sensors if sensor not in streams]:
                raise DriverError(f"it has no {' and no '.join(missing)} stream")
            for stream in streams.values():
                stream.start()
            # Only a running camera knows whether it can.
            camera = replace(camera, sync=device.synchronize())
            if wait_for_any(device.library, device.streams, _FIRST_IMAGE_LIMIT_S) is None:
                raise DriverError(f"it opens, but no image arrived within {_FIRST_IMAGE_LIMIT_S:g} s")
    except DriverError as err:
        return replace(camera, error=str(err))
    return camera
