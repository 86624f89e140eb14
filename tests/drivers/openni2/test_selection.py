"""Which camera is taken when there are several."""

import pytest
from plugged_usb import FakeRoot, Plugged

from nurbseg.common.errors import DeviceNotFoundError
from nurbseg.drivers.openni2.device import DeviceSource
from nurbseg.drivers.openni2.library import DeviceListing
from nurbseg.drivers.openni2.opened import choose, family_of, is_camera, usb_port
from nurbseg.drivers.options import DeviceOptions

XTION = DeviceListing("1d27/0601@2/5", "PrimeSense", "PS1080", 0x1D27, 0x0601)
KINECT = DeviceListing("freenect://0", "Microsoft", "Kinect", 0x045E, 0x02AE)
NAMELESS = DeviceListing("libfreenect2://1", "Microsoft", "Kinect v2", 0, 0)
RECORDING = DeviceListing("/tmp/clip.ONI", "PrimeSense", "oni File", 0, 0)
SERIALS = {XTION.uri: "X1", KINECT.uri: "K1", NAMELESS.uri: "K2"}


def chosen(wanted, serial="", there=(RECORDING, KINECT, XTION, NAMELESS)):
    return choose(there, wanted, serial, lambda listing: SERIALS[listing.uri])[0]


@pytest.mark.parametrize(
    ("wanted", "expected"),
    [
        ("", KINECT),
        ("any", KINECT),
        ("xtion", XTION),
        ("Xtion", XTION),
        ("kinect", KINECT),
        ("1d27/0601@2/5", XTION),
        ("X1", XTION),
        ("K2", NAMELESS),
    ],
)
def test_cameras_are_chosen_by_kind_uri_or_serial_number(wanted, expected):
    assert chosen(wanted) is expected


def test_a_serial_number_decides_among_cameras_of_a_kind():
    assert chosen("kinect", "K2") is NAMELESS
    with pytest.raises(
        DeviceNotFoundError, match=r"openni2:xtion with serial number K1: no such camera.*serial X1\) at 1d27"
    ):
        chosen("xtion", "K1")


def test_recordings_left_open_are_no_cameras():
    assert not is_camera(RECORDING)
    with pytest.raises(DeviceNotFoundError, match="finds no camera at all"):
        chosen("any", there=[RECORDING])


def test_families_follow_from_ids_else_from_words():
    assert family_of(XTION) == "ps1080"
    assert family_of(KINECT) == "kinect1"
    assert family_of(NAMELESS) == "kinect2"
    assert family_of(DeviceListing("x", "Somebody", "Webcam", 0x1234, 0x5678)) == ""


def test_the_port_is_found_by_bus_and_address(tmp_path):
    root = FakeRoot(tmp_path)
    for bus, address, ports in ((2, 4, (1,)), (2, 5, (1, 3)), (1, 5, (1, 3))):
        root.plug(Plugged((0x1D27, 0x0601), bus, address, ports))
    assert usb_port("1d27/0601@2/5", tmp_path) == "2-1.3"
    assert usb_port("1d27/0601@22/5", tmp_path) == "1d27/0601@22/5"
    assert usb_port("freenect://0", tmp_path) == "freenect://0"


def test_two_cameras_are_distinguished_and_used_at_once(virtual_cameras):
    virtual_cameras.add("first", serial="A1", usb_product=0x0600)
    virtual_cameras.add("second", serial="B2", vendor="Microsoft", usb_vendor=0x045E, usb_product=0x02AE)
    options = DeviceOptions(serial="A1")
    with DeviceSource("kinect") as kinect, DeviceSource("any", options) as xtion:
        assert kinect.metadata["uri"] == "virtual/second"
        assert xtion.metadata["uri"] == "virtual/first"
        assert (kinect.metadata["serial"], xtion.metadata["serial"]) == ("B2", "A1")
        for _ in range(5):
            assert kinect.read().depth_mm.shape == xtion.read().depth_mm.shape


def test_of_several_cameras_a_free_one_is_taken(virtual_cameras):
    first = virtual_cameras.add("first", serial="A1")
    second = virtual_cameras.add("second", serial="B2")
    for busy in (0, 1):
        first.set(busy=busy)
        second.set(busy=1 - busy)
        with DeviceSource("xtion") as source:
            assert source.metadata["serial"] == ("B2" if busy else "A1")


def test_a_camera_that_another_program_has_is_named(virtual_cameras):
    virtual_cameras.add("first", serial="A1", busy=1)
    with pytest.raises(DeviceNotFoundError, match="opening virtual/first: OpenNI2 answers"):
        DeviceSource("xtion")
    with pytest.raises(DeviceNotFoundError, match=r"serial unknown.*another program"):
        DeviceSource("any", DeviceOptions(serial="A1"))


def test_unplugging_one_camera_leaves_the_other(virtual_cameras):
    first = virtual_cameras.add("first", serial="A1")
    virtual_cameras.add("second", serial="B2")
    with DeviceSource("A1"), DeviceSource("B2") as other:
        first.unplug()
        for _ in range(20):
            other.read()
