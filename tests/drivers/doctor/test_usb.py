import array
import errno
import os
from types import SimpleNamespace

import pytest
import usb.backend.libusb1
import usb.core
from plugged_usb import ASTRA, KINECT_2, KINECT_CAMERA, MOUSE, XTION, FakeRoot, Plugged

from nurbseg.drivers.openni2.usb import UsbDevice, camera_parts, read_usb, try_to_open
from nurbseg.drivers.openni2.usb_ids import families, identify


@pytest.fixture
def root(tmp_path):
    return FakeRoot(tmp_path)


def test_a_device_is_described_by_the_kernels_list(root):
    root.plug(
        Plugged(XTION, bus=3, address=7, ports=(1, 4), product="Xtion PRO LIVE", serial="A1", xhci=True)
    )
    (device,) = read_usb(root.path)
    assert (device.ids, device.port, device.speed) == ("1d27:0601", "3-1.4", "high")
    assert (device.bus, device.address) == (3, 7)
    assert (device.product, device.serial) == ("Xtion PRO LIVE", "A1")
    assert device.usb3_controller


@pytest.mark.parametrize(
    ("refusal", "access"),
    [(errno.EACCES, "denied"), (errno.EPERM, "denied"), (errno.ENODEV, "no-node"), (0, "open")],
)
def test_whether_a_device_can_be_opened_is_found_by_opening_its_file(root, monkeypatch, refusal, access):
    root.plug(Plugged(XTION))
    (device,) = read_usb(root.path)
    descriptors, really_open = [], os.open

    def opened(path, flags):
        assert path == root.path / "dev/bus/usb/001/005"
        assert flags & os.O_RDWR
        if refusal:
            raise OSError(refusal, os.strerror(refusal))
        descriptors.append(really_open(path, flags))
        return descriptors[-1]

    monkeypatch.setattr(os, "open", opened)
    assert try_to_open(device, root.path) == access
    for descriptor in descriptors:
        with pytest.raises(OSError, match="Bad file descriptor"):
            os.fstat(descriptor)


def test_a_camera_whose_device_file_is_not_here_is_reported(root):
    root.plug(Plugged(XTION))
    root.remove("dev/bus/usb/001")
    (part,) = camera_parts(read_usb(root.path), root.path)
    assert part.access == "no-node"


def test_devices_that_are_no_cameras_are_listed_but_left_alone(root, monkeypatch):
    root.plug(Plugged(MOUSE))
    monkeypatch.setattr(os, "open", lambda *_: pytest.fail("opened"))
    (device,) = devices = read_usb(root.path)
    assert device.ids == "046d:c077"
    assert camera_parts(devices, root.path) == ()


def test_hubs_are_left_out(root):
    root.plug(Plugged((0x05E3, 0x0610), drivers=("hub",)))
    assert read_usb(root.path) == ()


def test_kernel_drivers_are_those_of_the_devices_own_interfaces(root):
    root.plug(Plugged(KINECT_CAMERA, ports=(2,), drivers=("gspca_kinect",)))
    root.plug(Plugged(MOUSE, address=9, ports=(2, 1), drivers=("usbhid",)))
    assert {device.ids: device.drivers for device in read_usb(root.path)} == {
        "045e:02ae": ("gspca_kinect",),
        "046d:c077": ("usbhid",),
    }


def test_half_an_entry_of_a_device_that_is_just_leaving_is_passed_over(root):
    root.plug(Plugged(XTION))
    root.remove("sys/bus/usb/devices/1-2/idVendor")
    assert read_usb(root.path) == ()


class ScriptedLibusb(usb.backend.IBackend):
    """libusb as pyusb uses it: a device without product cannot be opened, one without serial is silent."""

    def __init__(self, *plugged, failure=None):
        super().__init__()
        self.plugged, self.failure, self.handles = plugged, failure, []

    def enumerate_devices(self):
        if self.failure:
            raise self.failure
        return iter(self.plugged)

    def get_device_descriptor(self, dev):
        names = "bLength bDescriptorType bcdUSB bDeviceClass bDeviceSubClass bDeviceProtocol bMaxPacketSize0 "
        names += "bcdDevice iManufacturer bNumConfigurations"
        known = {"idVendor": dev.ids[0], "idProduct": dev.ids[1], "iProduct": 2, "iSerialNumber": 3}
        known |= {"bus": dev.bus, "address": dev.address, "port_number": None, "port_numbers": dev.ports}
        known |= {"speed": {"low": 1, "high": 3, "super+": 5}.get(dev.speed)}
        known |= {"bDeviceClass": 9} if dev.drivers == ("hub",) else {}
        return SimpleNamespace(**dict.fromkeys(names.split(), 0) | known)

    def open_device(self, dev):
        if dev.product is None:
            raise usb.core.USBError("Access denied", -3, errno.EACCES)
        assert not self.handles, "a device is closed before the next one is opened"
        self.handles.append(dev)
        return dev

    def close_device(self, dev_handle):
        self.handles.remove(dev_handle)

    def ctrl_transfer(self, dev_handle, bmRequestType, bRequest, wValue, wIndex, data, timeout):
        text = {0: "\u0409", 2: dev_handle.product, 3: dev_handle.serial}[wValue & 0xFF]
        if text is None:
            raise usb.core.USBError("Operation timed out", -7, errno.ETIMEDOUT)
        content = text.encode("utf-16-le")
        data[: len(content) + 2] = array.array("B", [len(content) + 2, 3, *content])
        return len(content) + 2


def test_without_the_kernels_list_that_of_libusb_is_read(tmp_path, monkeypatch):
    libusb = ScriptedLibusb(
        Plugged(XTION, bus=3, address=7, ports=(1, 4), product="PRO LIVE", serial="A1"),
        Plugged(MOUSE, address=8, ports=(), speed="low", product="Mouse"),
        Plugged((0x0B05, 0x1234), address=9, speed="super+", product="ASUS Xtion 2", serial=None),
        Plugged(KINECT_2, speed="", product=None),
        Plugged((0x05E3, 0x0610), drivers=("hub",)),
    )
    monkeypatch.setattr(usb.backend.libusb1, "get_backend", lambda: libusb)
    assert read_usb(tmp_path) == (
        UsbDevice(*XTION, bus=3, address=7, port="3-1.4", speed="high", product="PRO LIVE", serial="A1"),
        # A device that is no camera is not opened, not even for its name.
        UsbDevice(*MOUSE, bus=1, address=8, speed="low"),
        UsbDevice(0x0B05, 0x1234, bus=1, address=9, port="1-2", speed="super+", product="ASUS Xtion 2"),
        UsbDevice(*KINECT_2, bus=1, address=5, port="1-2"),
    )
    assert not libusb.handles


@pytest.mark.parametrize("failure", [usb.core.NoBackendError("none"), usb.core.USBError("no list")])
def test_without_the_kernels_list_and_libusb_no_device_is_found(tmp_path, monkeypatch, failure):
    monkeypatch.setattr(usb.backend.libusb1, "get_backend", lambda: ScriptedLibusb(failure=failure))
    assert read_usb(tmp_path) == ()


@pytest.mark.parametrize(
    ("ids", "family", "role"),
    [
        (XTION, "ps1080", "camera"),
        ((0x1D27, 0x1290), "pslink", "camera"),
        ((0x1D27, 0xF9DB), "pslink", "camera"),
        (KINECT_CAMERA, "kinect1", "camera"),
        ((0x045E, 0x02BB), "kinect1", "audio"),
        ((0x045E, 0x02C2), "kinect1", "motor"),
        (KINECT_2, "kinect2", "camera"),
        (ASTRA, "orbbec", "camera"),
        ((0x2BC5, 0x0614), "orbbec", "camera"),
    ],
)
def test_ids_name_the_camera_or_its_part(ids, family, role):
    model = identify(*ids)
    assert model is not None
    assert (model.family.key, model.role) == (family, role)


def test_an_astras_webcam_half_is_not_taken_for_the_depth_camera():
    assert identify(0x2BC5, 0x0501) is None


def test_an_xtion_2_is_known_by_its_name_only():
    model = identify(0x0B05, 0x1234, "ASUS Xtion 2")
    assert model is not None and model.family.key == "xtion2"
    assert identify(0x0B05, 0x1234, "ASUS USB keyboard") is None


def test_words_of_the_device_flag_name_families():
    assert {family.key for family in families("kinect")} == {"kinect1", "kinect2"}
    assert {family.key for family in families("openni2:xtion")} == {"ps1080", "pslink", "xtion2"}
    assert families("1d27/0601@1/5") == families("any")
